"""The capture folder: round trips, what a crash leaves, and what is refused."""

from __future__ import annotations

import errno
import json
import os
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner.capture import (
    Capture,
    CaptureHeader,
    CaptureWriter,
    FrameRecord,
    close_interrupted,
    digest,
)
from scanner.capture.exposure import exposure_report, exposure_warnings
from scanner.devices import Exposure, Flip, Source
from scanner.errors import DecodeError, StorageError
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize
from scanner.reconstruct import reconstruct

PROJECTOR = ProjectorSize(64, 48)
SEQUENCE = PatternSequence.bracketed(PROJECTOR, PmpPattern(frequencies=(1.0, 4.0), shifts=(3, 4)))


def header(bits: int = 8) -> CaptureHeader:
    return CaptureHeader(SEQUENCE, CameraFormat(20, 10, bits), id="test")


def frame(value: int, bits: int = 8) -> np.ndarray:
    camera = CameraFormat(20, 10, bits)
    return np.random.default_rng(value).integers(0, camera.max_value, camera.shape).astype(camera.dtype)


def write_frames(writer: CaptureWriter, patterns: range, bits: int = 8) -> None:
    for pattern in patterns:
        slot, xxh3 = writer.write(frame(pattern, bits))
        writer.record(FrameRecord(slot, pattern, xxh3=xxh3))


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_a_closed_capture_reads_back(tmp_path: Path, bits: int) -> None:
    writer = CaptureWriter(tmp_path / "c", header(bits), len(SEQUENCE))
    write_frames(writer, range(len(SEQUENCE)), bits)
    writer.close("complete", witnesses=[{"name": "sentinels"}], plan={"dwell": 2})
    capture = Capture.open(tmp_path / "c")
    assert capture.header.state == "complete"
    assert capture.header.sequence == SEQUENCE
    assert capture.header.plan == {"dwell": 2}
    assert capture.missing == ()
    for pattern in range(len(SEQUENCE)):
        np.testing.assert_array_equal(capture.frame(pattern), frame(pattern, bits))
    stored = np.load(tmp_path / "c" / "frames.npy", allow_pickle=False)
    assert stored.shape == (len(SEQUENCE), 10, 20)


def test_an_open_capture_announces_no_slots_and_holds_what_has_a_line(tmp_path: Path) -> None:
    writer = CaptureWriter(tmp_path / "c", header(), len(SEQUENCE))
    write_frames(writer, range(5))
    writer.write(frame(5))  # pixels without a line: the slot does not exist
    capture = Capture.open(tmp_path / "c")
    assert np.load(tmp_path / "c" / "frames.npy").shape[0] == 0
    assert capture.header.state == "open"
    assert sorted(capture.records) == [0, 1, 2, 3, 4]
    writer.abandon()
    assert close_interrupted(tmp_path / "c", "failed", "daemon_restarted").reason == "daemon_restarted"
    closed = Capture.open(tmp_path / "c")
    assert sorted(closed.records) == [0, 1, 2, 3, 4]
    assert np.load(tmp_path / "c" / "frames.npy").shape[0] == 5


@settings(max_examples=30, deadline=None)
@given(cut=st.integers(min_value=0, max_value=2500))
def test_a_torn_record_file_never_invents_a_frame(tmp_path_factory: pytest.TempPathFactory, cut: int) -> None:
    folder = tmp_path_factory.mktemp("torn") / "c"
    writer = CaptureWriter(folder, header(), len(SEQUENCE))
    write_frames(writer, range(8))
    writer.abandon()
    lines = folder / "frames.jsonl"
    content = lines.read_bytes()[:cut]
    lines.write_bytes(content)
    records = Capture.open(folder).records
    assert sorted(records) == list(range(content.count(b"\n")))


