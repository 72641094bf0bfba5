"""What the content of the frames says about their order: the witnesses. Pure: thumbnails in, findings out.

Stamps can lie and latencies be wrong; what the frames show cannot. Here stand the findings themselves and the
witnesses of full-on and full-off frames: sentinels, white and black. Those of fringe sets are in `witness_fringes`,
those of Gray code in `witness_gray`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.devices import Pixels
from scanner.patterns import FrameRole, PatternSequence
from scanner.patterns.sequence import SENTINELS_AFTER, SENTINELS_BEFORE

SENTINEL_TOLERANCE = 0.05
"""Share of the contrast by which equal sentinels may differ. Lamps drift by 1-3 % in seconds and mains light adds as
much; a blend of two patterns by this share moves a phase by 0.05 x 2 pi / N at most, far from half a fringe."""

BLACK_TOLERANCE, FLICKER = 0.015, 0.1
"""The lamp does not shine on full-off frames: they may differ by so much, and by the flicker of the ambient light, of
which mains light has up to a tenth over exposures that are no multiple of its period."""

NOISE_SIGMAS = 5.0
"""What is called lit, or different, stands this far above the noise."""

LIT_SHARE = 0.15
"""Of the contrast that the brightest half percent reaches: what is darker is scattered light more than pattern."""

LEAST_NOISE = 12**-0.5
"""Grey levels: rounding to whole levels."""

DARK_HINT = "is the lens cap off, the projector on and awake, and the exposure long enough?"

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Witness:
    """One finding. `value` is held against `limit`; `frames` are the positions it speaks against."""

    name: str
    passed: bool
    value: float
    limit: float
    frames: tuple[int, ...] = ()
    says: str = ""
    whole: bool = False
    """the order of the whole sequence is in doubt: single retakes cannot mend it"""

    def as_dict(self) -> dict[str, Any]:
        """Plain data for capture.json."""
        return {
            "name": self.name,
            "passed": self.passed,
            "value": float(self.value),
            "limit": float(self.limit),
            "frames": list(self.frames),
            "says": self.says,
        }


@dataclass(frozen=True)
class Witnesses:
    """All findings of a capture, and what they could not have revealed."""

    items: tuple[Witness, ...] = ()
    cannot_reveal: tuple[str, ...] = ()
    dark: bool = False
    """nothing in view is lit by the projector: there is nothing to judge, nor to decode"""

    @property
    def suspects(self) -> tuple[int, ...]:
        """Positions of frames that content speaks against."""
        return tuple(sorted({frame for item in self.items if not item.passed for frame in item.frames}))

    @property
    def whole(self) -> bool:
        """Whether the order of the whole sequence is in doubt."""
        return any(item.whole and not item.passed for item in self.items)

    @property
    def passed(self) -> bool:
        """Whether nothing speaks against the plan."""
        return not self.dark and all(item.passed for item in self.items)

    def joined(self, other: Witnesses) -> Witnesses:
        """The findings of two repetitions together."""
        cannot = tuple(dict.fromkeys((*self.cannot_reveal, *other.cannot_reveal)))
        return Witnesses((*self.items, *other.items), cannot, self.dark or other.dark)

    def as_list(self) -> list[dict[str, Any]]:
        """Plain data for capture.json's `witnesses`."""
        return [item.as_dict() for item in self.items]


@dataclass(frozen=True, eq=False)
class Scene:
    """The thumbnails of one repetition as samples, and what all witnesses need to know of them."""

    sequence: PatternSequence
    frames: Mapping[int, Array]
    """by position: (P,) float32 grey levels"""
    shape: tuple[int, int]
    max_value: int
    noise: float
    """1-sigma of one sample, grey levels"""
    lit: NDArray[np.bool_]
    """(P,) pixels that the projector's light reaches"""
    contrast: float
    """what that light adds to the brightest half percent of pixels, grey levels"""

    def mean(self, position: int) -> float:
        """Mean level of a frame over the lit pixels."""
        return float(self.frames[position][self.lit].mean())


def witness(sequence: PatternSequence, thumbnails: Mapping[int, Pixels], max_value: int) -> Witnesses:
    """Question the frames of one repetition.

    Args:
        thumbnails: by position, (h, w) uint8 or uint16 each, all of one size; absent positions are missing frames.
        max_value: the camera's largest grey level.

    Returns:
        Every witness this sequence has. One-frame sequences have none, and nothing is revealed.
    """
    # The method's own witnesses build on the findings here.
    from scanner.sequencer.witness_fringes import fringe_witnesses  # noqa: PLC0415
    from scanner.sequencer.witness_gray import gray_witnesses  # noqa: PLC0415

    if len(sequence) < 2 or len(thumbnails) < 2:
        return Witnesses(cannot_reveal=("any fault of order: one frame has no order",))
    scene = look(sequence, thumbnails, max_value)
    if scene is None:
        return Witnesses(
            (Witness("light", False, 0.0, 0.0, says="no pixel changes with the projector's pattern"),), dark=True
        )
    items: list[Witness] = []
    cannot: list[str] = []
    items += _sentinels(scene, cannot)
    items += _white_and_black(scene)
    if sequence.pattern.method == "pmp":
        items += fringe_witnesses(scene, cannot)
    elif sequence.pattern.method == "gray":
        items += gray_witnesses(scene, cannot)
    return Witnesses(tuple(items), tuple(cannot))


