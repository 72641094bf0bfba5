"""Witnesses of whole fringe sets: the remainder between neighbouring frequencies, and the order bars.

A set that was rotated or reversed as a whole fits its sinusoid as well as before. What it does not fit is the other
sets, unless all turned alike and their frequencies hide it; then the order bars speak, which hold one absolute
position however few shifts there are. Neither can say which frame of a set is wrong: they name sets.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from scanner.decode.unwrapping import Ladder, plan_ladder
from scanner.errors import DecodeError
from scanner.patterns import PmpPattern
from scanner.patterns.description import Axis
from scanner.patterns.sequence import BAR_COUNT, bar_light
from scanner.sequencer.findings import Array, Scene, Witness, middle
from scanner.sequencer.fringe_fit import MIN_PIXELS, Fit, mean_vector

LEAST_OFFSET = 0.05
"""Mean remainder, in fringes, that is allowed in any case: interreflections and slow drift of the lamp."""

MOST_OF_ENDS = 5.0
"""Fringes, over how much of the field a set must be seen, or over half of it if that is less. Blur that takes a set
(a sigma of .6 fringes leaves .1 % of it) still leaves light that swings at both ends of the field, where a fringe has
no neighbour: strips of two sigmas, 2.4 fringes together, whose phases are anything; twice that where a part is seen."""

HYPOTHESIS_GAIN = 0.35
"""A turned set is believed when it makes the remainders agree by so much better (mean cosine)."""

MIN_BARS_AGREEMENT = 0.75
"""Of pixels with the order bars: in step all but edges agree, any other order agrees in 15 of 31."""

BARS_GAIN = 0.15
"""Another place is believed when so many more pixels agree with the bars there."""

NEARBY = 1.25
"""Bars: the response of an uncorrected gamma 2.2 bends positions from three shifts of a unit frequency so far."""

MIN_SCALED_AGREEMENT, SCALE_GAIN = 0.9, 0.08
"""Positions of another size are believed when so many pixels agree with the bars then, and so many more than as they
are: frequencies described 3 % wrong cost a tenth of the agreement."""

SCALES = np.exp(np.arange(-0.7, 0.701, 0.01))
"""From half to twice the size; those within .015 of 1 are no other"""

SHIFTS = np.arange(-2.5, 2.51, 0.05)
"""Bars by which all positions may be moved: what is farther off is told by `BARS_GAIN`"""

LEAST_SHIFT, SHIFT_GAIN = 0.075, 0.04
"""Bars, and how much more must agree then (a tenth of a bar costs .05). In sound captures no shift wins .005, and the
best is .05 bars at most."""

MIN_BARS_SEEN = 8
"""Different bars in view, fewer than which could agree by chance (2^-8)."""


def order_witnesses(
    scene: Scene,
    pattern: PmpPattern,
    axis: Axis,
    bright: Sequence[tuple[Fit, NDArray[np.bool_]]],
    suspected: set[int],
    cannot: list[str],
) -> list[Witness]:
    """Question one axis.

    bright: its sets, and where each is well seen (`bright_pixels`). suspected: positions that others accuse already.
    """
    fits = [fit for fit, _ in bright]
    if len(fits) < len(pattern.frequencies) or not fits:
        cannot.append(f"rotations of sets along {axis} (sets are missing)")
        return []
    if suspected & {p for fit in fits for p in fit.positions}:
        # Phases of a set with a foreign frame prove nothing against other sets.
        return []
    seen = np.array([np.count_nonzero(pixels) for _, pixels in bright])
    least = np.array([min(MOST_OF_ENDS / fit.fringe_set.frequency, 0.5) for fit in fits]) * seen.max()
    if taken := [
        f"{fit.fringe_set.frequency:g}" for fit, has, needs in zip(fits, seen, least, strict=True) if has < needs
    ]:
        cannot.append(f"rotations and reversals of sets along {axis} (frequency {' and '.join(taken)} is blurred away)")
        return []
    use = np.logical_and.reduce([pixels for _, pixels in bright])
    if np.count_nonzero(use) < MIN_PIXELS:
        cannot.append(f"rotations and reversals of sets along {axis} (too few pixels show all of them)")
        return []
    try:
        ladder = plan_ladder(pattern.frequencies, [2 / n for n in pattern.shifts])
    except DecodeError:
        several = len(pattern.frequencies) > 1
        why = "frequencies without a common period" if several else "one frequency; decoding compares it with its code"
        cannot.append(f"rotations of sets along {axis} ({why})")
        return []
    cycles = np.stack([fit.cycles[use].astype(np.float64) for fit in fits])
    centre = 0.5 + (pattern.origin - 0.5) / scene.sequence.projector.along(axis)
    vectors = _agreement(ladder, cycles, centre)
    items = _remainders(scene, pattern, fits, ladder, cycles, vectors, use, centre, cannot)
    if all(item.passed for item in items):
        items += _bars(scene, pattern, axis, fits, ladder, cycles, vectors, use, centre, cannot)
    return items


def climb(
    ladder: Ladder, cycles: NDArray[np.float64], centre: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unwrap up the ladder. cycles: (K, P) of each set. Returns field fractions (P,) and remainders (steps, P)."""
    m, f = ladder.combinations.astype(np.float64), ladder.frequencies
    absolute = m[0] @ cycles
    absolute = absolute - np.rint(absolute - f[0] * centre)
    left = np.zeros((len(f) - 1, cycles.shape[1]))
    for j in range(len(f) - 1):
        psi = m[j + 1] @ cycles
        difference = f[j + 1] / f[j] * absolute - psi
        order = np.rint(difference)
        left[j] = difference - order
        absolute = psi + order
    return absolute / f[-1], left


