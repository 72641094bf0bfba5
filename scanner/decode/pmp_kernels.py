"""The pass of PMP decoding over pixels: all frames of one axis to coordinates, in one go and in cache.

Frames are given by the addresses of their pixels, so that they may lie anywhere: in memory, or in the map of a file.
Work goes through the image in tiles. A tile's samples are read once, four frames at a time; sums, phases, fringe
orders and the verdict follow while it is in the cache, in loops over few arrays that the compiler turns into vector
instructions. What a pixel's noise is, and how the ladder of beats climbs, is decided by the caller.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.addresses import expect_pixels, pixels_at
from scanner.kernel import contracting_kernel

TILE = 2048
"""Pixels a tile: its working arrays, some thirty float32 rows, fit the second-level cache beside 24 frames' worth."""

GROUP = 4
"""Frames read together. Sets are padded to whole groups with frames of weight 0."""

REASONS = 9
"""Members of `scanner.decode.Reason`."""

ARCTAN_ERROR_CYCLES = 3.5e-7
"""Largest error of `_turns`: a thirtieth of what rounding to 16 bits leaves of a fringe that fills the range, and below
the last bit of a float32 coordinate for up to 100 fringes."""

_F0 = np.float32(0)
_F1 = np.float32(1)
_F2 = np.float32(2)
_HALF = np.float32(0.5)
_QUARTER = np.float32(0.25)
_NAN = np.float32(np.nan)
_TINY = np.float32(1e-12)
_HUGE = np.float32(1e30)
_PER_TURN2 = np.float32(1 / (2 * np.pi) ** 2)

# atan(x) / (2 pi x) in x^2 on [0, 1]: least-maximum fit of six terms, error of atan(x) / 2 pi below 3e-7.
_A0 = np.float32(0.1591513175)
_A1 = np.float32(-0.0529385695)
_A2 = np.float32(0.0308029203)
_A3 = np.float32(-0.0185298779)
_A4 = np.float32(0.0083791126)
_A5 = np.float32(-0.0018651675)

# 2^x on [-1/2, 1/2], Taylor terms in ln 2; relative error below 5e-5.
_P1 = np.float32(np.log(2))
_P2 = np.float32(np.log(2) ** 2 / 2)
_P3 = np.float32(np.log(2) ** 3 / 6)
_P4 = np.float32(np.log(2) ** 4 / 24)
_LOG2_E_HALF = np.float32(-0.5 * np.log2(np.e))
_LEAST_POWER = np.float32(-120)


