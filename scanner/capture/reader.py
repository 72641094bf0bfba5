"""A capture folder, opened to read: from here or from elsewhere, finished or interrupted."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.bounded_files import read_small, read_small_text
from scanner.capture.header import (
    FRAMES_FILE,
    HEADER_FILE,
    MAX_PIXELS,
    RECORDS_FILE,
    CaptureHeader,
    FrameRecord,
    digest_matches,
)
from scanner.devices import Pixels
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat

_WHAT_TO_GIVE = "give a capture folder, its capture.json, or the folder of a scan"
MOST_NAMED = 4
"""Frames of one fault that are named; the others are counted."""
SCAN_FOLDER = "capture"
"""Where a scan's folder has its capture"""


class Capture:
    """A capture folder, opened to read.

    Frames are checked against their digests when first asked for; a slot that has no line, or whose digest differs,
    does not exist.
    """

    def __init__(
        self,
        path: Path,
        header: CaptureHeader,
        records: Sequence[FrameRecord] | None,
        checked: Mapping[int, str] | None = None,
    ) -> None:
        self.path = path
        self.header = header
        self.all_records = tuple(records or ())
        self._colours: dict[bool, str] = {}  # an image file by whether it is in colour
        self._full = 0.0  # largest share of a colour image's pixels that have a saturated channel
        self._slots = None if header.frames is not None else _map_frames(path, header)
        self._records = self._present(records, checked or {})

    @classmethod
    def open(cls, path: Path, checked: Mapping[int, str] | None = None) -> Capture:
        """Open a folder (its capture.json), the folder of a scan (the capture in there) or a JSON file.

        Args:
            path: folder or file.
            checked: digests by slot, which the caller has held against the pixels already.

        Raises:
            DecodeError: missing, unreadable or contradictory, with what and where.
        """
        file = _header_at(path)
        try:
            content = json.loads(read_small_text(file))
        except OSError as error:
            raise DecodeError(f"cannot read {file}: {error.strerror}", hint=_WHAT_TO_GIVE) from error
        except (ValueError, RecursionError) as error:
            raise DecodeError(f"{file} is not JSON: {error}") from error
        header = CaptureHeader.from_dict(content, str(file))
        records = _read_records(file.parent / RECORDS_FILE) if header.frames is None else None
        return cls(file.parent, header, records, checked)

    @property
    def records(self) -> Mapping[int, FrameRecord]:
        """By pattern index: the last whole line of each pattern whose frame is here."""
        return self._records

    def require_any(self) -> Mapping[int, FrameRecord]:
        """`records`, of a capture that is to be decoded.

        Raises:
            DecodeError: there are none; which file is to blame, and why.
        """
        if not self._records:
            raise DecodeError(f"no frame can be taken: {self.fault()}", hint=_NO_FRAME)
        return self._records

    def fault(self, pattern: int | None = None) -> str:
        """Why the frame of a pattern that is `missing` is not here: which file is to blame. None: of the last line."""
        lines, frames = self.path / RECORDS_FILE, self.path / FRAMES_FILE
        if self._slots is None:
            return f"{frames} holds none"
        told = [record for record in self.all_records if pattern in (None, record.pattern)]
        if not told:
            of = "a frame's record" if pattern is None else f"the record of pattern {pattern}"
            return f"{lines} holds no whole line that is {of}"
        last = told[-1]
        if last.pattern >= self.header.frame_count:
            return f"{lines} tells of pattern {last.pattern}, and the capture has {self.header.frame_count} from 0"
        if last.status != "ok" or last.slot is None:
            return f"{lines} says that the frame of pattern {last.pattern} is {last.status}"
        if last.slot >= len(self._slots):
            return f"{lines} names slot {last.slot}, and {FRAMES_FILE} has {len(self._slots)} from 0"
        return self._altered((last.slot,))

    @property
    def missing(self) -> tuple[int, ...]:
        """Pattern indices of a whole capture that are not here."""
        return tuple(index for index in range(self.header.frame_count) if index not in self._records)

    @property
    def lost(self) -> str | None:
        """Which frames of a whole capture are not here, in words, and what is to blame for the first; None: all are."""
        if not self.missing:
            return None
        named, more = ", ".join(map(str, self.missing[:MOST_NAMED])), len(self.missing) - MOST_NAMED
        frames = f"frame{'s' if len(self.missing) > 1 else ''} {named}{f' and {more} more' if more > 0 else ''}"
        return f"{frames} of {self.header.frame_count} lost: {self._faults()}"

    def _faults(self) -> str:
        """What is to blame for missing frames: for all of them where it is their pixels, else for the first."""
        last = {record.pattern: record for record in self.all_records}
        there = 0 if self._slots is None else len(self._slots)
        found = [last[pattern] for pattern in self.missing if pattern in last]
        slots = [r.slot for r in found if r.status == "ok" and r.slot is not None and r.slot < there]
        if len(slots) == len(self.missing):
            return self._altered(slots)
        why = self.fault(self.missing[0])
        return why if len(self.missing) == 1 else f"{why} (frame {self.missing[0]})"

    def _altered(self, slots: Sequence[int]) -> str:
        named, more = ", ".join(map(str, slots[:MOST_NAMED])), len(slots) - MOST_NAMED
        pixels = f"the pixels of {self.path / FRAMES_FILE}"
        if len(slots) == 1:
            return f"{pixels}, slot {named}, are not those that the digest in {RECORDS_FILE} was made of"
        which = f"slots {named}{f' and {more} more' if more > 0 else ''}"
        return f"{pixels}, {which}, are not those that the digests in {RECORDS_FILE} were made of"

    @property
    def calibration_path(self) -> Path | None:
        """The calibration file the capture names, if it names a file.

        Raises:
            DecodeError: the name leads out of the folder.
        """
        name = self.header.calibration
        if name is None or not name.endswith(".json"):
            return None
        return _inside(self.path, name, hint="copy the calibration into the folder, or give it with --calibration FILE")

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the frames that were read are not, and need not be, but had better be."""
        if True not in self._colours:
            return ()
        said = f"the frames are colour images ({self._colours[True]}): read as luma, grey ones measure better"
        if self._full <= MOST_FULL:
            return (said,)
        return (
            said,
            f"in one of them {self._full:.0%} of the pixels have a saturated channel, and a luma that is not: light is "
            "cut off there, and no pixel counts as saturated. Expose for less, until no channel is full",
        )

    def frame(self, pattern: int) -> Pixels:
        """The frame of a pattern index: (height, width) uint8 or uint16, a read-only view where possible.

        Raises:
            KeyError: not here.
            DecodeError: unreadable, of another size or depth than capture.json says, or in colour where others are not.
        """
        slot = self._records[pattern].slot
        if self.header.frames is not None:
            name = self.header.frames[pattern]
            image = _read_image(_inside(self.path, name), self.header.camera)
            self._require_alike(name, colour=image.ndim == 3)
            if image.ndim == 3:
                full = image >= self.header.camera.max_value
                self._full = max(self._full, float((full.any(axis=2) & ~full.all(axis=2)).mean()))
            return _grey(image, self.header.camera, str(self.path / name))
        if slot is None or self._slots is None:
            raise KeyError(pattern)
        frame: Pixels = self._slots[slot]
        return _within_range(frame, self.header.camera, f"{self.path / FRAMES_FILE}, slot {slot}")

    def _require_alike(self, name: str, *, colour: bool) -> None:
        """Luma is not what a grey frame has: phases made of both would be wrong, and look right."""
        self._colours.setdefault(colour, name)
        if len(self._colours) > 1:
            raise DecodeError(
                f"{self.path}: frame {self._colours[True]} is in colour, frame {self._colours[False]} is grey",
                hint="save all frames alike, grey ones rather, as the camera gives them",
            )

    def _present(self, records: Sequence[FrameRecord] | None, checked: Mapping[int, str]) -> dict[int, FrameRecord]:
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
            and (checked.get(record.slot, "") == record.xxh3 or digest_matches(slots[record.slot], record.xxh3))
        }


def _header_at(path: Path) -> Path:
    """The JSON file of a capture: in the folder given, in a scan's folder one further down, or the file itself."""
    if not path.is_dir():
        return path
    inside = path / SCAN_FOLDER / HEADER_FILE
    return inside if inside.is_file() and not (path / HEADER_FILE).exists() else path / HEADER_FILE


