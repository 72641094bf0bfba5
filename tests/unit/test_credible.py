"""Calibration files that are well-formed and no rig: refused where nothing can be so, warned of where it is odd."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from scanner.calibration.watch import watched
from scanner.calibration_spread import depth_spread
from scanner.credible import ODD_BASELINE_MM
from scanner.errors import CalibrationError
from scanner.geometry import calibration_from_dict, load_calibration
from scanner.scan import build_scan
from service import cli

Content = dict[str, Any]


@pytest.fixture
def content(rig_of: Callable[..., Any]) -> Content:
    found: Content = json.loads(json.dumps(rig_of("y").as_dict()))
    return found


def scaled(content: Content, factor: float) -> None:
    content["translation"] = [factor * t for t in content["translation"]]


def focal(content: Content, side: str, *lengths: float) -> None:
    for row, length in enumerate(lengths):
        content[side]["matrix"][row][row] = length


def turned_round(content: Content) -> None:
    content["rotation"] = (np.diag([1.0, -1.0, -1.0]) @ content["rotation"]).tolist()


def mirrored(content: Content) -> None:
    content["rotation"] = (np.diag([-1.0, 1.0, 1.0]) @ content["rotation"]).tolist()


def shifted(c: Content, shift: float = 1.1) -> None:
    """A projector with a lens shift of 110 %, as they are sold: above the camera, looking straight ahead."""
    c["projector"]["matrix"][1][2] = 149.5 - shift * 150
    c["rotation"], c["translation"] = np.eye(3).tolist(), [0.0, 160.0, 0.0]


def hall(content: Content, m34: float, left: Any = None) -> None:
    """The rig's own lens, 500 mm from the world's origin, as Hall's matrix has it."""
    lens = np.array(content["camera"]["matrix"]) / 500 if left is None else left
    matrix = np.column_stack((lens, [160.0, 120.0, m34])).tolist()
    content["hall"] = {"camera": matrix, "projector": matrix}


REFUSED = [
    (lambda c: scaled(c, 1e-3), r"0\.2 mm apart: nothing can be", "in metres, multiply the translation by 1000"),
    (lambda c: scaled(c, 1e4), "2e.06 mm apart", "micrometres"),
    (lambda c: c.update(rotation=np.eye(3).tolist(), translation=[0, 0, 0]), "translation is zero", "calibrate"),
    (turned_round, "no point before the camera", "transposed"),
    (mirrored, "determinant is -1", "mirror"),
    (lambda c: c["rotation"][0].__setitem__(0, 0.9), "not a rotation", "unrounded"),
    (lambda c: focal(c, "camera", 8.0, 8.0), r"camera\.matrix: a focal length of 8 px is an angle of view of 17", "mm"),
    (lambda c: focal(c, "camera", -620.0, 620.0), "focal length that is not positive", ""),
    (lambda c: focal(c, "projector", 700.0, 9000.0), "12.9 times", "pixels"),
    (lambda c: c["projector"]["matrix"][0].__setitem__(2, 1e4), "outside the picture: its middle would be seen 86", ""),
    (lambda c: c["camera"]["matrix"][0].__setitem__(1, 400.0), "skew", ""),
    (lambda c: c["camera"].update(distortion=[-20.0, 0, 0, 0, 0]), "folds the image", "fewer radial terms"),
    # Folds half-way out, and has unfolded again at the edges, where it moves nothing.
    (lambda c: c["camera"].update(distortion=[-41.0, 610.0, 0, 0, 0]), "folds the image", "fewer radial terms"),
    (lambda c: c["camera"].update(size=[1 << 17, 240]), "no picture", "pixels"),
    (lambda c: c["camera"].update(size=[True, 240]), "size", ""),
    (lambda c: c.update(response={"projector": {"gamma": float("nan")}}), r"response\.projector\.gamma", ""),
    (lambda c: c.update(response={"projector": {"gamma": 1e308}}), r"response\.projector\.gamma", ""),
    (lambda c: c.update(response={"camera": {"table": [1.0, 0.0] * 128}}), r"response\.camera\.table", ""),
    (lambda c: hall(c, 0.0), r"hall\.camera: .* m34, must be 1, got 0", "divide"),
    (lambda c: hall(c, 2.0), r"hall\.camera: .* m34, must be 1, got 2", "divide"),
    (lambda c: hall(c, 1.0, np.zeros((3, 3))), r"hall\.camera is singular", "null"),
    (lambda c: c.update(mcp_phase={"slope": 0, "intercept": 3.0}), r"mcp_phase\.slope must be above 0", "null"),
    (lambda c: c.update(residuals=5), "residuals must be", ""),
    (lambda c: c.update(residuals={"epipolar_px": "small"}), "epipolar_px", ""),
]  # fmt: skip


