"""A live run in the worker: the newest frame to a result, published on the live socket, and counts of what was done.

Frames wait in a mailbox of one: a newer frame takes the place of one that waits, which is dropped and counted. One or
two threads decode (kernels release the interpreter lock); results leave in the order of their frames. Pixels are
copied out of the spool first and checked then: a ring that was faster shows itself by the digest.
"""

from __future__ import annotations

import gc
import logging
import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import zmq
from msgspec import structs
from numpy.typing import NDArray

from scanner.durations import Durations
from scanner.endpoints import ipc_path
from scanner.errors import DecodeError, ProtocolError, ScannerError
from scanner.stream import FromWorker, LiveBegin, LiveCounts, LiveFrame
from scanner.wire_images import LiveHeader, encode_image
from service.descriptors import Admission
from service.sockets import MAX_SUBSCRIPTION_BYTES, remove_sockets

if TYPE_CHECKING:
    from scanner.reconstruct_live import LiveReconstruction, LiveResult

COUNTS_S = 0.25
"""Counts are said this often."""

TURN_S = 0.0005
"""The interpreter's turn where several threads want it. In its usual 5 ms a frame's message, or a result, would wait a
third of a frame at 60 a second for a thread that does not call a kernel just then."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Taken:
    """A frame that a thread works on; `ticket` is its place in the order of results."""

    ticket: int
    message: LiveFrame


class LiveWork:
    """One live run: `frame` from the talking side, `close` at its end. Threads run in between."""

    def __init__(self, begin: LiveBegin, answer: Callable[[FromWorker], None], threads: int | None = None) -> None:
        """Bind the live socket, make the decoders, start the threads.

        Raises:
            ScannerError: these frames cannot be decoded, or the socket cannot be opened.
        """
        from scanner.capture import CaptureHeader  # noqa: PLC0415  (OpenCV and Numba: after the devices are told)
        from scanner.decode_options import DecodeOptions  # noqa: PLC0415
        from scanner.geometry import calibration_from_dict  # noqa: PLC0415
        from scanner.reconstruct_live import LiveReconstruction  # noqa: PLC0415

        self.delivery = begin.delivery
        self._begin = begin
        self._answer = answer
        header = CaptureHeader.from_dict(begin.header, f"live run {begin.job}")
        calibration = None
        if begin.calibration is not None:
            calibration = calibration_from_dict(begin.calibration, name=f"calibration of {begin.job}")
        options = DecodeOptions.from_dict(begin.options)
        self._camera = header.camera
        self._count = threads or cores()
        decoders = [
            LiveReconstruction(header, calibration, options, xyz=begin.content == "xyz", stride=begin.stride)
            for _ in range(self._count)
        ]
        self._publisher = _Publisher(begin.endpoint)
        self._state = threading.Condition()
        self._newest: LiveFrame | None = None
        self._ending = False
        self._tickets = 0
        self._counter = _Counter(begin.delivery, begin.first, self._count)
        self._threads = [
            threading.Thread(target=self._decode, args=(decoder,), name=f"live-{number}", daemon=True)
            for number, decoder in enumerate(decoders)
        ]
        self._before = _in_short_turns()
        for thread in self._threads:
            thread.start()

    def frame(self, message: LiveFrame) -> None:
        """Take a frame. Never waits."""
        with self._state:
            self._counter.came(message.number)
            if self._newest is not None:
                self._counter.dropped += 1
            self._newest = message
            self._state.notify()
        self._say_counts(COUNTS_S)

    def close(self) -> None:
        """End: a frame that waits is dropped, those being decoded are published. May be called twice."""
        with self._state:
            self._ending = True
            self._state.notify_all()
        for thread in self._threads:
            thread.join()
        with self._state:
            if self._newest is not None:
                self._counter.dropped += 1
                self._newest = None
        self._publisher.close()
        self._before()
        self._say_counts(0.0)

    def _say_counts(self, period_s: float) -> None:
        with self._state:
            counts = self._counter.due(period_s)
        if counts is not None:
            self._answer(counts)

    # --- decoding threads -----------------------------------------------------------------------------------------

    def _decode(self, decoder: Any) -> None:
        pixels = np.empty(self._camera.shape, self._camera.dtype)
        frames = _Frames(pixels)
        try:
            self._decode_all(decoder, frames, pixels)
        finally:
            frames.close()

    def _decode_all(self, decoder: LiveReconstruction, frames: _Frames, pixels: NDArray[Any]) -> None:
        while (taken := self._take()) is not None:
            found = self._one(decoder, frames, pixels, taken.message)
            out = self._publisher.publish(taken.ticket, found)
            with self._state:
                if found is None:
                    self._counter.dropped += 1
                for result, sent_ns in out:
                    self._counter.published(result, sent_ns)
            self._say_counts(COUNTS_S)

    def _take(self) -> _Taken | None:
        with self._state:
            self._state.wait_for(lambda: self._newest is not None or self._ending)
            if self._ending or self._newest is None:
                return None
            message, self._newest = self._newest, None
            self._tickets += 1
            return _Taken(self._tickets - 1, message)

    def _one(
        self, decoder: LiveReconstruction, frames: _Frames, pixels: NDArray[Any], message: LiveFrame
    ) -> _Result | None:
        """What is to be published of a frame; None where its pixels were gone."""
        began = time.perf_counter()
        found: LiveResult | None = None
        problem: str | None = None
        try:
            if not frames.read(message):
                return None
            found = decoder.result(pixels)
        except ScannerError as error:
            problem = str(error)
        except Exception as error:  # noqa: BLE001  (a decoder that fails on one frame serves the next)
            _log.exception("frame %d of live run %s", message.number, self._begin.job)
            problem = f"the decoder failed: {type(error).__name__}: {error}"
        xyz = decoder.content == "xyz"
        height, width = (0, 0) if found is None else found.values.shape[:2]
        header = LiveHeader(
            number=message.number,
            job=self._begin.job,
            content=decoder.content,
            width=width,
            height=height,
            dtype="float32" if xyz else "uint16",
            stride=self._begin.stride if xyz else 1,
            scale=decoder.scale,
            points=0 if found is None else found.points,
            frame_id=message.frame_id,
            start_ns=message.start_ns,
            end_ns=message.end_ns,
            decode_ms=round(1e3 * (time.perf_counter() - began), 3),
            error=problem,
        )
        return _Result(header, b"" if found is None else found.values.data.cast("B"))


def _in_short_turns() -> Callable[[], None]:
    """Have this process take frames evenly; returns what undoes it.

    Turns are short, OpenCV starts no threads beside those that decode, and the collector of cycles passes over all
    that is there already: walking through it takes as long as a frame.
    """
    import cv2  # noqa: PLC0415  (as above)

    turn, threads = sys.getswitchinterval(), cv2.getNumThreads()
    sys.setswitchinterval(TURN_S)
    cv2.setNumThreads(1)
    gc.collect()
    gc.freeze()

    def undo() -> None:
        gc.unfreeze()
        cv2.setNumThreads(threads)
        sys.setswitchinterval(turn)

    return undo


@dataclass(frozen=True, eq=False)
class _Result:
    header: LiveHeader
    """without the time of sending"""
    values: bytes | memoryview


class _Publisher:
    """The live socket, and the order of results."""

    def __init__(self, endpoint: str) -> None:
        self._endpoint = endpoint
        self._lock = threading.Lock()
        self._waiting: dict[int, _Result | None] = {}
        self._next = 0
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.PUB)
        # Each reader's queue holds the newest result alone, and nobody is ever waited for.
        for option, value in ((zmq.LINGER, 0), (zmq.CONFLATE, 1), (zmq.MAXMSGSIZE, MAX_SUBSCRIPTION_BYTES)):
            self._socket.setsockopt(option, value)
        ipc_path(endpoint)
        before = os.umask(0o117)
        try:
            self._socket.bind(endpoint)
        except zmq.ZMQError as error:
            self._context.destroy(linger=0)
            raise ProtocolError(f"cannot open the live socket {endpoint}: {error.strerror}") from error
        finally:
            os.umask(before)
        self._admission = Admission({endpoint: self._socket})

    def publish(self, ticket: int, result: _Result | None) -> list[tuple[_Result, int]]:
        """Publish in order of tickets; what went out now, and when, ns."""
        out: list[tuple[_Result, int]] = []
        with self._lock:
            self._waiting[ticket] = result
            while self._next in self._waiting:
                ready = self._waiting.pop(self._next)
                self._next += 1
                if ready is not None:
                    sent = time.monotonic_ns()
                    data = encode_image(structs.replace(ready.header, sent_ns=sent), ready.values)
                    self._socket.send(data, zmq.DONTWAIT, copy=False)
                    out.append((ready, sent))
        return out

    def close(self) -> None:
        self._admission.close()
        self._context.destroy(linger=0)
        remove_sockets([self._endpoint])


class _Frames:
    """Reads frames out of the files that messages name."""

    def __init__(self, pixels: NDArray[Any]) -> None:
        self._pixels = pixels
        self._data = pixels.data.cast("B")
        self._file = -1
        self._path = ""

    def read(self, message: LiveFrame) -> bool:
        """Fill the pixels; False where they were overwritten or are gone."""
        from scanner.capture import digest_matches  # noqa: PLC0415

        try:
            if message.path != self._path:
                self.close()
                self._file, self._path = os.open(message.path, os.O_RDONLY | os.O_CLOEXEC), message.path
            count = os.preadv(self._file, [self._data], message.offset)
        except FileNotFoundError:
            return False
        except OSError as error:
            raise DecodeError(f"cannot read {message.path}: {error.strerror}") from error
        return count == len(self._data) and digest_matches(self._pixels, message.xxh3)

    def close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
        self._file, self._path = -1, ""


class _Counter:
    """What is said in `LiveCounts`. Not safe by itself: its owner locks."""

    def __init__(self, delivery: int, first: int, threads: int) -> None:
        self._delivery = delivery
        self._next = first
        self._threads = threads
        self.dropped = 0
        self._decoded = self._undecodable = 0
        self._spent_ms = 0.0
        self._latency = Durations()
        self._points = 0
        self._problem: str | None = None
        self._said = time.monotonic()

    def came(self, number: int) -> None:
        """A frame's message: those between it and the one before never came this far."""
        self.dropped += max(0, number - self._next)
        self._next = max(self._next, number + 1)

    def published(self, result: _Result, sent_ns: int) -> None:
        """A result went out."""
        header = result.header
        self._spent_ms += header.decode_ms
        self._latency.add((sent_ns - header.end_ns) / 1e6)
        self._points = header.points
        if header.error is None:
            self._decoded += 1
        else:
            self._undecodable += 1
            self._problem = header.error

    def due(self, period_s: float) -> LiveCounts | None:
        """The counts since the last time, if that is `period_s` ago; the caller sends them."""
        now = time.monotonic()
        if now - self._said < period_s:
            return None
        self._said = now
        results = self._decoded + self._undecodable
        counts = LiveCounts(
            self._delivery,
            self._next,
            self._decoded,
            self._undecodable,
            self.dropped,
            self._latency.take_fresh(),
            self._latency.largest_ms,
            self._spent_ms / results if results else 0.0,
            self._points,
            self._threads,
            self._problem,
        )
        self._decoded = self._undecodable = self.dropped = 0
        self._spent_ms = 0.0
        self._problem = None
        return counts


def cores() -> int:
    """Decoding threads: two where there are two cores, for a frame that comes while one is decoded."""
    return min(2, len(os.sched_getaffinity(0)))