def _read_records(path: Path) -> list[FrameRecord] | None:
    try:
        content = read_small(path)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise DecodeError(f"cannot read {path}: {error.strerror}") from error
    records = []
    # A line without its newline was torn by a crash and says nothing; so is one that does not parse.
    for line in content.split(b"\n")[:-1]:
        try:
            records.append(FrameRecord.from_dict(json.loads(line)))
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
            continue
    return records


def _map_frames(folder: Path, header: CaptureHeader) -> NDArray[Any] | None:
    path, camera = folder / FRAMES_FILE, header.camera
    if path.exists() and not path.is_file():
        raise DecodeError(f"{path} is no regular file", hint="a link to one will do; a pipe or device cannot be mapped")
    if not path.exists():
        if header.state != "complete":
            return None
        raise DecodeError(f"{folder}: neither {FRAMES_FILE} nor a list of image files", hint="is the capture whole?")
    shape, dtype, offset = _read_npy_header(path)
    if shape[1:] != camera.shape:
        raise DecodeError(
            f"{path}: frames of {shape[2]} x {shape[1]}, capture.json says {camera.width} x {camera.height}",
            hint="write the frames' own width and height under camera in capture.json, or take the frames that belong "
            "to it",
        )
    if dtype != camera.dtype:
        raise DecodeError(f"{path}: frames are {dtype}, {camera.bits} bits need {camera.dtype}", hint=_BITS)
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
    except Exception as error:  # a header is Python text: NumPy's reader fails on bad ones in a dozen ways
        raise DecodeError(f"{path} is not a NumPy array file: {error}", hint=_ARRAY) from error
    whole = all(type(n) is int and n >= 0 for n in shape)
    if (
        not whole
        or fortran
        or len(shape) != 3
        or dtype not in (np.uint8, np.uint16)
        or shape[1] * shape[2] > MAX_PIXELS
    ):
        raise DecodeError(
            f"{path}: expected uint8 or uint16 of shape (slots, height, width), found {dtype} {shape}", hint=_ARRAY
        )
    return shape, dtype, offset


