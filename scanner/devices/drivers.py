"""What opens devices: the objects that entry points name, found by `drivers.registry`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

from scanner.clock import Clock
from scanner.devices.cameras import Camera
from scanner.devices.projectors import Projector
from scanner.devices.triggers import TriggerBoard
from scanner.errors import ConfigError


@dataclass(frozen=True)
class DeviceInfo:
    """One device that a driver can see, for `fringed devices`."""

    driver: str
    device: str
    kind: Literal["camera", "projector", "trigger"]
    model: str
    details: dict[str, Any]


class CameraDriver(Protocol):
    """What an entry point of the group `fringed.cameras` names."""

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> Camera:
        """Open one camera. device: the rig file's string ("" = the first); options: the driver's own table.

        Raises:
            ConfigError: device or options make no sense to this driver.
            DeviceNotFound, DeviceBusy, PermissionDenied: it cannot be opened; the hint says what to do.
        """

    def discover(self) -> Sequence[DeviceInfo]:
        """The cameras this driver can see now. A missing library is an empty list, not an error."""


class ProjectorDriver(Protocol):
    """What an entry point of the group `fringed.projectors` names."""

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> Projector:
        """Open one projector; see `CameraDriver.open`."""

    def discover(self) -> Sequence[DeviceInfo]:
        """The projectors this driver can see now."""


class TriggerDriver(Protocol):
    """What an entry point of the group `fringed.triggers` names."""

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> TriggerBoard:
        """Open one trigger board; see `CameraDriver.open`."""

    def discover(self) -> Sequence[DeviceInfo]:
        """The boards this driver can see now."""


@runtime_checkable
class ChecksOptions(Protocol):
    """A driver that can judge what a rig file says to it without any device: `fringed check-config` asks."""

    def check(self, device: str, options: Mapping[str, Any]) -> Sequence[tuple[str, ConfigError]]:
        """What `open` would refuse, given the same, as far as that needs no device. Opens nothing.

        Returns:
            (option, error) each; option "" where it is the device string that makes no sense.
        """
