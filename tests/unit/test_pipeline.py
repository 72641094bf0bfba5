"""A job's way through the daemon where the disk refuses or a client changes its mind: no device, no worker."""

from __future__ import annotations

import asyncio
import errno
import io
import uuid
from collections.abc import Awaitable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from scanner.clock import VirtualClock
from scanner.errors import StorageError
from scanner.storage import storage_errors
from scanner.stream import PointsNote
from scanner.wire import ArrayEntry, FileEntry, ScanStart
from service.acquisition import Scan
from service.endings import reason_to_fail
from service.jobs import Job, JobState, JobStore
from service.pipe import CancelAcquire, Ended, Frames, Need, Taken, framed, read_command
from service.pipeline import Pipeline
from service.series import Series
from service.spool import Spool


class Devices:
    """Takes a scan at once; `ended` says when its folder is closed."""

    def __init__(self) -> None:
        self.ended: asyncio.Future[Ended] = asyncio.get_running_loop().create_future()
        self.listener: Any = None
        self.quick = True
        """a scan begins before anybody can cancel it"""

    async def acquire(self, job: str, _folder: Path, _params: ScanStart, listener: Any) -> Awaitable[Ended]:
        self.listener = listener
        if self.quick:
            listener.began()
        return self.ended

    def cancel(self, job: str) -> None:
        """The listener hears of the job until the devices have seen to it."""


class Workers:
    def __init__(self) -> None:
        self.given: list[Series] = []

    def submit(self, series: Series) -> None:
        self.given.append(series)

    def cancel(self, series: Series) -> None:
        series.cancelled = True
        series.outcome.cancel()


class Store(JobStore):
    """Records whose disk can be full."""

    full = False

    def write(self, job_id: str, record: Mapping[str, Any]) -> None:
        if self.full:
            raise StorageError("the disk is full")
        super().write(job_id, record)


async def no_recovery(_: Job) -> None:
    raise AssertionError("nothing was left")


class Bench:
    def __init__(self, folder: Path) -> None:
        self.store, self.spool = Store(folder / "jobs"), Spool(folder / "spool")
        self.spool.prepare()
        self.devices, self.workers = Devices(), Workers()
        self.events: list[str] = []
        self.pipeline = Pipeline(
            self.store,
            self.spool,
            self.devices,  # type: ignore[arg-type]
            self.workers,  # type: ignore[arg-type]
            lambda kind, *_: self.events.append(kind),
        )

    async def acquiring(self) -> Job:
        """A job whose frames are taken and whose folder is being closed."""

        self.pipeline.start(no_recovery)
        job = await self.pipeline.submit(ScanStart(str(uuid.uuid4())), "test")
        async with asyncio.timeout(5):
            while not self.workers.given:
                await asyncio.sleep(0)
        return job

    def end(self, job: Job) -> None:
        self.devices.ended.set_result(Ended(job.id, "completed", 1))


@pytest.fixture
async def bench(tmp_path: Path) -> Any:
    made = Bench(tmp_path)
    yield made
    await made.pipeline.close()


async def until(bench: Bench, kind: str) -> None:
    async with asyncio.timeout(5):
        while kind not in bench.events:
            await asyncio.sleep(0)


async def test_a_record_that_cannot_be_written_does_not_hold_a_scan_up(bench: Bench) -> None:
    job = await bench.acquiring()
    bench.store.full = True
    bench.end(job)
    await until(bench, "acquired")
    assert bench.workers.given[0].end is not None


async def test_nothing_is_told_of_a_scan_behind_its_end(bench: Bench) -> None:
    job = await bench.acquiring()
    bench.end(job)
    while job.state is JobState.ACQUIRING:
        await asyncio.sleep(0)
    await bench.pipeline.cancel(job)  # while the record of `acquired` is on its way to the disk
    await until(bench, "cancelled")
    await bench.pipeline.on_disk(lambda: None)
    for _ in range(5):
        await asyncio.sleep(0)
    assert bench.events[-1] == "cancelled"
    assert bench.workers.given[0].end is None


async def test_a_scan_that_begins_as_it_is_cancelled_is_given_to_no_worker(bench: Bench) -> None:
    bench.devices.quick = False
    bench.pipeline.start(no_recovery)
    job = await bench.pipeline.submit(ScanStart(str(uuid.uuid4())), "test")
    async with asyncio.timeout(5):
        while bench.devices.listener is None:
            await asyncio.sleep(0)
    await bench.pipeline.cancel(job)
    heard = bench.devices.listener  # what the devices said before they heard of it
    await heard.need(Need(job.id, frames=1, bytes=1, plan={}))
    heard.began()
    heard.frames(Frames(job.id, 1, 1, 0))
    heard.taken(Taken(job.id, 1))
    bench.end(job)
    await until(bench, "cancelled")
    assert bench.workers.given == []
    assert bench.events[-1] == "cancelled"


async def test_points_are_told_before_the_disk_is_done_and_acquired_is_not(bench: Bench) -> None:
    job = await bench.acquiring()
    places = [ArrayEntry("xyz", "<f4", (2, 2, 3), 64, 48)]
    bench.workers.given[0].hear(PointsNote(1, places, 1))
    assert "points" not in bench.events
    bench.devices.listener.taken(Taken(job.id))  # and some are missing
    assert "points" not in bench.events
    bench.devices.listener.taken(Taken(job.id, 1))
    assert (bench.events[-1], job.state) == ("points", JobState.ACQUIRING)
    assert job.readable("scan.npz") == 112
    assert not job.result()["files"]
    bench.end(job)
    await until(bench, "acquired")
    assert bench.events.count("points") == 1