@contracting_kernel
def decode_pixels(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    starts: NDArray[np.intp],
    weights: NDArray[np.float32],
    grams: NDArray[np.float32],
    clip: int,
    gains: NDArray[np.float32],
    rungs: NDArray[np.float32],
    ratios: NDArray[np.float32],
    errors: NDArray[np.float32],
    floors: NDArray[np.float32],
    noise: NDArray[np.float32],
    scale: NDArray[np.float32],
    limits: NDArray[np.float32],
    periodic: bool,
    finest: int,
    begin: int,
    end: int,
    position: NDArray[np.float32],
    sigma: NDArray[np.float32],
    confidence: NDArray[np.float32],
    albedo: NDArray[np.float32],
    modulation: NDArray[np.float32],
    reason: NDArray[np.uint8],
    counts: NDArray[np.int64],
) -> None:
    """Decode pixels begin .. end - 1 of one axis.

    Pixels at risk of a wrong order keep a tentative coordinate, for `neighbours.settle`.

    Args:
        addresses: (F,) of the frames' first pixels, sets one after another, each padded to a multiple of GROUP with
            its first frame. like: (0,) array of the frames' dtype, uint8 or uint16.
        starts: (K + 1,) where each set begins in `addresses`. weights: (3, F) float32, least-squares weights of A, p, q
            in I_n = A + p cos(alpha_n) - q sin(alpha_n); 0 for padding. grams: (K, 6) float32, of the normal matrix
            g00, g11, g22, 2 g01, 2 g02, 2 g12.
        clip: grey level from which a sample counts as saturated.
        gains: (K,) float32, variance of (p, q) over that of one sample.
        rungs: (J, K) float32 combinations. ratios: (J - 1,). errors: (J - 1, K): squared error weights.
        floors: (J - 1,) float32, variance of the remainder that no averaging removes.
        noise: [variance at A = 0, variance per grey level, least variance, prior's weight, 1 / (weight + freedom)].
        scale: [pixels along the axis, origin, coarsest rung's phase at the field's centre, finest frequency, first
            pixel's edge as a fraction of the field].
        limits: [modulation, modulation over its noise squared, residual variance over noise variance, residual
            variance over B^2, remainder over its sigma squared, wrong-order probability, edge in sigmas].
        periodic: both ends of the field look alike. finest: index of the finest set.
        position, sigma, confidence, albedo, modulation: (P,) float32, written. reason: (P,) uint8, written.
        counts: (REASONS,) int64, how many pixels have each reason, is added to.
    """
    sets = gains.size
    sums = np.empty(5 * TILE, np.float32)
    phases = np.empty((sets, TILE), np.float32)
    squares = np.empty((sets, TILE), np.float32)
    inverses = np.empty((sets, TILE), np.float32)
    mean = np.empty(TILE, np.float32)
    residual = np.empty(TILE, np.float32)
    top = np.empty(TILE, like.dtype)
    variance = np.empty(TILE, np.float32)
    lit = np.empty(TILE, np.float32)
    absolute = np.empty(TILE, np.float32)
    beat = np.empty(TILE, np.float32)
    spread = np.empty(TILE, np.float32)
    danger = np.empty(3 * TILE, np.float32)
    for at in range(begin, end, TILE):
        size = min(TILE, end - at)
        _fit_tile(
            addresses, like, starts, weights, grams, at, size, sums, phases, squares, inverses, mean, residual, top
        )
        _noise_of(mean, residual, noise, size, variance, lit, danger)
        for k in range(sets):
            # From here on `inverses` is the phase's variance, in cycles squared.
            _errors_of(squares[k], inverses[k], variance, gains[k], limits[0], limits[1], size, lit)
        _combine(phases, rungs[0], size, absolute)
        _fold(absolute, scale[2], size)
        for j in range(ratios.size):
            _spread(inverses, errors[j], floors[j], size, spread)
            _combine(phases, rungs[j + 1], size, beat)
            _step(absolute, beat, spread, ratios[j], limits[4], size, danger)
        _judge(
            absolute, squares[finest], inverses[finest], mean, residual, lit, top, danger,
            sets, ratios.size, clip, noise, scale, limits, periodic, size,
            position[at : at + size], sigma[at : at + size], confidence[at : at + size],
            albedo[at : at + size], modulation[at : at + size], reason[at : at + size],
        )  # fmt: skip
        _count(reason[at : at + size], counts)


