"""The parts of a live run, each by itself: frames without end, rings and recordings, rows on the wire, counts."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.registry import open_camera, open_projector
from scanner import live as client_live
from scanner.capture import Capture, CaptureHeader, FrameRecord, digest
from scanner.clock import VirtualClock
from scanner.devices import Exposure, Source, TriggerMode
from scanner.durations import BIN_MS, Durations
from scanner.errors import DecodeError, DeviceLost, ProtocolError, ScannerError, StorageError
from scanner.live import LiveWatch
from scanner.live_picture import encoded, live_picture, relief
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, ProjectorSize
from scanner.reconstruct_live import quantised, row_scale
from scanner.sequencer import Rig, endless
from scanner.series import read_series, recording_at, segment_name
from scanner.stream import LiveBegin, LiveCounts, LiveFrame
from scanner.wire_images import LiveHeader, encode_image
from service.commands import live as live_command
from service.commands.live import figures, sent_points
from service.live_files import close_recording, reserve
from service.live_series import LiveSeries, LiveTotals
from service.live_storage import FrameRing, Recording, ring_slots
from service.live_work import LiveWork
from service.pipe import Kept, Shot
from service.series import recorded_files
from service.spool import Limits, Spool

MCP = McpPattern(bits=2, carriers=(20.0, 34.0), codes=(0, 1, 2, 3))
SEQUENCE = PatternSequence(ProjectorSize(160, 128), MCP)
CAMERA = CameraFormat(160, 128, 8)
HEADER = CaptureHeader(SEQUENCE, CAMERA, id="run", repeat=256)


# --- frames without end -------------------------------------------------------------------------------------------


def rig(clock: VirtualClock, mode: TriggerMode | None = None, **camera: Any) -> tuple[Rig, PatternSequence]:
    found = Rig(
        open_projector("simulated", "quick/board", {}, clock),
        open_camera("simulated", "quick/board", {"ring": 3, **camera}, clock),
        trigger_mode=mode,
    )
    size = found.projector.capabilities
    return found, PatternSequence(ProjectorSize(size.width, size.height), MCP)


def test_a_projector_that_goes_away_ends_the_run_although_the_camera_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = VirtualClock()
    here, sequence = rig(clock)
    unplugged_ns = clock.now_ns() + 600_000_000

    def check() -> None:
        if clock.now_ns() > unplugged_ns:
            raise DeviceLost("the display went away", device="screen")

    monkeypatch.setattr(here.projector, "check_present", check, raising=False)
    with pytest.raises(DeviceLost, match="display went away"):
        list(endless(here, here.plan(sequence), sequence, clock, lambda: False))
    assert unplugged_ns <= clock.now_ns() < unplugged_ns + 1_000_000_000, "noticed within a second"
    here.camera.close()
    here.projector.close()


@pytest.mark.parametrize("mode", [None, TriggerMode.SOFTWARE])
def test_frames_come_in_the_light_of_the_pattern_until_cancelled(mode: TriggerMode | None) -> None:
    clock = VirtualClock()
    devices, sequence = rig(clock, mode)
    plan = devices.plan(sequence, repeat=8, exposure_ns=100_000_000)
    taken = []
    for frame in endless(devices, plan, sequence, clock, lambda: len(taken) == 5):
        taken.append(frame)
        assert frame.pixels.max() > 50
    assert [frame.record.frame_id for frame in taken] == list(range(taken[0].record.frame_id or 0, 5))
    assert {frame.record.verdict for frame in taken} == {"proved"}
    assert sum(frame.lost for frame in taken) == 0
    with pytest.raises(ScannerError):  # the camera was stopped
        devices.camera.pop(0)


def test_lost_and_broken_frames_are_counted_and_not_given() -> None:
    clock = VirtualClock()
    devices, sequence = rig(clock, faults={"drop": [3, 4], "incomplete": [6]})
    frames = endless(devices, devices.plan(sequence), sequence, clock, lambda: False)
    found = [(frame.record.frame_id, frame.lost) for frame, _ in zip(frames, range(5), strict=False)]
    frames.close()
    assert found == [(0, 0), (1, 0), (2, 0), (5, 2), (7, 1)]


def test_a_camera_that_falls_silent_is_lost() -> None:
    clock = VirtualClock()
    devices, sequence = rig(clock, faults={"drop_probability": 1.0})
    with pytest.raises(DeviceLost, match="no frame"):
        next(endless(devices, devices.plan(sequence), sequence, clock, lambda: False))


# --- rings and recordings -----------------------------------------------------------------------------------------


def frame(number: int) -> tuple[np.ndarray[Any, Any], FrameRecord]:
    exposure = Exposure(number * 10**9, number * 10**9 + 10**7, 1000, Source.HARDWARE)
    return np.full(CAMERA.shape, number % 251, np.uint8), FrameRecord(None, 0, frame_id=number, exposure=exposure)


def test_the_ring_overwrites_the_oldest_and_is_gone_afterwards(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    ring = FrameRing(folder, CAMERA, 3)
    written = [ring.write(*frame(n), n) for n in range(4)]
    content = np.fromfile(written[0][0], np.uint8).reshape(3, *CAMERA.shape)
    assert [int(slot[0, 0]) for slot in content] == [3, 1, 2]
    assert (written[3][1], written[3][2]) == (written[0][1], digest(frame(3)[0]))
    ring.close("complete", None)
    assert not folder.exists()
    assert [ring_slots(period) for period in (1, 16_666_667, 10**9)] == [256, 30, 16]


def test_a_recording_is_a_series_of_captures(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    header = replace(HEADER, plan={"patterns": 1, "repeat": 256})
    recording = Recording(tmp_path / "run", header, {"id": "lenses"}, lambda *kept: told.append(kept))
    places = [recording.write(*frame(n), n) for n in range(300)]
    assert places[256][0].endswith("000001/frames.npy")
    recording.close("complete", "completed")
    assert told == [(256, 256 * 160 * 128), (300, 300 * 160 * 128)]
    parts = read_series(tmp_path / "run")
    assert [(part.path.name, part.first) for part in parts] == [("000000", 0), ("000001", 256)]
    assert recording_at(parts[1].path) == [parts[1]]
    for part, count in zip(parts, (256, 44), strict=True):
        capture = Capture.open(part.path)
        assert (capture.header.state, capture.header.repeat, capture.missing) == ("complete", count, ())
        assert capture.header.plan == {"patterns": 1, "repeat": count}
        assert [capture.frame(i)[0, 0] for i in (0, count - 1)] == [part.first % 251, (part.first + count - 1) % 251]
        assert capture.records[1].frame_id == part.first + 1
        assert (part.path / "calibration.json").exists()
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"000000", "000001", "series.json"}


def test_a_ring_of_seconds_keeps_the_last_ones(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "run", HEADER, None, lambda *_: None, keep_s=20.0, period_ns=10**9)
    for number in range(95):  # one a second, ten to a folder
        recording.write(*frame(number), number)
    recording.close("complete", "completed")
    parts = read_series(tmp_path / "run")
    numbers = [part.first + i for part in parts for i in Capture.open(part.path).records]
    assert numbers == list(range(numbers[0], 95))
    assert 20 <= len(numbers) <= 40


def test_a_disk_that_fills_up_is_told_at_the_next_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = Recording(tmp_path / "run", HEADER, None, lambda *_: None)
    monkeypatch.setattr("os.posix_fallocate", _no_room)
    for number in range(256):  # room for these was taken before
        recording.write(*frame(number), number)
    with pytest.raises(StorageError, match="No space"):
        recording.write(*frame(256), 256)
    monkeypatch.undo()
    recording.close("failed", "disk_full")
    (part,) = read_series(tmp_path / "run")
    assert len(Capture.open(part.path).records) == 256


def test_a_recording_asks_for_room_for_what_follows(tmp_path: Path) -> None:
    (tmp_path / "now").mkdir()
    (tmp_path / "now" / "frames.npy").write_bytes(bytes(2_000_000))
    spool = Spool(tmp_path, Limits(bytes=3_500_000))
    assert reserve(spool, Kept("now", 256, 1_000_000), []) == []
    with pytest.raises(StorageError, match="spool"):
        reserve(spool, Kept("now", 256, 2_000_000), [])


def _no_room(*_: object) -> None:
    raise OSError(28, "No space left on device")


def test_what_a_crash_left_is_trimmed_and_listed(tmp_path: Path) -> None:
    folder = tmp_path / "run" / "capture"
    recording = Recording(folder, HEADER, None, lambda *_: None)
    for number in range(256 + 7):
        recording.write(*frame(number), number)
    recording._disk.shutdown()  # as after kill -9: nothing is closed any more
    (folder / segment_name(2)).mkdir()
    files = close_recording(folder, "daemon_restarted")
    assert {entry.name for entry in files} >= {"capture/series.json", "capture/000001/frames.npy"}
    last = Capture.open(folder / "000001")
    assert (last.header.state, len(last.records)) == ("open", 7)
    assert (folder / "000001" / "frames.npy").stat().st_size == 128 + 7 * 160 * 128
    assert [part.first for part in read_series(folder)] == [0, 256]
    assert files == recorded_files(folder)
    recording._now.writer.abandon()
    assert close_recording(tmp_path / "nothing", "x") == []


@pytest.mark.parametrize("name", ["..", "a/b", "/etc"])
def test_a_series_names_only_folders_beside_it(tmp_path: Path, name: str) -> None:
    content = f'{{"format": "fringed-series", "version": 1, "captures": [{{"folder": "{name}", "first": 0}}]}}'
    (tmp_path / "series.json").write_text(content)
    with pytest.raises(DecodeError):
        read_series(tmp_path)


# --- rows on the wire ---------------------------------------------------------------------------------------------


@given(st.lists(st.none() | st.floats(-0.5, 863.5, width=32), min_size=1, max_size=50))
def test_rows_cross_the_wire_to_half_a_step(values: list[float | None]) -> None:
    rows = np.array([[np.nan if v is None else v for v in values]], np.float32)
    scale = row_scale(864)
    sent, count = quantised(rows, scale)
    assert count == np.count_nonzero(sent)
    # The plain form: round half up, at least 1, 0 = none.
    plain = np.nan_to_num(np.clip(np.floor((rows + np.float32(0.5)) * np.float32(scale) + np.float32(0.5)), 1, 65535))
    np.testing.assert_array_equal(sent, plain.astype(np.uint16))
    header = head(0, width=rows.shape[1], height=1, scale=scale)
    found = LiveWatch("run").result(encode_image(header, sent.data.cast("B")))
    assert found is not None
    assert found.rows is not None
    # At the very top the least value, 1, is a whole step away from row -0.5.
    tolerance = 0.5 / scale + 1e-4
    np.testing.assert_allclose(found.rows, np.maximum(rows, -0.5 + 0.5 / scale), atol=tolerance)


def head(number: int, **members: Any) -> LiveHeader:
    given_members = {"width": 1, "height": 1, "scale": 75.0, "content": "rows", "dtype": "uint16", **members}
    return LiveHeader(number=number, job="run", **given_members)


def test_a_client_counts_what_it_missed_and_takes_its_own_run_only() -> None:
    watch = LiveWatch("run")
    assert [f.missed for n in (2, 3, 7) if (f := watch.result(encode_image(head(n), b"\1\0")))] == [2, 0, 3]
    assert watch.missed == 5
    assert watch.result(encode_image(head(6), b"\1\0")) is None
    other = LiveHeader(number=9, job="another", content="rows", width=0, height=0, dtype="uint16")
    assert watch.result(encode_image(other, b"")) is None
    with pytest.raises(ProtocolError):
        watch.result(encode_image(head(9), b"\1"))


def test_a_client_learns_of_the_end_from_the_state() -> None:
    def run(state: str, **members: Any) -> dict[str, Any]:
        return {"run": {"id": "run", "state": state, "reason": None, "live": {}, **members}}

    watch = LiveWatch("run")
    watch.state(run("acquiring"))
    watch.state(run("acquired"))  # why it ended is not known yet
    assert not watch.finished
    error = {"code": -32005, "message": "gone", "data": {"class": "DeviceLost", "hint": "plug it in"}}
    with pytest.raises(DeviceLost, match="gone"):
        watch.state(run("failed", error=error))
    for status in (run("done"), run("cancelled"), {"run": None}, {"run": {"id": "later"}}):
        watch = LiveWatch("run")
        watch.state(status)
        assert watch.finished


def test_pictures_of_rows_and_of_nothing(tmp_path: Path) -> None:
    y, x = np.mgrid[0:60, 0:80].astype(np.float32)
    rows = 2 * y + 0.5 * x
    np.testing.assert_allclose(relief(rows), 0, atol=1e-3)
    rows[20:30, 20:30] = np.nan
    frame = LiveWatch("run").result(encode_image(head(0, width=80, height=60), quantised(rows, 75.0)[0].data.cast("B")))
    assert frame is not None
    assert encoded(live_picture(frame), ".png").startswith(b"\x89PNG")
    empty = LiveWatch("run").result(encode_image(head(0, width=0, height=0, error="no stripes"), b""))
    assert empty is not None
    assert (empty.rows, empty.xyz, empty.error) == (None, None, "no stripes")
    assert live_picture(empty).shape == live_picture(frame).shape
    with pytest.raises(StorageError, match="gif"):
        encoded(live_picture(frame), ".gif")


# --- counts -------------------------------------------------------------------------------------------------------


@given(st.lists(st.floats(0, 12_000), min_size=1, max_size=200), st.floats(0.01, 1))
def test_percentiles_are_right_to_a_bin(durations: list[float], share: float) -> None:
    first, second = Durations(), Durations()
    for number, duration in enumerate(durations):
        (first if number % 2 else second).add(duration)
    total = Durations()
    for part in (first, second):
        total.add_counts(part.take_fresh(), part.largest_ms)
        assert part.take_fresh() == []
    exact = float(np.quantile(durations, share, method="inverted_cdf"))
    found = total.percentile(share)
    assert found is not None
    assert total.count == len(durations)
    if exact < 10_000:
        assert exact - 1e-3 <= found <= exact + BIN_MS + 1e-9
    assert sum(count for _, count in total.as_dict(bins=True)["bins"]) == len(durations)


def test_every_frame_is_counted_once_also_when_workers_die() -> None:
    totals = LiveTotals(captured=100)
    totals.add(counts(next=40, decoded=20, dropped=18))  # two under way
    totals.settle()  # its worker died: they are gone, too
    assert totals.dropped == 20
    totals.add(counts(next=90, decoded=10, undecodable=5, dropped=35))
    totals.settle(over=True)
    assert totals.decoded + totals.undecodable + totals.dropped == 100
    assert Durations().as_dict() == {"count": 0, "p50": None, "p90": None, "p99": None, "max": None}


def counts(**members: int) -> LiveCounts:
    given_members: dict[str, Any] = {"next": 0, "decoded": 0, "undecodable": 0, "dropped": 0, **members}
    return LiveCounts(delivery=1, latency=[], largest_ms=0.0, decode_ms=1.0, **given_members)


async def test_a_run_passes_on_the_newest_frames_and_forgives_steady_workers() -> None:
    series = LiveSeries("run", {}, None, "ipc:///x", "rows", 1, {}, delivering=lambda _: None, deliveries=2)
    begin = series.begin(7)
    assert (begin.delivery, begin.first) == (7, 0)
    for number in range(10):
        series.shot(Shot("run", number, "/ring", 0, "", number, 0, 0, 3))
    assert [f.number for f in series.take(7)] == [6, 7, 8, 9]
    assert (series.counts.captured, series.counts.lost) == (10, 3)
    series.hear(counts(next=10))
    assert series.deliveries == 2
    series._began -= 60
    series.hear(counts(next=10))
    assert series.deliveries == 1


# --- the worker ---------------------------------------------------------------------------------------------------


@pytest.fixture
def work(tmp_path: Path) -> Iterator[tuple[LiveWork, list[Any], FrameRing]]:
    said: list[Any] = []
    begin = LiveBegin(1, "run", HEADER.as_dict(), None, f"ipc://{tmp_path}/live.ipc", 5)
    ring = FrameRing(tmp_path / "ring", CAMERA, 4)
    working = LiveWork(begin, said.append, threads=2)
    yield working, said, ring
    working.close()
    ring.close("complete", None)


def message(ring: FrameRing, number: int, pixels: Any) -> LiveFrame:
    path, offset, xxh3 = ring.write(pixels, frame(number)[1], number)
    now = time.monotonic_ns()
    return LiveFrame(1, number, path, offset, xxh3, number, now - 1000, now)


def test_the_newest_frame_wins_and_all_are_counted(work: tuple[LiveWork, list[Any], FrameRing]) -> None:
    working, said, ring = work
    light = (10 + 200 * MCP.fringe(0, SEQUENCE.projector)).astype(np.uint8)
    working.frame(message(ring, 8, light))  # 5, 6 and 7 never came this far
    published(working, 1)
    for number in range(9, 28):  # the worker is slower than this loop
        working.frame(message(ring, number, light))
    working.frame(replace_digest(message(ring, 28, light)))
    working.close()
    total = LiveTotals(captured=29)
    for counted in said:
        total.add(counted)
    assert total.next == 29
    assert total.decoded >= 1
    assert total.dropped >= 3
    assert total.decoded + total.undecodable + total.dropped == 29 - 5
    assert total.latency.count == total.decoded + total.undecodable
    assert said[-1].threads == 2


def published(working: LiveWork, results: int) -> None:
    """Wait until so many are out, in order."""
    deadline = time.monotonic() + 10
    while working._publisher._next < results:
        assert time.monotonic() < deadline
        time.sleep(0.001)


def replace_digest(message: LiveFrame) -> LiveFrame:
    """As of a frame that was overwritten before it was read."""
    return LiveFrame(**{name: getattr(message, name) for name in message.__struct_fields__} | {"xxh3": 16 * "0"})


def test_frames_without_a_pattern_are_results_with_words(work: tuple[LiveWork, list[Any], FrameRing]) -> None:
    working, said, ring = work
    working.frame(message(ring, 5, np.zeros(CAMERA.shape, np.uint8)))
    published(working, 1)
    working.close()
    assert sum(counted.undecodable for counted in said) == 1
    assert any(counted.problem for counted in said)


# --- the terminal -------------------------------------------------------------------------------------------------


def test_the_line_waits_until_there_are_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_command, "FIRST_S", 0.0)
    run: dict[str, Any] = dict.fromkeys(("frames_per_s", "results_per_s", "dropped", "lost", "points"), 1)
    run |= {"retain": "none", "problem": None}
    latencies: list[float | None] = [None, None, 24.0]
    client = SimpleNamespace(
        live_status=lambda: {"live": {**run, "latency_ms": {"p50": latencies[0], "p99": latencies.pop(0)}}}
    )
    lines: list[str] = []
    watching = live_command._Watching(client, None, lambda: None)  # type: ignore[arg-type]  as far as it asks
    frame = client_live.LiveFrame(head(1, content="rows", width=2, height=1), np.zeros((1, 2), np.uint16), 0)
    watching.all(iter([frame] * 3), lines.append)
    assert len(lines) == 1
    assert "latency 24 ms" in lines[0]


def test_the_line_counts_the_points_that_are_sent() -> None:
    xyz = np.full((4, 6, 3), np.nan, np.float32)
    xyz[:3] = 500.0
    members = {"content": "xyz", "width": 6, "height": 4, "dtype": "float32"}
    thinned = client_live.LiveFrame(head(1, **members, stride=2, points=70), xyz, 0)
    whole = client_live.LiveFrame(head(1, **members, stride=1, points=18), xyz, 0)
    run = dict.fromkeys(("frames_per_s", "results_per_s", "dropped", "lost"), 1)
    run |= {"points": 70, "retain": "none", "problem": None, "latency_ms": {"p50": 1.0, "p99": 2.0}}
    assert "  18 points sent of 70" in figures(run, sent_points(thinned))
    assert "  70 points" in figures(run, sent_points(whole))
