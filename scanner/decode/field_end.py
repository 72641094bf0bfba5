"""The end of the projected field, where blur mixes the dark beyond it into a phase: what decoding may still say there.

Within a blur's reach of the end a pixel sees more of the field's inside than of its outside, which is dark, and its
coordinate is drawn inward; pixels beyond the end, in the blur's tail, even show the field's last pixels. No noise
tells. What is drawn by how much follows from the blur alone: the light that reaches a pixel is a normal distribution
about the place that it looks at, cut off at the end, and its mean is what the phase tells. Where that place lies
beyond the end the pixel is left undecided; inside, its sigma is widened by the pull, since the pull is the same each
time. Coordinates are not corrected.

How wide the blur is, the fringes say: it takes more of the height of fine ones than of coarse ones. Nothing here looks
at frames, and at a map only where some coordinate is near an end: decoders tell how near (`far_rooms`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from scanner.decode import Map, Reason
from scanner.decode.middles import nth_of
from scanner.decode.pmp_kernels import ROOM_STRETCH
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
"""From an end, share of the field and px, whichever is more: coordinates so near are told by decoders. It is more than
all that the widest blur reaches (a hundredth of the field: fringes that are worth projecting are gone by then)."""

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
_HALF_NORMAL_MEAN = math.sqrt(2 / math.pi)
"""Apparent distance, in blurs, of a place on the end itself"""

_NAN = np.float32(np.nan)
_NO_MAP = np.empty(0, np.float32)
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
    lowest2, share, contrast = frequencies[coarse] ** 2, np.float32(1), _NO_MAP
    flat = sample.modulations[coarse]
    if fine == coarse:
        if along / frequencies[fine] > LONGEST_TOLD_PX:
            return None
        lowest2, share, flat = 0.0, np.float32(AMPLITUDE / MEAN), sample.mean
        contrast = _NO_MAP if half_contrast is None else half_contrast
    pixels, ratios = _ratios(
        sample.runs, sample.modulations[fine], flat, contrast, share, sample.mean, sample.usable,
    )  # fmt: skip
    return Heights(pixels, ratios, along**2 / (2 * math.pi**2 * (frequencies[fine] ** 2 - lowest2)))


def far_rooms(pixels: int) -> NDArray[np.float32]:
    """(2, n) float32, to be lowered by a decoder: projector px from the field's first and last end to the nearest pixel
    of each ROOM_STRETCH that has a coordinate, where any is nearer than `margin_px`; more where none is."""
    return np.full((2, -(-pixels // ROOM_STRETCH)), np.inf, np.float32)


def rooms_of(position: Map, along: int) -> NDArray[np.float32]:
    """`far_rooms` of a whole map, for a decoder that does not tell. position, along: see `mind_ends`."""
    rooms = far_rooms(position.size)
    _lower(position, along, rooms)
    return rooms


def mind_ends(
    position: Map,
    sigma: Map,
    confidence: Map,
    reason: NDArray[np.uint8],
    rooms: NDArray[np.float32],
    along: int,
    heights: Callable[[], Heights | None],
    counts: NDArray[np.int64],
) -> FieldEnd | None:
    """Leave out what looks beyond an end of the field, and widen sigmas of what is drawn inward by it.

    Args:
        position, sigma, confidence: (P,) float32, reason: (P,) uint8, of one axis, as decided; changed in place. sigma
            may be empty, and is left out then.
        rooms: (2, n) float32, no more than what `far_rooms` says. along: projector px of the field, which ends half a
            pixel before 0 and behind the last.
        heights: called where coordinates are near an end; None: nothing tells the blur.
        counts: (REASONS,) int64 pixels by reason, kept true.

    Returns:
        What was done; None where no coordinate is near enough to an end.
    """
    # Farther in than the widest blur's reach: of sigmas, or, where there are none, of what is left out.
    reach = margin_px(along) * (1 if sigma.size else _HALF_NORMAL_MEAN / REACH)
    near = [end for end in (0, 1) if rooms[end].min() < reach]
    if not near:
        return None
    seen, blurs, changed, before = heights(), [0.0, 0.0], np.zeros(2, np.int64), int(counts[Reason.VALUE])
    for end in near:
        known, widest = blur_of(seen, position, along, end == 1)
        blurs[end] = WIDER * widest
        _mind(
            position, sigma, confidence, reason, rooms[end], along, end == 1,
            blurs[end] if known else LEAST_BLUR_PX, blurs[end], pulls(), changed,
        )  # fmt: skip
    left_out, widened = changed.tolist()
    counts[Reason.VALUE] -= left_out
    counts[Reason.BORDER] += left_out
    return FieldEnd(along, (blurs[0], blurs[1]), widened, left_out, before - left_out)


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
    # What the end itself has cut off keeps its fine fringes longer.
    margin = margin_px(along)
    middle, error = _middle_ratio(heights.pixels, heights.ratios, position, along, last, margin / 4, NEAR_SHARE * along)
    if error == np.inf:
        return False, SHARP_PX
    blurs = (
        math.sqrt(-math.log(min(max(ratio, 1e-6), 1.0)) * heights.per_log_px2) for ratio in (middle, middle - 2 * error)
    )
    likely, widest = (min(max(blur, LEAST_BLUR_PX), margin / (REACH * WIDER)) for blur in blurs)
    return bool(likely > 2 * LEAST_BLUR_PX and middle < 1 - LEAST_LOST), widest


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
    position, sigma, confidence = np.zeros((3, 64), np.float32)
    sample = np.ones((2, 32), np.float32)
    pixels, ratios = _ratios(
        np.array([0, 32]), sample, sample, _NO_MAP, np.float32(1), sample, np.ones(sample.shape, np.bool_)
    )
    counts = np.zeros(len(Reason), np.int64)
    mind_ends(
        position, sigma, confidence, np.zeros(64, np.uint8), rooms_of(position, 100), 100,
        lambda: Heights(pixels, ratios, 50.0), counts,
    )  # fmt: skip


@kernel
def _ratios(
    runs: NDArray[np.intp],
    height: NDArray[np.float32],
    flat: NDArray[np.float32],
    contrast: Map,
    share: np.float32,
    mean: NDArray[np.float32],
    usable: NDArray[np.bool_],
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Pixels that are usable and lit, and their height over `share` of what is flat, or of the contrast if not empty.

    Args:
        runs: (R,) first pixels. height, flat, mean: (R, L) float32. contrast: (P,) or empty. usable: (R, L) bool.
    """
    pixels, ratios, count = np.empty(mean.size, np.intp), np.empty(mean.size, np.float32), 0
    for r in range(mean.shape[0]):
        for i in range(mean.shape[1]):
            if usable[r, i] and mean[r, i] > 0:
                whole = share * (contrast[runs[r] + i] if contrast.size > 0 else flat[r, i])
                pixels[count], ratios[count] = runs[r] + i, height[r, i] / max(whole, np.float32(1e-3))
                count += 1
    return pixels[:count], ratios[:count]


