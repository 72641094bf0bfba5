"""The adjustment on points made by geometry: what it finds, what it states, and what it refuses and why."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.simulated.rigs import rig as simulated_rig
from drivers.simulated.targets import target_poses
from scanner.calibration.adjustment import Equations, adjust
from scanner.calibration.calibration_file import as_text, calibration_dict, residuals_of
from scanner.calibration.coverage import NOT_MET
from scanner.calibration.lens_slopes import lens_numbers, vector_of
from scanner.calibration.observe import LeftOut, Observation
from scanner.calibration.panel import SIZE, ticks
from scanner.calibration.pictures import HEAD_PX, draw
from scanner.calibration.problem import FLAT, POSES, Length, Problem, State, View
from scanner.calibration.sheet import contradiction, stated_length
from scanner.calibration.solve import Solution, SolveOptions, priors_of, sigmas, solve, thinned
from scanner.calibration.targets import parse_target
from scanner.digits import with_uncertainty
from scanner.errors import CalibrationError
from scanner.geometry import Calibration, calibration_from_dict
from service.commands.calibrate_solve import report
from tests.unit.calibration_bench import TARGET, made_up_rig, observations, poses, view_of

RIG = made_up_rig()
LENGTH = SolveOptions(length=(TARGET.longest_mm, 0.01))
SMALL = parse_target("chessboard:6x4:40")
SMALL_LENGTH = SolveOptions(length=(SMALL.longest_mm, 0.01))


def calibrate(*arguments: object) -> Solution:
    return solve(*arguments, leave_out=False)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def solution() -> Solution:
    return solve(TARGET, observations(RIG, poses()), LENGTH)


def test_finds_the_rig(solution: Solution) -> None:
    state = solution.state
    for found, true in ((state.camera, RIG.camera), (state.projector, RIG.projector)):
        assert np.diag(found.matrix)[:2] == pytest.approx(np.diag(true.matrix)[:2], rel=5e-4)
        assert found.matrix[:2, 2] == pytest.approx(true.matrix[:2, 2], abs=2.0)
    assert state.translation == pytest.approx(RIG.translation, abs=0.3)
    assert solution.left_out == ()
    assert solution.warnings == ()


def test_noise_is_recovered_from_the_residuals(solution: Solution) -> None:
    assert solution.adjusted.sigma_camera == pytest.approx(0.02, rel=0.1)
    assert solution.adjusted.projector_factor == pytest.approx(1.0, rel=0.1)


def test_errors_lie_within_stated_sigmas() -> None:
    within = []
    for seed in range(8):
        found = calibrate(SMALL, observations(RIG, poses(8, seed=seed), target=SMALL, seed=seed), SMALL_LENGTH)
        spread = sigmas(found.adjusted)
        for side, lens, true in (
            ("camera", found.state.camera, RIG.camera),
            ("projector", found.state.projector, RIG.projector),
        ):
            within.append(np.abs(lens_numbers(lens) - lens_numbers(true))[:4] / spread[side][:4])
        within.append(np.abs(found.state.translation - RIG.translation) / spread["translation"])
    ratios = np.concatenate(within)
    # 88 errors, correlated within a rig: 95 % are expected within two sigmas, and they must not be all far within.
    assert np.mean(ratios < 2) > 0.85
    assert np.mean(ratios < 0.5) < 0.7


def test_held_out_views_are_predicted(solution: Solution) -> None:
    assert np.isfinite(solution.held_out.errors).all()
    assert 0.005 < np.median(solution.held_out.errors) < 0.02


def test_errors_common_to_a_view_widen_the_covariance() -> None:
    generator = np.random.default_rng(5)
    calm, spoilt = observations(RIG, poses(8), target=SMALL), []
    for one in calm:
        # As by a sheet that lies differently each time: far more than points scatter, the same over the whole view.
        off = generator.normal(0, 0.05, 2)
        moved = one.view.camera + off * (one.view.camera - one.view.camera.mean(axis=0)) / 150
        spoilt.append(Observation(replace(one.view, camera=moved), *_sizes(one)))
    formal, stated, same = (
        sigmas(solve(SMALL, every, SMALL_LENGTH, leave_out=leave_out).adjusted)["camera"]
        for every, leave_out in ((spoilt, False), (spoilt, True), (calm, True))
    )
    assert (stated > 1.3 * formal).all()
    plain = sigmas(calibrate(SMALL, calm, SMALL_LENGTH).adjusted)["camera"]
    assert (same < 1.5 * plain).all()


def test_jacobian_is_that_of_the_residuals() -> None:
    views = tuple(view_of(RIG, pose, f"v{k}") for k, pose in enumerate(poses(3)))
    problem = Problem(TARGET, RIG.camera.size, RIG.projector.size, views)
    state = State(
        RIG.camera, RIG.projector, RIG.rotation, RIG.translation, np.array([1.001, 0.999, 0.4, -0.3, 0.2]), poses(3)
    )
    equations, x = Equations(problem, (0.02, 1.0)), state.vector()
    dense = equations.evaluate(x)[1]
    rows = slice(0, sum(4 * len(v.ids) for v in views))
    for k in range(POSES + 18):
        step = 1e-6 * max(abs(x[k]), 1e-2)
        ahead, behind = x.copy(), x.copy()
        ahead[k] += step
        behind[k] -= step
        numeric = (equations.evaluate(ahead)[0] - equations.evaluate(behind)[0])[rows] / (2 * step)
        assert np.abs(dense[rows, k] - numeric).max() < 1e-4 * max(np.abs(numeric).max(), 1e-9), k


def test_large_problems_are_thinned(monkeypatch: pytest.MonkeyPatch) -> None:
    views = [one.view for one in observations(RIG, poses(5))]
    assert all(len(view.ids) == 54 for view in thinned(views))
    monkeypatch.setattr("scanner.calibration.solve.MOST_ENTRIES", 4 * 5 * 27 * (POSES + 30))
    assert [len(view.ids) for view in thinned(views)] == [27] * 5


def test_stretched_sheet_is_found() -> None:
    stretched = observations(RIG, poses(6), sheet=(1.0, 1.002, 1.0))
    found = calibrate(TARGET, stretched, LENGTH)
    assert found.state.sheet[1] == pytest.approx(1.002, abs=2e-4)
    assert found.state.translation == pytest.approx(RIG.translation, abs=0.3)


@pytest.mark.parametrize("shape", ["rolled along a diagonal", "saddle"])
def test_a_sheet_bent_in_any_way_is_found(shape: str) -> None:
    x, y = TARGET.points[:, :2].T / float(np.hypot(*TARGET.half_extent))
    depth = 0.4 * ((x + y) ** 2 / 2 if shape != "saddle" else x * x - y * y)
    bent = replace(TARGET, points=TARGET.points + np.outer(depth, (0, 0, 1)))
    found = calibrate(TARGET, observations(RIG, poses(6), target=bent), LENGTH)
    asked = (0.2, 0.0, 0.2) if shape != "saddle" else (0.0, 0.4, 0.0)
    assert found.state.sheet[2:] == pytest.approx(asked, abs=0.02)
    off = np.abs(found.state.translation - RIG.translation) / sigmas(found.adjusted)["translation"]
    assert off.max() < 3
    assert calibration_dict(found)["target"]["twist_mm"] == found.state.sheet[4]


def test_of_a_square_grid_nobody_knows_which_row_was_measured() -> None:
    square = parse_target("chessboard:7x7:30")
    measured = 1.0015 * square.longest_mm  # along y; the pictures are read as if it had been x
    seen = observations(RIG, poses(6), target=square, sheet=(1.0, 1.0015, 1.0))
    found = calibrate(square, seen, SolveOptions(length=(measured, 0.02)))
    off = np.abs(found.state.translation - RIG.translation) / sigmas(found.adjusted)["translation"]
    assert off.max() < 2
    (said,) = [warning for warning in found.warnings if "turned by a quarter" in warning]
    assert re.search(r"stretched by 0\.1[4-6]% more one way than the other", said)
    even = observations(RIG, poses(6), target=square, sheet=(1.0015, 1.0015, 1.0))
    plain = calibrate(square, even, SolveOptions(length=(measured, 0.02)))
    assert not any("turned by a quarter" in warning for warning in plain.warnings)
    assert sigmas(plain.adjusted)["translation"].max() < 0.3 * sigmas(found.adjusted)["translation"].max()


def test_scale_is_the_stated_length_or_unverified(solution: Solution, capsys: pytest.CaptureFixture[str]) -> None:
    plain = calibration_dict(calibrate(TARGET, observations(RIG, poses(6)), SolveOptions(rigid=True)))
    assert plain["scale"] == "unverified"
    stated = calibration_dict(solution)
    assert stated["scale"] == {"reference_mm": 240.0, "sigma_mm": 0.01}
    assert stated["warnings"] == []
    assert all(warning.startswith(NOT_MET) for warning in plain["warnings"])  # of half the poses
    assert (plain["target"]["sigma"], stated["target"]["sigma"]["scale_x"]) == (None, pytest.approx(4e-5, rel=0.3))
    report(solution, stated, Path("rig.json"), None, as_json=False)
    shown = capsys.readouterr().out
    assert "rests on 240.000 +- 0.020 mm (k = 2), adjusted to 240.0" in shown
    assert re.search(r"sheet +scale x \d\.\d+ \+- 0\.\d+, scale y \d\.\d+ \+- 0\.\d+ of its nominal size, bow", shown)
    twice = 2 * sigmas(solution.adjusted)["camera"][0]
    assert f"focal {with_uncertainty(solution.state.camera.matrix[0, 0], twice)}, " in shown
    turn, spread = np.degrees(vector_of(solution.state.rotation)), 2 * np.degrees(sigmas(solution.adjusted)["rotation"])
    assert re.search(rf"rotation +{re.escape(with_uncertainty(turn[0], spread[0]))}, .* degrees, the vector", shown)
    bent = zip(("k1", "k2", "p1", "p2", "k3"), solution.state.projector.distortion, strict=True)
    told = [
        with_uncertainty(v, 2 * e) for (_, v), e in zip(bent, sigmas(solution.adjusted)["projector"][4:], strict=True)
    ]
    assert f"distortion k1 {told[0]}, k2 {told[1]}, p1 {told[2]}, p2 {told[3]}, k3 {told[4]}" in shown
    assert "unverified" not in shown
    longer = calibrate(TARGET, observations(RIG, poses(6)), SolveOptions(length=(240.48, 0.01)))
    assert np.linalg.norm(longer.state.translation) == pytest.approx(1.002 * np.linalg.norm(RIG.translation), rel=5e-4)
    # A scale that nobody verified is a thousandth unsure, and the translation says so.
    unverified = calibrate(TARGET, observations(RIG, poses(6)))
    assert sigmas(unverified.adjusted)["translation"][0] > 5 * sigmas(solution.adjusted)["translation"][0]


def test_a_length_that_contradicts_the_print_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """238 mm on what is 240 mm by its name: 2 mm of which a print (0.24 mm) and the length (0.1 mm) explain 0.26."""
    found = calibrate(TARGET, observations(RIG, poses(6)), SolveOptions(length=(238.0, 0.1)))
    content = calibration_dict(found)
    assert content["warnings"] == list(found.warnings)
    report(found, content, tmp_path / "rig.json", None, as_json=False)
    shown = " ".join(capsys.readouterr().err.split())
    for words in (
        "238.00 +- 0.20 mm, contradicts the target's 240 mm (+- 0.48 mm as prints go; +- is k = 2)",
        "it is 2.00 mm (0.83%) shorter, 7.7 sigmas of both together; the calibration has 238.",
        "state its spacing as it is: 29.750 +- 0.025 mm (k = 2) instead of 30",
        "of the variance of the distance from lens to lens, 2",
    ):
        assert words in shown


@pytest.mark.parametrize(
    ("mm", "sigma", "rigid", "sigmas"),
    [(240.7, 0.1, False, None), (239.1, 0.1, False, 3.5), (239.1, 0.5, False, None), (240.2, 0.05, True, 4.0)],
)
def test_length_and_print_contradict_each_other_from_three_sigmas(
    solution: Solution, mm: float, sigma: float, rigid: bool, sigmas: float | None
) -> None:
    priors = priors_of(SolveOptions(rigid=rigid), TARGET)
    problem = replace(solution.problem, priors=priors, length=Length(*TARGET.longest, mm, sigma))
    found = contradiction(problem, solution.state)
    assert (None if found is None else found.sigmas) == (None if sigmas is None else pytest.approx(sigmas, abs=0.05))
    if found is not None:
        assert ("leave --rigid out" in found.words, "taken as exact" in found.words) == (rigid, rigid)
    assert contradiction(replace(problem, length=None), solution.state) is None


def test_a_length_that_no_printer_makes_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"of 210 mm does not fit the target: .* 240 mm, -12%") as refused:
        stated_length((210.0, 0.1), TARGET)
    assert "26.250 +- 0.025 mm (k = 2) instead of 30 would fit" in str(refused.value.hint)


def test_file_is_read_back_and_its_id_is_its_content(solution: Solution) -> None:
    content = calibration_dict(solution, created="2026-01-01T00:00:00Z")
    read = calibration_from_dict(content)
    assert read.translation == pytest.approx(solution.state.translation)
    assert content["id"] == calibration_dict(solution, created="2027-01-01T00:00:00Z")["id"]
    changed = replace(solution, response={"gamma": 2.2})
    assert calibration_dict(changed)["id"] != content["id"]
    assert calibration_dict(changed)["response"] == {"projector": {"gamma": 2.2}, "camera": None}
    assert len(content["covariance"]["matrix"]) == len(content["covariance"]["parameters"]) == 24
    assert [view["name"] for view in content["residuals"]["views"]] == [f"pose{k:02d}" for k in range(12)]
    assert "[1280, 1024]" in as_text(content)


def test_bad_views_are_named_and_left_out() -> None:
    good = observations(RIG, poses())
    moved = replace(good[3].view, projector=good[3].view.projector + np.array([3.0, 0.0]))
    turned = replace(
        good[7].view, camera=good[7].view.camera[::-1].copy(), projector=good[7].view.projector[::-1].copy()
    )
    mixed = list(good)
    mixed[3] = Observation(moved, *_sizes(good[3]))
    mixed[7] = Observation(turned, *_sizes(good[7]))
    found = calibrate(TARGET, mixed, LENGTH, [LeftOut("dark", "no chessboard in the picture")])
    names = {one.name for one in found.left_out}
    # A board turned by half is the same board: only the moved one contradicts the others.
    assert names == {"dark", "pose03"}
    assert np.linalg.norm(found.state.translation - RIG.translation) < 0.5


def test_other_sizes_are_left_out() -> None:
    mixed = observations(RIG, poses())
    mixed[0] = replace(mixed[0], camera_size=(640, 480))
    found = calibrate(TARGET, mixed, LENGTH)
    assert [one.name for one in found.left_out] == ["pose00"]


def test_outlying_points_do_not_matter() -> None:
    spoilt = observations(RIG, poses())
    for k in (0, 5):
        view = spoilt[k].view
        camera = view.camera.copy()
        camera[::11] += 4.0
        spoilt[k] = Observation(replace(view, camera=camera), *_sizes(spoilt[k]))
    found = calibrate(TARGET, spoilt, LENGTH)
    assert found.state.translation == pytest.approx(RIG.translation, abs=0.4)


def test_totals_are_of_the_same_points_as_the_views_figures(solution: Solution) -> None:
    adjusted = solution.adjusted
    off = adjusted.camera_residuals[0].copy()
    kept = adjusted.kept[0].copy()
    off[3], kept[3] = 50.0, False
    changed = replace(
        solution,
        adjusted=replace(
            adjusted, camera_residuals=(off, *adjusted.camera_residuals[1:]), kept=(kept, *adjusted.kept[1:])
        ),
    )
    found = residuals_of(changed)
    assert found["outliers"] == 1
    for name in ("camera_px", "projector_px", "epipolar_px"):
        of_views = [view[name] for view in found["views"]]
        assert min(of_views) < found[name] < max(of_views)
        squares = [view[name] ** 2 * view["points"] for view in found["views"]]
        assert found[name] ** 2 == pytest.approx(sum(squares) / sum(view["points"] for view in found["views"]))
    picture = cv2.imdecode(np.frombuffer(draw(changed), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.shape == (HEAD_PX + 3 * SIZE[1], 3 * SIZE[0], 3)


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0, 1392, [0, 500, 1000]), (-0.03, 0.03, [-0.02, 0, 0.02]), (1183, 1454, [1200, 1300, 1400])],
)
def test_ticks_are_round_numbers_within_the_axis(low: float, high: float, expected: list[float]) -> None:
    assert ticks(low, high) == pytest.approx(expected)


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_turned_projectors_are_accepted_and_named(degrees: int) -> None:
    rig = _projector_seen(
        RIG,
        lambda p, w, h: {90: (h - 1 - p[:, 1], p[:, 0]), 180: (w - 1 - p[:, 0], h - 1 - p[:, 1])}.get(
            degrees, (p[:, 1], w - 1 - p[:, 0])
        ),
        swap=degrees != 180,
    )
    found = calibrate(TARGET, rig, LENGTH)
    assert any("upside down" in w if degrees == 180 else "turned by" in w for w in found.warnings)
    assert np.linalg.norm(found.state.translation) == pytest.approx(np.linalg.norm(RIG.translation), abs=0.3)


def test_a_picture_that_is_scaled_on_its_way_is_named(solution: Solution) -> None:
    assert not any("as high as wide" in said for said in solution.warnings)
    wide = 4 * RIG.projector.size[0] // 3
    seen = _projector_seen(RIG, lambda p, w, h: ((p[:, 0] + 0.5) * wide / w - 0.5, p[:, 1]))
    found = calibrate(TARGET, [replace(one, projector_size=(wide, one.projector_size[1])) for one in seen], LENGTH)
    (said,) = (said for said in found.warnings if "as high as wide" in said)
    assert said.startswith("the projector's pixels come out 1.33 times as high as wide")
    assert f"{wide} x {RIG.projector.size[1]} px" in said


def test_mirrored_and_swapped_are_refused_by_name() -> None:
    for change, word, setting in (
        (lambda p, w, h: (w - 1 - p[:, 0], p[:, 1]), "mirrored left to right", "mirror = true under"),
        (lambda p, w, h: (p[:, 0], h - 1 - p[:, 1]), "mirrored top to bottom", "mirror = true and rotate = 180"),
    ):
        with pytest.raises(CalibrationError, match=word) as refused:
            calibrate(TARGET, _projector_seen(RIG, change), LENGTH)
        assert setting in str(refused.value.hint)
    with pytest.raises(CalibrationError, match="rows and columns are exchanged"):
        calibrate(TARGET, _projector_seen(RIG, lambda p, w, h: (p[:, 1], p[:, 0]), swap=True), LENGTH)


@pytest.mark.parametrize(("seed", "lacks"), [(198, False), (0, True)])
def test_poses_that_leave_out_what_is_asked_for_are_named(seed: int, lacks: bool) -> None:
    """The poses of the how-to's simulated captures, 198, and those that it had before."""
    rig, scene = simulated_rig("casey2011"), "charuco_poses"
    drawn = target_poses(scene, rig, seed)
    every = np.array([np.r_[cv2.Rodrigues(pose.rotation)[0][:, 0], pose.translation] for pose in drawn])
    board = parse_target("charuco:10x7:30")
    seen = observations(rig.calibration, every, target=board)
    found = solve(board, seen, SolveOptions(length=(240.0, 0.05)), leave_out=False)
    words = [warning for warning in found.warnings if warning.startswith(NOT_MET)]
    assert len(words) == lacks
    for part in (
        "no pose is tilted with its left nearer",
        "span 14.5% of the first pose's (15% are asked)",
        "no points in 1 of 9 fields of the camera's picture (upper left)",
        "no points in 4 of 9 fields of the projector's picture (upper left, ",
    ):
        assert (part in "".join(words)) == lacks


