"""From capture folders to a calibration file: what is looked at, what is left out and why, and the command line."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.simulated.rigs import rig
from drivers.simulated.targets import target_points, target_poses
from scanner.calibration.observe import (
    LeftOut,
    Observation,
    find_captures,
    observe,
    observe_capture,
    observe_decoded,
    warnings_of,
)
from scanner.calibration.targets import parse_target
from scanner.capture import Capture, CaptureHeader
from scanner.capture.header import FrameRecord, digest
from scanner.decode import decoder_for
from scanner.errors import ConfigError
from scanner.geometry import load_calibration
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize
from scanner.patterns.sequence import Precorrection
from service.cli import main
from tests.unit.simulated_bench import Bench

SPEC = "chessboard:9x6:19"
TARGET = parse_target(SPEC)
PATTERN = PmpPattern(axes=("x", "y"), frequencies=(1.0, 8.0), shifts=(4, 4))


def write_capture(
    folder: Path, device: str, pattern: PmpPattern = PATTERN, frames: list[np.ndarray] | None = None
) -> Path:
    """One capture of a simulated scene, without stamps."""
    bench = Bench(device)
    c = bench.projector.capabilities
    sequence = PatternSequence(ProjectorSize(c.width, c.height), pattern, precorrection=Precorrection(gamma=2.3))
    taken = bench.captured([sequence.image(k) for k in range(len(sequence))]) if frames is None else frames
    shown = np.stack(taken).astype(np.uint8)
    folder.mkdir(parents=True)
    np.save(folder / "frames.npy", shown)
    header = CaptureHeader(sequence, CameraFormat(shown.shape[2], shown.shape[1], 8), created="2026-11-22T10:00:00Z")
    (folder / "capture.json").write_text(json.dumps(header.as_dict()))
    bench.camera.close()
    bench.projector.close()
    return folder


@pytest.fixture(scope="module")
def poses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six good captures, one that is out of step, one of a bare board, one of a single axis."""
    folder = tmp_path_factory.mktemp("poses")
    for k in range(0, 12, 2):
        write_capture(folder / f"p{k:02d}" / "capture", f"quick/chessboard_poses?pose={k}&seed=2")
    late = np.load(folder / "p00" / "capture" / "frames.npy")
    late[[1, 2]] = late[[2, 1]]
    write_capture(folder / "late", "quick/board", frames=list(late))
    write_capture(folder / "bare", "quick/board")
    write_capture(folder / "rows", "quick/board", PmpPattern(axes=("y",), frequencies=(1.0, 8.0), shifts=(4, 4)))
    return folder


def test_points_of_a_simulated_pose(poses: Path) -> None:
    found = observe_capture(poses / "p04" / "capture", "p04", TARGET)
    assert isinstance(found, Observation)
    chosen = rig("quick")
    pose = target_poses("chessboard_poses", chosen, 2)[4]
    # The board looks the same upside down, and is read from its other corner here.
    points = target_points("chessboard_poses", chosen)[::-1] @ pose.rotation.T + pose.translation
    calibration = chosen.calibration
    camera = calibration.camera.project(points)[found.view.ids]
    projector = calibration.projector.project(calibration.to_projector(points))[found.view.ids]
    assert len(found.view.ids) == 54
    # Squares of 17 px: the corners are good to a thirtieth, the projector's pixel of the same point to a tenth.
    assert np.sqrt(((found.view.camera - camera) ** 2).mean()) < 0.04
    assert np.sqrt(((found.view.projector - projector) ** 2).mean()) < 0.1
    assert found.response == {"gamma": 2.3}


