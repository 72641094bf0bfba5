"""One series on its way from the spool to a worker: what is in the folder, and what has become of it.

The sender reads frames.jsonl behind the devices process, so that a slow worker costs page cache and not frames, and a
second delivery or one after a restart is the same as the first. No pixel passes through here.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scanner.errors import StorageError
from scanner.storage import storage_errors
from scanner.stream import DecodedNote, EndReason, Frame, LiveCounts, PointsNote, Progress, Result
from scanner.wire import FileEntry
from service.spool import CAPTURE

HEADER = "capture.json"
RECORDS = "frames.jsonl"
FRAMES = "frames.npy"
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SeriesEnd:
    """How a series ended."""

    reason: EndReason
    missing: tuple[int, ...] = ()


@dataclass
class Series:
    """One capture folder to be decoded, open or closed.

    `changed` is set when there are more lines or the end is known; `outcome` is the worker's result, or the error that
    ended it. `told` hears what a worker says meanwhile.
    """

    job: str
    capture: Path
    outputs: Path
    """each delivery writes into a folder of its own in here"""
    options: Mapping[str, Any]
    told: Callable[[Progress | PointsNote | DecodedNote | LiveCounts], None]
    delivering: Callable[[int], None]
    """hears of each delivery before it begins, with its number"""
    deliveries: int = 0
    end: SeriesEnd | None = None
    lines: int | None = None
    """of frames.jsonl, once there will be no more"""
    cancelled: bool = False
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    outcome: asyncio.Future[Result] = field(default_factory=lambda: asyncio.get_running_loop().create_future())
    _points: PointsNote | None = None

    def grew(self) -> None:
        """There are more lines."""
        self.changed.set()

    def finish(self, reason: EndReason, missing: tuple[int, ...] = ()) -> None:
        """There will be no more lines."""
        self.end = SeriesEnd(reason, missing)
        self.changed.set()

    def whole(self, lines: int) -> None:
        """So many lines there are, and no more will come: what a worker made of these is told."""
        self.lines = lines
        self._tell_points()

    def hear(self, message: Progress | PointsNote | DecodedNote | LiveCounts) -> None:
        """A worker says something. Points that it made of the frames so far wait until these are known to be all."""
        if isinstance(message, PointsNote):
            self._points = message
            self._tell_points()
        else:
            self.told(message)

    def forget_points(self) -> None:
        """The worker that had them is gone."""
        self._points = None

    def _tell_points(self) -> None:
        points = self._points
        if points is not None and (points.frames is None or points.frames == self.lines):
            self._points = None
            self.told(points)

    def output(self, delivery: int) -> Path:
        """Where a delivery's worker writes the scan."""
        return self.outputs / f"scan-{delivery}"

    def remove_outputs(self, kept: str | None) -> None:
        """Delete what dead deliveries wrote."""
        for folder in self.outputs.glob("scan-*"):
            if folder.name != kept:
                shutil.rmtree(folder, ignore_errors=True)


class RecordTail:
    """Reads frames.jsonl while it grows, as `frame` messages."""

    def __init__(self, capture: Path, delivery: int) -> None:
        """Raise StorageError where the folder is not a capture."""
        self.sent = 0
        self._delivery = delivery
        self._position = 0
        self._path = capture / FRAMES
        try:
            camera = json.loads((capture / HEADER).read_bytes())["camera"]
            self._frame_bytes = camera["width"] * camera["height"] * (1 if camera.get("bits", 8) <= 8 else 2)
            with self._path.open("rb") as file:
                head = file.read(10)
            # An NPY file of version 1: magic, version, then the header's length (2 bytes), then the header.
            self._first = 10 + int.from_bytes(head[8:10], "little")
            self._records = (capture / RECORDS).open("rb")
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise StorageError(f"{capture} is not a capture that can be sent: {error}") from error

    def read(self, limit: int) -> Iterator[Frame]:
        """The frames of the next whole lines, at most `limit`. Fewer: there are no more lines yet.

        Raises:
            StorageError: the disk failed.
        """
        upto = self.sent + limit
        with storage_errors(self._path):
            self._records.seek(self._position)
        while self.sent < upto:
            with storage_errors(self._path):
                line = self._records.readline()
            if not line.endswith(b"\n"):
                return  # still being written, or torn by a crash: either way it does not exist
            self._position += len(line)
            record = _parsed(line)
            if record is None:
                continue
            slot = record["slot"]
            yield Frame(
                delivery=self._delivery,
                index=self.sent,
                pattern=record["pattern"],
                slot=slot,
                status=record.get("status", "ok"),
                path=str(self._path),
                offset=0 if slot is None else self._first + slot * self._frame_bytes,
                xxh3=record.get("xxh3"),
            )
            self.sent += 1

    def close(self) -> None:
        """Close the file. May be called twice."""
        self._records.close()


def _parsed(line: bytes) -> dict[str, Any] | None:
    try:
        record: dict[str, Any] = json.loads(line)
        return record if {"slot", "pattern"} <= record.keys() else None
    except (ValueError, AttributeError):
        return None


def capture_state(capture: Path) -> tuple[str, str | None, int]:
    """(state, reason, frames planned) of a capture folder; ("none", None, 0) where there is none."""
    try:
        content = json.loads((capture / HEADER).read_bytes())
        plan = content.get("plan") or {}
        count = int(plan.get("patterns", 0)) * int(plan.get("repeat", 1))
        return str(content["state"]), content.get("reason"), count
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return "none", None, 0


def missing_patterns(capture: Path, count: int) -> tuple[int, ...]:
    """Pattern indices without a whole line."""
    last = {record["pattern"]: record for record in _records(capture)}
    return tuple(pattern for pattern in range(count) if last.get(pattern, {}).get("slot") is None)


def frames_kept(capture: Path) -> tuple[FileEntry, ...]:
    """The files of a capture with at least one frame; none where they cannot be read: the scan has failed anyway."""
    if not any(record["slot"] is not None for record in _records(capture)):
        return ()
    try:
        return tuple(recorded_files(capture))
    except StorageError as problem:
        _log.warning("%s cannot be listed: %s", capture, problem)
        return ()


def recorded_files(folder: Path) -> list[FileEntry]:
    """The files of a recording or capture, by the names that clients fetch them by.

    Raises:
        StorageError: one cannot be read.
    """
    with storage_errors(folder):
        paths = sorted(path for path in folder.rglob("*") if path.is_file() and path.name[0] != ".")
        names = [path.relative_to(folder).as_posix() for path in paths]
        return [file_entry(folder, name, f"{CAPTURE}/{name}") for name in names]


def file_entry(folder: Path, name: str, listed_as: str | None = None, sha: str | None = None) -> FileEntry:
    """A file's name, size and SHA-256 (read from it where it is not known), for the list that clients fetch by."""
    path = folder / name
    if sha is None:
        with path.open("rb") as file:
            sha = hashlib.file_digest(file, "sha256").hexdigest()
    return FileEntry(listed_as or name, path.stat().st_size, sha)


def _records(capture: Path) -> list[dict[str, Any]]:
    """The whole lines of frames.jsonl."""
    try:
        lines = (capture / RECORDS).read_bytes().split(b"\n")[:-1]
    except OSError:
        return []
    return [record for line in lines if (record := _parsed(line)) is not None]
