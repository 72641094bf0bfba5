"""Killed workers, daemons and devices processes: what is left is decoded, or failed with its reason."""

from __future__ import annotations

import asyncio
import json
import os
import resource
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from scanner.capture import Capture
from scanner.client import AsyncClient, Client
from scanner.errors import DecodeError, DeviceLost, Unreachable
from service.config import load_rig
from service.daemon import Daemon
from tests.faults.daemons import RIG, RunningDaemon, children, wait_for


def wait_for_event(client: Client, job: str, kind: str) -> None:
    for event in client.events(job):
        if event.kind == kind:
            return
    raise AssertionError(f"{job} ended without {kind}: {client.result(job)}")


# --- workers ------------------------------------------------------------------------------------------------------


def test_a_killed_worker_is_replaced_and_a_capture_that_kills_three_is_given_up_and_named(
    daemon: Callable[..., RunningDaemon], tmp_path: Path
) -> None:
    running = daemon()
    killed: set[int] = set()
    with Client(running.endpoint) as client:
        # Once, in mid-scan: another worker takes the scan over.
        job = client.start_scan("pmp")
        (seat,) = wait_for(lambda: [w for w in client.status()["workers"] if w["job"] == job])
        os.kill(seat["pid"], signal.SIGKILL)
        assert client.wait(job)["state"] == "done"
        assert client.status()["workers"][0]["pid"] != seat["pid"]

        # Every worker that takes the capture.
        job = client.start_scan("pmp")
        deadline = time.monotonic() + 60
        while (status := client.call("scan.status", id=job))["state"] not in ("failed", "done"):
            assert time.monotonic() < deadline
            for worker in client.status()["workers"]:
                if worker["job"] == job and worker["pid"] not in killed:
                    killed.add(worker["pid"])
                    os.kill(worker["pid"], signal.SIGKILL)
            time.sleep(0.01)
        assert (status["reason"], len(killed)) == ("worker_lost", 3)
        assert job in status["error"]["message"]
        assert "fringed decode" in status["error"]["data"]["hint"]
        with pytest.raises(DecodeError, match=job):
            client.fetch(job, Path("never"))
        wait_for(lambda: client.result(job)["files"])  # the capture may still have been under way
        kept = Capture.open(client.fetch(job, tmp_path / "kept", failed_too=True) / "capture")
        assert (kept.header.state, kept.missing) == ("complete", ())
        assert client.scan("mcp").xyz is not None


# --- daemons ------------------------------------------------------------------------------------------------------


def test_daemon_killed_while_it_acquires(daemon: Callable[..., RunningDaemon], tmp_path: Path) -> None:
    first, job_id = daemon(workers=0), str(uuid.uuid4())
    with Client(first.endpoint) as client:
        client.start_scan("pmp", job_id=job_id)
        wait_for_event(client, job_id, "frame")
        first.kill()
    second = daemon()
    with Client(second.endpoint) as client:
        assert client.start_scan("pmp", job_id=job_id) == job_id
        outcome = client.wait(job_id)
        assert (outcome["state"], outcome["reason"]) == ("failed", "daemon_restarted")
        assert outcome["error"]["message"]
        header = (tmp_path / "state" / "spool" / job_id / "capture" / "capture.json").read_bytes()
        assert json.loads(header)["state"] == "failed"
        listed = {entry["name"] for entry in client.result(job_id)["files"]}
        assert {"capture/capture.json", "capture/frames.npy", "capture/frames.jsonl"} <= listed
        assert client.scan("mcp").xyz is not None


def test_daemon_killed_between_scan_and_decode(daemon: Callable[..., RunningDaemon]) -> None:
    first, job_id = daemon(workers=0), str(uuid.uuid4())
    with Client(first.endpoint) as client:
        client.start_scan("mcp", job_id=job_id)
        wait_for_event(client, job_id, "acquired")
        first.kill()
    second = daemon()
    with Client(second.endpoint) as client:
        assert client.start_scan("mcp", job_id=job_id) == job_id
        outcome = client.wait(job_id)
        assert (outcome["state"], outcome["reason"]) == ("done", "completed")
        assert len(client.list_scans()) == 1


def test_daemon_killed_with_a_scan_in_the_queue(daemon: Callable[..., RunningDaemon]) -> None:
    first = daemon(workers=0)
    with Client(first.endpoint) as client:
        client.start_scan("pmp")
        waiting = client.start_scan("mcp")
        first.kill()
    second = daemon(workers=0)
    with Client(second.endpoint) as client:
        outcome = client.wait(waiting)
        assert (outcome["state"], outcome["reason"]) == ("failed", "daemon_restarted")
        assert "queued" in outcome["error"]["message"]


def test_a_client_lives_through_a_restart(daemon: Callable[..., RunningDaemon]) -> None:
    first = daemon(workers=0)
    with Client(first.endpoint, timeout_s=30) as client:
        job = client.start_scan("mcp")
        wait_for_event(client, job, "acquired")
        first.kill()
        daemon()
        assert client.wait(job)["state"] == "done"