@contracting_kernel
def fit_runs(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    starts: NDArray[np.intp],
    weights: NDArray[np.float32],
    grams: NDArray[np.float32],
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
        addresses, like, starts, weights, grams, clip: see `decode_pixels`.
        runs: (R,) first pixel of each run.
        phases, modulations: (K, R x length) float32, written: cycles in -.5 .. .5, grey levels.
        mean, residual: (R x length,) float32, written: A, mean of the sets; squared residuals, sum of the sets.
        clipped: (R x length,) bool, written.
    """
    sets = starts.size - 1
    sums = np.empty(5 * TILE, np.float32)
    tile_phases = np.empty((sets, TILE), np.float32)
    squares = np.empty((sets, TILE), np.float32)
    inverses = np.empty((sets, TILE), np.float32)
    tile_mean = np.empty(TILE, np.float32)
    tile_residual = np.empty(TILE, np.float32)
    top = np.empty(TILE, like.dtype)
    for r in range(runs.size):
        _fit_tile(
            addresses, like, starts, weights, grams, runs[r], length,
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


# --- sums and phases --------------------------------------------------------------------------------------------------


@contracting_kernel
def _fit_tile(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    starts: NDArray[np.intp],
    weights: NDArray[np.float32],
    grams: NDArray[np.float32],
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
        for n in range(starts[k], starts[k + 1], GROUP):
            one = pixels_at(addresses[n], at, size, like)
            two = pixels_at(addresses[n + 1], at, size, like)
            three = pixels_at(addresses[n + 2], at, size, like)
            four = pixels_at(addresses[n + 3], at, size, like)
            for m in range(n, n + GROUP):
                expect_pixels(addresses[m], at + size, size, like)
            if n == starts[k]:
                _begin(one, two, three, four, weights[:, n : n + GROUP], size, sums)
            else:
                _add(one, two, three, four, weights[:, n : n + GROUP], size, sums)
            _brightest(one, two, three, four, size, top)
        _phase(sums, grams[k], size, phases[k], squares[k], inverses[k], mean, residual)
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
        sums[i] = first
        sums[TILE + i] = a2 * d2 + a3 * d3 + a4 * d4
        sums[2 * TILE + i] = p2 * d2 + p3 * d3 + p4 * d4
        sums[3 * TILE + i] = q2 * d2 + q3 * d3 + q4 * d4
        sums[4 * TILE + i] = d2 * d2 + d3 * d3 + d4 * d4


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
        first = sums[i]
        d1 = np.float32(one[i]) - first
        d2 = np.float32(two[i]) - first
        d3 = np.float32(three[i]) - first
        d4 = np.float32(four[i]) - first
        sums[TILE + i] += a1 * d1 + a2 * d2 + a3 * d3 + a4 * d4
        sums[2 * TILE + i] += p1 * d1 + p2 * d2 + p3 * d3 + p4 * d4
        sums[3 * TILE + i] += q1 * d1 + q2 * d2 + q3 * d3 + q4 * d4
        sums[4 * TILE + i] += d1 * d1 + d2 * d2 + d3 * d3 + d4 * d4


@contracting_kernel
def _brightest(
    one: NDArray[Any], two: NDArray[Any], three: NDArray[Any], four: NDArray[Any], size: int, top: NDArray[Any]
) -> None:
    for i in range(size):
        top[i] = max(top[i], one[i], two[i], three[i], four[i])


@contracting_kernel
def _phase(
    sums: NDArray[np.float32],
    gram: NDArray[np.float32],
    size: int,
    phases: NDArray[np.float32],
    squares: NDArray[np.float32],
    inverses: NDArray[np.float32],
    mean: NDArray[np.float32],
    residual: NDArray[np.float32],
) -> None:
    g00, g11, g22, g01, g02, g12 = gram[0], gram[1], gram[2], gram[3], gram[4], gram[5]
    for i in range(size):
        a = sums[TILE + i]
        p = sums[2 * TILE + i]
        q = sums[3 * TILE + i]
        explained = a * (g00 * a + g01 * p + g02 * q) + p * (g11 * p + g12 * q) + g22 * q * q
        residual[i] += max(sums[4 * TILE + i] - explained, _F0)
        mean[i] += sums[i] + a
        # atan2 in cycles without a branch: the smaller over the larger, then the octant put back. One division gives
        # both the quotient and 1 / B^2.
        ap, aq = abs(p), abs(q)
        large = max(ap, aq) + _TINY
        b2 = p * p + q * q + _TINY
        both = _F1 / (large * b2)
        t = min(ap, aq) * (both * b2)
        z = t * t
        s = t * (_A0 + z * (_A1 + z * (_A2 + z * (_A3 + z * (_A4 + z * _A5)))))
        s = _QUARTER - s if aq > ap else s
        s = _HALF - s if p < _F0 else s
        phases[i] = -s if q < _F0 else s
        squares[i] = b2
        inverses[i] = both * large


# --- fringe orders ----------------------------------------------------------------------------------------------------


@contracting_kernel
def _noise_of(
    mean: NDArray[np.float32],
    residual: NDArray[np.float32],
    noise: NDArray[np.float32],
    size: int,
    variance: NDArray[np.float32],
    lit: NDArray[np.float32],
    danger: NDArray[np.float32],
) -> None:
    v0, slope, least, prior, shrink = noise[0], noise[1], noise[2], noise[3], noise[4]
    for i in range(size):
        model = max(v0 + slope * mean[i], least)
        # A residual can show a pixel to be noisier than the model has it; a small one is luck more often than not.
        variance[i] = max((prior * model + residual[i]) * shrink, model)
        lit[i] = _F0
        danger[i] = _HUGE
        danger[TILE + i] = _F1
        danger[2 * TILE + i] = -_F1


@contracting_kernel
def _errors_of(
    squares: NDArray[np.float32],
    inverses: NDArray[np.float32],
    variance: NDArray[np.float32],
    gain: np.float32,
    min_b: np.float32,
    min_snr2: np.float32,
    size: int,
    lit: NDArray[np.float32],
) -> None:
    min_b2, per_b2 = min_b * min_b, gain * _PER_TURN2
    for i in range(size):
        noise_b2 = gain * variance[i]
        lit[i] += _F1 if squares[i] >= max(min_b2, min_snr2 * noise_b2) else _F0
        inverses[i] *= per_b2 * variance[i]


@contracting_kernel
def _fold(absolute: NDArray[np.float32], centre: np.float32, size: int) -> None:
    for i in range(size):
        absolute[i] -= np.rint(absolute[i] - centre)


@contracting_kernel
def _combine(phases: NDArray[np.float32], rung: NDArray[np.float32], size: int, total: NDArray[np.float32]) -> None:
    first = True
    for k in range(rung.size):
        weight = rung[k]
        if weight != _F0:
            phase = phases[k]
            if first:
                for i in range(size):
                    total[i] = weight * phase[i]
            else:
                for i in range(size):
                    total[i] += weight * phase[i]
            first = False


@contracting_kernel
def _spread(
    cycles2: NDArray[np.float32],
    errors: NDArray[np.float32],
    floor: np.float32,
    size: int,
    spread: NDArray[np.float32],
) -> None:
    """Variance of a step's remainder."""
    first = True
    for k in range(errors.size):
        weight = errors[k]
        if weight != _F0:
            error = cycles2[k]
            if first:
                for i in range(size):
                    spread[i] = floor + weight * error[i]
            else:
                for i in range(size):
                    spread[i] += weight * error[i]
            first = False


@contracting_kernel
def _step(
    absolute: NDArray[np.float32],
    beat: NDArray[np.float32],
    spread: NDArray[np.float32],
    ratio: np.float32,
    max_remainder2: np.float32,
    size: int,
    danger: NDArray[np.float32],
) -> None:
    """One rung up. `danger` remembers the step that was nearest to the neighbouring order, and the worst remainder."""
    for i in range(size):
        difference = ratio * absolute[i] - beat[i]
        order = np.rint(difference)
        remainder = difference - order
        variance = spread[i]
        margin = _F1 - _F2 * abs(remainder)
        # margin / variance < the least so far, without a division
        nearer = margin * danger[TILE + i] < danger[i] * variance
        danger[i] = margin if nearer else danger[i]
        danger[TILE + i] = variance if nearer else danger[TILE + i]
        danger[2 * TILE + i] = max(danger[2 * TILE + i], remainder * remainder - max_remainder2 * variance)
        absolute[i] = beat[i] + order


@contracting_kernel
def _judge(
    absolute: NDArray[np.float32],
    finest2: NDArray[np.float32],
    finest_error2: NDArray[np.float32],
    mean: NDArray[np.float32],
    residual: NDArray[np.float32],
    lit: NDArray[np.float32],
    top: NDArray[Any],
    danger: NDArray[np.float32],
    sets: int,
    steps: int,
    clip: int,
    noise: NDArray[np.float32],
    scale: NDArray[np.float32],
    limits: NDArray[np.float32],
    periodic: bool,
    size: int,
    position: NDArray[np.float32],
    sigma: NDArray[np.float32],
    confidence: NDArray[np.float32],
    albedo: NDArray[np.float32],
    modulation: NDArray[np.float32],
    reason: NDArray[np.uint8],
) -> None:
    """Coordinate, sigma, confidence and reason of every pixel of a tile."""
    v0, slope, least, prior, shrink = noise[0], noise[1], noise[2], noise[3], noise[4]
    along, origin, fine, low = scale[0], scale[1], scale[3], scale[4]
    max_excess, max_share, max_wrong, edge = limits[2], limits[3], limits[5], limits[6]
    freedom = max(_F1 / shrink - prior, _F1)
    max_excess *= freedom
    max_share *= freedom
    per_fringe, per_cycle, count = along / fine, _F1 / fine, np.float32(steps)
    whole = _F1 if periodic else _F0
    side = edge if periodic else -edge
    all_lit = np.float32(sets) - _HALF
    for i in range(size):
        # Both ends of a periodic field look alike: whole turns are taken off.
        turns = absolute[i] * per_cycle
        turns -= whole * np.rint(turns - low - _HALF)
        value = turns * along - origin
        deviation = per_fringe * np.sqrt(finest_error2[i])
        margin = side * deviation
        inside = (value > margin - _HALF) & (value < along - _HALF - margin)
        model = max(v0 + slope * mean[i], least)
        moved = (residual[i] > max_excess * model) & (residual[i] > max_share * finest2[i])
        # Odds of the neighbouring order against the nearest, for a normal error: exp(-(1 - 2 |r|) / (2 sigma^2)).
        # The step in most danger stands for all.
        power = max(danger[i] / danger[TILE + i] * _LOG2_E_HALF, _LEAST_POWER)
        exponent = np.rint(power)
        x = power - exponent
        odds = _F1 + x * (_P1 + x * (_P2 + x * (_P3 + x * _P4)))
        odds *= np.int32((np.int32(exponent) + np.int32(127)) << np.int32(23)).view(np.float32)
        wrong = count * odds
        risk = (wrong > max_wrong) | (danger[2 * TILE + i] > _F0)
        why = np.int32(0) if inside else np.int32(5)
        why = np.int32(4) if risk else why
        why = np.int32(3) if lit[i] < all_lit else why
        why = np.int32(1) if lit[i] < _HALF else why
        why = np.int32(7) if moved else why
        why = np.int32(2) if top[i] >= clip else why
        good = why == np.int32(0)
        known = good | (why == np.int32(4))
        position[i] = value if known else _NAN
        sigma[i] = deviation if known else _NAN
        confidence[i] = _F1 - wrong if good else _F0
        albedo[i] = mean[i]
        modulation[i] = np.sqrt(finest2[i])
        reason[i] = np.uint8(why)


@contracting_kernel
def _count(reason: NDArray[np.uint8], counts: NDArray[np.int64]) -> None:
    values = _how_many(reason, 0)
    counts[0] += values
    if values < reason.size:
        for why in range(1, REASONS):
            counts[why] += _how_many(reason, why)


@contracting_kernel
def _how_many(reason: NDArray[np.uint8], why: int) -> int:
    # A tile's worth fits 16 bits; narrow counters are what makes this a few vector instructions.
    found, wanted = np.uint16(0), np.uint8(why)
    for i in range(reason.size):
        found = np.uint16(found + np.uint16(reason[i] == wanted))
    return int(found)


# --- two axes ---------------------------------------------------------------------------------------------------------


@contracting_kernel
def join_maps(
    position: NDArray[np.float32],
    sigma: NDArray[np.float32],
    confidence: NDArray[np.float32],
    albedo: NDArray[np.float32],
    modulation: NDArray[np.float32],
    reason: NDArray[np.uint8],
    other_position: NDArray[np.float32],
    other_sigma: NDArray[np.float32],
    other_confidence: NDArray[np.float32],
    other_albedo: NDArray[np.float32],
    other_modulation: NDArray[np.float32],
    other_reason: NDArray[np.uint8],
    counts: NDArray[np.int64],
) -> None:
    """A pixel is decided when both its coordinates are. All (P,); the first six become those of both axes.

    Args:
        counts: (REASONS,) int64, how many pixels have each reason, is added to.
    """
    for begin in range(0, reason.size, TILE):
        end = min(begin + TILE, reason.size)
        for i in range(begin, end):
            why = reason[i] if reason[i] != 0 else other_reason[i]
            reason[i] = why
            confidence[i] *= other_confidence[i]
            albedo[i] = _HALF * (albedo[i] + other_albedo[i])
            modulation[i] = min(modulation[i], other_modulation[i])
        for i in range(begin, end):
            good = reason[i] == 0
            position[i] = position[i] if good else _NAN
            sigma[i] = sigma[i] if good else _NAN
            other_position[i] = other_position[i] if good else _NAN
            other_sigma[i] = other_sigma[i] if good else _NAN
        _count(reason[begin:end], counts)
