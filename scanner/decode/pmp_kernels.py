"""The pass of PMP decoding over pixels: all frames of one axis to coordinates, in one go and in registers.

Frames are given by the addresses of their pixels, so that they may lie anywhere: in memory, or in the map of a file.
Work goes through the image by vectors of pixels (`scanner.lanes`). A vector's samples are read once; sums, phases,
fringe orders and the verdict follow, and only phases and modulations go through memory in between, a few cache lines.
What no pixel of a vector needs is left out: a way up the ladder where nothing is lit, an exponential where no order is
in doubt. What a pixel's noise is, and how the ladder of beats climbs, is decided by the caller. Sums are those of
`pmp_sums`, orders those of `pmp_climb`; the noise of a phase follows from that of its samples (Surrel 1997).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.addresses import CACHE_LINE, aligned_rows, copies_of, keep
from scanner.decode.pmp_climb import climb, combine, plan_rows
from scanner.decode.pmp_sums import fit_lanes, turns_of
from scanner.decode.reasons import count_reasons
from scanner.kernel import contracting_kernel, inlined_kernel
from scanner.lane_memory import align_stack, stream
from scanner.lanes import (
    LANES,
    Lanes,
    all_of,
    any_of,
    choose,
    expect,
    floats,
    greatest,
    least,
    load,
    lowest,
    magnitude,
    nearest,
    root,
    store,
    whole,
)

_F0 = np.float32(0)
_F1 = np.float32(1)
_HALF = np.float32(0.5)
_NAN = np.float32(np.nan)
_HUGE = np.float32(np.inf)
_PER_TURN2 = np.float32(1 / (2 * np.pi) ** 2)

AHEAD = 1024
"""Pixels between the one that is worked on and the one that is asked for: 2 us, several times what memory takes."""

STRETCH = 16384
"""Pixels whose reasons are counted together."""

ROOM_STRETCH = 1024
"""Pixels that share one distance from each end of the field; strips that threads share begin at multiples of it."""


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
    rooms: NDArray[np.float32],
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
            variance over B^2, remainder over its sigma squared, wrong-order probability, edge in sigmas, distance
            from an end of the field within which it is told].
        periodic: both ends of the field look alike. finest: index of the finest set.
        position, sigma, confidence, albedo, modulation: (P,) float32, written; sigma, albedo and modulation may be
            empty, and are left out then. reason: (P,) uint8, written.
        rooms: (2, ceil(P / ROOM_STRETCH)) float32, lowered: projector px from the field's first and last end to the
            nearest pixel of a stretch that has a coordinate, where any is as near as the last of `limits`.
        counts: (REASONS,) int64, how many pixels have each reason, is added to.
    """
    align_stack()
    sets, steps = gains.size, ratios.size
    # Behind phases and B^2 by set: what the ladder combines of sets, a beat for each rung, a spread for each step.
    spot = aligned_rows(2 * sets + 2 * steps + 1, LANES).reshape(-1)
    beats, terms, parts = plan_rows(rungs, errors, gains)
    even = gains.min() == gains.max()
    combined = beats.max() >= 2 * sets or (steps > 0 and terms[:, 0].max() >= 2 * sets)
    turns = turns_of(starts, weights, shifts)
    unit = _F1 / np.float32(clip) ** 2
    per_cycle, turn = scale[0] / scale[3], _F1 / scale[3]
    widest = max((abs(limits[6]) * per_cycle) * np.sqrt(_PER_TURN2 / limits[1]), limits[7])
    freedom = max(_F1 / noise[4] - noise[3], _F1)
    line = CACHE_LINE // like.itemsize
    maps = position.ctypes.data | confidence.ctypes.data | sigma.ctypes.data
    aligned = (maps | albedo.ctypes.data | modulation.ctypes.data | (4 * begin)) % CACHE_LINE == 0
    solid = begin + (end - begin) // LANES * LANES
    for at in range(begin, solid, LANES):
        if at & (line - 1) == 0:
            for n in range(addresses.size):
                expect(addresses, n, at + AHEAD, like)
        _decode_lanes(
            addresses, like, starts, weights, grams, shifts, turns, clip, gains, rungs, ratios, errors, floors, noise,
            scale, limits, periodic, finest, beats, terms, parts, combined, unit,
            per_cycle, turn, widest, freedom, even, spot, at, at, aligned,
            position, sigma, confidence, albedo, modulation, reason, rooms,
        )  # fmt: skip
    if solid < end:
        # What is left goes into vectors of its own: nothing may be read beyond a frame's last pixel.
        size, spare, last_reason = end - solid, np.zeros((addresses.size, LANES), like.dtype), np.empty(LANES, np.uint8)
        copies, last = copies_of(addresses, solid, size, like, spare), aligned_rows(5, LANES)
        _decode_lanes(
            copies, like, starts, weights, grams, shifts, turns, clip, gains, rungs, ratios, errors, floors, noise,
            scale, limits, periodic, finest, beats, terms, parts, combined, unit,
            per_cycle, turn, widest, freedom, even, spot, solid, 0, False,
            last[0], last[1], last[2], last[3], last[4], last_reason, rooms,
        )  # fmt: skip
        keep(spare)
        position[solid:end], confidence[solid:end] = last[0, :size], last[2, :size]
        reason[solid:end] = last_reason[:size]
        if sigma.size > 0:
            sigma[solid:end] = last[1, :size]
            albedo[solid:end], modulation[solid:end] = last[3, :size], last[4, :size]
    for at in range(begin, end, STRETCH):
        count_reasons(reason[at : min(at + STRETCH, end)], counts)


