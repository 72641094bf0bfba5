"""What a projector is and can do, and the slots of a table that it, or a trigger board, runs by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from scanner.devices.times import Flip, Interval

Image = NDArray[np.uint8]


class ProjectorKind(StrEnum):
    """The three kinds of projector."""

    STATIC = "static"
    """a slide, or a pattern that stays on"""
    FRAMEBUFFER = "framebuffer"
    """one image per refresh or per `dwell` refreshes: HDMI, V4L2 output, a window"""
    SEQUENCER = "sequencer"
    """runs a table of slots by itself: pattern-mode controllers"""


@dataclass(frozen=True)
class ProjectorCapabilities:
    """What a projector can do. Unmeasured is None, never a guess."""

    kind: ProjectorKind
    width: int
    height: int
    refresh_ns: int
    """period of the vertical blank"""
    modulation_period_ns: int | None = None
    """a grey is built over this time (colour wheel, bit planes); None: the light is constant"""
    latency: Interval | None = None
    """from the flip's stamp to the change of light at the first row that changes"""
    settle: Interval | None = None
    """from then until every row shows the new image"""
    scan: Literal["global", "rows"] = "global"
    trigger_outputs: frozenset[Literal["frame", "exposure"]] = frozenset()


@runtime_checkable
class Projector(Protocol):
    """A display that the host flips: `static` and `framebuffer`. Opened by its driver's `open_projector`."""

    @property
    def name(self) -> str:
        """The device's name in messages."""

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """What it can do."""

    def load(self, images: Sequence[Image]) -> None:
        """Replace the images in the device's memory, before a run. images: (height, width) uint8 each.

        Raises:
            DeviceError: wrong size or no room.
        """

    def show(self, index: int) -> Flip:
        """Flip to loaded image `index` at the next vertical blank; returns once it happened.

        Raises:
            DeviceLost: the display went away.
        """

    def close(self) -> None:
        """Leave a black screen and give the device back. May be called twice."""


@dataclass(frozen=True)
class TableSlot:
    """One slot of a projector's or trigger board's own table."""

    image: int
    exposure_us: int
    dark_us: int
    bit_planes: int = 8
    colour: Literal["white", "red", "green", "blue"] = "white"
    wait_trigger: bool = False
    """a board: it begins at an edge of the source; else when the slot before it ends"""
    emit_trigger: bool = True
    edges: int = 1
    """with `wait_trigger` on a board: it begins at this edge, counted from the one that began the waiting slot before
    (the first slot: from arming); 2 is a pattern that stays on for two refreshes"""


@runtime_checkable
class SequencedProjector(Projector, Protocol):
    """A projector that runs a table of slots by itself and says when each began."""

    def program(self, table: Sequence[TableSlot]) -> None:
        """Load the table, after `load` and before `start`."""

    def start(self) -> None:
        """Run the table once."""

    def flips(self) -> Sequence[Flip]:
        """Starts of the slots run so far, in order."""
