"""What a camera is and can do, the settings it takes and the frames it gives."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from scanner.devices.times import Exposure, Interval, Source

Pixels = NDArray[np.uint8] | NDArray[np.uint16]


class TriggerMode(StrEnum):
    """What starts an exposure."""

    FREE = "free"
    SOFTWARE = "software"
    HARDWARE = "hardware"


@dataclass(frozen=True)
class CameraCapabilities:
    """What a camera can do, in its present region and pixel format."""

    width: int
    height: int
    bits: int
    """significant bits a pixel, right-aligned"""
    shutter: Literal["global", "rolling"]
    readout_ns: int
    """rolling: first row's start to last row's start; global: duration of the transfer"""
    exposure_min_ns: int
    exposure_max_ns: int
    exposure_step_ns: int
    min_gap_ns: int
    """shortest time from the end of one exposure to the start of the next; see `min_period_ns`"""
    trigger_modes: frozenset[TriggerMode]
    trigger_latency: Interval | None = None
    """software trigger call to first row's start"""
    line_latency: Interval | None = None
    """edge on the trigger line to first row's start (mode HARDWARE)"""
    stamp: Source = Source.ESTIMATED
    stamp_bound_ns: int = 1_000_000
    gain_min_db: float = 0.0
    gain_max_db: float = 0.0
    mosaic: str | None = None

    @property
    def max_value(self) -> int:
        """Largest grey level."""
        return (1 << self.bits) - 1

    def min_period_ns(self, exposure_ns: int) -> int:
        """Shortest time between the starts of two exposures, ns."""
        return exposure_ns + self.min_gap_ns


@dataclass(frozen=True)
class CameraSettings:
    """What a camera is told before a run. None leaves the device's value."""

    exposure_ns: int | None = None
    gain_db: float | None = None
    pixel_format: str | None = None
    region: tuple[int, int, int, int] | None = None
    """x, y, width, height in sensor pixels"""


@dataclass(frozen=True)
class CameraFrame:
    """One frame as the camera delivered it.

    `pixels` are lent: valid until the next `pop` or `stop` of the camera; whoever needs them longer copies them.
    """

    pixels: Pixels
    """(height, width) uint8 or uint16, right-aligned, C-contiguous"""
    frame_id: int
    """the device's own count, as it gave it (may wrap)"""
    exposure: Exposure
    complete: bool = True
    trigger: int | None = None
    """number of the trigger that started it, from 0 at `start`, where the device counts them; those that a busy
    camera dropped are counted too"""


@runtime_checkable
class Camera(Protocol):
    """A camera. Opened by its driver's `open_camera`, with automatic functions off."""

    @property
    def name(self) -> str:
        """The device's name in messages."""

    @property
    def capabilities(self) -> CameraCapabilities:
        """What it can do with the settings last applied."""

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set and read back, while stopped. Returns what the device took.

        Raises:
            ConfigError: a value outside the capabilities, named with its bounds.
        """

    def start(self, mode: TriggerMode) -> None:
        """Begin to acquire; frames from before are gone."""

    def trigger(self) -> None:
        """Start one exposure now (mode SOFTWARE). A camera that is busy drops it, as real ones do."""

    def pop(self, timeout_ns: int) -> CameraFrame | None:
        """The next frame, oldest first; None if none came in `timeout_ns`.

        Raises:
            DeviceLost: the camera went away.
        """

    def stop(self) -> None:
        """End acquisition. May be called twice."""

    def close(self) -> None:
        """Give the device back. May be called twice."""
