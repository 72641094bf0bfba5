"""Job records: keys, repeats, states, what is on disk, expiry."""

from __future__ import annotations

import json
import uuid
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanner.errors import SyncError
from scanner.wire import FileEntry, FilterParams, Refused, ScanStart
from service.jobs import Job, JobState, JobStore, parameters_digest

ID = "0b3e3a52-9f0e-4c52-8a55-3f1d8f3b6a11"


def made(store: JobStore, client: str = "", **params: Any) -> Job:
    job = store.make(ScanStart(job_id=params.pop("job_id", ID), **params), client)
    store.write(job.id, job.record())
    return job


def test_a_record_is_read_back_as_the_same_job(tmp_path: Path) -> None:
    job = made(JobStore(tmp_path), "me", method="mcp", filters=FilterParams(depth=(1.0, 2.0)))
    job.become(JobState.ACQUIRING)
    job.become(JobState.FAILED, reason="sync_lost", error=SyncError("out of step", frames=(1, 2)))
    job.files, job.output = (FileEntry("scan.npz", 3, "ab"),), "scan-1"
    JobStore(tmp_path).write(job.id, job.record())
    assert JobStore(tmp_path).get(ID) == job


def test_the_same_id_is_the_same_job(tmp_path: Path) -> None:
    store = JobStore(tmp_path)
    job = made(store, "me", method="mcp")
    for again in (store, JobStore(tmp_path)):
        found = again.find(ScanStart(job_id=ID.upper(), method="mcp"), "me")
        assert found is not None
        assert found.id == job.id
        assert again.find(ScanStart(job_id=ID, method="mcp"), "") is not None


@pytest.mark.parametrize(("client", "params"), [("me", {"method": "pmp"}), ("other", {"method": "mcp"})])
def test_the_same_id_for_something_else_is_an_error(tmp_path: Path, client: str, params: dict[str, Any]) -> None:
    store = JobStore(tmp_path)
    made(store, "me", method="mcp")
    with pytest.raises(Refused) as caught:
        store.find(ScanStart(job_id=ID, **params), client)
    assert caught.value.reason == "job_id_reused"
    assert caught.value.hint


@pytest.mark.parametrize("job_id", ["", "x", "../../etc/passwd", ID + "0", "0" * 500])
def test_only_uuids_name_jobs(tmp_path: Path, job_id: str) -> None:
    with pytest.raises(Refused, match="UUID"):
        JobStore(tmp_path).find(ScanStart(job_id=job_id), "")


def test_unknown_jobs_are_errors(tmp_path: Path) -> None:
    with pytest.raises(Refused) as caught:
        JobStore(tmp_path).get(ID)
    assert caught.value.reason == "unknown_job"


def test_an_expired_id_is_an_error_and_never_a_new_scan(tmp_path: Path) -> None:
    clock = [1000.0]
    store = JobStore(tmp_path, lambda: clock[0])
    job, kept, running = (made(store, job_id=str(uuid.uuid4())) for _ in range(3))
    for over in (job, kept):
        over.become(JobState.CANCELLED)
        over.ended = clock[0]
    clock[0] += 7 * 86400
    assert store.expire(lambda each: each is kept) == []
    clock[0] += 1
    assert store.expire(lambda each: each is kept) == [job]
    assert not list(tmp_path.glob(f"{job.id}*"))
    for again in (store, JobStore(tmp_path, lambda: clock[0])):
        for ask in (lambda s: s.find(ScanStart(job_id=job.id), ""), lambda s: s.get(job.id)):
            with pytest.raises(Refused, match="expired"):
                ask(again)
        assert {each.id for each in again} == {kept.id, running.id}


def test_a_damaged_record_is_left_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    made(JobStore(tmp_path))
    (tmp_path / "aaaa.json").write_text("{")
    (tmp_path / f"{uuid.uuid4()}.json").write_text(json.dumps({"format": "fringed-job", "version": 2}))
    odd = {**json.loads((tmp_path / f"{ID}.json").read_bytes()), "id": 7}
    (tmp_path / f"{uuid.uuid4()}.json").write_text(json.dumps(odd))
    assert [job.id for job in JobStore(tmp_path)] == [ID]
    assert len([record for record in caplog.records if "left alone" in record.message]) == 3
    assert (tmp_path / "aaaa.json").exists()


def test_states_go_one_way(tmp_path: Path) -> None:
    job = made(JobStore(tmp_path))
    path = (JobState.ACQUIRING, JobState.ACQUIRED, JobState.DECODING, JobState.DECODED)
    for state in path:
        job.become(state)
    job.become(JobState.ACQUIRED)  # the worker was lost
    job.become(JobState.DONE, reason="completed")
    assert job.ended is not None
    for state in JobState:
        with pytest.raises(ValueError, match="does not become"):
            job.become(state)


@given(st.permutations(["method", "repeat", "decoder", "compare_truth"]))
def test_the_digest_knows_no_order_and_no_id(order: list[str]) -> None:
    values = {"method": "mcp", "repeat": 2, "decoder": "hmm", "compare_truth": True}
    given_params = {key: values[key] for key in order}
    digests = {parameters_digest(ScanStart(job_id=job, **given_params)) for job in (ID, "other")}  # type: ignore[arg-type]
    assert digests == {parameters_digest(ScanStart(job_id="", **values))}  # type: ignore[arg-type]
    assert digests != {parameters_digest(ScanStart(job_id=""))}
