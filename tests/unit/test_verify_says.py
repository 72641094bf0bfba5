"""What `fringed calibrate verify` says of arguments that do not fit, and of figures that are no test by a norm."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scanner.calibration.detection import charuco_board
from scanner.calibration.markers import markers_in, of_another_kind
from scanner.calibration.targets import parse_target
from scanner.calibration.verified import Wanted, verified
from scanner.calibration_id import content_id
from scanner.scan import load_scan
from service.cli import main
from tests.unit.test_calibration_verification import ball, board, save
from tests.unit.test_figure_spread import ball as ball_of_rig
from tests.unit.test_figure_spread import rig
from tests.unit.test_figure_spread import save as save_of_rig


def said(capsys: pytest.CaptureFixture[str]) -> str:
    shown = capsys.readouterr()
    return " ".join((shown.out + shown.err).split())


def test_arguments_that_do_not_fit_are_told_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = str(save(tmp_path / "board", board(0.02)))
    for words in ([], ["--flat"]):
        assert main(["calibrate", "verify", folder, "--length", "240", *words]) == 2
        assert "--length is how long a target's longest row was measured to be: give --target" in said(capsys)
    for edge, ends in (("500,300,60,20", "column 559 and row 319"), ("100,10,80,50", "column 179 and row 59")):
        assert main(["calibrate", "verify", folder, "--edge", edge]) == 1
        assert f"--edge {edge} reaches to {ends}, and the scan's picture ends at 159 and 119" in said(capsys)


def test_size_is_called_by_its_norm_and_one_position_no_acceptance_test(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = [str(save(tmp_path / name, ball(noise_mm=noise))) for name, noise in (("one", 0.01), ("two", 0.011))]
    assert main(["calibrate", "verify", folders[0], "--sphere", "49.9"]) == 0
    shown = said(capsys)
    assert "probing size PS 0.101 +- unknown mm, VDI/VDE 2634-2, measured less the stated 49.9 mm" in shown
    assert "one scan is one position, and no acceptance test: by VDI/VDE 2634-2" in shown
    assert main(["calibrate", "verify", *folders, "--sphere", "49.9"]) == 0
    assert "2 scans are 2 positions at most, and no acceptance test" in said(capsys)
    assert main(["calibrate", "verify", *folders, "--sphere", "49.9", "--repeat"]) == 0
    assert "2 scans of one scene are one position, and no acceptance test" in said(capsys)


def test_a_calibration_that_was_edited_makes_no_points_anew(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def edited(**changes: Any) -> dict[str, Any]:
        content = rig()
        content["id"] = content_id(content)
        return {**content, **changes}

    name = edited()["id"]
    save_of_rig(tmp_path / "a", *ball_of_rig(), name)
    file = tmp_path / "a" / "capture" / "calibration.json"
    lens = {**rig()["camera"], "matrix": [[303, 0, 80], [0, 300, 60], [0, 0, 1]]}
    surer = {**rig()["covariance"], "matrix": [[0.0, 0.0], [0.0, 1e-9]]}
    for changes, words in (
        ({}, "expanded uncertainty, k = 2"),
        ({"covariance": surer}, "edited by hand? What is made with it now rests on what it says now"),
        ({"camera": lens}, f"the scan's points were not made by calibration {name} as it stands"),
    ):
        file.write_text(json.dumps(edited(**changes)))
        assert main(["calibrate", "verify", str(tmp_path / "a"), "--sphere", "120"]) == 0
        shown = said(capsys)
        assert words in shown
        assert ("edited by hand" in shown) == ("covariance" in changes)


@pytest.mark.parametrize(("method", "known"), [("pmp", True), ("mcp", False), ("gray", False)])
def test_points_that_err_together_have_no_uncertainty(
    method: str, known: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = rig()
    content["id"] = content_id(content)
    save_of_rig(tmp_path / "a", *ball_of_rig(), content["id"])
    (tmp_path / "a" / "capture" / "calibration.json").write_text(json.dumps(content))
    report = tmp_path / "a" / "report.json"
    made = {"decoder": {}, "capture": {"method": method}}
    report.write_text(json.dumps({**json.loads(report.read_text()), **made}))
    assert main(["calibrate", "verify", str(tmp_path / "a"), "--sphere", "120", "--json"]) == 0
    one = json.loads(capsys.readouterr().out)["scans"][0]
    assert (one["sphere"]["uncertainty"]["diameter_mm"]["expanded"] is not None) == known
    assert (one["unknown"] is None) == known
    assert known or "err together" in one["unknown"]


def test_an_error_is_no_surer_than_what_it_is_measured_against(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = str(tmp_path / "a")
    content = rig()
    content["id"] = content_id(content)
    save_of_rig(tmp_path / "a", *ball_of_rig(), content["id"])
    (tmp_path / "a" / "capture" / "calibration.json").write_text(json.dumps(content))
    found = []
    for given in ("120", "120:0", "120:0.5"):
        assert main(["calibrate", "verify", folder, "--sphere", given, "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out)["scans"][0]["sphere"]["uncertainty"])
    exact, none, given = (one["size_mm"] for one in found)
    assert exact == none == found[0]["diameter_mm"]
    rim = exact.get("rim", 0.0)
    assert given["expanded"] - rim == pytest.approx(np.hypot(exact["expanded"] - rim, 2 * 0.5))
    assert given["reference"] == 0.5
    assert {**given, "expanded": 0, "reference": 0} == {**exact, "expanded": 0, "reference": 0}
    assert found[2]["diameter_mm"] == found[0]["diameter_mm"]
    assert main(["calibrate", "verify", folder, "--sphere", "120:0.5"]) == 0
    assert "and the points; of an error, what it is measured against" in said(capsys)
    for wrong in ("nan", "120:nan", "120:-1", "120:130", "x", "120:", "0.01", "1e9"):
        assert main(["calibrate", "verify", folder, "--sphere", wrong]) == 2
        assert "--sphere: " in capsys.readouterr().err


def test_a_chessboard_with_markers_is_a_charuco_board(tmp_path: Path) -> None:
    board_with, chess = parse_target("charuco:10x7:30"), parse_target("chessboard:9x6:30")
    picture = cv2.copyMakeBorder(charuco_board(board_with).generateImage((600, 420)), 40, 40, 40, 40, 0, value=255)
    assert markers_in(picture) == 35
    words = of_another_kind(picture, chess)
    assert words is not None
    assert "35 ArUco markers are in the picture" in words
    assert "charuco:10x7:30" in words
    assert of_another_kind(picture, board_with) is None
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]] / 2.0
    folder = save(tmp_path / "target", np.stack((u, v, np.full(u.shape, 700.0)), axis=-1), picture.astype(np.float32))
    for described, warned in ((chess, [words]), (board_with, [])):
        assert verified(folder, load_scan(folder), Wanted(target=described))["warnings"] == warned
    y, x = np.mgrid[:420, :600] // 60
    plain = np.where((x + y) % 2, 235, 20).astype(np.uint8)
    assert of_another_kind(cv2.copyMakeBorder(plain, 40, 40, 40, 40, 0, value=255), chess) is None
