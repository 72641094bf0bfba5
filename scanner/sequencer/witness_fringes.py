"""Witnesses of fringe sets: the residual of each fit, the sets' means, the remainder between sets, order bars, copies.

Each sees what the others cannot. The residual names swapped, doubled and foreign frames of sets of four shifts or
more; the mean of a set does so for three. A set that was rotated or reversed as a whole leaves no residual: the
remainder between sets shows it, unless all sets turned alike and their frequencies hide it; then the order bars speak,
which hold one absolute position however few shifts there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from scanner.decode.pmp_witness import set_witness
from scanner.decode.unwrapping import Ladder, plan_ladder
from scanner.errors import DecodeError
from scanner.patterns import PmpPattern
from scanner.patterns.description import Axis
from scanner.patterns.pmp import FringeSet
from scanner.patterns.sequence import BAR_COUNT, bar_light
from scanner.sequencer.witness import NOISE_SIGMAS, Array, Scene, Witness, equal_positions, sigma_between

MIN_PIXELS = 150
"""Lit pixels of the thumbnail, fewer than which prove nothing."""

MAX_RESIDUAL = 0.35
"""Residual over B where its cause cannot be told from the response by phase. Uncorrected gamma 2.2 leaves .2."""

MAX_DISORDER = 0.15
"""Residual over B, beyond noise, that differs from frame to frame at the same phase, which no response does. Light
that flickers by 10 % from frame to frame leaves .06, uncorrected gamma 2.3 on a vignetted field .06."""

GAIN_VARIED, GAIN_NARROW = 0.6, 0.35
"""Another order is believed when it brings the residual down to this share of what it was. In a scene that shows all
phases no response can look like another order; where it shows few, a bent response at one phase may."""

COPY_SIGMAS = 1.3
"""Two frames that differ by no more than this, over the noise of full-on frames, are one picture."""

MAX_MEAN_DIFFERENCE = 0.2
"""Of a set's mean from the others', rms over B, gain taken out. A doubled frame among three leaves .41; the third
harmonic of an uncorrected gamma 2.2 leaves .05."""

HYPOTHESIS_GAIN = 0.35
"""A turned set is believed when it makes the remainders agree by so much better (mean cosine)."""

MIN_BARS_AGREEMENT = 0.75
"""Of pixels with the order bars: in step all but edges agree, any other order agrees in 15 of 31."""

BARS_GAIN = 0.15
"""Another place is believed when so many more pixels agree with the bars there."""

NEARBY = 1.25
"""Bars: the response of an uncorrected gamma 2.2 bends positions from three shifts of a unit frequency so far."""

MIN_BARS_SEEN = 8
"""Different bars in view, fewer than which could agree by chance (2^-8)."""


@dataclass(frozen=True, eq=False)
class Fit:
    """One set's least-squares fit I_n = A + B cos(theta + alpha_n) over all samples."""

    fringe_set: FringeSet
    positions: tuple[int, ...]
    """of the frames that are here"""
    alpha: NDArray[np.float64]
    frames: Array
    """(N, P) grey levels"""
    mean: Array
    modulation: Array
    cycles: Array
    """(P,) theta / 2 pi"""

    def model(self, n: int) -> Array:
        """(P,) what frame n should show."""
        angle = 2 * np.pi * self.cycles + np.float32(self.alpha[n])
        return np.asarray(self.mean + self.modulation * np.cos(angle), dtype=np.float32)


def fringe_witnesses(scene: Scene, cannot: list[str]) -> list[Witness]:
    """All witnesses of a PMP capture."""
    pattern = scene.sequence.pattern
    if not isinstance(pattern, PmpPattern):
        return []
    fits = [fit for fringe_set in pattern.sets() if (fit := _fit(scene, pattern, fringe_set)) is not None]
    clipped = _clipped(scene)
    items = [item for fit in fits if (item := _residual(scene, fit, clipped)) is not None]
    items += _means(scene, fits, clipped)
    items += _copies(scene, fits)
    suspected = {p for item in items if not item.passed for p in item.frames}
    for axis in pattern.axes:
        mine = [fit for fit in fits if fit.fringe_set.axis == axis]
        items += _between_sets(scene, pattern, axis, mine, clipped, suspected, cannot)
    if any(n == 3 for n in pattern.shifts):
        cannot.append("blends of neighbouring patterns inside a set of three shifts, if small")
    return items


