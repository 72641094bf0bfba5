"""What a capture folder says of itself: capture.json, the lines of frames.jsonl, and the head of frames.npy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Literal

import numpy as np
import xxhash

from scanner.devices import Exposure, Flip, Pixels, Source
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, PatternSequence, ProjectorSize

FORMAT = "fringed-capture"
VERSION = 1
HEADER_FILE = "capture.json"
FRAMES_FILE = "frames.npy"
RECORDS_FILE = "frames.jsonl"

NPY_HEADER_BYTES = 128
MAX_REPEAT = 100_000
MOSAICS = ("RGGB", "GRBG", "GBRG", "BGGR")
"""Colours of the first two rows' first two pixels."""

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
        xxh3 = line.get("xxh3")
        if xxh3 is not None and not isinstance(xxh3, str):
            raise ValueError("not a frame record")
        if status not in ("ok", "incomplete", "missing") or line["pattern"] < 0 or (slot is not None and slot < 0):
            raise ValueError("not a frame record")
        if any(not isinstance(line.get(count), int | None) for count in ("frame_id", "trigger")):
            raise TypeError("not a frame record")
        return cls(
            slot=None if slot is None else int(slot),
            pattern=int(line["pattern"]),
            attempt=int(line.get("attempt", 0)),
            status=status,
            xxh3=xxh3,
            frame_id=line.get("frame_id"),
            trigger=line.get("trigger"),
            exposure=None
            if exposure is None
            else Exposure(
                int(exposure["start_ns"]),
                int(exposure["end_ns"]),
                int(exposure["bound_ns"]),
                Source(exposure["source"]),
            ),
            flip=None
            if flip is None
            else Flip(int(flip["t_ns"]), int(flip["vblank"]), int(flip["bound_ns"]), Source(flip["source"])),
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
        if content.get("version") != VERSION or content["version"] is True:
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
        if isinstance(repeat, bool) or not isinstance(repeat, int) or not 1 <= repeat <= MAX_REPEAT:
            raise DecodeError(f"{name}: repeat must be an integer in 1 .. {MAX_REPEAT}, got {repeat!r:.80}")
        mosaic = camera.get("mosaic")
        if mosaic is not None and mosaic not in MOSAICS:
            raise DecodeError(f"{name}: camera.mosaic must be null or one of {', '.join(MOSAICS)}, got {mosaic!r:.80}")
        calibration, witnesses = content.get("calibration"), content.get("witnesses") or []
        if calibration is not None and not isinstance(calibration, str):
            raise DecodeError(f"{name}: calibration must be a file name or an id, got {calibration!r:.80}")
        if not isinstance(witnesses, list) or not all(isinstance(witness, dict) for witness in witnesses):
            raise DecodeError(f"{name}: witnesses must be a list of objects")
        frames = content.get("frames")
        if frames is not None and not (isinstance(frames, list) and all(isinstance(f, str) for f in frames)):
            raise DecodeError(f"{name}: frames must be a list of file names")
        plan = content.get("plan")
        if plan is not None and not (isinstance(plan, dict) and isinstance(plan.get("why") or {}, dict)):
            raise DecodeError(f"{name}: plan must be null or an object, and why in it too, got {plan!r:.80}")
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
            camera=CameraFormat(width, height, bits, mosaic),
            id=str(content.get("id", "")),
            created=str(content.get("created", "")),
            repeat=repeat,
            calibration=calibration,
            state=state,
            reason=content.get("reason"),
            plan=plan,
            witnesses=tuple(witnesses),
            frames=None if frames is None else tuple(frames),
            extra={key: value for key, value in content.items() if key not in known},
        )


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


def npy_header(slots: int, camera: CameraFormat) -> bytes:
    """A version 1.0 NPY header, always 128 bytes long so that the count can be written over."""
    shape = (slots, camera.height, camera.width)
    text = f"{{'descr': '{camera.dtype.str}', 'fortran_order': False, 'shape': {shape}, }}"
    body = text.ljust(NPY_HEADER_BYTES - 11).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(body).to_bytes(2, "little") + body


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
