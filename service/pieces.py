"""Pieces of files as answers: where they are many, bytes are read into those of the answer.

Which file it is, and whether it may be read, is `service.control`'s.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

from scanner.errors import StorageError
from scanner.storage import temporary_of
from scanner.wire import answer_head


@dataclass(frozen=True)
class Encoded:
    """A result that stands in its answer's bytes already."""

    data: bytes


def piece(path: Path, offset: int, length: int) -> bytes:
    """Bytes of a file; fewer where it ends before.

    Raises:
        StorageError: it cannot be read.
    """
    with _opened(path) as file:
        return os.pread(file.fileno(), length, offset)


def large_piece(number: int | str | None, path: Path, offset: int, length: int) -> Encoded | bytes:
    """The answer, read into its own bytes; of a file that is shorter than it was the bytes that there are."""
    head = answer_head(number, length)
    answer = bytearray(len(head) + length)
    answer[: len(head)] = head
    with _opened(path) as file:
        got = os.preadv(file.fileno(), [memoryview(answer)[len(head) :]], offset)
    # A bytearray, of which a socket takes the bytes like those of any other.
    return Encoded(cast(bytes, answer)) if got == length else bytes(answer[len(head) : len(head) + got])


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """A file, or its bytes so far where it is not whole yet; it may become that meanwhile."""
    try:
        for place in (path, temporary_of(path), path):
            try:
                file = place.open("rb", buffering=0)
            except FileNotFoundError as error:
                missing = error
                continue
            with file:
                yield file
            return
        raise missing
    except OSError as error:
        raise StorageError(
            f"{path.name} cannot be read: {error.strerror}", hint="was the spool changed by hand?"
        ) from error
