"""Witnesses inside fringe sets: the residual of each fit, the sets' means, copies.

Each sees what the others cannot. The residual names swapped, doubled and foreign frames of sets of four shifts or
more; the mean of a set does so for three; copies show in any. What concerns sets as a whole is in `witness_order`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from scanner.patterns import PmpPattern
from scanner.patterns.pmp import FringeSet
from scanner.sequencer.findings import Array, Scene, Witness, equal_positions, listed, middle, sigmas_between
from scanner.sequencer.fringe_fit import (
    MIN_PIXELS,
    Fit,
    bright_pixels,
    clipped_pixels,
    design_matrix,
    disorder,
    fit_set,
    left_over,
    mean_vector,
    rms,
    solve,
)
from scanner.sequencer.witness_order import order_witnesses

MAX_HARMONIC = 0.4
"""Second harmonic over B that a response may leave; uncorrected gamma 2.3 leaves .3."""

MAX_DISORDER = 0.06
"""Residual over B, noise taken off, that differs from frame to frame at the same phase, which no response does. Light
that flickers by 5 % from frame to frame leaves .03; two neighbours of 16 shifts exchanged leave .1."""

GAIN_VARIED, GAIN_NARROW = 0.6, 0.35
"""Another order is believed when it brings the residual down to this share of what it was. In a scene that shows all
phases no response can look like another order; where it shows few, a bent response at one phase may."""

EQUALLY_WELL = 1.3
"""Explanations whose residuals differ by less than this cannot be told apart."""

COPY_SIGMAS = 1.15
"""Two frames that differ by no more than this, over the noise of full-on frames, are one picture: they are darker, so
their own noise is less."""

COPY_EXPECTED = 6.0
"""Only frames that should differ by this much more than the noise are compared."""

MAX_MEAN_DIFFERENCE = 0.06
"""Of a set's mean from the others', rms over B, gain and noise taken out. A doubled frame among three leaves .41, one
blended by a seventh .06; the third harmonic of an uncorrected gamma 2.3 leaves .03."""


def fringe_witnesses(scene: Scene, cannot: list[str]) -> list[Witness]:
    """All witnesses of a PMP capture."""
    pattern = scene.sequence.pattern
    if not isinstance(pattern, PmpPattern):
        return []
    fits = [fit for fringe_set in pattern.sets() if (fit := fit_set(scene, pattern, fringe_set)) is not None]
    clipped = clipped_pixels(scene)
    bright = [bright_pixels(scene, fit, clipped) for fit in fits]
    each = list(zip(fits, bright, strict=True))
    items = [item for fit, use in each if (item := _residual(scene, fit, fits, use)) is not None]
    items += _copies(scene, fits)
    suspected = {p for item in items if not item.passed for p in item.frames}
    items += _means(scene, fits, bright, suspected)
    suspected |= {p for item in items if not item.passed for p in item.frames}
    for axis in pattern.axes:
        mine = [(fit, use) for fit, use in each if fit.fringe_set.axis == axis]
        items += order_witnesses(scene, pattern, axis, mine, suspected, cannot)
    if any(n == 3 for n in pattern.shifts):
        cannot.append("blends of neighbouring patterns inside a set of three shifts, if small")
    return items


def _name(fringe_set: FringeSet) -> str:
    return f"frequency {fringe_set.frequency:g} along {fringe_set.axis}"


# --- one set ------------------------------------------------------------------------------------------------------


def _residual(scene: Scene, fit: Fit, others: Sequence[Fit], bright: NDArray[np.bool_]) -> Witness | None:
    """What the fit leaves: explained by another order of frames, or beyond what any response leaves."""
    count = len(fit.positions)
    if count < 4 or np.count_nonzero(bright) < MIN_PIXELS:
        return None
    name, called = f"residual {fit.fringe_set.frequency:g}{fit.fringe_set.axis}", _name(fit.fringe_set)
    design, frames, b = design_matrix(fit.alpha), fit.frames[:, bright], fit.modulation[bright]
    rest = left_over(design, frames, b)
    left, noise = rms(rest), scene.noise / float(np.median(b))
    # A second harmonic of amplitude h B leaves N h^2 / 2 over N - 3 degrees of freedom.
    limit = MAX_HARMONIC * (count / 2 / (count - 3)) ** 0.5 + noise
    if left > 1.5 * noise and (found := _explained(fit, others, bright, left, noise)) is not None:
        wrong, says = found
        return Witness(name, False, left, limit, wrong, f"{called}: {says}")
    if (seen := disorder(fit, bright, rest)) is not None:
        (left, wrong), limit = seen, MAX_DISORDER + noise / 3
    else:
        wrong = _odd_one_out(fit, bright, left) if left > limit else ()
    if left <= limit:
        return Witness(name, True, left, limit, says=f"{called} fits a sinusoid")
    says = f"{called} does not fit a sinusoid: {left:.2f} B that no response explains"
    return Witness(name, False, left, limit, wrong, says)


def _explained(
    fit: Fit, others: Sequence[Fit], bright: NDArray[np.bool_], left: float, noise: float
) -> tuple[tuple[int, ...], str] | None:
    """Frames whose exchange, or whose showing another shift, explains the residual; and that in words."""
    gain = GAIN_VARIED if mean_vector(fit, bright) < 0.5 else GAIN_NARROW
    design, frames, b = design_matrix(fit.alpha), fit.frames[:, bright], fit.modulation[bright]
    if pairs := _exchange(design, frames, b, gain * left):
        wrong = tuple(sorted({fit.positions[n] for pair in pairs for n in pair}))
        named = " or ".join(f"{fit.positions[i]} and {fit.positions[j]}" for i, j in pairs)
        return wrong, f"fits with frames {named} exchanged, and not as it is"
    if wrong := _false_shifts(fit, bright, noise, gain):
        return wrong, f"frames {listed(wrong)} show another shift than their own"
    foreign = [(p, frame[bright]) for other in others if other is not fit for p, frame in _each(other)]
    if (exchanged := _foreign(fit, foreign, bright, GAIN_NARROW * left)) is not None:
        return exchanged, f"fits with frame {exchanged[1]} in place of {exchanged[0]}, and not as it is"
    return None


def _each(fit: Fit) -> list[tuple[int, Array]]:
    return list(zip(fit.positions, fit.frames, strict=True))


def _foreign(
    fit: Fit, foreign: Sequence[tuple[int, Array]], bright: NDArray[np.bool_], below: float
) -> tuple[int, int] | None:
    """(own position, foreign position): the frame of another set with which this set fits, if one does."""
    stride = max(1, int(np.count_nonzero(bright)) // 1000)
    frames, b = fit.frames[:, bright][:, ::stride], fit.modulation[bright][::stride]
    design = design_matrix(fit.alpha)
    found = []
    for n, position in enumerate(fit.positions):
        tried = frames.copy()
        for other, pixels in foreign:
            tried[n] = pixels[::stride]
            found.append((_rms(design, tried, b), (position, other)))
    best = min(found, default=(np.inf, (0, 0)))
    return best[1] if best[0] < below else None


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
        found = solve(design_matrix(fit.alpha[keep]), frames[keep])
        off = [float(np.sqrt(np.median(((row - frames[n]) / b) ** 2))) / 0.6745 for row in _predict(alphas, found)]
        if off[n] > 2 * noise and min(off) < gain * off[n]:
            wrong.append(fit.positions[n])
    return tuple(wrong)


def _whole(fit: Fit) -> bool:
    return len(fit.positions) == fit.fringe_set.shifts


def _predict(alphas: NDArray[np.float64], found: Array) -> Array:
    """(M, P) what frames of these shifts should show."""
    return np.asarray(design_matrix(alphas).astype(np.float32) @ found)


def _rms(design: NDArray[np.float64], frames: Array, b: Array) -> float:
    """Residual over B, rms over frames, median over pixels."""
    return rms(left_over(design, frames, b))


def _exchange(design: NDArray[np.float64], frames: Array, b: Array, below: float) -> list[tuple[int, int]]:
    """The exchanges of two frames that leave the smallest residual, if that is below `below`.

    Of four frames, exchanging the middle two or the outer two leaves the same: one is the other, reversed.
    """
    stride = max(1, frames.shape[1] // 2000)
    sample, weights = frames[:, ::stride], b[::stride]
    found = []
    for i, j in combinations(range(len(frames)), 2):
        order = list(range(len(frames)))
        order[i], order[j] = order[j], order[i]
        found.append((_rms(design, sample[order], weights), (i, j)))
    found.sort()
    return [pair for rest, pair in found if rest < min(below, EQUALLY_WELL * found[0][0])]


def _odd_one_out(fit: Fit, bright: NDArray[np.bool_], left: float) -> tuple[int, ...]:
    """The frame without which the others fit; all of them where none is, or where too few would be left to tell."""
    count = len(fit.positions)
    if count < 5:
        return fit.positions
    b = fit.modulation[bright]
    tried = []
    for n in range(count):
        keep = [i for i in range(count) if i != n]
        tried.append((_rms(design_matrix(fit.alpha[keep]), fit.frames[keep][:, bright], b), n))
    best, n = min(tried)
    return (fit.positions[n],) if best < GAIN_VARIED * left else fit.positions


def _means(
    scene: Scene, fits: Sequence[Fit], bright: Sequence[NDArray[np.bool_]], suspected: set[int]
) -> list[Witness]:
    """Equal mean light of all sets, pixel by pixel, and between black and white: the only check inside three shifts."""
    if not fits:
        return []
    use = np.logical_and.reduce(bright)
    references = _references(scene, use)
    if np.count_nonzero(use) < MIN_PIXELS or (len(fits) < 2 and references is None):
        return []
    means = np.stack([fit.mean[use] for fit in fits])
    if references is not None:
        black, span = references
        means = means - black
    else:
        # Of two sets each stands half way to the other's error; of more the median is right.
        span = middle(list(means)) if len(fits) > 2 else means.mean(axis=0)
    b = middle([fit.modulation[use] for fit in fits])
    # Lamps drift and mains light beats: one gain a set is taken out; disorder differs from pixel to pixel.
    # Medians line by line: along an axis they take five times as long.
    gains = np.array([[np.median(line)] for line in means / np.maximum(span, 1)])
    value = np.sqrt(np.array([np.median(line) for line in ((means - gains * span) / b) ** 2])) / 0.6745
    # The references are medians of three frames each (variance pi / 2 / 3), of which the mean takes about a half.
    own = np.array([1 / len(fit.positions) for fit in fits])
    noise = scene.noise / float(np.median(b)) * np.sqrt(own + (0.26 if references is not None else own.mean()))
    value = np.sqrt(np.maximum(value**2 - noise**2, 0))
    limit = MAX_MEAN_DIFFERENCE / (2 if references is None and len(fits) == 2 else 1) + noise
    # A set with a frame that is named already has its reason.
    wrong = [fits[int(i)] for i in np.flatnonzero(value > limit) if not suspected & set(fits[int(i)].positions)]
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
        levels[light] = middle(here)
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
        stride = max(1, int(np.count_nonzero(use)) // 2000)
        chosen = np.flatnonzero(use)[::stride]
        own = _varied(fit, chosen)
        frames_here = fit.frames.take(chosen, axis=1)
        for later in fits[f:]:
            if later is not fit and not (own and _varied(later, chosen)):
                continue
            if not (pairs := _pairs(fit, later)):
                continue
            ones, others = (list(indices) for indices in zip(*pairs, strict=True))
            frames_there = frames_here if later is fit else later.frames.take(chosen, axis=1)
            differences = sigmas_between(frames_here[ones], frames_there[others])
            expected = np.full(len(pairs), 8 * noise)
            if later is fit:
                model = fit.model(chosen)
                expected = sigmas_between(model[ones], model[others])
            tell = expected >= COPY_EXPECTED * noise
            nearest = min(nearest, float(np.min(differences[tell] / noise, initial=np.inf)))
            copied = tell & (differences <= np.minimum(COPY_SIGMAS * noise, 0.4 * expected))
            frames |= {later.positions[others[n]]: fit.positions[ones[n]] for n in np.flatnonzero(copied)}
    if not np.isfinite(nearest):
        return []
    named = ", ".join(f"{later} of {earlier}" for later, earlier in sorted(frames.items()))
    says = f"copies of an earlier frame: {named}" if frames else "all frames differ"
    return [Witness("copies", not frames, nearest, COPY_SIGMAS, tuple(sorted(frames)), says)]


def _varied(fit: Fit, use: NDArray[np.intp]) -> bool:
    """Whether the scene shows enough of the set's phases for two frames not to be alike by chance."""
    return mean_vector(fit, use) < 0.9


def _pairs(fit: Fit, later: Fit) -> list[tuple[int, int]]:
    if later is fit:
        return list(combinations(range(len(fit.positions)), 2))
    if (fit.fringe_set.axis, fit.fringe_set.frequency) == (later.fringe_set.axis, later.fringe_set.frequency):
        return []
    return [(i, j) for i in range(len(fit.positions)) for j in range(len(later.positions))]
