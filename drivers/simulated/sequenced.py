"""The simulated pattern-mode controller: it runs a table of slots by itself, several patterns from one video frame.

Patterns are packed into the three colour planes of video frames, as such controllers take them over HDMI. A video
frame comes at a vertical blank; its slots run within it, one after the other, each dark and then lit; a slot longer
than a refresh keeps its frame for as many as it needs. Each slot's light has an edge on the output `exposure`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.simulated.options import Settings
from drivers.simulated.projector import STAMP_BOUND_NS, SimulatedProjector
from drivers.simulated.timeline import LoadedImage
from drivers.simulated.world import World
from scanner.devices import Flip, Image, Source, TableSlot
from scanner.errors import ConfigError, DeviceError

PLANES = 3
"""Patterns in a video frame: 8-bit greys in red, green and blue"""

LOADING_US = 100
"""Time that the controller needs at the beginning of a video frame before its first slot can be lit"""

SHORTEST_US = 50
LONGEST_US = 10_000_000


def pack(images: Sequence[Image]) -> list[NDArray[np.uint8]]:
    """Patterns in the planes of video frames, (H, W, 3) uint8 each: pattern i is plane i % 3 of frame i // 3."""
    frames = []
    for first in range(0, len(images), PLANES):
        frame = np.zeros((*images[first].shape, PLANES), np.uint8)
        for plane, image in enumerate(images[first : first + PLANES]):
            frame[..., plane] = image
        frames.append(frame)
    return frames


@dataclass(frozen=True)
class _Placed:
    """A slot in time: refreshes after the start at which its video frame comes, and when in it the slot begins, ns."""

    refresh: int
    offset_ns: int


class SimulatedSequencedProjector(SimulatedProjector):
    """A projector of kind sequencer; see `scanner.devices.SequencedProjector`."""

    def __init__(self, world: World, settings: Settings, name: str) -> None:
        super().__init__(world, settings, name)
        world.lines["exposure"] = self._exposure_output
        self._count = 0
        self._table: tuple[TableSlot, ...] = ()
        self._begun: list[Flip] = []

    def load(self, images: Sequence[Image]) -> None:
        """Pack the patterns into video frames and take them out as the controller does."""
        super().load(images)
        self._count = len(images)
        frames = pack(images)
        self._images = [
            LoadedImage(np.ascontiguousarray(frames[i // PLANES][..., i % PLANES])) for i in range(len(images))
        ]

    def program(self, table: Sequence[TableSlot]) -> None:
        """Load the table; see `scanner.devices.SequencedProjector.program`.

        Raises:
            ConfigError: a slot names no image, or has times outside the controller's.
        """
        for i, slot in enumerate(table):
            if not 0 <= slot.image < self._count:
                raise ConfigError(f"slot {i} shows image {slot.image}, {self._count} are loaded", device=self._name)
            if not SHORTEST_US <= slot.exposure_us <= LONGEST_US or not 0 <= slot.dark_us <= LONGEST_US:
                raise ConfigError(
                    f"slot {i}: {slot.exposure_us} us of light after {slot.dark_us} us of dark cannot be set",
                    device=self._name,
                    hint=f"light lasts {SHORTEST_US} .. {LONGEST_US} us, dark 0 .. {LONGEST_US} us",
                )
        self._table = tuple(table)

    def start(self) -> None:
        """Run the table once, from the next vertical blank on.

        Raises:
            DeviceError: there is no table.
            DeviceLost: the display went away.
        """
        self._check_open()
        if not self._table:
            raise DeviceError("nothing is programmed", device=self._name, hint="load a table before starting")
        refresh, vblank = self._options.refresh_ns, self._next_vblank()
        self._begun = []
        for i, (slot, placed) in enumerate(zip(self._table, _placed(self._table, refresh), strict=True)):
            begins = self._first_vblank_ns + (vblank + placed.refresh) * refresh + placed.offset_ns
            self._begun.append(Flip(begins, vblank + placed.refresh, STAMP_BOUND_NS, Source.HARDWARE))
            self._light(i, slot, begins + round(self._latency_ns))
            self._last_vblank = vblank + placed.refresh
            self._flips_since_open += 1

    def flips(self) -> Sequence[Flip]:
        """Starts of the slots' light run so far, less its latency."""
        now = self._clock.now_ns()
        return [flip for flip in self._begun if flip.t_ns <= now]

    def _light(self, i: int, slot: TableSlot, on_ns: int) -> None:
        """One slot's light, with the faults that befall it."""
        if i in self._faults.skip and self._allowance.take("skip"):
            return
        self._world.timeline.show(on_ns, self._images[slot.image])
        if slot.emit_trigger:
            self._exposure_output.add(on_ns)
        self._world.timeline.show(on_ns + 1000 * slot.exposure_us, None)


def _placed(table: Sequence[TableSlot], refresh_ns: int) -> list[_Placed]:
    """Where slots lie: as many in a video frame as there are planes and time for."""
    found: list[_Placed] = []
    refresh, used, planes = 0, 1000 * LOADING_US, 0
    for slot in table:
        length = 1000 * (slot.dark_us + slot.exposure_us)
        if planes and (planes == PLANES or used + length > refresh_ns):
            refresh += -(-used // refresh_ns)
            used, planes = 1000 * LOADING_US, 0
        found.append(_Placed(refresh, used + 1000 * slot.dark_us))
        used, planes = used + length, planes + 1
    return found
