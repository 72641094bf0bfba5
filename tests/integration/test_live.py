"""Live runs of a real daemon on the quick rig: results, refusals, recordings, slow clients."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

from scanner.capture import Capture
from scanner.client import AsyncClient, Client
from scanner.decode_options import DecodeOptions
from scanner.errors import ConfigError, DeviceBusy, ScannerError
from scanner.geometry import calibration_from_dict, load_calibration
from scanner.reconstruct_live import LiveReconstruction
from scanner.scan import load_scan
from scanner.series import read_series
from scanner.wire import Refused
from service.cli import main
from service.config import load_rig
from service.private import private_daemon
from tests.faults.daemons import settle

pytestmark = pytest.mark.alone

RIG = "simulated:quick/board?ring=6&period_us=16667&modulation=none"
SHORT = {"exposure": 15_000.0}
"""Shorter than the period: sixty frames a second."""


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with private_daemon(load_rig(RIG)) as found:
        settle(found)
        yield found


@pytest.fixture
def client(endpoint: str) -> Iterator[Client]:
    with Client(endpoint, name="test") as connected:
        yield connected
        if (run := connected.live_status()) is not None:
            connected.live_stop(run["id"])


def finished(client: Client, job: str) -> dict[str, Any]:
    """End a run and wait for the end of its job."""
    client.live_stop(job)
    return client.wait(job)


def test_every_frame_becomes_rows_as_they_come(client: Client) -> None:
    with client.live(**SHORT) as frames:
        taken = [frame for frame, _ in zip(frames, range(20), strict=False)]
    numbers = [frame.number for frame in taken]
    assert numbers == sorted(set(numbers))
    assert all(frame.missed == after - before - 1 for frame, before, after in zip(taken[1:], numbers, numbers[1:]))  # noqa: B905
    last = taken[-1]
    assert last.rows is not None
    assert last.rows.shape == (240, 320)
    assert last.header.points == np.count_nonzero(np.isfinite(last.rows)) > 50_000
    assert 0 < last.header.decode_ms < last.latency_ms < 2000
    scan = client.scan("mcp", **SHORT)
    assert scan.rows is not None
    assert float(np.nanmedian(np.abs(scan.rows - last.rows))) < 0.1
    report = finished(client, last.header.job)["report"]
    assert report["captured"] == report["decoded"] + report["undecodable"] + report["dropped"]
    assert report["latency_ms"]["count"] == report["decoded"]
    assert report["latency_ms"]["p50"] <= report["latency_ms"]["p99"] <= report["latency_ms"]["max"]
    assert report["frames_per_s"] > 50


def test_points_are_those_of_the_rows(client: Client) -> None:
    with client.live(content="xyz", stride=2, filters={"edges": False}, **SHORT) as frames:
        frame = next(frames)
    assert frame.xyz is not None
    assert frame.xyz.shape == (120, 160, 3)
    assert (frame.rows, frame.header.stride) == (None, 2)
    run = client.live_status()
    assert run is not None
    with client.live(**SHORT) as frames:
        rows = next(frames)
    found = rows.points(_calibration(run))[::2, ::2, 2]
    assert float(np.nanmedian(np.abs(found - frame.xyz[..., 2]))) < 0.5


def _calibration(run: dict[str, Any]) -> Any:
    return calibration_from_dict(run["live"]["calibration"], name="test")


def test_one_at_a_time_and_no_scan_meanwhile(client: Client) -> None:
    job = str(uuid.uuid4())
    assert client.live_start(job, **SHORT)["id"] == job
    assert client.live_start(job, **SHORT)["id"] == job
    for call in (
        client.live_start,
        lambda: client.start_scan("mcp"),
        client.devices,
    ):
        with pytest.raises(DeviceBusy, match="live run") as caught:
            call()
        assert "live.stop" in (caught.value.hint or "")
    with pytest.raises(Refused) as reused:
        client.live_start(job, content="xyz", **SHORT)
    assert reused.value.reason == "job_id_reused"
    assert client.cancel(job)["state"] in ("acquired", "done", "cancelled")
    over = client.wait(job)["state"]
    assert over in ("done", "cancelled")  # the latter before its first frame
    assert client.live_stop(job)["state"] == over
    assert client.list_scans()[-1]["kind"] == "live"
    scan = client.start_scan("pmp")
    with pytest.raises(DeviceBusy, match=scan) as caught:
        client.live_start()
    assert "scan.cancel" in (caught.value.hint or "")
    client.cancel(scan)
    client.wait(scan)


@pytest.mark.parametrize(
    ("params", "error", "named"),
    [
        ({"pattern": {"carriers": [1, 2]}}, ConfigError, "carriers"),
        ({"exposure": 1e9}, ConfigError, "exposure"),
        ({"filters": {"depth": [9.0, 1.0]}}, ConfigError, "depth"),
        ({"decoder": "none such"}, ConfigError, "none such"),
        ({"stride": 0}, Refused, "stride"),
        ({"retain": "some"}, Refused, "retain"),
        ({"method": "pmp"}, Refused, "method"),
        ({"seconds": -1.0}, Refused, "seconds"),
    ],
)
def test_what_cannot_run_is_refused_in_words(
    client: Client, params: dict[str, Any], error: type[ScannerError], named: str
) -> None:
    with pytest.raises(error, match=named), client.live(**params) as frames:
        next(frames)


def test_a_recording_decoded_later_gives_the_same(client: Client, tmp_path: Path) -> None:
    seen = {}
    with client.live(retain="record", **SHORT) as frames:
        for frame in frames:
            seen[frame.number] = frame.values.copy()
            if len(seen) > 10:
                break
        job = frame.header.job
    outcome = client.wait(job)
    assert (outcome["state"], outcome["report"]["recorded"]["frames"]) == ("done", outcome["report"]["captured"])
    client.fetch(job, tmp_path)
    (part,) = read_series(tmp_path / "capture")
    capture = Capture.open(part.path)
    assert len(capture.records) == outcome["report"]["captured"] == capture.header.repeat
    decoder = LiveReconstruction(
        capture.header, load_calibration(part.path / "calibration.json"), DecodeOptions(), follow=False
    )
    for number in sorted(seen)[::5]:
        # Live, one frame helps with the next: a value on a threshold may fall the other way, a thousandth of them.
        assert np.mean(decoder.result(capture.frame(number)).values == seen[number]) > 0.999


def test_the_last_seconds_only(client: Client, endpoint: str) -> None:
    with client.live(retain="ring", ring_s=0.25, **SHORT) as frames:
        for frame in frames:
            if frame.number > 60:
                break
    report = finished(client, frame.header.job)["report"]
    assert 15 <= report["recorded"]["frames"] < 50 < report["captured"]
    names = [entry["name"] for entry in client.result(frame.header.job)["files"]]
    assert "capture/000000/frames.npy" not in names
    client.delete(frame.header.job)
    assert not list((Path(endpoint.removeprefix("ipc://")).parent / "spool").glob(f"{frame.header.job}/**/*.npy"))


def test_nothing_is_kept_of_a_run_that_keeps_nothing(client: Client, endpoint: str) -> None:
    with client.live(seconds=0.2, **SHORT) as frames:
        job = [frame.header.job for frame in frames][-1]
    assert client.wait(job)["files"] == []
    assert not (Path(endpoint.removeprefix("ipc://")).parent / "spool" / job).exists()


def test_a_client_that_does_not_read_slows_nobody(client: Client) -> None:
    started = client.live_start(**SHORT)
    with zmq.Context() as context, context.socket(zmq.SUB) as sleeper:
        sleeper.setsockopt(zmq.LINGER, 0)
        sleeper.setsockopt(zmq.RCVHWM, 1)
        sleeper.setsockopt(zmq.SUBSCRIBE, b"")
        sleeper.connect(started["endpoint"])
        frames = client.live_frames(started["id"])
        taken = [frame for frame, _ in zip(frames, range(25), strict=False)]
        frames.close()
    report = finished(client, started["id"])["report"]
    assert report["frames_per_s"] > 50
    assert report["lost"] == 0
    assert taken[-1].number - taken[0].number + 1 - len(taken) == sum(frame.missed for frame in taken[1:])


async def test_async_clients_read_too(client: Client, endpoint: str) -> None:
    async with AsyncClient(endpoint) as one, AsyncClient(endpoint) as two:
        async with one.live(**SHORT) as frames:
            first = await anext(aiter(frames))
            others = two.live_frames(first.header.job)
            assert (await anext(others)).rows is not None
            await others.aclose()
            run = await two.live_status()
            assert run is not None
            assert run["state"] == "acquiring"
        run = await one.live_status()
        assert run is not None
        assert run["state"] in ("acquired", "done")


# --- fringed live, fringed decode ---------------------------------------------------------------------------------


def test_the_command_records_draws_and_says_how_it_went(
    endpoint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    take, picture = tmp_path / "take", tmp_path / "now.png"
    words = ["live", "--connect", endpoint, "--exposure", "15000", "--seconds", "0.4", "--record", str(take)]
    assert main([*words, "--picture", str(picture), "--json"]) == 0
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert report["state"] == "done"
    assert report["recorded"]["frames"] == report["captured"] > 15
    assert sum(count for _, count in report["latency_ms"]["bins"]) == report["latency_ms"]["count"]
    assert "frames/s in" in said.err
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert {path.name for path in take.iterdir()} == {"000000", "series.json"}
    assert main(words) == 1  # the folder is not empty
    assert main(["decode", str(take), "--frames", "3:4", "--json"]) == 0
    decoded = json.loads(capsys.readouterr().out)
    assert [frame["number"] for frame in decoded["frames"]] == [3, 4]
    scan = load_scan(take / "scan" / "000003")
    assert scan.report["live"]["number"] == 3
    assert scan.report["points"] == decoded["frames"][0]["points"] > 50_000


def test_ctrl_c_ends_the_command_well(endpoint: str, client: Client, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupt() -> None:
        while (run := client.live_status()) is None or run["state"] != "acquiring" or not run["live"]["decoded"]:
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    client.live_start(seconds=0.05, **SHORT)  # so that the run before is over, and known to be
    waiting = threading.Thread(target=interrupt)
    wait_until_over(client)
    waiting.start()
    assert main(["live", "--connect", endpoint, "--exposure", "15000"]) == 0
    waiting.join()
    assert "latency" in capsys.readouterr().out
    run = client.live_status()
    assert run is not None
    assert run["state"] == "done"


def wait_until_over(client: Client) -> None:
    while (run := client.live_status()) is not None and run["state"] != "done":
        time.sleep(0.02)


@pytest.mark.parametrize(
    "words", [["--last", "3"], ["--stride", "2"], ["--picture", "now.gif"], ["--rig", "simulated", "--connect", "x"]]
)
def test_wrong_usage_is_told_before_anything_moves(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["live", *words]) == 2
    assert words[0] in capsys.readouterr().err
