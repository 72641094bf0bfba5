"""A scan in the worker: made before the last frame is there, told when the series has ended, void where it goes on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.registry import open_camera
from scanner.capture import Capture, CaptureHeader, CaptureWriter
from scanner.clock import VirtualClock
from scanner.decode_options import DecodeOptions
from scanner.errors import SyncError
from scanner.reconstruct import calibration_for, reconstruct
from scanner.scan import load_scan
from scanner.storage import temporary_of
from scanner.stream import Ack, DecodedNote, End, FromWorker, PointsNote, Progress, Result, Start
from service.scan_work import ScanWork
from service.series import RecordTail
from tests.unit.sequencer_bench import Taken, pmp, take

DELIVERY = 7


class Room:
    """A capture folder that grows, and a worker's scan that follows it."""

    def __init__(self, folder: Path, taken: Taken) -> None:
        self.capture, self.output, self.taken = folder / "capture", folder / "scan-7", taken
        self.said: list[FromWorker] = []
        header = CaptureHeader(
            taken.sequence, taken.format, calibration="calibration.json", plan=taken.acquisition.plan.as_dict()
        )
        self.writer = CaptureWriter(self.capture, header, len(taken.sequence) + 4)
        camera = open_camera("simulated", "quick/board?seed=1", {}, VirtualClock())
        (self.capture / "calibration.json").write_text(json.dumps(camera.true_calibration().as_dict()))  # type: ignore[attr-defined]
        camera.close()
        self.tail = RecordTail(self.capture, DELIVERY)
        options = DecodeOptions().as_dict()
        start = Start(DELIVERY, "job", str(self.capture), str(self.output), options)
        self.work = ScanWork(start, self.said.append, lambda _: None, decode=True)
        self.work.begin()

    def write(self, position: int, shown: int | None = None) -> None:
        """Put a frame into the folder, or that of another position in its place; the worker takes it."""
        record = self.taken.acquisition.last[position]
        slot, digest = self.writer.write(self.taken.frames[position if shown is None else shown])
        self.writer.record(replace(record, slot=slot, xxh3=digest))
        for message in self.tail.read(100):
            self.work.frame(message)

    def end(self) -> Result:
        """Close the folder and the series."""
        self.writer.close("complete", "completed")
        self.tail.close()
        message = End(DELIVERY, "completed", self.tail.sent, [])
        self.work.heard(message)
        result = self.work.end(message)
        assert isinstance(result, Result)
        return result

    def told(self) -> list[Any]:
        return [type(message) for message in self.said if not isinstance(message, Ack | Progress)]

    def notes(self) -> list[PointsNote]:
        return [message for message in self.said if isinstance(message, PointsNote)]

    def by_hand(self) -> Any:
        capture = Capture.open(self.capture)
        return reconstruct(capture, calibration_for(capture))


@pytest.fixture(scope="module")
def taken() -> Taken:
    return take(pmp())


def test_points_are_there_with_the_last_frame_and_the_rest_is_told_with_the_end(tmp_path: Path, taken: Taken) -> None:
    room = Room(tmp_path, taken)
    decoded_last = max(taken.sequence.fringes)
    for position in range(len(taken.sequence)):
        room.write(position)
        assert temporary_of(room.output / "scan.npz").exists() == (position >= decoded_last)
        assert len(room.notes()) == (position + 1 == len(taken.sequence))
    assert {type(message) for message in room.said} == {Ack, PointsNote}
    assert room.notes()[0].frames == len(taken.sequence)
    result = room.end()
    assert room.told() == [PointsNote, DecodedNote]
    stages = [message.stage for message in room.said if isinstance(message, Progress)]
    assert stages[:3] == ["decoding", "triangulating", "checking frames"]
    assert [entry.name for entry in result.files[:4]] == ["scan.npz", "cloud.ply", "preview.png", "report.json"]
    assert result.report["capture"]["state"] == "complete"
    made, expected = load_scan(room.output), room.by_hand()
    for name, array in expected.arrays().items():
        np.testing.assert_array_equal(getattr(made, name), array)
    content = (room.output / "scan.npz").read_bytes()
    for place in room.notes()[0].arrays:
        there = np.frombuffer(content[place.offset : place.offset + place.bytes], place.dtype).reshape(place.shape)
        np.testing.assert_array_equal(there, getattr(expected, place.name))


@pytest.mark.parametrize("swapped", [{8: 9, 9: 8}, {-1: 3}], ids=["fringes", "the last sentinel"])
def test_frames_that_are_taken_again_make_an_early_scan_void(
    swapped: dict[int, int], tmp_path: Path, taken: Taken
) -> None:
    room, count = Room(tmp_path, taken), len(taken.sequence)
    swapped = {position % count: shown for position, shown in swapped.items()}
    for position in range(count):
        room.write(position, swapped.get(position))
    assert {type(message) for message in room.said} == {Ack}
    for position in swapped:
        room.write(position)
    assert [note.frames for note in room.notes()] == [count + len(swapped)]
    room.end()
    assert room.told() == [PointsNote, DecodedNote]
    np.testing.assert_array_equal(load_scan(room.output).xyz, room.by_hand().xyz)


def test_points_of_frames_that_were_in_step_are_void_where_more_come(tmp_path: Path, taken: Taken) -> None:
    room, count = Room(tmp_path, taken), len(taken.sequence)
    for position in (*range(count), 8):
        room.write(position)
    assert [note.frames for note in room.notes()] == [count, count + 1]
    room.end()
    np.testing.assert_array_equal(load_scan(room.output).xyz, room.by_hand().xyz)


def test_what_made_an_early_scan_fail_is_told_with_the_end(tmp_path: Path, taken: Taken) -> None:
    room = Room(tmp_path, taken)
    swapped = {8: 9, 9: 8}
    for position in range(len(taken.sequence)):
        room.write(position, swapped.get(position))
    with pytest.raises(SyncError) as error:
        room.end()
    assert error.value.frames == (8, 9)
    assert room.told() == []
    room.work.close()
    assert not room.output.exists()


def test_an_early_scan_that_is_let_go_leaves_nothing(tmp_path: Path, taken: Taken) -> None:
    room = Room(tmp_path, taken)
    for position in range(len(taken.sequence)):
        room.write(position)
    assert room.output.exists()
    room.work.close()
    room.tail.close()
    room.writer.abandon()
    assert not room.output.exists()
