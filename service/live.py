"""Live runs in the daemon: at most one at a time, in place of scans, from `live.start` to the last byte of a recording.

    start --devices free--> acquiring --stop, its time, or a fault--> acquired --disk, worker--> done | failed

A run is a job like a scan's: its record is on disk before anything moves, the same id gives the same run, and what it
recorded is fetched, acknowledged and kept like a scan's files. No pixel passes through here.
"""

from __future__ import annotations

import asyncio
import logging
import shutil
import time
from collections import deque
from collections.abc import Mapping
from typing import Any

import msgspec

from scanner.errors import DeviceBusy, ScannerError, StorageError
from scanner.wire import LiveStart, Refused
from service.deliveries import WorkerLost
from service.devices_link import DevicesLink
from service.endings import error_of, reason_to_fail
from service.jobs import Job, JobState
from service.live_files import close_recording, reserve
from service.live_series import LiveSeries, LiveTotals
from service.pipe import Ended, Frames, Kept, LiveBegan, Need, Shot, Taken
from service.pipeline import Pipeline
from service.series import recorded_files
from service.worker_pool import WorkerPool

STATS_S = 1.0
"""Events of a run's counts come this often."""

RATE_S = 2.0
"""Rates are means over this long."""

DRAIN_S = 5.0
"""Time for a worker to finish the frames it has when a run ends; kernels end sooner."""

_log = logging.getLogger(__name__)


