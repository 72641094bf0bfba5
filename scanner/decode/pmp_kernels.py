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

from scanner.decode.addresses import aligned_rows
from scanner.decode.pmp_sums import SUMS, TILE, fit_tile
from scanner.decode.reasons import count_reasons
from scanner.kernel import contracting_kernel

_F0 = np.float32(0)
_F1 = np.float32(1)
_F2 = np.float32(2)
_HALF = np.float32(0.5)
_NAN = np.float32(np.nan)
_HUGE = np.float32(1e30)
_PER_TURN2 = np.float32(1 / (2 * np.pi) ** 2)

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
    whole: NDArray[np.intp],
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
            g00, g11, g22, 2 g01, 2 g02, 2 g12. whole: (K,) shifts of sets that have all of their 4 or 8, else 0.
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
    work = aligned_rows(3 * sets + SUMS + 10, TILE)
    phases, squares, inverses = work[:sets], work[sets : 2 * sets], work[2 * sets : 3 * sets]
    sums, danger = work[3 * sets : -10], work[-10:-7]
    mean, residual, variance, lit, absolute, beat, spread = (
        work[-7],
        work[-6],
        work[-5],
        work[-4],
        work[-3],
        work[-2],
        work[-1],
    )
    top = np.empty(TILE, like.dtype)
    for at in range(begin, end, TILE):
        size = min(TILE, end - at)
        fit_tile(
            addresses,
            like,
            starts,
            weights,
            grams,
            whole,
            at,
            size,
            sums,
            phases,
            squares,
            inverses,
            mean,
            residual,
            top,
        )
        _noise_of(mean, residual, noise, size, variance, lit, danger)
        for k in range(sets):
            # From here on `inverses` is the phase's variance, in cycles squared.
            _errors_of(squares[k], inverses[k], variance, gains[k], limits[0], limits[1], size, lit)
        _combine(phases, rungs[0], size, absolute)
        _fold(absolute, scale[2], size)
        for j in range(ratios.size):
            _spread(inverses, errors[j], floors[j], size, spread)
            single = _only(rungs[j + 1])
            if single >= 0:
                _step(absolute, phases[single], spread, ratios[j], limits[4], size, danger)
            else:
                _combine(phases, rungs[j + 1], size, beat)
                _step(absolute, beat, spread, ratios[j], limits[4], size, danger)
        _doubt(danger, ratios.size, size)
        _judge(
            absolute, squares[finest], inverses[finest], mean, residual, lit, top, danger[0],
            sets, clip, noise, scale, limits, periodic, size,
            position[at : at + size], sigma[at : at + size], confidence[at : at + size],
            albedo[at : at + size], modulation[at : at + size], reason[at : at + size],
        )  # fmt: skip
        count_reasons(reason[at : at + size], counts)


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
        danger[0, i] = _HUGE
        danger[1, i] = _F1
        danger[2, i] = -_F1


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
    """Variance of a step's remainder: of two sets, as between single sets, in one loop; any more are added."""
    first, second = -1, -1
    for k in range(errors.size):
        if errors[k] != _F0 and first < 0:
            first = k
        elif errors[k] != _F0 and second < 0:
            second = k
    one, weight = cycles2[first], errors[first]
    two, other = cycles2[max(second, first)], errors[second] if second >= 0 else _F0
    for i in range(size):
        spread[i] = floor + weight * one[i] + other * two[i]
    for k in range(max(second, first) + 1, errors.size):
        if errors[k] != _F0:
            weight, one = errors[k], cycles2[k]
            for i in range(size):
                spread[i] += weight * one[i]


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
        nearer = margin * danger[1, i] < danger[0, i] * variance
        danger[0, i] = margin if nearer else danger[0, i]
        danger[1, i] = variance if nearer else danger[1, i]
        danger[2, i] = max(danger[2, i], remainder * remainder - max_remainder2 * variance)
        absolute[i] = beat[i] + order


@contracting_kernel
def _only(rung: NDArray[np.float32]) -> int:
    """The set that is this rung all by itself; -1 where it is a combination."""
    only = -1
    for k in range(rung.size):
        if rung[k] != _F0:
            if rung[k] != _F1 or only >= 0:
                return -1
            only = k
    return only


@contracting_kernel
def _doubt(danger: NDArray[np.float32], steps: int, size: int) -> None:
    """Probability that an order is wrong, into danger[0]."""
    count = np.float32(steps)
    for i in range(size):
        # Odds of the neighbouring order against the nearest, for a normal error: exp(-(1 - 2 |r|) / (2 sigma^2)).
        # The step in most danger stands for all.
        power = max(danger[0, i] / danger[1, i] * _LOG2_E_HALF, _LEAST_POWER)
        exponent = np.rint(power)
        x = power - exponent
        odds = _F1 + x * (_P1 + x * (_P2 + x * (_P3 + x * _P4)))
        odds *= np.int32((np.int32(exponent) + np.int32(127)) << np.int32(23)).view(np.float32)
        danger[0, i] = _F1 if danger[2, i] > _F0 else count * odds


@contracting_kernel
def _judge(
    absolute: NDArray[np.float32],
    finest2: NDArray[np.float32],
    finest_error2: NDArray[np.float32],
    mean: NDArray[np.float32],
    residual: NDArray[np.float32],
    lit: NDArray[np.float32],
    top: NDArray[Any],
    wrong: NDArray[np.float32],
    sets: int,
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
    per_fringe, per_cycle = along / fine, _F1 / fine
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
        why = np.int32(0) if inside else np.int32(5)
        why = np.int32(4) if wrong[i] > max_wrong else why
        why = np.int32(3) if lit[i] < all_lit else why
        why = np.int32(1) if lit[i] < _HALF else why
        why = np.int32(7) if moved else why
        why = np.int32(2) if top[i] >= clip else why
        good = why == np.int32(0)
        known = good | (why == np.int32(4))
        position[i] = value if known else _NAN
        sigma[i] = deviation if known else _NAN
        confidence[i] = _F1 - wrong[i] if good else _F0
        reason[i] = np.uint8(why)
    for i in range(size):
        albedo[i] = mean[i]
        modulation[i] = np.sqrt(finest2[i])


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
        count_reasons(reason[begin:end], counts)
