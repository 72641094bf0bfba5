"""The control channel of the simulated GigE Vision camera: GVCP, as messages in and messages out.

Discovery, reading and writing of registers and memory, who holds the control privilege and for how long without a
sign of life, and requests for packets to be sent again. No socket here: `gige` carries the bytes. Numbers: GigE
Vision 1.2, chapters 14 to 17.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

from drivers.simulated import gige_features as f
from drivers.simulated import gige_registers as r
from drivers.simulated.gige_registers import Refused, Registers

PORT = 3956
KEY = 0x42
ACK_REQUIRED = 0x01

DISCOVERY, RESEND, READ_REGISTER, WRITE_REGISTER, READ_MEMORY, WRITE_MEMORY = 0x02, 0x40, 0x80, 0x82, 0x84, 0x86
NOT_IMPLEMENTED, INVALID_HEADER = 0x8001, 0x800E
MEMORY_BYTES = 536
"""Most bytes of memory one message carries"""

Sender = tuple[str, int]


@dataclass(frozen=True)
class ResendRequest:
    """Packets `first` .. `last` of a block, wanted again."""

    block: int
    first: int
    last: int


class Control:
    """One camera's answers. Calls come from one thread."""

    def __init__(
        self,
        registers: Registers,
        resend: Callable[[ResendRequest], None],
        released: Callable[[], None],
        now_ns: Callable[[], int],
    ) -> None:
        """resend: told of each request for packets. released: told when the controlling client is gone."""
        self._registers = registers
        self._resend = resend
        self._released = released
        self._now_ns = now_ns
        self._controller: Sender | None = None
        self._heard_ns = 0
        registers.on_write(r.CONTROL_PRIVILEGE, self._set_privilege)
        self._sender: Sender = ("", 0)

    @property
    def controller(self) -> Sender | None:
        """Who holds the control privilege."""
        return self._controller

    def answer(self, message: bytes, sender: Sender) -> bytes | None:
        """The answer to one message; None where there is none to give."""
        if len(message) < 8 or message[0] != KEY:
            return None
        flags, command, length, number = struct.unpack_from(">BHHH", message, 1)
        body = message[8 : 8 + length]
        self.check_heartbeat()
        if sender == self._controller:
            self._heard_ns = self._now_ns()
        self._sender = sender
        if command == RESEND:
            self._take_resend(body)
            return None
        try:
            content, status = self._obey(command, body), 0
        except Refused as refused:
            content, status = b"", refused.status
        except struct.error:
            content, status = b"", INVALID_HEADER
        if command != DISCOVERY and not flags & ACK_REQUIRED:
            return None
        return struct.pack(">HHHH", status, command + 1, len(content), number) + content

    def check_heartbeat(self) -> None:
        """Take the privilege from a client that was silent for longer than it said it would be."""
        timeout_ns = self._registers.word(f.HEARTBEAT_TIMEOUT) * 1_000_000
        if self._controller is not None and self._now_ns() - self._heard_ns > timeout_ns:
            self._release()

    def _obey(self, command: int, body: bytes) -> bytes:
        if command == DISCOVERY:
            return self._registers.read(0, r.DISCOVERY_BYTES)
        if command == READ_REGISTER:
            return b"".join(self._read(address, 4) for (address,) in struct.iter_unpack(">I", body))
        if command == WRITE_REGISTER:
            pairs = list(struct.iter_unpack(">I4s", body))
            for address, content in pairs:
                self._write(address, content)
            return struct.pack(">HH", 0, len(pairs))
        if command == READ_MEMORY:
            address, _, count = struct.unpack(">IHH", body)
            if count > MEMORY_BYTES:
                raise Refused(r.INVALID_PARAMETER)
            return body[:4] + self._read(address, count)
        if command == WRITE_MEMORY:
            (address,) = struct.unpack_from(">I", body)
            self._write(address, body[4:])
            return struct.pack(">HH", 0, len(body) - 4)
        raise Refused(NOT_IMPLEMENTED)

    def _read(self, address: int, size: int) -> bytes:
        if self._controller not in (None, self._sender) and self._registers.word(r.CONTROL_PRIVILEGE) & r.EXCLUSIVE:
            raise Refused(r.ACCESS_DENIED)
        return self._registers.read(address, size)

    def _write(self, address: int, content: bytes) -> None:
        # Without the privilege only the privilege itself may be written, and that only while nobody holds it.
        if self._controller != self._sender and (self._controller is not None or address != r.CONTROL_PRIVILEGE):
            raise Refused(r.ACCESS_DENIED)
        self._registers.write(address, content)

    def _set_privilege(self, value: int) -> None:
        if value & (r.CONTROL | r.EXCLUSIVE):
            self._controller, self._heard_ns = self._sender, self._now_ns()
        else:
            self._release()

    def _release(self) -> None:
        if self._controller is not None:
            self._controller = None
            self._registers.set_word(r.CONTROL_PRIVILEGE, 0)
            self._released()

    def _take_resend(self, body: bytes) -> None:
        if len(body) >= 12:
            _, block, first, last = struct.unpack_from(">HHII", body)
            self._resend(ResendRequest(block, first & 0xFFFFFF, last & 0xFFFFFF))
