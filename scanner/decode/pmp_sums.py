"""Sums and phases of PMP: all frames of a vector of pixels to phase, modulation, mean and residual of every set.

Frames are given by the addresses of their pixels, so that they may lie anywhere: in memory, or in the map of a file.
A set that is whole and has four or eight shifts is fitted by the halves that are each other's negative, in whole
numbers as far as these go (synchronous detection: Bruning et al. 1974); any other set goes through least squares, frame
by frame (Greivenkamp 1984). What is made of the phases is the business of `pmp_kernels`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.addresses import aligned_rows, copies_of
from scanner.kernel import contracting_kernel, inlined_kernel
from scanner.lane_memory import align_stack
from scanner.lane_quads import any_reaches, brighter, brightest, dot, energy, has_quads, no_quads, quads, weights_of
from scanner.lanes import (
    LANES,
    Lanes,
    as_samples,
    choose,
    expect,
    floats,
    greatest,
    least,
    load,
    magnitude,
    multiply_add,
    root,
    samples,
    store,
    whole,
    with_sign,
)

GROUP = 4
"""Sets are padded to whole groups of frames, with frames of weight 0."""

RUNS_AHEAD = 4
"""Runs of a sample that are asked for before they are worked on: work on one is much shorter than the wait for it."""

ARCTAN_ERROR_CYCLES = 3.5e-7
"""Largest error of `_phase`: a third of what rounding to 16 bits leaves of three shifts that fill the range, and a
thousandth of what any camera's noise does."""

_F0 = np.float32(0)
_HUGE = np.float32(np.inf)
_F1 = np.float32(1)
_F2 = np.float32(2)
_F4 = np.float32(4)
_HALF = np.float32(0.5)
_QUARTER = np.float32(0.25)
_EIGHTH = np.float32(0.125)
_SIXTEENTH = np.float32(0.0625)
_ROOT_HALF = np.float32(0.5**0.5)
_TINY = np.float32(1e-12)
_MIDDLE = np.float32(128)

# cos and sin of eighths of a turn as whole numbers: 99 / 70 is the square root of 2 but for 5e-5. What that leaves of
# the exact ratio is the same for both sums of any fringe, and goes into their scale.
_P_FIRST, _P_LATER = weights_of(99, 70, 0, -70), weights_of(-99, -70, 0, 70)
_Q_FIRST, _Q_LATER = weights_of(0, 70, 99, 70), weights_of(0, -70, -99, -70)
_LONG_EIGHT = np.float32((2 * 99 + 2 * 2**0.5 * 70) ** -2)
_P_FOUR, _Q_FOUR, _ONES = weights_of(1, 0, -1, 0), weights_of(0, 1, 0, -1), weights_of(1, 1, 1, 1)
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
    shifts: NDArray[np.intp],
    clip: int,
    pixels: int,
    runs: NDArray[np.intp],
    length: int,
    phases: NDArray[np.float32],
    modulations: NDArray[np.float32],
    mean: NDArray[np.float32],
    residual: NDArray[np.float32],
    clipped: NDArray[np.bool_],
) -> None:
    """Fit the sets at a sample of pixels: `length` of them from each of `runs` on.

    Args:
        addresses, like, starts, weights, grams, shifts, clip: see `decode_pixels`.
        pixels: of a frame.
        runs: (R,) first pixel of each run.
        phases, modulations: (K, R x length) float32, written: cycles, grey levels.
        mean, residual: (R x length,) float32, written: A, mean of the sets; squared residuals, sum of the sets.
        clipped: (R x length,) bool, written.
    """
    align_stack()
    sets = starts.size - 1
    turns = turns_of(starts, weights, shifts)
    spot = aligned_rows(2 * sets + 3, LANES).reshape(-1)
    spare = np.zeros((addresses.size, LANES), like.dtype)
    flat_phases, flat_modulations = phases.reshape(-1), modulations.reshape(-1)
    for r in range(RUNS_AHEAD):
        _expect_run(addresses, like, runs, r, length)
    for r in range(runs.size):
        _expect_run(addresses, like, runs, r + RUNS_AHEAD, length)
        for done in range(0, length, LANES):
            at, size = runs[r] + done, min(LANES, length - done)
            # The last vector may end with the frame, but not lie beyond it.
            begin = min(at, pixels - LANES)
            if begin < 0:
                near = copies_of(addresses, at, size, like, spare)
                begin = at
            else:
                near = addresses
            a, rest, _, clear = fit_lanes(near, like, starts, weights, grams, shifts, turns, clip, begin, spot)
            to, skip = r * length + done, at - begin
            store(spot, (2 * sets + 2) * LANES, choose(clear, _F0, _F1))
            for i in range(size):
                clipped[to + i] = spot[(2 * sets + 2) * LANES + skip + i] > _F0
            if size == LANES and skip == 0:
                for k in range(sets):
                    store(flat_phases, k * mean.size + to, load(spot, k * LANES))
                    store(flat_modulations, k * mean.size + to, root(load(spot, (sets + k) * LANES)))
                store(mean, to, a)
                store(residual, to, rest)
                continue
            store(spot, 2 * sets * LANES, a)
            store(spot, (2 * sets + 1) * LANES, rest)
            for k in range(sets):
                for i in range(size):
                    phases[k, to + i] = spot[k * LANES + skip + i]
                    modulations[k, to + i] = np.sqrt(spot[(sets + k) * LANES + skip + i])
            for i in range(size):
                mean[to + i] = spot[2 * sets * LANES + skip + i]
                residual[to + i] = spot[(2 * sets + 1) * LANES + skip + i]


