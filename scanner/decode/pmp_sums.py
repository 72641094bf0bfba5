"""Sums and phases of PMP: all frames of some pixels to phase, modulation, mean and residual of every set.

Frames are given by the addresses of their pixels, so that they may lie anywhere: in memory, or in the map of a file.
A set that is whole and has four or eight shifts is fitted by the halves that are each other's negative, in whole
numbers as far as these go; any other set goes through least squares, frame by frame. What is made of the phases is the
business of `pmp_kernels`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.addresses import aligned_rows, expect_pixels, pixels_at
from scanner.kernel import contracting_kernel
from scanner.lanes import (
    LANES,
    Lanes,
    choose,
    floats,
    greatest,
    least,
    load,
    magnitude,
    multiply_add,
    samples,
    store,
    with_sign,
)

TILE = 1024
"""Pixels a tile: its working rows, some twenty of float32, stay in the second-level cache beside 24 frames' worth."""

GROUP = 4
"""Sets are padded to whole groups of frames, with frames of weight 0."""

ARCTAN_ERROR_CYCLES = 3.5e-7
"""Largest error of `_phase`: a third of what rounding to 16 bits leaves of three shifts that fill the range, and a
thousandth of what any camera's noise does."""

_F0 = np.float32(0)
_F1 = np.float32(1)
_F4 = np.float32(4)
_HALF = np.float32(0.5)
_QUARTER = np.float32(0.25)
_EIGHTH = np.float32(0.125)
_ROOT_HALF = np.float32(0.5**0.5)
_TINY = np.float32(1e-12)
_PER_TURN = np.float32(1 / (2 * np.pi))

# atan(x) / (2 pi x) in x^2 on [0, 1]: least-maximum fit of six terms, error of atan(x) / 2 pi below 3e-7.
_A0 = np.float32(0.1591513175)
_A1 = np.float32(-0.0529385695)
_A2 = np.float32(0.0308029203)
_A3 = np.float32(-0.0185298779)
_A4 = np.float32(0.0083791126)
_A5 = np.float32(-0.0018651675)


@contracting_kernel
def fit_runs(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    starts: NDArray[np.intp],
    weights: NDArray[np.float32],
    grams: NDArray[np.float32],
    whole: NDArray[np.intp],
    clip: int,
    runs: NDArray[np.intp],
    length: int,
    phases: NDArray[np.float32],
    modulations: NDArray[np.float32],
    mean: NDArray[np.float32],
    residual: NDArray[np.float32],
    clipped: NDArray[np.bool_],
) -> None:
    """Fit the sets at a sample of pixels: `length` of them, up to TILE, from each of `runs` on.

    Args:
        addresses, like, starts, weights, grams, whole, clip: see `decode_pixels`.
        runs: (R,) first pixel of each run.
        phases, modulations: (K, R x length) float32, written: cycles, grey levels.
        mean, residual: (R x length,) float32, written: A, mean of the sets; squared residuals, sum of the sets.
        clipped: (R x length,) bool, written.
    """
    sets = starts.size - 1
    rows = aligned_rows(3 * sets + 3, TILE)
    for r in range(runs.size):
        fit_tile(addresses, like, starts, weights, grams, whole, runs[r], length, False, rows)
        to = r * length
        for k in range(sets):
            for i in range(length):
                phases[k, to + i] = rows[k, i]
                modulations[k, to + i] = np.sqrt(rows[sets + k, i])
        for i in range(length):
            mean[to + i] = rows[3 * sets, i]
            residual[to + i] = rows[3 * sets + 1, i]
            clipped[to + i] = rows[3 * sets + 2, i] >= clip


@contracting_kernel
def fit_tile(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    starts: NDArray[np.intp],
    weights: NDArray[np.float32],
    grams: NDArray[np.float32],
    whole: NDArray[np.intp],
    at: int,
    size: int,
    more: bool,
    rows: NDArray[np.float32],
) -> None:
    """Fit all sets at `size` pixels from `at` on; more: the pixels behind them will be asked for next.

    Args:
        rows: (3 K + 3, TILE) float32, written: phases, cycles; B^2; 1 / B^2; A, the mean of the sets; their squared
            residuals; the brightest sample. Up to LANES columns more than `size` are written.
    """
    solid = size // LANES * LANES
    _fit_blocks(addresses, like, starts, weights, grams, whole, at, 0, solid, size if more else 0, rows)
    if solid < size:
        # What is left goes into vectors of its own: nothing may be read beyond a frame's last pixel.
        spare = np.zeros((addresses.size, LANES), like.dtype)
        copies = np.empty_like(addresses)
        for n in range(addresses.size):
            spare[n, : size - solid] = pixels_at(addresses[n], at + solid, size - solid, like)
            copies[n] = spare[n:].ctypes.data - (at + solid) * like.itemsize
        _fit_blocks(copies, like, starts, weights, grams, whole, at, solid, solid + LANES, 0, rows)