def test_the_last_whole_line_of_a_pattern_wins_and_a_wrong_digest_does_not_exist(tmp_path: Path) -> None:
    writer = CaptureWriter(tmp_path / "c", header(), len(SEQUENCE))
    write_frames(writer, range(3))
    slot, xxh3 = writer.write(frame(100))
    writer.record(FrameRecord(slot, 1, attempt=1, xxh3=xxh3))
    slot, _ = writer.write(frame(101))
    writer.record(FrameRecord(slot, 2, attempt=1, xxh3=digest(frame(102))))
    writer.record(FrameRecord(None, 0, attempt=1, status="missing"))
    writer.close("complete")
    capture = Capture.open(tmp_path / "c")
    assert sorted(capture.records) == [1]
    np.testing.assert_array_equal(capture.frame(1), frame(100))


@pytest.mark.parametrize(
    ("absent", "said"), [(False, r", slots 1, 2, are not .* were made of$"), (True, r"\(frame 1\)$")]
)
def test_what_is_lost_is_explained_for_all_frames_or_for_the_one_that_is_named(
    tmp_path: Path, absent: bool, said: str
) -> None:
    writer = CaptureWriter(tmp_path / "c", header(), len(SEQUENCE))
    for pattern in range(len(SEQUENCE) - absent):
        slot, xxh3 = writer.write(frame(pattern))
        writer.record(FrameRecord(slot, pattern, xxh3=digest(frame(99)) if pattern in (1, 2) else xxh3))
    writer.close("complete")
    lost = Capture.open(tmp_path / "c").lost
    assert lost is not None
    assert re.search(said, lost)


def test_a_record_round_trips_through_its_line() -> None:
    record = FrameRecord(
        3,
        2,
        attempt=1,
        xxh3="00",
        frame_id=17,
        trigger=18,
        exposure=Exposure(1, 2, 3, Source.HARDWARE),
        flip=Flip(4, 5, 6, Source.DRIVER),
        verdict="proved",
    )
    assert FrameRecord.from_dict(json.loads(json.dumps(record.as_dict()))) == record


def test_more_frames_than_reserved_find_room(tmp_path: Path) -> None:
    writer = CaptureWriter(tmp_path / "c", header(), 1)
    write_frames(writer, range(len(SEQUENCE)))
    writer.close("complete")
    assert Capture.open(tmp_path / "c").missing == ()


def test_a_full_disk_is_found_before_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(StorageError) as error:
        CaptureWriter(tmp_path / "c", header(), 5)
    assert "free some space" in str(error.value.hint)
    assert not (tmp_path / "c" / "capture.json").exists()
    assert not list((tmp_path / "c").iterdir())


