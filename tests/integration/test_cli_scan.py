"""`fringed scan` as a process: from nothing to files, interrupted, refused, and against a running daemon."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scanner.capture import Capture
from scanner.errors import StorageError
from scanner.scan import load_scan
from service.cli import main
from tests.faults.daemons import settle

FRINGED = (sys.executable, "-c", "import sys; from service.cli import main; sys.exit(main())")
SCAN_FILES = {"scan.npz", "cloud.ply", "preview.png", "report.json", "capture"}
PATIENCE_S = 60.0


def fringed(*words: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*FRINGED, *map(str, words)], capture_output=True, text=True, check=False, timeout=PATIENCE_S)


@contextmanager
def running(*words: Any, environment: Mapping[str, str] | None = None) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [*FRINGED, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **(environment or {})},
    ) as it:
        try:
            yield it
        finally:
            it.kill()


def first_document(process: subprocess.Popen[str]) -> Any:
    """What it has printed once it serves."""
    assert process.stdout is not None
    lines = "".join(iter(process.stdout.readline, "}\n"))
    return json.loads(lines + "}")


Here = Callable[..., tuple[int, str, str]]


@pytest.fixture
def here(capsys: pytest.CaptureFixture[str]) -> Here:
    """Run a command in this process, where no more is asked of it: (status, standard output, standard error)."""

    def runs(*words: Any) -> tuple[int, str, str]:
        capsys.readouterr()
        status = main([str(word) for word in words])
        return status, *capsys.readouterr()

    return runs


def test_a_scan_from_nothing_to_files_and_again(tmp_path: Path, here: Here) -> None:
    folder = tmp_path / "out"
    words = ("scan", "--rig", "simulated:quick/board", "-o", folder)
    ran = fringed(*words, "--compare-truth", "--json")
    assert ran.returncode == 0, ran.stderr
    result = json.loads(ran.stdout)
    assert {path.name for path in folder.iterdir()} == SCAN_FILES | {"error_map.png"}
    assert result["report"]["truth"]["inside"]["wrong"] == 0
    assert "capturing" in ran.stderr
    assert load_scan(folder).points.shape == (result["report"]["points"], 3)
    capture = Capture.open(folder / "capture")
    assert capture.header.state == "complete"
    assert capture.missing == ()
    # A second scan into the same folder is refused, or takes the first one's place without leaving anything of it.
    status, out, err = here(*words)
    assert (status, out) == (1, "")
    assert "--force" in err
    status, out, err = here(*words, "--force")
    assert status == 0, err
    assert "cloud.ply" in out
    assert {path.name for path in folder.iterdir()} == SCAN_FILES
    assert Capture.open(folder / "capture").header.id != capture.header.id
    # What was captured decodes again, to the same rows.
    assert here("decode", folder / "capture", "-o", tmp_path / "again")[0] == 0
    # Decoded with another calibration, a scan keeps that one.
    other = json.loads((folder / "capture" / "calibration.json").read_text()) | {"id": "another"}
    (tmp_path / "other.json").write_text(json.dumps(other))
    of_other = tmp_path / "of_other"
    assert here("decode", folder / "capture", "--calibration", tmp_path / "other.json", "-o", of_other)[0] == 0
    said = here("calibrate", "verify", of_other, "--flat")[1]
    assert "the calibration has no covariance" in said
    assert json.loads((of_other / "calibration.json").read_text())["id"] == "another"
    np.testing.assert_array_equal(load_scan(tmp_path / "again").rows, load_scan(folder).rows)
    status, out, err = here("audit", folder / "capture", "-o", tmp_path / "timing.svg", "--json")
    assert status == 0, err
    assert json.loads(out)["passed"]
    assert (tmp_path / "timing.svg").read_text().lstrip().startswith("<")


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_scan_told_to_stop_leaves_nothing(number: signal.Signals, status: int, tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "out"
    with running("scan", "--rig", "simulated:quick/board", "--repeat", "20", "-o", folder) as scan:
        assert scan.stderr is not None
        for line in scan.stderr:
            if line.startswith("starting"):  # it is over: the job has begun, and has twenty repetitions before it
                break
        scan.send_signal(number)
        out, _ = scan.communicate(timeout=PATIENCE_S)
    assert scan.returncode == status
    assert out == ""
    assert not (tmp_path / "deep").exists()


def test_a_scan_that_is_killed_leaves_no_private_folder(tmp_path: Path) -> None:
    private = Path(tempfile.mkdtemp())  # short: with a longer one sockets would go elsewhere
    words = ("scan", "--rig", "simulated:quick/board", "--repeat", "20", "-o", tmp_path / "out")
    with running(*words, environment={"TMPDIR": str(private)}) as scan:
        deadline = time.monotonic() + PATIENCE_S
        while not list(private.glob("fringed-*/spool/*/capture/frames.npy")):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        scan.kill()
    assert not (tmp_path / "out").exists()
    while list(private.iterdir()):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    private.rmdir()


@pytest.mark.parametrize("imported", ["service.program", "typer", "scanner.client"])
def test_an_early_interrupt_is_quiet(imported: str, tmp_path: Path) -> None:
    program = f"""