@pytest.mark.parametrize(("change", "says", "hint"), REFUSED)
def test_what_cannot_be_is_refused_with_its_likely_cause(
    content: Content, change: Callable[[Content], None], says: str, hint: str
) -> None:
    change(content)
    with pytest.raises(CalibrationError, match=says) as caught:
        calibration_from_dict(content, name="file.json")
    assert "file.json" in str(caught.value)
    assert hint in (caught.value.hint or "")


ODD = [
    (lambda c: scaled(c, 0.02), "4 mm apart, their common view begins at .* metres, multiply the translation by 1000"),
    (lambda c: scaled(c, 100), "apart, .* micrometres"),
    (lambda c: scaled(c, -1), "look away from one another, by 1[56]"),
    (lambda c: c.update(rotation=np.eye(3).tolist(), translation=[0, 0, 200]), "straight behind the camera"),
    (lambda c: c.update(rotation=np.eye(3).tolist(), translation=[0, 0, -200]), "in the camera's picture"),
    (lambda c: focal(c, "camera", 1e6, 1e6), r"angle of view of 0\.0183 degrees across"),
    (lambda c: focal(c, "projector", 700, 2100), "3 times"),
    (lambda c: focal(c, "camera", 1.2 * 620.0, 620.0), "pixels that are not square"),
    (lambda c: focal(c, "camera", 620.0, 0.7 * 620.0), "pixels that are not square"),
    (lambda c: shifted(c, 3.5), "outside the picture"),
    (lambda c: c.update(response={"projector": None, "camera": {"gamma": 2.2}}), "response.camera is not applied"),
    (lambda c: c["camera"].update(distortion=[-1.76, 0, 0, 0, 0]), "in its corners"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "says"), ODD)
def test_what_is_odd_is_believed_with_a_warning(
    content: Content, change: Callable[[Content], None], says: str, tmp_path: Any
) -> None:
    change(content)
    (tmp_path / "odd.json").write_text(json.dumps(content))
    found = load_calibration(tmp_path / "odd.json").warnings
    assert len([said for said in found if re.search(says, said)]) == 1, found
    assert all(said.startswith("odd.json") for said in found), "reports are read elsewhere: no paths"


@pytest.mark.parametrize(
    "change",
    [
        lambda c: None,
        lambda c: scaled(c, 2 * ODD_BASELINE_MM / 200),
        lambda c: c.update(rotation=np.eye(3).tolist()),  # side by side, parallel
        lambda c: focal(c, "projector", 700, 1400),  # mirrors on edge
        lambda c: focal(c, "camera", 620, 310),  # pixels joined in pairs
        lambda c: focal(c, "camera", 620, 1.1 * 620),  # analogue
        lambda c: hall(c, 1.0),
        lambda c: c.update(mcp_phase={"slope": 4.0, "intercept": -2.0}),
        shifted,
    ],
)
def test_rigs_that_exist_pass_without_a_word(content: Content, change: Callable[[Content], None]) -> None:
    change(content)
    assert calibration_from_dict(content).warnings == ()


NAMES = ["camera.fx", "translation.x", "translation.y"]
SOUND = np.diag([4.0, 0.01, 0.02]) + np.array([[0, 0.1, 0], [0.1, 0, 0], [0, 0, 0.0]])


