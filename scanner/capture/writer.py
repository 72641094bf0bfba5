"""A capture folder, being written, so that a crash at any moment leaves a folder that says what it is.

Pixels come first, then the frame's line, the slot count only on closing, capture.json last.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scanner.capture.header import (
    FRAMES_FILE,
    HEADER_FILE,
    NPY_HEADER_BYTES,
    RECORDS_FILE,
    CaptureHeader,
    FrameRecord,
    State,
    digest,
    npy_header,
)
from scanner.capture.reader import Capture
from scanner.devices import Pixels
from scanner.errors import DecodeError, StorageError
from scanner.storage import replace_json, storage_errors, sync_folder


class CaptureWriter:
    """A capture folder, being written.

    States: created (`state: open`, space reserved) -> write, record ... -> close (`complete` or `failed`).
    One thread writes; `sync` may be called from another.
    """

    def __init__(self, folder: Path, header: CaptureHeader, slots: int) -> None:
        """Make the folder and reserve room for `slots` frames.

        Raises:
            StorageError: the folder has a capture, cannot be written, or the disk has no room.
        """
        self.folder = folder
        self.header = replace(header, state="open", created=header.created or header.as_dict()["created"])
        self.slots = 0
        camera = header.camera
        self._frame_bytes = camera.width * camera.height * camera.dtype.itemsize
        self._reserved = 0
        with storage_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            if (folder / HEADER_FILE).exists():
                raise StorageError(f"{folder} holds a capture already", hint="give another folder")
            flags = os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
            self._frames = os.open(folder / FRAMES_FILE, flags | os.O_RDWR, 0o640)
            self._records = os.open(folder / RECORDS_FILE, flags | os.O_WRONLY | os.O_APPEND, 0o640)
        try:
            with storage_errors(folder):
                os.pwrite(self._frames, npy_header(0, camera), 0)
                self._reserve(slots)
            replace_json(folder / HEADER_FILE, self.header.as_dict())
        except StorageError:
            self.abandon()
            for name in (FRAMES_FILE, RECORDS_FILE):
                (folder / name).unlink()
            raise

    @property
    def frames_path(self) -> Path:
        """The file with the pixels."""
        return self.folder / FRAMES_FILE

    def offset(self, slot: int) -> int:
        """Byte offset of a slot's pixels in the frames file."""
        return NPY_HEADER_BYTES + slot * self._frame_bytes

    def write(self, pixels: Pixels) -> tuple[int, str]:
        """Write pixels to the next slot; returns (slot, digest). Without `record` the slot does not exist yet.

        Raises:
            StorageError: the disk is full or failed.
            DecodeError: not a frame of this capture's format.
        """
        camera = self.header.camera
        if pixels.shape != camera.shape or pixels.dtype != camera.dtype:
            raise DecodeError(f"a frame of {pixels.dtype} {pixels.shape} does not fit {camera.dtype} {camera.shape}")
        slot = self.slots
        with storage_errors(self.frames_path):
            if slot >= self._reserved:
                self._reserve(max(2 * self._reserved, 8))
            data = np.ascontiguousarray(pixels).data.cast("B")
            done = 0
            while done < len(data):
                done += os.pwrite(self._frames, data[done:], self.offset(slot) + done)
        self.slots += 1
        return slot, digest(pixels)

    def record(self, record: FrameRecord) -> None:
        """Append a frame's line, after its pixels.

        Raises:
            StorageError: the disk is full or failed.
        """
        line = (json.dumps(record.as_dict(), separators=(",", ":")) + "\n").encode()
        with storage_errors(self.folder / RECORDS_FILE):
            while line:  # the last bytes of a disk take part of a line: the next attempt says that it is full
                line = line[os.write(self._records, line) :]

    def sync(self) -> None:
        """Make all that was written so far last: fdatasync of pixels, then of lines."""
        with storage_errors(self.folder):
            os.fdatasync(self._frames)
            os.fdatasync(self._records)

    def close(
        self,
        state: State,
        reason: str | None = None,
        *,
        plan: Mapping[str, Any] | None = None,
        witnesses: Sequence[Mapping[str, Any]] = (),
        repeat: int | None = None,
    ) -> CaptureHeader:
        """Sync, write the slot count, then capture.json with the final state. Called once.

        Args:
            state: complete or failed.
            reason: why it ended.
            plan, witnesses: in place of the header's.
            repeat: how many repetitions came, where that was open until now.

        Raises:
            StorageError: the disk is full or failed; the folder then stays `open`.
        """
        header = replace(
            self.header,
            state=state,
            reason=reason,
            plan=self.header.plan if plan is None else plan,
            witnesses=tuple(witnesses) or self.header.witnesses,
            repeat=repeat or self.header.repeat,
        )
        try:
            with storage_errors(self.folder):
                os.ftruncate(self._frames, self.offset(self.slots))
                os.pwrite(self._frames, npy_header(self.slots, self.header.camera), 0)
            self.sync()
            replace_json(self.folder / HEADER_FILE, header.as_dict())
        finally:
            self.abandon()
        self.header = header
        return header

    def abandon(self) -> None:
        """Close the files and leave the folder as it is: `state: open`, interrupted. May be called twice."""
        for descriptor in (self._frames, self._records):
            if descriptor >= 0:
                os.close(descriptor)
        self._frames = self._records = -1

    def _reserve(self, slots: int) -> None:
        # Room is taken before the run, so that a full disk is found then and not in its middle.
        os.posix_fallocate(self._frames, 0, self.offset(slots))
        self._reserved = slots


def close_interrupted(folder: Path, state: State, reason: str) -> CaptureHeader:
    """Close a folder that a crash left `open`: count the slots that have a line, write header and capture.json.

    Raises:
        DecodeError, StorageError: the folder cannot be read or written.
    """
    capture = Capture.open(folder)
    header = replace(capture.header, state=state, reason=reason)
    slots = 1 + max((record.slot for record in capture.records.values() if record.slot is not None), default=-1)
    path = folder / FRAMES_FILE
    if path.exists():
        camera = header.camera
        end = NPY_HEADER_BYTES + slots * camera.width * camera.height * camera.dtype.itemsize
        with storage_errors(path), path.open("r+b") as file:
            file.truncate(end)
            file.write(npy_header(slots, camera))
            file.flush()
            os.fsync(file.fileno())
    replace_json(folder / HEADER_FILE, header.as_dict())
    sync_folder(folder)
    return header
