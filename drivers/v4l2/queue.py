"""A node's queue of memory-mapped buffers, for capture and output alike: request, queue, dequeue, stream on and off.

A dequeued buffer belongs to the program until it is queued again; its bytes are the driver's own memory, not a copy.
Views of it stay valid memory after `release`, since each keeps its mapping alive.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import mmap
import select
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.ioctl import Node
from drivers.v4l2 import videodev2 as v
from drivers.v4l2.node import failure
from scanner.errors import DeviceError

SLICE_MS = 200
"""A wait is cut into pieces: not every driver wakes its sleepers when its device is pulled out"""


_HALF = 1 << 31


@dataclass(frozen=True)
class Dequeued:
    """A buffer that came back."""

    index: int
    bytes_used: int
    sequence: int
    """the driver's count of frames; a gap is a frame that never came"""
    t_ns: int
    """the driver's stamp, ns; what clock and which instant say the next two"""
    monotonic: bool
    start_of_exposure: bool
    damaged: bool


class FrameCount:
    """A driver's numbers as a count that always goes on, past the wrap at 2^32.

    Drivers that number frames by the clock (vivid; sensors behind some bridges) give two frames one number when a late
    one is followed by one in time: the second then takes the next number, and later ones their own again.
    """

    def __init__(self) -> None:
        self._raw: int | None = None
        self._unwrapped = 0
        self._last = -1
        self.frames = self.missing = 0
        """that were given a number; numbers between them that nobody had"""

    def next(self, sequence: int) -> int:
        """The count of the frame that the driver calls `sequence`."""
        step = 0 if self._raw is None else (sequence - self._raw + _HALF) % (2 * _HALF) - _HALF
        self._unwrapped = sequence if self._raw is None else self._unwrapped + step
        self._raw = sequence
        number = max(self._last + 1, self._unwrapped)
        self.missing += number - self._last - 1 if self.frames else 0
        self.frames += 1
        self._last = number
        return number


class BufferQueue:
    """Buffers of one node. The node stays the caller's."""

    def __init__(self, node: Node, kind: int, count: int) -> None:
        """Request `count` buffers (the driver may give more) and map them.

        Raises:
            DeviceBusy: somebody else has this node's buffers.
            DeviceError: the driver gives none.
        """
        self._node = node
        self._kind = kind
        self._poll = select.poll()
        self._poll.register(node.fd, select.POLLIN if _is_capture(kind) else select.POLLOUT)
        request = v.RequestBuffers(count=count, type=kind, memory=v.MEMORY_MMAP)
        self._call(v.REQBUFS, request, "buffers cannot be had")
        if not request.count:
            raise DeviceError("the driver gives no buffers", device=node.name)
        try:
            self.views: list[NDArray[np.uint8]] = [self._map(index) for index in range(request.count)]
        except DeviceError:
            self.release()
            raise

    def __len__(self) -> int:
        return len(self.views)

    def put(self, index: int, bytes_used: int = 0) -> None:
        """Give buffer `index` to the driver. bytes_used: of an output."""
        buffer, planes = self._buffer(index)
        buffer.field = v.FIELD_NONE
        if self._kind in v.MULTIPLANAR:
            planes[0].bytesused = bytes_used
        else:
            buffer.bytesused = bytes_used
        self._call(v.QBUF, buffer, "a buffer cannot be queued")

    def take(self, timeout_ms: int) -> Dequeued | None:
        """The oldest buffer that the driver is done with; None if there was none in time (at most SLICE_MS).

        Raises:
            DeviceLost: the device went away.
            DeviceError: the driver stopped streaming.
        """
        events = self._poll.poll(min(max(timeout_ms, 0), SLICE_MS))
        buffer, planes = self._buffer(0)
        try:
            self._node.call(v.DQBUF, buffer)
        except BlockingIOError:
            if events and events[0][1] & (select.POLLERR | select.POLLHUP):
                self.check_alive()
                raise DeviceError(
                    "the driver stopped streaming", device=self._node.name, hint="is the signal there? see `dmesg`"
                ) from None
            self.check_alive()
            return None
        except OSError as error:
            raise failure(error, "no frame can be had", self._node) from error
        return Dequeued(
            index=buffer.index,
            bytes_used=planes[0].bytesused if self._kind in v.MULTIPLANAR else buffer.bytesused,
            sequence=buffer.sequence,
            t_ns=buffer.tv_sec * 1_000_000_000 + buffer.tv_usec * 1000,
            monotonic=buffer.flags & v.BUF_FLAG_TIMESTAMP_MASK == v.BUF_FLAG_TIMESTAMP_MONOTONIC,
            start_of_exposure=buffer.flags & v.BUF_FLAG_TSTAMP_SRC_MASK == v.BUF_FLAG_TSTAMP_SRC_SOE,
            damaged=bool(buffer.flags & v.BUF_FLAG_ERROR),
        )

    def on(self) -> None:
        """Begin to stream."""
        self._call(v.STREAMON, ctypes.create_string_buffer(self._kind.to_bytes(4, "little"), 4), "streaming fails")

    def off(self) -> None:
        """End streaming; every buffer is the program's again. A device that is gone has ended by itself."""
        with contextlib.suppress(OSError):
            self._node.call(v.STREAMOFF, ctypes.create_string_buffer(self._kind.to_bytes(4, "little"), 4))

    def release(self) -> None:
        """Give the buffers back to the driver, so that others may have them."""
        self.views = []
        with contextlib.suppress(OSError):  # gone, or views are still held: closing the node does the rest
            self._node.call(v.REQBUFS, v.RequestBuffers(count=0, type=self._kind, memory=v.MEMORY_MMAP))

    def check_alive(self) -> None:
        """Raise DeviceLost if the device went away."""
        self._call(v.QUERYCAP, v.Capability(), "the device does not answer")

    def _map(self, index: int) -> NDArray[np.uint8]:
        buffer, planes = self._buffer(index)
        self._call(v.QUERYBUF, buffer, "a buffer cannot be looked at")
        multiplanar = self._kind in v.MULTIPLANAR
        length = planes[0].length if multiplanar else buffer.length
        offset = planes[0].m.mem_offset if multiplanar else buffer.m.offset
        try:
            mapping = mmap.mmap(self._node.fd, length, offset=offset)
        except (OSError, ValueError) as error:
            raise DeviceError(f"a buffer cannot be mapped: {error}", device=self._node.name) from error
        return np.frombuffer(mapping, dtype=np.uint8)

    def _buffer(self, index: int) -> tuple[v.Buffer, ctypes.Array[v.Plane]]:
        buffer = v.Buffer(index=index, type=self._kind, memory=v.MEMORY_MMAP)
        planes = (v.Plane * 8)()
        if self._kind in v.MULTIPLANAR:
            buffer.m.planes = ctypes.cast(planes, ctypes.POINTER(v.Plane))
            buffer.length = len(planes)
        return buffer, planes

    def _call(self, request: int, argument: ctypes.Structure | ctypes.Array[ctypes.c_char], doing: str) -> None:
        try:
            self._node.call(request, argument)
        except OSError as error:
            if error.errno == errno.EPIPE:
                raise DeviceError("there is no signal", device=self._node.name) from error
            raise failure(error, doing, self._node) from error


def _is_capture(kind: int) -> bool:
    return kind in {v.TYPE_VIDEO_CAPTURE, v.TYPE_VIDEO_CAPTURE_MPLANE}
