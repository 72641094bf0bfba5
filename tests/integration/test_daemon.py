"""Daemon, devices process, worker and clients as real processes, on the quick rig."""

from __future__ import annotations

import asyncio
import stat
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

from scanner.client import AsyncClient, Client
from scanner.errors import ConfigError, StorageError
from scanner.wire import MAX_REQUEST_BYTES, Event, Refused
from scanner.wire_images import decode_preview
from service.config import load_rig
from service.private import private_daemon
from tests.faults.daemons import RIG, settle


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with private_daemon(load_rig(RIG)) as found:
        settle(found)
        yield found


@pytest.fixture
def client(endpoint: str) -> Iterator[Client]:
    with Client(endpoint, name="test") as connected:
        yield connected


@pytest.fixture
def raw(endpoint: str) -> Iterator[Any]:
    """A client of another language: one DEALER, bytes in, maps out."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as dealer:
        dealer.setsockopt(zmq.LINGER, 0)
        dealer.setsockopt(zmq.RCVTIMEO, 3000)
        dealer.connect(endpoint)

        def call(message: Any) -> Any:
            dealer.send(message if isinstance(message, bytes) else msgpack.packb(message))
            return msgpack.unpackb(dealer.recv())

        yield call


# --- scans --------------------------------------------------------------------------------------------------------


def test_scan_gives_arrays(client: Client) -> None:
    scan = client.scan("mcp")
    assert scan.xyz is not None
    assert scan.xyz.shape == (240, 320, 3)
    assert 600 < float(np.nanmedian(scan.xyz[..., 2])) < 800
    assert client.list_scans()[-1]["acknowledged"]


def test_multi_frame_scan_into_a_folder_with_events(client: Client, tmp_path: Path) -> None:
    events: list[Event] = []
    early: dict[str, Any] = {}

    def heard(event: Event) -> None:
        events.append(event)
        if event.kind == "points":
            early.update(client.arrays(event))

    scan = client.scan("pmp", folder=tmp_path, on_event=heard, compare_truth=True)
    assert early.keys() == {"xyz", "confidence"}
    for name, array in early.items():
        np.testing.assert_array_equal(array, getattr(scan, name))
    assert scan.rows is not None
    assert scan.report["truth"]["lit"]["coverage"] > 0.9
    names = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert {"scan.npz", "cloud.ply", "preview.png", "report.json"} <= names
    assert {f"capture/{name}" for name in ("capture.json", "frames.jsonl", "frames.npy", "calibration.json")} <= names
    kinds = [event.kind for event in events]
    assert kinds[-1] == "done"
    assert {"plan", "frame", "acquired", "decoding", "decoded"} <= set(kinds)
    frames = [event.fields["captured"] for event in events if event.kind == "frame"]
    assert frames == sorted(frames)
    assert frames[-1] == next(event.fields["frames"] for event in events if event.kind == "plan")


def test_events_have_no_gaps(client: Client) -> None:
    numbers = []
    job = client.start_scan("mcp")
    for event in client.events(job):
        numbers.append(event.number)
    assert len(numbers) > 4
    assert numbers[1:] == sorted(set(numbers[1:]))


def test_the_same_job_id_is_the_same_job(client: Client) -> None:
    job_id = str(uuid.uuid4())
    assert client.start_scan("mcp", job_id=job_id) == job_id
    assert client.wait(job_id)["state"] == "done"
    before = len(client.list_scans())
    assert client.start_scan("mcp", job_id=job_id) == job_id
    assert len(client.list_scans()) == before
    with pytest.raises(Refused) as caught:
        client.start_scan("pmp", job_id=job_id)
    assert caught.value.reason == "job_id_reused"


def test_one_scan_acquires_while_the_one_before_decodes(client: Client) -> None:
    first, second = client.start_scan("mcp"), client.start_scan("mcp")
    done = {job: client.wait(job)["state"] for job in (first, second)}
    assert set(done.values()) == {"done"}
    states = {scan["id"]: scan for scan in client.list_scans()}
    assert states[second]["created"] <= states[first]["ended"]


def test_cancel_while_it_acquires(client: Client) -> None:
    job = client.start_scan("pmp")
    for event in client.events(job):
        if event.kind == "frame":
            client.cancel(job)
    outcome = client.result(job)
    assert (outcome["state"], outcome["reason"], outcome["files"]) == ("cancelled", "cancelled", [])
    assert client.scan("mcp").xyz is not None


def test_cancel_in_the_queue_and_after_the_end(client: Client) -> None:
    running, waiting = client.start_scan("pmp"), client.start_scan("mcp")
    assert client.cancel(waiting)["state"] == "cancelled"
    assert client.cancel(running)["state"] == "cancelled"
    assert client.cancel(waiting)["state"] == "cancelled"


def test_ctrl_c_cancels_on_the_daemon_too(client: Client) -> None:
    def interrupt(event: Event) -> None:
        if event.kind == "frame":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        client.scan("pmp", on_event=interrupt)
    assert client.list_scans()[-1]["state"] == "cancelled"


def test_a_client_that_vanishes_leaves_its_scan_running(endpoint: str, client: Client) -> None:
    with Client(endpoint) as other:
        job = other.start_scan("mcp")
    assert client.wait(job)["state"] == "done"


@pytest.mark.parametrize(
    ("method", "params", "named"),
    [
        ("laser", {}, "laser"),
        ("pmp", {"pattern": {"frequencies": [1, 500], "shifts": [4, 4]}}, "period"),
        ("pmp", {"pattern": {"method": "mcp"}}, "mcp"),
        ("pmp", {"pattern": {"frequencies": [1, 2], "shifts": [1000, 1000]}}, "2000 images"),
        ("mcp", {"exposure": 1e9}, "exposure"),
        ("mcp", {"filters": {"depth": [9.0, 1.0]}}, "depth"),
        ("mcp", {"repeat": 0}, "repeat"),
    ],
)
def test_what_cannot_be_scanned_is_refused_in_words(
    client: Client, method: str, params: dict[str, Any], named: str
) -> None:
    before = client.list_scans()
    with pytest.raises(ConfigError, match=named) as caught:
        client.scan(method, **params)
    assert caught.value.hint or named == "depth"
    assert client.list_scans() == before, "a job was taken for it"


def test_what_only_the_plan_can_refuse_is_a_job_that_failed(client: Client) -> None:
    with pytest.raises(ConfigError, match="exposure"):
        client.scan("mcp", exposure=9.9e6)
    assert client.list_scans()[-1]["reason"] == "refused"


def test_a_long_sequence_can_be_cancelled_before_its_images_are_made(client: Client) -> None:
    began = time.monotonic()
    job = client.start_scan("pmp", pattern={"frequencies": [1], "shifts": [1000]}, exposure=1000)
    client.cancel(job)
    assert client.wait(job)["state"] == "cancelled"
    assert client.scan("mcp").xyz is not None
    assert time.monotonic() - began < 10


def test_repeat_and_gray(client: Client) -> None:
    assert client.scan("mcp", repeat=3).report["capture"]["frames"] == 3
    assert client.scan("gray", pattern={"bits": 5, "code_bits": 8}).rows is not None


# --- files --------------------------------------------------------------------------------------------------------


def test_files_are_named_and_never_paths(client: Client) -> None:
    job = client.start_scan("mcp")
    client.wait(job)
    names = [entry["name"] for entry in client.result(job)["files"]]
    assert "scan.npz" in names
    for name in ("../../jobs", "/etc/passwd", "capture/../scan.npz", "", "scan-1/scan.npz"):
        with pytest.raises(Refused) as caught:
            client.call("scan.fetch", id=job, name=name)
        assert caught.value.reason == "unknown_file"
    for wrong in ({"offset": -1}, {"length": 0}, {"length": 1 << 30}):
        with pytest.raises(Refused, match="offset"):
            client.call("scan.fetch", id=job, name="scan.npz", **wrong)
    for behind in (1 << 40, (1 << 64) - 1):
        assert client.call("scan.fetch", id=job, name="scan.npz", offset=behind) == b""
    assert client.call("scan.fetch", id=job, name="scan.npz", offset=2, length=2) == b"\x03\x04"


def test_a_file_that_arrives_damaged_is_not_kept(client: Client, endpoint: str, tmp_path: Path) -> None:
    job = client.start_scan("mcp")
    client.wait(job)
    folder = Path(endpoint.removeprefix("ipc://")).parent / "spool" / job
    (png,) = folder.glob("scan-*/preview.png")
    png.write_bytes(png.read_bytes()[:-1] + b"\0")
    with pytest.raises(StorageError, match="damaged"):
        client.fetch(job, tmp_path)
    assert "preview.png" not in {path.name for path in tmp_path.rglob("*")}
    assert not list(tmp_path.rglob("*.part"))


def test_delete(client: Client, endpoint: str) -> None:
    job = client.start_scan("mcp")
    with pytest.raises(Refused, match=r"acquiring|queued"):
        client.delete(job)
    client.wait(job)
    client.delete(job)
    assert not (Path(endpoint.removeprefix("ipc://")).parent / "spool" / job).exists()
    with pytest.raises(StorageError, match="deleted"):
        client.result(job)


# --- the wire, as another language sees it ------------------------------------------------------------------------


def test_hello_comes_first(raw: Any) -> None:
    answer = raw({"jsonrpc": "2.0", "id": 1, "method": "status", "params": {}})
    assert (answer["id"], answer["error"]["data"]["reason"]) == (1, "hello_required")
    welcome = raw({"jsonrpc": "2.0", "id": "a", "method": "hello", "params": {"protocol": [1, 7]}})
    assert welcome["id"] == "a"
    assert welcome["result"]["protocol"] == [1, 0]
    assert "scan.start" in welcome["result"]["features"]
    assert raw({"jsonrpc": "2.0", "id": 2, "method": "status"})["result"]["name"]


def test_another_major_version_is_refused(raw: Any) -> None:
    error = raw({"jsonrpc": "2.0", "id": 1, "method": "hello", "params": {"protocol": [2, 0]}})["error"]
    assert error["data"]["reason"] == "protocol_version"
    assert "[1, 0]" in error["message"]
    assert error["data"]["hint"]


@pytest.mark.parametrize(
    ("message", "code", "number"),
    [
        (b"\xc1\xff", -32700, None),
        (b"", -32700, None),
        ({"jsonrpc": "2.0", "id": 4, "method": 5}, -32600, 4),
        ({"id": 4, "method": "status"}, -32600, 4),
        ({"jsonrpc": "2.0", "id": 4, "method": "scan.begin"}, -32601, 4),
        ({"jsonrpc": "2.0", "id": 4, "method": "hello", "params": {"protocol": [1, -1]}}, -32602, 4),
        ({"jsonrpc": "2.0", "id": 4, "method": "hello", "params": {"protocol": []}}, -32602, 4),
        ({"jsonrpc": "2.0", "id": 4, "method": "hello", "params": {"protocol": "1.0"}}, -32602, 4),
        ({"jsonrpc": "2.0", "id": 4, "method": "hello", "params": {"pad": "x" * MAX_REQUEST_BYTES}}, -32011, None),
    ],
)
def test_broken_calls_are_answered(raw: Any, client: Client, message: Any, code: int, number: Any) -> None:
    answer = raw(message)
    assert (answer["error"]["code"], answer["id"]) == (code, number)
    assert answer["error"]["message"]
    assert client.status()["name"]


def test_a_message_beyond_the_limit_ends_the_connection_and_not_the_daemon(endpoint: str, client: Client) -> None:
    with zmq.Context() as context, context.socket(zmq.DEALER) as dealer:
        dealer.setsockopt(zmq.LINGER, 0)
        dealer.connect(endpoint)
        dealer.send(bytes(9 << 20))
        assert not dealer.poll(300)
    assert client.status()["name"]


def test_a_req_socket_is_served(endpoint: str) -> None:
    with zmq.Context() as context, context.socket(zmq.REQ) as req:
        req.setsockopt(zmq.LINGER, 0)
        req.setsockopt(zmq.RCVTIMEO, 3000)
        req.connect(endpoint)
        req.send(msgpack.packb({"jsonrpc": "2.0", "id": 1, "method": "hello", "params": {"protocol": [1, 0]}}))
        assert msgpack.unpackb(req.recv())["result"]["protocol"] == [1, 0]


def test_sockets_are_the_groups_alone(endpoint: str) -> None:
    folder = Path(endpoint.removeprefix("ipc://")).parent
    sockets = [path for path in folder.iterdir() if stat.S_ISSOCK(path.stat().st_mode)]
    assert {path.name for path in sockets} >= {"control.ipc", "events.ipc", "worker.ipc"}
    assert {oct(stat.S_IMODE(path.stat().st_mode)) for path in sockets} == {"0o660"}


def test_status_and_devices(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    status = client.status()
    assert status["devices"]["camera"]["width"] == 320
    assert len(status["workers"]) == 1
    assert status["spool"]["bytes"] >= 0
    monkeypatch.setattr(client, "timeout_s", 0.05)  # every driver looks, each in a process of its own: it takes longer
    assert "simulated" in {device["driver"] for device in client.devices()}


def test_preview_shows_what_the_camera_sees(client: Client) -> None:
    with zmq.Context() as context, context.socket(zmq.SUB) as preview:
        preview.setsockopt(zmq.LINGER, 0)
        preview.setsockopt(zmq.CONFLATE, 1)
        preview.setsockopt(zmq.SUBSCRIBE, b"")
        words: dict[str, Any] = {"rate_hz": 20.0, "max_width": 160}
        preview.connect(client.preview_start(**words))
        assert preview.poll(20_000)
        header, pixels = decode_preview(preview.recv())
        assert (header.width, header.height, header.stride) == (160, 120, 2)
        assert np.frombuffer(pixels, np.uint8).max() > 50
        client.preview_start(**words)  # as clients do where pictures are late: it must not begin anew
        numbers = [header.number, *(decode_preview(preview.recv())[0].number for _ in range(3))]
        assert numbers == sorted(set(numbers))
        assert client.scan("mcp").xyz is not None  # a scan goes before, and the preview goes on after it
        preview.recv()
        assert preview.poll(20_000)
    client.preview_stop()


# --- asyncio ------------------------------------------------------------------------------------------------------


async def test_async_clients_at_once(endpoint: str, tmp_path: Path) -> None:
    async with AsyncClient(endpoint) as one, AsyncClient(endpoint) as two:
        kinds: list[str] = []
        scans = await asyncio.gather(
            one.scan("mcp", on_event=lambda event: kinds.append(event.kind)), two.scan("mcp", folder=tmp_path / "two")
        )
        assert all(scan.xyz is not None for scan in scans)
        assert kinds[-1] == "done"
        with pytest.raises(Refused, match="no job"):
            await two.result(str(uuid.uuid4()))


async def test_a_cancelled_task_cancels_its_scan(endpoint: str) -> None:
    async with AsyncClient(endpoint) as client:
        started = asyncio.Event()
        task = asyncio.create_task(client.scan("pmp", on_event=lambda event: started.set()))
        await started.wait()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert (await client.list_scans())[-1]["state"] == "cancelled"