def test_a_line_that_the_disk_takes_in_two_pieces_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = CaptureWriter(tmp_path / "c", header(), 5)
    write = os.write
    monkeypatch.setattr(os, "write", lambda file, data: write(file, data[: max(1, len(data) // 2)]))
    writer.record(FrameRecord(None, 3, status="missing"))
    writer.record(FrameRecord(None, 4, status="missing"))
    writer.abandon()
    lines = (tmp_path / "c" / "frames.jsonl").read_text().splitlines()
    assert [json.loads(line)["pattern"] for line in lines] == [3, 4]


def test_a_folder_with_a_capture_is_refused(tmp_path: Path) -> None:
    CaptureWriter(tmp_path / "c", header(), 1).abandon()
    with pytest.raises(StorageError, match="holds a capture already"):
        CaptureWriter(tmp_path / "c", header(), 1)


def image_capture(folder: Path, names: list[str], **changes: object) -> Path:
    pattern = {"method": "pmp", "axes": ["y"], "frequencies": [1], "shifts": [3]}
    content = {
        "format": "fringed-capture",
        "version": 1,
        "projector": {"width": 64, "height": 48},
        "camera": {"width": 20, "height": 10, "bits": 8},
        "pattern": pattern,
        "frames": names,
        **changes,
    }
    folder.mkdir(exist_ok=True)
    (folder / "capture.json").write_text(json.dumps(content))
    return folder


def write_images(folder: Path, images: list[np.ndarray]) -> list[str]:
    folder.mkdir(exist_ok=True)
    names = [f"{i}.png" for i in range(len(images))]
    for name, image in zip(names, images, strict=True):
        assert cv2.imwrite(str(folder / name), image)
    return names


def test_an_image_that_may_not_be_read_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = write_images(tmp_path / "c", [frame(0)] * 3)
    capture = Capture.open(image_capture(tmp_path / "c", names))

    def refuse(*_: object) -> bytes:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("scanner.capture.reader.read_small", refuse)
    with pytest.raises(DecodeError, match=r"1\.png cannot be read: Permission denied"):
        capture.frame(1)


def in_colour(pixels: np.ndarray) -> np.ndarray:
    return np.repeat(pixels[..., None], 3, axis=2)


def test_image_files_are_read_colour_as_luma(tmp_path: Path) -> None:
    frames = [frame(1), frame(2), frame(3)]
    grey = Capture.open(image_capture(tmp_path / "g", write_images(tmp_path / "g", frames)))
    colour = Capture.open(image_capture(tmp_path / "c", write_images(tmp_path / "c", [in_colour(f) for f in frames])))
    for index, pixels in enumerate(frames):
        np.testing.assert_array_equal(grey.frame(index), pixels)
        np.testing.assert_array_equal(colour.frame(index), pixels)
    assert grey.warnings == ()
    assert len(colour.warnings) == 1
    full = [in_colour(f) for f in frames]
    full[1][..., 1] = 255
    green = Capture.open(image_capture(tmp_path / "green", write_images(tmp_path / "green", full)))
    assert [green.frame(index) for index in range(len(full))]
    assert "100% of the pixels have a saturated channel" in green.warnings[1]


@pytest.mark.parametrize("odd", [0, 1])
def test_colour_among_grey_is_refused_by_name(odd: int, tmp_path: Path) -> None:
    frames = [in_colour(frame(n)) if n == odd else frame(n) for n in range(3)]
    capture = Capture.open(image_capture(tmp_path / "c", write_images(tmp_path / "c", frames)))
    with pytest.raises(DecodeError, match=rf"frame {odd}\.png is in colour, frame {1 - odd}\.png is grey") as caught:
        [capture.frame(n) for n in range(3)]
    assert "alike" in str(caught.value.hint)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda f: (f / "1.png").unlink(), "is missing"),
        (lambda f: (f / "1.png").write_bytes(b"no image"), "cannot be read"),
        (lambda f: cv2.imwrite(str(f / "1.png"), np.zeros((9, 20), np.uint8)), "20 x 9"),
        (lambda f: cv2.imwrite(str(f / "1.png"), np.zeros((10, 20), np.uint16)), "uint16"),
    ],
)
def test_a_bad_image_is_named(tmp_path: Path, spoil: object, says: str) -> None:
    names = write_images(tmp_path / "c", [frame(0), frame(1), frame(2)])
    folder = image_capture(tmp_path / "c", names)
    spoil(folder)  # type: ignore[operator]
    capture = Capture.open(folder)
    with pytest.raises(DecodeError, match=says) as error:
        capture.frame(1)
    assert "1.png" in str(error.value)


def test_a_calibration_elsewhere_is_refused_with_what_to_do(tmp_path: Path) -> None:
    names = write_images(tmp_path / "c", [frame(0), frame(1), frame(2)])
    capture = Capture.open(image_capture(tmp_path / "c", names, calibration="../rig.json"))
    with pytest.raises(DecodeError, match="leads out of") as error:
        _ = capture.calibration_path
    assert "--calibration" in (error.value.hint or "")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"format": "other"}, "not a fringed-capture"),
        ({"version": 2}, "version 2"),
        ({"frames": ["0.png"]}, "1 frames listed, the pattern has 3"),
        ({"frames": ["../0.png", "1.png", "2.png"]}, "leads out of"),
        ({"camera": {"width": 0, "height": 10}}, "camera needs width"),
        ({"camera": {"width": 1 << 20, "height": 1 << 20}}, "larger than any"),
        ({"camera": {"width": 20, "height": 10, "bits": 40}}, "bits"),
        ({"projector": None}, "projector is missing"),
        ({"pattern": {"method": "laser"}}, "unknown pattern method"),
        ({"pattern": {"method": "pmp", "axes": ["y"], "frequencies": [1, 2], "shifts": [3]}}, "shifts"),
        ({"state": "maybe"}, "state"),
        ({"repeat": 0}, "repeat"),
        ({"repeat": 10**12}, "repeat"),
        ({"version": True}, "version True"),
        ({"calibration": 5}, "calibration must be"),
        ({"witnesses": 5}, "witnesses must be"),
        ({"plan": 5}, "plan must be"),
        ({"plan": {"why": 5}}, "plan must be"),
        ({"frames": ["0.png", "1" * 5000, "2.png"]}, "is no file name"),
        ({"frames": ["0.png", "\0", "2.png"]}, "is no file name"),
        ({"camera": {"width": 20, "height": 10, "bits": 8, "mosaic": "purple"}}, "mosaic"),
        ({"camera": {"width": 20, "height": 10, "bits": 7}}, "frame of 7 bits"),
    ],
)
def test_a_bad_header_is_refused_with_its_file(tmp_path: Path, changes: dict[str, object], says: str) -> None:
    names = write_images(tmp_path / "c", [frame(0), frame(1), frame(2)])
    folder = image_capture(tmp_path / "c", names, **changes)
    with pytest.raises(DecodeError, match=says) as error:
        _ = [Capture.open(folder).frame(pattern) for pattern in range(3)]
    assert str(folder) in str(error.value)


