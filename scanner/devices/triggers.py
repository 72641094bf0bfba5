"""What a trigger board is and can do, and what it reports of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, Protocol, runtime_checkable

from scanner.devices.projectors import TableSlot
from scanner.devices.times import Source


class TriggerSource(StrEnum):
    """What a board's table waits for."""

    INTERNAL = "INT"
    VSYNC = "VSYNC"
    EXTERNAL = "EXT"


@dataclass(frozen=True)
class TriggerCapabilities:
    """What a trigger board can do. A slot is dark for `dark_us`, then its pulse lasts `exposure_us`."""

    sources: frozenset[TriggerSource]
    max_steps: int
    """steps in its memory; a longer table must be repetitions of so many: see `scanner.trigger_table`"""
    max_repeats: int
    dark_min_us: int
    """shortest dark time of a slot: from the edge that begins it, or the end of the slot before"""
    exposure_min_us: int
    time_max_us: int
    """longest dark time and longest exposure"""
    jitter_ns: int
    """a pulse begins within +- this of its edge plus its dark time"""
    event_bound_ns: int = 500_000
    """events of pulses are true to this at worst; behind USB the clock's fit is good to a few tenths of a ms"""


@dataclass(frozen=True)
class TriggerEvent:
    """One exposure pulse that a board gave."""

    sequence: int
    """number of the run: how often the board was armed since it was opened, from 0"""
    step: int
    """position of the slot in the table that was programmed"""
    t_ns: int
    """when the pulse began"""
    bound_ns: int
    source: Source


@dataclass(frozen=True)
class TriggerFault:
    """What a board reported about the run since `arm`. All but `lost_events` end it, outputs low."""

    kind: Literal["missing_edge", "overrun", "lost_events", "reset"]
    """no edge within the board's time-out; an edge came that should have begun a slot while another ran; pulses came
    whose events did not; the board began anew"""
    message: str
    step: int | None = None
    """position of the slot concerned, in the table that was programmed"""
    t_ns: int | None = None


@runtime_checkable
class TriggerBoard(Protocol):
    """A board that runs a table of exposures on its own timer; the host never times a frame.

        idle --program--> idle --arm--> armed --first edge, or fire--> running --last slot over, abort, fault--> idle

    The last slot's end is not reported: it is known from its event. Opened by its driver's `open`, outputs low.
    """

    @property
    def name(self) -> str:
        """The device's name in messages."""

    @property
    def capabilities(self) -> TriggerCapabilities:
        """What it can do."""

    def program(self, table: Sequence[TableSlot], source: TriggerSource) -> None:
        """Load the whole table, while idle.

        Source INTERNAL: slots follow one another from `fire` on, and none may have `wait_trigger`. VSYNC, EXTERNAL:
        the first slot has it.

        Raises:
            ConfigError: a slot outside the capabilities, named with its bounds; a table that does not fit.
            DeviceBusy: a run is under way.
        """

    def arm(self) -> None:
        """Wait for the source; events and faults from before are gone. Edges count from when this returns at latest.

        Raises:
            DeviceError: nothing is programmed.
            DeviceBusy: a run is under way.
        """

    def fire(self) -> None:
        """Start the table now (source INTERNAL).

        Raises:
            DeviceError: the board is not armed, or its source is another.
        """

    def abort(self) -> None:
        """Stop, outputs low. Always works; the board is idle after it and keeps its table."""

    def events(self) -> Sequence[TriggerEvent]:
        """Pulses given since `arm`, in order. Those of the last milliseconds may still be on their way.

        Raises:
            DeviceLost: the board went away.
        """

    def faults(self) -> Sequence[TriggerFault]:
        """What went wrong since `arm`, in order.

        Raises:
            DeviceLost: the board went away.
        """

    def close(self) -> None:
        """Abort and give the device back. May be called twice."""
