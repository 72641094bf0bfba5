"""The end of the projected field, where blur mixes the dark beyond it into a phase: what decoding may still say there.

Within a blur's reach of the end a pixel sees more of the field's inside than of its outside, which is dark, and its
coordinate is drawn inward; pixels beyond the end, in the blur's tail, even show the field's last pixels. No noise
tells. What is drawn by how much follows from the blur alone: the light that reaches a pixel is a normal distribution
about the place that it looks at, cut off at the end, and its mean is what the phase tells. Where that place lies
beyond the end the pixel is left undecided; inside, its sigma is widened by the pull, since the pull is the same each
time. Coordinates are not corrected.

How wide the blur is, the fringes say: it takes more of the height of fine ones than of coarse ones. Nothing here looks
at frames. Where no coordinate is near an end, a look at a grid of pixels is all that is done.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from scanner.decode import Map, Reason
from scanner.decode.pmp_sample import Sample
from scanner.kernel import kernel
from scanner.patterns import PmpPattern
from scanner.patterns.description import Axis
from scanner.patterns.pmp import AMPLITUDE, MEAN

WIDER = 1.25
"""Of the blur that fringes tell: it differs over the image, and an end's is told by what lies beside it. The pull falls
so fast with distance that a blur a fifth too small covers half of the points."""

REACH = 4.0
"""Blurs from the end beyond which the pull is less than 1e-4 of a blur"""

MARGIN_SHARE, MARGIN_PX = 1 / 20, 32.0
"""From an end, share of the field and px, whichever is more: coordinates so near are looked at one by one. It is
several steps of the grid that looks for them, and all that the widest blur reaches (a hundredth of the field: fringes
that are worth projecting are gone by then)."""

GRID_POINTS = 1000
"""As many pixels are asked whether any is near. Only things smaller than a thousandth of the picture are missed, where
all of them lies near an end, and nothing around them does."""

LEAST_BLUR_PX = 1 / math.sqrt(12)
"""A projector pixel's own width"""

LEAST_LOST = 0.01
"""Of the height of fine fringes, that tells of a blur: a response and rounding change heights by as much"""

SHARP_PX = 1.0
"""Where nothing tells the blur: that of projector and camera in focus (.7 px each)"""

NEAR_SHARE = 1 / 4
"""Of the field, from an end: sampled pixels so near tell its blur, where they are NEAR_PIXELS"""

NEAR_PIXELS, FEWEST = 256, 16

LONGEST_TOLD_PX = 64.0
"""Period of fringes that are held against flat light: ambient light of a tenth of the projector's passes for a blur of
.07 of it"""

WORTH_A_WORD = 0.03
"""Of the decided pixels, drawn by more than their noise or left out: a field whose ends are in view has a hundredth"""

_TABLE_STEPS = 64
_TOGETHER = 64
_HALF_NORMAL_MEAN = math.sqrt(2 / math.pi)
"""Apparent distance, in blurs, of a place on the end itself"""

_NAN = np.float32(np.nan)
_VALUE, _BORDER = np.uint8(Reason.VALUE), np.uint8(Reason.BORDER)


@dataclass(frozen=True)
class Heights:
    """What tells a blur: how high fine fringes are over coarse ones at some pixels.

    pixels: (n,) intp. ratios: (n,) float32, 1 without blur. per_log_px2: variance of the blur, projector px squared,
    over -log of the ratio.
    """

    pixels: NDArray[np.intp]
    ratios: NDArray[np.float32]
    per_log_px2: float


