"""Jobs: what was asked for and how far it has come, on disk before any device moves.

A job is keyed by the id that the client made, the client's name and a digest of the parameters: asking again gives the
same job, asking for something else under the same id is an error. Records live seven days after their end; what is
left of them then is the id, so that it never becomes a new scan. No device, socket or file of pixels is touched here.
"""

from __future__ import annotations

import hashlib
import logging
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import msgspec

from scanner.errors import ScannerError, StorageError
from scanner.storage import replace_file, replace_json, storage_errors, sync_folder
from scanner.wire import TERMINAL_STATES, ArrayEntry, ErrorBody, FileEntry, LiveStart, Refused, ScanStart, error_body

FORMAT = "fringed-job"
VERSION = 1

KEEP_S = 7 * 86400.0
"""A record lives this long after its job ended, and as long as its files do."""

REMEMBER_S = 365 * 86400.0
"""The id of an expired record is remembered this long."""

MAX_DELIVERIES = 3
"""A series that was sent this often without an answer is given up."""

Params = ScanStart | LiveStart
"""What a job was asked for with: a scan, or a live run."""

_EXPIRED_FILE = "expired.jsonl"
_log = logging.getLogger(__name__)


class JobState(StrEnum):
    """Where a job stands.

    queued -> acquiring -> acquired -> decoding -> decoded -> done
       any but the last may become failed or cancelled; decoding and decoded fall back to acquired when a worker is lost
    """

    QUEUED = "queued"
    ACQUIRING = "acquiring"
    ACQUIRED = "acquired"
    DECODING = "decoding"
    DECODED = "decoded"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def over(self) -> bool:
        """Whether a job stays in this state."""
        return self in TERMINAL_STATES


_NEXT: dict[JobState, frozenset[JobState]] = {
    JobState.QUEUED: frozenset({JobState.ACQUIRING}),
    JobState.ACQUIRING: frozenset({JobState.ACQUIRED}),
    JobState.ACQUIRED: frozenset({JobState.DECODING, JobState.DECODED, JobState.DONE}),
    JobState.DECODING: frozenset({JobState.DECODED, JobState.DONE, JobState.ACQUIRED}),
    JobState.DECODED: frozenset({JobState.DONE, JobState.ACQUIRED}),
}


