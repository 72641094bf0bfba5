"""The command line: exit statuses, what goes to which stream, and what bad input gets."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import typer

from drivers import registry
from scanner.devices import DeviceInfo
from scanner.patterns import PatternSequence, ProjectorSize
from scanner.scan import load_scan
from scanner.wire_vectors import CALLS
from service import cli, program
from service.commands.status import facts, row

FRINGED = (sys.executable, "-c", "import sys; from service.cli import main; sys.exit(main())")
COMMANDS = ("scan", "decode", "audit", "patterns", "devices", "check-config", "daemon", "worker", "status")

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Run a command in `tmp_path`: (status, standard output, standard error)."""
    monkeypatch.chdir(tmp_path)

    def runs(*words: Any) -> tuple[int, str, str]:
        capsys.readouterr()
        status = cli.main([str(word) for word in words])
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        assert "error: unexpected" not in captured.err, captured.err
        return status, captured.out, captured.err

    return runs


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


# --- streams and statuses -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_examples(command: str, run: Run) -> None:
    status, out, err = run(command, "--help")
    assert (status, err) == (0, "")
    assert "Examples:" in out
    assert f"  fringed {command}" in out


def test_version_and_bare_call(run: Run) -> None:
    assert run("--version")[:2] == (0, "fringed 0.1.0\n")
    assert json.loads(run("--json", "--version")[1]) == {"version": "0.1.0"}
    status, out, _ = run()
    assert status == 0
    assert "check-config" in out
    assert "decoded as it comes. Ctrl-C ends it" in " ".join(out.split()), "the list cuts no sentence"
    status, out, err = run("calibrate")
    assert (status, out) == (2, "")
    assert err.startswith("Usage: fringed calibrate")
    assert "error" not in err.split("Commands:")[0]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["scna"], "scna"),
        (["scan", "--colour"], "--colour"),
        (["scan", "--method", "laser"], "laser"),
        (["scan", "--rig", "simulated", "--connect", "ipc:///x"], "exclude each other"),
        (["scan", "--exposure", "long"], "expected auto or microseconds"),
        (["scan", "--exposure", "-3"], "1 .. 10000000"),
        (["scan", "--frequencies", "1,x"], "--frequencies"),
        (["scan", "--frequencies", "1,0"], "positive"),
        (["scan", "--shifts", "4.5"], "whole numbers"),
        (["scan", "--frequencies", "1,8", "--shifts", "4,4,4"], "3 numbers for 2 frequencies"),
        (["scan", "--carriers", "5,6"], "says nothing to the method pmp"),
        (["scan", "--method", "mcp", "--bits", "3"], "needs --carriers"),
        (["scan", "--method", "mcp", "--carriers", "50"], "2 to 6"),
        (["scan", "--method", "mcp", "--codes", "0,-1"], "whole numbers from 0"),
        (["scan", "--method", "mcp", "--carriers", "40,80", "--codes", "0,1,2,2"], "0 .. 3, each once"),
        (["scan", "--method", "mcp", "--first", "dark"], "modulated, unmodulated"),
        (["scan", "--method", "mcp", "--unmodulated", "0.5"], "--levels composite"),
        (["scan", "--method", "mcp", "--levels", "composite", "--unmodulated", "1.5"], "at most 1"),
        (["scan", "--method", "gray", "--first", "modulated"], "says nothing to the method gray"),
        (["scan", "--no-inverse"], "--inverse/--no-inverse says nothing to the method pmp"),
        (["scan", "--method", "gray", "--code", "morse"], "gray, binary"),
        (["live", "--carriers", "40,80", "--codes", "1,2,3,4"], "0 .. 3, each once"),
        (["scan", "--method", "mcp", "--axis", "xy"], "--axis"),
        (["scan", "--depth", "500:400"], "smaller first"),
        (["scan", "--depth", "near"], "depth must be"),
        (["scan", "--box", "1:2"], "box must be"),
        (["scan", "--min-confidence", "1.5"], "--min-confidence"),
        (["scan", "--repeat", "0"], "--repeat"),
        (["decode"], "CAPTURE"),
        (["audit", "x", "-o", "timing.pdf"], ".svg or .png"),
        (["patterns", "pmp"], "output"),
        (["patterns", "pmp", "-o", "x", "--size", "12"], "WIDTHxHEIGHT"),
        (["patterns", "pmp", "-o", "x", "--size", "64x64", "--frequencies", "1,60"], "period"),
        (["worker"], "--connect"),
    ],
)
def test_wrong_usage_is_2_and_says_what(words: list[str], said: str, run: Run, tmp_path: Path) -> None:
    status, out, err = run(*words)
    assert (status, out) == (2, "")
    assert said in err
    assert "--help" in err
    status, out, _ = run(*words, "--json")
    assert status == 2
    assert json.loads(out)["error"]["code"] == 2
    assert list(tmp_path.iterdir()) == []


