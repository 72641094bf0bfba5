"""Frames from the library's stream: buffers of ours that it fills, and a thread that stamps each when it comes.

The library writes packets straight into these arrays; a frame handed out is a view of one, lent until the next. When
all are full, frames are lost and counted (underruns), and the camera's count of frames shows the gap.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.aravis.library import aravis, is_library_error
from drivers.aravis.network import buffer_bytes
from drivers.aravis.options import AravisOptions
from drivers.aravis.sockets import set_receive_buffer

POP_US = 20_000
"""The receiving thread looks this often whether it shall end"""

NO_LEADER = (1 << 64) - 1
"""Frame id of a buffer whose first packet never came: nothing else in it is known, either"""

RESEND_WAIT_US = 10_000
"""A frame whose packets stopped coming for so long is asked for the rest. A sender that only paused would be asked for
what it is about to send, and slowed down further: no shorter"""

RETENTION_US = 100_000
"""A frame whose packets stopped coming for so long is given up"""

BUFFERED_BYTES = 256 << 20
LEAST_BUFFERS, MOST_BUFFERS = 8, 64
"""While one frame waits for its packets, those behind it fill buffers: 64 are more than RETENTION_US at 500 Hz"""

REQUEST_RATIO = 1.0
"""Share of a frame's packets that may be asked for again"""


@dataclass(frozen=True, eq=False)
class Received:
    """One frame as it came."""

    buffer: Any
    content: NDArray[np.uint8]
    frame_id: int
    device_ns: int
    arrival_ns: int
    complete: bool
    trigger_count: int | None


class Stream:
    """The stream of one acquisition. Made and closed on the thread that calls the library."""

    def __init__(
        self,
        camera: Any,
        options: AravisOptions,
        *,
        counted: bool,
        heard: Callable[[Received], None],
    ) -> None:
        """counted: frames carry a count of triggers. heard: told of every frame, on the receiving thread."""
        library = aravis()
        self._payload = int(camera.get_payload())
        device = camera.get_device()
        if camera.is_gv_device():
            option = library.GvStreamOption
            device.set_stream_options(option.NONE if options.packet_socket else option.PACKET_SOCKET_DISABLED)
        self._stream = _created(camera)
        if camera.is_gv_device():
            self._configure(options)
        self._parser = camera.create_chunk_parser() if counted else None
        self._heard = heard
        self._arrays: dict[Any, NDArray[np.uint8]] = {}
        fitting = min(max(BUFFERED_BYTES // max(1, self._payload), LEAST_BUFFERS), MOST_BUFFERS)
        for _ in range(options.buffers or fitting):
            content = np.zeros(self._payload, dtype=np.uint8)
            buffer = library.Buffer.new(self._payload, content.ctypes.data)
            self._arrays[buffer] = content
            self._lend(buffer)
        self._frames: deque[Received] = deque()
        self._came = threading.Condition()
        self._ended = False
        self._without_leader = 0
        self._thread = threading.Thread(target=self._receive, name="aravis frames", daemon=True)
        self._thread.start()

    def pop(self, timeout_s: float) -> Received | None:
        """The oldest frame; None if none came in that time, or the stream ended."""
        with self._came:
            if not self._frames:
                self._came.wait_for(lambda: self._frames or self._ended, timeout_s)
            return self._frames.popleft() if self._frames else None

    def give_back(self, received: Received) -> None:
        """The frame's memory may be filled again."""
        if not self._ended:
            self._lend(received.buffer)

    def end(self) -> None:
        """Hand out no more frames; may be called from any thread."""
        with self._came:
            self._ended = True
            self._came.notify_all()

    def close(self) -> None:
        """Let go of the library's stream; with a dead camera this takes seconds."""
        self.end()
        self._thread.join(timeout=50 * POP_US / 1e6)
        self._frames.clear()
        self._stream = None
        self._arrays.clear()

    def counts(self) -> Mapping[str, int]:
        """The library's own counters: n_completed_buffers, n_failures, n_underruns, n_resent_packets and others."""
        stream, found = self._stream, {}
        for i in range(0 if stream is None else stream.get_n_infos()):
            name = str(stream.get_info_name(i))
            if str(stream.get_info_type(i).name) == "guint64":
                found[name] = int(stream.get_info_uint64(i))
        return {**found, "n_without_leader": self._without_leader}

    def _configure(self, options: AravisOptions) -> None:
        library, stream = aravis(), self._stream
        stream.set_property("socket-buffer", library.GvStreamSocketBuffer.FIXED)
        stream.set_property("socket-buffer-size", buffer_bytes(self._payload, options.socket_buffer_frames))
        resend = library.GvStreamPacketResend
        # The library does so when the first packet is there: too late for the frame it belongs to.
        set_receive_buffer(int(stream.get_port()), buffer_bytes(self._payload, options.socket_buffer_frames))
        stream.set_property("packet-resend", resend.ALWAYS if options.resend else resend.NEVER)
        stream.set_property("packet-request-ratio", REQUEST_RATIO)
        stream.set_property("packet-timeout", RESEND_WAIT_US)
        stream.set_property("frame-retention", RETENTION_US)

    def _lend(self, buffer: Any) -> None:
        buffer.set_frame_id(NO_LEADER)
        if (stream := self._stream) is not None:  # closed on the link's thread meanwhile
            stream.push_buffer(buffer)

    def _receive(self) -> None:
        stream, status = self._stream, aravis().BufferStatus
        while not self._ended:
            buffer = stream.timeout_pop_buffer(POP_US)
            arrival_ns = time.monotonic_ns()
            if buffer is None:
                continue
            found = buffer.get_status()
            if found in (status.ABORTED, status.CLEARED) or buffer.get_frame_id() == NO_LEADER:
                self._without_leader += found not in (status.ABORTED, status.CLEARED)
                self._lend(buffer)
                continue
            received = Received(
                buffer=buffer,
                content=self._arrays[buffer],
                frame_id=int(buffer.get_frame_id()),
                device_ns=int(buffer.get_timestamp()),
                arrival_ns=arrival_ns,
                complete=found == status.SUCCESS,
                trigger_count=self._trigger_count(buffer) if found == status.SUCCESS else None,
            )
            self._heard(received)
            with self._came:
                self._frames.append(received)
                self._came.notify_all()

    def _trigger_count(self, buffer: Any) -> int | None:
        if self._parser is None:
            return None
        try:
            return int(self._parser.get_integer_value(buffer, "ChunkCounterValue"))
        except Exception as error:
            if is_library_error(error):  # the chunk is not in this frame
                return None
            raise


def _created(camera: Any) -> Any:
    """A stream without a callback: those crash when the interpreter ends. Aravis 0.10 takes one argument less."""
    try:
        return camera.create_stream(None, None)
    except TypeError:
        return camera.create_stream(None)
