"""The one door for small files that may come from anywhere: captures, calibrations, rig files and others of text.

What is no regular file (a device without an end, a pipe that nobody writes) is refused before anything is read, and so
is what is larger than such a file can be. Frames and scans have readers of their own.
"""

from __future__ import annotations

import errno
import io
import json
import os
import stat
from pathlib import Path
from typing import Any

MAX_SMALL_BYTES = 64 << 20
"""The most that a JSON or JSON Lines file may have: a line of frames.jsonl takes 350 bytes, and a capture of 100,000
repetitions (the most there are) of one pattern 35 MB"""


def read_small(path: Path, limit: int = MAX_SMALL_BYTES) -> bytes:
    """A regular file's bytes; links are followed.

    Raises:
        OSError: it cannot be read (as from `open`), is no regular file, or has more than `limit` bytes: `strerror` says
            so in words.
    """
    with open(path, "rb", opener=_opener) as file:
        kind = os.fstat(file.fileno())
        if not stat.S_ISREG(kind.st_mode):
            raise OSError(errno.EINVAL, "it is a device, pipe or socket, and a regular file is needed", str(path))
        content = file.read(limit + 1) if kind.st_size <= limit else None
    if content is None or len(content) > limit:
        raise OSError(errno.EFBIG, f"it is larger than such a file may be ({limit / 1e6:.0f} MB)", str(path))
    return content


def read_small_text(path: Path, limit: int = MAX_SMALL_BYTES, encoding: str = "utf-8") -> str:
    """A regular file's text, with lines that end in a line feed.

    Raises:
        OSError: see `read_small`.
        UnicodeDecodeError: it is no text.
    """
    return io.TextIOWrapper(io.BytesIO(read_small(path, limit)), encoding=encoding).read()


def read_small_json(path: Path) -> Any:
    """What a JSON file says that people edit: a member that is there twice, an old line left beside the new one, would
    be the last one's without a word.

    Raises:
        OSError: see `read_small`.
        ValueError: it is no JSON, or an object has a member twice. RecursionError: it is nested too deeply.
    """
    return json.loads(read_small_text(path), object_pairs_hook=_once)


def _once(members: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(members)
    if len(found) < len(members):
        names = [name for name, _ in members]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{twice!r:.80} is there twice")
    return found


def _opener(path: str, flags: int) -> int:
    """Without O_NONBLOCK a pipe waits here for its writer."""
    return os.open(path, flags | os.O_NONBLOCK)