def test_wrong_square_size_is_named_by_a_stated_baseline() -> None:
    wrong = parse_target("chessboard:9x6:25")
    true = float(np.linalg.norm(RIG.translation))
    views = observations(RIG, poses(6))
    with pytest.raises(CalibrationError, match="target's size is probably stated wrong") as refused:
        calibrate(wrong, views, SolveOptions(baseline_mm=true))
    assert "of about 30 mm instead of" in str(refused.value.hint)
    with pytest.raises(CalibrationError, match="working distance"):
        calibrate(wrong, views, SolveOptions(distance_mm=700.0))
    slightly = calibrate(TARGET, views, SolveOptions(length=(240.0, 0.01), baseline_mm=true * 1.08))
    assert any("were entered" in warning for warning in slightly.warnings)
    with pytest.raises(CalibrationError, match="does not fit the target"):
        calibrate(wrong, views, SolveOptions(length=(240.0, 0.1)))


def test_target_that_did_not_move_is_named() -> None:
    still = np.repeat(poses(1), 8, axis=0)
    with pytest.raises(CalibrationError, match="did not move"):
        calibrate(TARGET, observations(RIG, still), LENGTH)
    two = np.concatenate((np.repeat(poses(2)[:1], 4, axis=0), np.repeat(poses(2)[1:], 4, axis=0)))
    with pytest.raises(CalibrationError, match="2 different poses are too few"):
        calibrate(TARGET, observations(RIG, two), LENGTH)