def test_a_white_frame_is_where_the_target_is_looked_for_first(poses: Path, tmp_path: Path) -> None:
    """One that is elsewhere moves the points; one that shows no target, or is missing, leaves them to the albedo."""
    frames = np.load(poses / "p04" / "capture" / "frames.npy")
    header = json.loads((poses / "p04" / "capture" / "capture.json").read_text())
    header["pattern"]["white"] = len(frames)
    bright = frames.max(axis=0)
    lines = [json.dumps({"slot": k, "pattern": k, "attempt": 0, "status": "ok"}) for k in range(len(frames))]
    found = {}
    for name, white in (("moved", np.roll(bright, 3, axis=1)), ("black", 0 * bright), ("missing", bright)):
        folder = tmp_path / name
        folder.mkdir()
        np.save(folder / "frames.npy", np.concatenate((frames, white[None])))
        (folder / "capture.json").write_text(json.dumps(header))
        if name == "missing":
            (folder / "frames.jsonl").write_text("\n".join(lines) + "\n")
        outcome = observe_capture(folder, name, TARGET)
        assert isinstance(outcome, Observation), outcome
        found[name] = outcome.view.camera
    plain = observe_capture(poses / "p04" / "capture", "p04", TARGET)
    assert isinstance(plain, Observation)
    assert found["moved"] == pytest.approx(plain.view.camera + np.array([3.0, 0.0]), abs=0.1)
    assert found["black"] == pytest.approx(plain.view.camera)
    assert found["missing"] == pytest.approx(plain.view.camera)


def test_a_part_that_is_overexposed_is_named(poses: Path, tmp_path: Path) -> None:
    capture = Capture.open(poses / "p04" / "capture")
    frames = [capture.frame(k).astype(float) for k in range(len(capture.header.sequence))]
    plain = observe_capture(poses / "p04" / "capture", "p04", TARGET)
    assert isinstance(plain, Observation)
    assert plain.warnings == ()
    right = np.arange(frames[0].shape[1]) > np.quantile(plain.view.camera[:, 0], 0.7)
    glare = [np.clip(frame * np.where(right, 1.6, 1.0), 0, 255) for frame in frames]
    outcome = observe_capture(write_capture(tmp_path / "glare", "quick/board", frames=glare), "glare", TARGET)
    assert isinstance(outcome, Observation)
    assert len(outcome.view.ids) < len(plain.view.ids)
    assert any("a part of the target is overexposed, and has no points" in said for said in outcome.warnings)


def test_points_on_a_line_or_hardly_any_do_not_serve(poses: Path) -> None:
    """Of a board of which fringes reach one row, or a few points."""
    capture = Capture.open(poses / "p04" / "capture")
    decoder = decoder_for(capture.header.sequence, capture.header.camera)
    for k in range(len(capture.header.sequence)):
        decoder.add(k, capture.frame(k))
    decoded = decoder.finish()
    whole = observe_decoded("whole", decoded, TARGET)
    assert not isinstance(whole, LeftOut)
    across = whole.camera[:9].mean(axis=0), whole.camera[9:18].mean(axis=0)
    y, x = np.indices(decoded.albedo.shape)
    step = across[1] - across[0]
    row = np.abs((x - across[0][0]) * step[0] + (y - across[0][1]) * step[1]) < 0.5 * step @ step
    here = np.hypot(*(np.stack((x, y)) - whole.camera[20][:, None, None])) < 12
    for lit, words in ((row, "lie on a line"), (here, "points only")):
        dark = replace(decoded, **{name: np.where(lit, getattr(decoded, name), np.nan) for name in ("rows", "columns")})
        outcome = observe_decoded("part", dark, TARGET)
        assert isinstance(outcome, LeftOut)
        assert words in outcome.reason


def test_what_cannot_serve_says_why(poses: Path) -> None:
    paths = find_captures([poses])
    assert len(paths) == 9
    observations, left_out = observe(paths, TARGET)
    assert [one.view.name for one in observations] == [f"p{k:02d}" for k in range(0, 12, 2)]
    reasons = {one.name: one for one in left_out}
    assert "no chessboard" in reasons["bare"].reason
    assert "--axis xy" in reasons["rows"].reason
    assert reasons["late"].out_of_step
    assert "out of step" in reasons["late"].reason