@dataclass(frozen=True)
class FieldEnd:
    """What the ends of one axis did to its maps."""

    along: int
    """projector px of the field"""
    blur_px: tuple[float, float]
    """1-sigma by which sigmas are widened at the first and at the last end, projector px; 0 where none was asked for"""
    widened: int
    """pixels drawn inward by more than their noise"""
    left_out: int
    """pixels that look at places beyond an end, as far as their blur tells"""
    decided: int
    """pixels of the axis with a value, the widened ones among them"""

    def warning(self, axis: Axis) -> str | None:
        """What a user should know where it concerns more than a few points."""
        if self.widened + self.left_out <= WORTH_A_WORD * (self.decided + self.left_out):
            return None
        share, blur = (self.widened + self.left_out) / (self.decided + self.left_out), max(self.blur_px)
        return (
            f"{share:.0%} of the points along {axis} lie at the end of the projected field, where a blur of "
            f"{blur / WIDER:.1f} projector px draws them inward: {self.left_out} are left out, and sigmas of "
            f"{self.widened} are widened; focus the projector, or let its field end beyond what is scanned"
        )

    def as_dict(self) -> dict[str, Any]:
        """For report.json."""
        return {"along": self.along, "blur_px": list(self.blur_px), "widened": self.widened, "left_out": self.left_out}


def heights_of(pattern: PmpPattern, along: int, sample: Sample, half_contrast: Map | None = None) -> Heights | None:
    """Heights of the finest fringes over those of the coarsest; None where their ratio tells no blur.

    Fringes of frequency f keep exp(-2 pi^2 f^2 s^2) of their height in a blur of s, as a fraction of the field.

    Args:
        along: projector px of the field. sample: of the axis.
        half_contrast: (P,) float32, half of what white and black differ by, for a pattern of one frequency; None: the
            fringe's mean stands for it, to which ambient light adds.
    """
    frequencies = pattern.frequencies
    fine, coarse = (pick(range(len(frequencies)), key=lambda k: frequencies[k]) for pick in (max, min))
    there = sample.usable & (sample.mean > 0)
    pixels = (sample.runs[:, None] + np.arange(sample.mean.shape[1]))[there]
    height, lowest2 = sample.modulations[fine][there], frequencies[coarse] ** 2
    if fine != coarse:
        flat = sample.modulations[coarse][there]
    elif along / frequencies[fine] > LONGEST_TOLD_PX:
        return None
    else:
        level = sample.mean[there] if half_contrast is None else half_contrast[pixels]
        flat, lowest2 = level * np.float32(AMPLITUDE / MEAN), 0.0
    ratios = height / np.maximum(flat, np.float32(1e-3))
    return Heights(pixels, ratios, along**2 / (2 * math.pi**2 * (frequencies[fine] ** 2 - lowest2)))


def mind_ends(
    position: Map,
    sigma: Map,
    confidence: Map,
    reason: NDArray[np.uint8],
    width: int,
    along: int,
    heights: Callable[[], Heights | None],
    counts: NDArray[np.int64],
) -> FieldEnd | None:
    """Leave out what looks beyond an end of the field, and widen sigmas of what is drawn inward by it.

    Args:
        position, sigma, confidence: (P,) float32, reason: (P,) uint8, of one axis, as decided; changed in place. sigma
            may be empty, and is left out then.
        width: pixels a row. along: projector px of the field, which ends half a pixel before 0 and behind the last.
        heights: called where coordinates are near an end; None: nothing tells the blur.
        counts: (REASONS,) int64 pixels by reason, kept true.

    Returns:
        What was done; None where no coordinate is near an end.
    """
    boxes = boxes_near_ends(position, width, along)
    if not boxes:
        return None
    rows, seen = (-1, width), heights()
    blurs, changed, before = [0.0, 0.0], np.zeros(2, np.int64), int(counts[Reason.VALUE])
    for end, box in boxes.items():
        known, widest = blur_of(seen, position, along, end == 1)
        blurs[end] = WIDER * widest
        _mind(
            position.reshape(rows), sigma.reshape(rows), confidence.reshape(rows), reason.reshape(rows),
            box, along, end == 1, blurs[end] if known else LEAST_BLUR_PX, blurs[end], pulls(), changed,
        )  # fmt: skip
    left_out, widened = changed.tolist()
    counts[Reason.VALUE] -= left_out
    counts[Reason.BORDER] += left_out
    return FieldEnd(along, (blurs[0], blurs[1]), widened, left_out, before - left_out)


