"""A camera driver, whole and small: its device is a picture of a grey wedge. Put your device's calls in its place."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from scanner.clock import Clock
from scanner.devices import (
    CameraCapabilities,
    CameraFrame,
    CameraSettings,
    DeviceInfo,
    Exposure,
    Interval,
    Source,
    TriggerMode,
)
from scanner.errors import ConfigError, DeviceBusy, DeviceError, DeviceNotFound

WEDGE = np.tile(np.linspace(0, 255, 320), (240, 1))
CAPABILITIES = CameraCapabilities(
    width=320,
    height=240,
    bits=8,
    shutter="global",
    readout_ns=5_000_000,
    exposure_min_ns=10_000,
    exposure_max_ns=1_000_000_000,
    exposure_step_ns=1_000,
    min_gap_ns=5_000_000,
    trigger_modes=frozenset({TriggerMode.FREE, TriggerMode.SOFTWARE}),
    trigger_latency=Interval(0, 500_000),  # measured; None where it was not
    stamp=Source.ESTIMATED,  # HARDWARE only if the device itself stamps the exposure
    stamp_bound_ns=1_000_000,
)


class WedgeCamera:
    """A `scanner.devices.Camera`: global shutter, 320 x 240, free running or by software trigger."""

    def __init__(self, name: str, clock: Clock) -> None:
        self.name, self.capabilities = name, CAPABILITIES
        self._clock = clock
        self._exposure_ns = 10_000_000
        self._mode: TriggerMode | None = None
        self._closed = False
        self._starts: deque[int] = deque()  # of exposures begun and not yet popped
        self._free_ns = self._count = 0

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set and read back, while stopped."""
        self._check_open()
        if self._mode is not None:
            raise DeviceBusy("settings wait for a stop", device=self.name, hint="stop it first")
        c = self.capabilities
        asked = self._exposure_ns if settings.exposure_ns is None else settings.exposure_ns
        if not c.exposure_min_ns <= asked <= c.exposure_max_ns:
            raise ConfigError(f"exposure {asked / 1e3:g} us lies outside 10 .. 1000000 us", device=self.name)
        taken = CameraSettings(asked // c.exposure_step_ns * c.exposure_step_ns, 0.0, "Mono8", (0, 0, 320, 240))
        for setting in ("gain_db", "pixel_format", "region"):
            wanted, only = getattr(settings, setting), getattr(taken, setting)
            if wanted not in (None, only):
                raise ConfigError(f"{setting} {wanted} is not offered", device=self.name, hint=f"it has {only}")
        self._exposure_ns = taken.exposure_ns or asked
        return taken

    def start(self, mode: TriggerMode) -> None:
        """Begin to acquire."""
        self._check_open()
        if mode not in self.capabilities.trigger_modes:
            raise ConfigError(f"no trigger mode {mode}", device=self.name, hint="it has free and software")
        if self._mode is not None:
            raise DeviceBusy("the camera is acquiring already", device=self.name, hint="stop it first")
        self._mode, self._free_ns = mode, self._clock.now_ns()

    def trigger(self) -> None:
        """Start one exposure now, unless one is under way."""
        self._check_open()
        if self._mode is not TriggerMode.SOFTWARE:
            raise DeviceError("not started in mode software", device=self.name)
        if self._clock.now_ns() >= self._free_ns:
            self._expose()

    def pop(self, timeout_ns: int) -> CameraFrame | None:
        """The next frame, oldest first; None if none came in time."""
        self._check_open()
        if self._mode is None:
            raise DeviceError("the camera is not started", device=self.name)
        if self._mode is TriggerMode.FREE and not self._starts:
            self._expose()
        give_up_ns = self._clock.now_ns() + timeout_ns
        after_start_ns = self._exposure_ns + self.capabilities.readout_ns
        if not self._starts or self._starts[0] + after_start_ns > give_up_ns:
            self._clock.sleep_until(give_up_ns)
            return None
        self._clock.sleep_until(self._starts[0] + after_start_ns)
        start_ns = self._starts.popleft()
        self._count += 1
        pixels = (WEDGE * min(1.0, self._exposure_ns / 20e6)).astype(np.uint8)
        c = self.capabilities
        stamp = Exposure(start_ns, start_ns + self._exposure_ns, c.stamp_bound_ns, c.stamp)
        return CameraFrame(pixels, self._count, stamp)

    def stop(self) -> None:
        """End acquisition; frames not yet popped are gone."""
        self._mode = None
        self._starts.clear()

    def close(self) -> None:
        """Give the device back."""
        self.stop()
        self._closed = True

    def _expose(self) -> None:
        start_ns = max(self._clock.now_ns(), self._free_ns)
        self._starts.append(start_ns)
        self._free_ns = start_ns + self.capabilities.min_period_ns(self._exposure_ns)

    def _check_open(self) -> None:
        if self._closed:
            raise DeviceError("the camera is closed", device=self.name)


class WedgeDriver:
    """A `scanner.devices.CameraDriver` that also checks options without a device."""

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> WedgeCamera:
        """Open the camera."""
        for _, error in self.check(device, options):
            raise error
        if device not in ("", "0"):
            raise DeviceNotFound("there is no such wedge", device=device, hint='there is one: device = "0"')
        return WedgeCamera("wedge 0", clock)

    def discover(self) -> Sequence[DeviceInfo]:
        """The cameras that can be seen now."""
        return [DeviceInfo("wedge", "0", "camera", "grey wedge", {"size": [320, 240]})]

    def check(self, device: str, options: Mapping[str, Any]) -> Sequence[tuple[str, ConfigError]]:
        """What `open` would refuse, as far as that needs no device."""
        return [(key, ConfigError(f"unknown option {key!r}", device=device, hint="it has none")) for key in options]


driver = WedgeDriver()