def test_poses_without_depth_or_tilt_are_refused() -> None:
    flat = poses(5, tilt_deg=0.0, depth=(700.0, 700.0))
    flat[:, :2] = 0.0
    with pytest.raises(CalibrationError) as refused:
        calibrate(SMALL, observations(RIG, flat, target=SMALL), SMALL_LENGTH)
    assert "tilt" in str(refused.value.hint) or "plane" in str(refused.value)


def test_too_few_captures_say_why() -> None:
    few = observations(RIG, poses(2))
    out = [LeftOut("a", "no chessboard"), LeftOut("b", "no chessboard"), LeftOut("c", "too dark")]
    with pytest.raises(CalibrationError, match=r"2 of 5 captures can be used, 3 are needed. 2 x no chessboard"):
        calibrate(TARGET, few, LENGTH, out)
    late = [LeftOut(name, "frames out of step: frames 3, 4", out_of_step=True) for name in "abc"]
    with pytest.raises(CalibrationError, match="out of step"):
        calibrate(TARGET, [], LENGTH, late)
    lost = [LeftOut(name, f"frames lost: slot {name}", unreadable=True) for name in ("0", "1", "3")]
    with pytest.raises(CalibrationError) as error:
        calibrate(TARGET, [], LENGTH, lost)
    assert str(error.value).endswith(". 0: frames lost: slot 0; 1: frames lost: slot 1; 3: frames lost: slot 3")
    assert error.value.hint == "copy these folders again from where they were taken, or capture again"


