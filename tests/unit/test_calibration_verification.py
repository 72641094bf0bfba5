"""Features measured in made-up scans: flatness, a sphere, a length and repeatability."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scanner.calibration import figure_spread
from scanner.calibration.one_scene import Repeat, made_otherwise, require_one_scene
from scanner.calibration.targets import parse_target
from scanner.calibration.verification import flat_board, local_point, repeatability, sphere, target_length
from scanner.calibration.verified import Wanted, verified
from scanner.capture import CaptureHeader
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, ProjectorSize
from scanner.scan import Scan, load_scan
from service.cli import main
from service.commands.verify_words import errors_of, show, warnings_in
from tests.unit.test_calibration_marks import PLACES, field

HEIGHT, WIDTH = 120, 160


def board(noise_mm: float = 0.0, bow_mm: float = 0.0, seed: int = 0) -> np.ndarray:
    """(H, W, 3) mm: 160 x 120 mm, tilted by 20 degrees at 500 mm; noise along its normal."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    u, v = x - 79.5, y - 59.5
    w = np.random.default_rng(seed).normal(0, noise_mm, u.shape) + bow_mm * (u**2 + v**2) / (80**2 + 60**2)
    turn = np.asarray(cv2.Rodrigues(np.radians([0.0, 20.0, 0.0]))[0])
    return np.stack((u, v, w), axis=-1) @ turn.T + np.array([0.0, 0.0, 500.0])


