"""Sums and phases of PMP: all frames of some pixels to phase, modulation, mean and residual of every set.

Frames are given by the addresses of their pixels, so that they may lie anywhere: in memory, or in the map of a file.
A set that is whole and has four or eight shifts is fitted in one loop, which makes use of the half that is the
negative of the other; any other set goes through least squares, four frames at a time. What is made of the phases is
the business of `pmp_kernels`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.addresses import aligned_rows, expect_pixels, pixels_at
from scanner.kernel import contracting_kernel

TILE = 2048
"""Pixels a tile: its working arrays, some thirty float32 rows, fit the second-level cache beside 24 frames' worth."""

SUMS = 5
"""Rows of working memory for the sums of a set: its first frame, A and p and q, the squares."""

GROUP = 4
"""Frames read together. Sets are padded to whole groups with frames of weight 0."""

ARCTAN_ERROR_CYCLES = 3.5e-7
"""Largest error of `_measure` and `_turn`: a third of what rounding to 16 bits leaves of three shifts that fill the
range, and a thousandth of what any camera's noise does."""

_F0 = np.float32(0)
_F1 = np.float32(1)
_HALF = np.float32(0.5)
_QUARTER = np.float32(0.25)
_EIGHTH = np.float32(0.125)
_TINY = np.float32(1e-12)
_F4 = np.float32(4)
_FOUR, _EIGHT = 4, 8
_FIRST, _A, _P, _Q, _SQUARES = range(SUMS)

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
        phases, modulations: (K, R x length) float32, written: cycles in -.5 .. .5, grey levels.
        mean, residual: (R x length,) float32, written: A, mean of the sets; squared residuals, sum of the sets.
        clipped: (R x length,) bool, written.
    """
    sets = starts.size - 1
    work = aligned_rows(3 * sets + SUMS + 2, TILE)
    tile_phases, squares, inverses = work[:sets], work[sets : 2 * sets], work[2 * sets : 3 * sets]
    sums, tile_mean, tile_residual = work[3 * sets : -2], work[-2], work[-1]
    top = np.empty(TILE, like.dtype)
    for r in range(runs.size):
        fit_tile(
            addresses, like, starts, weights, grams, whole, runs[r], length,
            sums, tile_phases, squares, inverses, tile_mean, tile_residual, top,
        )  # fmt: skip
        to = r * length
        for k in range(sets):
            for i in range(length):
                phases[k, to + i] = tile_phases[k, i]
                modulations[k, to + i] = np.sqrt(squares[k, i])
        for i in range(length):
            mean[to + i] = tile_mean[i]
            residual[to + i] = tile_residual[i]
            clipped[to + i] = top[i] >= clip


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
    sums: NDArray[np.float32],
    phases: NDArray[np.float32],
    squares: NDArray[np.float32],
    inverses: NDArray[np.float32],
    mean: NDArray[np.float32],
    residual: NDArray[np.float32],
    top: NDArray[Any],
) -> None:
    """All sets at `size` pixels from `at` on: phases, B^2, 1 / B^2; A, squared residuals and brightest sample."""
    for i in range(size):
        mean[i] = _F0
        residual[i] = _F0
        top[i] = 0
    sets = starts.size - 1
    for k in range(sets):
        first = starts[k]
        for n in range(first, starts[k + 1]):
            expect_pixels(addresses[n], at + size, size, like)
        one = pixels_at(addresses[first], at, size, like)
        two = pixels_at(addresses[first + 1], at, size, like)
        three = pixels_at(addresses[first + 2], at, size, like)
        four = pixels_at(addresses[first + 3], at, size, like)
        _brightest(one, two, three, four, size, top)
        part = weights[:, first : first + GROUP]
        if whole[k] == _FOUR:
            _sum_four(one, two, three, four, part, size, sums, mean, residual)
        elif whole[k] == _EIGHT:
            five = pixels_at(addresses[first + 4], at, size, like)
            six = pixels_at(addresses[first + 5], at, size, like)
            seven = pixels_at(addresses[first + 6], at, size, like)
            eight = pixels_at(addresses[first + 7], at, size, like)
            _brightest(five, six, seven, eight, size, top)
            _sum_eight(one, two, three, four, five, six, seven, eight, part, size, sums, mean, residual)
        else:
            _begin(one, two, three, four, part, size, sums)
            for n in range(first + GROUP, starts[k + 1], GROUP):
                one = pixels_at(addresses[n], at, size, like)
                two = pixels_at(addresses[n + 1], at, size, like)
                three = pixels_at(addresses[n + 2], at, size, like)
                four = pixels_at(addresses[n + 3], at, size, like)
                _brightest(one, two, three, four, size, top)
                _add(one, two, three, four, weights[:, n : n + GROUP], size, sums)
            _explain(sums, grams[k], size, mean, residual)
        _measure(sums[_P], sums[_Q], size, phases[k], squares[k], inverses[k])
        _turn(sums[_P], sums[_Q], size, phases[k])
    share = _F1 / np.float32(sets)
    for i in range(size):
        mean[i] *= share


@contracting_kernel
def _begin(
    one: NDArray[Any],
    two: NDArray[Any],
    three: NDArray[Any],
    four: NDArray[Any],
    weights: NDArray[np.float32],
    size: int,
    sums: NDArray[np.float32],
) -> None:
    a2, a3, a4 = weights[0, 1], weights[0, 2], weights[0, 3]
    p2, p3, p4 = weights[1, 1], weights[1, 2], weights[1, 3]
    q2, q3, q4 = weights[2, 1], weights[2, 2], weights[2, 3]
    for i in range(size):
        # Differences from the first frame: small numbers, so that float32 keeps the residual of 16-bit frames.
        first = np.float32(one[i])
        d2 = np.float32(two[i]) - first
        d3 = np.float32(three[i]) - first
        d4 = np.float32(four[i]) - first
        sums[0, i] = first
        sums[1, i] = a2 * d2 + a3 * d3 + a4 * d4
        sums[2, i] = p2 * d2 + p3 * d3 + p4 * d4
        sums[3, i] = q2 * d2 + q3 * d3 + q4 * d4
        sums[4, i] = d2 * d2 + d3 * d3 + d4 * d4


@contracting_kernel
def _add(
    one: NDArray[Any],
    two: NDArray[Any],
    three: NDArray[Any],
    four: NDArray[Any],
    weights: NDArray[np.float32],
    size: int,
    sums: NDArray[np.float32],
) -> None:
    a1, a2, a3, a4 = weights[0, 0], weights[0, 1], weights[0, 2], weights[0, 3]
    p1, p2, p3, p4 = weights[1, 0], weights[1, 1], weights[1, 2], weights[1, 3]
    q1, q2, q3, q4 = weights[2, 0], weights[2, 1], weights[2, 2], weights[2, 3]
    for i in range(size):
        first = sums[0, i]
        d1 = np.float32(one[i]) - first
        d2 = np.float32(two[i]) - first
        d3 = np.float32(three[i]) - first
        d4 = np.float32(four[i]) - first
        sums[1, i] += a1 * d1 + a2 * d2 + a3 * d3 + a4 * d4
        sums[2, i] += p1 * d1 + p2 * d2 + p3 * d3 + p4 * d4
        sums[3, i] += q1 * d1 + q2 * d2 + q3 * d3 + q4 * d4
        sums[4, i] += d1 * d1 + d2 * d2 + d3 * d3 + d4 * d4


@contracting_kernel
def _brightest(
    one: NDArray[Any], two: NDArray[Any], three: NDArray[Any], four: NDArray[Any], size: int, top: NDArray[Any]
) -> None:
    for i in range(size):
        top[i] = max(top[i], one[i], two[i], three[i], four[i])


@contracting_kernel
def _explain(
    sums: NDArray[np.float32],
    gram: NDArray[np.float32],
    size: int,
    mean: NDArray[np.float32],
    residual: NDArray[np.float32],
) -> None:
    g00, g11, g22, g01, g02, g12 = gram[0], gram[1], gram[2], gram[3], gram[4], gram[5]
    for i in range(size):
        a, p, q = sums[_A, i], sums[_P, i], sums[_Q, i]
        explained = a * (g00 * a + g01 * p + g02 * q) + p * (g11 * p + g12 * q) + g22 * q * q
        residual[i] += max(sums[_SQUARES, i] - explained, _F0)
        mean[i] += sums[_FIRST, i] + a


# --- whole sets of four and eight -------------------------------------------------------------------------------------


@contracting_kernel
def _sum_four(
    one: NDArray[Any],
    two: NDArray[Any],
    three: NDArray[Any],
    four: NDArray[Any],
    weights: NDArray[np.float32],
    size: int,
    sums: NDArray[np.float32],
    mean: NDArray[np.float32],
    residual: NDArray[np.float32],
) -> None:
    # Samples half a turn apart: their difference has the fringe alone, their sum what is no fringe.
    p1, p2, q1, q2 = weights[1, 0], weights[1, 1], weights[2, 0], weights[2, 1]
    for i in range(size):
        x1, x2, x3, x4 = np.float32(one[i]), np.float32(two[i]), np.float32(three[i]), np.float32(four[i])
        d1, d2 = x1 - x3, x2 - x4
        s1, s2 = x1 + x3, x2 + x4
        sums[_P, i] = p1 * d1 + p2 * d2
        sums[_Q, i] = q1 * d1 + q2 * d2
        residual[i] += _QUARTER * (s1 - s2) * (s1 - s2)
        mean[i] += _QUARTER * (s1 + s2)


@contracting_kernel
def _sum_eight(
    one: NDArray[Any],
    two: NDArray[Any],
    three: NDArray[Any],
    four: NDArray[Any],
    five: NDArray[Any],
    six: NDArray[Any],
    seven: NDArray[Any],
    eight: NDArray[Any],
    weights: NDArray[np.float32],
    size: int,
    sums: NDArray[np.float32],
    mean: NDArray[np.float32],
    residual: NDArray[np.float32],
) -> None:
    # As with four; the differences' squares beyond the fringe's, and how the sums differ, are the residual.
    p1, p2, p3, p4 = weights[1, 0], weights[1, 1], weights[1, 2], weights[1, 3]
    q1, q2, q3, q4 = weights[2, 0], weights[2, 1], weights[2, 2], weights[2, 3]
    for i in range(size):
        x1, x2, x3, x4 = np.float32(one[i]), np.float32(two[i]), np.float32(three[i]), np.float32(four[i])
        x5, x6, x7, x8 = np.float32(five[i]), np.float32(six[i]), np.float32(seven[i]), np.float32(eight[i])
        d1, d2, d3, d4 = x1 - x5, x2 - x6, x3 - x7, x4 - x8
        s1, s2, s3, s4 = x1 + x5, x2 + x6, x3 + x7, x4 + x8
        p = p1 * d1 + p2 * d2 + p3 * d3 + p4 * d4
        q = q1 * d1 + q2 * d2 + q3 * d3 + q4 * d4
        odd = _HALF * (d1 * d1 + d2 * d2 + d3 * d3 + d4 * d4) - _F4 * (p * p + q * q)
        s13, s24 = s1 + s3, s2 + s4
        even = _QUARTER * ((s1 - s3) * (s1 - s3) + (s2 - s4) * (s2 - s4)) + _EIGHTH * (s13 - s24) * (s13 - s24)
        sums[_P, i] = p
        sums[_Q, i] = q
        residual[i] += max(odd, _F0) + even
        mean[i] += _EIGHTH * (s13 + s24)


# --- phases -----------------------------------------------------------------------------------------------------------

# Loops are cut where their constants would no longer fit the registers: reloading them costs more than an array.


@contracting_kernel
def _measure(
    p: NDArray[np.float32],
    q: NDArray[np.float32],
    size: int,
    phases: NDArray[np.float32],
    squares: NDArray[np.float32],
    inverses: NDArray[np.float32],
) -> None:
    """B^2 and 1 / B^2; the phase within its octant, cycles."""
    for i in range(size):
        x, y = abs(p[i]), abs(q[i])
        b2 = x * x + y * y + _TINY
        squares[i] = b2
        inverses[i] = _F1 / b2
        t = min(x, y) / (max(x, y) + _TINY)
        z = t * t
        phases[i] = t * (_A0 + z * (_A1 + z * (_A2 + z * (_A3 + z * (_A4 + z * _A5)))))


@contracting_kernel
def _turn(p: NDArray[np.float32], q: NDArray[np.float32], size: int, phases: NDArray[np.float32]) -> None:
    """The octant put back: atan2(q, p) in cycles, -.5 .. .5."""
    for i in range(size):
        x, y, s = p[i], q[i], phases[i]
        s = _QUARTER - s if abs(y) > abs(x) else s
        s = _HALF - s if x < _F0 else s
        phases[i] = -s if y < _F0 else s
