"""The stream channel of the simulated GigE Vision camera: blocks of packets (GVSP), loss, and packets sent again.

A block is a leader, the payload in parts of equal size, and a trailer; the last few are kept for clients that ask for
lost packets. Loss is drawn by seed, packet by packet, for first and repeated ones alike. Numbers: GigE Vision 1.2,
chapters 23 and 24.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.simulated.gige_control import ResendRequest

LEADER, TRAILER, PAYLOAD = 1 << 24, 2 << 24, 3 << 24
IMAGE, EXTENDED_CHUNKS = 0x0001, 0x4000
OVERHEAD = 36
"""Bytes of a packet that are headers: IP 20, UDP 8, GVSP 8"""

RESENT_STATUS, UNAVAILABLE = 0x0100, 0x800C
KEPT_BLOCKS = 8
PACE_PACKETS = 8
"""Packets between two looks at the clock, where the stream is slower than the wire"""


@dataclass(frozen=True)
class Picture:
    """What one block says of itself."""

    pixel_format: int
    width: int
    height: int
    offset_x: int
    offset_y: int
    stamp: int
    """ticks of the camera's clock"""
    has_chunks: bool


@dataclass(frozen=True, eq=False)
class _Block:
    """One block in memory: the packets' headers (leader and trailer whole) and the payload."""

    headers: list[bytes]
    payload: memoryview
    part: int

    def packet(self, index: int) -> tuple[bytes, memoryview]:
        start = (index - 1) * self.part
        inside = 0 < index < len(self.headers) - 1
        return self.headers[index], self.payload[start : start + self.part] if inside else self.payload[:0]


@dataclass
class StreamCounts:
    """What the stream did since the camera was made."""

    blocks: int = 0
    packets: int = 0
    lost_packets: int = 0
    resent_packets: int = 0
    resend_requests: int = 0


class Stream:
    """Sends blocks to one client."""

    def __init__(self, address: str, loss: float, seed: int, link_bits_per_s: float) -> None:
        self.loss = loss
        self.counts = StreamCounts()
        self._random = np.random.default_rng([seed, 0x67766370])
        self._link = link_bits_per_s
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((address, 0))
        self._kept: OrderedDict[int, _Block] = OrderedDict()
        self._to: tuple[str, int] | None = None
        self._lock = threading.Lock()

    @property
    def source_port(self) -> int:
        """The port that packets come from."""
        port: int = self._socket.getsockname()[1]
        return port

    def aim(self, to: tuple[str, int] | None) -> None:
        """Send to this address from now on, or nowhere."""
        with self._lock:
            self._to = to
            self._kept.clear()

    def send(self, number: int, picture: Picture, payload: memoryview, packet_bytes: int, delay_s: float) -> None:
        """Send one block.

        Args:
            number: of the block, 1 .. 65535.
            picture: what it shows.
            payload: pixels and chunks; kept as it is until KEPT_BLOCKS more were sent.
            packet_bytes: a packet's size on the wire, headers included.
            delay_s: pause after each packet, as the client asked for.
        """
        block = _block(number, picture, payload, packet_bytes - OVERHEAD)
        with self._lock:
            to = self._to
            if to is None:
                return
            self._kept[number] = block
            while len(self._kept) > KEPT_BLOCKS:
                self._kept.popitem(last=False)
        self._send_paced(block, to, packet_bytes, delay_s)
        self.counts.blocks += 1

    def resend(self, request: ResendRequest) -> None:
        """Send packets of a kept block again; of one that is gone, say so."""
        self.counts.resend_requests += 1
        with self._lock:
            to, block = self._to, self._kept.get(request.block)
        if to is None:
            return
        if block is None:
            header = struct.pack(">HHI", UNAVAILABLE, request.block, PAYLOAD | request.first)
            self._socket.sendto(header, to)
            return
        for index in range(request.first, min(request.last, len(block.headers) - 1) + 1):
            header, part = block.packet(index)
            self.counts.resent_packets += 1
            self._send_packet(struct.pack(">H", RESENT_STATUS) + header[2:], part, to, self._is_lost(1)[0])

    def send_test(self, packet_bytes: int, to: tuple[str, int]) -> None:
        """The test packet by which a client finds the largest that arrives."""
        header = struct.pack(">HHI", 0, 0, PAYLOAD)
        self._socket.sendto(header.ljust(packet_bytes - 28, b"\0"), to)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _send_paced(self, block: _Block, to: tuple[str, int], packet_bytes: int, delay_s: float) -> None:
        lost = self._is_lost(len(block.headers))
        pause_s = delay_s + (8 * packet_bytes / self._link if self._link else 0.0)
        begun = time.monotonic()
        for index in range(len(block.headers)):
            header, part = block.packet(index)
            self._send_packet(header, part, to, bool(lost[index]))
            if pause_s and index % PACE_PACKETS == PACE_PACKETS - 1:
                ahead = begun + (index + 1) * pause_s - time.monotonic()
                if ahead > 0:
                    time.sleep(ahead)

    def _send_packet(self, header: bytes, part: memoryview, to: tuple[str, int], lost: bool) -> None:
        self.counts.packets += 1
        if lost:
            self.counts.lost_packets += 1
            return
        try:
            self._socket.sendmsg([header, part], [], 0, to)
        except (ConnectionRefusedError, BlockingIOError):
            self.counts.lost_packets += 1  # nobody listens, or the kernel is out of buffers: gone, as on a wire

    def _is_lost(self, count: int) -> NDArray[np.bool_]:
        if self.loss <= 0:
            return np.zeros(count, dtype=bool)
        return np.asarray(self._random.random(count) < self.loss)


def _block(number: int, picture: Picture, payload: memoryview, part: int) -> _Block:
    kind = IMAGE | (EXTENDED_CHUNKS if picture.has_chunks else 0)
    leader = struct.pack(
        ">HHIIIIIIIHH",
        0,
        kind,
        picture.stamp >> 32,
        picture.stamp & 0xFFFFFFFF,
        picture.pixel_format,
        picture.width,
        picture.height,
        picture.offset_x,
        picture.offset_y,
        0,
        0,
    )
    trailer = struct.pack(">HHI", 0, kind, picture.height)
    parts = -(-len(payload) // part)
    headers = [struct.pack(">HHI", 0, number, LEADER) + leader]
    headers += [struct.pack(">HHI", 0, number, PAYLOAD | index) for index in range(1, parts + 1)]
    headers.append(struct.pack(">HHI", 0, number, TRAILER | (parts + 1)) + trailer)
    return _Block(headers, payload, part)