def test_wrong_columns_and_rows_fit_no_rig() -> None:
    with pytest.raises(CalibrationError, match=r"no rig fits these points|focal length"):
        calibrate(parse_target("chessboard:4x6:40"), observations(RIG, poses(4), target=SMALL), SolveOptions())


def test_measured_independently_without_slopes() -> None:
    plain = []
    for k, pose in enumerate(poses()):
        view = view_of(RIG, pose, f"p{k}", noise=(0.0, 0.0))
        generator = np.random.default_rng(k)
        camera, projector = (a + generator.normal(0, 0.05, a.shape) for a in (view.camera, view.projector))
        free = View(view.name, view.ids, camera, projector, np.full(camera.shape, 0.1), np.zeros_like(view.slope))
        plain.append(Observation(free, RIG.camera.size, RIG.projector.size))
    found = calibrate(TARGET, plain, LENGTH)
    assert found.adjusted.sigma_camera == pytest.approx(0.05, rel=0.15)
    assert found.adjusted.projector_factor == pytest.approx(0.5, rel=0.15)


def test_adjustment_holds_what_is_fixed() -> None:
    views = tuple(view_of(RIG, pose, f"v{k}") for k, pose in enumerate(poses(6)))
    state = State(RIG.camera, RIG.projector, RIG.rotation, RIG.translation, FLAT.copy(), poses(6))
    held = adjust(Problem(TARGET, RIG.camera.size, RIG.projector.size, views, fixed=(0, 1, 24, 25, 26)), state)
    assert held.state.camera.matrix[0, 0] == RIG.camera.matrix[0, 0]
    assert held.covariance[0, 0] == 0
    assert held.covariance[2, 2] > 0