def boxes_near_ends(position: Map, width: int, along: int) -> dict[int, tuple[int, int, int, int]]:
    """Where coordinates are near an end: by end, 0 the first and 1 the last, (top, bottom, left, right) in pixels.

    Args:
        position: (P,) float32. width, along: see `mind_ends`.
    """
    grid, corners = _grid(position.size, along), np.empty((2, 4), np.int64)
    if not _near(position, width, *grid, corners):
        return {}
    height, around = position.size // width, 2 * grid[0]
    return {
        end: (max(top - around, 0), min(bottom + around, height), max(left - around, 0), min(right + around, width))
        for end, (top, bottom, left, right) in enumerate(corners.tolist())
        if bottom > top
    }


def margin_px(along: int) -> float:
    """From an end, projector px: coordinates farther in are not looked at."""
    return min(max(MARGIN_SHARE * along, MARGIN_PX), along / 2)


def blur_of(heights: Heights | None, position: Map, along: int, last: bool) -> tuple[bool, float]:
    """1-sigma of the blur at an end, projector px, on the safe side of what it is known by; and whether it is known to
    be more than a pixel's own width: where it is not, sigmas are widened, but nothing is left out for it.

    Args:
        position: (P,) float32, NaN where undecided. along: see `mind_ends`. last: the end of the highest coordinates.
    """
    if heights is None:
        return False, SHARP_PX
    room = position[heights.pixels] + np.float32(0.5)
    room = along - room if last else room
    # What the end itself has cut off keeps its fine fringes longer.
    clear, margin = margin_px(along) / 4, margin_px(along)
    inside = np.flatnonzero((room > clear) & (room < along - clear))
    near = inside[room[inside] < NEAR_SHARE * along]
    ratios = heights.ratios[near if near.size >= NEAR_PIXELS else inside]
    if ratios.size < FEWEST:
        return False, SHARP_PX
    middle = float(np.median(ratios))
    # A median's own error: 1.25 times a mean's, by the spread that the ratios' middle half has.
    error = 1.2533 * 1.4826 * float(np.median(np.abs(ratios - middle))) / math.sqrt(ratios.size)
    blurs = (
        math.sqrt(-math.log(min(max(ratio, 1e-6), 1.0)) * heights.per_log_px2) for ratio in (middle, middle - 2 * error)
    )
    likely, widest = (min(max(blur, LEAST_BLUR_PX), margin / (REACH * WIDER)) for blur in blurs)
    return likely > 2 * LEAST_BLUR_PX and middle < 1 - LEAST_LOST, widest


@cache
def pulls() -> NDArray[np.float32]:
    """(T,) pull by apparent distance from the end, in blurs, for distances from 0 to REACH + 1 in 1 / 64; not to be
    written into.

    Of a normal distribution about a place at distance u inside the end, cut off there, the mean lies at
    u + phi(u) / Phi(u) (Johnson, Kotz and Balakrishnan 1994, sec. 13.10.1).
    """
    u = np.linspace(-3.0, REACH + 1, 4001)
    pull = np.exp(-u * u / 2) / math.sqrt(2 * math.pi) / ndtr(u)
    return np.interp(np.arange((REACH + 1) * _TABLE_STEPS + 1) / _TABLE_STEPS, u + pull, pull).astype(np.float32)


def keep_pull(values: Map, sigma: Map, count: NDArray[np.uint16], told: Mapping[str, Any]) -> None:
    """Give sigmas of a mean of several decodings back what averaging has taken from the pull, which it leaves.

    Args:
        values: any shape, projector px, NaN where there is none. sigma: the same, changed in place.
        count: how many decodings each mean is of. told: of `FieldEnd.as_dict`.
    """
    first = values + np.float32(0.5)
    for room, blur in zip((first, told["along"] - first), told["blur_px"], strict=True):
        near = room < REACH * blur
        if blur > 0 and near.any():
            pull = blur * np.interp(room[near] / blur, np.arange(pulls().size) / _TABLE_STEPS, pulls())
            sigma[near] = np.hypot(sigma[near], pull * np.sqrt(1 - 1 / np.maximum(count[near], 1)))


