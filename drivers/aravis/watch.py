"""Notices in well under a second that a camera is gone; Aravis itself takes seconds.

A thread asks the camera for a sign of life a few times a second: a GigE camera for its control register, over a
socket of our own, so that a blocked library is no hindrance; any other by a short read through the library. Any
answer is life, a refusal, too; a register that says nobody controls the camera means that it began anew.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Protocol

PROBES = 4
"""Signs of life that must be missed, each waited for in full: a host that was busy itself loses no camera"""

GVCP_PORT = 3956
CONTROL_PRIVILEGE = 0x0A00
_READ_REGISTER, _READ_REGISTER_ACK = 0x0080, 0x0081
_IN_CONTROL = 0b11


class Probe(Protocol):
    """Asks one camera for a sign of life."""

    def alive(self, patience_s: float) -> bool:
        """Whether it answered within that time.

        Raises:
            Restarted: it did, and knows nothing of us any more.
        """

    def close(self) -> None:
        """Give back what it holds."""


class Restarted(Exception):
    """The camera answers, and is controlled by nobody: it lost its power, or dropped us."""


class GvcpProbe:
    """Reads the control register of a GigE camera over a socket of its own (GigE Vision 1.2, 16.2)."""

    def __init__(self, address: str) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._address = (address, GVCP_PORT)
        self._number = 0

    def alive(self, patience_s: float) -> bool:
        """See `Probe`."""
        self._number = self._number % 0xFFFF + 1
        request = struct.pack(">BBHHHI", 0x42, 0x01, _READ_REGISTER, 4, self._number, CONTROL_PRIVILEGE)
        until = time.monotonic() + patience_s
        try:
            # Each time: a network that went away and came back may have given this machine another address.
            self._socket.connect(self._address)
            self._send(request)
            while (left := until - time.monotonic()) > 0:
                self._socket.settimeout(left)
                answer = self._socket.recv(64)
                if len(answer) < 8 or struct.unpack_from(">H", answer, 6)[0] != self._number:
                    continue
                status, command = struct.unpack_from(">HH", answer)
                if status == 0 and command == _READ_REGISTER_ACK and len(answer) >= 12:
                    self._check_privilege(struct.unpack_from(">I", answer, 8)[0])
                return True
        except OSError:  # timed out, no way there, or the port is closed: nobody is there
            left = until - time.monotonic()
            if left > 0:
                time.sleep(left)
        return False

    def close(self) -> None:
        """See `Probe`."""
        self._socket.close()

    def _send(self, request: bytes) -> None:
        """The first send after an answer that the port is closed only tells that answer."""
        try:
            self._socket.send(request)
        except ConnectionRefusedError:
            self._socket.send(request)

    @staticmethod
    def _check_privilege(value: int) -> None:
        if not value & _IN_CONTROL:
            raise Restarted


class CallProbe:
    """Reads through the library: for cameras on USB, where a missing device fails at once."""

    def __init__(self, read: Callable[[], object], is_expected: Callable[[BaseException], bool]) -> None:
        self._read = read
        self._is_expected = is_expected

    def alive(self, patience_s: float) -> bool:
        """See `Probe`."""
        begun = time.monotonic()
        try:
            self._read()
        except Exception as error:
            if not self._is_expected(error):
                raise
            left = begun + patience_s - time.monotonic()
            if left > 0:
                time.sleep(left)
            return False
        return True

    def close(self) -> None:
        """See `Probe`."""


class Watch:
    """Calls `lost` once, from its own thread, when the camera is gone."""

    def __init__(self, probe: Probe, loss_s: float, lost: Callable[[str], None]) -> None:
        """loss_s: silence that means loss."""
        self._probe = probe
        self._patience_s = loss_s / PROBES
        self._loss_s = loss_s
        self._lost = lost
        self._ended = threading.Event()
        self._heard_ns = time.monotonic_ns()
        self._thread = threading.Thread(target=self._run, name="aravis watch", daemon=True)
        self._thread.start()

    def heard(self) -> None:
        """A frame came: that is life, too."""
        self._heard_ns = time.monotonic_ns()

    def close(self) -> None:
        """Stop watching."""
        self._ended.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=2 * self._loss_s)

    def _run(self) -> None:
        missed = 0
        with contextlib.closing(self._probe):
            while not self._ended.is_set():
                begun = time.monotonic_ns()
                try:
                    alive = self._probe.alive(self._patience_s)
                except Restarted:
                    self._tell("the camera has begun anew: it lost its power or its connection")
                    return
                missed = 0 if alive or self._heard_ns > begun else missed + 1
                if missed >= PROBES:
                    self._tell(f"the camera has not answered for {self._loss_s:.1f} s")
                    return
                if alive:
                    self._ended.wait(self._patience_s)

    def _tell(self, what: str) -> None:
        if not self._ended.is_set():
            self._ended.set()
            self._lost(what)
