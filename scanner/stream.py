"""The messages between the daemon and a decode worker: one series is `start`, `frame`..., `end`, then a result.

Pixels do not travel: a frame names file, offset and digest, and the worker maps the file (daemon and worker share a
host as long as only ipc is served). Every message of a series carries the number of its delivery; what carries the
number of a dead delivery is void. The worker's `credit` says how many frames may be under way to it; acquisition
never waits for it. Messages are MessagePack maps whose `type` says which; docs/reference/protocol.md has the tables.
"""

from __future__ import annotations

from typing import Any, Literal

import msgspec
from msgspec import Struct

from scanner.wire import ArrayEntry, ErrorBody, FileEntry, decoded

EndReason = Literal[
    "completed",
    "cancelled",
    "device_lost",
    "sync_lost",
    "overrun",
    "worker_lost",
    "disk_full",
    "storage_failed",
    "daemon_restarted",
]
"""Why a series ended."""

HEARTBEAT_S = 1.0
"""A worker that has said nothing for this long says `alive`, whatever it computes."""

SILENCE_S = 10.0
"""A worker that has said nothing for this long is given up and its series sent to another."""

CREDIT = 64
"""Frames under way to a worker: at 600 frames a second a tenth of a second, more than a slow turn of either side."""


class Ready(Struct, frozen=True, tag="ready"):
    """Worker: I can take a series. First message, and the answer to `identify`."""

    protocol: tuple[int, int]
    worker: str
    pid: int
    host: str
    decode: bool = True
    """False: digests are checked and nothing is decoded (for measuring the stream)"""
    credit: int = CREDIT
    busy: int | None = None
    """the delivery it still works on"""


class Alive(Struct, frozen=True, tag="alive"):
    """Worker: nothing else to say."""


class Ack(Struct, frozen=True, tag="ack"):
    """Worker: so many frames of this delivery have been taken, in all."""

    delivery: int
    frames: int


class Progress(Struct, frozen=True, tag="progress"):
    """Worker: this stage begins."""

    delivery: int
    stage: str


class PointsNote(Struct, frozen=True, tag="points"):
    """Worker: these arrays of scan.npz are there to be read, before the file is whole."""

    delivery: int
    arrays: list[ArrayEntry]
    frames: int | None = None
    """of how many `frame` messages, where it comes before `end`: true if these are all; None: of all"""


class DecodedNote(Struct, frozen=True, tag="decoded"):
    """Worker: scan.npz is there."""

    delivery: int
    files: list[FileEntry]
    report: dict[str, Any] = {}


class Result(Struct, frozen=True, tag="result"):
    """Worker: all files are there. The series is acknowledged."""

    delivery: int
    files: list[FileEntry]
    report: dict[str, Any] = {}


class Failed(Struct, frozen=True, tag="failed"):
    """Worker: the series cannot be decoded."""

    delivery: int
    error: ErrorBody


class Released(Struct, frozen=True, tag="released"):
    """Worker: a cancelled series has been let go."""

    delivery: int


class Leaving(Struct, frozen=True, tag="leaving"):
    """Worker: I go, send nothing more."""


class Start(Struct, frozen=True, tag="start"):
    """Daemon: a series begins. Paths are absolute."""

    delivery: int
    job: str
    capture: str
    """the capture folder; its capture.json is there"""
    output: str
    """folder for the scan's files; the worker makes it"""
    options: dict[str, Any] = {}


class Frame(Struct, frozen=True, tag="frame"):
    """Daemon: one line of frames.jsonl, and where the pixels lie."""

    delivery: int
    index: int
    """0, 1, ... within the delivery"""
    pattern: int
    slot: int | None
    status: str
    path: str
    offset: int
    """byte offset of the pixels in the file; meaningless where slot is null"""
    xxh3: str | None


class End(Struct, frozen=True, tag="end"):
    """Daemon: no more frames. Always comes."""

    delivery: int
    reason: EndReason
    frames: int
    """number of `frame` messages of this delivery"""
    missing: list[int]
    """pattern indices without a frame"""


class LiveBegin(Struct, frozen=True, tag="live"):
    """Daemon: a live run begins: each frame is decoded by itself and its result published, the newest first of all."""

    delivery: int
    job: str
    header: dict[str, Any]
    """as capture.json has it: pattern, projector, camera"""
    calibration: dict[str, Any] | None
    endpoint: str
    """the socket to bind and publish on"""
    first: int
    """number of the first frame that is this worker's to decode or to count as dropped"""
    content: Literal["rows", "xyz"] = "rows"
    stride: int = 1
    options: dict[str, Any] = {}


class LiveFrame(Struct, frozen=True, tag="live_frame"):
    """Daemon: one camera frame of a live run. Where it waits and a newer one comes, it is dropped and counted."""

    delivery: int
    number: int
    path: str
    offset: int
    xxh3: str
    """of the pixels; where it differs, the frame was overwritten by newer ones and counts as dropped"""
    frame_id: int
    start_ns: int
    end_ns: int


class LiveCounts(Struct, frozen=True, tag="live_counts"):
    """Worker: what was done since the last of these."""

    delivery: int
    next: int
    """number of the first frame that is not counted yet, here or before"""
    decoded: int
    undecodable: int
    """published as a result without values"""
    dropped: int
    latency: list[tuple[int, int]]
    """exposure's end to published: (half milliseconds, count)"""
    largest_ms: float
    decode_ms: float
    """mean time of decoding one frame; 0 where there was none"""
    points: int = 0
    """of the newest result"""
    threads: int = 1
    problem: str | None = None
    """why the newest undecodable frame was"""


class Cancel(Struct, frozen=True, tag="cancel"):
    """Daemon: let this series go."""

    delivery: int


class Identify(Struct, frozen=True, tag="identify"):
    """Daemon: I do not know you; say `ready`."""


class Stop(Struct, frozen=True, tag="stop"):
    """Daemon: finish and exit."""


FromWorker = (
    Ready | Alive | Ack | Progress | PointsNote | DecodedNote | Result | LiveCounts | Failed | Released | Leaving
)
ToWorker = Start | Frame | End | LiveBegin | LiveFrame | Cancel | Identify | Stop

_from_worker: msgspec.msgpack.Decoder[FromWorker] = msgspec.msgpack.Decoder(FromWorker)
_to_worker: msgspec.msgpack.Decoder[ToWorker] = msgspec.msgpack.Decoder(ToWorker)


def decode_from_worker(data: bytes) -> FromWorker:
    """Read a worker's message.

    Raises:
        ProtocolError: it is none.
    """
    return decoded(_from_worker, data, "a worker's message")


def decode_to_worker(data: bytes) -> ToWorker:
    """Read the daemon's message to a worker.

    Raises:
        ProtocolError: it is none.
    """
    return decoded(_to_worker, data, "a message to a worker")