def test_no_daemon_says_how_to_start_one(run: Run, tmp_path: Path) -> None:
    status, out, err = run("status", "--connect", f"ipc://{tmp_path}/none.ipc")
    assert (status, out) == (1, "")
    assert "fringed daemon" in err
    status, out, _ = run("scan", "--connect", f"ipc://{tmp_path}/none.ipc", "--json")
    assert status == 1
    assert json.loads(out)["error"]["class"] == "Unreachable"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("debug", [False, True])
def test_a_bug_shows_one_line_and_where_the_rest_is(
    debug: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    said: list[tuple[Any, ...]] = []
    monkeypatch.setattr(program, "print_error", lambda *words: said.append(words))
    monkeypatch.setattr(program, "_run", lambda words, as_json: [].pop())
    assert cli.main(["devices", *(["--debug"] if debug else [])]) == 1
    assert said[0][0] == "unexpected IndexError: pop from empty list"
    logs = list(tmp_path.glob("fringed-error-*.log"))
    assert [("Traceback" in log.read_text()) for log in logs] == ([] if debug else [True])


@pytest.mark.parametrize(("error", "status"), [(KeyboardInterrupt(), 130), (typer.Abort(), 130)])
def test_an_interrupted_command_is_130(
    error: BaseException, status: int, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any) -> None:
        raise error

    monkeypatch.setattr("drivers.registry.discover", interrupted)
    assert run("devices")[0] == status
    got, out, _ = run("devices", "--json")
    assert (got, json.loads(out)["error"]["message"]) == (status, "interrupted")


def test_a_closed_pipe_is_no_error() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as closed:
        ran = subprocess.run(
            [*FRINGED, "devices", "--json"], stdout=closed, stderr=subprocess.PIPE, text=True, check=False
        )
    assert (ran.returncode, ran.stderr) == (1, "")


def test_the_command_line_starts_without_array_libraries() -> None:
    heavy = (
        "import sys, service.program; print(sorted({'numpy', 'numba', 'cv2', 'zmq', 'pydantic'} & set(sys.modules)))"
    )
    ran = subprocess.run([sys.executable, "-c", heavy], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"


def test_opencv_does_not_write_between_our_lines() -> None:
    code = "import service.cli, cv2; assert cv2.imdecode(cv2.imencode('.png', cv2.UMat(9, 9, 0))[1][:60], 1) is None"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "", "")


def test_shell_completion_is_offered() -> None:
    ran = subprocess.run(
        [*FRINGED, "--show-completion", "bash"], capture_output=True, text=True, check=True, env={**os.environ}
    )
    assert "complete" in ran.stdout


# --- devices and rig files ----------------------------------------------------------------------------------------


def test_devices_lists_the_simulated_rigs(run: Run) -> None:
    status, out, err = run("devices", "--json")
    found = json.loads(out)["devices"]
    assert (status, err) == (0, "")
    assert {"camera", "projector"} <= {device["kind"] for device in found if device["driver"] == "simulated"}


def test_devices_prints_the_piece_of_a_rig_file(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = [DeviceInfo("aravis", "maker-42", "camera", "Maker 42", {})]
    monkeypatch.setattr("drivers.registry.discover", lambda: seen)
    status, out, _ = run("devices")
    assert status == 0
    assert '[camera]\ndriver = "aravis"\ndevice = "maker-42"' in out
    monkeypatch.setattr("drivers.registry.discover", list)
    assert "fringed doctor" in run("devices")[1]


def test_devices_prints_a_rig_file_of_simulated_ones(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    of_rigs = [("camera", "casey2011/bust"), ("camera", "quick/bust"), ("projector", "casey2011/bust")]
    seen = [DeviceInfo("simulated", device, kind, "", {}) for kind, device in (*of_rigs, ("trigger", "casey2011/bust"))]
    monkeypatch.setattr("drivers.registry.discover", lambda: seen)
    _, out, _ = run("devices")
    (tmp_path / "rig.toml").write_text(out[out.index("# a simulated rig") :])
    assert "also quick/bust" in out
    status, out, _ = run("check-config", "rig.toml")
    assert status == 0
    assert "simulated casey2011/bust" in out


def test_status_of_no_daemon_says_how_to_start_one_there(run: Run, tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/none.ipc"
    status, _, err = run("status", "--connect", endpoint)
    assert status == 1
    assert f"fringed daemon CONFIG.toml --endpoint {endpoint}" in err


def test_a_driver_that_cannot_look_costs_only_its_own_devices(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(registry, "driver_names", lambda kind: ["no-such-driver", "simulated"])
    assert {device.driver for device in registry.discover()} == {"simulated"}
    assert "no-such-driver cannot look for devices" in caplog.text


def test_check_config_says_what_a_rig_file_means_or_all_that_is_wrong(run: Run, tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text('camera.driver = "simulated"\nprojector.driver = "simulated"\n')
    status, out, err = run("check-config", rig)
    assert (status, err) == (0, "")
    assert "auto: test shots" in out
    rig.write_text('camera.driver = "simulated"\ncamera.divice = 3\nprojector.dwell = 0\n')
    status, out, err = run("check-config", rig)
    assert (status, out) == (1, "")
    assert f"{rig}:2: camera.divice: unknown key; did you mean 'device'?" in err
    assert "projector.driver: is missing" in err
    assert "projector.dwell = 0: expected refreshes" in err
    status, out, _ = run("check-config", rig, "--json")
    assert (status, [problem["line"] for problem in json.loads(out)["problems"]]) == (1, [2, 3, 3])


def test_check_config_takes_what_the_daemon_takes(run: Run) -> None:
    status, out, err = run("check-config", "simulated:quick/board")
    assert (status, err) == (0, "")
    assert "quick/board" in out


@pytest.mark.parametrize("words", [("scan",), ("decode", "x"), ("patterns", "pmp"), ("audit", "x")])
def test_an_empty_output_is_wrong_usage(words: tuple[str, ...], run: Run, tmp_path: Path) -> None:
    status, _, err = run(*words, "-o", "")
    assert status == 2
    assert "got nothing" in err
    assert list(tmp_path.iterdir()) == []


def test_a_name_that_no_file_can_have_is_refused_in_words(run: Run, capture: Path) -> None:
    for words in (("scan", "--rig", "simulated:quick/board"), ("decode", capture), ("patterns", "pmp")):
        status, _, err = run(*words, "-o", 300 * "x")
        assert status == 1
        assert "File name too long" in err
    assert run("check-config", 5000 * "x")[0] == 1


def test_the_module_is_a_program_too() -> None:
    ran = subprocess.run([sys.executable, "-m", "service.cli", "--version"], capture_output=True, text=True, check=True)
    assert ran.stdout.startswith("fringed ")


def test_check_config_opens_the_calibration(run: Run, tmp_path: Path) -> None:
    (tmp_path / "broken.json").write_text("{")
    (tmp_path / "rig.toml").write_text(
        'rig.calibration = "broken.json"\ncamera.driver = "simulated"\nprojector.driver = "simulated"\n'
    )
    status, _, err = run("check-config", "rig.toml")
    assert status == 1
    assert "broken.json" in err


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
    ],
)
def test_patterns_are_what_their_description_says(words: list[str], run: Run, tmp_path: Path) -> None:
    size = [] if "--size" in words else ["--size", "96x64"]
    status, out, _ = run("patterns", *words, *size, "-o", "images", "--json")
    assert status == 0
    content = json.loads((tmp_path / "images" / "pattern.json").read_text())
    assert {key: json.loads(out)[key] for key in content} == content
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


@pytest.fixture
def capture(run: Run, tmp_path: Path) -> Path:
    assert run("patterns", "pmp", "--size", "96x64", "--frequencies", "1,4,16", "--shifts", "4", "-o", "seen")[0] == 0
    return capture_of(tmp_path / "seen")


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


def test_audit_of_a_capture_without_stamps_proves_nothing(run: Run, capture: Path, tmp_path: Path) -> None:
    status, out, _ = run("audit", capture, "--json")
    assert (status, json.loads(out)["passed"]) == (0, True)
    assert json.loads(out)["verdicts"] == {"proved": 0, "consistent": 0, "unproved": 12}
    status, out, _ = run("audit", capture, "-o", "timing.svg")
    assert status == 0
    lines = out.splitlines()
    assert any(line.startswith("this sequence cannot reveal  ") for line in lines)
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


@pytest.mark.parametrize(
    "changes",
    [
        {"camera": {**calibration()["camera"], "size": [640, 480]}},
        {"projector": {**calibration()["projector"], "size": [96, 128]}},
        {"camera": {**calibration()["camera"], "matrix": [[0, 0, 0], [0, 0, 0], [0, 0, 1]]}},
        {"rotation": [[float("nan"), 0, 0], [0, 1, 0], [0, 0, 1]]},
        {"rotation": [[1, 0, 0], [1, 0, 0], [0, 0, 1]]},
        {"version": 2},
        {"translation": None},
    ],
)
def test_bad_calibrations_are_refused(changes: dict[str, Any], run: Run, capture: Path, tmp_path: Path) -> None:
    good = tmp_path / "good.json"
    good.write_text(json.dumps(calibration()))
    assert run("decode", capture, "--calibration", good, "-o", "good")[0] == 0
    bad = tmp_path / "bad.json"
    bad.write_text(json.dumps(calibration(**changes)))
    status, _, err = run("decode", capture, "--calibration", bad, "-o", "deep/out")
    assert status == 1
    assert err.startswith("opening") or "error:" in err
    assert "\nhint: " in err
    assert not (tmp_path / "deep").exists()


def test_status_tells_what_a_daemon_answers() -> None:
    (_, _, content) = next(call for call in CALLS if call[0] == "status")
    told = dict(facts(content))
    assert told["camera"] == "simulated camera quick/board, 320 x 240 px, 8 bits"
    assert told["projector"] == "simulated projector quick/board, 320 x 240 px, framebuffer"
    assert told["workers"] == "rig-812 on rig (process 812), idle"
    assert told["jobs"] == "none under way"
    assert told["spool"] == "13.5 MB, no limit; 1.00 GB of the disk are kept free"
    (_, _, job) = next(call for call in CALLS if call[0] == "scan.status")
    busy = {**content, "devices": None, "workers": [], "jobs": [job], "waiting_for_worker": 2}
    told = dict(facts(busy))
    assert told["devices"].startswith("not open")
    assert told["workers"].startswith("none")
    assert told["waiting"].startswith("2 captured")
    assert job["id"] in told["jobs"]
    assert row(job)[:3] == (job["id"], job["method"], job["state"])