import os, signal, sys
from service.cli import main
class Early:
    def find_spec(self, name, path=None, target=None):
        if name == {imported!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Early())
sys.exit(main(["status", "--connect", "ipc://{tmp_path}/control.ipc"]))
"""
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout) == (130, "")
    assert "Traceback" not in ran.stderr


@pytest.mark.parametrize(
    ("rig", "said"),
    [("simulated:quick/nowhere", "nowhere"), ("lost.toml", "lost.toml")],
)
def test_a_rig_that_is_not_there_is_named(rig: str, said: str, tmp_path: Path) -> None:
    ran = fringed("scan", "--rig", rig, "-o", tmp_path / "out", "--json")
    assert ran.returncode == 1
    assert said in ran.stderr
    assert said in json.loads(ran.stdout)["error"]["message"]
    assert list(tmp_path.iterdir()) == []


# --- with a daemon that runs --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Of `fringed daemon`, which says where it serves, and ends in order with nothing more to say."""
    folder = tmp_path_factory.mktemp("d")
    endpoint, words = f"ipc://{folder}/control.ipc", ("simulated:quick/board", "--state", folder / "state", "--json")
    with running("daemon", *words, "--endpoint", endpoint) as daemon:
        told = first_document(daemon)
        assert (told["pid"], told["endpoints"]["control"]) == (daemon.pid, endpoint)
        assert set(told) == {"endpoints", "pid", "rig"}
        settle(endpoint)
        yield endpoint
        daemon.send_signal(signal.SIGTERM)
        rest, _ = daemon.communicate(timeout=PATIENCE_S)
    assert (daemon.returncode, rest) == (0, "")


def test_a_disk_without_room_is_noticed_before_the_run(
    endpoint: str, here: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def full(folder: Path, needed: int) -> None:
        asked.append(needed)
        raise StorageError(f"{folder} is full", hint="free some space")

    monkeypatch.setattr("scanner.storage.check_room", full)
    assert here("scan", "--connect", endpoint, "-o", tmp_path / "out")[0] == 1
    assert asked[0] > 31 * 320 * 240
    assert list(tmp_path.iterdir()) == []
    assert json.loads(here("status", "--connect", endpoint, "--json")[1])["scans"][-1]["state"] == "cancelled"


def test_a_worker_says_where_it_works_and_is_told_to_stop(endpoint: str) -> None:
    with running("worker", "--connect", endpoint, "--json") as worker:
        assert first_document(worker) == {"endpoint": endpoint, "pid": worker.pid}
        worker.send_signal(signal.SIGINT)
        rest, said = worker.communicate(timeout=PATIENCE_S)
    assert (worker.returncode, rest) == (130, ""), said
    assert "error: interrupted" in said


def test_a_running_daemon_is_asked_for_scans(endpoint: str, here: Here, tmp_path: Path) -> None:
    before = json.loads(here("status", "--connect", endpoint, "--json")[1])["scans"]
    for method in ("mcp", "gray"):
        status, out, err = here("scan", "--connect", endpoint, "--method", method, "-o", tmp_path / method, "--json")
        assert status == 0, err
        assert json.loads(out)["report"]["points"] > 10_000
    scans = json.loads(here("status", "--connect", endpoint, "--json")[1])["scans"]
    assert [scan["state"] for scan in scans[len(before) :]] == ["done", "done"]
    assert here("status", "--connect", endpoint)[0] == 0


def test_preview_writes_a_picture_and_tells_how_bright_it_is(endpoint: str, here: Here, tmp_path: Path) -> None:
    file = tmp_path / "seen.png"
    status, out, err = here("preview", "--connect", endpoint, "--seconds", "0.2", "-o", file, "--json")
    assert status == 0, err
    told = json.loads(out)
    assert told["pictures"] > 0
    assert 0.2 < told["mean"] < told["bright"] < 1
    assert cv2.imread(str(file), cv2.IMREAD_UNCHANGED).shape == (240, 320)
    assert "sharpness" in err
    status, _, err = here("preview", "-o", tmp_path / "seen.gif")
    assert (status, "png or jpg" in err) == (2, True)