@inlined_kernel
def _expect_run(addresses: NDArray[np.intp], like: NDArray[Any], runs: NDArray[np.intp], r: int, length: int) -> None:
    """Ask for the pixels of a run, if there is one, of up to two cache lines."""
    if r < runs.size:
        for n in range(addresses.size):
            expect(addresses, n, runs[r], like)
            expect(addresses, n, runs[r] + length - 1, like)


@contracting_kernel
def turns_of(starts: NDArray[np.intp], weights: NDArray[np.float32], shifts: NDArray[np.intp]) -> NDArray[np.float32]:
    """(K, 2): how the phase of a set of four or eight counts: which way, 1 or -1, and from where, cycles."""
    turns = np.empty((shifts.size, 2), np.float32)
    for k in range(shifts.size):
        turns[k, 0], turns[k, 1] = _F1, _F0
        if shifts[k] != 0:
            p, q = weights[1, starts[k]], weights[2, starts[k]]
            quarter = starts[k] + shifts[k] // 4
            turns[k, 0] = _F1 if p * weights[2, quarter] - q * weights[1, quarter] > _F0 else -_F1
            turns[k, 1] = np.float32(np.arctan2(q, p)) * _PER_TURN
    return turns


@inlined_kernel
def fit_lanes(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    starts: NDArray[np.intp],
    weights: NDArray[np.float32],
    grams: NDArray[np.float32],
    shifts: NDArray[np.intp],
    turns: NDArray[np.float32],
    clip: int,
    at: int,
    spot: NDArray[np.float32],
) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Fit all sets at LANES pixels from `at` on.

    Mean of their A, sum of their squared residuals, least of their B^2, where nothing clips.

    Args:
        spot: (2 K, LANES) and more, flat, float32, written: phases, cycles; B^2.
    """
    sets = starts.size - 1
    share = _F1 / np.float32(sets)
    mean, residual, weakest, top = floats(_F0), floats(_F0), floats(_HUGE), as_samples(0, like)
    # Of sets that are fitted in quads: samples' energy and sum from the middle of their range, the brightest.
    squares, sums, bright, level, dotted = whole(0), whole(0), no_quads(), floats(_F0), 0
    for k in range(sets):
        first, count = starts[k], shifts[k]
        if has_quads(like) and count != 0:
            if count == 8:
                p, q, total, squares, bright = _sum_eight(addresses, like, first, at, squares, bright)
                scale, part, half = _LONG_EIGHT, _EIGHTH, _F4
            else:
                p, q, total, squares, bright = _sum_four(addresses, like, first, at, squares, bright)
                scale, part, half = _QUARTER, _QUARTER, _F2
            square = scale * (p * p + q * q) + _TINY
            a = floats(total)
            own = part * a
            sums, level = sums + total, level + own
            dotted += 1
            residual -= a * own
            residual -= half * square
        else:
            if count == 8:
                p, q, scale, own, rest, high = _fit_eight(addresses, like, first, share, at)
            elif count == 4:
                p, q, scale, own, rest, high = _fit_four(addresses, like, first, share, at)
            else:
                p, q, scale, own, rest, high = _fit_any(
                    addresses, like, first, starts[k + 1], weights, grams[k], share, at
                )
            square = scale * (p * p + q * q) + _TINY
            mean += own
            residual += rest
            top = greatest(top, high)
        weakest = least(weakest, square)
        store(spot, k * LANES, turns[k, 0] * _phase(p, q) + turns[k, 1])
        store(spot, (sets + k) * LANES, square)
    clear = top < clip
    if has_quads(like):
        mean += share * (level + np.float32(dotted) * _MIDDLE)
        # x (x - 128) = y^2 + 128 y for y = x - 128
        residual = greatest(residual + floats(squares - 128 * sums), _F0)
        if any_reaches(bright, clip):
            clear = clear & (brightest(bright) < clip)
    return mean, residual, weakest, clear


@inlined_kernel
def _sum_eight(
    addresses: NDArray[np.intp], like: NDArray[Any], first: int, at: int, squares: Lanes, bright: Lanes
) -> tuple[Lanes, Lanes, Lanes, Lanes, Lanes]:
    """p and q, scaled; sum from the middle; energy and brightest with those of sets before."""
    x, y = quads(addresses, first, at, like), quads(addresses, first + 4, at, like)
    p, q = dot(y, _P_LATER, dot(x, _P_FIRST, 0)), dot(y, _Q_LATER, dot(x, _Q_FIRST, 0))
    total = dot(y, _ONES, dot(x, _ONES, -8 * 128))
    return floats(p), floats(q), total, energy(y, energy(x, squares)), brighter(bright, brighter(x, y))


@inlined_kernel
def _sum_four(
    addresses: NDArray[np.intp], like: NDArray[Any], first: int, at: int, squares: Lanes, bright: Lanes
) -> tuple[Lanes, Lanes, Lanes, Lanes, Lanes]:
    x = quads(addresses, first, at, like)
    p, q, total = dot(x, _P_FOUR, 0), dot(x, _Q_FOUR, 0), dot(x, _ONES, -4 * 128)
    return floats(p), floats(q), total, energy(x, squares), brighter(bright, x)


@inlined_kernel
def _fit_eight(
    addresses: NDArray[np.intp], like: NDArray[Any], first: int, share: np.float32, at: int
) -> tuple[Lanes, Lanes, np.float32, Lanes, Lanes, Lanes]:
    # Samples half a turn apart: their difference has the odd harmonics alone, the fringe and the third; their sum what
    # is no fringe at all.
    x1, x2 = samples(addresses, first, at, like), samples(addresses, first + 1, at, like)
    x3, x4 = samples(addresses, first + 2, at, like), samples(addresses, first + 3, at, like)
    x5, x6 = samples(addresses, first + 4, at, like), samples(addresses, first + 5, at, like)
    x7, x8 = samples(addresses, first + 6, at, like), samples(addresses, first + 7, at, like)
    high = greatest(greatest(greatest(x1, x2), greatest(x3, x4)), greatest(greatest(x5, x6), greatest(x7, x8)))
    s1, s2, s3, s4 = x1 + x5, x2 + x6, x3 + x7, x4 + x8
    d2, d4 = x2 - x6, x4 - x8
    s13, s24 = s1 + s3, s2 + s4
    a, b, c, d = floats(x1 - x5), floats(d2 - d4), floats(x3 - x7), floats(d2 + d4)
    p, q = multiply_add(b, _ROOT_HALF, a), multiply_add(d, _ROOT_HALF, c)
    u, v = multiply_add(b, -_ROOT_HALF, a), multiply_add(d, -_ROOT_HALF, c)
    e, f, g = floats(s1 - s3), floats(s2 - s4), floats(s13 - s24)
    rest = u * u + v * v + e * e + f * f + (_HALF * g) * g
    return p, q, _SIXTEENTH, (share * _EIGHTH) * floats(s13 + s24), _QUARTER * rest, high


@inlined_kernel
def _fit_four(
    addresses: NDArray[np.intp], like: NDArray[Any], first: int, share: np.float32, at: int
) -> tuple[Lanes, Lanes, np.float32, Lanes, Lanes, Lanes]:
    x1, x2 = samples(addresses, first, at, like), samples(addresses, first + 1, at, like)
    x3, x4 = samples(addresses, first + 2, at, like), samples(addresses, first + 3, at, like)
    high = greatest(greatest(x1, x2), greatest(x3, x4))
    s1, s2 = x1 + x3, x2 + x4
    rest = floats(s1 - s2)
    level = (share * _QUARTER) * floats(s1 + s2)
    return floats(x1 - x3), floats(x2 - x4), _QUARTER, level, (_QUARTER * rest) * rest, high


@inlined_kernel
def _fit_any(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    first: int,
    last: int,
    weights: NDArray[np.float32],
    gram: NDArray[np.float32],
    share: np.float32,
    at: int,
) -> tuple[Lanes, Lanes, np.float32, Lanes, Lanes, Lanes]:
    g00, g11, g22, g01, g02, g12 = gram[0], gram[1], gram[2], gram[3], gram[4], gram[5]
    # Differences from the first frame: small numbers, so that float32 keeps the residual of 16-bit frames.
    x1 = samples(addresses, first, at, like)
    high, a, p, q, total = x1, floats(_F0), floats(_F0), floats(_F0), floats(_F0)
    for n in range(first + 1, last):
        x = samples(addresses, n, at, like)
        high = greatest(high, x)
        d = floats(x - x1)
        a += weights[0, n] * d
        p += weights[1, n] * d
        q += weights[2, n] * d
        total += d * d
    explained = a * (g00 * a + g01 * p + g02 * q) + p * (g11 * p + g12 * q) + g22 * q * q
    return p, q, _F1, share * (floats(x1) + a), greatest(total - explained, _F0), high


@inlined_kernel
def _phase(p: Lanes, q: Lanes) -> Lanes:
    """atan2(q, p) in cycles, -.5 .. .5."""
    x, y = magnitude(p), magnitude(q)
    t = least(x, y) / (greatest(x, y) + _TINY)
    z = t * t
    s = t * (_A0 + z * (_A1 + z * (_A2 + z * (_A3 + z * (_A4 + z * _A5)))))
    s = choose(y > x, _QUARTER - s, s)
    s = choose(p < _F0, _HALF - s, s)
    return with_sign(s, q)
