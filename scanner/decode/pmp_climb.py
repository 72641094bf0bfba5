"""Fringe orders of PMP: up the ladder of beats, from the coarsest rung to the finest, in vectors of pixels.

Each rung in proportion picks the period of the next (Huntley and Saldner 1993). How far its remainder lies from half a
period, over what noise makes of it, is the probability that the order is wrong. Which beats make up the ladder is the
business of `unwrapping`; phases and modulations come from `pmp_sums`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.kernel import contracting_kernel, inlined_kernel
from scanner.lanes import (
    LANES,
    Lanes,
    any_of,
    choose,
    floats,
    greatest,
    load,
    magnitude,
    nearest,
    power_of_two,
    store,
    whole,
)

_F0 = np.float32(0)
_F1 = np.float32(1)
_F2 = np.float32(2)
_HUGE = np.float32(1e30)
_PER_TURN2 = np.float32(1 / (2 * np.pi) ** 2)

# 2^x on [-1/2, 1/2], Taylor terms in ln 2; relative error below 5e-5.
_P1 = np.float32(np.log(2))
_P2 = np.float32(np.log(2) ** 2 / 2)
_P3 = np.float32(np.log(2) ** 3 / 6)
_P4 = np.float32(np.log(2) ** 4 / 24)
_LOG2_E_HALF = np.float32(-0.5 * np.log2(np.e))
_LEAST_POWER = np.float32(-120)

_CERTAIN = np.float32(60)
"""(1 - 2 |r|) / sigma^2 whose odds, e^-30, are nothing beside 1 in float32, for as many steps as there may be."""


@contracting_kernel
def plan_rows(
    rungs: NDArray[np.float32],
    errors: NDArray[np.float32],
    gains: NDArray[np.float32],
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Which rows the ladder climbs by: (J,) of each rung's phase; (J - 1, 2) of each step's B^2, (J - 1, 2) weights.

    A rung that is one set is that set's phase, and an error of two sets is made up of theirs; others are combined in
    rows of their own before, which lie behind those of the sets.
    """
    steps, sets = errors.shape
    first_beat, first_spread = 2 * sets, 2 * sets + steps + 1
    beats = np.empty(steps + 1, np.intp)
    terms = np.full((steps, 2), sets)
    parts = np.zeros((steps, 2), np.float32)
    for j in range(steps + 1):
        single = _only(rungs[j])
        beats[j] = single if single >= 0 else first_beat + j
    for j in range(steps):
        count = 0
        for k in range(sets):
            if errors[j, k] != _F0:
                if count < 2:
                    terms[j, count] = sets + k
                    parts[j, count] = errors[j, k] * gains[k] * _PER_TURN2
                count += 1
        if count > 2:
            terms[j, 0] = first_spread + j
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


@inlined_kernel
def combine(
    spot: NDArray[np.float32],
    rungs: NDArray[np.float32],
    errors: NDArray[np.float32],
    gains: NDArray[np.float32],
    beats: NDArray[np.intp],
    terms: NDArray[np.intp],
) -> None:
    """Write the rows that are no set's own: phases of beats, and the sum of weight / B^2 of errors of three sets."""
    sets = gains.size
    for j in range(beats.size):
        if beats[j] >= 2 * sets:
            total = floats(_F0)
            for k in range(sets):
                total += rungs[j, k] * load(spot, k * LANES)
            store(spot, beats[j] * LANES, total)
    for j in range(terms.shape[0]):
        if terms[j, 0] >= 2 * sets:
            total = floats(_F0)
            for k in range(sets):
                total += errors[j, k] * gains[k] * _PER_TURN2 / load(spot, (sets + k) * LANES)
            store(spot, terms[j, 0] * LANES, total)


@inlined_kernel
def climb(
    spot: NDArray[np.float32],
    beats: NDArray[np.intp],
    terms: NDArray[np.intp],
    parts: NDArray[np.float32],
    ratios: NDArray[np.float32],
    floors: NDArray[np.float32],
    centre: np.float32,
    max_remainder2: np.float32,
    unit: np.float32,
    sets: int,
    variance: Lanes,
) -> tuple[Lanes, Lanes]:
    """Up the ladder: the finest rung's absolute phase, and the probability that an order is wrong."""
    absolute = load(spot, beats[0] * LANES)
    absolute -= nearest(absolute - centre)
    # The step that came nearest to the neighbouring order, and by what sigma; the worst remainder.
    margin, spread, worst = floats(_HUGE), floats(_F1), floats(-_F1)
    for j in range(ratios.size):
        if terms[j, 0] < 2 * sets:
            # a / B1^2 + b / B2^2 without the divisions: all that follows is times both.
            one, two = unit * load(spot, terms[j, 0] * LANES), load(spot, terms[j, 1] * LANES)
            weight = one * two
            error2 = variance * (parts[j, 0] * unit * two + parts[j, 1] * one) + floors[j] * weight
        else:
            weight = floats(_F1)
            error2 = variance * load(spot, terms[j, 0] * LANES) + floors[j]
        beat = load(spot, beats[j + 1] * LANES)
        difference = ratios[j] * absolute - beat
        order = nearest(difference)
        remainder = difference - order
        absolute = beat + order
        room = (_F1 - _F2 * magnitude(remainder)) * weight
        excess = remainder * remainder * weight - max_remainder2 * error2
        if j == 0:
            margin, spread, worst = room, error2, excess
        else:
            # room / error2 < the least so far, without a division
            nearer = room * spread < margin * error2
            margin, spread = choose(nearer, room, margin), choose(nearer, error2, spread)
            worst = greatest(worst, excess)
    # Odds of the neighbouring order against the nearest, for a normal error: exp(-(1 - 2 |r|) / (2 sigma^2)).
    # The step in most danger stands for all.
    wrong = floats(_F0)
    if any_of(margin < _CERTAIN * spread):
        power = greatest(margin / spread * _LOG2_E_HALF, _LEAST_POWER)
        exponent = nearest(power)
        x = power - exponent
        odds = (_F1 + x * (_P1 + x * (_P2 + x * (_P3 + x * _P4)))) * power_of_two(whole(exponent))
        wrong = np.float32(ratios.size) * odds
    return absolute, choose(worst > _F0, _F1, wrong)
