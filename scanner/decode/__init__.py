"""Frames to projector rows: the contract of every decoder, and the one that fits a pattern.

A decoder is given frames one at a time, in any order, as they arrive; what is left to do after the last one is
small. It knows the pattern and the camera's format, and no devices; MCP's may know the rig's calibration, as evidence.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from scanner.decode.stages import Observer
from scanner.errors import DecodeError
from scanner.patterns import (
    CameraFormat,
    CompositePattern,
    GrayPmpPattern,
    McpPattern,
    PatternSequence,
    PmpPattern,
)

if TYPE_CHECKING:  # it brings compiled kernels, which those who only ask for a decoder's name do without
    from scanner.geometry import Calibration

Map = NDArray[np.float32]
"""(H, W) float32, NaN where undecided"""


class Reason(IntEnum):
    """Why a pixel has no value (formats.md, Scan)."""

    VALUE = 0
    SHADOW = 1
    CLIPPED = 2
    LOW_MODULATION = 3
    UNWRAP_RISK = 4
    BORDER = 5
    OUT_OF_STEP = 6
    MOVED = 7
    FILTERED = 8


@dataclass(frozen=True)
class Decoded:
    """What a decoder found, on the camera's pixel grid (H, W). Invalid is NaN.

    rows and columns are projector coordinates seen at the pixel's centre, px; None where the axis was not
    projected. sigma_*: expected 1-sigma of their random error, px. confidence: 0..1, the estimated probability
    that the value is no wrong stripe or fringe. albedo, modulation: A and B in grey levels.
    """

    rows: Map | None
    columns: Map | None
    sigma_rows: Map | None
    sigma_columns: Map | None
    confidence: Map
    albedo: Map
    modulation: Map
    reason: NDArray[np.uint8]
    stripes: NDArray[np.int16] | None = None
    """MCP: index of the decoded stripe at the pixel nearest to its peak, -1 elsewhere"""
    peaks: NDArray[np.float32] | None = None
    """MCP: (M, 5) x, y, projector row or column, stripe index, confidence"""
    warnings: tuple[str, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)
    """counts, thresholds and figures for report.json, plain data"""


@dataclass(frozen=True)
class Coordinates:
    """What a scan is triangulated by and no more, (H, W) float32 each: as in `Decoded`."""

    rows: Map | None
    columns: Map | None
    confidence: Map
    warnings: tuple[str, ...]
    """of frames that are missing or out of step"""


class Decoder(Protocol):
    """One scan's decoder."""

    def add(self, position: int, frame: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
        """Take the frame at `position` of the pattern's frame list. The array is not kept.

        Raises:
            DecodeError: wrong size or dtype, or a position that was given before.
        """

    def finish(self) -> Decoded:
        """The maps, after the last frame.

        Raises:
            DecodeError: too few frames, or frames that contradict the description.
        """


@runtime_checkable
class KeepingDecoder(Decoder, Protocol):
    """A decoder that can work on frames where they lie."""

    def keep(self, position: int, frame: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
        """Like `add`, without a copy: the frame must not change before `finish` has returned."""


@runtime_checkable
class SeriesDecoder(Decoder, Protocol):
    """A decoder that may be used again: what one frame teaches (where the pattern is, how large) helps with the next.

    add, finish, next_frame, add, finish, ... Its maps are those of a new decoder but for what a search would have found
    anew; it searches again by itself when what it knows does not fit.
    """

    def next_frame(self) -> None:
        """Make ready for another frame list; frames taken so far are forgotten."""


@runtime_checkable
class PositionsDecoder(Decoder, Protocol):
    """A decoder that can give rows or columns alone, in less time: for those who use no other map."""

    def positions(self) -> Map:
        """In place of `finish`: its rows, or its columns where the pattern's axis is "x"; until the next call.

        Raises:
            DecodeError: as `finish`.
        """


DECODERS: Mapping[str, tuple[str, ...]] = {"mcp": ("default", "casey2011")}
"""Decoders by name, of methods that have more than the default one."""

WITH_STAGES = ("casey2011",)
"""Decoders that tell an observer their intermediate images."""


def require_decoder(method: str, name: str) -> None:
    """Raise DecodeError where a method has no decoder of this name."""
    if name not in DECODERS.get(method, ("default",)):
        others = ", ".join(f"{known} ({of})" for of, names in DECODERS.items() for known in names if known != "default")
        raise DecodeError(
            f"no decoder {name!r} for method {method!r}",
            hint=f"decoder: default (any method), {others}",
        )


def decoder_for(
    sequence: PatternSequence,
    camera: CameraFormat,
    name: str = "default",
    observer: Observer | None = None,
    mcp_phase: Mapping[str, Any] | None = None,
    calibration: Calibration | None = None,
) -> Decoder:
    """The decoder for a pattern.

    Args:
        sequence: what was projected.
        camera: the frames' format.
        name: "default", or a decoder of that method by name: "casey2011" for MCP, the dissertation's own.
        observer: told the intermediate images, if one is given.
        mcp_phase: a calibration's code-to-phase fit, if it has one. "casey2011" alone uses it: others know the rows.
        calibration: the rig's, if it has one, for MCP's default decoder: it tells the carriers' phases. Others do
            without.

    Raises:
        DecodeError: no such decoder for this method, or one that has no stages for the observer.
    """
    require_decoder(sequence.pattern.method, name)
    if observer is not None and name not in WITH_STAGES:
        raise DecodeError(
            f"decoder {name!r} has no stages to show",
            hint=f"decoders that have: {', '.join(f'--decoder {known}' for known in WITH_STAGES)} (method mcp)",
        )
    # Imported on demand: a program that decodes PMP does not pay for MCP's kernels.
    if name == "casey2011":
        from scanner.decode.mcp.casey2011 import CaseyDecoder  # noqa: PLC0415

        return CaseyDecoder(sequence, camera, observer, mcp_phase)
    if isinstance(sequence.pattern, PmpPattern):
        from scanner.decode.pmp import PmpDecoder  # noqa: PLC0415

        return PmpDecoder(sequence, camera)
    if isinstance(sequence.pattern, McpPattern):
        from scanner.decode.mcp import McpDecoder  # noqa: PLC0415

        return McpDecoder(sequence, camera, calibration)
    if isinstance(sequence.pattern, CompositePattern):
        from scanner.decode.composite import CompositeDecoder  # noqa: PLC0415

        return CompositeDecoder(sequence, camera)
    if isinstance(sequence.pattern, GrayPmpPattern):
        from scanner.decode.graypmp import GrayPmpDecoder  # noqa: PLC0415

        return GrayPmpDecoder(sequence, camera)
    from scanner.decode.graycode import GrayDecoder  # noqa: PLC0415

    return GrayDecoder(sequence, camera)
