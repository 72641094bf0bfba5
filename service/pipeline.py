"""A job's way through the daemon: queue, devices, spool, worker. One scan acquires while the one before decodes.

Each change of state is on disk before it is told. No device and no pixel is touched here.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import msgspec

from scanner.errors import ScannerError, StorageError
from scanner.stream import DecodedNote, LiveCounts, PointsNote, Progress, Result
from scanner.wire import LiveStart, Refused, ScanStart
from service.deliveries import WorkerLost
from service.devices_link import DevicesLink
from service.endings import error_of, reason_to_fail
from service.jobs import Job, JobState, JobStore
from service.pipe import Ended, Need
from service.scan_hearing import ScanHearing
from service.series import Series, capture_state, frames_kept, missing_patterns
from service.spool import Spool, empty_trash
from service.tasks import Tasks
from service.worker_pool import WorkerPool

MAX_QUEUED = 256
SWEEP_S = 600.0

_T = TypeVar("_T")
_log = logging.getLogger(__name__)
Publish = Callable[[str, str | None, Mapping[str, Any]], None]


class Pipeline:
    """All jobs of one daemon."""

    def __init__(
        self, store: JobStore, spool: Spool, devices: DevicesLink, workers: WorkerPool, publish: Publish
    ) -> None:
        self.store = store
        self.spool = spool
        spool.record = store.record
        self._devices = devices
        self._workers = workers
        self._publish = publish
        self._queue: deque[Job] = deque()
        self._queued = asyncio.Event()
        self._series: dict[str, Series] = {}
        self._acquiring: Job | None = None
        self._tasks = Tasks("the pipeline")
        # One thread: records reach the disk in the order in which they were made.
        self._disk = ThreadPoolExecutor(1, thread_name_prefix="records")

    def start(self, recover_live: Callable[[Job], Coroutine[Any, Any, None]]) -> None:
        """Take up what an earlier daemon left, then begin with the queue. Live runs are `recover_live`'s."""
        for job in self.store:
            if job.files and not job.deleted and not self.spool.folder(job.id).exists():
                job.deleted = True  # by a daemon that ended before it could say so
        for job in self.store.unfinished():
            self.spawn(recover_live(job) if isinstance(job.params, LiveStart) else self._recover(job))
        self.spawn(self._acquire_all())
        self.spawn(self._sweep())

    async def close(self) -> None:
        """Cancel the scan that acquires; what is being decoded is taken up by the next daemon."""
        acquiring = self._acquiring
        if acquiring is not None:
            await self.cancel(acquiring)
            deadline = time.monotonic() + 3.0
            while self._acquiring is acquiring and time.monotonic() < deadline:
                await asyncio.sleep(0.02)
        await self._tasks.close()
        self._disk.shutdown()

    @property
    def busy_with(self) -> Job | None:
        """A scan that has the devices, or waits for them."""
        # Those of the store: one whose record is being written is not in the queue yet.
        waiting = (job for job in self.store if job.state is JobState.QUEUED and job.kind == "scan")
        return self._acquiring or next(waiting, None)

    async def submit(self, params: ScanStart, client: str) -> Job:
        """The job of these parameters: the one that is there, or a new one, on disk when this returns.

        Raises:
            Refused: see `JobStore.find`; or too many wait.
            StorageError: its record cannot be written.
        """
        job = self.store.find(params, client)
        if job is not None:
            await self.on_disk(lambda: None)  # its record may still be on its way there
            job = self.store.find(params, client)  # forgotten, where it could not be written
        if job is not None:
            return job
        if len(self._queue) >= MAX_QUEUED:
            raise Refused(f"{MAX_QUEUED} scans wait already", reason="queue_full", hint="ask again later")
        job = self.store.make(params, client)
        try:
            await self.save(job)
        except StorageError:
            self.store.forget(job)
            raise
        self.tell(job, "queued")
        if job.state is JobState.QUEUED:
            self._queue.append(job)
            self._queued.set()
        return job

    async def cancel(self, job: Job) -> None:
        """Stop a job. One that is over stays as it is."""
        if job.state.over:
            return
        if job is self._acquiring:
            self._devices.cancel(job.id)
        if (series := self._series.get(job.id)) is not None:
            self._workers.cancel(series)
        await self.end(job, JobState.CANCELLED, reason="cancelled")

    async def acknowledge(self, job: Job) -> None:
        """Its client has what it needs.

        Raises:
            StorageError: that cannot be recorded; it is not acknowledged.
        """
        if job.acknowledged:
            return
        job.acknowledged = True
        try:
            await self.save(job)
        except StorageError:
            job.acknowledged = False
            raise

    async def delete(self, job: Job) -> None:
        """Delete a job's files now.

        Raises:
            Refused: it is not over.
            StorageError: the folder cannot be changed, or the record not written; nothing is deleted.
        """
        if not job.state.over:
            raise Refused(f"job {job.id} is {job.state}", reason="not_over", hint="cancel it first")
        trash = await self.on_disk(self.spool.remove, job)
        await asyncio.to_thread(empty_trash, trash)
        self._publish("spool.deleted", job.id, {})

    # --- acquiring ----------------------------------------------------------------------------------------------

    async def _acquire_all(self) -> None:
        while True:
            while not self._queue:
                self._queued.clear()
                await self._queued.wait()
            job = self._queue.popleft()
            if job.state is not JobState.QUEUED:
                continue
            self._acquiring = job
            try:
                await self._acquire(job)
            except ScannerError as error:
                await self.end(job, JobState.FAILED, reason="failed", error=error)
            except Exception as error:  # noqa: BLE001  (one scan that fails must not end the daemon)
                _log.exception("job %s", job.id)
                await self.end(job, JobState.FAILED, reason="failed", error=ScannerError(f"the daemon failed: {error}"))
            finally:
                self._acquiring = None

    async def _acquire(self, job: Job) -> None:
        job.become(JobState.ACQUIRING)
        # Its record has been on disk since it was asked for; what the capture folder says goes before this state.
        self.spawn(self._note(job))
        self.tell(job, "started")
        folder = self.spool.capture(job.id)
        ending = await self._devices.acquire(job.id, folder, job.params, ScanHearing(self, job))
        self.spawn(self._acquired(job, ending))  # the disk may still be busy with it when the next scan begins

    async def _acquired(self, job: Job, ending: Awaitable[Ended]) -> None:
        ended = await ending
        series = self._series.get(job.id)
        if job.state is JobState.FAILED:  # its decoding, meanwhile
            await self._keep_frames(job)
            await self._note(job)
        if job.state.over:
            return
        if ended.reason == "completed" and series is not None:
            job.become(JobState.ACQUIRED)
            await self._note(job)
            if job.state is JobState.CANCELLED:  # meanwhile
                return
            self.tell(job, "acquired", {"reason": ended.reason, "missing": ended.missing, **ended.report})
            series.finish("completed", tuple(ended.missing))
            return
        if series is not None:
            self._workers.cancel(series)
        if ended.reason == "cancelled":
            await self.end(job, JobState.CANCELLED, reason="cancelled")
            return
        error = error_of(ended)
        await self._keep_frames(job)
        await self.end(job, JobState.FAILED, reason=ended.reason or reason_to_fail(error), error=error)

    async def room_for(self, job: Job, need: Need) -> None:
        """Make room in the spool for a planned scan.

        Raises:
            StorageError: there is none.
        """
        job.total = need.frames
        self.tell(job, "plan", {"frames": need.frames, "bytes": need.bytes, "plan": need.plan})
        # While the scan before decodes, its room is taken already: files reserved ahead count in full.
        gone = await self.on_disk(self.spool.make_room, need.bytes, list(self.store))
        for deleted in gone:
            self._publish("spool.deleted", deleted.id, {})

    def began(self, job: Job) -> None:
        """A job's capture folder is there: a worker may begin."""
        self._follow(job, self._new_series(job))

    def grew(self, job: Job) -> None:
        """More of a job's frames are on disk."""
        if (series := self._series.get(job.id)) is not None:
            series.grew()

    def taken(self, job: Job, lines: int) -> None:
        """All of a job's frames are in its folder, in so many lines, and in step; the disk may still be busy."""
        if (series := self._series.get(job.id)) is not None:
            series.whole(lines)

    # --- decoding -----------------------------------------------------------------------------------------------

    def _new_series(self, job: Job) -> Series:
        options = {
            "decoder": job.params.decoder,
            "filters": msgspec.to_builtins(job.params.filters),
            "compare_truth": isinstance(job.params, ScanStart) and job.params.compare_truth,
        }
        return Series(
            job=job.id,
            capture=self.spool.capture(job.id),
            outputs=self.spool.folder(job.id),
            options=options,
            told=lambda message: self._hear(job, message),
            delivering=lambda number: self._delivering(job, number),
            deliveries=job.deliveries,
        )

    def _follow(self, job: Job, series: Series) -> None:
        self._series[job.id] = series
        self.spawn(self._decode(job, series))
        self._workers.submit(series)

    async def _decode(self, job: Job, series: Series) -> None:
        interrupted = job.reason == "daemon_restarted"
        try:
            result = await series.outcome
            await self._done(job, series, result)
        except asyncio.CancelledError:
            if not series.cancelled:
                raise
        except WorkerLost as lost:
            await self._fail(job, "worker_lost", lost.error)
        except ScannerError as error:
            await self._fail(job, "daemon_restarted" if interrupted else reason_to_fail(error), error)
        finally:
            self._series.pop(job.id, None)

    async def _done(self, job: Job, series: Series, result: Result) -> None:
        if job.state.over:
            return
        job.files, job.report, job.stage = tuple(result.files), result.report, ""
        reason = job.reason or "completed"
        await self.end(job, JobState.DONE, reason=reason)
        await self.on_disk(series.remove_outputs, job.output)

    def _hear(self, job: Job, message: Progress | PointsNote | DecodedNote | LiveCounts) -> None:
        if job.state.over or isinstance(message, LiveCounts):
            return
        if isinstance(message, Progress):
            job.stage = message.stage
            if job.state is JobState.ACQUIRED:
                job.become(JobState.DECODING)
            self.tell(job, "decoding", {"stage": message.stage})
            return
        if isinstance(message, PointsNote):
            job.arrays = tuple(message.arrays)
            self.tell(job, "points", {"file": "scan.npz", "arrays": msgspec.to_builtins(message.arrays)})
            return
        if job.state not in (JobState.ACQUIRED, JobState.DECODING):
            return
        job.files, job.report = tuple(message.files), message.report
        job.become(JobState.DECODED)
        self.tell(job, "decoded", {"report": message.report, "files": msgspec.to_builtins(message.files)})

    def _delivering(self, job: Job, number: int) -> None:
        job.deliveries += 1
        job.output = f"scan-{number}"
        job.files = job.arrays = ()
        if job.state in (JobState.DECODING, JobState.DECODED):
            job.become(JobState.ACQUIRED)
        self.spawn(self._note(job))

    # --- after a restart ----------------------------------------------------------------------------------------

    async def _recover(self, job: Job) -> None:
        """Take up a job that an earlier daemon left unfinished. What was whole is decoded, nothing is done again."""
        capture = self.spool.capture(job.id)
        state, reason, count = capture_state(capture)
        if state == "none" or (state == "failed" and reason != "daemon_restarted"):
            how = f" (capture: {reason})" if reason else ""
            error = ScannerError(
                f"the daemon was restarted while this scan was {job.state}{how}",
                hint="ask for the scan again with a new job id",
            )
            await self._keep_frames(job)
            await self.end(job, JobState.FAILED, reason="daemon_restarted", error=error)
            return
        job.state = JobState.ACQUIRED
        if state != "complete":
            job.reason = "daemon_restarted"
        missing = missing_patterns(capture, count)
        job.total, job.captured = count, count - len(missing)
        await self._note(job)
        if job.state is JobState.CANCELLED:  # meanwhile
            return
        series = self._new_series(job)
        series.finish("completed" if state == "complete" else "daemon_restarted", missing)
        self.tell(job, "acquired", {"reason": job.reason or "completed", "missing": list(missing)})
        self._follow(job, series)

    async def _fail(self, job: Job, reason: str, error: ScannerError) -> None:
        """End a job whose decoding failed; see `_keep_frames`."""
        if job.state is not JobState.ACQUIRING:  # else when its capture is closed
            await self._keep_frames(job)
        await self.end(job, JobState.FAILED, reason=reason, error=error)

    async def _keep_frames(self, job: Job) -> None:
        """List what a job that fails has recorded, now that it is closed: to be fetched and looked at."""
        kept = await asyncio.to_thread(frames_kept, self.spool.capture(job.id))
        if job.state is not JobState.CANCELLED:
            job.files = kept

    # --- small things -------------------------------------------------------------------------------------------

    async def end(self, job: Job, state: JobState, *, reason: str, error: ScannerError | None = None) -> None:
        """End a job: its state, on disk, then told. One that is over stays as it is."""
        if job.state.over:
            return
        job.become(state, reason=reason, error=error)
        await self._note(job)
        fields: dict[str, Any] = {"reason": job.reason}
        if state is JobState.DONE:
            fields["files"] = msgspec.to_builtins(job.files)
        if job.error is not None:
            fields["error"] = msgspec.to_builtins(job.error)
        self.tell(job, state.value, fields)
        _log.info("job %s is %s (%s)", job.id, state, job.reason)

    def tell(self, job: Job, kind: str, fields: Mapping[str, Any] | None = None) -> None:
        """Publish an event of a job."""
        self._publish(kind, job.id, {"state": job.state.value, **(fields or {})})

    async def save(self, job: Job) -> None:
        """Write a job's record."""
        await self.on_disk(self.store.write, job.id, job.record())

    async def _note(self, job: Job) -> None:
        """Write a job's record where it may stay behind: capture folder and older record are enough for a restart."""
        try:
            await self.save(job)
        except StorageError as problem:
            _log.error("job %s is %s, which cannot be recorded: %s", job.id, job.state, problem)

    async def on_disk(self, function: Callable[..., _T], *arguments: Any) -> _T:
        """Call in the one thread that changes records and spool."""
        return await asyncio.get_running_loop().run_in_executor(self._disk, function, *arguments)

    async def _sweep(self) -> None:
        while True:
            try:
                for job in await self.on_disk(self.spool.sweep, list(self.store)):
                    self._publish("spool.deleted", job.id, {})
                await self.on_disk(
                    self.store.expire, lambda job: not job.deleted and self.spool.folder(job.id).exists()
                )
            except StorageError as problem:
                _log.error("old scans cannot be deleted now: %s", problem)
            await asyncio.sleep(SWEEP_S)

    def spawn(self, coroutine: Coroutine[Any, Any, None]) -> None:
        """Run beside everything else; ended with the pipeline."""
        self._tasks.spawn(coroutine)
