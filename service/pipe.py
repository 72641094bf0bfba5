"""The messages between the daemon and its devices process, and their framing on two pipes.

Commands go to the child's standard input, which is its lifeline too: when it closes, the daemon is gone. What the
child says comes from a descriptor of its own, so that a library that prints cannot break it. A message is its length
(4 bytes, little-endian) and a MessagePack map whose `type` says which.
"""

from __future__ import annotations

import asyncio
import os
import threading
from collections import deque
from typing import Any, BinaryIO

import msgspec
from msgspec import Struct

from scanner.errors import ProtocolError
from scanner.stream import EndReason
from scanner.wire import ErrorBody, LiveStart, ScanStart

MAX_BYTES = 8 << 20

# --- to the devices process ---------------------------------------------------------------------------------------


class Open(Struct, frozen=True, tag="open"):
    """Open the devices of this rig (`RigConfig.model_dump(mode="json")`) and keep them open."""

    rig: dict[str, Any]


class Acquire(Struct, frozen=True, tag="acquire"):
    """Plan a scan and say `need`; on `go`, run it into this capture folder."""

    job: str
    folder: str
    params: ScanStart


class AcquireLive(Struct, frozen=True, tag="acquire_live"):
    """The same for a live run; `cancel` ends it. `folder` is for what is retained, or for the ring that is not."""

    job: str
    folder: str
    params: LiveStart


class Go(Struct, frozen=True, tag="go"):
    """There is room."""

    job: str


class CancelAcquire(Struct, frozen=True, tag="cancel"):
    """Stop the scan, wherever it is."""

    job: str


class Preview(Struct, frozen=True, tag="preview"):
    """Show what the camera sees on the preview socket while no scan runs; rate 0 stops it."""

    endpoint: str
    rate_hz: float
    max_width: int


class Discover(Struct, frozen=True, tag="discover"):
    """Name the devices that the drivers can see."""

    number: int


# --- from the devices process -------------------------------------------------------------------------------------


class Opened(Struct, frozen=True, tag="opened"):
    """The devices are open."""

    camera: dict[str, Any]
    projector: dict[str, Any]


class OpenFailed(Struct, frozen=True, tag="open_failed"):
    """They are not; the process will exit."""

    error: ErrorBody


class Need(Struct, frozen=True, tag="need"):
    """The scan is planned and will write this much."""

    job: str
    frames: int
    bytes: int
    plan: dict[str, Any]


class Began(Struct, frozen=True, tag="began"):
    """The capture folder is there."""

    job: str


class Frames(Struct, frozen=True, tag="frames"):
    """So many lines are in frames.jsonl. Only the newest of these is sent when there is no time for all."""

    job: str
    lines: int
    captured: int
    """different patterns with a frame"""
    retakes: int


class LiveBegan(Struct, frozen=True, tag="live_began"):
    """The pattern is on and frames will follow. `header` is what their capture.json says."""

    job: str
    header: dict[str, Any]
    calibration: dict[str, Any] | None


class Shot(Struct, frozen=True, tag="shot"):
    """One frame of a live run. Where there is no time for all, only the newest is sent; `number` shows the gap."""

    job: str
    number: int
    path: str
    offset: int
    xxh3: str
    frame_id: int
    start_ns: int
    end_ns: int
    lost: int
    """frames so far that the camera counted and that never came"""


class Kept(Struct, frozen=True, tag="kept"):
    """A piece of a live recording is on disk and closed, or was let go again by the ring."""

    job: str
    frames: int
    """on disk in all"""
    bytes: int


class Taken(Struct, frozen=True, tag="taken"):
    """All frames are taken and the devices are free; the disk is not done yet."""

    job: str
    lines: int | None = None
    """of frames.jsonl, where all of the scan's frames are there and in step"""


class Ended(Struct, frozen=True, tag="ended"):
    """The scan is over and its folder closed. `reason` is None where it never began."""

    job: str
    reason: EndReason | None
    lines: int = 0
    missing: list[int] = []
    error: ErrorBody | None = None
    report: dict[str, Any] = {}


class Devices(Struct, frozen=True, tag="devices"):
    """Answer to `discover`."""

    number: int
    devices: list[dict[str, Any]]


class Counted(Struct, frozen=True, tag="counted"):
    """What became of the camera's frames in all scans and live runs, by its driver's names."""

    counts: dict[str, int]


class DeviceFault(Struct, frozen=True, tag="fault"):
    """A device went away: all are given up, and `opened` follows when they are back."""

    error: ErrorBody


Command = Open | Acquire | AcquireLive | Go | CancelAcquire | Preview | Discover
Report = (
    Opened
    | OpenFailed
    | Need
    | Began
    | Frames
    | LiveBegan
    | Shot
    | Kept
    | Taken
    | Ended
    | Devices
    | DeviceFault
    | Counted
)

_commands: msgspec.msgpack.Decoder[Command] = msgspec.msgpack.Decoder(Command)
_reports: msgspec.msgpack.Decoder[Report] = msgspec.msgpack.Decoder(Report)
_encoder = msgspec.msgpack.Encoder()


def framed(message: Command | Report) -> bytes:
    """A message with its length."""
    data = _encoder.encode(message)
    return len(data).to_bytes(4, "little") + data


def read_command(stream: BinaryIO) -> Command | None:
    """The next command; None where the daemon is gone."""
    head = stream.read(4)
    if len(head) < 4:
        return None
    length = int.from_bytes(head, "little")
    data = stream.read(length)
    return _commands.decode(data) if len(data) == length else None


async def read_report(stream: asyncio.StreamReader) -> Report | None:
    """The next report; None where the devices process is gone.

    Raises:
        ProtocolError: something else writes there.
    """
    try:
        length = int.from_bytes(await stream.readexactly(4), "little")
        if length > MAX_BYTES:
            raise ProtocolError(f"a report of {length} bytes from the devices process")
        return _reports.decode(await stream.readexactly(length))
    except (asyncio.IncompleteReadError, ConnectionError):
        return None
    except msgspec.MsgspecError as error:
        raise ProtocolError(f"the devices process says nonsense: {error}") from error


class Outbox:
    """What the devices process has to say: `post` never waits, whatever the daemon does.

    A thread writes. Of `Frames` and of `Shot` that it has not written yet only the newest is kept.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._waiting: deque[Report] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._write, name="outbox", daemon=True)
        self._thread.start()

    def post(self, report: Report) -> None:
        """Send a report soon."""
        with self._changed:
            if isinstance(report, Frames | Shot) and self._waiting and type(self._waiting[-1]) is type(report):
                self._waiting.pop()
            self._waiting.append(report)
            self._changed.notify()

    def close(self, timeout_s: float = 1.0) -> None:
        """Write what waits, within `timeout_s`."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(timeout_s)

    def _write(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._waiting) or self._closed)
                if not self._waiting:
                    return
                data = memoryview(framed(self._waiting.popleft()))
            try:
                while data:
                    data = data[os.write(self._descriptor, data) :]
            except BrokenPipeError:
                return  # the daemon is gone; the lifeline says so to the main thread