@inlined_kernel
def _decode_lanes(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    starts: NDArray[np.intp],
    weights: NDArray[np.float32],
    grams: NDArray[np.float32],
    shifts: NDArray[np.intp],
    turns: NDArray[np.float32],
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
    beats: NDArray[np.intp],
    terms: NDArray[np.intp],
    parts: NDArray[np.float32],
    combined: bool,
    unit: np.float32,
    per_cycle: np.float32,
    turn: np.float32,
    widest: np.float32,
    freedom: np.float32,
    even: bool,
    spot: NDArray[np.float32],
    at: int,
    to: int,
    past_caches: bool,
    position: NDArray[np.float32],
    sigma: NDArray[np.float32],
    confidence: NDArray[np.float32],
    albedo: NDArray[np.float32],
    modulation: NDArray[np.float32],
    reason: NDArray[np.uint8],
    rooms: NDArray[np.float32],
) -> None:
    """Decode LANES pixels from `at` on, into the maps from `to` on."""
    sets = gains.size
    v0, slope, least_variance, prior, shrink = noise[0], noise[1], noise[2], noise[3], noise[4]
    mean, residual, weakest, clear = fit_lanes(addresses, like, starts, weights, grams, shifts, turns, clip, at, spot)
    model = greatest(v0 + slope * mean, least_variance)
    # A residual can show a pixel to be noisier than the model has it; a small one is luck more often than not.
    variance = greatest((prior * model + residual) * shrink, model)
    lit = _lit(spot, gains, even, weakest, limits[0] * limits[0], limits[1], variance)
    absolute, wrong = floats(_F0), floats(_F1)
    if any_of(lit):
        if combined:
            combine(spot, rungs, errors, gains, beats, terms)
        absolute, wrong = climb(spot, beats, terms, parts, ratios, floors, scale[2], limits[4], unit, sets, variance)
    along, origin, low = scale[0], scale[1], scale[4] + _HALF
    cycles = absolute * turn
    if periodic:
        # Both ends of a periodic field look alike: whole turns are taken off.
        cycles -= nearest(cycles - low)
    value = cycles * along - origin
    square = load(spot, (sets + finest) * LANES)
    spread = (per_cycle**2 * gains[finest] * _PER_TURN2) * variance
    # Farther from both ends than so many sigmas, without a root: squares that keep their sign.
    edge = limits[6] if periodic else -limits[6]
    first, last = value + _HALF, (along - _HALF) - value
    room = least(first, last)
    # What is lit has a sigma of no more than this; nearly all pixels are farther from the ends than by that.
    inside = room > widest
    far = all_of(inside)
    if not far:
        inside = (room * magnitude(room)) * square > (edge * abs(edge)) * spread
    still = residual <= greatest((limits[2] * freedom) * model, (limits[3] * freedom) * square)
    good = inside & lit & still & (wrong <= limits[5]) & clear
    known, why = good, whole(0)
    if not all_of(good):
        why = choose(inside, 0, 5)
        why = choose(wrong <= limits[5], why, 4)
        why = choose(lit, why, 3)
        why = choose(_some_lit(spot, gains, limits[0] * limits[0], limits[1], variance), why, 1)
        why = choose(still, why, 7)
        why = choose(clear, why, 2)
        known = good | ((why > 3) & (why < 5))
        value, wrong = choose(known, value, _NAN), choose(good, wrong, _F1)
    if not far:
        stretch = at // ROOM_STRETCH
        rooms[0, stretch] = min(rooms[0, stretch], lowest(choose(known, first, _HUGE)))
        rooms[1, stretch] = min(rooms[1, stretch], lowest(choose(known, last, _HUGE)))
    _put(position, to, value, past_caches)
    _put(confidence, to, _F1 - wrong, past_caches)
    store(reason, to, why)
    if sigma.size > 0:
        _put(sigma, to, choose(known, root(spread / square), _NAN), past_caches)
        _put(albedo, to, mean, past_caches)
        _put(modulation, to, root(square), past_caches)


@inlined_kernel
def _put(row: NDArray[np.float32], to: int, value: Lanes, past_caches: bool) -> None:
    # What is written to memory without being read from it before leaves that to the frames.
    if past_caches:
        stream(row, to, value)
    else:
        store(row, to, value)


@inlined_kernel
def _lit(
    spot: NDArray[np.float32],
    gains: NDArray[np.float32],
    even: bool,
    weakest: Lanes,
    min_b2: np.float32,
    min_sigmas2: np.float32,
    variance: Lanes,
) -> Lanes:
    """Where all sets have enough modulation: the weakest, where their gains are the same."""
    if even:
        return weakest >= greatest(min_sigmas2 * gains[0] * variance, min_b2)
    lit = _enough(spot, gains, 0, min_b2, min_sigmas2, variance)
    for k in range(1, gains.size):
        lit = lit & _enough(spot, gains, k, min_b2, min_sigmas2, variance)
    return lit


@inlined_kernel
def _some_lit(
    spot: NDArray[np.float32], gains: NDArray[np.float32], min_b2: np.float32, min_sigmas2: np.float32, variance: Lanes
) -> Lanes:
    """Where any set has."""
    some = _enough(spot, gains, 0, min_b2, min_sigmas2, variance)
    for k in range(1, gains.size):
        some = some | _enough(spot, gains, k, min_b2, min_sigmas2, variance)
    return some


@inlined_kernel
def _enough(
    spot: NDArray[np.float32],
    gains: NDArray[np.float32],
    k: int,
    min_b2: np.float32,
    min_sigmas2: np.float32,
    variance: Lanes,
) -> Lanes:
    return load(spot, (gains.size + k) * LANES) >= greatest(min_sigmas2 * gains[k] * variance, min_b2)
