"""The command line: exit statuses, what goes to which stream, and what bad input gets."""

import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer

from drivers import registry
from scanner.devices import DeviceInfo
from scanner.wire_vectors import CALLS
from service import cli, program
from service.commands.status import facts, row

FRINGED = (sys.executable, "-c", "import sys; from service.cli import main; sys.exit(main())")
COMMANDS = ("scan", "decode", "audit", "patterns", "devices", "check-config", "daemon", "worker", "status")

Run = Callable[..., tuple[int, str, str]]


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
        (["scan", "--frequencies", "1,1e308"], "--frequencies: expected positive numbers up to 65535"),
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


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize(
    "words",
    [
        ("calibrate", "solve", "x", "--target", "chessboard:9x6:30"),
        ("calibrate", "marks", "x", "--at", "1,1"),
        ("calibrate", "mcp", "x", "y", "--calibration", "z"),
        ("calibrate", "target", "chessboard:9x6:30"),
        ("audit", "x"),
    ],
)
def test_a_folder_in_a_files_place_is_not_to_be_replaced(
    words: tuple[str, ...], force: bool, run: Run, tmp_path: Path
) -> None:
    (tmp_path / "there.svg").mkdir()
    status, _, err = run(*words, "-o", tmp_path / "there.svg", *(["--force"] if force else []))
    assert status == 2
    assert "is a folder, a file is to be written: give another name" in " ".join(err.split())
    assert "replaces" not in err


def test_a_live_picture_of_another_kind_is_refused_before_anything_begins(run: Run) -> None:
    for words in (("calibrate", "run", "simulated", "--target", "chessboard:9x6:20"), ("preview",), ("live",)):
        status, _, err = run(*words, "--picture", "x.tiff")
        assert status == 2
        assert "--picture: expected a png or jpg file, got 'x.tiff'" in err


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


IN_A_KERNEL = SystemError("CPUDispatcher(judge) returned a result with an exception set")
IN_A_KERNEL.__cause__ = KeyboardInterrupt()


@pytest.mark.parametrize(
    ("error", "status"), [(KeyboardInterrupt(), 130), (typer.Abort(), 130), (IN_A_KERNEL, 130)], ids=repr
)
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
        words = ("check-config", "simulated:quick/board", "--json")
        ran = subprocess.run([*FRINGED, *words], stdout=closed, stderr=subprocess.PIPE, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (1, "")


@pytest.mark.parametrize("words", [("--version",), ("--help",), ("check-config", "simulated", "--json")])
def test_output_that_cannot_be_written_is_said_and_no_bug(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with Path("/dev/full").open("w", encoding="utf-8") as full, monkeypatch.context() as redirected:
        redirected.setattr(sys, "stdout", full)
        assert cli.main(words) == 1
    err = capsys.readouterr().err
    assert err.startswith("error: cannot write to standard output: No space left on device\n")
    assert "bug" not in err


def test_closed_streams_lead_nowhere() -> None:
    line = f"{sys.executable} -m service.cli --version <&- >&- 2>&-"
    assert subprocess.run(["/bin/sh", "-c", line], check=False, timeout=60).returncode == 0


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


def test_devices_lists_the_simulated_rigs_and_a_driver_that_cannot_look_costs_only_its_own(
    run: Run, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(registry, "driver_names", lambda kind: ["no-such-driver", "simulated"])
    status, out, err = run("devices", "--json")
    found = json.loads(out)["devices"]
    assert status == 0
    assert "looking for devices" in err
    assert {device["driver"] for device in found} == {"simulated"}
    assert {"camera", "projector"} <= {device["kind"] for device in found}
    assert "no-such-driver cannot look for devices" in caplog.text


def test_devices_prints_the_piece_of_a_rig_file(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = [DeviceInfo("aravis", "maker-42", "camera", "Maker 42", {})]
    monkeypatch.setattr("drivers.registry.discover", lambda: seen)
    status, out, _ = run("devices")
    assert status == 0
    assert '[camera]\ndriver = "aravis"\ndevice = "maker-42"' in out
    monkeypatch.setattr("drivers.registry.discover", list)
    status, out, err = run("devices")
    assert "fringed doctor" in out
    assert "looking for devices" in err, "it takes seconds"


def test_ctrl_c_is_the_normal_end_of_a_simulated_camera(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(self: threading.Event, timeout: float) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr(
        registry, "load_simulator", lambda name: lambda *_, **__: nullcontext(SimpleNamespace(facts=[]))
    )
    monkeypatch.setattr(threading.Event, "wait", interrupted)
    status, out, err = run("simulate", "gige")
    assert (status, err) == (0, "")
    assert "Ctrl-C" in out


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