def _sizes(observation: Observation) -> tuple[tuple[int, int], tuple[int, int]]:
    return observation.camera_size, observation.projector_size


def _projector_seen(rig: Calibration, change, *, swap: bool = False) -> list[Observation]:
    """The views with the projector's coordinates changed as a turned, mirrored or mistaken one would."""
    width, height = rig.projector.size
    found = []
    for one in observations(rig, poses(6)):
        view = one.view
        moved = np.column_stack(change(view.projector, width, height))
        corner = np.column_stack(change(np.zeros((1, 2)), width, height))
        turn = np.stack(
            [(np.column_stack(change(np.eye(2)[k][None], width, height)) - corner)[0] for k in range(2)], axis=-1
        )
        new = replace(view, projector=moved, slope=turn @ view.slope)
        found.append(Observation(new, one.camera_size, (height, width) if swap else (width, height)))
    return found


def test_rodrigues_of_a_board_turned_by_half() -> None:
    every = poses()
    for pose in every:
        turned = np.asarray(cv2.Rodrigues(pose[:3])[0]) @ np.diag([-1.0, -1.0, 1.0])
        pose[:3] = cv2.Rodrigues(turned)[0].ravel()
    found = calibrate(TARGET, observations(RIG, every), LENGTH)
    assert found.state.translation == pytest.approx(RIG.translation, abs=0.3)
