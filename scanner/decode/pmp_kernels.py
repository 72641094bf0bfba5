"""The pass of PMP decoding over pixels: all frames of one axis to coordinates, in one go and in cache.

Frames are given by the addresses of their pixels, so that they may lie anywhere: in memory, or in the map of a file.
Work goes through the image in tiles. A tile's samples are read once; sums, phases, fringe orders and the verdict follow
while it is in the cache, in four loops over vectors of pixels (`scanner.lanes`): longer ones would wait for their own
results. What a pixel's noise is, and how the ladder of beats climbs, is decided by the caller.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.addresses import aligned_rows
from scanner.decode.pmp_sums import TILE, fit_tile
from scanner.decode.reasons import count_reasons
from scanner.kernel import contracting_kernel
from scanner.lanes import (
    LANES,
    any_of,
    choose,
    floats,
    greatest,
    load,
    magnitude,
    nearest,
    power_of_two,
    root,
    store,
    whole,
)

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
    shifts: NDArray[np.intp],
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
            g00, g11, g22, 2 g01, 2 g02, 2 g12. shifts: (K,) of sets that have all of their 4 or 8, else 0.
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
    sets, steps = gains.size, ratios.size
    # Behind the fit's rows: variance, lit sets, absolute phase, probability of a wrong order; then what the ladder
    # combines of sets: a beat for each rung, an error for each step.
    rows = aligned_rows(3 * sets + 7 + 2 * steps + 1, TILE)
    fit, rest = rows[: 3 * sets + 3], rows[3 * sets + 3 : 3 * sets + 7]
    first_beat, first_spread = 3 * sets + 7, 3 * sets + 8 + steps
    beats, terms, parts = _plan(rungs, errors, gains, first_beat, first_spread, 2 * sets)
    last = aligned_rows(5, TILE)
    last_reason = np.empty(TILE, np.uint8)
    for at in range(begin, end, TILE):
        size = min(TILE, end - at)
        blocks = -(-size // LANES) * LANES
        fit_tile(addresses, like, starts, weights, grams, shifts, at, size, at + size < end, fit)
        if _noise_of(fit, gains, noise, limits, blocks, rest[0], rest[1]):
            _combine_rungs(rows, rungs, errors, gains, beats, terms, first_beat, first_spread, blocks)
            _climb(rows.reshape(-1), beats, terms, parts, ratios, floors, scale[2], limits[4], blocks, rest)
        if blocks == size:
            _judge(
                fit, rest, finest, gains, clip, noise, scale, limits, periodic, blocks,
                position[at : at + size], sigma[at : at + size], confidence[at : at + size],
                albedo[at : at + size], modulation[at : at + size], reason[at : at + size],
            )  # fmt: skip
        else:
            _judge(
                fit, rest, finest, gains, clip, noise, scale, limits, periodic, blocks,
                last[0], last[1], last[2], last[3], last[4], last_reason,
            )  # fmt: skip
            position[at : at + size], sigma[at : at + size] = last[0, :size], last[1, :size]
            confidence[at : at + size] = last[2, :size]
            albedo[at : at + size], modulation[at : at + size] = last[3, :size], last[4, :size]
            reason[at : at + size] = last_reason[:size]
        count_reasons(reason[at : at + size], counts)


# --- the ladder as rows -----------------------------------------------------------------------------------------------


@contracting_kernel
def _plan(
    rungs: NDArray[np.float32],
    errors: NDArray[np.float32],
    gains: NDArray[np.float32],
    first_beat: int,
    first_spread: int,
    inverses: int,
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Which rows the ladder climbs by: (J,) of each rung's phase; (J - 1, 2) of each step's errors, (J - 1, 2) weights.

    A rung that is one set is that set's phase, and an error of two sets is made up of theirs; others are combined in
    rows of their own before.
    """
    steps, sets = errors.shape
    beats = np.empty(steps + 1, np.intp)
    terms = np.full((steps, 2), inverses)
    parts = np.zeros((steps, 2), np.float32)
    for j in range(steps + 1):
        single = _only(rungs[j])
        beats[j] = single if single >= 0 else first_beat + j
    for j in range(steps):
        count = 0
        for k in range(sets):
            if errors[j, k] != _F0:
                if count < 2:
                    terms[j, count] = inverses + k
                    parts[j, count] = errors[j, k] * gains[k] * _PER_TURN2
                count += 1
        if count > 2:
            terms[j, 0], parts[j, 0] = first_spread + j, _F1
            terms[j, 1], parts[j, 1] = first_spread + j, _F0
    return beats, terms, parts


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
def _combine_rungs(
    rows: NDArray[np.float32],
    rungs: NDArray[np.float32],
    errors: NDArray[np.float32],
    gains: NDArray[np.float32],
    beats: NDArray[np.intp],
    terms: NDArray[np.intp],
    first_beat: int,
    first_spread: int,
    size: int,
) -> None:
    sets = gains.size
    for j in range(beats.size):
        if beats[j] == first_beat + j:
            _combine(rows[:sets], rungs[j], size, rows[beats[j]])
    for j in range(terms.shape[0]):
        if terms[j, 0] == first_spread + j:
            _combine(rows[2 * sets : 3 * sets], errors[j] * gains * _PER_TURN2, size, rows[terms[j, 0]])