def _remainders(
    scene: Scene,
    pattern: PmpPattern,
    fits: Sequence[Fit],
    ladder: Ladder,
    cycles: NDArray[np.float64],
    vectors: NDArray[np.complex128],
    use: NDArray[np.bool_],
    centre: float,
    cannot: list[str],
) -> list[Witness]:
    """Neighbouring rungs must agree over the whole image; if they do not, which turned set would make them?"""
    if len(ladder.frequencies) < 2:
        if not scene.sequence.bars:
            cannot.append("a rotation or reversal of the only set (no other frequency, no bars)")
        return []
    shifts = [fit.fringe_set.shifts for fit in fits]
    score = float(vectors.real.mean())
    # No set is turned to find a better agreement than there can be.
    could_be = score + HYPOTHESIS_GAIN < 1
    best, turned = _best_turn(pattern, ladder, cycles, centre, shifts) if could_be else (score, ())
    axis = fits[0].fringe_set.axis
    if turned and best > score + HYPOTHESIS_GAIN:
        frames = tuple(sorted(p for k in turned for p in fits[k].positions))
        named = " or ".join(f"{fits[k].fringe_set.frequency:g}" for k in turned)
        says = f"frequency {named} along {axis} is out of step: frames are rotated, reversed or those of another set"
        return [Witness(f"remainder {axis}", False, score, best - HYPOTHESIS_GAIN, frames, says)]
    noise2 = [(scene.noise / float(np.median(fit.modulation[use]))) ** 2 * 2 / n / (4 * np.pi**2)
              for fit, n in zip(fits, shifts, strict=True)]  # fmt: skip
    lengths = [mean_vector(fit, use) for fit in fits]
    items = []
    for j, (errors, vector) in enumerate(zip(ladder.errors, vectors, strict=True)):
        concerned = [k for k, weight in enumerate(errors) if abs(weight) > 1e-9]
        expected = float(np.exp(-2 * np.pi**2 * np.sum(errors**2 * noise2)))
        varied = all(lengths[k] < 0.5 for k in concerned)
        items.append(_step(fits, ladder, j, vector, expected, concerned, varied, cannot))
    return items


