"""`fringed patterns`, `decode` and `audit`: what they write, and what bad input gets."""

import json
import re
import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scanner.capture.header import FrameRecord, digest
from scanner.patterns import PatternSequence, ProjectorSize
from scanner.scan import load_scan
from service import cli

Run = Callable[..., tuple[int, str, str]]

CAMERA = {"width": 160, "height": 128, "bits": 8}


def capture_of(folder: Path, **changes: Any) -> Path:
    """A capture made elsewhere from written patterns: the camera sees the projector pixel by pixel, and dark around."""
    content = json.loads((folder / "pattern.json").read_text())
    capture = {
        "format": "fringed-capture",
        "version": 1,
        "projector": content["projector"],
        "camera": CAMERA,
        "pattern": content["pattern"],
        "frames": [f"seen-{name}" for name in content["images"]],
        **changes,
    }
    for name in content["images"]:
        image = cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)
        seen = np.zeros((CAMERA["height"], CAMERA["width"]), np.uint8)
        seen[: image.shape[0], : image.shape[1]] = image
        if not changes:
            cv2.imwrite(str(folder / f"seen-{name}"), seen)
    (folder / "capture.json").write_text(json.dumps(capture))
    return folder


# --- patterns -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words",
    [
        ["pmp", "--frequencies", "1,4,16.5", "--shifts", "3", "--axis", "xy"],
        ["mcp", "--size", "1152x864"],
        ["mcp", "--size", "640x480", "--carriers", "40,70,100", "--axis", "x", "--levels", "composite"],
        [
            "mcp",
            "--white",
            "--levels",
            "composite",
            "--first",
            "unmodulated",
            "--unmodulated",
            "0.5",
            "--size",
            "800x600",
        ],
        ["gray", "--bits", "5"],
        ["gray", "--no-inverse", "--code", "binary", "--axis", "x"],
        ["gray+pmp", "--inverse", "--bracketed"],
        ["pmp", "--bracketed", "--gamma", "2.2"],
        ["pmp", "--frequencies", "1,20", "--shifts", "4"],
    ],
)
def test_patterns_are_what_their_description_says(words: list[str], run: Run, tmp_path: Path) -> None:
    size = [] if "--size" in words else ["--size", "96x64"]
    status, out, _ = run("patterns", *words, *size, "-o", "images", "--json")
    assert status == 0
    content = json.loads((tmp_path / "images" / "pattern.json").read_text())
    assert {key: json.loads(out)[key] for key in content} == content
    assert len(json.loads(out)["warnings"]) == ("1,20" in words), "a step that the decoder will warn of is warned of"
    assert (content["format"], content["version"]) == ("fringed-pattern", 1)
    projector = ProjectorSize(**content["projector"])
    sequence = PatternSequence.from_description(projector, content["pattern"])
    assert len(content["images"]) == len(sequence)
    for position, name in enumerate(content["images"]):
        image = cv2.imread(str(tmp_path / "images" / name), cv2.IMREAD_UNCHANGED)
        assert image.dtype == np.uint8
        np.testing.assert_array_equal(image, sequence.image(position))
    assert bool(content["pattern"]["sentinels"]) == ("--bracketed" in words)
    for option, value in pairwise(words):
        if option in ("--code", "--first", "--levels"):
            assert content["pattern"][option.removeprefix("--")] == value
    if "--unmodulated" in words:
        assert content["pattern"]["unmodulated"] == 0.5
    if words[0] == "gray":
        needed = "--no-inverse" in words
        assert content["pattern"]["inverse"] is not needed
        assert (content["pattern"]["white"] is not None) is needed


def test_mcp_carriers_alone_keep_the_default_order_of_code_words(run: Run, tmp_path: Path) -> None:
    def made(folder: str, *words: str) -> tuple[list[int], str]:
        status, _, err = run("patterns", "mcp", "--size", "640x480", "-o", folder, *words)
        assert status == 0
        return json.loads((tmp_path / folder / "pattern.json").read_text())["pattern"]["codes"], err

    default, _ = made("default")
    assert default != sorted(default)
    four = ("--carriers", "40,70,100,130")
    codes, err = made("four", *four)
    assert codes == default
    assert "note:" not in err
    codes, err = made("three", "--carriers", "40,70,100")
    assert codes == list(range(8))
    assert "note: code words of 3 bits stand in natural order" in err
    assert "--codes" in err
    given = ",".join(map(str, range(15, -1, -1)))
    assert made("given", *four, "--codes", given)[0] == list(range(15, -1, -1))
    assert made("alone", "--codes", given)[0] == list(range(15, -1, -1))


def test_json_may_stand_before_the_command(run: Run) -> None:
    status, out, err = run("--json", "patterns", "gray", "--size", "8x8", "-o", "images")
    assert status == 0, err
    assert json.loads(out)["folder"] == "images"