def test_poses_are_counted_as_people_count(tmp_path: Path) -> None:
    for name in ("10", "2", "1", "b1"):
        (tmp_path / "poses" / name).mkdir(parents=True)
        (tmp_path / "poses" / name / "capture.json").write_text("{}")
    assert [path.name for path in find_captures([tmp_path])] == ["1", "2", "10", "b1"]
    one = tmp_path / "poses" / "10"
    assert [path.name for path in find_captures([one, tmp_path, one])] == ["1", "2", "10", "b1"]


def test_what_should_be_a_capture_and_is_none_is_named(poses: Path, tmp_path: Path) -> None:
    """Frames without a header, and a folder with nothing in it; a folder of other things is no pose."""
    shutil.copytree(poses / "p04" / "capture", tmp_path / "1" / "capture")
    (tmp_path / "1" / "capture" / "capture.json").unlink()
    (tmp_path / "2").mkdir()
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "read me").write_text("")
    shutil.copytree(poses / "p06" / "capture", tmp_path / "3" / "capture")
    observations, left_out = observe(find_captures([tmp_path]), TARGET)
    assert [one.view.name for one in observations] == ["3"]
    assert [one.name for one in left_out] == ["1", "2"]
    assert all(one.reason.startswith("no capture.json in it") and one.unreadable for one in left_out)


@pytest.mark.parametrize(("gain", "words"), [(40.0, "it is overexposed"), (0.005, "light the whole target")])
def test_a_target_whose_pixels_have_no_value_says_what_to_do(poses: Path, gain: float, words: str) -> None:
    capture = Capture.open(poses / "p04" / "capture")
    white = capture.frame(0)
    decoder = decoder_for(capture.header.sequence, capture.header.camera)
    for k in range(len(capture.header.sequence)):
        decoder.add(k, np.clip(np.rint(gain * capture.frame(k).astype(float)), 0, 255).astype(np.uint8))
    outcome = observe_decoded("p", decoder.finish(), TARGET, white=white)
    assert isinstance(outcome, LeftOut)
    assert words in outcome.reason