def _step(
    fits: Sequence[Fit],
    ladder: Ladder,
    j: int,
    vector: complex,
    expected: float,
    concerned: Sequence[int],
    varied: bool,
    cannot: list[str],
) -> Witness:
    low, high = ladder.frequencies[j], ladder.frequencies[j + 1]
    axis = fits[0].fringe_set.axis
    name = f"remainder {low:g}:{high:g} {axis}"
    offset, length = float(np.angle(vector)) / (2 * np.pi), float(np.abs(vector))
    # Half a frame's step of the set with most shifts. A scene that shows all phases averages response errors out as
    # far as it shows them by their spread: there what lies beyond the spread is disorder.
    limit = max(LEAST_OFFSET, 0.5 / max(fits[k].fringe_set.shifts for k in concerned))
    if varied:
        spread = float(np.sqrt(2 * max(0.0, np.log(expected / max(length, 1e-6))))) / (2 * np.pi)
        limit = min(limit, LEAST_OFFSET + spread)
    frames = tuple(sorted(p for k in concerned for p in fits[k].positions))
    if length > 0.5:
        passed = abs(offset) <= limit
        says = f"frequencies {low:g} and {high:g} along {axis} disagree by {offset:+.3f} of a fringe over the image"
        return Witness(name, passed, abs(offset), limit, () if passed else frames, says)
    few = min(fits[k].fringe_set.shifts for k in concerned)
    if expected > 0.8 and length < 0.2 and few > 3:
        says = f"frequencies {low:g} and {high:g} along {axis} have nothing to do with one another"
        return Witness(name, False, length, 0.2, frames, says)
    cannot.append(f"a rotation of frequency {low:g} or {high:g} along {axis} (their remainder is too noisy)")
    return Witness(name, True, length, 0.2, says="too noisy to judge")


def _agreement(ladder: Ladder, cycles: NDArray[np.float64], centre: float) -> NDArray[np.complex128]:
    """(steps,) mean vectors of the remainders; 1 where all pixels agree."""
    return np.asarray(np.exp(2j * np.pi * climb(ladder, cycles, centre)[1]).mean(axis=1))