@pytest.mark.parametrize(
    ("covariance", "says"),
    [
        ({"parameters": NAMES, "matrix": SOUND[:2].tolist()}, "shape"),
        ({"parameters": NAMES, "matrix": (SOUND * np.nan).tolist()}, "NaN"),
        ({"parameters": NAMES, "matrix": (SOUND + np.triu(SOUND, 1)).tolist()}, "not symmetric"),
        ({"parameters": NAMES, "matrix": (-SOUND).tolist()}, "variance below zero"),
        ({"parameters": NAMES, "matrix": (SOUND + 9 * (np.ones((3, 3)) - np.eye(3))).tolist()}, "semi-definite"),
        ({"parameters": NAMES, "matrix": [["a"] * 3] * 3}, "numbers"),
        ({"parameters": NAMES, "matrix": (np.ones((3, 3)) - np.eye(3)).tolist()}, "no variance"),
        ({"parameters": ["camera.zoom"], "matrix": [[1.0]]}, "camera.zoom"),
        ({"parameters": ["camera.fx"] * 2, "matrix": [[1.0, 0], [0, 1.0]]}, "twice"),
        ({"parameters": NAMES, "matrix": (1e30 * SOUND).tolist()}, "nothing is known of it"),
        ({"parameters": 5, "matrix": [[1.0]]}, "parameters"),
        ([1, 2], "object"),
    ],
)
def test_a_covariance_that_is_none_is_said_and_the_budget_names_what_is_missing(
    content: Content, ball: Any, covariance: Any, says: str
) -> None:
    from scanner.uncertainty import _calibration  # noqa: PLC0415

    rig = calibration_from_dict({**content, "covariance": covariance}, name="rig.json")
    (warning,) = rig.warnings
    assert says in warning
    assert "missing from their budgets" in warning
    scan = build_scan(ball.decoded(0.02), rig)
    assert depth_spread(rig, scan, "y") is None
    told = _calibration(scan, rig, "y")
    assert (told.mm, told.says) == (None, "the calibration has no covariance that can be read")


def test_a_sound_covariance_passes_and_counts(content: Content, ball: Any) -> None:
    rig = calibration_from_dict({**content, "covariance": {"parameters": NAMES, "matrix": SOUND.tolist()}})
    (warning,) = rig.warnings
    assert "says nothing of camera.fy, camera.cx" in warning
    assert warning.endswith("rotation.z, translation.z: scans' budgets take these as exact")
    names = [*NAMES, *warning.partition(" of ")[2].partition(":")[0].split(", ")]
    whole = np.zeros((len(names), len(names)))
    whole[: len(NAMES), : len(NAMES)] = SOUND
    complete = {"parameters": names, "matrix": whole.tolist()}
    assert calibration_from_dict({**content, "covariance": complete}).warnings == ()
    assert 0 < (depth_spread(rig, build_scan(ball.decoded(0.02), rig), "y") or 0) < 5


def test_the_report_of_a_scan_and_check_config_say_it(
    content: Content, ball: Any, tmp_path: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    scaled(content, 0.02)
    path, rig_file = tmp_path / "near.json", tmp_path / "rig.toml"
    path.write_text(json.dumps(content))
    rig_file.write_text(
        f'camera.driver = "simulated"\nprojector.driver = "simulated"\nrig.calibration = "{path.name}"\n'
    )
    rig = load_calibration(path)
    scan = build_scan(ball.decoded(0.02), ball.calibration)
    assert watched(scan, rig, SimpleNamespace(extra={})).report["warnings"] == list(rig.warnings)  # type: ignore[arg-type]
    assert cli.main(["check-config", str(rig_file)]) == 0
    assert "warning: " in (told := capsys.readouterr().err)
    assert "multiply the translation by 1000" in told
    scaled(content, 0.02)
    path.write_text(json.dumps(content))
    assert cli.main(["check-config", str(rig_file)]) == 1
    assert "nothing can be triangulated" in capsys.readouterr().err