@dataclass
class Job:
    """One job's life; `state` changes through `become` alone."""

    id: str
    client: str
    params: Params
    state: JobState = JobState.QUEUED
    reason: str | None = None
    """why it ended or its series did: completed, cancelled, worker_lost, ... (formats.md, Wire)"""
    error: ErrorBody | None = None
    created: float = field(default_factory=time.time)
    """seconds since 1970"""
    ended: float | None = None
    deliveries: int = 0
    """how often its series was sent to a worker"""
    output: str | None = None
    """folder of the scan's files, in the job's folder of the spool"""
    files: tuple[FileEntry, ...] = ()
    arrays: tuple[ArrayEntry, ...] = ()
    """of scan.npz, which can be read before that is whole"""
    report: dict[str, Any] = field(default_factory=dict)
    acknowledged: bool = False
    """its client has what it needs"""
    deleted: bool = False
    """its files are gone from the spool"""
    captured: int = 0
    total: int = 0
    stage: str = ""

    @property
    def kind(self) -> str:
        """scan or live"""
        return "live" if isinstance(self.params, LiveStart) else "scan"

    @property
    def digest(self) -> str:
        """Digest of the parameters."""
        return parameters_digest(self.params)

    def become(self, state: JobState, *, reason: str | None = None, error: ScannerError | None = None) -> None:
        """Change state.

        Raises:
            ValueError: no such change exists: a fault of the program.
        """
        allowed = _NEXT.get(self.state, frozenset())
        if state not in allowed and (self.state.over or state not in (JobState.FAILED, JobState.CANCELLED)):
            raise ValueError(f"job {self.id}: {self.state} does not become {state}")
        self.state = state
        self.reason = reason or self.reason
        if error is not None:
            self.error = error_body(error)
        if state.over:
            self.ended = time.time()

    def readable(self, name: str) -> int | None:
        """Bytes of a file that clients may fetch; of scan.npz, before it is whole, up to the arrays that are there."""
        whole = next((entry.bytes for entry in self.files if entry.name == name), None)
        if whole is None and name == "scan.npz" and self.arrays:
            return max(array.offset + array.bytes for array in self.arrays)
        return whole

    def status(self) -> dict[str, Any]:
        """What `scan.status` and `scan.list` say of it."""
        return {
            "id": self.id,
            "kind": self.kind,
            "method": self.params.method,
            "state": self.state.value,
            "reason": self.reason,
            "captured": self.captured,
            "total": self.total,
            "stage": self.stage,
            "created": self.created,
            "ended": self.ended,
            "acknowledged": self.acknowledged,
            "deleted": self.deleted,
            "error": None if self.error is None else msgspec.to_builtins(self.error),
        }

    def result(self) -> dict[str, Any]:
        """What `scan.result` says of it."""
        return {
            "id": self.id,
            "state": self.state.value,
            "reason": self.reason,
            "report": self.report,
            "files": [] if self.deleted else [msgspec.to_builtins(entry) for entry in self.files],
            "error": None if self.error is None else msgspec.to_builtins(self.error),
        }

    def record(self) -> dict[str, Any]:
        """The job as its file has it."""
        return {
            "format": FORMAT,
            "version": VERSION,
            **self.result(),
            "files": [msgspec.to_builtins(entry) for entry in self.files],
            "client": self.client,
            "digest": self.digest,
            "kind": self.kind,
            "params": msgspec.to_builtins(self.params),
            "created": self.created,
            "ended": self.ended,
            "deliveries": self.deliveries,
            "output": self.output,
            "acknowledged": self.acknowledged,
            "deleted": self.deleted,
        }

    @classmethod
    def from_record(cls, content: Any) -> Job:
        """Read a job's file.

        Raises:
            ValueError, TypeError, KeyError, AttributeError: it is none.
        """
        if not isinstance(content, dict) or content.get("format") != FORMAT or content.get("version") != VERSION:
            raise ValueError(f"not a version {VERSION} {FORMAT} file")
        error = content.get("error")
        return cls(
            id=str(uuid.UUID(content["id"])),
            client=str(content["client"]),
            params=_params(content.get("kind", "scan"), content["params"]),
            state=JobState(content["state"]),
            reason=content.get("reason"),
            error=None if error is None else msgspec.convert(error, ErrorBody),
            created=float(content["created"]),
            ended=content.get("ended"),
            deliveries=int(content.get("deliveries", 0)),
            output=content.get("output"),
            files=tuple(msgspec.convert(content.get("files", []), list[FileEntry])),
            report=dict(content.get("report") or {}),
            acknowledged=bool(content.get("acknowledged")),
            deleted=bool(content.get("deleted")),
        )


