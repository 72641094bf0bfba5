"""Device nodes of the kernel: request numbers, calls, and errno turned into this project's errors. No driver itself.

Numbers follow `asm-generic/ioctl.h` as it is on x86-64 and arm64, and structures are those of a 64-bit kernel.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from scanner.errors import DeviceBusy, DeviceError, DeviceLost, DeviceNotFound, PermissionDenied

_WRITE, _READ = 1, 2
_SIZE_SHIFT, _DIRECTION_SHIFT, _TYPE_SHIFT = 16, 30, 8

_GONE = frozenset({errno.ENODEV, errno.ENXIO, errno.ESHUTDOWN})


def io(kind: str, number: int) -> int:
    """A request that carries nothing."""
    return ord(kind) << _TYPE_SHIFT | number


def ior(kind: str, number: int, carries: type) -> int:
    """A request that the kernel answers with `carries`, a ctypes type."""
    return _request(_READ, kind, number, carries)


def iow(kind: str, number: int, carries: type) -> int:
    """A request that gives the kernel `carries`."""
    return _request(_WRITE, kind, number, carries)


def iowr(kind: str, number: int, carries: type) -> int:
    """A request that gives `carries` and has it changed."""
    return _request(_WRITE | _READ, kind, number, carries)


class Node:
    """An open device node. Calls are repeated when a signal comes between; errors stay OSError for who knows better."""

    def __init__(self, path: str, name: str, *, group: str) -> None:
        """Open `path` for reading and writing, without blocking.

        Raises:
            DeviceNotFound, DeviceBusy, PermissionDenied: it cannot be opened. group: who may, for the hint.
        """
        self.path = path
        self.name = name
        try:
            self.fd = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NONBLOCK)
        except OSError as error:
            if error.errno in {errno.EACCES, errno.EPERM}:
                raise PermissionDenied(
                    f"this user may not open {path}",
                    device=name,
                    hint=f"join the group that owns it: adduser USER {group}, then log in again",
                ) from error
            if error.errno in {errno.ENOENT, errno.ENODEV, errno.ENXIO}:
                raise DeviceNotFound(
                    f"{path} is not there", device=name, hint="is it plugged in? `fringed devices` lists what is"
                ) from error
            raise device_error(error, "it cannot be opened", name) from error

    def call(self, request: int, argument: ctypes.Structure | ctypes.Union | ctypes.Array[ctypes.c_char] | int) -> int:
        """One ioctl; `argument` is changed in place.

        Raises:
            OSError: what the kernel said.
        """
        while True:
            try:
                if isinstance(argument, int):
                    return fcntl.ioctl(self.fd, request, argument)
                return int(fcntl.ioctl(self.fd, request, argument, True))
            except InterruptedError:
                continue

    @property
    def open(self) -> bool:
        """Whether it still is."""
        return self.fd >= 0

    def close(self) -> None:
        """Give the descriptor back. May be called twice."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1


def gone(error: OSError) -> bool:
    """Whether the kernel means that the device went away."""
    return error.errno in _GONE


def device_error(error: OSError, doing: str, device: str) -> DeviceError:
    """The error of this project that `error` is. doing: what failed, in words, as "the format cannot be set"."""
    said = f"{doing}: {os.strerror(error.errno or 0)}"
    if gone(error):
        return DeviceLost("the device went away", device=device, hint="plug it in again and repeat the scan")
    if error.errno == errno.EBUSY:
        return DeviceBusy(said, device=device, hint="another program uses it; end that one first")
    if error.errno in {errno.EACCES, errno.EPERM}:
        return PermissionDenied(said, device=device, hint="this user may open the device and not do that")
    return DeviceError(said, device=device, hint="`dmesg` may say more")


def holders(path: str) -> list[str]:
    """Processes that hold `path` open, as "name (pid)", this one left out; those of other users only root sees."""
    return sorted(set(_holders(os.path.realpath(path))))


def _holders(path: str) -> Iterator[str]:
    for process in Path("/proc").iterdir():
        if not process.name.isdigit() or int(process.name) == os.getpid():
            continue
        try:
            if any(os.path.realpath(link) == path for link in (process / "fd").iterdir()):
                yield f"{(process / 'comm').read_text().strip()} ({process.name})"
        except OSError:
            continue  # it ended while we looked, or is somebody else's


def _request(direction: int, kind: str, number: int, carries: type) -> int:
    return direction << _DIRECTION_SHIFT | ctypes.sizeof(carries) << _SIZE_SHIFT | ord(kind) << _TYPE_SHIFT | number
