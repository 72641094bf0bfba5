"""Writing files so that a crash at any moment leaves the old one or the new one, whole.

Also: output folders that are refused unless empty, and room on the disk asked for before it is needed.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
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


def replace_file(path: Path, content: bytes, digests: Digests | None = None) -> None:
    """Write `content` to `path`: a temporary file beside it, fsync, rename, fsync of the folder. digests: `replacing`.

    Raises:
        StorageError: the disk is full, or the folder cannot be written.
    """
    with replacing(path, digests) as file:
        file.write(content)


@contextmanager
def replacing(path: Path, digests: Digests | None = None, *, room: int = 0) -> Iterator[BinaryIO]:
    """A file to write; on leaving it takes the place of `path`, as `replace_file` says. Nothing is left on failure.

    Args:
        path: the file; until then its bytes are in `temporary_of(path)`.
        digests: makes the SHA-256 of what was written, once it is there: from buffers that do not change until then.
        room: bytes that will be written at most; taken from the disk at once, which then writes them faster.

    Raises:
        StorageError: the disk is full, the folder cannot be written, or a device or folder is there.
    """
    temporary = temporary_of(path)
    with storage_errors(path):
        _require_replaceable(path)
        try:
            with temporary.open("wb", buffering=0) as raw:
                if room:
                    os.posix_fallocate(raw.fileno(), 0, room)
                file = Written(raw, remember=digests is not None)
                yield cast(BinaryIO, file)
                if room:
                    os.ftruncate(raw.fileno(), raw.tell())
                os.fsync(raw.fileno())
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)
    if digests is not None:
        # Not before: it would take the processor from what is still being written.
        digests.begin(path.name, file.parts)


def try_file(path: Path) -> None:
    """Look whether `replace_file` will do, long before there is something to write. Leaves nothing.

    Raises:
        StorageError: it will not.
    """
    with storage_errors(path):
        _require_replaceable(path)
        if not path.parent.is_dir():
            raise StorageError(f"{path} cannot be written: there is no folder {path.parent}", hint="make it first")
        temporary = temporary_of(path)
        temporary.touch()
        temporary.unlink()


def _require_replaceable(path: Path) -> None:
    # A rename would put a file in the place of /dev/null, for everybody on the machine.
    if path.exists() and not path.is_file():
        what = "a folder" if path.is_dir() else "a device, pipe or socket"
        raise StorageError(f"{path} is {what}, a file is to be written", hint="give another name")


def temporary_of(path: Path) -> Path:
    """Where the bytes of a file are until it is whole and takes its place."""
    return path.with_name(f".{path.name}.tmp")


class Written:
    """A file that is written straight from memory, and may remember from where."""

    def __init__(self, file: Any, *, remember: bool) -> None:
        self._file = file
        self._remember = remember
        self.parts: list[Any] = []
        self.tell = file.tell

    def write(self, part: Any) -> int:
        """Write bytes that do not change until their digest is made."""
        left = memoryview(part).cast("B")
        size = len(left)
        if self._remember:
            self.parts.append(part)
        while left:
            left = left[self._file.write(left) :]
        return size

    def rewrite(self, part: bytearray, offset: int) -> None:
        """Write again, at its place, a part that was changed since it was written."""
        left = memoryview(part)
        while left:
            done = os.pwrite(self._file.fileno(), left, offset)
            left, offset = left[done:], offset + done

    def flush(self) -> None:
        """Nothing waits in here."""


class Digests:
    """SHA-256 of files by name, made in threads of their own. Used in a `with` statement."""

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(2, thread_name_prefix="digest")
        self._made: dict[str, Future[str]] = {}

    def __enter__(self) -> Digests:
        return self

    def __exit__(self, *_: object) -> None:
        self._threads.shutdown()

    def begin(self, name: str, parts: Sequence[Any]) -> None:
        """Make the digest of a file of these parts."""
        self._made[name] = self._threads.submit(_sha256, parts)

    def of(self, name: str) -> str:
        """A file's digest, once it is made."""
        return self._made[name].result()


def _sha256(parts: Sequence[Any]) -> str:
    sha = hashlib.sha256()
    for part in parts:
        sha.update(part)
    return sha.hexdigest()


def replace_json(path: Path, content: Any, digests: Digests | None = None) -> None:
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


def is_full(error: StorageError) -> bool:
    """Whether it was for want of room: deleting something helps."""
    return isinstance(error.__cause__, OSError) and error.__cause__.errno in (errno.ENOSPC, errno.EDQUOT)


@contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turn the system's errors about `path` into StorageError with a hint."""
    hints = {
        errno.ENOSPC: "the disk is full: free some space",
        errno.EDQUOT: "the quota is used up: free some space",
        errno.EFBIG: "files of this size are not allowed there: raise the limit (ulimit -f), or give another disk",
        errno.EACCES: "this user may not write there",
        errno.EPERM: "this user may not write there",
        errno.EROFS: "the file system is read-only",
        errno.ENOENT: "nothing can be made there: make its folder (mkdir -p), or give another place",
        errno.ENOTDIR: "a part of this path is a file: give another",
        errno.EMFILE: "too many open files: raise the limit (ulimit -n)",
    }
    try:
        yield
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror or error}", hint=hints.get(error.errno or 0)) from error
