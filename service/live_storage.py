"""Where the frames of a live run go, in the devices process: a small ring that is gone afterwards, or a recording.

A recording is a series of ordinary capture folders of at most `SEGMENT` frames, listed in series.json. The next folder
is made, with its room reserved, while the one before fills; closing and syncing happen on a thread of their own: no
frame waits for it. With a limit in seconds folders that are wholly older are let go again.
"""

from __future__ import annotations

import os
import shutil
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from scanner.capture import CaptureHeader, CaptureWriter, FrameRecord, State, digest
from scanner.devices import Pixels
from scanner.errors import StorageError
from scanner.patterns import CameraFormat
from scanner.series import SERIES_FILE, segment_name, series_content
from scanner.storage import replace_json, storage_errors

SEGMENT = 256
"""Frames of one capture folder."""

RING_S = 0.5
RING_FRAMES = (16, 256)
"""A frame waits in the ring for the worker until it is overwritten: half a second, but at least and at most so many
frames. A worker takes the newest one within the time of a decode."""

SYNC_EVERY_BYTES = 16 << 20
"""As for scans (`service.write_back`)."""

Told = Callable[[int, int], None]
"""Frames and bytes that are on disk, closed, in all."""


class LiveStorage(Protocol):
    """Where frames go; one thread writes."""

    def write(self, pixels: Pixels, record: FrameRecord, number: int) -> tuple[str, int, str]:
        """Take a frame; (path, offset, digest) of its pixels.

        Raises:
            StorageError: the disk is full or failed.
        """

    def close(self, state: State, reason: str | None) -> None:
        """No more frames. Returns when all is on disk, or gone.

        Raises:
            StorageError: the disk is full or failed.
        """


def ring_slots(period_ns: int) -> int:
    """Frames of the ring at this camera period."""
    least, most = RING_FRAMES
    return min(most, max(least, round(RING_S * 1e9 / max(1, period_ns))))


class FrameRing:
    """One file of `slots` frames, written round and round. A reader knows by the digest whether it was in time."""

    def __init__(self, folder: Path, camera: CameraFormat, slots: int) -> None:
        """Make the folder and the file, at its full size.

        Raises:
            StorageError: no room, or the folder cannot be written.
        """
        self._folder = folder
        self._path = str(folder / "ring")
        self._camera = camera
        self._slots = slots
        self._bytes = camera.width * camera.height * camera.dtype.itemsize
        with storage_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self._path, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o640)
            try:
                os.posix_fallocate(self._file, 0, slots * self._bytes)
            except OSError:
                os.close(self._file)
                shutil.rmtree(folder)
                raise

    def write(self, pixels: Pixels, record: FrameRecord, number: int) -> tuple[str, int, str]:
        """Take a frame in place of the oldest; see `LiveStorage`."""
        del record
        offset = number % self._slots * self._bytes
        with storage_errors(self._folder):
            os.pwrite(self._file, np.ascontiguousarray(pixels).data.cast("B"), offset)
        return self._path, offset, digest(pixels)

    def close(self, state: State, reason: str | None) -> None:
        """Nothing is kept."""
        del state, reason
        os.close(self._file)
        with storage_errors(self._folder):
            shutil.rmtree(self._folder)


@dataclass
class _Segment:
    """One capture folder of the series."""

    index: int
    first: int
    writer: CaptureWriter
    frames: int = 0
    bytes: int = 0
    newest_ns: int = 0
    syncing: Future[None] | None = field(default=None, repr=False)