class JobStore:
    """The records of all jobs, in a folder of one JSON file each. One thread at a time."""

    def __init__(self, folder: Path, now: Callable[[], float] = time.time) -> None:
        """Read the folder; a file that is no record is reported and left alone.

        Raises:
            StorageError: the folder cannot be made or read.
        """
        self.folder = folder
        self._now = now
        self._jobs: dict[str, Job] = {}
        with storage_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            for path in sorted(folder.glob("*.json")):
                self._load(path)
            self._expired = self._read_expired()

    def __iter__(self) -> Iterator[Job]:
        return iter(sorted(self._jobs.values(), key=lambda job: job.created))

    def find(self, params: Params, client: str) -> Job | None:
        """The job that was asked for before, or None.

        Raises:
            Refused: job_id is no UUID, has expired, or was used for something else.
        """
        job_id = canonical_id(params.job_id)
        if job_id in self._expired:
            raise _unknown(job_id, "its record has expired")
        job = self._jobs.get(job_id)
        if job is None:
            return None
        # An unnamed caller is known by the id alone: a UUID is hard to guess.
        same_client = not client or not job.client or client == job.client
        if not same_client or job.digest != parameters_digest(params):
            raise Refused(
                f"job {job_id} was asked for {'by another client' if not same_client else 'with other parameters'}",
                reason="job_id_reused",
                hint="make a new UUID for every new scan; repeat the same one only with the same parameters",
            )
        return job

    def make(self, params: Params, client: str) -> Job:
        """A new job, known from now on. It is the caller's to `write` it before anything is done about it."""
        job = Job(id=canonical_id(params.job_id), client=client, params=params, created=self._now())
        self._jobs[job.id] = job
        return job

    def forget(self, job: Job) -> None:
        """Take back a job that could not be written."""
        self._jobs.pop(job.id, None)

    def get(self, job_id: str) -> Job:
        """A job by its id.

        Raises:
            Refused: there is none, or it has expired.
        """
        job = self._jobs.get(canonical_id(job_id))
        if job is None:
            raise _unknown(job_id, "its record has expired" if job_id in self._expired else "it was never asked for")
        return job

    def write(self, job_id: str, record: Mapping[str, Any]) -> None:
        """Write a job's record (`Job.record`, taken at the moment that it tells of).

        Raises:
            StorageError: the disk is full or failed.
        """
        replace_json(self.folder / f"{job_id}.json", record)

    def record(self, job: Job) -> None:
        """Write a job's record as it is now; see `write`."""
        self.write(job.id, job.record())

    def unfinished(self) -> list[Job]:
        """Jobs that are not over, oldest first."""
        return [job for job in self if not job.state.over]

    def expire(self, has_files: Callable[[Job], bool]) -> list[Job]:
        """Forget jobs that ended more than `KEEP_S` ago and have no files any more, but for their ids; returns them."""
        now = self._now()
        old = [job for job in self._jobs.values() if job.ended is not None and now - job.ended > KEEP_S]
        gone = [job for job in old if not has_files(job)]
        if not gone:
            return []
        self._expired |= {job.id: now for job in gone}
        self._expired = {key: when for key, when in self._expired.items() if now - when <= REMEMBER_S}
        lines = b"".join(msgspec.json.encode([key, when]) + b"\n" for key, when in self._expired.items())
        replace_file(self.folder / _EXPIRED_FILE, lines)
        with storage_errors(self.folder):
            for job in gone:
                del self._jobs[job.id]
                (self.folder / f"{job.id}.json").unlink(missing_ok=True)
            sync_folder(self.folder)
        return gone

    def _load(self, path: Path) -> None:
        try:
            job = Job.from_record(msgspec.json.decode(path.read_bytes()))
        except (msgspec.MsgspecError, ValueError, TypeError, KeyError, AttributeError) as error:
            _log.error("job record %s is damaged and was left alone: %s", path, error)
            return
        self._jobs[job.id] = job

    def _read_expired(self) -> dict[str, float]:
        path = self.folder / _EXPIRED_FILE
        if not path.exists():
            return {}
        try:
            lines = [msgspec.json.decode(line) for line in path.read_bytes().splitlines()]
            return {str(key): float(when) for key, when in lines}
        except (msgspec.MsgspecError, ValueError, TypeError) as error:
            raise StorageError(
                f"{path} is damaged: {error}", hint="remove it if no expired scan is asked for"
            ) from error


def canonical_id(job_id: str) -> str:
    """A job id in the one form that file names have.

    Raises:
        Refused: it is no UUID.
    """
    try:
        return str(uuid.UUID(job_id))
    except ValueError:
        raise Refused(f"job id {job_id[:80]!r} is not a UUID", reason="invalid_params") from None


def parameters_digest(params: Params) -> str:
    """SHA-256 of the parameters without the job id: the same whether defaults are spelled out or not."""
    from service.door import plain  # noqa: PLC0415  (brings NumPy, which records alone do not need)

    content = plain(params)
    content.pop("job_id")
    if isinstance(params, LiveStart):
        content["kind"] = "live"  # never the same as a scan with the same words
    return hashlib.sha256(msgspec.msgpack.encode(content, order="sorted")).hexdigest()


def _params(kind: str, content: Any) -> Params:
    return msgspec.convert(content, LiveStart) if kind == "live" else msgspec.convert(content, ScanStart)


def _unknown(job_id: str, why: str) -> Refused:
    return Refused(f"there is no job {job_id}: {why}", reason="unknown_job", hint="scan.list names the jobs there are")
