"""The serial port, behind the one small face that the driver knows: bytes in, bytes out, and named errors.

pyserial stands behind it and nowhere else. A pty will do where a port does.
"""

from __future__ import annotations

import contextlib
import errno
import grp
import os
import termios
from pathlib import Path
from typing import Any, Protocol

import serial

from scanner.errors import ConfigError, DeviceBusy, DeviceError, DeviceLost, DeviceNotFound, PermissionDenied
from scanner.trigger_protocol import BAUD

READ_S = 0.05
"""A read without a byte returns after this long"""

WRITE_S = 0.5
"""A port that takes no byte for this long is lost"""


class Transport(Protocol):
    """What carries bytes to the board and back."""

    @property
    def name(self) -> str:
        """The port's name in messages."""

    def read(self) -> bytes:
        """What has come, after at most `READ_S`; b"" if nothing.

        Raises:
            DeviceLost: the port went away.
        """

    def write(self, data: bytes) -> None:
        """Send.

        Raises:
            DeviceLost: the port went away, or takes nothing.
        """

    def close(self) -> None:
        """Give the port back; may be called twice."""


class SerialTransport:
    """A tty at 115200 baud, 8N1, held for ourselves alone."""

    def __init__(self, path: str) -> None:
        """Open the port.

        Raises:
            DeviceNotFound, PermissionDenied, DeviceBusy, ConfigError: it cannot be opened; the hint says what to do.
        """
        self._path = path
        try:
            self._port: Any = serial.Serial(path, BAUD, timeout=READ_S, write_timeout=WRITE_S, exclusive=True)
            self._keep_up()
        except (OSError, termios.error) as error:  # SerialException is an OSError
            raise _cannot_open(path, error) from error

    def _keep_up(self) -> None:
        """Clear HUPCL: closing then leaves DTR as it is, and the next opening does not reset the board."""
        settings = termios.tcgetattr(self._port.fileno())
        settings[2] &= ~termios.HUPCL
        termios.tcsetattr(self._port.fileno(), termios.TCSANOW, settings)

    @property
    def name(self) -> str:
        """The port's path."""
        return self._path

    def read(self) -> bytes:
        """See `Transport.read`."""
        try:
            return bytes(self._port.read(max(1, self._port.in_waiting)))
        except (OSError, TypeError, termios.error) as error:  # TypeError: closed in the middle of a read
            raise self._lost(error) from error

    def write(self, data: bytes) -> None:
        """See `Transport.write`."""
        try:
            self._port.write(data)
        except serial.SerialTimeoutException as error:
            raise DeviceLost(
                "the port takes no bytes", device=self._path, hint="unplug the board and plug it in again"
            ) from error
        except (OSError, termios.error) as error:
            raise self._lost(error) from error

    def close(self) -> None:
        """Give the port back; may be called twice."""
        with contextlib.suppress(OSError, termios.error):  # one that is gone cannot be flushed
            self._port.close()

    def _lost(self, error: Exception) -> DeviceLost:
        return DeviceLost(f"the port went away ({error})", device=self._path, hint="plug the board in again")


def _cannot_open(path: str, error: OSError | termios.error) -> DeviceError | ConfigError:
    """What the kernel or pyserial said, as one of our errors."""
    number = error.errno if isinstance(error, OSError) else error.args[0]
    # pyserial raises its own error for a port somebody else has locked, and gives it the number of the lock's refusal.
    if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK):
        return DeviceBusy(
            "another program holds the port",
            device=path,
            hint=f"close it (a serial monitor, ModemManager); `fuser -v {path}` names it",
        )
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        return DeviceNotFound(
            "there is no such port", device=path, hint="plug the board in; `fringed devices` lists it"
        )
    if number in (errno.EACCES, errno.EPERM):
        group = _group_of(path)
        return PermissionDenied(
            f"this user may not open it (it belongs to the group {group})",
            device=path,
            hint=f"sudo usermod -aG {group} {_user()}, then log in again",
        )
    return ConfigError(f"this is no serial port ({error})", device=path, hint="give the board's tty, as /dev/ttyACM0")


def _group_of(path: str) -> str:
    try:
        return grp.getgrgid(Path(path).stat().st_gid).gr_name
    except (OSError, KeyError):
        return "dialout"


def _user() -> str:
    return os.environ.get("USER") or f"$(id -un {os.getuid()})"
