"""A capture: the frames of one sequence and their folder on disk (formats.md, Capture).

`Capture` reads a folder that may come from anywhere, finished or interrupted. `CaptureWriter` writes one so that a
crash at any moment leaves a folder that says what it is: pixels first, then the frame's line, the slot count only on
closing, capture.json last. Neither knows which frame is right: that is the sequencer's.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import xxhash
from numpy.typing import NDArray

from scanner.devices import Exposure, Flip, Pixels, Source
from scanner.errors import DecodeError, StorageError
from scanner.patterns import CameraFormat, PatternSequence, ProjectorSize
from scanner.storage import replace_json, storage_errors, sync_folder

FORMAT = "fringed-capture"
VERSION = 1
HEADER_FILE = "capture.json"
FRAMES_FILE = "frames.npy"
RECORDS_FILE = "frames.jsonl"

NPY_HEADER_BYTES = 128
MAX_PIXELS = 1 << 28
"""Larger frames are refused before anything is read: no camera has them."""

State = Literal["open", "complete", "failed"]
Status = Literal["ok", "incomplete", "missing"]
Verdict = Literal["proved", "consistent", "unproved"]


@dataclass(frozen=True)
class FrameRecord:
    """A line of frames.jsonl: one frame's pairing with a pattern, and its status.

    `pattern` is repetition x patterns + position in the sequence's frame list; `slot` the place in frames.npy, None
    for a frame that never came.
    """

    slot: int | None
    pattern: int
    attempt: int = 0
    status: Status = "ok"
    xxh3: str | None = None
    frame_id: int | None = None
    trigger: int | None = None
    exposure: Exposure | None = None
    flip: Flip | None = None
    verdict: Verdict = "unproved"

    def as_dict(self) -> dict[str, Any]:
        """The line of formats.md as plain data."""
        exposure, flip = self.exposure, self.flip
        return {
            "slot": self.slot,
            "pattern": self.pattern,
            "attempt": self.attempt,
            "status": self.status,
            "xxh3": self.xxh3,
            "frame_id": self.frame_id,
            "trigger": self.trigger,
            "exposure": exposure
            and {
                "start_ns": exposure.start_ns,
                "end_ns": exposure.end_ns,
                "bound_ns": exposure.bound_ns,
                "source": exposure.source.value,
            },
            "flip": flip
            and {
                "t_ns": flip.t_ns,
                "vblank": flip.vblank,
                "bound_ns": flip.bound_ns,
                "source": flip.source.value,
            },
            "verdict": self.verdict,
        }

    @classmethod
    def from_dict(cls, line: Mapping[str, Any]) -> FrameRecord:
        """Read a line.

        Raises:
            KeyError, TypeError, ValueError: it is not one.
        """
        exposure, flip = line.get("exposure"), line.get("flip")
        slot, status = line["slot"], line.get("status", "ok")
        if status not in ("ok", "incomplete", "missing") or line["pattern"] < 0 or (slot is not None and slot < 0):
            raise ValueError("not a frame record")
        return cls(
            slot=None if slot is None else int(slot),
            pattern=int(line["pattern"]),
            attempt=int(line.get("attempt", 0)),
            status=status,
            xxh3=line.get("xxh3"),
            frame_id=line.get("frame_id"),
            trigger=line.get("trigger"),
            exposure=exposure
            and Exposure(
                int(exposure["start_ns"]),
                int(exposure["end_ns"]),
                int(exposure["bound_ns"]),
                Source(exposure["source"]),
            ),
            flip=flip and Flip(int(flip["t_ns"]), int(flip["vblank"]), int(flip["bound_ns"]), Source(flip["source"])),
            verdict=line.get("verdict", "unproved"),
        )


@dataclass(frozen=True)
class CaptureHeader:
    """capture.json: what was projected and with what."""

    sequence: PatternSequence
    camera: CameraFormat
    id: str = ""
    created: str = ""
    repeat: int = 1
    calibration: str | None = None
    state: State = "complete"
    reason: str | None = None
    plan: Mapping[str, Any] | None = None
    witnesses: Sequence[Mapping[str, Any]] = ()
    frames: tuple[str, ...] | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def frame_count(self) -> int:
        """Frames that a whole capture has."""
        return self.repeat * len(self.sequence)

    def as_dict(self) -> dict[str, Any]:
        """capture.json as plain data."""
        projector, camera = self.sequence.projector, self.camera
        content: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            "id": self.id,
            "created": self.created or datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
            "projector": {"width": projector.width, "height": projector.height},
            "camera": {
                "width": camera.width,
                "height": camera.height,
                "bits": camera.bits,
                "mosaic": camera.mosaic,
            },
            "pattern": self.sequence.describe(),
            "repeat": self.repeat,
            "calibration": self.calibration,
            "state": self.state,
            "reason": self.reason,
            "plan": self.plan,
            "witnesses": [dict(witness) for witness in self.witnesses],
            **self.extra,
        }
        return content if self.frames is None else {**content, "frames": list(self.frames)}

    @classmethod
    def from_dict(cls, content: Any, name: str) -> CaptureHeader:
        """Check and take capture.json; `name` is used in messages.

        Raises:
            DecodeError: not a capture, of another version, or a member missing or wrong.
        """
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise DecodeError(f"{name}: not a {FORMAT} file", hint='its "format" member says what a file is')
        if content.get("version") != VERSION:
            raise DecodeError(
                f"{name}: version {content.get('version')!r} of {FORMAT}, this program reads version {VERSION}",
                hint="update fringed",
            )
        projector = _size(content, "projector", name)
        width, height = _size(content, "camera", name)
        camera = content["camera"]
        bits = camera.get("bits", 8)
        if isinstance(bits, bool) or not isinstance(bits, int) or not 1 <= bits <= 16:
            raise DecodeError(f"{name}: camera.bits must be 1 .. 16, got {bits!r}")
        repeat = content.get("repeat", 1)
        if isinstance(repeat, bool) or not isinstance(repeat, int) or repeat < 1:
            raise DecodeError(f"{name}: repeat must be a positive integer, got {repeat!r}")
        frames = content.get("frames")
        if frames is not None and not (isinstance(frames, list) and all(isinstance(f, str) for f in frames)):
            raise DecodeError(f"{name}: frames must be a list of file names")
        state = content.get("state", "complete")
        if state not in ("open", "complete", "failed"):
            raise DecodeError(f"{name}: state must be open, complete or failed, got {state!r}")
        try:
            sequence = PatternSequence.from_description(ProjectorSize(*projector), content.get("pattern") or {})
        except DecodeError as error:
            raise DecodeError(f"{name}: {error.message}", hint=error.hint) from error
        known = set(cls(sequence, CameraFormat(width, height)).as_dict()) | {"frames"}
        return cls(
            sequence=sequence,
            camera=CameraFormat(width, height, bits, camera.get("mosaic")),
            id=str(content.get("id", "")),
            created=str(content.get("created", "")),
            repeat=repeat,
            calibration=content.get("calibration"),
            state=state,
            reason=content.get("reason"),
            plan=content.get("plan"),
            witnesses=tuple(content.get("witnesses") or ()),
            frames=None if frames is None else tuple(frames),
            extra={key: value for key, value in content.items() if key not in known},
        )


# --- reading ------------------------------------------------------------------------------------------------------


class Capture:
    """A capture folder, opened to read.

    Frames are checked against their digests when first asked for; a slot that has no line, or whose digest differs,
    does not exist.
    """

    def __init__(self, path: Path, header: CaptureHeader, records: Sequence[FrameRecord] | None) -> None:
        self.path = path
        self.header = header
        self.all_records = tuple(records or ())
        self._slots = None if header.frames is not None else _map_frames(path, header)
        self._records = self._present(records)

    @classmethod
    def open(cls, path: Path) -> Capture:
        """Open a folder (its capture.json) or a JSON file.

        Raises:
            DecodeError: missing, unreadable or contradictory, with what and where.
        """
        file = path / HEADER_FILE if path.is_dir() else path
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
        except OSError as error:
            raise DecodeError(
                f"cannot read {file}: {error.strerror}", hint="give a capture folder or its capture.json"
            ) from error
        except ValueError as error:
            raise DecodeError(f"{file} is not JSON: {error}") from error
        header = CaptureHeader.from_dict(content, str(file))
        records = _read_records(file.parent / RECORDS_FILE) if header.frames is None else None
        return cls(file.parent, header, records)

    @property
    def records(self) -> Mapping[int, FrameRecord]:
        """By pattern index: the last whole line of each pattern whose frame is here."""
        return self._records

    @property
    def missing(self) -> tuple[int, ...]:
        """Pattern indices of a whole capture that are not here."""
        return tuple(index for index in range(self.header.frame_count) if index not in self._records)

    @property
    def calibration_path(self) -> Path | None:
        """The calibration file the capture names, if it names a file.

        Raises:
            DecodeError: the name leads out of the folder.
        """
        name = self.header.calibration
        return _inside(self.path, name) if name is not None and name.endswith(".json") else None

    def frame(self, pattern: int) -> Pixels:
        """The frame of a pattern index: (height, width) uint8 or uint16, a read-only view where possible.

        Raises:
            KeyError: not here.
            DecodeError: unreadable, or of another size or depth than capture.json says.
        """
        slot = self._records[pattern].slot
        if self.header.frames is not None:
            return _read_image(_inside(self.path, self.header.frames[pattern]), self.header.camera)
        if slot is None or self._slots is None:
            raise KeyError(pattern)
        frame: Pixels = self._slots[slot]
        return frame

    def _present(self, records: Sequence[FrameRecord] | None) -> dict[int, FrameRecord]:
        count = self.header.frame_count
        if self.header.frames is not None:
            if len(self.header.frames) != count:
                raise DecodeError(
                    f"{self.path}: {len(self.header.frames)} frames listed, the pattern has {count}",
                    hint="the pattern description and the frames contradict each other",
                )
            return {index: FrameRecord(index, index) for index in range(count)}
        slots = self._slots
        if slots is None:
            return {}
        if records is None:
            if len(slots) != count:
                raise DecodeError(
                    f"{self.path / FRAMES_FILE}: {len(slots)} frames, the pattern has {count}",
                    hint="the pattern description and the frames contradict each other",
                )
            return {index: FrameRecord(index, index) for index in range(count)}
        last = {record.pattern: record for record in records if record.pattern < count}
        return {
            pattern: record
            for pattern, record in sorted(last.items())
            if record.status == "ok"
            and record.slot is not None
            and record.slot < len(slots)
            and digest_matches(slots[record.slot], record.xxh3)
        }


def digest(pixels: Pixels) -> str:
    """XXH3 (64 bit) of the pixels, 16 hex digits."""
    return xxhash.xxh3_64_hexdigest(np.ascontiguousarray(pixels).data)


def digest_matches(pixels: Pixels, expected: str | None) -> bool:
    """Whether the pixels have that digest (64 or 128 bit); no digest given matches."""
    if expected is None:
        return True
    data = np.ascontiguousarray(pixels).data
    found = xxhash.xxh3_128_hexdigest(data) if len(expected) == 32 else xxhash.xxh3_64_hexdigest(data)
    return found == expected


def _read_records(path: Path) -> list[FrameRecord] | None:
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise DecodeError(f"cannot read {path}: {error.strerror}") from error
    records = []
    # A line without its newline was torn by a crash and says nothing; so is one that does not parse.
    for line in content.split(b"\n")[:-1]:
        try:
            records.append(FrameRecord.from_dict(json.loads(line)))
        except (ValueError, KeyError, TypeError):
            continue
    return records


def _map_frames(folder: Path, header: CaptureHeader) -> NDArray[Any] | None:
    path, camera = folder / FRAMES_FILE, header.camera
    if not path.exists():
        if header.state != "complete":
            return None
        raise DecodeError(f"{folder}: neither {FRAMES_FILE} nor a list of image files", hint="is the capture whole?")
    shape, dtype, offset = _read_npy_header(path)
    if shape[1:] != camera.shape:
        raise DecodeError(
            f"{path}: frames of {shape[2]} x {shape[1]}, capture.json says {camera.width} x {camera.height}"
        )
    if dtype != camera.dtype:
        raise DecodeError(f"{path}: frames are {dtype}, {camera.bits} bits need {camera.dtype}")
    frame_bytes = camera.width * camera.height * dtype.itemsize
    whole = (path.stat().st_size - offset) // frame_bytes
    slots = whole if header.state == "open" else shape[0]
    if slots > whole:
        raise DecodeError(
            f"{path} is truncated: {shape[0]} frames announced, {whole} there",
            hint="copy it again; an interrupted capture says state: open",
        )
    if slots == 0:
        return None
    return np.memmap(path, dtype=dtype, mode="r", offset=offset, shape=(slots, *camera.shape))


def _read_npy_header(path: Path) -> tuple[tuple[int, ...], np.dtype[Any], int]:
    try:
        with path.open("rb") as file:
            version = np.lib.format.read_magic(file)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, fortran, dtype = read(file)
            offset = file.tell()
    except (OSError, ValueError) as error:
        raise DecodeError(f"{path} is not a NumPy array file: {error}") from error
    if fortran or len(shape) != 3 or dtype not in (np.uint8, np.uint16) or shape[1] * shape[2] > MAX_PIXELS:
        raise DecodeError(f"{path}: expected uint8 or uint16 of shape (slots, height, width), found {dtype} {shape}")
    return shape, dtype, offset


def _read_image(path: Path, camera: CameraFormat) -> Pixels:
    if not path.is_file():
        raise DecodeError(f"frame {path} is missing")
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise DecodeError(f"frame {path} cannot be read as an image", hint="PNG, TIFF, PGM or BMP, 8 or 16 bit")
    if image.ndim == 3:
        image = image[..., 0] if image.shape[2] == 1 else cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2GRAY)
    if image.shape != camera.shape:
        raise DecodeError(
            f"frame {path} is {image.shape[1]} x {image.shape[0]}, capture.json says {camera.width} x {camera.height}"
        )
    if image.dtype != camera.dtype:
        raise DecodeError(f"frame {path} is {image.dtype}, {camera.bits} bits need {camera.dtype}")
    return np.asarray(image, dtype=camera.dtype)


def _inside(folder: Path, name: str) -> Path:
    path = (folder / name).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise DecodeError(
            f"{folder}: {name!r} leads out of the capture folder", hint="paths are relative to the folder"
        )
    return path


def _size(content: Mapping[str, Any], key: str, name: str) -> tuple[int, int]:
    member = content.get(key)
    if not isinstance(member, dict):
        raise DecodeError(f"{name}: {key} is missing", hint='{"width": pixels, "height": pixels}')
    sizes = (member.get("width"), member.get("height"))
    if any(isinstance(n, bool) or not isinstance(n, int) or n < 1 for n in sizes):
        raise DecodeError(f"{name}: {key} needs width and height in pixels, got {sizes[0]!r}, {sizes[1]!r}")
    width, height = int(sizes[0] or 0), int(sizes[1] or 0)
    if width * height > MAX_PIXELS:
        raise DecodeError(f"{name}: {key} of {width} x {height} pixels is larger than any")
    return width, height


# --- writing ------------------------------------------------------------------------------------------------------


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
            os.pwrite(self._frames, _npy_header(0, camera), 0)
            self._reserve(slots)
            replace_json(folder / HEADER_FILE, self.header.as_dict())

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
        with storage_errors(self.folder / RECORDS_FILE):
            os.write(self._records, (json.dumps(record.as_dict(), separators=(",", ":")) + "\n").encode())

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
    ) -> CaptureHeader:
        """Sync, write the slot count, then capture.json with the final state. Called once.

        Raises:
            StorageError: the disk is full or failed; the folder then stays `open`.
        """
        header = replace(
            self.header,
            state=state,
            reason=reason,
            plan=self.header.plan if plan is None else plan,
            witnesses=tuple(witnesses) or self.header.witnesses,
        )
        try:
            with storage_errors(self.folder):
                os.ftruncate(self._frames, self.offset(self.slots))
                os.pwrite(self._frames, _npy_header(self.slots, self.header.camera), 0)
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
            file.write(_npy_header(slots, camera))
            file.flush()
            os.fsync(file.fileno())
    replace_json(folder / HEADER_FILE, header.as_dict())
    sync_folder(folder)
    return header


def _npy_header(slots: int, camera: CameraFormat) -> bytes:
    """A version 1.0 NPY header, always 128 bytes long so that the count can be written over."""
    shape = (slots, camera.height, camera.width)
    text = f"{{'descr': '{camera.dtype.str}', 'fortran_order': False, 'shape': {shape}, }}"
    body = text.ljust(NPY_HEADER_BYTES - 11).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(body).to_bytes(2, "little") + body