@contracting_kernel
def _combine(values: NDArray[np.float32], weights: NDArray[np.float32], size: int, total: NDArray[np.float32]) -> None:
    for i in range(0, size, LANES):
        store(total, i, floats(_F0))
    for k in range(weights.size):
        weight, row = weights[k], values[k]
        if weight != _F0:
            for i in range(0, size, LANES):
                store(total, i, load(total, i) + weight * load(row, i))


# --- fringe orders ----------------------------------------------------------------------------------------------------


@contracting_kernel
def _noise_of(
    fit: NDArray[np.float32],
    gains: NDArray[np.float32],
    noise: NDArray[np.float32],
    limits: NDArray[np.float32],
    size: int,
    variance: NDArray[np.float32],
    lit: NDArray[np.float32],
) -> bool:
    """Variance of a sample, and how many sets have enough modulation; whether any pixel has it in all of them."""
    v0, slope, least, prior, shrink = noise[0], noise[1], noise[2], noise[3], noise[4]
    sets = gains.size
    mean, residual = fit[3 * sets], fit[3 * sets + 1]
    for i in range(0, size, LANES):
        model = greatest(v0 + slope * load(mean, i), least)
        # A residual can show a pixel to be noisier than the model has it; a small one is luck more often than not.
        store(variance, i, greatest((prior * model + load(residual, i)) * shrink, model))
        store(lit, i, floats(_F0))
    min_b2 = limits[0] * limits[0]
    for k in range(sets):
        squares, min_per_variance = fit[sets + k], limits[1] * gains[k]
        for i in range(0, size, LANES):
            enough = load(squares, i) >= greatest(min_per_variance * load(variance, i), min_b2)
            store(lit, i, load(lit, i) + choose(enough, _F1, _F0))
    all_lit, most = np.float32(sets) - _HALF, floats(_F0)
    for i in range(0, size, LANES):
        most = greatest(most, load(lit, i))
    return any_of(most > all_lit)


