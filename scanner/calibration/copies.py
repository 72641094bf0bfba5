"""What is given twice: copies of one capture or scan, which agree perfectly and tell nothing new.

Poses that are copies make a calibration look surer than it is, repeats that are copies make a rig look steadier.
"""

from __future__ import annotations

import hashlib
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path

from scanner.capture import Capture
from scanner.capture.header import FRAMES_FILE


def again(path: Path, keys: Sequence[Hashable], seen: Mapping[Hashable, tuple[Path, str]]) -> str | None:
    """What is wrong with a path if one with the same key was seen, in words that follow its name; else None.

    seen: path and name by key.
    """
    for key in keys:
        if key in seen:
            earlier, name = seen[key]
            return "is given twice" if path.resolve() == earlier.resolve() else f"is a copy of {name}"
    return None


def file_key(path: Path) -> bytes:
    """SHA-256 of a file's content.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as content:
        return hashlib.file_digest(content, "sha256").digest()


def capture_key(capture: Capture) -> Hashable:
    """What copies of a capture that was read have in common, and no others: id and time, or else its pixels.

    A program that gives all its captures one id and no time is told apart by the pixels.

    Raises:
        OSError: a file of frames cannot be read.
    """
    header = capture.header
    if header.id and header.created:
        return header.id, header.created
    names = (FRAMES_FILE,) if header.frames is None else header.frames[: len(header.sequence)]
    return tuple(file_key(capture.path / name) for name in names)
