"""The spool: a folder for each job with its capture and scan, and what may be deleted from it.

Never deleted without a person's word: a series that is not decoded yet or could not be, that its client has not
acknowledged (until it is older than the rig file's limit), or that somebody is reading. Where that leaves no room a
new scan is refused.
"""

from __future__ import annotations

import logging
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from scanner.errors import StorageError
from scanner.storage import check_room, is_full, storage_errors
from service.jobs import Job, JobState

CAPTURE = "capture"
_TRASH = ".deleted-"

LEASE_S = 120.0
"""Files that were read this recently are still being read."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Limits:
    """When scans leave the spool. None: no limit."""

    bytes: int | None = None
    """most that the spool may hold"""
    min_free_bytes: int = 0
    """what the disk keeps free"""
    max_age_s: float | None = None
    """a decoded scan older than this may go even if nobody acknowledged it, and goes in any case"""


@dataclass
class Spool:
    """The folder and its limits. One thread at a time."""

    root: Path
    limits: Limits = Limits()
    now: Callable[[], float] = time.time
    record: Callable[[Job], None] = lambda _: None
    """writes a job's record, once its files are gone (the pipeline's, into its store)"""
    _leases: dict[str, float] = field(default_factory=dict)

    def prepare(self) -> None:
        """Make the folder and finish deletions that a crash interrupted.

        Raises:
            StorageError: it cannot be made or written.
        """
        with storage_errors(self.root):
            self.root.mkdir(parents=True, exist_ok=True)
            for rest in self.root.glob(f"{_TRASH}*"):
                shutil.rmtree(rest)

    def folder(self, job_id: str) -> Path:
        """A job's folder."""
        return self.root / job_id

    def capture(self, job_id: str) -> Path:
        """A job's capture folder."""
        return self.root / job_id / CAPTURE

    def lease(self, job_id: str) -> None:
        """Somebody reads this job's files now."""
        self._leases[job_id] = self.now() + LEASE_S

    def used(self) -> int:
        """Bytes that the spool takes on disk."""
        return sum(_folder_bytes(folder) for folder in self._folders())

    def make_room(self, needed: int, jobs: Iterable[Job]) -> list[Job]:
        """Delete what may go, oldest first, until `needed` more bytes fit; returns the jobs whose files went.

        Raises:
            StorageError: they would not fit even so: nothing was deleted.
        """
        gone: list[Job] = []
        candidates = [job for job in jobs if self.may_go(job)]
        problem = self._no_room(needed)
        if problem is not None:
            could_go = sum(_folder_bytes(self.folder(job.id)) for job in candidates)
            if self._no_room(needed - could_go) is not None:
                raise problem
        for job in candidates:
            if self._no_room(needed) is None:
                break
            self.delete(job)
            gone.append(job)
        return gone

    def sweep(self, jobs: Iterable[Job]) -> list[Job]:
        """Delete decoded scans older than the limit; returns the jobs whose files went."""
        old = [job for job in jobs if self._old(job) and self.may_go(job)]
        for job in old:
            self.delete(job)
        return old

    def may_go(self, job: Job) -> bool:
        """Whether a job's files may be deleted without asking."""
        if job.deleted or not job.state.over or self._leases.get(job.id, 0.0) > self.now():
            return False
        if job.state is JobState.FAILED:
            return False  # never decoded: somebody may want to know why
        return job.state is JobState.CANCELLED or job.acknowledged or self._old(job)

    def delete(self, job: Job) -> None:
        """Delete a job's files.

        Raises:
            StorageError: the folder cannot be changed.
        """
        empty_trash(self.remove(job))

    def remove(self, job: Job) -> Path:
        """Take a job's files out of the spool at once, and record it; returns where they are until `empty_trash`.

        Raises:
            StorageError: the folder cannot be changed, or the record not written: the files are where they were.
        """
        folder, trash = self.folder(job.id), self.root / f"{_TRASH}{job.id}"
        with storage_errors(folder):
            taken = folder.exists()
            if taken:
                folder.rename(trash)
        before, job.deleted = job.deleted, True
        try:
            self.record(job)
        except StorageError as problem:
            if is_full(problem):
                self._record_in_their_place(job, trash)
            else:
                if taken:
                    with storage_errors(folder):
                        trash.rename(folder)
                job.deleted = before
                raise
        self._leases.pop(job.id, None)
        _log.info("files of job %s deleted", job.id)
        return trash

    def _record_in_their_place(self, job: Job, trash: Path) -> None:
        """A full disk has no room for the record but what the files take: they go first."""
        empty_trash(trash)
        try:
            self.record(job)
        except StorageError as problem:  # filled again meanwhile; the next daemon sees that there is no folder
            _log.error("job %s is deleted, which cannot be recorded: %s", job.id, problem)

    def _old(self, job: Job) -> bool:
        age = self.limits.max_age_s
        return age is not None and job.ended is not None and self.now() - job.ended > age

    def _no_room(self, needed: int) -> StorageError | None:
        limit = self.limits.bytes
        if limit is not None and (used := self.used()) + needed > limit:
            return StorageError(
                f"the spool holds {used / 1e6:.0f} MB of {limit / 1e6:.0f} MB and the scan needs {needed / 1e6:.0f} MB",
                hint="fetch and acknowledge scans, delete failed ones (scan.delete), or raise daemon.spool_limit_gb",
            )
        try:
            check_room(self.root, needed + self.limits.min_free_bytes)
        except StorageError as error:
            return error
        return None

    def _folders(self) -> Iterator[Path]:
        with storage_errors(self.root):
            yield from (folder for folder in self.root.iterdir() if folder.is_dir())


def empty_trash(trash: Path) -> None:
    """Free the bytes of removed files; may take as long as the disk likes."""
    with storage_errors(trash):
        if trash.exists():
            shutil.rmtree(trash)


def _folder_bytes(folder: Path) -> int:
    """Bytes on disk: files reserved ahead count with what they reserved."""
    total = 0
    for parent, _, names in os.walk(folder):  # what is removed meanwhile counts nothing
        for name in names:
            try:
                total += (Path(parent) / name).stat().st_blocks * 512
            except FileNotFoundError:
                continue
    return total
