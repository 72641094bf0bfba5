"""The witnesses of full-on and full-off frames: sentinels, and a method's own white and black."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from scanner.patterns import FrameRole
from scanner.patterns.sequence import SENTINELS_AFTER, SENTINELS_BEFORE
from scanner.sequencer.findings import Scene, Witness, listed

SENTINEL_TOLERANCE = 0.05
"""Share of the contrast by which equal sentinels may differ. Lamps drift by 1-3 % in seconds and mains light adds as
much; a blend of two patterns by this share moves a phase by 0.05 x 2 pi / N at most, far from half a fringe."""

BLACK_TOLERANCE, FLICKER = 0.015, 0.1
"""The lamp does not shine on full-off frames: they may differ by so much, and by the flicker of the ambient light, of
which mains light has up to a tenth over exposures that are no multiple of its period."""


def level_witnesses(scene: Scene, cannot: list[str]) -> list[Witness]:
    """Findings of sentinels, white and black; what they could not have revealed is added to `cannot`."""
    return [*_sentinels(scene, cannot), *_white_and_black(scene)]


def _sentinels(scene: Scene, cannot: list[str]) -> list[Witness]:
    """Levels and order of the sentinels: latency, direction, blends, and shifts of the whole sequence."""
    sequence = scene.sequence
    planned = dict(zip(sequence.sentinels, SENTINELS_BEFORE + SENTINELS_AFTER, strict=False))
    here = [p for p in sequence.sentinels if p in scene.frames]
    if len(here) < 4:
        cannot.append("frames that all come late by whole patterns (no sentinels)")
        return []
    levels, ambient = _levels(scene, planned)
    if _clipped(scene, [p for p in here if planned[p]]) > 0.5:
        cannot.append("exposures that straddle the flips by little (full white is clipped)")
    dark = min(SENTINEL_TOLERANCE, BLACK_TOLERANCE + FLICKER * ambient)
    off = {p: abs(levels[p] - planned[p]) / (SENTINEL_TOLERANCE if planned[p] else dark) for p in here}
    wrong = [p for p in here if off[p] > 1]
    worst = max(here, key=lambda p: off[p])
    value, limit = abs(levels[worst] - planned[worst]), SENTINEL_TOLERANCE if planned[worst] else dark
    if not wrong:
        return [Witness("sentinels", True, value, limit, says="black and white frames are where planned")]
    says, whole = _explain_sentinels(scene, levels, planned, wrong)
    return [Witness("sentinels", False, value, limit, tuple(wrong), says, whole)]


def _clipped(scene: Scene, positions: Sequence[int]) -> float:
    """Share of the lit pixels at which all of these frames are at the camera's limit."""
    if not positions or not scene.lit.any():
        return 0.0
    least = np.min([scene.frames[p][scene.lit] for p in positions], axis=0)
    return float(np.mean(least >= scene.max_value))


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
    return f"sentinels {listed(wrong)} do not show the black or white that was planned", True


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