def _best_turn(
    pattern: PmpPattern, ladder: Ladder, cycles: NDArray[np.float64], centre: float, shifts: Sequence[int]
) -> tuple[float, tuple[int, ...]]:
    """The best agreement that one turned set, or two exchanged ones, would give, and the sets that could be those."""
    sample = cycles[:, :: max(1, cycles.shape[1] // 1500)]
    scores = np.full(len(shifts), -1.0)
    for k, count in enumerate(shifts):
        for direction in (1, -1):
            for turn in range(count):
                if direction == 1 and turn == 0:
                    continue
                tried = sample.copy()
                # Reversed frames n -> r - n measure -theta - 2 offset - sign r 2 pi / N; rotated ones theta + r / N.
                fixed = -pattern.offset / np.pi if direction == -1 else 0.0
                tried[k] = direction * tried[k] + fixed + turn / count
                vectors = _agreement(ladder, tried, centre)
                if vectors.real.min() > 0.5:
                    scores[k] = max(scores[k], float(vectors.real.mean()))
    for k, other in combinations(range(len(shifts)), 2):
        for direction in (1, -1) if shifts[k] == shifts[other] else ():
            tried = sample.copy()
            # Two sets exchanged, or the order of all their frames reversed: n -> N - 1 - n, a turn by -sign.
            shift = 0.0 if direction == 1 else -pattern.offset / np.pi + pattern.sign / shifts[k]
            tried[[k, other]] = direction * tried[[other, k]] + shift
            vectors = _agreement(ladder, tried, centre)
            if vectors.real.min() > 0.5:
                scores[[k, other]] = np.maximum(scores[[k, other]], float(vectors.real.mean()))
    best = float(scores.max())
    return best, tuple(int(k) for k in np.flatnonzero((scores > best - 0.05) & (scores > 0)))


def _bars(
    scene: Scene,
    pattern: PmpPattern,
    axis: Axis,
    fits: Sequence[Fit],
    ladder: Ladder,
    cycles: NDArray[np.float64],
    vectors: NDArray[np.complex128],
    use: NDArray[np.bool_],
    centre: float,
    cannot: list[str],
) -> list[Witness]:
    """The order bars against the positions that the fringes give."""
    position = scene.sequence.bars.get(axis)
    blind = f"sets along {axis} that are all rotated or reversed alike"
    if position is None or position not in scene.frames:
        cannot.append(f"{blind} (no order bars)")
        return []
    b = np.min([fit.modulation[use] for fit in fits], axis=0)
    fraction, sigma, rung = _trusted(scene, fits, ladder, cycles, np.abs(vectors), centre, b)
    bar = (fraction - (pattern.origin - 0.5) / scene.sequence.projector.along(axis)) * BAR_COUNT
    known = sigma * BAR_COUNT < 0.5
    seen = np.unique(np.floor(bar[known & (bar > 0) & (bar < BAR_COUNT)]).astype(int))
    if np.count_nonzero(known) < MIN_PIXELS or len(seen) < MIN_BARS_SEEN:
        cannot.append(f"{blind} (the scene shows {len(seen)} of {BAR_COUNT} order bars well enough)")
        return []
    mean = middle([fit.mean[use] for fit in fits])
    above = (scene.frames[position][use] - mean)[known]
    here, other, other_at = _best_places(bar[known], above > 0, _nearby(fits, ladder))
    name = f"order bars {axis}"
    if other >= max(MIN_BARS_AGREEMENT, here + BARS_GAIN):
        frames = tuple(sorted({position, *(p for fit in fits for p in fit.positions)}))
        says = (
            f"{here:.0%} of pixels agree with the order bars along {axis} where the fringes put them, {other:.0%} "
            f"{other_at}: all sets are rotated or reversed alike"
        )
        return [Witness(name, False, here, other - BARS_GAIN, frames, says, whole=True)]
    everything = tuple(sorted({position, *(p for fit in fits for p in fit.positions)}))
    along = scene.sequence.projector.along(axis)
    if elsewhere := _elsewhere(pattern, axis, along, bar[known], above > 0, here, rung):
        agrees, says = elsewhere
        return [Witness(name, False, here, agrees - SCALE_GAIN, everything, says, whole=True)]
    binary = float(np.mean(np.abs(above) > 0.5 * b[known]))
    if here < MIN_BARS_AGREEMENT and binary < MIN_BARS_AGREEMENT:
        says = "the frame of the order bars shows no bars"
        return [Witness(name, False, here, MIN_BARS_AGREEMENT, (position,), says)]
    return [Witness(name, True, here, MIN_BARS_AGREEMENT, says=f"{here:.0%} agree with the fringes, no place more")]


def _elsewhere(
    pattern: PmpPattern,
    axis: Axis,
    along: int,
    bar: NDArray[np.float64],
    light: NDArray[np.bool_],
    here: float,
    finest: float,
) -> tuple[float, str] | None:
    """(agreement, in words) where all positions together are moved, or of another size, by the bars; None: neither."""
    moved, shift = _best_shift(bar, light, max(LEAST_SHIFT, 2 * NEARBY / finest))
    scaled, scale = _best_scale(bar, light) if shift or here + SCALE_GAIN <= 1 else (0.0, 1.0)
    if shift and moved >= scaled:
        return moved, (
            f"{moved:.0%} of pixels agree with the order bars along {axis} if all positions are moved by "
            f"{shift * along / BAR_COUNT:+.0f} px: the description's origin ({pattern.origin:g}) or offset "
            f"({pattern.offset:g}) is not that of the frames"
        )
    scaled, scale = _best_scale(bar, light) if here + SCALE_GAIN <= 1 else (0.0, 1.0)
    if scaled < max(MIN_SCALED_AGREEMENT, here + SCALE_GAIN):
        return None
    return scaled, (
        f"{here:.0%} of pixels agree with the order bars along {axis} where the fringes put them, {scaled:.0%} if "
        f"positions are {scale:.2f} times as large: the description's frequencies or projector size are not those "
        "of the frames"
    )


def _nearby(fits: Sequence[Fit], ladder: Ladder) -> float:
    """Bars: half of what one frame's step of any set moves the positions of the first rung, at most `NEARBY`."""
    moves = [
        abs(weight) / fit.fringe_set.shifts / ladder.frequencies[0]
        for weight, fit in zip(ladder.combinations[0], fits, strict=True)
        if weight
    ]
    return float(min(NEARBY, 0.5 * BAR_COUNT * min(moves)))


def _trusted(
    scene: Scene,
    fits: Sequence[Fit],
    ladder: Ladder,
    cycles: NDArray[np.float64],
    lengths: NDArray[np.float64],
    centre: float,
    b: Array,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Field fractions (P,) from the highest rung that is surely unwrapped, their 1-sigma, and that rung's frequency."""
    variances = np.array([2 / fit.fringe_set.shifts for fit in fits])
    rung = 0
    while rung < len(lengths) and lengths[rung] > 0.8:
        rung += 1
    part = Ladder(ladder.combinations[: rung + 1], ladder.frequencies[: rung + 1], ladder.errors[:rung], False)
    fraction, _ = climb(part, cycles, centre)
    weight = float(np.sqrt(np.sum(ladder.combinations[rung] ** 2 * variances))) / (2 * np.pi)
    return fraction, scene.noise / b * weight / ladder.frequencies[rung], float(ladder.frequencies[rung])


def _best_places(bar: NDArray[np.float64], light: NDArray[np.bool_], nearby: float) -> tuple[float, float, str]:
    """Agreement of the bars' light with the places that the fringes give, there and elsewhere.

    Returns (best agreement nearby, best elsewhere, where in words); elsewhere is -1 where no place there could be
    believed in. Nearby: response errors of few shifts bend positions by so much. Edges, where blur decides, count
    little: they are few.
    """
    stride = max(1, bar.size // 1500)
    bar, light = bar[::stride], light[::stride]
    lit = np.append(bar_light(np.arange(BAR_COUNT), BAR_COUNT) > 0.5, False)
    moved = [(float(offset), float(min(offset, BAR_COUNT - offset))) for offset in np.arange(0, BAR_COUNT, 0.25)]

    def agreement(base: NDArray[np.float64], offset: float) -> float:
        return float(np.mean(lit[((base + offset) % BAR_COUNT).astype(np.intp)] == light))

    near = max(agreement(bar, offset) for offset, away in moved if away <= nearby)
    far, far_at = -1.0, ""
    if near + BARS_GAIN > 1:
        return near, far, far_at
    for mirrored in (False, True):
        base = BAR_COUNT - bar if mirrored else bar
        for offset, away in moved:
            if (mirrored or away > nearby) and (agrees := agreement(base, offset)) > far:
                far = agrees
                far_at = f"{'mirrored and ' if mirrored else ''}{away / BAR_COUNT:.0%} of the field away"
    return near, far, far_at


def _best_shift(bar: NDArray[np.float64], light: NDArray[np.bool_], least: float) -> tuple[float, float]:
    """(agreement, bars) of the least shift that agrees best; 0 bars where it is below `least` or little is won by it.

    The response bends positions, but does not move them all; what it bends is less, the finer the fringes.
    """
    stride = max(1, bar.size // 1500)
    bar, light = bar[::stride], light[::stride]
    lit = bar_light(np.arange(BAR_COUNT), BAR_COUNT) > 0.5

    def agreement(shift: float) -> float:
        place = np.floor(bar + shift).astype(np.intp)
        inside = (place >= 0) & (place < BAR_COUNT)
        return float(np.mean(inside & (lit[np.clip(place, 0, BAR_COUNT - 1)] == light)))

    unmoved = agreement(0.0)
    if unmoved + SHIFT_GAIN > 1:
        return unmoved, 0.0
    best, shift = max((agreement(float(shift)), float(shift)) for shift in SHIFTS)
    believed = abs(shift) > least and best >= max(MIN_SCALED_AGREEMENT, unmoved + SHIFT_GAIN)
    return (best, shift) if believed else (unmoved, 0.0)


def _best_scale(bar: NDArray[np.float64], light: NDArray[np.bool_]) -> tuple[float, float]:
    """(agreement, factor) where positions of another size agree best with the bars' light; off the field none does."""
    stride = max(1, bar.size // 1500)
    bar, light = bar[::stride], light[::stride]
    lit = bar_light(np.arange(BAR_COUNT), BAR_COUNT) > 0.5
    best, at = 0.0, 1.0
    for scale in SCALES[np.abs(np.log(SCALES)) > 0.015]:
        place = np.floor(bar * scale).astype(np.intp)
        inside = (place >= 0) & (place < BAR_COUNT)
        agrees = float(np.mean(inside & (lit[np.clip(place, 0, BAR_COUNT - 1)] == light)))
        if agrees > best:
            best, at = agrees, float(scale)
    return best, at