def test_nothing_lives_on_after_a_killed_daemon(daemon: Callable[..., RunningDaemon]) -> None:
    running = daemon()
    with Client(running.endpoint) as client:
        client.start_scan("pmp")
        started = wait_for(lambda: (pids := children(running.process.pid)) and len(pids) == 2 and pids)
    running.kill()
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in started))
    with pytest.raises(Unreachable, match="nobody listens"):
        Client(running.endpoint)


def test_two_daemons_on_one_state_are_refused(daemon: Callable[..., RunningDaemon], tmp_path: Path) -> None:
    daemon(workers=0)
    second = subprocess.run(
        [sys.executable, "-m", "service.daemon", "--config", RIG, "--private", tmp_path / "state"],
        capture_output=True,
        text=True,
        check=False,
        timeout=20,
    )
    assert second.returncode == 1
    assert "another daemon" in second.stderr


@pytest.mark.parametrize(("number", "workers"), [(signal.SIGTERM, 1), (signal.SIGHUP, 0)])
def test_a_signal_ends_a_daemon_in_order(
    number: signal.Signals, workers: int, daemon: Callable[..., RunningDaemon], tmp_path: Path
) -> None:
    running = daemon(workers=workers)
    with Client(running.endpoint) as client:
        job = client.start_scan("pmp")
        wait_for_event(client, job, "frame")
        running.process.send_signal(number)
        assert running.process.wait(10) == 0
    assert not list((tmp_path / "state").glob("*.ipc"))
    assert '"cancelled"' in (tmp_path / "state" / "jobs" / f"{job}.json").read_text()


# --- devices ------------------------------------------------------------------------------------------------------


@asynccontextmanager
async def daemon_here(state: Path, **options: Any) -> AsyncIterator[tuple[AsyncClient, Callable[[], int]]]:
    """A daemon in this event loop, its children real; gives a client and the devices process' id."""
    endpoint = f"ipc://{state}/control.ipc"
    rig = load_rig(RIG)
    served = Daemon(rig, state_dir=state, endpoint=endpoint, **options)
    ready = asyncio.Event()
    serving = asyncio.create_task(served.run(ready))
    await ready.wait()

    def devices() -> int:
        (pid,) = children(os.getpid(), "service.devices_process")
        return pid

    try:
        async with AsyncClient(endpoint) as client:
            yield client, devices
    finally:
        served.stop()
        await serving


async def test_a_disk_that_fills_and_devices_that_die_or_hang_end_the_scan_and_not_the_daemon(tmp_path: Path) -> None:
    async with daemon_here(tmp_path, devices_silence_s=3.0) as (client, devices):
        job = await client.start_scan("pmp", repeat=3)
        async for event in client.events(job):
            if event.kind == "frame":
                # The system refuses every write beyond the sixth frame, as it does when nothing is left.
                no_room = (500_000, resource.RLIM_INFINITY)
                before = resource.prlimit(devices(), resource.RLIMIT_FSIZE, no_room)
                break
        outcome = await client.wait(job)
        assert (outcome["state"], outcome["reason"]) == ("failed", "disk_full")
        assert "File too large" in outcome["error"]["message"]
        resource.prlimit(devices(), resource.RLIMIT_FSIZE, before)
        assert (await client.scan("mcp")).xyz is not None

        for blow, says in (signal.SIGKILL, "devices process died"), (signal.SIGSTOP, "said nothing for 3 s"):
            job = await client.start_scan("pmp")
            async for event in client.events(job):
                if event.kind == "frame" and event.fields["captured"] < event.fields["total"]:
                    os.kill(devices(), blow)
                    break
            outcome = await client.wait(job)
            assert (outcome["state"], outcome["reason"]) == ("failed", "device_lost")
            assert says in outcome["error"]["message"]
            with pytest.raises(DeviceLost):
                await client.fetch(job, tmp_path / "never")
            assert (await client.scan("mcp")).xyz is not None  # they came back


async def test_a_worker_that_hangs_is_replaced(tmp_path: Path) -> None:
    async with daemon_here(tmp_path, worker_silence_s=2.5) as (client, _):
        while not (workers := (await client.status())["workers"]):
            await asyncio.sleep(0.05)
        job = await client.start_scan("mcp")
        os.kill(workers[0]["pid"], signal.SIGSTOP)
        assert (await client.wait(job))["state"] == "done"


async def test_a_frame_that_is_damaged_in_the_spool_is_missing(tmp_path: Path) -> None:
    async with daemon_here(tmp_path) as (client, _):
        while not (workers := (await client.status())["workers"]):
            await asyncio.sleep(0.05)
        # The last frame: of MCP the only one, of PMP a sentinel, which the fringes can do without.
        for method in ("mcp", "pmp"):
            os.kill(workers[0]["pid"], signal.SIGSTOP)
            job = await client.start_scan(method)
            async for event in client.events(job):
                if event.kind == "acquired":
                    frames = tmp_path / "spool" / job / "capture" / "frames.npy"
                    content = bytearray(frames.read_bytes())
                    content[-5000] ^= 1
                    frames.write_bytes(content)
                    os.kill(workers[0]["pid"], signal.SIGCONT)
            outcome = await client.result(job)
            if method == "mcp":
                assert (outcome["state"], outcome["reason"]) == ("failed", "decode_failed")
            else:
                assert outcome["state"] == "done"
                assert len(outcome["report"]["capture"]["missing"]) == 1
