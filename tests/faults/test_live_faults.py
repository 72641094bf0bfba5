"""Live runs whose worker, camera, disk or daemon goes away: nothing hangs, nothing is left, recordings stay whole."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from scanner.capture import Capture
from scanner.client import Client
from scanner.errors import DeviceLost, StorageError
from scanner.live import LiveFrame
from scanner.series import read_series
from tests.faults.daemons import RunningDaemon, children, wait_for

pytestmark = pytest.mark.alone

RIG = "simulated:quick/board?ring=6&period_us=16667&modulation=none"
SHORT = {"exposure": 15_000.0}


def until(frames: Iterator[LiveFrame], number: int) -> LiveFrame:
    for frame in frames:
        if frame.number >= number:
            return frame
    raise AssertionError(f"the run ended before frame {number}")


def test_worker_devices_and_daemon_go_away_one_after_the_other(
    daemon: Callable[..., RunningDaemon], tmp_path: Path
) -> None:
    running = daemon(rig=RIG)
    with Client(running.endpoint) as client:
        # The worker is killed: another one goes on, in the same run, at the same socket.
        run = client.live_start(**SHORT)["id"]
        frames = client.live_frames(run)
        before = until(frames, 3)
        os.kill(client.status()["workers"][0]["pid"], signal.SIGKILL)
        after = until(frames, before.number + 10)
        assert after.rows is not None
        client.live_stop(run)
        report = client.wait(run)["report"]
        assert report["captured"] == report["decoded"] + report["undecodable"] + report["dropped"]
        assert report["lost"] == 0
        assert report["frames_per_s"] > 50

        # The devices process is killed: the run fails, what was recorded is kept, and the next run has fresh devices.
        run = client.live_start(retain="record", **SHORT)["id"]
        frames = client.live_frames(run)
        until(frames, 10)
        os.kill(wait_for(lambda: children(running.process.pid, "devices_process"))[0], signal.SIGKILL)
        with pytest.raises(DeviceLost, match="devices process died"):
            until(frames, 10**6)
        outcome = client.wait(run)
        assert (outcome["state"], outcome["reason"]) == ("failed", "device_lost")
        client.fetch(run, tmp_path / "kept", failed_too=True)
        (part,) = read_series(tmp_path / "kept" / "capture")
        assert len(Capture.open(part.path).records) >= 10

        # The daemon is killed while it records: the next one finds the recording.
        run = client.live_start(retain="record", **SHORT)["id"]
        until(client.live_frames(run), 10)
        running.process.kill()
    running.end()
    running = daemon(rig=RIG)
    with Client(running.endpoint) as client:
        outcome = client.wait(run)
        assert (outcome["state"], outcome["reason"]) == ("done", "daemon_restarted")
        (part,) = read_series(spool(tmp_path, run))
        assert len(Capture.open(part.path).records) > 10

        # The daemon is told to end while it records: the recording is closed.
        run = client.live_start(retain="record", **SHORT)["id"]
        until(client.live_frames(run), 5)
        client.shutdown()
    running.process.wait(15)
    (part,) = read_series(spool(tmp_path, run))
    capture = Capture.open(part.path)
    assert (capture.header.state, capture.missing) == ("complete", ())
    assert '"state": "complete"' in (part.path.parent / "series.json").read_text()


def spool(folder: Path, job: str) -> Path:
    return folder / "state" / "spool" / job / "capture"


def test_no_room_refuses_a_recording_and_an_unplugged_camera_ends_a_run(daemon: Callable[..., RunningDaemon]) -> None:
    running = daemon(rig=f"{RIG}&kind=static&unplug_after=30", spool_limit_gb=0.02)
    with Client(running.endpoint) as client:
        with pytest.raises(StorageError, match="spool"), client.live(retain="record", **SHORT) as frames:
            next(frames)
        run = client.live_start(**SHORT)["id"]
        with pytest.raises(DeviceLost, match="went away"):
            until(client.live_frames(run), 10**6)
        outcome = client.wait(run)
        assert (outcome["state"], outcome["reason"], outcome["report"]["captured"]) == ("failed", "device_lost", 30)
