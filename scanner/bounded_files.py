"""The one door for small files that may come from anywhere: captures, calibrations, rig files and others of text.

What is no regular file (a device without an end, a pipe that nobody writes) is refused before anything is read, and so
is what is larger than such a file can be. Frames and scans have readers of their own.
"""

from __future__ import annotations

import errno
import io
import os
import stat
from pathlib import Path

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


def _opener(path: str, flags: int) -> int:
    """Without O_NONBLOCK a pipe waits here for its writer."""
    return os.open(path, flags | os.O_NONBLOCK)
