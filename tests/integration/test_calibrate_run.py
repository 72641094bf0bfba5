"""`fringed calibrate run` as a whole: a target that walks through its poses, captured by itself, to a calibration."""

import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from drivers.simulated.rigs import rig as reference_rig
from scanner.calibration.solve import SolveOptions
from scanner.calibration.targets import parse_target
from scanner.capture import Capture
from scanner.errors import CalibrationError, StorageError
from scanner.geometry import load_calibration
from service.cli import main
from service.config import load_rig
from service.guided_calibration import GuidedCalibration, alone_in

TARGET = "chessboard:9x6:19"
POSES = 3


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fast rig that knows its latency, so that no test waits for either."""
    path = tmp_path_factory.mktemp("rig") / "rig.toml"
    device = "quick/chessboard_poses?walk=true&exposure_scale=4"
    path.write_text(
        f'[rig]\nname = "walk"\n[camera]\ndriver = "simulated"\ndevice = "{device}"\n'
        f'[projector]\ndriver = "simulated"\ndevice = "{device}"\nlatency_us = [300, 700]\nsettle_us = [100, 300]\n'
        "[projector.options]\nrefresh_ns = 8_000_000\nlatency_us = 500\n"
        "[camera.options]\nreadout_us = 300\n[camera.settings]\nexposure_us = 4000\n"
    )
    return path


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A picture every twelfth of a second, and a target that counts as still after a fifth."""
    monkeypatch.setattr("service.guided_calibration.PREVIEW_HZ", 12.0)
    monkeypatch.setattr("scanner.calibration.guide.STILL_S", 0.2)


@pytest.mark.usefixtures("quick")
def test_a_rig_is_calibrated_by_itself(rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "calibration"
    words = ["calibrate", "run", str(rig), "--target", TARGET, "-o", str(folder)]
    assert main([*words, "--poses", str(POSES), "--write", "--json"]) == 0
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert {path.name for path in folder.iterdir()} == {
        *("poses", "calibrate.png", "calibration.json", "calibration.png")
    }
    # Every pose another one, both axes, kept as a capture of its own.
    assert [view["name"] for view in document["views"]] == [f"{n + 1:02d}" for n in range(POSES)]
    first = Capture.open(folder / "poses" / "01")
    assert set(first.header.sequence.pattern.axes) == {"x", "y"}  # type: ignore[union-attr]
    assert document["calibration"]["scale"] == "unverified"
    opened = document["calibration"]["warm_up"]["devices_open_s"]
    assert 0 < opened[0] < opened[1] < 120
    assert first.header.extra["warm_up"]["devices_open_s"] == opened[0]
    for words_said in (
        "taken from the rig file",
        "response: gamma",
        "pose 3: 54 points; residual 0.0",
        "next:",
    ):
        assert words_said in said.err
    # What three poses of a quick rig tell, against the truth: to a per cent or two.
    found, truth = load_calibration(folder / "calibration.json"), reference_rig("quick").calibration
    assert found.camera.matrix[0, 0] == pytest.approx(truth.camera.matrix[0, 0], rel=0.02)
    assert np.linalg.norm(found.translation) == pytest.approx(np.linalg.norm(truth.translation), rel=0.03)
    assert load_rig(rig).rig.calibration == folder / "calibration.json"

    # A finished run is not replaced unasked.
    assert main(words) == 2
    assert "--force" in capsys.readouterr().err
    # One that goes on takes its poses up again; the last can be taken back.
    again = GuidedCalibration(None, parse_target(TARGET), folder, SolveOptions())  # type: ignore[arg-type]  asked nothing
    assert again.take_up() == len(again.captures) == POSES
    assert again.solved().state.camera.matrix[0, 0] == pytest.approx(found.camera.matrix[0, 0])
    assert again.undo() == f"{POSES:02d}"
    assert len(again.captures) == POSES - 1
    shutil.copytree(folder / "poses" / "01", folder / "poses" / "20")
    copied = GuidedCalibration(None, parse_target(TARGET), folder, SolveOptions())  # type: ignore[arg-type]
    assert copied.take_up() == POSES - 1
    assert [one.reason for one in copied.left_out] == ["it is a copy of 01, and tells nothing new"]
    copied.close()
    shutil.rmtree(folder / "poses" / "20")
    (folder / "poses" / f"{POSES + 4:02d}").touch()  # of whatever kind: the next pose stands behind it
    assert again._free_place().name == f"{POSES + 5:02d}"
    again.close()


def test_two_runs_in_one_folder_do_not_mix_their_poses(tmp_path: Path) -> None:
    with alone_in(tmp_path), pytest.raises(StorageError, match="another calibration runs in"), alone_in(tmp_path):
        pass
    with alone_in(tmp_path):
        pass


class _Elsewhere:
    """A daemon whose devices have other sizes."""

    def preview_start(self, **_: object) -> str:
        return ""

    def preview_stop(self) -> None:
        """Nothing."""

    def status(self) -> dict[str, object]:
        return {"devices": {side: {"width": 1392, "height": 1040} for side in ("camera", "projector")}}


def test_poses_of_another_rig_are_not_taken_up(tmp_path: Path) -> None:
    session = GuidedCalibration(_Elsewhere(), parse_target(TARGET), tmp_path, SolveOptions())  # type: ignore[arg-type]
    session.require_this_rig()  # none are there
    size = (320, 240)
    session.observations.append(SimpleNamespace(view=SimpleNamespace(name="01"), camera_size=size, projector_size=size))  # type: ignore[arg-type]
    with pytest.raises(
        CalibrationError, match=r"pose 01 of .* is another rig's: camera 320 x 240, projector 320 x 240"
    ):
        session.require_this_rig()
    session.close()


@pytest.mark.usefixtures("quick")
def test_where_no_pose_is_captured_the_reason_is_said(
    rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.commands.calibrate_run.PATIENCE_S", 0.5)
    assert main(["calibrate", "run", str(rig), "--target", "circles:7x5:19", "-o", str(tmp_path / "none")]) == 1
    said = capsys.readouterr().err
    assert "error: no pose was captured" in said
    waited = re.search(r"no new pose for \d+ s: (.+)", said)
    assert waited is not None
    assert f"hint: at the end: {waited[1]}" in said


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["--target", TARGET], 2, "--connect"),
        (["simulated", "--target", TARGET, "--write"], 1, "no rig file"),
        (["simulated", "--target", "wedge:wedge.json"], 1, "wedge.json"),
    ],
)
def test_what_cannot_be_run_is_refused_before_a_device_is_opened(
    words: list[str], status: int, said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["calibrate", "run", *words, "-o", str(tmp_path / "out")]) == status
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
