"""The one tree of errors. Each says what happened, on which device, and what to do about it (`hint`).

    ScannerError
    ├── ConfigError            a rig file, option or argument is wrong
    ├── DeviceError            a device failed
    │   ├── DeviceNotFound     it is not there
    │   ├── DeviceBusy         someone else holds it
    │   ├── DeviceLost         it went away while in use
    │   └── PermissionDenied   it is there, and this user may not open it
    ├── SyncError              frames and patterns are out of step
    ├── DecodeError            frames cannot be decoded, or contradict their description
    ├── CalibrationError       a calibration is missing, unusable or absurd
    ├── StorageError           a file or folder cannot be read or written whole
    └── ProtocolError          a message breaks the wire protocol
        └── Unreachable        nobody answers

The same code and hint cross the wire: see `scanner.wire`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar


class ScannerError(Exception):
    """Root of the tree.

    Args:
        message: what happened, in words a user can act on.
        device: the device concerned, if any.
        hint: what to do about it.
    """

    code: ClassVar[int] = -32000

    def __init__(self, message: str, *, device: str | None = None, hint: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.device = device
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.device}: {self.message}" if self.device else self.message

    def data(self) -> dict[str, Any]:
        """The error's details as plain data, for reports and the wire."""
        return {"class": type(self).__name__, "device": self.device, "hint": self.hint}


class ConfigError(ScannerError):
    """A rig file, option or argument is wrong."""

    code = -32001


class DeviceError(ScannerError):
    """A device failed."""

    code = -32002


class DeviceNotFound(DeviceError):
    """The device is not there."""

    code = -32003


class DeviceBusy(DeviceError):
    """Someone else holds the device."""

    code = -32004


class DeviceLost(DeviceError):
    """The device went away while in use."""

    code = -32005


class PermissionDenied(DeviceError):
    """The device is there, and this user may not open it."""

    code = -32006


class SyncError(ScannerError):
    """Frames and patterns are out of step.

    `frames` are the positions, in the pattern's frame list, of the frames that are not to be trusted.
    """

    code = -32007

    def __init__(
        self,
        message: str,
        *,
        frames: Sequence[int] = (),
        device: str | None = None,
        hint: str | None = None,
    ) -> None:
        super().__init__(message, device=device, hint=hint)
        self.frames = tuple(int(frame) for frame in frames)

    def data(self) -> dict[str, Any]:
        """The error's details, with the frames named."""
        return {**super().data(), "frames": list(self.frames)}


class DecodeError(ScannerError):
    """Frames cannot be decoded, or contradict their description."""

    code = -32008


class CalibrationError(ScannerError):
    """A calibration is missing, unusable or absurd."""

    code = -32009


class StorageError(ScannerError):
    """A file or folder cannot be read or written whole."""

    code = -32010


class ProtocolError(ScannerError):
    """A message breaks the wire protocol."""

    code = -32011


class Unreachable(ProtocolError):
    """Nobody answers at the endpoint."""

    code = -32012


def _tree(root: type[ScannerError]) -> dict[str, type[ScannerError]]:
    found = {root.__name__: root}
    for child in root.__subclasses__():
        found.update(_tree(child))
    return found


def from_data(message: str, data: Mapping[str, Any]) -> ScannerError:
    """The error that `ScannerError.data` described; an unknown class becomes a plain `ScannerError`."""
    kind = _tree(ScannerError).get(str(data.get("class")), ScannerError)
    device, hint = data.get("device"), data.get("hint")
    if issubclass(kind, SyncError):
        return kind(message, frames=data.get("frames", ()), device=device, hint=hint)
    return kind(message, device=device, hint=hint)