def ball(radius: float = 25.0, noise_mm: float = 0.0) -> np.ndarray:
    """(H, W, 3) mm: a sphere's near side before a wall, with pixels between that have nothing."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    u, v = 0.5 * (x - 79.5), 0.5 * (y - 59.5)
    away = u**2 + v**2
    r = radius + np.random.default_rng(1).normal(0, noise_mm, u.shape)
    with np.errstate(invalid="ignore"):
        z = np.where(away < (0.9 * radius) ** 2, 400 - np.sqrt(r**2 - away), 460.0)
    points = np.stack((u, v, z), axis=-1)
    points[(away > (0.9 * radius) ** 2) & (away < (1.1 * radius) ** 2)] = np.nan
    return points


def test_flat_board_is_as_flat_as_its_noise() -> None:
    found = flat_board(board(noise_mm=0.05))
    assert found.rms_mm == pytest.approx(0.05, rel=0.03)
    # 99.7 % of a Gaussian lie within 5.94 sigma.
    assert found.flatness_mm == pytest.approx(5.94 * 0.05, rel=0.05)
    assert found.tilt_deg == pytest.approx(20, abs=0.01)
    assert found.distance_mm == pytest.approx(500 * np.cos(np.radians(20)), abs=0.05)
    assert abs(found.bow_mm) < 0.01
    assert found.used > 0.999


def test_bow_is_not_taken_for_noise() -> None:
    found = flat_board(board(noise_mm=0.01, bow_mm=0.4))
    # The rim is farther than the middle, whichever way round the fit takes the board.
    assert found.bow_mm == pytest.approx(-0.4, rel=0.05)
    assert flat_board(board(noise_mm=0.01, bow_mm=-0.4)).bow_mm == pytest.approx(0.4, rel=0.05)
    assert found.flatness_mm > 0.3


def test_what_is_no_board_is_told_apart() -> None:
    cloud = board(noise_mm=0.02)
    cloud[:40, :60] += np.array([0.0, 0.0, -30.0])
    cloud[100:] = np.nan
    found = flat_board(cloud)
    assert found.rms_mm == pytest.approx(0.02, rel=0.05)
    assert found.used == pytest.approx(1 - 2400 / 16000, abs=0.001)
    with pytest.raises(DecodeError, match="too few"):
        flat_board(np.full((50, 50, 3), np.nan))


def test_sphere_form_and_size() -> None:
    found = sphere(ball(noise_mm=0.03), 50.0)
    assert found.diameter_mm == pytest.approx(50.0, abs=0.02)
    assert found.size_mm == pytest.approx(found.diameter_mm - 50.0)
    assert found.rms_mm == pytest.approx(0.03, rel=0.05)
    # 99.7 % and 95 % of a Gaussian lie within 5.94 and 3.92 sigma.
    assert (found.form_mm, found.shell_mm) == pytest.approx((5.94 * 0.03, 3.92 * 0.03), rel=0.07)
    assert found.centre_mm == pytest.approx((0, 0, 400), abs=0.02)
    assert 0.2 < found.used < 0.6
    larger = sphere(ball(), 49.9)
    assert larger.size_mm == pytest.approx(0.1, abs=0.002)
    assert sphere(ball()[40:80, 60:100]).size_mm is None


def test_points_off_a_ball_that_no_figure_contains_are_warned_of(tmp_path: Path) -> None:
    spoilt = ball(noise_mm=0.03)
    seen = np.linalg.norm(spoilt[..., :2], axis=2) < 20
    spoilt[:60][seen[:60], 2] -= np.where(np.arange(seen[:60].sum()) % 10, 0, 15)
    folders = [save(tmp_path / name, xyz) for name, xyz in (("whole", ball(noise_mm=0.03)), ("spoilt", spoilt))]
    found = [verified(folder, load_scan(folder), Wanted(sphere_mm=50.0)) for folder in folders]
    assert found[0]["warnings"] == []
    (said,) = found[1]["warnings"]
    assert found[1]["sphere"]["left_out"] == pytest.approx(0.05, abs=0.02)
    assert "of the points within the ball's outline lie off it" in said
    assert "no PF and PS of VDI/VDE 2634-2" in said


def test_small_sphere_before_a_wide_wall() -> None:
    found = sphere(ball(radius=12.0, noise_mm=0.01), 24.0)
    assert found.used < 0.1
    assert found.size_mm == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(("stated", "other"), [(50.0, 48.0), (48.0, 50.0)])
def test_of_two_balls_the_one_that_was_stated_is_measured_and_the_other_named(stated: float, other: float) -> None:
    # One beside the other, and farther away than its wall.
    both = np.concatenate((ball(noise_mm=0.03), ball(24.0, noise_mm=0.03) + np.array([85.0, 0.0, 0.0])), axis=1)
    found = sphere(both, stated)
    assert found.diameter_mm == pytest.approx(stated, abs=0.02)
    assert found.another_mm == pytest.approx(other, abs=0.02)
    assert sphere(ball(noise_mm=0.03), 50.0).another_mm is None


def test_a_slice_of_a_ball_is_no_ball_of_metres() -> None:
    # 2 mm of a ball of 50 stand out of a wall.
    shallow = ball(noise_mm=0.03)
    shallow[..., 2] = np.minimum(shallow[..., 2], 377.0)
    with pytest.raises(DecodeError) as refused:
        sphere(shallow, 200.0)
    assert not re.search(r"there is one of \d{4}", str(refused.value))


def test_sphere_of_another_size_is_not_found() -> None:
    with pytest.raises(DecodeError, match="no sphere"):
        sphere(board()[::2, ::2], 20.0)


def test_a_sphere_of_too_few_points_is_no_sphere_of_another_size() -> None:
    # A wider wall: the scan has points enough, the ball has not.
    thin = np.pad(ball(noise_mm=0.03), ((0, 0), (0, 300), (0, 0)), constant_values=np.nan)[::4, ::4]
    y, x = np.nonzero(np.isnan(thin).all(axis=2))
    thin[y, x] = np.stack((2.0 * x - 40, 2.0 * y - 30, np.full(x.size, 460.0)), axis=-1)
    with pytest.raises(DecodeError, match=r"[1-9]\d+ points of the sphere of 50 mm are too few .* 500 are needed"):
        sphere(thin, 50.0)


@pytest.mark.parametrize(("given", "hint"), [(25.0, "not its radius"), (40.0, "scale of the calibration")])
def test_a_sphere_of_another_size_is_named_with_its_own(given: float, hint: str) -> None:
    with pytest.raises(DecodeError, match=rf"no sphere of {given:g} mm.* there is one of 50\.0") as refused:
        sphere(ball(noise_mm=0.03)[::2, ::2], given)
    assert hint in refused.value.hint


def test_repeatability_is_the_noise_and_the_drift() -> None:
    scans = [board(0.04, seed=k) for k in range(8)]
    steep = np.cos(np.radians(20))
    found = repeatability(scans)
    # Noise along the board's normal: its depth part.
    assert found.depth_mm == pytest.approx(0.04 * steep, rel=0.03)
    assert found.drift_mm < 0.002
    moved = repeatability([*scans, scans[0] + np.array([0.0, 0.0, 0.9])])
    assert moved.drift_mm == pytest.approx(0.8, abs=0.01)
    with pytest.raises(DecodeError, match="different sizes"):
        repeatability([scans[0], scans[0][:50]])
    with pytest.raises(DecodeError, match="point in every scan"):
        repeatability([scans[0], np.full_like(scans[0], np.nan)])


def test_repeatability_of_few_scans_is_that_of_many_and_pixels_on_depth_edges_have_no_part_in_it() -> None:
    scans = [board(0.04, seed=k) for k in range(8)]
    every = np.stack([scan[..., 2] for scan in scans])
    few, many = repeatability(scans[:3]), repeatability(scans)
    assert many.depth_mm == pytest.approx(float(np.sqrt(np.nanmean(every.var(axis=0, ddof=1)))), rel=1e-6)
    assert few.expanded_mm is not None
    assert few.depth_mm == pytest.approx(many.depth_mm, abs=2 * few.expanded_mm)
    edge = [scan.copy() for scan in scans]
    edge[0][40, 10:20] += 30.0
    assert repeatability(edge).depth_mm == pytest.approx(many.depth_mm, rel=1e-3)
    assert repeatability(edge).points == many.points - 10


def test_point_between_pixels_is_on_the_surface() -> None:
    cloud = board()
    point = local_point(cloud, np.array([50.25, 40.75]))
    assert point == pytest.approx(
        0.25 * (0.75 * cloud[40, 50] + 0.25 * cloud[40, 51]) + 0.75 * (0.75 * cloud[41, 50] + 0.25 * cloud[41, 51])
    )
    assert local_point(cloud, np.array([2.0, 40.0])) is None
    cloud[30:45] = np.nan
    assert local_point(cloud, np.array([50.0, 40.0])) is None


def scanned_target() -> tuple[np.ndarray, np.ndarray]:
    """Albedo (H, W) of a chessboard of 12 mm squares, and its points at 4 px a mm, flat at 300 mm."""
    y, x = np.mgrid[:440, :560]
    squares = ((x - 40) // 48 + (y - 40) // 48) % 2 == 0
    inside = (x >= 40) & (x < 520) & (y >= 40) & (y < 376)
    albedo = cv2.GaussianBlur(np.where(inside & squares, 60.0, 200.0).astype(np.float32), (0, 0), 0.8)
    return albedo, np.stack((x / 4, y / 4, np.full(x.shape, 300.0)), axis=-1)


def test_length_between_the_ends_of_a_row() -> None:
    albedo, xyz = scanned_target()
    target = parse_target("chessboard:9x6:12")
    assert target_length(albedo, xyz, target).error_mm == pytest.approx(0.0, abs=0.01)
    assert target_length(albedo, 1.001 * xyz, target, 96.0).error_mm == pytest.approx(0.096, abs=0.01)
    with pytest.raises(DecodeError, match="not found"):
        target_length(albedo, xyz, parse_target("chessboard:7x4:12"))
    xyz[:, :120] = np.nan
    with pytest.raises(DecodeError, match="no scanned surface"):
        target_length(albedo, xyz, target)


def test_scans_that_do_not_repeat_each_other_are_told_apart() -> None:
    """By noise alone nothing is said; a twentieth of a millimetre, three times the noise, is; a hundredth of the
    distance is another scene, and its scan is named."""
    sigma = np.full((HEIGHT, WIDTH), 0.02, np.float32)
    scans = [Repeat(f"s{k}", board(0.02, seed=k), sigma) for k in range(3)]
    assert require_one_scene(scans) == []
    moved = replace(scans[2], xyz=scans[2].xyz + np.array([0, 0, 0.2]))
    (said,) = require_one_scene([*scans[:2], moved])
    assert said.startswith("s2 differs from the others by more than noise: 80%")
    assert require_one_scene([*scans[:2], replace(moved, sigma_z=None)]) == [], "without sigmas nothing tells"
    corner = scans[1].xyz.copy()
    corner[:40, :60, 2] += 20.0
    with pytest.raises(DecodeError, match=r"s1 shows another scene than s0, .*: 12% of the pixels"):
        require_one_scene([scans[0], replace(scans[1], xyz=corner)])
    with pytest.raises(DecodeError, match=r"s1 shows another scene than the others"):
        require_one_scene([scans[0], replace(scans[1], xyz=corner), scans[2]])


def of_a_board(**more: Any) -> dict[str, Any]:
    """Of one board, as `verify` writes it: of the figures' U nothing but the points' part is known."""
    figures = {"flatness_mm": 0.39004, "rms_mm": 0.06391, "distance_mm": 1346.00011, "used": 0.52, "noise_mm": 0.3}
    names = ("flatness_mm", "rms_mm", "distance_mm")
    spreads = {name: {"random": 0.002, "calibration": None, "expanded": None} for name in names}
    spreads["noise_mm"] = {"random": 0.002, "calibration": 0.003, "expanded": 0.0072}
    beyond = {"flatness_mm": {"mm": 0.249, "least_mm": None, "most_mm": None}}
    one = {
        "scan": "b1",
        "flat": {**figures, "uncertainty": spreads, "beyond": beyond},
        "coverage_factor": 2.0,
        "unknown": "no covariance",
        "systematic_besides": {"mm": 0.0, "calibration": True, "unknown": ["calibration", "response"]},
    }
    return {"scans": [{**one, **more}]}


def test_what_is_unknown_is_no_zero_and_has_no_digits(capsys: pytest.CaptureFixture[str]) -> None:
    found = of_a_board()
    worst = max(errors_of(found), key=lambda error: error.mm)
    show(found, worst)
    shown = capsys.readouterr()
    assert "note: for uncertainties a calibration needs a covariance, which fringed calibrate solve" in shown.err
    said = " ".join(shown.out.split())
    assert "noise of normal errors 99.7 % of the points span 5.9 sigmas" in said
    assert "systematic unknown (calibration, response); in none of the measured figures: b1" in said
    assert "0.390 +- unknown 0.064 +- unknown 1346.000 +- unknown 0.5200 0.3000 +- 0.0072" in said
    assert "has 0.3000 +- 0.0072 by noise, beyond it 0.249 +- unknown: b1" in said
    assert "largest error 0.390 +- unknown mm, the flatness of b1, as measured" in said
    besides = {"mm": 0.0163, "calibration": True, "unknown": ["calibration"]}
    show(of_a_board(systematic_besides=besides), worst)
    said = " ".join(capsys.readouterr().out.split())
    assert "systematic at least +-0.033 mm of depth (k = 2), and what is unknown (calibration); in none of" in said
    for least, words in ((0.2184, "beyond it 0.249 +- 0.031: b1"), (0.0, "beyond it 0.28 at most: b1")):
        known = of_a_board()
        known["scans"][0]["flat"]["uncertainty"]["flatness_mm"]["expanded"] = 0.02
        known["scans"][0]["flat"]["beyond"]["flatness_mm"] |= {"least_mm": least, "most_mm": 0.277}
        show(known, worst)
        of = "0.390 +- 0.020 mm, VDI/VDE 2634-2, 99.7 % of the points; a perfect board has 0.3000 +- 0.0072 by noise, "
        assert of + words in " ".join(capsys.readouterr().out.split())


def test_what_is_said_of_all_scans_is_said_once(capsys: pytest.CaptureFixture[str]) -> None:
    ones = [of_a_board(scan=name)["scans"][0] for name in ("b1", "b2", "b3")]
    for one, mm in zip(ones, (0.016, 0.021, 0.017), strict=True):
        one["systematic_besides"] = {"mm": mm, "calibration": True, "unknown": ["calibration"]}
    repeats = {
        "depth_mm": 0.1,
        "drift_mm": 0.0,
        "scans": 3,
        "points": 9,
        "uncertainty": {"depth_mm": {"expanded": 0.1}},
    }
    for repeated, lines in ((None, 3), (repeats, 1)):
        show({"scans": ones, "repeatability": repeated}, None)
        said = capsys.readouterr().out
        assert len(re.findall(r"^\+-", said, re.M)) == 1
        assert len(re.findall(r"^systematic", said, re.M)) == lines
        assert "up to 0.0040 mm: all scans" in said
    assert "at least +-0.042 mm of depth (k = 2), and what is unknown (calibration)" in said
    assert ": all scans, at most" in said


def test_a_board_of_half_a_scans_points_is_warned_of(tmp_path: Path) -> None:
    spoilt = board(0.02)
    spoilt[60:, :, 2] += 25.0
    spoilt[:3, :, 2] = np.nan
    folder = save(tmp_path / "b1", spoilt)
    (said,) = warnings_in({"scans": [{"scan": "b1", **verified(folder, load_scan(folder), Wanted(flat=True))}]})
    assert said.startswith("b1: the board's figures are of 51% of the scan's points")


# --- commands -------------------------------------------------------------------------------------------------------


def save(
    folder: Path, xyz: np.ndarray | None, albedo: np.ndarray | None = None, method: str = "", **maps: np.ndarray
) -> Path:
    shape = albedo.shape if albedo is not None else xyz.shape[:2] if xyz is not None else maps["rows"].shape
    plain = np.full(shape, 120, np.float32)
    scan = Scan(
        rows=maps.get("rows", np.ones(shape, np.float32)),
        columns=None,
        sigma_rows=None,
        sigma_columns=None,
        sigma_z=None,
        xyz=None if xyz is None else xyz.astype(np.float32),
        confidence=np.ones(shape, np.float32),
        albedo=plain if albedo is None else albedo,
        modulation=plain,
        reason=np.zeros(shape, np.uint8),
        stripes=None,
        peaks=maps.get("peaks"),
        report={"format": "fringed-report", "version": 1, **({"decoder": {"method": method}} if method else {})},
    )
    folder.mkdir()
    np.savez(folder / "scan.npz", **scan.arrays())  # what `verify` reads; no cloud and no picture
    (folder / "report.json").write_text(json.dumps(scan.report))
    return folder


def test_verify_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figure_spread, "POINTS", 500)
    monkeypatch.setattr(figure_spread, "DRAWS", 10)  # what they tell is test_figure_spread's
    boards = [str(save(tmp_path / f"b{k}", board(0.02, seed=k))) for k in range(3)]
    assert main(["calibrate", "verify", *boards, "--flat", "--repeat", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert len(document["scans"]) == 3
    repeats = document["repeatability"]
    assert repeats["scans"] == 3
    # Noise of single pixels, known by 19,000 of them: 2 / sqrt(2 x 2 x 19,000).
    assert repeats["uncertainty"]["depth_mm"]["expanded"] == pytest.approx(repeats["depth_mm"] / 138, rel=0.2)
    assert main(["calibrate", "verify", *boards[:2], "--repeat"]) == 0
    said = capsys.readouterr().out
    assert "+- unknown: standard deviation of 2 scans (k = 2)" in said
    assert "from three scans on" in said
    assert document["largest_error_mm"] == pytest.approx(0.119, rel=0.1)
    assert document["largest_error_of"].startswith(f"the flatness of {tmp_path / 'b'}")
    assert (repeats["warnings"], document["scans"][0]["warnings"]) == ([], [])
    assert main(["calibrate", "verify", boards[0], "--flat", "--tolerance", "0.05"]) == 1
    shown = capsys.readouterr()
    assert "0.05 mm are allowed" in shown.err
    assert "flatness mm" in shown.out
    for words in ([], ["--length", "3"], ["--repeat"]):
        assert main(["calibrate", "verify", boards[0], *words]) == 2
    copy = str(save(tmp_path / "copy", board(0.02, seed=0)))
    anew = save(tmp_path / "anew", board(0.02, seed=0))
    for folder, told in ((anew, "two"), (tmp_path / "b0", "one")):
        header = CaptureHeader(PatternSequence(ProjectorSize(1152, 864), McpPattern()), CameraFormat(160, 120, 8))
        (folder / "capture").mkdir()
        (folder / "capture" / "capture.json").write_text(
            json.dumps(replace(header, id=told, frames=("0.png",)).as_dict())
        )
    for again, words in (
        (boards[0] + "/../b0", "is given twice"),
        (copy, "is a copy of"),
        (str(anew), "captured anew, which only simulated rigs do"),
    ):
        capsys.readouterr()
        assert main(["calibrate", "verify", boards[0], boards[1], again, "--repeat"]) == 2
        said = " ".join(capsys.readouterr().err.split())
        assert words in said
        assert ("?seed=2" in said) == ("anew" in words)
    assert main(["calibrate", "verify", boards[0], "--edge", "40,10,80,100", "--tolerance", "1"]) == 2
    far = str(save(tmp_path / "far", board(0.02, seed=7) + np.array([0, 0, 30.0])))
    capsys.readouterr()
    assert main(["calibrate", "verify", boards[0], far, "--repeat"]) == 1
    assert "shows another scene than" in capsys.readouterr().err
    ball_folder = str(save(tmp_path / "ball", ball(noise_mm=0.01)))
    assert main(["calibrate", "verify", ball_folder, "--sphere", "50", "--tolerance", "0.2"]) == 0
    shown = capsys.readouterr()
    assert "not told, in none of the measured figures" in " ".join(shown.out.split())
    assert "+- unknown" in shown.out
    assert "99.7 % of the points; what noise makes of it is not known" in " ".join(shown.out.split())
    assert "whether it is with its uncertainty is not known" in shown.err
    budget = {"format": "fringed-report", "version": 1, "uncertainty": {"systematic_mm": 0.29}}
    (tmp_path / "ball" / "report.json").write_text(json.dumps(budget))
    assert main(["calibrate", "verify", ball_folder, "--sphere", "50", "--tolerance", "0.2"]) == 0
    shown = capsys.readouterr()
    assert "+-0.58 mm of depth (k = 2), in none of the measured figures" in " ".join(shown.out.split())
    albedo, xyz = scanned_target()
    row = str(save(tmp_path / "target", xyz, albedo.astype(np.float32)))
    capsys.readouterr()
    assert main(["calibrate", "verify", row, "--target", "chessboard:9x6:12", "--length", "95.5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["scans"][0]["length"]["error_mm"] == pytest.approx(0.5, abs=0.02)
    # The scene has one edge in depth: 10 mm between the left of column 80 and the right.
    stepped = board(0.02)
    stepped[:, 80:, 2] += 10.0
    folder = str(save(tmp_path / "step", stepped))
    capsys.readouterr()
    assert main(["calibrate", "verify", folder, "--edge", "40,10,80,100", "--json"]) == 0
    edge = json.loads(capsys.readouterr().out)["scans"][0]["edge"]
    assert edge["width_px"] < 1.5
    assert edge["step_mm"] == pytest.approx(10.0, abs=0.1)
    assert main(["calibrate", "verify", folder, "--edge", "40,10,80"]) == 2
    empty = str(save(tmp_path / "rows", None, np.full((40, 50), 9, np.float32)))
    assert main(["calibrate", "verify", empty, "--flat"]) == 1
    assert "has no points" in capsys.readouterr().err


def test_marks_are_kept_and_verified(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    albedo, xyz = field()
    before, after = (
        save(tmp_path / "before", xyz, albedo),
        save(tmp_path / "after", xyz + np.array([0, 0, 0.4]), albedo),
    )
    file = tmp_path / "marks.json"
    words = ["calibrate", "marks", str(before), "-o", str(file)]
    at = [word for x, y in PLACES for word in ("--at", f"{x:g},{y:g}")]
    assert main([*words, *at, "--plate", "140,100,120,60"]) == 0
    assert "mark 3" in capsys.readouterr().out
    assert main([*words, *at]) == 2
    assert main([*words, "--force", "--at", "3"]) == 2
    assert main([*words, "--force", *at[:4]]) == 1
    capsys.readouterr()
    assert main(["calibrate", "verify", str(before), "--marks", str(file), "--tolerance", "0.05"]) == 0
    capsys.readouterr()
    assert main(["calibrate", "verify", str(after), "--marks", str(file), "--tolerance", "0.1", "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["largest_error_mm"] == pytest.approx(0.4, abs=0.02)
    assert main(["calibrate", "verify", str(after), "--marks", str(file)]) == 0
    assert "seen" in capsys.readouterr().out
    alone = tmp_path / "plate.json"
    assert main(["calibrate", "marks", str(before), "-o", str(alone), "--plate", "140,100,120,60"]) == 0
    capsys.readouterr()
    assert main(["calibrate", "verify", str(after), "--marks", str(alone)]) == 0
    shown = capsys.readouterr().out
    assert "plate offset mm" in shown
    assert "seen" not in shown


def test_scans_that_were_made_otherwise_are_named() -> None:
    def scan(name: str, method: str = "pmp", calibration: str = "a") -> Repeat:
        report = {"decoder": {"method": method}, "capture": {"repeat": 1}, "rig": {"calibration": calibration}}
        return Repeat(name, board(0.02), None, report)

    assert made_otherwise([scan("s1"), scan("s2")]) == []
    (said,) = made_otherwise([scan("s1"), scan("s2", "gray"), scan("s3")])
    assert "method pmp" in said
    assert "(s1, s3); gray" in said
    (said,) = made_otherwise([scan("s1"), scan("s2", calibration="b")])
    assert "calibration a" in said


def test_a_board_that_is_printed_is_said_to_be(tmp_path: Path) -> None:
    folder = save(tmp_path / "scan", board(0.02))
    plain = load_scan(folder)
    stripes = np.where(np.indices(plain.shape).sum(axis=0) % 24 < 12, np.float32(0.2), np.float32(1.0))
    for scan, said in ((plain, False), (replace(plain, albedo=stripes), True)):
        warnings = verified(folder, scan, Wanted(flat=True))["warnings"]
        assert any("the board is printed" in warning for warning in warnings) == said
