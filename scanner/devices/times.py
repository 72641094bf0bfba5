"""Time stamps and durations as devices give them: CLOCK_MONOTONIC nanoseconds, each with a source and a bound."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Source(StrEnum):
    """Where a time stamp comes from."""

    HARDWARE = "hardware"
    """latched by the device or the kernel at the event itself"""
    DRIVER = "driver"
    """taken by a driver near the event, with a bound that holds"""
    ESTIMATED = "estimated"
    """computed or taken late: the bound is a belief"""


@dataclass(frozen=True)
class Interval:
    """A measured duration, ns: it lies in [low_ns, high_ns]."""

    low_ns: int
    high_ns: int

    def __post_init__(self) -> None:
        if self.low_ns > self.high_ns:
            raise ValueError(f"interval is upside down: {self.low_ns} > {self.high_ns}")


@dataclass(frozen=True)
class Exposure:
    """When a frame was exposed: first row's start to last row's end (so rolling readout is inside), ns."""

    start_ns: int
    end_ns: int
    bound_ns: int
    """each of the two times is true within +- bound_ns"""
    source: Source


@dataclass(frozen=True)
class Flip:
    """When scan-out of an image began, ns. Light follows after the projector's latency."""

    t_ns: int
    vblank: int
    """the display's own count of vertical blanks"""
    bound_ns: int
    source: Source