def test_an_output_folder_that_is_not_empty_is_refused(run: Run, tmp_path: Path) -> None:
    assert run("patterns", "gray", "--size", "8x8", "-o", "images")[0] == 0
    before = sorted(path.stat().st_mtime_ns for path in (tmp_path / "images").iterdir())
    status, _, err = run("patterns", "gray", "--size", "8x8", "-o", "images")
    assert status == 1
    assert "--force" in err
    assert sorted(path.stat().st_mtime_ns for path in (tmp_path / "images").iterdir()) == before
    assert run("patterns", "gray", "--size", "8x8", "-o", "images", "--force")[0] == 0
    (tmp_path / "file").touch()
    for place in ("file", "file/below"):
        status, _, err = run("patterns", "gray", "--size", "8x8", "-o", place)
        assert status == 1
        assert "file" in err
        assert "\nhint: " in err
    status, _, err = run("patterns", "gray", "--size", "8x8", "-o", "/proc/there/images")
    assert status == 1
    assert "/proc/there" in err
    assert "hint: nothing can be made there" in err


# --- decode and audit ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture") / "seen"
    words = ("--size", "96x64", "--frequencies", "1,4,16", "--shifts", "4", "-o", str(folder))
    assert cli.main(["patterns", "pmp", *words]) == 0
    return capture_of(folder)


@pytest.fixture
def capture(seen: Path, tmp_path: Path) -> Path:
    """One's own, to be harmed."""
    return Path(shutil.copytree(seen, tmp_path / "seen"))


def test_patterns_seen_pixel_by_pixel_decode_to_their_rows(run: Run, capture: Path) -> None:
    status, out, err = run("decode", capture, "--json")
    assert status == 0
    assert "no calibration" in err
    result = json.loads(out)
    assert result["folder"] == str(capture / "scan")
    assert set(result["report"]["timings"]) >= {"write scan.npz"}
    rows = load_scan(capture / "scan").rows
    assert rows is not None
    seen = rows[:64, :96]
    assert np.isfinite(seen).mean() > 0.9
    assert np.nanmax(np.abs(seen - np.arange(64, dtype=np.float32)[:, None])) < 0.1
    status, out, _ = run("decode", capture / "capture.json", "-o", "elsewhere")
    assert status == 0
    assert "elsewhere/preview.png" in out
    status, _, err = run("decode", capture)
    assert status == 1
    assert "not empty" in err


def test_decode_says_which_frame_is_lost_and_what_is_to_blame(run: Run, capture: Path) -> None:
    content = json.loads((capture / "capture.json").read_text())
    names = content.pop("frames")
    frames = np.stack([cv2.imread(str(capture / name), cv2.IMREAD_UNCHANGED) for name in names])
    np.save(capture / "frames.npy", frames)
    told = ["0" * 16 if k == 3 else digest(frame) for k, frame in enumerate(frames)]
    lines = [json.dumps(FrameRecord(k, k, xxh3=xxh3).as_dict()) + "\n" for k, xxh3 in enumerate(told)]
    (capture / "frames.jsonl").write_text("".join(lines))
    said = f"frame 3 of {len(frames)} lost: the pixels of {capture / 'frames.npy'}, slot 3, are not those that the "
    for state, warns in (("complete", True), ("open", False)):
        (capture / "capture.json").write_text(json.dumps({**content, "state": state}))
        status, out, _ = run("decode", capture, "-o", state, "--json")
        assert status == 0
        assert any(said in one for one in json.loads(out)["report"]["warnings"]) == warns
    (capture / "frames.jsonl").write_text("".join(line.replace(told[2], "1" * 16) for line in lines))
    (capture / "capture.json").write_text(json.dumps(content))
    status, _, err = run("decode", capture, "-o", "without-two")
    assert status == 1
    assert f"frames 2, 3 of {len(frames)} lost: the pixels of" in err


def test_audit_of_a_capture_without_stamps_proves_nothing(run: Run, capture: Path, tmp_path: Path) -> None:
    status, out, _ = run("audit", capture, "--json")
    assert (status, json.loads(out)["passed"]) == (0, True)
    assert json.loads(out)["verdicts"] == {"proved": 0, "consistent": 0, "unproved": 12}
    status, out, _ = run("audit", capture, "-o", "timing.svg")
    assert status == 0
    lines = out.splitlines()
    assert any(line.startswith("this sequence cannot reveal  ") for line in lines)
    assert any(re.fullmatch("by pictures +none contradicted", line) for line in lines)
    witnesses = json.loads(run("audit", capture, "--json")[1])["witnesses"]
    assert witnesses
    assert all(any(line.startswith(w["name"]) and "  agrees  " in line for line in lines) for w in witnesses)
    assert (tmp_path / "timing.svg").read_text().startswith("<svg")
    status, _, err = run("audit", capture, "-o", "timing.svg")
    assert status == 2
    assert "--force" in err