@contracting_kernel
def _fit_blocks(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    starts: NDArray[np.intp],
    weights: NDArray[np.float32],
    grams: NDArray[np.float32],
    whole: NDArray[np.intp],
    at: int,
    begin: int,
    end: int,
    ahead: int,
    rows: NDArray[np.float32],
) -> None:
    sets = starts.size - 1
    share = _F1 / np.float32(sets)
    mean, residual, top = rows[3 * sets], rows[3 * sets + 1], rows[3 * sets + 2]
    for i in range(begin, end):
        mean[i] = _F0
        residual[i] = _F0
        top[i] = _F0
    for k in range(sets):
        if ahead > 0:
            # What the next tile will ask for, set by set: fetched while this one is worked on.
            for n in range(starts[k], starts[k + 1]):
                expect_pixels(addresses[n], at + ahead, ahead, like)
        first = starts[k]
        if whole[k] == 8:
            _fit_eight(addresses, like, first, weights[:, first : first + 3], share, at, begin, end, k, rows)
        elif whole[k] == 4:
            _fit_four(addresses, like, first, weights[:, first : first + 2], share, at, begin, end, k, rows)
        else:
            _fit_any(addresses, like, first, starts[k + 1], weights, grams[k], share, at, begin, end, k, rows)


@contracting_kernel
def _fit_eight(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    first: int,
    weights: NDArray[np.float32],
    share: np.float32,
    at: int,
    begin: int,
    end: int,
    k: int,
    rows: NDArray[np.float32],
) -> None:
    phases, squares, inverses, mean, residual, top = _rows_of(rows, k)
    # Samples half a turn apart: their difference has the odd harmonics alone, the fringe and the third; their sum what
    # is no fringe at all. Weights say how the set's phase counts: which way, and from where.
    direction = np.float32(16) * (weights[1, 0] * weights[2, 2] - weights[1, 2] * weights[2, 0])
    origin = np.float32(np.arctan2(weights[2, 0], weights[1, 0])) * _PER_TURN
    level = share * _EIGHTH
    for i in range(begin, end, LANES):
        x1, x2 = samples(addresses, first, at + i, like), samples(addresses, first + 1, at + i, like)
        x3, x4 = samples(addresses, first + 2, at + i, like), samples(addresses, first + 3, at + i, like)
        x5, x6 = samples(addresses, first + 4, at + i, like), samples(addresses, first + 5, at + i, like)
        x7, x8 = samples(addresses, first + 6, at + i, like), samples(addresses, first + 7, at + i, like)
        high = greatest(greatest(greatest(x1, x2), greatest(x3, x4)), greatest(greatest(x5, x6), greatest(x7, x8)))
        store(top, i, greatest(load(top, i), floats(high)))
        s1, s2, s3, s4 = x1 + x5, x2 + x6, x3 + x7, x4 + x8
        d2, d4 = x2 - x6, x4 - x8
        s13, s24 = s1 + s3, s2 + s4
        a, b, c, d = floats(x1 - x5), floats(d2 - d4), floats(x3 - x7), floats(d2 + d4)
        p, q = multiply_add(b, _ROOT_HALF, a), multiply_add(d, _ROOT_HALF, c)
        u, v = multiply_add(b, -_ROOT_HALF, a), multiply_add(d, -_ROOT_HALF, c)
        e, f, g = floats(s1 - s3), floats(s2 - s4), floats(s13 - s24)
        store(mean, i, load(mean, i) + level * floats(s13 + s24))
        rest = u * u + v * v + e * e + f * f + (_HALF * g) * g
        store(residual, i, load(residual, i) + _QUARTER * rest)
        square, inverse, phase = _phase(p, q, np.float32(0.0625))
        store(squares, i, square)
        store(inverses, i, inverse)
        store(phases, i, direction * phase + origin)