class Live:
    """The live run of this daemon, if one is under way, and the last one."""

    def __init__(self, pipeline: Pipeline, devices: DevicesLink, workers: WorkerPool, endpoint: str) -> None:
        self._pipeline = pipeline
        self._devices = devices
        self._workers = workers
        self._endpoint = endpoint
        self._run: LiveRun | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        """of the run, and of those before whose recordings are being closed"""

    @property
    def running(self) -> bool:
        """Whether a run holds the devices."""
        return self._run is not None and self._run.holds_devices

    async def start(self, params: LiveStart, client: str) -> Job:
        """The run of these parameters: the one that is there, or a new one.

        Raises:
            DeviceBusy: another one runs, or a scan.
            Refused: see `JobStore.find`.
            StorageError: its record cannot be written.
        """
        store = self._pipeline.store
        if store.find(params, client) is None:
            await self._until_let_go()
        # Looked up again: the same call may have come twice meanwhile. From here to the run nothing is waited for.
        job = store.find(params, client)
        if job is not None:
            return job
        if self._run is not None and self.running:
            raise DeviceBusy(f"live run {self._run.job.id} is under way", hint="live.stop ends it")
        if (scan := self._pipeline.busy_with) is not None:
            raise DeviceBusy(f"scan {scan.id} is {scan.state}", hint="wait for its end, or cancel it (scan.cancel)")
        job = store.make(params, client)
        self._run = run = LiveRun(job, params, self._pipeline, self._devices, self._workers, self._endpoint)
        try:
            await self._pipeline.save(job)
        except StorageError:
            store.forget(job)
            self._run = None
            raise
        self._pipeline.tell(job, "queued")
        task = asyncio.create_task(run.run())
        self._tasks.add(task)
        task.add_done_callback(self._finished)
        return job

    async def _until_let_go(self) -> None:
        """A scan that was cancelled gives the devices back soon."""
        deadline = time.monotonic() + DRAIN_S
        while (scan := self._pipeline.busy_with) is not None and scan.state.over and time.monotonic() < deadline:
            await asyncio.sleep(0.01)

    async def stop(self, job_id: str | None = None) -> Job:
        """End the run and wait until the devices are free; one that is over stays as it is.

        Raises:
            Refused: none runs, or another one.
        """
        run = self._run
        if job_id is not None:
            job = self._pipeline.store.get(job_id)
            if run is None or run.job is not job:
                if not isinstance(job.params, LiveStart):
                    raise Refused(f"job {job.id} is a scan", reason="unknown_job", hint="scan.cancel")
                return job
        if run is None:
            raise Refused("no live run is under way", reason="not_live", hint="live.start")
        run.stop()
        await run.free.wait()
        return run.job

    def status(self) -> dict[str, Any] | None:
        """The run under way or the last one; None where there was none."""
        return None if self._run is None else self._run.status()

    async def close(self) -> None:
        """End the run, recording and all."""
        if self._run is not None:
            self._run.stop()
        if self._tasks:
            _, late = await asyncio.wait(self._tasks, timeout=2 * DRAIN_S)
            for task in late:
                task.cancel()
            await asyncio.gather(*late, return_exceptions=True)

    async def recover(self, job: Job) -> None:
        """Take up a run that an earlier daemon left: what is recorded is kept, nothing goes on."""
        folder = self._pipeline.spool.capture(job.id)
        files = await asyncio.to_thread(close_recording, folder, "daemon_restarted")
        job.files = tuple(files)
        job.reason = "daemon_restarted"
        if not files:
            await asyncio.to_thread(shutil.rmtree, folder.parent, ignore_errors=True)
            error = ScannerError("the daemon was restarted during this live run", hint="start another one")
            await self._pipeline.end(job, JobState.FAILED, reason="daemon_restarted", error=error)
            return
        if job.state is JobState.QUEUED:
            job.become(JobState.ACQUIRING)
        if job.state is JobState.ACQUIRING:
            job.become(JobState.ACQUIRED)
        await self._pipeline.end(job, JobState.DONE, reason="daemon_restarted")

    def _finished(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            _log.error("a live run failed", exc_info=error)


class LiveRun:
    """One run. Hears the devices (`service.devices_link.ScanListener`)."""

    def __init__(
        self,
        job: Job,
        params: LiveStart,
        pipeline: Pipeline,
        devices: DevicesLink,
        workers: WorkerPool,
        endpoint: str,
    ) -> None:
        self.job = job
        self.free = asyncio.Event()
        """devices and worker are free again"""
        self._params = params
        self._pipeline = pipeline
        self._devices = devices
        self._workers = workers
        self._endpoint = endpoint
        self._series: LiveSeries | None = None
        self._kept = Kept(job.id, 0, 0)
        self._plan: Mapping[str, Any] = {}
        self._began: float | None = None
        self._ended: float | None = None
        self._past: deque[tuple[float, int, int]] = deque()
        self._failure: tuple[ScannerError, str] | None = None

    @property
    def holds_devices(self) -> bool:
        """Whether scans must wait."""
        return not self.free.is_set()

    def stop(self) -> None:
        """End soon."""
        if not self.free.is_set():
            self._devices.cancel(self.job.id)

    async def run(self) -> None:
        """From the devices' first move to the end of the job."""
        job, pipeline = self.job, self._pipeline
        telling = asyncio.create_task(self._tell_counts())
        try:
            job.become(JobState.ACQUIRING)
            await pipeline.save(job)
            pipeline.tell(job, "started")
            ending = await self._devices.acquire(job.id, pipeline.spool.capture(job.id), self._params, self)
            self._ended = time.monotonic()
            await self._end_decoding()
            if not job.state.over and self._series is not None:
                job.become(JobState.ACQUIRED)
                self.free.set()
            await self._finish(await ending)
        except ScannerError as error:
            await pipeline.end(job, JobState.FAILED, reason="failed", error=error)
        except Exception as error:  # noqa: BLE001  (a run that fails must not end the daemon)
            _log.exception("live run %s", job.id)
            failure = ScannerError(f"the daemon failed: {error}", hint="see its log")
            await pipeline.end(job, JobState.FAILED, reason="failed", error=failure)
        finally:
            telling.cancel()
            await asyncio.gather(telling, return_exceptions=True)
            self.free.set()

    # --- what the devices say ----------------------------------------------------------------------------------

    async def need(self, need: Need) -> None:
        """Planned."""
        self._plan = need.plan
        await self._pipeline.room_for(self.job, need)

    def began(self) -> None:
        """Of scans."""

    def frames(self, frames: Frames) -> None:
        """Of scans."""

    def taken(self, taken: Taken) -> None:
        """Of scans."""

    def live(self, report: LiveBegan | Shot | Kept) -> None:
        """It began, took a frame, or has more on disk."""
        match report:
            case LiveBegan():
                self._begin(report)
            case Shot() if self._series is not None:
                self._series.shot(report)
                self.job.captured = report.number + 1
            case Kept():
                self._kept = report
                self._pipeline.spawn(self._reserve())

    def _begin(self, report: LiveBegan) -> None:
        self._began = time.monotonic()
        params = self._params
        self._series = series = LiveSeries(
            job=self.job.id,
            header=report.header,
            calibration=report.calibration,
            endpoint=self._endpoint,
            content=params.content,
            stride=params.stride,
            options={"decoder": params.decoder, "filters": msgspec.to_builtins(params.filters)},
            delivering=self._delivering,
        )
        series.outcome.add_done_callback(self._decoding_ended)
        self._workers.submit(series)
        self._pipeline.tell(self.job, "live", {"endpoint": self._endpoint, "header": report.header})

    def _delivering(self, number: int) -> None:
        self.job.deliveries += 1
        _log.info("live run %s: delivery %d", self.job.id, number)

    def _decoding_ended(self, outcome: asyncio.Future[Any]) -> None:
        """A run that no worker can decode is over."""
        problem = None if outcome.cancelled() else outcome.exception()
        if isinstance(problem, WorkerLost):
            self._fail(problem.error, "worker_lost")
        elif isinstance(problem, ScannerError):
            self._fail(problem, reason_to_fail(problem))

    def _fail(self, error: ScannerError, reason: str) -> None:
        """End soon, as failed."""
        if self._failure is None:
            self._failure = (error, reason)
        self.stop()

    async def _reserve(self) -> None:
        """A folder of the recording is full: is there room for the one after the next?"""
        if self._params.retain != "record" or self.free.is_set():
            return
        try:
            await self._pipeline.on_disk(reserve, self._pipeline.spool, self._kept, list(self._pipeline.store))
        except StorageError as error:
            self._fail(error, reason_to_fail(error))

    # --- the end -----------------------------------------------------------------------------------------------

    async def _finish(self, ended: Ended) -> None:
        """The recording is closed: list it, and end the job."""
        job, pipeline = self.job, self._pipeline
        folder = pipeline.spool.capture(job.id)
        if ended.reason == "cancelled":  # before the first frame
            await pipeline.end(job, JobState.CANCELLED, reason="cancelled")
            return
        failure = self._failure
        if failure is None and ended.reason != "completed":
            error = error_of(ended)
            failure = (error, ended.reason or reason_to_fail(error))
        if self._params.retain == "none":
            await asyncio.to_thread(shutil.rmtree, folder.parent, ignore_errors=True)
        elif folder.exists():
            job.files = tuple(await asyncio.to_thread(recorded_files, folder))
        kept = ended.report.get("kept") or {}
        self._kept = Kept(job.id, int(kept.get("frames", self._kept.frames)), int(kept.get("bytes", self._kept.bytes)))
        job.report = self._figures(bins=True)
        if job.state is JobState.ACQUIRED:
            await pipeline.save(job)
            pipeline.tell(job, "acquired", {"reason": ended.reason, **job.report})
        if failure is None:
            await pipeline.end(job, JobState.DONE, reason="completed")
        else:
            await pipeline.end(job, JobState.FAILED, reason=failure[1], error=failure[0])

    async def _end_decoding(self) -> None:
        series = self._series
        if series is None:
            return
        series.finish("completed")
        if not series.outcome.done():
            await asyncio.wait({series.outcome}, timeout=DRAIN_S)
        self._workers.cancel(series)
        series.counts.settle(over=True)

    # --- figures -----------------------------------------------------------------------------------------------

    def status(self) -> dict[str, Any]:
        """The job's state, and what the run has done."""
        return {**self.job.status(), "live": self._figures(bins=False)}

    def _figures(self, *, bins: bool) -> dict[str, Any]:
        totals = LiveTotals() if self._series is None else self._series.counts
        until = self._ended or time.monotonic()
        seconds = 0.0 if self._began is None else until - self._began
        captured, published = self._rates(totals)
        params = self._params
        return {
            "endpoint": self._endpoint,
            "content": params.content,
            "stride": params.stride,
            "retain": params.retain,
            "seconds": round(seconds, 3),
            **totals.as_dict(),
            "frames_per_s": round(captured, 2),
            "results_per_s": round(published, 2),
            "latency_ms": totals.latency.as_dict(bins=bins),
            "recorded": {"frames": self._kept.frames, "bytes": self._kept.bytes},
            "header": None if self._series is None else dict(self._series.header),
            "calibration": None if self._series is None else self._series.calibration,
        }

    def _rates(self, totals: LiveTotals) -> tuple[float, float]:
        """Frames and results a second: over the last seconds, or over the whole of a run that has ended."""
        now, published = time.monotonic(), totals.decoded + totals.undecodable
        if self._ended is not None and self._began is not None:
            seconds = max(self._ended - self._began, 1e-9)
            return totals.captured / seconds, published / seconds
        while self._past and now - self._past[0][0] > RATE_S:
            self._past.popleft()
        if not self._past:
            return 0.0, 0.0
        then, captured_then, published_then = self._past[0]
        seconds = max(now - then, 1e-9)
        return (totals.captured - captured_then) / seconds, (published - published_then) / seconds

    async def _tell_counts(self) -> None:
        told = time.monotonic()
        while True:
            await asyncio.sleep(STATS_S / 4)
            if self._series is None or self._ended is not None:
                continue
            totals, now = self._series.counts, time.monotonic()
            self._past.append((now, totals.captured, totals.decoded + totals.undecodable))
            if now - told >= STATS_S:
                told = now
                figures = self._figures(bins=False)
                self._pipeline.tell(
                    self.job,
                    "live.counts",
                    {key: value for key, value in figures.items() if key not in ("header", "calibration")},
                )