@kernel
def _middle_ratio(
    pixels: NDArray[np.intp],
    ratios: NDArray[np.float32],
    position: Map,
    along: int,
    last: bool,
    clear: float,
    near: float,
) -> tuple[float, float]:
    """Median of ratios at pixels farther than `clear` from both ends, and its error, infinite if these are too few; of
    those nearer than `near` to the one end, if these are enough."""
    inside, beside = np.empty(ratios.size, np.float32), np.empty(ratios.size, np.float32)
    count, nearer = 0, 0
    for i in range(ratios.size):
        room = _room(position[pixels[i]], along, last)
        if room > clear and room < along - clear:
            inside[count] = ratios[i]
            count += 1
            if room < near:
                beside[nearer] = ratios[i]
                nearer += 1
    of = beside[:nearer] if nearer >= NEAR_PIXELS else inside[:count]
    if of.size < FEWEST:
        return 1.0, np.inf
    middle = nth_of(of, of.size // 2)
    # A median's own error: 1.25 times a mean's, by the spread that the ratios' middle half has.
    spread = nth_of(np.abs(of - middle), of.size // 2)
    return float(middle), 1.2533 * 1.4826 * float(spread) / np.sqrt(of.size)


@kernel
def _lower(position: Map, along: int, rooms: NDArray[np.float32]) -> None:
    """See `rooms_of`."""
    for i in range(position.size):
        first, last = _room(position[i], along, False), _room(position[i], along, True)
        stretch = i // ROOM_STRETCH
        # The lesser of two of which one may be NaN.
        rooms[0, stretch], rooms[1, stretch] = np.fmin(rooms[0, stretch], first), np.fmin(rooms[1, stretch], last)


@kernel
def _mind(
    position: Map,
    sigma: Map,
    confidence: Map,
    reason: NDArray[np.uint8],
    rooms: NDArray[np.float32],
    along: int,
    last: bool,
    leaving: float,
    blur: float,
    pulls: NDArray[np.float32],
    changed: NDArray[np.int64],
) -> None:
    """One end's part of `mind_ends`.

    rooms: (n,) of the end. leaving, blur: by which pixels are left out, and sigmas widened. changed: left out, widened,
    is added to.
    """
    unit, most, least = np.float32(1 / blur), np.float32(REACH * blur), np.float32(_HALF_NORMAL_MEAN * leaving)
    for stretch in range(rooms.size):
        if rooms[stretch] >= most:
            continue
        for i in range(stretch * ROOM_STRETCH, min((stretch + 1) * ROOM_STRETCH, position.size)):
            room = _room(position[i], along, last)
            if not (room < most and reason[i] == _VALUE):
                continue
            if room < least:
                changed[0] += 1
                position[i], confidence[i], reason[i] = _NAN, np.float32(0), _BORDER
                if sigma.size > 0:
                    sigma[i] = _NAN
            elif sigma.size > 0:
                at = room * unit * np.float32(_TABLE_STEPS)
                step = int(at)
                pull = np.float32(blur) * (pulls[step] + (at - np.float32(step)) * (pulls[step + 1] - pulls[step]))
                changed[1] += pull > sigma[i]
                sigma[i] = np.sqrt(sigma[i] * sigma[i] + pull * pull)


@kernel
def _room(position: np.float32, along: int, last: bool) -> np.float32:
    """From an end of the field inward, projector px."""
    inside = position + np.float32(0.5)
    return np.float32(along) - inside if last else inside