@contracting_kernel
def _climb(
    rows: NDArray[np.float32],
    beats: NDArray[np.intp],
    terms: NDArray[np.intp],
    parts: NDArray[np.float32],
    ratios: NDArray[np.float32],
    floors: NDArray[np.float32],
    centre: np.float32,
    max_remainder2: np.float32,
    size: int,
    rest: NDArray[np.float32],
) -> None:
    """Up the ladder: the finest rung's absolute phase, and the probability that an order is wrong."""
    variances, out, wrong = rest[0], rest[2], rest[3]
    steps = ratios.size
    count = np.float32(steps)
    beats_at, terms_at = beats * TILE, terms * TILE
    for i in range(0, size, LANES):
        variance = load(variances, i)
        absolute = load(rows, beats_at[0] + i)
        absolute -= nearest(absolute - centre)
        # The step that came nearest to the neighbouring order, and by what sigma; the worst remainder.
        margin, spread, worst = floats(_HUGE), floats(_F1), floats(-_F1)
        for j in range(steps):
            own = parts[j, 0] * load(rows, terms_at[j, 0] + i) + parts[j, 1] * load(rows, terms_at[j, 1] + i)
            error2 = variance * own + floors[j]
            beat = load(rows, beats_at[j + 1] + i)
            difference = ratios[j] * absolute - beat
            order = nearest(difference)
            remainder = difference - order
            absolute = beat + order
            room = _F1 - _F2 * magnitude(remainder)
            # room / error2 < the least so far, without a division
            nearer = room * spread < margin * error2
            margin, spread = choose(nearer, room, margin), choose(nearer, error2, spread)
            worst = greatest(worst, remainder * remainder - max_remainder2 * error2)
        store(out, i, absolute)
        # Odds of the neighbouring order against the nearest, for a normal error: exp(-(1 - 2 |r|) / (2 sigma^2)).
        # The step in most danger stands for all.
        power = greatest(margin / spread * _LOG2_E_HALF, _LEAST_POWER)
        exponent = nearest(power)
        x = power - exponent
        odds = (_F1 + x * (_P1 + x * (_P2 + x * (_P3 + x * _P4)))) * power_of_two(whole(exponent))
        store(wrong, i, choose(worst > _F0, _F1, count * odds))


@contracting_kernel
def _judge(
    fit: NDArray[np.float32],
    rest: NDArray[np.float32],
    finest: int,
    gains: NDArray[np.float32],
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
    sets = gains.size
    squares, inverses = fit[sets + finest], fit[2 * sets + finest]
    means, residuals, tops = fit[3 * sets], fit[3 * sets + 1], fit[3 * sets + 2]
    variances, lits, absolutes, wrongs = rest[0], rest[1], rest[2], rest[3]
    v0, slope, least = noise[0], noise[1], noise[2]
    along, origin, fine, low = scale[0], scale[1], scale[3], scale[4] + _HALF
    freedom = max(_F1 / noise[4] - noise[3], _F1)
    max_excess, max_share, max_wrong = limits[2] * freedom, limits[3] * freedom, limits[5]
    per_cycle, per_fringe2 = _F1 / fine, (along / fine) ** 2 * gains[finest] * _PER_TURN2
    turn = _F1 if periodic else _F0
    side = limits[6] if periodic else -limits[6]
    all_lit, top = np.float32(sets) - _HALF, np.float32(clip)
    beyond = along - _HALF
    for i in range(0, size, LANES):
        # Both ends of a periodic field look alike: whole turns are taken off.
        turns = load(absolutes, i) * per_cycle
        turns -= turn * nearest(turns - low)
        value = turns * along - origin
        deviation = root((per_fringe2 * load(variances, i)) * load(inverses, i))
        wrong, lit, square = load(wrongs, i), load(lits, i), load(squares, i)
        mean, residual = load(means, i), load(residuals, i)
        edge = side * deviation - _HALF
        inside = (value > edge) & (value + edge < beyond - _HALF)
        model = greatest(v0 + slope * mean, least)
        moved = (residual > max_excess * model) & (residual > max_share * square)
        why = choose(inside, 0, 5)
        why = choose(wrong > max_wrong, 4, why)
        why = choose(lit > all_lit, why, 3)
        why = choose(lit < _HALF, 1, why)
        why = choose(moved, 7, why)
        why = choose(load(tops, i) >= top, 2, why)
        good = why < 1
        known = good | ((why > 3) & (why < 5))
        store(position, i, choose(known, value, _NAN))
        store(sigma, i, choose(known, deviation, _NAN))
        store(confidence, i, choose(good, _F1 - wrong, _F0))
        store(reason, i, why)
        store(albedo, i, mean)
        store(modulation, i, root(square))


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
