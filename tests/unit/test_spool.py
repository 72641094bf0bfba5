"""The spool: what may be deleted, in which order, and when a scan is refused instead."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from pathlib import Path

import pytest

from scanner.errors import StorageError
from scanner.wire import ScanStart
from service.jobs import Job, JobState
from service.series import RecordTail, capture_state, missing_patterns
from service.spool import LEASE_S, Limits, Spool

MB = 1_000_000
NOW = 1_000_000.0


@pytest.fixture
def clock() -> list[float]:
    return [NOW]


@pytest.fixture
def new_spool(tmp_path: Path, clock: list[float]) -> Callable[[Limits], Spool]:
    def make(limits: Limits) -> Spool:
        spool = Spool(tmp_path / "spool", limits, now=lambda: clock[0])
        spool.prepare()
        return spool

    return make


def filled(spool: Spool, state: JobState, *, acknowledged: bool = False, ended: float = NOW, size: int = MB) -> Job:
    job = Job(str(uuid.uuid4()), "", ScanStart(job_id=""), state=state, acknowledged=acknowledged, created=ended)
    job.ended = ended if state.over else None
    folder = spool.capture(job.id)
    folder.mkdir(parents=True)
    (folder / "frames.npy").write_bytes(b"x" * size)
    return job


def test_oldest_acknowledged_go_first_and_no_more_than_needed(new_spool: Callable[[Limits], Spool]) -> None:
    spool = new_spool(Limits(bytes=5 * MB))
    jobs = [filled(spool, JobState.DONE, acknowledged=True, ended=NOW + i) for i in range(4)]
    assert spool.make_room(2 * MB, jobs) == jobs[:2]
    assert [spool.folder(job.id).exists() for job in jobs] == [False, False, True, True]
    assert [job.deleted for job in jobs] == [True, True, False, False]


def test_for_a_scan_that_cannot_fit_nothing_goes(new_spool: Callable[[Limits], Spool]) -> None:
    spool = new_spool(Limits(bytes=4 * MB))
    job = filled(spool, JobState.DONE, acknowledged=True)
    with pytest.raises(StorageError, match="holds 1 MB of 4 MB and the scan needs 5 MB"):
        spool.make_room(5 * MB, [job])
    assert spool.folder(job.id).exists()
    assert not job.deleted


@pytest.mark.parametrize("state", [s for s in JobState if s not in (JobState.DONE, JobState.CANCELLED)])
def test_a_series_that_is_not_decoded_is_never_deleted(
    new_spool: Callable[[Limits], Spool], state: JobState, clock: list[float]
) -> None:
    spool = new_spool(Limits(bytes=2 * MB, max_age_s=10))
    job = filled(spool, state, acknowledged=True)
    clock[0] += 1e9
    with pytest.raises(StorageError, match="needs 2 MB") as caught:
        spool.make_room(2 * MB, [job])
    assert caught.value.hint
    assert spool.sweep([job]) == []
    assert spool.folder(job.id).exists()


def test_nor_one_that_nobody_acknowledged_until_it_is_old(
    new_spool: Callable[[Limits], Spool], clock: list[float]
) -> None:
    spool = new_spool(Limits(bytes=2 * MB, max_age_s=100))
    job = filled(spool, JobState.DONE)
    with pytest.raises(StorageError):
        spool.make_room(2 * MB, [job])
    clock[0] += 101
    assert spool.sweep([job]) == [job]
    assert not spool.folder(job.id).exists()


def test_nor_one_that_is_being_read(new_spool: Callable[[Limits], Spool], clock: list[float]) -> None:
    spool = new_spool(Limits(bytes=2 * MB))
    job = filled(spool, JobState.DONE, acknowledged=True)
    spool.lease(job.id)
    with pytest.raises(StorageError):
        spool.make_room(2 * MB, [job])
    clock[0] += LEASE_S + 1
    assert spool.make_room(MB, [job]) == [job]


def test_cancelled_scans_may_go(new_spool: Callable[[Limits], Spool]) -> None:
    spool = new_spool(Limits(bytes=2 * MB))
    job = filled(spool, JobState.CANCELLED)
    assert spool.make_room(2 * MB, [job]) == [job]


def test_the_disk_itself_is_asked(new_spool: Callable[[Limits], Spool]) -> None:
    spool = new_spool(Limits(min_free_bytes=1 << 60))
    with pytest.raises(StorageError, match="the disk has"):
        spool.make_room(1, [])


def test_room_that_is_reserved_counts(new_spool: Callable[[Limits], Spool], tmp_path: Path) -> None:
    import os  # noqa: PLC0415

    spool = new_spool(Limits())
    folder = spool.capture(str(uuid.uuid4()))
    folder.mkdir(parents=True)
    with (folder / "frames.npy").open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, 3 * MB)
    assert spool.used() >= 3 * MB


def test_an_interrupted_deletion_is_finished(new_spool: Callable[[Limits], Spool], tmp_path: Path) -> None:
    spool = new_spool(Limits())
    (spool.root / ".deleted-a").mkdir()
    (spool.root / ".deleted-a" / "frames.npy").write_bytes(b"x")
    spool.prepare()
    assert list(spool.root.iterdir()) == []


# --- what the sender reads ----------------------------------------------------------------------------------------


def capture_folder(tmp_path: Path, lines: list[str]) -> Path:
    folder = tmp_path / "capture"
    folder.mkdir()
    plan = '{"patterns": 4, "repeat": 1}'
    head = f'{{"state": "open", "camera": {{"width": 4, "height": 2, "bits": 10}}, "plan": {plan}}}'
    (folder / "capture.json").write_text(head)
    (folder / "frames.npy").write_bytes(b"\x93NUMPY\x01\x00" + (118).to_bytes(2, "little") + bytes(118))
    (folder / "frames.jsonl").write_text("".join(lines))
    return folder


def line(slot: int | None, pattern: int, status: str = "ok") -> str:
    where = "null" if slot is None else slot
    return f'{{"slot":{where},"pattern":{pattern},"status":"{status}","xxh3":"ab"}}\n'


def test_tail_reads_whole_lines_as_they_come(tmp_path: Path) -> None:
    folder = capture_folder(tmp_path, [line(0, 0), line(1, 1), '{"slot":2,"pat'])
    tail = RecordTail(folder, 7)
    found = list(tail.read(10))
    assert [(frame.index, frame.pattern, frame.offset) for frame in found] == [(0, 0, 128), (1, 1, 128 + 16)]
    assert list(tail.read(10)) == []
    with (folder / "frames.jsonl").open("a") as file:
        file.write('tern":2}\n' + line(None, 3, "missing"))
    assert [(frame.index, frame.slot, frame.status) for frame in tail.read(10)] == [(2, 2, "ok"), (3, None, "missing")]
    tail.close()


def test_tail_reads_no_more_than_the_credit(tmp_path: Path) -> None:
    tail = RecordTail(capture_folder(tmp_path, [line(i, i) for i in range(4)]), 7)
    assert [len(list(tail.read(n))) for n in (0, 3, 3)] == [0, 3, 1]
    tail.close()


def test_what_a_folder_says_after_a_crash(tmp_path: Path) -> None:
    folder = capture_folder(tmp_path, [line(0, 0), line(None, 1, "missing"), line(1, 2), '{"slot":2'])
    assert capture_state(folder) == ("open", None, 4)
    assert missing_patterns(folder, 4) == (1, 3)
    assert capture_state(tmp_path) == ("none", None, 0)
    with pytest.raises(StorageError):
        RecordTail(tmp_path, 1)