def look(sequence: PatternSequence, thumbnails: Mapping[int, Pixels], max_value: int) -> Scene | None:
    """Take the thumbnails as samples: noise, lit pixels. None if no pixel changes beyond the noise."""
    frames = {p: pixels.reshape(-1).astype(np.float32) for p, pixels in sorted(thumbnails.items())}
    shape = next(iter(thumbnails.values())).shape
    noise = _noise(sequence, frames, (int(shape[0]), int(shape[1])))
    stack = np.stack(list(frames.values()))
    # The second largest minus the second smallest: one frame's outliers (a cosmic ray, a torn frame) light nothing.
    ranked = np.sort(stack, axis=0)
    spread = ranked[-2] - ranked[1] if len(stack) > 4 else ranked[-1] - ranked[0]
    contrast = float(np.quantile(spread, 0.995))
    # n normal samples range over about 2 sqrt(2 ln n) sigma.
    range_of_noise = 2 * float(np.sqrt(2 * np.log(len(stack)))) * noise
    if contrast < range_of_noise + NOISE_SIGMAS * noise:
        return None
    lit = spread > max(LIT_SHARE * contrast, range_of_noise + NOISE_SIGMAS * noise / 2)
    return Scene(sequence, frames, (int(shape[0]), int(shape[1])), max_value, noise, lit, contrast)


def sigma_between(a: Array, b: Array) -> float:
    """1-sigma of one sample from two frames of one picture (or how far two pictures differ, on the same scale).

    The largest twentieth of the differences, where something moved or a pixel is hot, is left out; a normal
    distribution keeps 0.871 of its rms without them. (A median would count whole grey levels.)
    """
    squares = np.sort((a - b) ** 2)[: max(1, int(0.95 * a.size))]
    return float(np.sqrt(squares.mean() / 2)) / 0.871


def equal_positions(sequence: PatternSequence) -> Iterable[tuple[float, tuple[int, ...]]]:
    """(light, positions) of the full-off and the full-on frames."""
    levels: dict[float, list[int]] = {0.0: [], 1.0: []}
    for position, level in zip(sequence.sentinels, SENTINELS_BEFORE + SENTINELS_AFTER, strict=False):
        levels[level].append(position)
    if sequence.black is not None:
        levels[0.0].append(sequence.black)
    if sequence.white is not None:
        levels[1.0].append(sequence.white)
    return [(level, tuple(sorted(positions))) for level, positions in levels.items()]