@contracting_kernel
def _fit_four(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    first: int,
    weights: NDArray[np.float32],
    share: np.float32,
    at: int,
    begin: int,
    end: int,
    k: int,
    rows: NDArray[np.float32],
) -> None:
    phases, squares, inverses, mean, residual, top = _rows_of(rows, k)
    direction = _F4 * (weights[1, 0] * weights[2, 1] - weights[1, 1] * weights[2, 0])
    origin = np.float32(np.arctan2(weights[2, 0], weights[1, 0])) * _PER_TURN
    level = share * _QUARTER
    for i in range(begin, end, LANES):
        x1, x2 = samples(addresses, first, at + i, like), samples(addresses, first + 1, at + i, like)
        x3, x4 = samples(addresses, first + 2, at + i, like), samples(addresses, first + 3, at + i, like)
        high = greatest(greatest(x1, x2), greatest(x3, x4))
        store(top, i, greatest(load(top, i), floats(high)))
        s1, s2 = x1 + x3, x2 + x4
        rest = floats(s1 - s2)
        store(mean, i, load(mean, i) + level * floats(s1 + s2))
        store(residual, i, load(residual, i) + (_QUARTER * rest) * rest)
        square, inverse, phase = _phase(floats(x1 - x3), floats(x2 - x4), _QUARTER)
        store(squares, i, square)
        store(inverses, i, inverse)
        store(phases, i, direction * phase + origin)


@contracting_kernel
def _fit_any(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    first: int,
    last: int,
    weights: NDArray[np.float32],
    gram: NDArray[np.float32],
    share: np.float32,
    at: int,
    begin: int,
    end: int,
    k: int,
    rows: NDArray[np.float32],
) -> None:
    phases, squares, inverses, mean, residual, top = _rows_of(rows, k)
    g00, g11, g22, g01, g02, g12 = gram[0], gram[1], gram[2], gram[3], gram[4], gram[5]
    for i in range(begin, end, LANES):
        # Differences from the first frame: small numbers, so that float32 keeps the residual of 16-bit frames.
        x1 = samples(addresses, first, at + i, like)
        high, a, p, q, total = x1, floats(_F0), floats(_F0), floats(_F0), floats(_F0)
        for n in range(first + 1, last):
            x = samples(addresses, n, at + i, like)
            high = greatest(high, x)
            d = floats(x - x1)
            a += weights[0, n] * d
            p += weights[1, n] * d
            q += weights[2, n] * d
            total += d * d
        store(top, i, greatest(load(top, i), floats(high)))
        explained = a * (g00 * a + g01 * p + g02 * q) + p * (g11 * p + g12 * q) + g22 * q * q
        store(mean, i, load(mean, i) + share * (floats(x1) + a))
        store(residual, i, load(residual, i) + greatest(total - explained, _F0))
        square, inverse, phase = _phase(p, q, _F1)
        store(squares, i, square)
        store(inverses, i, inverse)
        store(phases, i, phase)


@contracting_kernel
def _rows_of(rows: NDArray[np.float32], k: int) -> tuple[NDArray[np.float32], ...]:
    """The rows that the k-th set writes, and the three that all sets add to."""
    sets = (rows.shape[0] - 3) // 3
    return rows[k], rows[sets + k], rows[2 * sets + k], rows[3 * sets], rows[3 * sets + 1], rows[3 * sets + 2]


@contracting_kernel
def _phase(p: Lanes, q: Lanes, scale: np.float32) -> tuple[Lanes, Lanes, Lanes]:
    """scale (p^2 + q^2) and its inverse; atan2(q, p) in cycles, -.5 .. .5."""
    x, y = magnitude(p), magnitude(q)
    square = scale * (p * p + q * q) + _TINY
    t = least(x, y) / (greatest(x, y) + _TINY)
    z = t * t
    s = t * (_A0 + z * (_A1 + z * (_A2 + z * (_A3 + z * (_A4 + z * _A5)))))
    s = choose(y > x, _QUARTER - s, s)
    s = choose(p < _F0, _HALF - s, s)
    return square, _F1 / square, with_sign(s, q)