async def test_asking_again_waits_for_the_record_too(bench: Bench) -> None:
    params = ScanStart(str(uuid.uuid4()))
    bench.store.full = True
    answers = await asyncio.gather(*(bench.pipeline.submit(params, "") for _ in range(2)), return_exceptions=True)
    assert [type(answer) for answer in answers] == [StorageError, StorageError]


async def test_an_acknowledgement_counts_once_it_is_on_disk(bench: Bench) -> None:
    job = await bench.pipeline.submit(ScanStart(str(uuid.uuid4())), "")
    bench.store.full = True
    for _ in range(2):
        with pytest.raises(StorageError):
            await bench.pipeline.acknowledge(job)
    assert not job.acknowledged


async def test_files_that_a_killed_daemon_deleted_are_known_to_be_gone(bench: Bench) -> None:
    gone, kept = (Job(str(uuid.uuid4()), "", ScanStart(""), state=JobState.DONE) for _ in range(2))
    for job in (gone, kept):
        job.files = (FileEntry("scan.npz", 1, ""),)
        bench.store._jobs[job.id] = job
    bench.spool.folder(kept.id).mkdir()
    await bench.acquiring()
    assert (gone.deleted, kept.deleted) == (True, False)


async def test_the_spool_is_swept_again_after_a_disk_failed(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    swept = 0

    def sweep(_: Any) -> list[Job]:
        nonlocal swept
        swept += 1
        raise StorageError("read-only")

    monkeypatch.setattr(bench.spool, "sweep", sweep)
    monkeypatch.setattr("service.pipeline.SWEEP_S", 0.0)
    task = asyncio.create_task(bench.pipeline._sweep())
    async with asyncio.timeout(5):
        while swept < 2 and not task.done():
            await asyncio.sleep(0)
    task.cancel()
    assert swept >= 2


def test_a_command_that_the_daemon_did_not_finish_is_its_end() -> None:
    whole = framed(CancelAcquire("job"))
    assert read_command(io.BytesIO(whole)) == CancelAcquire("job")
    assert [read_command(io.BytesIO(whole[:cut])) for cut in range(len(whole))] == [None] * len(whole)


def test_a_truth_that_cannot_be_written_ends_the_scan_alone(tmp_path: Path) -> None:
    class Camera:
        def truth(self) -> Any:
            return SimpleNamespace(rows=0, columns=0, xyz=0, lit=0)

        def true_calibration(self) -> None:
            return None

    opened: Any = SimpleNamespace(rig=SimpleNamespace(camera=Camera()))
    params = ScanStart("", compare_truth=True)
    scan = Scan("job", tmp_path / "gone", params, opened, VirtualClock(), lambda _: None)
    with pytest.raises(StorageError):
        scan._write_truth()


@pytest.mark.parametrize(
    ("number", "reason"), [(errno.ENOSPC, "disk_full"), (errno.EDQUOT, "disk_full"), (errno.EPERM, "storage_failed")]
)
def test_a_disk_that_is_not_full_is_not_called_so(number: int, reason: str, tmp_path: Path) -> None:
    with pytest.raises(StorageError) as raised, storage_errors(tmp_path):
        raise OSError(number, "no")
    assert reason_to_fail(raised.value) == reason
    assert reason_to_fail(StorageError("the spool holds 2 MB of 2 MB")) == "disk_full"


def test_files_that_cannot_be_deleted_are_not_called_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spool, job = Spool(tmp_path), Job(str(uuid.uuid4()), "", ScanStart(""), state=JobState.CANCELLED)
    spool.capture(job.id).mkdir(parents=True)

    def refuse(*_: Any) -> None:
        raise OSError(errno.EROFS, "read-only")

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(StorageError):
        spool.remove(job)
    assert not job.deleted
    assert spool.may_go(job)


@pytest.mark.parametrize("way", ["delete", "make_room"])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EPERM])
async def test_deleting_on_a_full_disk_frees_it_and_elsewhere_a_record_unwritten_keeps_the_files(
    bench: Bench, number: int, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = bench.store.make(ScanStart(str(uuid.uuid4())), "test")
    job.state, job.acknowledged, job.files = JobState.DONE, True, (FileEntry("capture/frames.npy", 1, ""),)
    bench.spool.capture(job.id).mkdir(parents=True)
    (bench.spool.capture(job.id) / "frames.npy").write_bytes(b"x")
    bench.store.record(job)

    def write(path: Path, _: object) -> None:
        if number == errno.EPERM or any(bench.spool.root.rglob("frames.npy")):  # else its bytes are free again
            with storage_errors(path):
                raise OSError(number, "no")

    async def delete() -> None:
        if way == "delete":
            await bench.pipeline.delete(job)
            return
        free = iter([StorageError("full"), None, StorageError("full")])
        monkeypatch.setattr(bench.spool, "_no_room", lambda _: next(free, None))
        await bench.pipeline.room_for(job, Need(job.id, frames=1, bytes=1, plan={}))

    with monkeypatch.context() as full:
        full.setattr("service.jobs.replace_json", write)
        if number == errno.ENOSPC:
            await delete()
        else:
            with pytest.raises(StorageError, match="no"):
                await delete()
    kept = number == errno.EPERM
    assert any(bench.spool.root.rglob("frames.npy")) is kept
    assert bench.spool.capture(job.id).is_dir() is kept
    assert job.deleted is not kept
    assert ("spool.deleted" in bench.events) is not kept
    await bench.pipeline.delete(job)  # again, with room
    assert not any(bench.spool.root.rglob("frames.npy"))
    assert JobStore(bench.store.folder).get(job.id).deleted
