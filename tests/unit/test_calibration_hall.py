"""The Hall model: its matrices, what they are made of, its triangulation, and calibration from a target in space."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from scanner.calibration.calibration_file import calibration_dict
from scanner.calibration.hall import decompose, focal_spread, hall_matrix, project_hall, triangulate_hall
from scanner.calibration.observe import LeftOut, Observation
from scanner.calibration.solve import SolveOptions, solve
from scanner.calibration.solve_hall import solve_hall
from scanner.calibration.targets import Target, parse_target
from scanner.errors import CalibrationError
from scanner.geometry import Calibration, Lens, calibration_from_dict
from scanner.triangulation import triangulate
from tests.unit.calibration_bench import TARGET, made_up_rig, observations, poses, view_of

PLAIN = made_up_rig()
RIG = replace(
    PLAIN,
    camera=Lens(PLAIN.camera.size, PLAIN.camera.matrix, np.zeros(5)),
    projector=Lens(PLAIN.projector.size, PLAIN.projector.matrix, np.zeros(5)),
)
"""The made-up rig without distortion: what the Hall model can be"""

POSE = np.array([0.1, -0.05, 0.02, 10.0, -5.0, 700.0])


@pytest.fixture
def wedge(tmp_path: Path) -> Target:
    points = [
        (side * 60.0 + (k % 3 - 1) * 35.0, (k // 3 - 1) * 60.0, 25.0 * (k % 3 if side < 0 else 2 - k % 3) * -1.0)
        for side in (-1, 1)
        for k in range(9)
    ]
    file = tmp_path / "wedge.json"
    content = {"format": "fringed-target", "version": 1, "diameter_mm": 20, "points": points}
    file.write_text(json.dumps(content))
    return parse_target(f"wedge:{file}")


def seen(rig: Calibration, target: Target, noise: tuple[float, float] = (0.01, 0.005)) -> list[Observation]:
    view = view_of(rig, POSE, "wedge", target=target, noise=noise)
    return [Observation(view, rig.camera.size, rig.projector.size)]


def test_matrix_maps_points_to_pixels_and_is_made_of_a_lens() -> None:
    generator = np.random.default_rng(2)
    points = generator.uniform((-100, -80, 600), (100, 80, 800), (20, 3))
    matrix = hall_matrix(points, RIG.projector.project(RIG.to_projector(points)))
    assert matrix[2, 3] == 1
    assert project_hall(matrix, points) == pytest.approx(RIG.projector.project(RIG.to_projector(points)), abs=1e-6)
    parts = decompose(matrix)
    assert parts.matrix == pytest.approx(RIG.projector.matrix, rel=1e-6, abs=1e-4)
    assert parts.rotation == pytest.approx(RIG.rotation, abs=1e-7)
    assert parts.translation == pytest.approx(RIG.translation, abs=1e-3)


def test_points_that_fix_no_matrix_are_refused() -> None:
    points = np.column_stack((*np.random.default_rng(0).uniform(-100, 100, (2, 12)), np.full(12, 700.0)))
    with pytest.raises(CalibrationError, match="one plane"):
        hall_matrix(points, RIG.camera.project(points))
    with pytest.raises(CalibrationError, match="too few"):
        hall_matrix(points[:5], RIG.camera.project(points[:5]))


def test_triangulation_in_rows_is_that_of_the_lenses(wedge: Target) -> None:
    turn = np.asarray(cv2.Rodrigues(np.array([0.3, 0.0, 0.01]))[0])
    above = replace(RIG, camera=_coarser(RIG.camera), rotation=turn, translation=-turn @ np.array([5.0, -220.0, 0.0]))
    content = calibration_dict(solve_hall(wedge, seen(above, wedge, (0.0, 0.0))))
    read = calibration_from_dict(content)
    width, height = read.camera.size
    on_plane = read.camera.normalised(read.camera.pixel_grid())
    points = np.concatenate((on_plane, np.ones((height, width, 1))), axis=-1) * 700.0
    rows = read.projector.project(read.to_projector(points))[..., 1].astype(np.float32)
    rows[np.arange(height) % 16 != 8] = np.nan
    camera, projector = (np.array(content["hall"][side]) for side in ("camera", "projector"))
    world = triangulate_hall(camera, projector, rows)
    by_lenses = triangulate(read, rows=rows).xyz @ np.array(content["world"]["rotation"]).T
    measured = np.isfinite(by_lenses).all(axis=-1)
    assert measured.mean() == pytest.approx(1 / 16)
    assert world[measured] == pytest.approx((by_lenses + content["world"]["translation"])[measured], abs=5e-3)
    assert np.isnan(world[~measured]).all()


def _coarser(lens: Lens) -> Lens:
    """The same view in a quarter of the pixels across and down."""
    scale = np.diag([0.25, 0.25, 1.0])
    return Lens((lens.size[0] // 4, lens.size[1] // 4), scale @ lens.matrix, lens.distortion)


def test_wedge_gives_the_rig(wedge: Target) -> None:
    found = solve_hall(wedge, seen(RIG, wedge), SolveOptions(), [LeftOut("dark", "too dark")])
    assert [one.name for one in found.left_out] == ["dark"]
    # Over the wedge's own depth points are right, whatever focal length and distance have made of each other.
    pose = found.state.poses[0]
    rotation = found.geometry
    assert found.warnings == ()
    assert rotation.camera.matrix[0, 0] == pytest.approx(2000.0, rel=0.03)
    assert pose[5] == pytest.approx(700.0, rel=0.03)
    content = calibration_dict(found)
    assert content["covariance"] is None
    assert content["residuals"]["camera_px"] < 0.03
    assert np.array(content["hall"]["camera"]).shape == (3, 4)


def test_wedge_and_the_adjustment(wedge: Target) -> None:
    found = solve(wedge, seen(RIG, wedge), SolveOptions())
    assert found.state.translation == pytest.approx(RIG.translation, rel=0.05, abs=3)
    assert np.isnan(found.held_out.errors).all()


def test_distortion_is_what_the_hall_model_lacks(wedge: Target) -> None:
    strong = replace(RIG, camera=replace(RIG.camera, distortion=np.array([-0.5, 0.3, 0.0, 0.0, 0.0])))
    found = solve_hall(wedge, seen(strong, wedge))
    assert any("no distortion" in warning for warning in found.warnings)


def test_flat_targets_give_matrices_too() -> None:
    found = solve_hall(TARGET, observations(RIG, poses(6)), SolveOptions(rigid=True))
    content = calibration_dict(found)
    read = calibration_from_dict(content)
    assert read.camera.matrix[:2, :2] == pytest.approx(RIG.camera.matrix[:2, :2], rel=2e-3, abs=2.0)
    assert read.translation == pytest.approx(RIG.translation, abs=2.0)
    assert content["residuals"]["projector_px"] < 0.06


def test_flat_targets_count_with_the_size_that_they_came_out_with() -> None:
    """A print that is larger than it is called: the length that was measured on it makes the scale."""
    print_scale = 1.01
    seen_larger = observations(RIG, poses(6), sheet=(print_scale, print_scale, 1.0))
    length = TARGET.longest_mm * print_scale
    options = SolveOptions(length=(length, 0.001))
    hall, adjusted = (solver(TARGET, seen_larger, options) for solver in (solve_hall, solve))
    assert hall.state.sheet[0] == pytest.approx(print_scale, abs=3e-4)
    assert hall.state.translation == pytest.approx(adjusted.state.translation, abs=0.3)
    assert np.linalg.norm(hall.state.translation) == pytest.approx(np.linalg.norm(RIG.translation), rel=1e-3)
    assert calibration_dict(hall)["residuals"]["camera_px"] < 0.05


def test_too_few_discs_and_no_capture_are_refused(wedge: Target) -> None:
    one = seen(RIG, wedge)[0]
    few = replace(one, view=one.view.only(np.arange(18) < 10))
    with pytest.raises(CalibrationError, match="10 discs are seen"):
        solve_hall(wedge, [few])
    with pytest.raises(CalibrationError, match="too dark"):
        solve_hall(wedge, [], None, [LeftOut("a", "too dark")])


def test_a_target_that_is_nearly_flat_is_refused(wedge: Target) -> None:
    shallow = replace(wedge, points=wedge.points * (1.0, 1.0, 0.04))
    with pytest.raises(CalibrationError, match="depth is too small for the Hall model"):
        solve_hall(shallow, seen(PLAIN, shallow))


def test_focal_length_scatters_as_it_says(wedge: Target) -> None:
    found, stated = [], []
    for seed in range(30):
        view = view_of(RIG, POSE, "wedge", target=wedge, noise=(0.05, 0.01), seed=seed)
        matrix = hall_matrix(wedge.points, view.camera)
        found.append(np.sqrt(np.prod(np.diag(decompose(matrix).matrix)[:2])))
        stated.append(focal_spread(matrix, wedge.points, view.camera))
    assert np.std(found) / np.mean(found) == pytest.approx(np.median(stated), rel=0.4)


def test_target_file_of_the_other_hand_is_refused(wedge: Target) -> None:
    left_handed = replace(wedge, points=wedge.points * (-1.0, 1.0, 1.0))
    with pytest.raises(CalibrationError, match="mirrored against its coordinates"):
        solve_hall(left_handed, seen(RIG, wedge))


def _in_frame(wedge: Target, matrix: np.ndarray, shift: np.ndarray) -> Target:
    """The wedge in other coordinates: `POSE` undone, then moved."""
    return replace(wedge, points=wedge.points @ matrix.T + shift)


def test_a_target_in_the_cameras_own_coordinates_is_moved_to_its_middle(wedge: Target) -> None:
    """Where the origin is beside a lens no matrix has m34 = 1."""
    turn = np.asarray(cv2.Rodrigues(POSE[:3])[0])
    one = solve_hall(wedge, seen(RIG, wedge))
    for shift in (0.0, 1.0, -1.0):
        of_camera = _in_frame(wedge, turn, POSE[3:] + np.array([0, 0, shift]))
        found = solve_hall(of_camera, seen(RIG, wedge))
        assert found.state.translation == pytest.approx(one.state.translation, rel=1e-4, abs=0.05)
        assert any("is beside a lens" in said for said in found.warnings)
        assert np.isfinite(np.array(calibration_dict(found)["hall"]["camera"])).all()
    found = solve_hall(_in_frame(wedge, turn, POSE[3:] + np.array([0, 0, 100.0])), seen(RIG, wedge))
    assert found.state.translation == pytest.approx(one.state.translation, rel=1e-4, abs=0.05)
    assert found.warnings == ()


def test_the_other_hand_is_told_wherever_the_origin_is(wedge: Target) -> None:
    for shift in (-3000.0, 3000.0):
        left_handed = replace(wedge, points=wedge.points * (1.0, 1.0, -1.0) + [0, 0, shift])
        with pytest.raises(CalibrationError, match="mirrored against its coordinates"):
            solve_hall(left_handed, seen(RIG, wedge))


def test_a_wedge_of_another_size_contradicts_what_was_entered(wedge: Target) -> None:
    large = replace(wedge, points=wedge.points * 1.2)
    for entered in (SolveOptions(baseline_mm=float(np.linalg.norm(RIG.translation))), SolveOptions(distance_mm=700.0)):
        assert solve_hall(wedge, seen(RIG, wedge), entered).warnings == ()
        with pytest.raises(CalibrationError, match="were entered"):
            solve_hall(large, seen(RIG, wedge), entered)


def test_a_disc_that_is_not_where_its_file_has_it_is_named(wedge: Target) -> None:
    moved, noisy = wedge.points.copy(), wedge.points + np.random.default_rng(3).normal(0, 0.2, wedge.points.shape)
    moved[7] += [1.5, 0.0, 0.0]
    with pytest.raises(CalibrationError, match="disc 7, from 0 on, is not where"):
        solve_hall(replace(wedge, points=moved), seen(RIG, wedge))
    adjusted = solve(replace(wedge, points=moved), seen(RIG, wedge), SolveOptions())
    assert any("discs 7, from 0 on, were left out as outliers" in said for said in adjusted.warnings)
    assert not any("left out as outliers" in said for said in solve(wedge, seen(RIG, wedge), SolveOptions()).warnings)
    with pytest.raises(CalibrationError, match=r"does not fit these points: .* px are left") as refused:
        solve_hall(replace(wedge, points=noisy), seen(RIG, wedge))
    assert "measure the discs' places again" in str(refused.value.hint)
