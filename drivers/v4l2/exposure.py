"""When a V4L2 frame was exposed, and for how long: the exposure control's units, and what a stamp says of the time.

Pure arithmetic, but for finding the control. No more is claimed than is known: flags say which instant a stamp is of,
drivers set them wrongly, and only a measured delay makes more than an estimate of them.
"""

from __future__ import annotations

from dataclasses import dataclass

from drivers.ioctl import Node
from drivers.v4l2 import controls
from drivers.v4l2.queue import Dequeued
from scanner.devices import Exposure, Source
from scanner.errors import DeviceError

STAMP_ROUNDING_NS = 1000
"""Stamps of v4l2_buffer are whole microseconds, cut off"""

EXPOSURE_UNIT_NS = 100_000
"""V4L2_CID_EXPOSURE_ABSOLUTE counts in 100 us"""


@dataclass(frozen=True)
class ExposureControl:
    """A control that sets the exposure, and its unit."""

    control: controls.Control
    unit_ns: int

    def bounds(self, period_ns: int) -> tuple[int, int, int]:
        """Shortest, longest and step, ns. No longer than a period: what is beyond it, the camera cuts off."""
        step = max(self.control.step, 1) * self.unit_ns
        lowest = self.control.minimum * self.unit_ns
        low = lowest if lowest > 0 else lowest + step * -(-(1 - lowest) // step)
        longest = min(self.control.maximum * self.unit_ns, period_ns)
        return low, low + max(0, longest - low) // step * step, step

    def units(self, exposure_ns: int) -> int:
        """The control's value for an exposure: the next shorter one that it has."""
        step = max(self.control.step, 1)
        above = max(0, exposure_ns // self.unit_ns - self.control.minimum)
        return self.control.minimum + above // step * step


def find(node: Node, unit_us: float | None) -> ExposureControl | None:
    """The control to use; None: the camera has none that can be set and whose unit is known."""
    by_id = {control.id: control for control in controls.controls(node).values()}
    absolute, own = by_id.get(controls.EXPOSURE_ABSOLUTE), by_id.get(controls.EXPOSURE)
    if absolute is not None and absolute.settable:
        return ExposureControl(absolute, round(1e3 * unit_us) if unit_us else EXPOSURE_UNIT_NS)
    if own is not None and own.settable and unit_us:
        return ExposureControl(own, round(1e3 * unit_us))
    return None


@dataclass(frozen=True)
class Stamping:
    """What turns a stamp into an exposure. All ns, but delay_us."""

    exposure_ns: int
    readout_ns: int
    period_ns: int
    rolling: bool
    delay_us: tuple[float, float] | None
    """measured: stamp minus start of the first row's exposure, [low, high]"""

    @property
    def source(self) -> Source:
        """Where the times come from."""
        return Source.ESTIMATED if self.delay_us is None else Source.DRIVER

    @property
    def bound_ns(self) -> int:
        """What every time keeps: half the measured delay's spread, or without one two periods, a belief."""
        if self.delay_us is None:
            return 2 * self.period_ns
        return round(500 * (self.delay_us[1] - self.delay_us[0])) + STAMP_ROUNDING_NS

    def exposure(self, taken: Dequeued, begun_ns: int, now_ns: int, device: str) -> Exposure:
        """The exposure of a frame that came back at `now_ns`, of a stream begun at `begun_ns`.

        Raises:
            DeviceError: the delay was measured, and this stamp is of another clock than it.
        """
        length = self.exposure_ns + (self.readout_ns if self.rolling else 0)
        # Clocks differ by seconds and more; drivers round by frames: vivid's stamps lie up to 1.4 periods ahead.
        slack = 2 * self.period_ns
        believable = taken.monotonic and begun_ns - slack <= taken.t_ns <= now_ns + slack
        if self.delay_us is not None:
            if not believable:
                raise DeviceError(
                    "the driver's time stamps are not of CLOCK_MONOTONIC",
                    device=device,
                    hint="take stamp_delay_us out of the rig file: without good stamps it means nothing",
                )
            start = taken.t_ns - round(500 * (self.delay_us[0] + self.delay_us[1]))
        elif not believable:
            start = now_ns - length
        elif taken.start_of_exposure:
            start = taken.t_ns
        else:  # end of frame: the last row was exposed, and all was read out
            start = taken.t_ns - self.exposure_ns - self.readout_ns
        return Exposure(start, start + length, self.bound_ns, self.source)