_PIXEL_BYTES = 32
"""The most that an image file takes for a pixel: plain text PPM has three numbers of five digits, and has comments"""

MOST_FULL = 0.01
"""Share of a colour image's pixels that may have a saturated channel: glints"""

_IMAGE_HEAD_BYTES = 4 << 20
"""... and before and after the pixels: colour profile, thumbnail, what a camera says of itself"""

_ARRAY = "copy it again, or write it with numpy.save: (slots, height, width), uint8 or uint16, in C order"
_NO_FRAME = "copy the folder again, or capture again; without frames.jsonl all slots are taken, in pattern order"
_BITS = "camera.bits in capture.json: up to 8 for uint8, 9 to 16 for uint16"


def _read_image(path: Path, camera: CameraFormat) -> NDArray[Any]:
    """The pixels of a file: (height, width), or (height, width, 3) where it is in colour."""
    if not path.is_file():
        raise DecodeError(f"frame {path} is missing", hint="copy it there, or correct frames in capture.json")
    try:
        content = read_small(path, _IMAGE_HEAD_BYTES + _PIXEL_BYTES * camera.width * camera.height)
    except OSError as error:
        raise DecodeError(f"frame {path} cannot be read: {error.strerror}") from error
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED) if content else None
    # OpenCV fills a JPEG that breaks off with grey and says nothing.
    if image is None or (content[:2] == b"\xff\xd8" and b"\xff\xd9" not in content[-64:]):
        raise DecodeError(f"frame {path} cannot be read as an image", hint="PNG, TIFF, PGM or BMP, 8 or 16 bit")
    if image.ndim == 2:
        return np.asarray(image)
    return np.asarray(image[..., 0] if image.shape[2] == 1 else image[..., :3])  # without alpha


def _grey(image: NDArray[Any], camera: CameraFormat, name: str) -> Pixels:
    """The frame that an image is, if it is one of this camera: luma of colour."""
    if image.shape[:2] != camera.shape:
        raise DecodeError(
            f"frame {name} is {image.shape[1]} x {image.shape[0]}, capture.json says {camera.width} x {camera.height}",
            hint="all frames have the camera's size: take the one that belongs here, or correct camera in capture.json",
        )
    if image.dtype != camera.dtype:
        raise DecodeError(f"frame {name} is {image.dtype}, {camera.bits} bits need {camera.dtype}", hint=_BITS)
    luma = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return _within_range(np.asarray(luma, dtype=camera.dtype), camera, name)


def _within_range(frame: Pixels, camera: CameraFormat, name: str) -> Pixels:
    if camera.bits not in (8, 16) and int(frame.max()) > camera.max_value:
        raise DecodeError(
            f"{name}: grey level {int(frame.max())} in a frame of {camera.bits} bits",
            hint="samples are right-aligned: say the right camera.bits, or shift them down",
        )
    return frame


def _inside(folder: Path, name: str, hint: str = "paths are relative to the folder") -> Path:
    try:
        path = (folder / name).resolve()
        path.exists()
    except (OSError, ValueError, RuntimeError) as error:
        raise DecodeError(f"{folder}: {name!r:.80} is no file name: {error!s:.80}") from error
    if not path.is_relative_to(folder.resolve()):
        raise DecodeError(f"{folder}: {name!r} leads out of the capture folder", hint=hint)
    return path