def _fit(scene: Scene, pattern: PmpPattern, fringe_set: FringeSet) -> Fit | None:
    fringes = scene.sequence.fringes[fringe_set.first : fringe_set.first + fringe_set.shifts]
    here = [n for n, p in enumerate(fringes) if p in scene.frames]
    if len(here) < 3:
        return None
    alpha = pattern.sign * 2 * np.pi * np.asarray(here) / fringe_set.shifts + pattern.offset
    frames = np.stack([scene.frames[fringes[n]] for n in here])
    mean, cosine, sine = _solve(_design(alpha), frames)
    cycles = np.arctan2(sine, cosine) / np.float32(2 * np.pi)
    return Fit(fringe_set, tuple(fringes[n] for n in here), alpha, frames, mean, np.hypot(cosine, sine), cycles)


def _design(alpha: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([np.ones_like(alpha), np.cos(alpha), -np.sin(alpha)], axis=1)


def _solve(design: NDArray[np.float64], frames: Array) -> Array:
    return np.asarray(np.linalg.pinv(design).astype(np.float32) @ frames)


def _clipped(scene: Scene) -> NDArray[np.bool_]:
    top = np.max([scene.frames[p] for p in scene.sequence.fringes if p in scene.frames], axis=0)
    return np.asarray(top >= scene.max_value)


def _bright(scene: Scene, fit: Fit, clipped: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels with a modulation well above its noise, and not clipped."""
    b = fit.modulation
    sigma = scene.noise * float(np.sqrt(2 / len(fit.positions)))
    return scene.lit & ~clipped & (b > NOISE_SIGMAS * sigma) & (b > 0.25 * float(np.quantile(b, 0.99)))


def _name(fringe_set: FringeSet) -> str:
    return f"frequency {fringe_set.frequency:g} along {fringe_set.axis}"


# --- one set ------------------------------------------------------------------------------------------------------


def _residual(scene: Scene, fit: Fit, clipped: NDArray[np.bool_]) -> Witness | None:
    """What the fit leaves: explained by an exchange of frames, by a frame that shows another shift, or large."""
    bright = _bright(scene, fit, clipped)
    if len(fit.positions) < 4 or np.count_nonzero(bright) < MIN_PIXELS:
        return None
    name, called = f"residual {fit.fringe_set.frequency:g}{fit.fringe_set.axis}", _name(fit.fringe_set)
    design, frames, b = _design(fit.alpha), fit.frames[:, bright], fit.modulation[bright]
    left, noise = _rms(design, frames, b), scene.noise / float(np.median(b))
    limit = MAX_RESIDUAL + noise
    gain = GAIN_VARIED if _length(fit, bright) < 0.5 else GAIN_NARROW
    if left > 1.5 * noise:
        if (pair := _exchange(design, frames, b, gain * left)) is not None:
            wrong = tuple(sorted(fit.positions[n] for n in pair))
            says = f"{called} fits with frames {wrong[0]} and {wrong[1]} exchanged, and not as it is"
            return Witness(name, False, left, limit, wrong, says)
        if wrong := _false_shifts(fit, bright, noise, gain):
            says = f"{called}: frames {', '.join(map(str, wrong))} show another shift than their own"
            return Witness(name, False, left, limit, wrong, says)
    if left > limit:
        says = f"{called} does not fit a sinusoid: {left:.2f} B is left"
        return Witness(name, False, left, limit, _odd_one_out(fit, bright, left), says)
    seen = set_witness(fit.fringe_set, fit.positions, fit.frames[:, bright], design, clipped[bright])
    if seen.disorder is not None and seen.disorder > MAX_DISORDER + noise:
        says = f"{called} does not fit a sinusoid: {seen.disorder:.2f} B that no response explains"
        return Witness(name, False, seen.disorder, MAX_DISORDER + noise, seen.suspects, says)
    return Witness(name, True, left, limit, says=f"{called} fits a sinusoid")


def _false_shifts(fit: Fit, bright: NDArray[np.bool_], noise: float, gain: float) -> tuple[int, ...]:
    """Frames that the others predict for another shift, and not for their own."""
    count = len(fit.positions)
    if count < 5:
        return ()
    stride = max(1, int(np.count_nonzero(bright)) // 2000)
    frames, b = fit.frames[:, bright][:, ::stride], fit.modulation[bright][::stride]
    steps = np.arange(fit.fringe_set.shifts)
    alphas = fit.alpha[0] + (fit.alpha[1] - fit.alpha[0]) * steps if _whole(fit) else fit.alpha
    wrong = []
    for n in range(count):
        keep = [i for i in range(count) if i != n]
        found = _solve(_design(fit.alpha[keep]), frames[keep])
        off = [float(np.sqrt(np.median(((row - frames[n]) / b) ** 2))) / 0.6745 for row in _predict(alphas, found)]
        if off[n] > 2 * noise and min(off) < gain * off[n]:
            wrong.append(fit.positions[n])
    return tuple(wrong)


def _whole(fit: Fit) -> bool:
    return len(fit.positions) == fit.fringe_set.shifts


def _predict(alphas: NDArray[np.float64], found: Array) -> Array:
    """(M, P) what frames of these shifts should show."""
    return np.asarray(_design(alphas).astype(np.float32) @ found)


def _rms(design: NDArray[np.float64], frames: Array, b: Array) -> float:
    """Residual over B, rms over frames, median over pixels."""
    left = (frames - design.astype(np.float32) @ _solve(design, frames)) / b
    return float(np.sqrt(np.median((left**2).sum(axis=0)) / max(len(frames) - 3, 1)))


def _exchange(design: NDArray[np.float64], frames: Array, b: Array, below: float) -> tuple[int, int] | None:
    """The exchange of two frames that leaves the smallest residual, if that is below `below`."""
    stride = max(1, frames.shape[1] // 2000)
    sample, weights = frames[:, ::stride], b[::stride]
    found = []
    for i, j in combinations(range(len(frames)), 2):
        order = list(range(len(frames)))
        order[i], order[j] = order[j], order[i]
        found.append((_rms(design, sample[order], weights), (i, j)))
    found.sort()
    return found[0][1] if found[0][0] < below else None


def _odd_one_out(fit: Fit, bright: NDArray[np.bool_], left: float) -> tuple[int, ...]:
    """The frame without which the others fit; all of them where none is, or where too few would be left to tell."""
    count = len(fit.positions)
    if count < 5:
        return fit.positions
    b = fit.modulation[bright]
    tried = []
    for n in range(count):
        keep = [i for i in range(count) if i != n]
        tried.append((_rms(_design(fit.alpha[keep]), fit.frames[keep][:, bright], b), n))
    best, n = min(tried)
    return (fit.positions[n],) if best < GAIN_VARIED * left else fit.positions


def _means(scene: Scene, fits: Sequence[Fit], clipped: NDArray[np.bool_]) -> list[Witness]:
    """Equal mean light of all sets, pixel by pixel, and between black and white: the only check inside three shifts."""
    if not fits:
        return []
    use = np.logical_and.reduce([_bright(scene, fit, clipped) for fit in fits])
    references = _references(scene, use)
    if np.count_nonzero(use) < MIN_PIXELS or (len(fits) < 2 and references is None):
        return []
    means = np.stack([fit.mean[use] for fit in fits])
    if references is not None:
        black, span = references
        means = means - black
    else:
        # Of two sets each stands half way to the other's error; of more the median is right.
        span = np.median(means, axis=0) if len(fits) > 2 else means.mean(axis=0)
    b = np.median(np.stack([fit.modulation[use] for fit in fits]), axis=0)
    # Lamps drift and mains light beats: one gain a set is taken out; disorder differs from pixel to pixel.
    gains = np.median(means / np.maximum(span, 1), axis=1, keepdims=True)
    value = np.sqrt(np.median(((means - gains * span) / b) ** 2, axis=1)) / 0.6745
    noise = scene.noise / float(np.median(b)) / np.sqrt([len(fit.positions) for fit in fits])
    limit = MAX_MEAN_DIFFERENCE / (2 if references is None and len(fits) == 2 else 1) + 3 * noise
    wrong = [fits[int(i)] for i in np.flatnonzero(value > limit)]
    frames = tuple(sorted(p for fit in wrong for p in fit.positions))
    worst = int(np.argmax(value / limit))
    if not wrong:
        return [Witness("equal means", True, float(value[worst]), float(limit[worst]), says="sets have equal means")]
    says = f"{', '.join(_name(fit.fringe_set) for fit in wrong)}: mean light unlike that of the other sets"
    return [Witness("equal means", False, float(value[worst]), float(limit[worst]), frames, says)]


def _references(scene: Scene, use: NDArray[np.bool_]) -> tuple[Array, Array] | None:
    """(black, white - black) over some pixels, from full-off and full-on frames that are not clipped."""
    levels = {}
    for light, positions in equal_positions(scene.sequence):
        here = [scene.frames[p][use] for p in positions if p in scene.frames]
        if not here:
            return None
        levels[light] = np.median(np.stack(here), axis=0).astype(np.float32)
    span = levels[1.0] - levels[0.0]
    clipped = float(np.mean(levels[1.0] >= scene.max_value)) if span.size else 1.0
    return (levels[0.0], span) if clipped < 0.05 and float(np.median(span)) > 0 else None


def _copies(scene: Scene, fits: Sequence[Fit]) -> list[Witness]:
    """Frames of different patterns that are one picture: a stale buffer, a doubled frame, a flip that never came."""
    noise = scene.noise
    frames: dict[int, int] = {}
    nearest = np.inf
    for f, fit in enumerate(fits):
        use = scene.lit & (fit.modulation > 4 * scene.noise)
        if np.count_nonzero(use) < MIN_PIXELS:
            continue
        own = _varied(fit, use)
        for later in fits[f:]:
            if later is not fit and not (own and _varied(later, use)):
                continue
            for i, j in _pairs(fit, later):
                difference = sigma_between(fit.frames[i][use], later.frames[j][use])
                expected = 8 * noise
                if later is fit:
                    expected = sigma_between(fit.model(i)[use], fit.model(j)[use])
                if expected < 4 * noise:
                    continue
                nearest = min(nearest, difference / noise)
                if difference <= min(COPY_SIGMAS * noise, 0.4 * expected):
                    frames[later.positions[j]] = fit.positions[i]
    if not np.isfinite(nearest):
        return []
    named = ", ".join(f"{later} of {earlier}" for later, earlier in sorted(frames.items()))
    says = f"copies of an earlier frame: {named}" if frames else "all frames differ"
    return [Witness("copies", not frames, nearest, COPY_SIGMAS, tuple(sorted(frames)), says)]


def _varied(fit: Fit, use: NDArray[np.bool_]) -> bool:
    """Whether the scene shows enough of the set's phases for two frames not to be alike by chance."""
    return _length(fit, use) < 0.9


def _length(fit: Fit, use: NDArray[np.bool_]) -> float:
    """Length of the mean phase vector: 1 where the scene shows one phase only, 0 where it shows all alike."""
    return float(np.abs(np.exp(2j * np.pi * fit.cycles[use]).mean()))


def _pairs(fit: Fit, later: Fit) -> list[tuple[int, int]]:
    if later is fit:
        return list(combinations(range(len(fit.positions)), 2))
    if (fit.fringe_set.axis, fit.fringe_set.frequency) == (later.fringe_set.axis, later.fringe_set.frequency):
        return []
    return [(i, j) for i in range(len(fit.positions)) for j in range(len(later.positions))]


# --- sets against one another, and against the bars -----------------------------------------------------------------


def _between_sets(
    scene: Scene,
    pattern: PmpPattern,
    axis: Axis,
    fits: Sequence[Fit],
    clipped: NDArray[np.bool_],
    suspected: set[int],
    cannot: list[str],
) -> list[Witness]:
    if len(fits) < len(pattern.frequencies) or not fits:
        cannot.append(f"rotations of sets along {axis} (sets are missing)")
        return []
    if suspected & {p for fit in fits for p in fit.positions}:
        # Phases of a set with a foreign frame prove nothing against other sets.
        return []
    use = np.logical_and.reduce([_bright(scene, fit, clipped) for fit in fits])
    if np.count_nonzero(use) < MIN_PIXELS:
        cannot.append(f"rotations and reversals of sets along {axis} (too few pixels show all of them)")
        return []
    try:
        ladder = plan_ladder(pattern.frequencies, [2 / n for n in pattern.shifts])
    except DecodeError:
        cannot.append(f"rotations of sets along {axis} (frequencies without a common period)")
        return []
    cycles = np.stack([fit.cycles[use].astype(np.float64) for fit in fits])
    centre = 0.5 + (pattern.origin - 0.5) / scene.sequence.projector.along(axis)
    items = _remainders(scene, pattern, fits, ladder, cycles, use, centre, cannot)
    if all(item.passed for item in items):
        items += _bars(scene, pattern, axis, fits, ladder, cycles, use, centre, cannot)
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
    use: NDArray[np.bool_],
    centre: float,
    cannot: list[str],
) -> list[Witness]:
    """Neighbouring rungs must agree over the whole image; if they do not, which turned set would make them?"""
    if len(ladder.frequencies) < 2:
        if not scene.sequence.bars:
            cannot.append("a rotation or reversal of the only set (no other frequency, no bars)")
        return []
    vectors = _agreement(ladder, cycles, centre)
    shifts = [fit.fringe_set.shifts for fit in fits]
    best, turned = _best_turn(pattern, ladder, cycles, centre, shifts)
    score = float(vectors.real.mean())
    axis = fits[0].fringe_set.axis
    if turned and best > score + HYPOTHESIS_GAIN:
        frames = tuple(sorted(p for k in turned for p in fits[k].positions))
        named = " or ".join(f"{fits[k].fringe_set.frequency:g}" for k in turned)
        says = f"frequency {named} along {axis} is out of step: frames are rotated, reversed or those of another set"
        return [Witness(f"remainder {axis}", False, score, best - HYPOTHESIS_GAIN, frames, says)]
    noise2 = [(scene.noise / float(np.median(fit.modulation[use]))) ** 2 * 2 / n / (4 * np.pi**2)
              for fit, n in zip(fits, shifts, strict=True)]  # fmt: skip
    items = []
    for j, (errors, vector) in enumerate(zip(ladder.errors, vectors, strict=True)):
        concerned = [k for k, weight in enumerate(errors) if abs(weight) > 1e-9]
        expected = float(np.exp(-2 * np.pi**2 * np.sum(errors**2 * noise2)))
        items.append(_step(fits, ladder, j, vector, expected, concerned, cannot))
    return items


def _step(
    fits: Sequence[Fit],
    ladder: Ladder,
    j: int,
    vector: complex,
    expected: float,
    concerned: Sequence[int],
    cannot: list[str],
) -> Witness:
    low, high = ladder.frequencies[j], ladder.frequencies[j + 1]
    axis = fits[0].fringe_set.axis
    name = f"remainder {low:g}:{high:g} {axis}"
    # Half a frame's step of the set with most shifts; sets of few shifts have response errors, and move far.
    limit = max(0.05, 0.5 / max(fits[k].fringe_set.shifts for k in concerned))
    offset, length = float(np.angle(vector)) / (2 * np.pi), float(np.abs(vector))
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
    fraction, sigma = _trusted(scene, fits, ladder, cycles, centre, b)
    bar = (fraction - (pattern.origin - 0.5) / scene.sequence.projector.along(axis)) * BAR_COUNT
    known = sigma * BAR_COUNT < 0.5
    seen = np.unique(np.floor(bar[known & (bar > 0) & (bar < BAR_COUNT)]).astype(int))
    if np.count_nonzero(known) < MIN_PIXELS or len(seen) < MIN_BARS_SEEN:
        cannot.append(f"{blind} (the scene shows {len(seen)} of {BAR_COUNT} order bars well enough)")
        return []
    mean = np.median([fit.mean[use] for fit in fits], axis=0)
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
    binary = float(np.mean(np.abs(above) > 0.5 * b[known]))
    if here < MIN_BARS_AGREEMENT and binary < MIN_BARS_AGREEMENT:
        says = "the frame of the order bars shows no bars"
        return [Witness(name, False, here, MIN_BARS_AGREEMENT, (position,), says)]
    return [Witness(name, True, here, MIN_BARS_AGREEMENT, says=f"{here:.0%} agree with the fringes, no place more")]


def _nearby(fits: Sequence[Fit], ladder: Ladder) -> float:
    """Bars: half of what one frame's step of any set moves the positions of the first rung, at most `NEARBY`."""
    moves = [
        abs(weight) / fit.fringe_set.shifts / ladder.frequencies[0]
        for weight, fit in zip(ladder.combinations[0], fits, strict=True)
        if weight
    ]
    return float(min(NEARBY, 0.5 * BAR_COUNT * min(moves)))


def _trusted(
    scene: Scene, fits: Sequence[Fit], ladder: Ladder, cycles: NDArray[np.float64], centre: float, b: Array
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Field fractions (P,) from the highest rung that is surely unwrapped, and their 1-sigma."""
    variances = np.array([2 / fit.fringe_set.shifts for fit in fits])
    vectors = np.abs(_agreement(ladder, cycles, centre))
    rung = 0
    while rung < len(vectors) and vectors[rung] > 0.8:
        rung += 1
    part = Ladder(ladder.combinations[: rung + 1], ladder.frequencies[: rung + 1], ladder.errors[:rung], False)
    fraction, _ = climb(part, cycles, centre)
    weight = float(np.sqrt(np.sum(ladder.combinations[rung] ** 2 * variances))) / (2 * np.pi)
    return fraction, scene.noise / b * weight / ladder.frequencies[rung]


def _best_places(bar: NDArray[np.float64], light: NDArray[np.bool_], nearby: float) -> tuple[float, float, str]:
    """Agreement of the bars' light with the places that the fringes give, there and elsewhere.

    Returns (best agreement nearby, best elsewhere, where in words). Nearby:
    response errors of few shifts bend positions by so much. Edges, where blur decides, count little: they are few.
    """
    stride = max(1, bar.size // 3000)
    bar, light = bar[::stride], light[::stride]
    near, far, far_at = -1.0, -1.0, ""
    for mirrored in (False, True):
        base = BAR_COUNT - bar if mirrored else bar
        for offset in np.arange(0, BAR_COUNT, 0.25):
            moved = min(offset, BAR_COUNT - offset)
            place = np.floor((base + offset) % BAR_COUNT)
            agrees = float(np.mean((bar_light(place, BAR_COUNT) > 0.5) == light))
            if not mirrored and moved <= nearby:
                near = max(near, agrees)
            elif agrees > far:
                far = agrees
                far_at = f"{'mirrored and ' if mirrored else ''}{moved / BAR_COUNT:.0%} of the field away"
    return near, far, far_at