def test_damaged_captures_are_left_out(poses: Path, tmp_path: Path) -> None:
    (tmp_path / "capture.json").write_text("{")
    found = observe_capture(tmp_path, "broken", TARGET)
    assert isinstance(found, LeftOut)
    assert "not JSON" in found.reason
    with pytest.raises(ConfigError, match="no such capture"):
        find_captures([tmp_path / "missing"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="holds no capture"):
        find_captures([tmp_path / "empty"])
    assert find_captures([poses / "p00", poses / "p00" / "capture"]) == [poses / "p00" / "capture"]


def test_frames_that_do_not_match_their_digests_are_named(poses: Path, tmp_path: Path) -> None:
    """All of them, or so many that no fringe set is left: the pixels are to blame, and the file is named."""
    good = poses / "p04" / "capture"
    frames = np.load(good / "frames.npy")
    for name, damaged in (("whole", len(frames)), ("part", 6)):
        folder = tmp_path / name
        shutil.copytree(good, folder)
        digests = [digest(frame) if k >= damaged else "0" * 16 for k, frame in enumerate(frames)]
        lines = [json.dumps(FrameRecord(k, k, xxh3=told).as_dict()) + "\n" for k, told in enumerate(digests)]
        (folder / "frames.jsonl").write_text("".join(lines))
        found = observe_capture(folder, name, TARGET)
        assert isinstance(found, LeftOut)
        slot = 0 if name == "part" else len(frames) - 1
        assert f"frames.npy, slot {slot}, are not those that the digest in frames.jsonl was made of" in found.reason
        assert found.unreadable
        assert str(tmp_path) not in found.reason, "captures that lack the same have the same reason"


def test_a_pose_that_serves_without_a_frame_says_so(poses: Path, tmp_path: Path) -> None:
    """Of a set of four one is lost: the pose serves, and what is lost, and of which file, is among the warnings."""
    for name in ("one", "two"):
        folder = tmp_path / name
        shutil.copytree(poses / "p04" / "capture", folder)
        frames = np.load(folder / "frames.npy")
        lines = [FrameRecord(k, k, xxh3="0" * 16 if k == 5 else digest(frame)) for k, frame in enumerate(frames)]
        (folder / "frames.jsonl").write_text("".join(json.dumps(line.as_dict()) + "\n" for line in lines))
    found = [observe_capture(tmp_path / name, name, TARGET) for name in ("one", "two")]
    observations = [one for one in found if isinstance(one, Observation)]
    assert len(observations) == 2
    said = warnings_of(observations)
    assert len(said) == 3, "what is the same is said once, of both"
    assert f"frame 5 of {len(frames)} lost: the pixels of {tmp_path / 'one' / 'frames.npy'}, slot 5," in said[0]
    assert said[0].endswith(str(Capture.open(tmp_path / "one").lost))
    assert said[1].startswith("captures one, two (used): frequency 8 along x decoded from 3 of 4 frames; missing: 5")
    assert warnings_of([replace(observations[0], warnings=())]) == []


def test_copies_and_failed_captures_are_no_poses(poses: Path, tmp_path: Path) -> None:
    """A copy is known by its id and time, of a capture without them by its pixels; one id for all is no copy."""
    identities = {
        "a1": ("one", "today"),
        "a2": ("one", "today"),
        "b1": ("", ""),
        "b2": ("", ""),
        "c1": ("same", ""),
        "d1": ("f", "today"),
    }
    for name, (identity, created) in identities.items():
        shutil.copytree(poses / ("p04" if name != "c1" else "p06") / "capture", tmp_path / name)
        file = tmp_path / name / "capture.json"
        told = {"id": identity, "created": created, "state": "failed" if name == "d1" else "complete"}
        file.write_text(json.dumps({**json.loads(file.read_text()), **told, "reason": "camera lost"}))
    (tmp_path / "a3").symlink_to(tmp_path / "a1")
    observations, left_out = observe(find_captures([tmp_path]), TARGET)
    assert [one.view.name for one in observations] == ["a1", "b1", "c1"]
    reasons = {one.name: one.reason for one in left_out}
    assert set(reasons) == {"a2", "a3", "b2", "d1"}
    assert reasons["a2"].startswith("it is a copy of a1")
    assert reasons["a3"].startswith("it is given twice")
    assert reasons["b2"].startswith("it is a copy of b1")
    assert "its capture failed (camera lost)" in reasons["d1"]


def test_command_writes_a_calibration(poses: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "rig.json"
    words = ["calibrate", "solve", str(poses), "--target", SPEC, "--length", "152:0.01", "-o", str(file), "--json"]
    assert main([*words, "--warm-up", "30"]) == 0
    document = json.loads(capsys.readouterr().out)
    calibration = load_calibration(file)
    true = rig("quick").calibration
    assert calibration.id == document["calibration"]["id"] != ""
    assert calibration.warnings == ()
    copied = tmp_path / "copied.json"
    copied.write_text(json.dumps(calibration.as_dict()))
    assert load_calibration(copied).warnings == ()
    copied.write_text(json.dumps({**calibration.as_dict(), "translation": [1.0, 240.0, 40.0]}))
    assert any("copied.json: its id" in said and "edited by hand" in said for said in load_calibration(copied).warnings)
    copied.write_text(json.dumps({**calibration.as_dict(), "translation": [1.0, 240.0, 40.0], "id": "mine"}))
    assert not any("its id" in said for said in load_calibration(copied).warnings)
    assert np.linalg.norm(calibration.translation - true.translation) < 2.0
    assert calibration.phase_axis == "y"
    assert {one["name"] for one in document["left_out"]} == {"late", "bare", "rows"}
    assert len(document["views"]) == 6
    assert all(view["held_out_px"] < 1.0 for view in document["views"])
    content = json.loads(file.read_text())
    assert content["warm_up"] == {
        "minutes": 30.0,
        "first_capture": "2026-11-22T10:00:00Z",
        "last_capture": "2026-11-22T10:00:00Z",
    }
    assert content["response"]["projector"] == {"gamma": 2.3}
    assert content["scale"] == {"reference_mm": 152.0, "sigma_mm": 0.01}
    assert file.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert main(words) == 2
    assert "exists" in capsys.readouterr().err


def test_command_leaves_no_file_of_a_failed_solve(
    poses: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "rig.json"
    pair = [str(poses / "p00"), str(poses / "p02")]
    assert main(["calibrate", "solve", *pair, "--target", SPEC, "-o", str(file)]) == 1
    assert "2 of 2 captures can be used, 3 are needed" in capsys.readouterr().err
    wrong = ["--target", "chessboard:9x6:30", "--baseline", "150"]
    four = [str(poses / f"p{k:02d}") for k in (0, 2, 4, 6)]
    assert main(["calibrate", "solve", *four, *wrong, "-o", str(file)]) == 1
    assert "squares (spacing) of about 19 mm instead of 30 mm would fit" in capsys.readouterr().err
    assert main(["calibrate", "solve", str(poses), "--target", "chess:1", "-o", str(file)]) == 1
    assert main(["calibrate", "solve", str(poses), "--target", SPEC, "--length", "x", "-o", str(file)]) == 2
    assert list(tmp_path.iterdir()) == []


def test_command_shows_views_and_warnings(poses: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    some = [str(poses / name) for name in ("p00", "p02", "p04", "late")]
    words = ["calibrate", "solve", *some, "--target", SPEC, "-o", str(tmp_path / "rig.json"), "--no-picture"]
    assert main(words) == 0
    shown = capsys.readouterr()
    (line,) = (line for line in shown.out.splitlines() if line.startswith("translation"))
    assert re.search(
        r"^translation +(-?\d+(\.\d)?(, )?){3} mm if the target has .* unverified, uncertainty unknown$", line
    )
    assert " mm; its size is that of prints, not measured\n" in shown.out
    assert "expanded uncertainty, k = 2" in " ".join(shown.out.split())
    assert "warning: scale unverified: no length was stated" in " ".join(shown.err.split())
    assert "p04" in shown.out
    assert "left out late" in shown.err
    assert not (tmp_path / "rig.png").exists()


def test_command_draws_a_target(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "board.svg"
    assert main(["calibrate", "target", "chessboard:9x6:30", "-o", str(file), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["paper_mm"] == [330.0, 262.0]
    assert document["length_mm"] == 240.0
    assert file.read_text().startswith("<?xml")
    assert (document["contrast"], document["warnings"]) == (1.0, [])
    words = ["calibrate", "target", "--grey", "0.6", "-o", str(file), "--force"]
    assert main([*words, "charuco:10x7:30"]) == 0
    shown = capsys.readouterr()
    assert "40% of black on white: points in the camera are 2.5 times as unsure" in " ".join(shown.out.split())
    assert "leave 40% of the contrast" in shown.err
    assert "the markers are grey, too" in shown.err
    assert main([*words[:3], "0.35", *words[4:], "chessboard:9x6:30"]) == 0
    assert "warning" not in capsys.readouterr().err
    assert main(["calibrate", "target", "chessboard:9x6:30", "-o", str(tmp_path / "board.pdf")]) == 2
    assert main(["calibrate", "target", "chessboard:9x6:30", "-o", str(file)]) == 2


def test_a_charuco_board_that_is_described_as_a_chessboard_is_warned_of_once(tmp_path: Path) -> None:
    for k in (0, 4):
        write_capture(tmp_path / str(k) / "capture", f"quick/charuco_poses?pose={k}&seed=2")
    captures = [tmp_path / str(k) / "capture" for k in (0, 4)]
    for described, warned in (("chessboard:9x6:19", 1), ("charuco:10x7:19", 0)):
        found, _ = observe(captures, parse_target(described))
        assert found
        said = [one for one in warnings_of(found) if "this is a ChArUco board" in one]
        assert len(said) == warned
    _, left_out = observe(captures, parse_target("circles:9x6:19"))
    assert all(one.reason.endswith("is it a ChArUco board (charuco:)?") for one in left_out)