def warm_up() -> None:
    """Compile what every scan comes to, and what only a view of the field's end does."""
    position, sigma, confidence = np.zeros((3, 4), np.float32)
    counts = np.zeros(len(Reason), np.int64)
    mind_ends(position, sigma, confidence, np.zeros(4, np.uint8), 2, 100, lambda: None, counts)


@lru_cache(maxsize=16)
def _grid(pixels: int, along: int) -> tuple[int, float, float]:
    """(pixels from one point to the next, coordinates below which and above which one is near an end)."""
    margin = margin_px(along)
    return max(math.isqrt(pixels // GRID_POINTS), 1), margin - 0.5, along - margin - 0.5


@kernel
def _near(position: Map, width: int, step: int, low: float, high: float, boxes: NDArray[np.int64]) -> bool:
    """Whether a grid of pixels meets coordinates near an end; boxes: (2, 4) top, bottom, left, right of those near the
    first end, and of those near the last."""
    height = position.size // width
    boxes[:, 0], boxes[:, 1], boxes[:, 2], boxes[:, 3] = height, 0, width, 0
    found = False
    for line in range((height + step - 1) // step):
        for place in range((width + step - 1) // step):
            # Sheared both ways: no straight edge passes between its lines.
            y, x = line * step + place * 5 % step, place * step + line * 7 % step
            if y < height and x < width:
                value = position[y * width + x]
                if value < low or value > high:
                    box = boxes[0] if value < low else boxes[1]
                    box[0], box[1] = min(box[0], y), max(box[1], y + 1)
                    box[2], box[3] = min(box[2], x), max(box[3], x + 1)
                    found = True
    return found


@kernel
def _mind(
    position: Map,
    sigma: Map,
    confidence: Map,
    reason: NDArray[np.uint8],
    box: tuple[int, int, int, int],
    along: int,
    last: bool,
    leaving: float,
    blur: float,
    pulls: NDArray[np.float32],
    changed: NDArray[np.int64],
) -> None:
    """One end's part of `mind_ends` within a box: top, bottom, left, right.

    leaving, blur: by which pixels are left out, and sigmas widened. changed: left out, widened, is added to.
    """
    top, bottom, left, right = box
    unit, most, least = np.float32(1 / blur), np.float32(REACH * blur), np.float32(_HALF_NORMAL_MEAN * leaving)
    for y in range(top, bottom):
        for begin in range(left, right, _TOGETHER):
            stretch = slice(begin, min(begin + _TOGETHER, right))
            if not _any_within(position[y, stretch], along, last, most):
                continue
            for x in range(begin, min(begin + _TOGETHER, right)):
                room = _room(position[y, x], along, last)
                if not (room < most and reason[y, x] == _VALUE):
                    continue
                if room < least:
                    changed[0] += 1
                    position[y, x], confidence[y, x], reason[y, x] = _NAN, np.float32(0), _BORDER
                    if sigma.size > 0:
                        sigma[y, x] = _NAN
                elif sigma.size > 0:
                    at = room * unit * np.float32(_TABLE_STEPS)
                    step = int(at)
                    pull = np.float32(blur) * (pulls[step] + (at - np.float32(step)) * (pulls[step + 1] - pulls[step]))
                    changed[1] += pull > sigma[y, x]
                    sigma[y, x] = np.sqrt(sigma[y, x] * sigma[y, x] + pull * pull)


@kernel
def _room(position: np.float32, along: int, last: bool) -> np.float32:
    """From an end of the field inward, projector px."""
    inside = position + np.float32(0.5)
    return np.float32(along) - inside if last else inside


@kernel
def _any_within(positions: Map, along: int, last: bool, most: np.float32) -> bool:
    # Without a way out of the loop: a vector at once is faster than one and then none.
    found = np.int32(0)
    for i in range(positions.size):
        found |= np.int32(_room(positions[i], along, last) < most)
    return bool(found)