def test_a_jpeg_that_breaks_off_is_not_taken_for_a_frame(tmp_path: Path) -> None:
    whole = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (10, 20), np.uint8))[1].tobytes()
    for content, fine in ((whole, True), (whole[: len(whole) // 2], False)):
        names = write_images(tmp_path / "c", [frame(0), frame(1), frame(2)])
        (tmp_path / "c" / "1.png").write_bytes(content)
        capture = Capture.open(image_capture(tmp_path / "c", names))
        if fine:
            assert capture.frame(1).shape == (10, 20)
        else:
            with pytest.raises(DecodeError, match="cannot be read"):
                capture.frame(1)


@pytest.mark.parametrize(
    "line",
    ["[]", "5", "null", "[" * 200_000, '{"slot": Infinity, "pattern": 1}', '{"slot": 1, "pattern": 1, "xxh3": 5}'],
)
def test_a_line_that_is_no_record_says_nothing(tmp_path: Path, line: str) -> None:
    writer = CaptureWriter(tmp_path / "c", header(), len(SEQUENCE))
    write_frames(writer, range(3))
    writer.close("complete")
    with (tmp_path / "c" / "frames.jsonl").open("a") as file:
        file.write(line + "\n")
    assert sorted(Capture.open(tmp_path / "c").records) == [0, 1, 2]


@pytest.mark.parametrize("shape", ["(-3, 10, 20)", "(True, 10, 20)", "((((", "(3, 10, 20" + "(" * 50])
def test_a_damaged_array_header_is_refused(tmp_path: Path, shape: str) -> None:
    folder = image_capture(tmp_path / "c", [])
    content = json.loads((folder / "capture.json").read_text())
    del content["frames"]
    (folder / "capture.json").write_text(json.dumps(content))
    body = f"{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
    (folder / "frames.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(body).to_bytes(2, "little") + body + bytes(600))
    with pytest.raises(DecodeError, match=r"frames\.npy"):
        Capture.open(folder)


def test_truncated_frames_are_refused(tmp_path: Path) -> None:
    writer = CaptureWriter(tmp_path / "c", header(), len(SEQUENCE))
    write_frames(writer, range(len(SEQUENCE)))
    writer.close("complete")
    path = tmp_path / "c" / "frames.npy"
    os.truncate(path, path.stat().st_size - 100)
    with pytest.raises(DecodeError, match="truncated"):
        Capture.open(tmp_path / "c")


@pytest.mark.parametrize(
    ("array", "says"),
    [
        (np.zeros((3, 10, 20), np.float32), "expected uint8 or uint16"),
        (np.zeros((3, 10), np.uint8), "expected uint8 or uint16"),
        (np.zeros((3, 10, 21), np.uint8), "21 x 10"),
        (np.zeros((2, 10, 20), np.uint8), "2 frames, the pattern has 3"),
        (np.zeros((3, 10, 20), np.uint16), "uint16"),
        (np.array([{"a": 1}], dtype=object), "expected uint8 or uint16"),
    ],
)
def test_a_foreign_frames_file_is_checked_before_it_is_read(tmp_path: Path, array: np.ndarray, says: str) -> None:
    folder = image_capture(tmp_path / "c", [])
    content = json.loads((folder / "capture.json").read_text())
    del content["frames"]
    (folder / "capture.json").write_text(json.dumps(content))
    np.save(folder / "frames.npy", array, allow_pickle=True)
    with pytest.raises(DecodeError, match=says):
        Capture.open(folder)


def test_no_folder_and_no_json_are_named(tmp_path: Path) -> None:
    with pytest.raises(DecodeError, match="cannot read"):
        Capture.open(tmp_path)
    (tmp_path / "capture.json").write_text("{")
    with pytest.raises(DecodeError, match="not JSON"):
        Capture.open(tmp_path)


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        (b"", "frames.jsonl holds no whole line that is a frame's record"),
        (b"{not a record}\n", "frames.jsonl holds no whole line that is a frame's record"),
        (
            b'{"slot": 0, "pattern": 0, "xxh3": "0011223344556677"}\n',
            "the pixels of .*frames.npy, slot 0, are not those",
        ),
        (b'{"slot": 900, "pattern": 0}\n', "frames.jsonl names slot 900, and frames.npy has"),
        (b'{"slot": 0, "pattern": 900}\n', "frames.jsonl tells of pattern 900, and the capture has"),
        (b'{"slot": null, "pattern": 3, "status": "missing"}\n', "says that the frame of pattern 3 is missing"),
    ],
)
def test_a_capture_none_of_whose_frames_can_be_taken_says_which_file_is_to_blame(
    lines: bytes, says: str, tmp_path: Path
) -> None:
    writer = CaptureWriter(tmp_path / "c", header(), len(SEQUENCE))
    write_frames(writer, range(len(SEQUENCE)))
    writer.close("complete")
    assert len(Capture.open(tmp_path / "c").require_any()) == len(SEQUENCE)
    (tmp_path / "c" / "frames.jsonl").write_bytes(lines)
    with pytest.raises(DecodeError, match=says):
        Capture.open(tmp_path / "c").require_any()
    with pytest.raises(DecodeError, match=says):
        reconstruct(Capture.open(tmp_path / "c"), None)


def test_the_exposure_that_was_used_is_told_and_warned_of_where_it_is_another() -> None:
    plan = {"exposure_ns": 4_167_000, "why": {"exposure_ns": "one modulation period"}}
    given = replace(header(), plan=plan, extra={"exposure": {"mode": "given", "asked_us": 1.0}})
    assert exposure_report(given) == {"mode": "given", "asked_us": 1.0, "used_us": 4167.0}
    (warning,) = exposure_warnings(given)
    assert warning == "exposed for 4167 us and not 1 us as asked: one modulation period"
    assert exposure_warnings(replace(given, extra={"exposure": {"mode": "given", "asked_us": 4150.0}})) == ()
    shots = replace(given, extra={"exposure": {"mode": "auto", "warning": "full white saturates"}})
    assert exposure_warnings(shots) == ("full white saturates",)
    # Made elsewhere, or by somebody who lies.
    assert exposure_report(header()) is None
    for told in (None, 3, {"warning": 5, "asked_us": "long"}):
        assert exposure_warnings(replace(given, extra={"exposure": told})) == ()


@pytest.mark.parametrize("member", ["frame_id", "trigger", "exposure", "flip"])
@pytest.mark.parametrize("value", [[], {}, "x"])
def test_a_record_with_a_member_of_another_kind_is_none(member: str, value: object) -> None:
    with pytest.raises((KeyError, TypeError, ValueError)):
        FrameRecord.from_dict({"slot": 0, "pattern": 0, member: value})
