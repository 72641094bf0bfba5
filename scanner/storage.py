"""Writing files so that a crash at any moment leaves the old one or the new one, whole.

Also: output folders that are refused unless empty, and room on the disk asked for before it is needed.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import queue
import shutil
import threading
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, BinaryIO, cast

from scanner.errors import StorageError


def sync_folder(folder: Path) -> None:
    """Make the names in `folder` last: fsync of the directory."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def replace_file(path: Path, content: bytes, digests: dict[str, str] | None = None) -> None:
    """Write `content` to `path`: a temporary file beside it, fsync, rename, fsync of the folder. digests: `replacing`.

    Raises:
        StorageError: the disk is full, or the folder cannot be written.
    """
    with replacing(path, digests) as file:
        file.write(content)


@contextmanager
def replacing(path: Path, digests: dict[str, str] | None = None) -> Iterator[BinaryIO]:
    """A file to write; on leaving it takes the place of `path`, as `replace_file` says. Nothing is left on failure.

    Args:
        digests: takes the SHA-256 of what was written, by the file's name. It is made in another thread while this one
            writes: from front to back, in buffers that do not change before the end.

    Raises:
        StorageError: the disk is full, or the folder cannot be written.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    with storage_errors(path):
        try:
            with temporary.open("wb") as file, ExitStack() as reading:
                told = file if digests is None else reading.enter_context(_Digesting(file))
                yield cast(BinaryIO, told)
                file.flush()
                os.fsync(file.fileno())
            if digests is not None:
                digests[path.name] = cast(_Digesting, told).hexdigest()
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)


class _Digesting:
    """A file that can be written, and a thread that makes the digest of what is."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._sha = hashlib.sha256()
        self._parts: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._digest, name="digest")
        self.tell, self.flush = file.tell, file.flush

    def __enter__(self) -> _Digesting:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._parts.put(None)
        self._thread.join()

    def write(self, part: Any) -> int:
        """Write bytes that do not change until the file is closed."""
        self._parts.put(part)
        return self._file.write(part)

    def hexdigest(self) -> str:
        """SHA-256 of all that was written, once the file is closed."""
        return self._sha.hexdigest()

    def _digest(self) -> None:
        while (part := self._parts.get()) is not None:
            self._sha.update(part)


def replace_json(path: Path, content: Any, digests: dict[str, str] | None = None) -> None:
    """Write plain data as JSON with `replace_file`."""
    replace_file(path, (json.dumps(content, indent=1) + "\n").encode(), digests)


def prepare_output(folder: Path, *, force: bool = False) -> Path:
    """Make an output folder, or take one that is empty.

    Raises:
        StorageError: not a folder, not writable, or not empty and not `force`.
    """
    with storage_errors(folder):
        if folder.exists() and not folder.is_dir():
            raise StorageError(f"{folder} is a file, an output folder is needed", hint="give another -o DIR")
        if folder.is_dir() and any(folder.iterdir()) and not force:
            raise StorageError(f"{folder} is not empty", hint="give another -o DIR, or --force to write into it")
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise StorageError(f"{folder} is not writable", hint="give another -o DIR")
    return folder


def try_output(folder: Path, *, force: bool = False) -> None:
    """Look whether `prepare_output` will do, long before there is something to write. Leaves nothing.

    Raises:
        StorageError: as `prepare_output`.
    """
    new = not_there(folder)
    prepare_output(folder, force=force)
    remove_empty(new)


def not_there(folder: Path) -> list[Path]:
    """The folder and those around it that do not exist yet, innermost first: what making it would make.

    Raises:
        StorageError: it cannot be looked at.
    """
    with storage_errors(folder):
        return [path for path in (folder, *folder.parents) if not path.exists()]


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders that were made in vain, innermost first; one that somebody uses stays, and those around it."""
    for folder in folders:
        try:
            folder.rmdir()
        except FileNotFoundError:
            continue
        except OSError:
            return


def check_room(folder: Path, needed: int) -> None:
    """Ask for `needed` bytes of free space under `folder`, or under its nearest existing parent.

    Raises:
        StorageError: there is less.
    """
    place = next(parent for parent in (folder, *folder.resolve().parents) if parent.exists())
    free = shutil.disk_usage(place).free
    if free < needed:
        raise StorageError(
            f"{folder} needs {needed / 1e6:.0f} MB, the disk has {free / 1e6:.0f} MB left",
            hint="free some space, or give a folder on another disk",
        )


@contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turn the system's errors about `path` into StorageError with a hint."""
    hints = {
        errno.ENOSPC: "the disk is full: free some space",
        errno.EDQUOT: "the quota is used up: free some space",
        errno.EACCES: "this user may not write there",
        errno.EROFS: "the file system is read-only",
        errno.EMFILE: "too many open files: raise the limit (ulimit -n)",
    }
    try:
        yield
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror or error}", hint=hints.get(error.errno or 0)) from error