def test_a_scans_folder_names_the_capture_in_it(run: Run, capture: Path, tmp_path: Path) -> None:
    (tmp_path / "scan").mkdir()
    capture.rename(tmp_path / "scan" / "capture")
    status, out, _ = run("audit", "scan")
    assert status == 0
    assert f"capture{' ' * 22}scan/capture" in out
    status, _, err = run("audit", tmp_path)
    assert status == 1
    assert "the folder of a scan" in err


def damage_image(folder: Path) -> None:
    (folder / "seen-003.png").write_bytes(b"\x89PNG\r\n\x1a\n")


def one_in_colour(folder: Path) -> None:
    cv2.imwrite(str(folder / "seen-003.png"), cv2.imread(str(folder / "seen-003.png"), cv2.IMREAD_COLOR))


def wrong_size(folder: Path) -> None:
    cv2.imwrite(str(folder / "seen-003.png"), np.zeros((127, 160), np.uint8))


def change(**members: Any) -> Callable[[Path], Any]:
    return lambda folder: capture_of(folder, **members)


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (shutil.rmtree, "cannot read"),
        (lambda folder: (folder / "seen-003.png").unlink(), "003.png is missing\nhint: copy it there"),
        (damage_image, "003.png"),
        (wrong_size, "take the one that belongs here"),
        (one_in_colour, "seen-003.png is in colour, frame seen-000.png is grey"),
        (lambda folder: (folder / "capture.json").write_text("{"), "not JSON"),
        (change(format="something"), "fringed-capture"),
        (change(version=2), "version 2"),
        (change(frames=["000.png"]), "1 frames listed, the pattern has 12"),
        (change(frames=["../000.png"] * 12), "folder"),
        (change(pattern={"method": "laser"}), "laser"),
        (change(pattern={"method": "pmp", "axes": ["y"], "frequencies": [1], "shifts": [2]}), "three shifts"),
        (change(calibration="lost.json"), "lost.json"),
        (change(calibration="../out.json"), "out.json"),
    ],
)
def test_bad_captures_are_refused_and_leave_nothing(
    harm: Callable[[Path], Any], said: str, run: Run, capture: Path, tmp_path: Path
) -> None:
    harm(capture)
    status, out, err = run("decode", capture, "-o", "out")
    assert (status, out) == (1, "")
    assert said in err
    assert not (tmp_path / "out").exists()


def test_frames_all_in_colour_are_read_as_luma_and_said_so_once(run: Run, capture: Path, tmp_path: Path) -> None:
    assert run("decode", capture, "-o", "grey")[0] == 0
    for path in capture.glob("seen-*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_COLOR))
    status, out, err = run("decode", capture, "-o", "colour", "--json")
    assert status == 0, err
    said = [warning for warning in json.loads(out)["report"]["warnings"] if "luma" in warning]
    assert len(said) == 1
    grey, colour = load_scan(tmp_path / "grey").rows, load_scan(tmp_path / "colour").rows
    assert grey is not None
    np.testing.assert_array_equal(grey, colour)


def calibration(**changes: Any) -> dict[str, Any]:
    lens = {"size": [160, 128], "matrix": [[100, 0, 47.5], [0, 100, 31.5], [0, 0, 1]], "distortion": [0, 0, 0, 0, 0]}
    turned = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    return {
        "format": "fringed-calibration",
        "version": 1,
        "camera": lens,
        "projector": {**lens, "size": [96, 64]},
        "rotation": turned,
        "translation": [0, 50, 0],
        **changes,
    }


def test_bad_calibrations_are_refused(run: Run, capture: Path, tmp_path: Path) -> None:
    file = tmp_path / "calibration.json"
    file.write_text(json.dumps(calibration()))
    assert run("decode", capture, "--calibration", file, "-o", "good")[0] == 0
    for changes in (
        {"camera": {**calibration()["camera"], "size": [640, 480]}},
        {"projector": {**calibration()["projector"], "size": [96, 128]}},
        {"camera": {**calibration()["camera"], "matrix": [[0, 0, 0], [0, 0, 0], [0, 0, 1]]}},
        {"rotation": [[float("nan"), 0, 0], [0, 1, 0], [0, 0, 1]]},
        {"rotation": [[1, 0, 0], [1, 0, 0], [0, 0, 1]]},
        {"version": 2},
        {"translation": None},
    ):
        file.write_text(json.dumps(calibration(**changes)))
        status, _, err = run("decode", capture, "--calibration", file, "-o", "deep/out")
        assert status == 1, changes
        assert err.startswith("opening") or "error:" in err, changes
        assert "\nhint: " in err, changes
        assert not (tmp_path / "deep").exists(), changes


def test_a_name_that_no_file_can_have_is_refused_in_words(run: Run, capture: Path) -> None:
    for words in (("scan", "--rig", "simulated:quick/board"), ("decode", capture), ("patterns", "pmp")):
        status, _, err = run(*words, "-o", 300 * "x")
        assert status == 1
        assert "File name too long" in err
    assert run("check-config", 5000 * "x")[0] == 1
