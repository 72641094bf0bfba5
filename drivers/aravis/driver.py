"""What the registry opens: the driver for GigE Vision and USB3 Vision cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from drivers.aravis.camera import AravisCamera
from drivers.aravis.find import find_cameras
from drivers.aravis.library import aravis
from drivers.aravis.options import AravisOptions
from drivers.option_table import option_problems, read_options
from scanner.clock import Clock
from scanner.devices import DeviceInfo
from scanner.errors import ConfigError

DRIVER = "aravis"


class AravisDriver:
    """Entry point of the group `fringed.cameras`. Device strings: `find.open_camera`; the table: `options`."""

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> AravisCamera:
        """Open a camera; see `scanner.devices.CameraDriver.open`.

        Raises:
            ConfigError: the library is missing, or an option is wrong.
            DeviceNotFound, DeviceBusy, PermissionDenied: it cannot be opened.
        """
        aravis()
        return AravisCamera(device, read_options(AravisOptions, options, device or DRIVER), clock)

    def check(self, device: str, options: Mapping[str, Any]) -> Sequence[tuple[str, ConfigError]]:
        """See `scanner.devices.ChecksOptions.check`."""
        return option_problems(AravisOptions, options, device or DRIVER)

    def discover(self) -> Sequence[DeviceInfo]:
        """The cameras that answer; none where the library is missing."""
        try:
            found = find_cameras()
        except ConfigError:
            return []
        return [
            DeviceInfo(
                driver=DRIVER,
                device=one.identity,
                kind="camera",
                model=f"{one.vendor} {one.model}".strip(),
                details={
                    "serial": one.serial,
                    "address": one.address,
                    "protocol": one.protocol,
                    "physical": one.physical,
                },
            )
            for one in found
        ]