class Recording:
    """Capture folder after capture folder, in `folder`."""

    def __init__(
        self,
        folder: Path,
        header: CaptureHeader,
        calibration: Mapping[str, Any] | None,
        told: Told,
        *,
        keep_s: float | None = None,
        period_ns: int = 1,
    ) -> None:
        """Make the first folder.

        Args:
            folder: the series'.
            header: of a capture of this run; `repeat` is the number of frames of each folder.
            calibration: written beside each capture.json.
            told: hears from the closing thread what is on disk.
            keep_s: None keeps all; else so many seconds at least.
            period_ns: of the camera: a short ring has short folders.

        Raises:
            StorageError: no room, or the folder cannot be written.
        """
        size = SEGMENT if keep_s is None else min(SEGMENT, max(8, round(keep_s * 1e9 / max(1, period_ns) / 2)))
        self._folder = folder
        self._header = replace(header, repeat=size)
        self._calibration = calibration
        self._told = told
        self._keep_ns = None if keep_s is None else round(keep_s * 1e9)
        self._size = size
        camera = header.camera
        self._frame_bytes = camera.width * camera.height * camera.dtype.itemsize
        self._sync_every = max(1, SYNC_EVERY_BYTES // self._frame_bytes)
        self._disk = ThreadPoolExecutor(1, thread_name_prefix="live-disk")
        self._kept: deque[_Segment] = deque()
        self._closings: deque[Future[None]] = deque()
        self._next: Future[_Segment] | None = None
        try:
            self._now = self._disk.submit(self._open, 0, 0).result()
            self._disk.submit(self._list, "open", None).result()
        except StorageError:
            self._disk.shutdown()
            raise

    @property
    def segment_bytes(self) -> int:
        """Room that one folder reserves."""
        return self._size * self._frame_bytes

    def write(self, pixels: Pixels, record: FrameRecord, number: int) -> tuple[str, int, str]:
        """Take a frame; see `LiveStorage`."""
        self._raise_problem()
        if self._now.frames == self._size:
            self._turn(number)
        now = self._now
        slot, found = now.writer.write(pixels)
        now.writer.record(replace(record, slot=slot, pattern=now.frames, xxh3=found))
        now.frames += 1
        now.bytes += self._frame_bytes
        now.newest_ns = 0 if record.exposure is None else record.exposure.end_ns
        if self._next is None and now.frames >= self._size // 2:
            self._next = self._disk.submit(self._open, now.index + 1, now.first + self._size)
        if now.frames % self._sync_every == 0 and (now.syncing is None or now.syncing.done()):
            now.syncing = self._disk.submit(now.writer.sync)
        return str(now.writer.frames_path), now.writer.offset(slot), found

    def close(self, state: State, reason: str | None) -> None:
        """Close the last folder and the list; what was reserved ahead is removed."""
        try:
            if self._next is not None:
                self._drop(self._next)
            self._disk.submit(self._close, self._now, state, reason).result()
            self._raise_problem(wait=True)
            self._disk.submit(self._list, state, reason).result()
        finally:
            self._disk.shutdown()

    # --- on the thread of the disk -----------------------------------------------------------------------------

    def _open(self, index: int, first: int) -> _Segment:
        folder = self._folder / segment_name(index)
        header = replace(
            self._header, id=f"{self._header.id}-{index}", extra={**self._header.extra, "live": {"first": first}}
        )
        writer = CaptureWriter(folder, header, self._size)
        if self._calibration is not None:
            replace_json(folder / "calibration.json", self._calibration)
        return _Segment(index, first, writer)

    def _close(self, segment: _Segment, state: State, reason: str | None) -> None:
        if segment.frames == 0:
            segment.writer.abandon()
            shutil.rmtree(segment.writer.folder)
            return
        plan = None if self._header.plan is None else {**self._header.plan, "repeat": segment.frames}
        segment.writer.close(state, reason, plan=plan, repeat=segment.frames)
        self._kept.append(segment)
        if self._keep_ns is not None:
            while len(self._kept) > 1 and segment.newest_ns - self._kept[0].newest_ns > self._keep_ns:
                shutil.rmtree(self._kept.popleft().writer.folder)
        self._told(sum(kept.frames for kept in self._kept), sum(kept.bytes for kept in self._kept))

    def _list(self, state: str, reason: str | None) -> None:
        segments = [(s.index, s.first, s.frames) for s in self._kept]
        if state == "open":
            segments.append((self._now.index, self._now.first, 0))
        replace_json(self._folder / SERIES_FILE, series_content(self._header.id, segments, state, reason))

    # --- between both ------------------------------------------------------------------------------------------

    def _turn(self, number: int) -> None:
        """Go on in the next folder; the one before is closed behind."""
        before = self._now
        ahead = self._next or self._disk.submit(self._open, before.index + 1, number)
        self._next = None
        self._now = ahead.result()
        self._closings.append(self._disk.submit(self._close, before, "complete", "completed"))
        self._closings.append(self._disk.submit(self._list, "open", None))

    def _raise_problem(self, *, wait: bool = False) -> None:
        while self._closings and (wait or self._closings[0].done()):
            self._closings.popleft().result()
        syncing = self._now.syncing
        if syncing is not None and syncing.done():
            syncing.result()

    def _drop(self, ahead: Future[_Segment]) -> None:
        try:
            segment = ahead.result()
        except StorageError:
            return  # it was never needed
        self._disk.submit(self._close, segment, "failed", None).result()