def _noise(sequence: PatternSequence, frames: Mapping[int, Array], shape: tuple[int, int]) -> float:
    """Of the pairs of equal frames, full-on ones if there are any since they are noisier, the pair that differs least.

    A pair without any difference is one frame twice and says nothing. Planned equals may all be false, so no more is
    believed than the grain of differences between any frames shows. Never below rounding.
    """
    pairs = list(pairwise(sorted(frames)))
    pairs = pairs[:: -(-len(pairs) // 8)]
    grain = float(np.quantile([_grain(frames[a] - frames[b], shape) for a, b in pairs], 0.25))
    for _, positions in sorted(equal_positions(sequence), reverse=True):
        here = [p for p in positions if p in frames]
        found = [sigma_between(*_brighter(frames[a], frames[b])) for a, b in combinations(here, 2)]
        if found := [sigma for sigma in found if sigma > 0]:
            return max(min([*found, max(3 * grain, LEAST_NOISE)]), LEAST_NOISE)
    return max(grain, LEAST_NOISE)


def _grain(difference: Array, shape: tuple[int, int]) -> float:
    """1-sigma of one sample of two frames, from the roughness of their difference image.

    Second differences along rows and along columns, whichever is smoother: projected stripes are smooth along one of
    them, and a texture scales with the light, which varies slowly. Median absolute value of a normal / 0.6745; a
    second difference of the difference of two frames has 12 variances.
    """
    image = difference.reshape(shape)
    rough = [float(np.median(np.abs(np.diff(image, 2, axis=axis)))) for axis in (0, 1) if image.shape[axis] > 2]
    return min(rough, default=0.0) / 0.6745 / 12**0.5


def _brighter(a: Array, b: Array) -> tuple[Array, Array]:
    """The half of the pixels that is brighter, where there is noise to see."""
    both = a + b
    use = both >= np.median(both)
    return a[use], b[use]


# --- full-on and full-off frames ----------------------------------------------------------------------------------


def _sentinels(scene: Scene, cannot: list[str]) -> list[Witness]:
    """Levels and order of the sentinels: latency, direction, blends, and shifts of the whole sequence."""
    sequence = scene.sequence
    planned = dict(zip(sequence.sentinels, SENTINELS_BEFORE + SENTINELS_AFTER, strict=False))
    here = [p for p in sequence.sentinels if p in scene.frames]
    if len(here) < 4:
        cannot.append("frames that all come late by whole patterns (no sentinels)")
        return []
    levels, ambient = _levels(scene, planned)
    dark = min(SENTINEL_TOLERANCE, BLACK_TOLERANCE + FLICKER * ambient)
    off = {p: abs(levels[p] - planned[p]) / (SENTINEL_TOLERANCE if planned[p] else dark) for p in here}
    wrong = [p for p in here if off[p] > 1]
    worst = max(here, key=lambda p: off[p])
    value, limit = abs(levels[worst] - planned[worst]), SENTINEL_TOLERANCE if planned[worst] else dark
    if not wrong:
        return [Witness("sentinels", True, value, limit, says="black and white frames are where planned")]
    says, whole = _explain_sentinels(scene, levels, planned, wrong)
    return [Witness("sentinels", False, value, limit, tuple(wrong), says, whole)]


def _levels(scene: Scene, planned: Mapping[int, float]) -> tuple[dict[int, float], float]:
    """Level of every frame over the lit pixels, 0 = black, 1 = white; and the ambient light on that scale.

    The scale is set by the medians of planned blacks and whites if these stand apart, so that one false sentinel does
    not move it; else by the darkest and brightest frame there is.
    """
    means = {p: scene.mean(p) for p in scene.frames}
    black = float(np.median([means[p] for p, level in planned.items() if level == 0 and p in means] or [np.nan]))
    white = float(np.median([means[p] for p, level in planned.items() if level == 1 and p in means] or [np.nan]))
    low, high = min(means.values()), max(means.values())
    if not white - black > 0.75 * (high - low):
        black, white = low, high
    span = max(white - black, 1e-6)
    return {p: (mean - black) / span for p, mean in means.items()}, black / span


def _explain_sentinels(
    scene: Scene, levels: Mapping[int, float], planned: Mapping[int, float], wrong: Sequence[int]
) -> tuple[str, bool]:
    """What kind of disorder it is, and whether it concerns the whole sequence."""
    sequence, tolerance = scene.sequence, 2 * SENTINEL_TOLERANCE
    here = [p for p in sequence.sentinels if p in levels]
    if all(abs(levels[p] - (1 - planned[p])) < tolerance for p in here):
        return "the sequence runs backwards: sentinels are white where black was shown and the other way round", True
    for lag in (1, -1, 2, -2):
        # Beyond the sequence's ends nothing is known; among the fringes the mean lies between.
        expected = {p: planned[p - lag] for p in here if p - lag in planned}
        if len(expected) >= 3 and all(abs(levels[p] - level) < tolerance for p, level in expected.items()):
            side = "before" if lag > 0 else "after"
            count = "the pattern" if abs(lag) == 1 else f"the pattern {abs(lag)} places"
            return f"every frame shows {count} {side} its own: light comes later or earlier than planned", True
    if len(wrong) == 1:
        # A wholly false one is a stale or lost frame of its own; a blend is a matter of timing, which all share.
        blend = abs(levels[wrong[0]] - planned[wrong[0]]) < 1 - tolerance
        return f"sentinel {wrong[0]} is at {levels[wrong[0]]:.0%} of white, planned {planned[wrong[0]]:.0%}", blend
    partial = [p for p in wrong if tolerance < levels[p] < 1 - tolerance]
    if len(partial) >= 2:
        named = ", ".join(f"{p} at {levels[p]:.0%}" for p in partial)
        return f"sentinels are neither black nor white ({named} of white): exposures straddle the flips", True
    return f"sentinels {', '.join(map(str, wrong))} do not show the black or white that was planned", True


def _white_and_black(scene: Scene) -> list[Witness]:
    """The method's own white and black frame: they must bound all others."""
    sequence = scene.sequence
    white, black = sequence.white, sequence.black
    if white is None or black is None or white not in scene.frames or black not in scene.frames:
        return []
    others = [scene.mean(p) for p in scene.frames if sequence.role(p) in (FrameRole.FRINGE, FrameRole.BARS)]
    span = scene.mean(white) - scene.mean(black)
    middle = float(np.median(others)) - scene.mean(black) if others else span / 2
    if span <= 0:
        return [Witness("white and black", False, span, 0.0, (white, black), "white is not brighter than black")]
    share = middle / span
    # Every code or fringe image is half lit; a response bent by gamma 2.2 leaves a third.
    passed = 0.15 < share < 0.95
    says = f"the other frames are at {share:.0%} between black and white"
    return [Witness("white and black", passed, share, 0.95, () if passed else (white, black), says)]
