"""The MCP pattern for a projector and a camera: axis, bits, carriers, and why each.

Carriers want to be high and far apart, so that small objects have all of them; blur and the pixels of both devices
set how high. Stripes want to be many, since every one is a row of measurement; their height in the camera sets how
many. What was tried of profiles and code orders, and why these, stands in docs/explanation/mcp.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

from scanner.errors import DecodeError
from scanner.patterns.description import Axis, ProjectorSize
from scanner.patterns.mcp import PERMUTED_CODES, McpPattern

BLUR_PX = 0.7
"""Sigma of the point spread taken for both devices, in their own pixels (the longer side of those that are not square):
a well-focused lens on either"""

SQUARE = 1.2
"""Ratio of a projector's pixels' sides, as the camera sees them, up to which they count as square: where the axes
converge by 30 degrees it is 1.15. A lens blurs to all sides alike: of pixels half as wide it takes twice as many."""

LEAST_MODULATION = 0.58
"""Share of the finest carrier's modulation that blur must leave: at a half its code bits drown where light is weak"""

FINEST = 222.0
NEAR = 0.01
"""Cycles of the finest carrier on the rig that figures are published of; within this share of it a rig gets the very
same carriers, so that it can be compared: focus changes by more"""

RATIOS = (98 / 222, 136 / 222, 185 / 222, 1.0)
"""Carriers relative to the finest: as far apart as an octave and a bit allows, none the sum or double of others
within a band's width, where a gamma that is not undone would put its harmonics (Casey 2011, fig. 3.28)"""

LEAST_PITCH_PX = 7.0
"""Camera pixels that a stripe should have. Tried on a rig whose stripes have 7.5: four bits left 0.05 % of a bust on a
wrong stripe, three bits 1.8 % and two 5 %, though their stripes are twice and four times as high: words count more"""

FEWEST_BITS, MOST_BITS = 2, 4
"""More than four carriers share the light of one stripe too thinly"""


@dataclass(frozen=True)
class McpChoice:
    """A pattern, and the reason of each of its values, in words."""

    pattern: McpPattern
    why: Mapping[str, str]


def choose_mcp(projector: ProjectorSize, axis: Axis, camera_scale: tuple[float, float] = (1.0, 1.0)) -> McpChoice:
    """The pattern to project.

    Args:
        projector: its size.
        axis: the axis that measures depth on this rig.
        camera_scale: camera pixels per projector pixel along the projector's x and y, at the working distance.

    Raises:
        DecodeError: the projector or the camera is too coarse for any.
    """
    why = {"axis": f"{axis}: the projected axis that moves with depth"}
    along, across = projector.along(axis), projector.along("x" if axis == "y" else "y")
    scale_along, scale_across = (camera_scale[1], camera_scale[0]) if axis == "y" else camera_scale
    finest = _finest(across, scale_across, scale_along / scale_across, why)
    bits = _bits(along, scale_along, why)
    problem: DecodeError | None = None
    for fewer in range(bits, FEWEST_BITS - 1, -1):
        try:
            pattern = McpPattern(axis, fewer, _carriers(finest, fewer), codes_of(fewer))
            pattern.validate(projector)
        except DecodeError as error:
            problem = error
            continue
        why["carriers"] += f"; {', '.join(f'{f:g}' for f in pattern.carriers)} cycles, {_gap(pattern):g} and more apart"
        why["profile"] = "triangle, all stripes equally bright: peaks stay whole under shading and none saturates first"
        why["codes"] = (
            "neighbours at distance 1, 2 and 3 differ in two bits or more"
            if fewer == MOST_BITS
            else "natural order: so few words leave no better one"
        )
        return McpChoice(pattern, why)
    raise DecodeError(
        f"a projector of {projector.width} x {projector.height}, of which a pixel has {scale_along:.2f} x "
        f"{scale_across:.2f} camera pixels, is too coarse for mcp" + (f": {problem}" if problem else ""),
        hint="move the camera nearer, take a camera of more pixels, or use pmp",
    )


def codes_of(bits: int) -> tuple[int, ...]:
    """The default order of the code words: neighbours far apart where an order is known, else the natural one."""
    return PERMUTED_CODES if bits == MOST_BITS else tuple(range(1 << bits))


def _finest(across: int, scale: float, longer: float, why: dict[str, str]) -> float:
    """Cycles of the finest carrier whose modulation survives both blurs: exp(-2 pi^2 s^2 (a^2 / p^2 + 1 / (p m)^2)).

    longer: side of a projector pixel along the axis over its side across; a is this where pixels are not SQUARE.
    """
    most = -math.log(LEAST_MODULATION) / (2 * math.pi**2 * BLUR_PX**2)
    wider = longer if longer > SQUARE else 1.0
    period = math.sqrt((wider**2 + 1 / scale**2) / most)
    why["carriers"] = (
        f"the finest has a period of {period:.1f} projector and {period * scale:.1f} camera pixels: focused lenses "
        f"({BLUR_PX:g} px) leave it {LEAST_MODULATION:.0%} of its modulation"
        + (f", projector pixels being {wider:.1f} times as long the other way" if wider > 1 else "")
    )
    finest = across / period
    return FINEST if abs(finest / FINEST - 1) < NEAR else finest


def _bits(along: int, scale: float, why: dict[str, str]) -> int:
    for bits in range(MOST_BITS, FEWEST_BITS - 1, -1):
        pitch = along / (1 << bits + 1)
        if pitch * scale >= LEAST_PITCH_PX or bits == FEWEST_BITS:
            why["bits"] = (
                f"{bits}: {1 << bits + 1} stripes of {pitch:.1f} projector and {pitch * scale:.1f} camera pixels"
            )
            return bits
    raise AssertionError("the fewest bits are always taken")


def _carriers(finest: float, bits: int) -> tuple[float, ...]:
    # A carrier that is whole but for the last digit of a float is whole.
    return tuple(float(math.floor(finest * ratio + 1e-6)) for ratio in RATIOS[-bits:])


def _gap(pattern: McpPattern) -> float:
    ordered = sorted(pattern.carriers)
    return min(high - low for low, high in pairwise(ordered))
