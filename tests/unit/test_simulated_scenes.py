"""Rigs and scenes: the geometry of scenes.json, exact truth, targets where they are said to be."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.simulated import cast, targets, view
from drivers.simulated.optics import Optics
from drivers.simulated.rigs import rig, rig_names
from drivers.simulated.scenes import SceneOptions, build_scene, scene_names
from drivers.simulated.view import View
from scanner.calibration.detection import Detection, detect
from scanner.calibration.targets import parse_target
from tests.unit.simulated_bench import Bench

PACKAGE = Path(cast.__file__).parent
CHESSBOARD = "chessboard:9x6:30"
SHARED = Path(__file__).parents[3] / "shared" / "scenes.json"


def seen(name: str, options: SceneOptions | None = None, rig_name: str = "quick", seed: int = 0) -> View:
    chosen = rig(rig_name)
    return view.view_scene(chosen, build_scene(name, options or SceneOptions(), chosen, seed), Optics())


def test_the_package_carries_the_shared_scenes() -> None:
    own = (PACKAGE / "scenes.json").read_bytes()
    shared = SHARED.read_bytes() if SHARED.exists() else own  # a clone alone has only its own copy
    assert own == shared


# --- rigs ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", rig_names())
def test_both_devices_aim_at_the_target(name: str) -> None:
    r = rig(name)
    for lens, point in (
        (r.calibration.camera, r.aim),
        (r.calibration.projector, r.calibration.to_projector(r.aim)),
    ):
        width, height = lens.size
        assert lens.project(point) == pytest.approx(((width - 1) / 2, (height - 1) / 2), abs=1e-6)
    assert r.calibration.phase_axis == r.axis
    assert r.calibration.rotation[0, 1] == pytest.approx(0, abs=1e-12)  # the projector's x axis is level


def test_fields_are_those_of_the_dissertation() -> None:
    r = rig("casey2011")
    camera = r.calibration.camera
    corners = camera.normalised(np.array([[-0.5, -0.5], [1391.5, 1039.5]])) * 1346
    assert np.ptp(corners, axis=0) == pytest.approx((555, 413))
    assert r.calibration.projector_centre == pytest.approx((0, -239, 0))
    assert r.scale == pytest.approx(1.0)


def test_lens_shift_puts_the_axis_at_the_lower_edge() -> None:
    projector = rig("bench2026").calibration.projector
    assert projector.matrix[0, 0] == pytest.approx(1.2 * 1920)
    assert projector.matrix[1, 2] == pytest.approx(1079.5)


# --- casting ---------------------------------------------------------------------------------------------------------


def test_rays_meet_bodies_where_geometry_says() -> None:
    directions = np.array([[0.0, 0.0, 1.0], [0.0, 0.05, 1.0], [0.5, 0.0, 1.0]])
    bodies = np.stack(
        (
            cast.sphere(np.array([0.0, 0.0, 100.0]), 10.0),
            cast.box(np.array([55.0, 0.0, 110.0]), np.eye(3), np.array([10.0, 10.0, 10.0])),
        )
    )
    hits = cast.cast_rays(np.zeros(3), directions, bodies, None)
    assert hits.distance[0] == pytest.approx(90.0)
    a, b, c = 1 + 0.05**2, -100.0, 100.0**2 - 100.0
    assert hits.distance[1] == pytest.approx((-b - np.sqrt(b * b - a * c)) / a)
    assert hits.distance[2] == pytest.approx(100.0)
    assert hits.body.tolist() == [0, 0, 1]
    assert np.abs(hits.normal[2]) == pytest.approx((0.0, 0.0, 1.0))
    assert np.linalg.norm(hits.normal, axis=1) == pytest.approx(np.ones(3))


def test_a_marched_field_is_met_on_its_surface_and_misses_beside_it() -> None:
    y, x = np.mgrid[-20:20.5:0.5, -20:20.5:0.5]
    height = 8.0 * np.exp(-(x**2 + y**2) / 50.0) + 0.5
    field = cast.HeightField(-20.0, -20.0, 200.0, 0.5, height)
    generator = np.random.default_rng(0)
    directions = np.column_stack((generator.uniform(-0.12, 0.12, (400, 2)), np.ones(400)))
    hits = cast.cast_rays(np.zeros(3), directions, cast.height_body(field)[None], field)
    points = directions * hits.distance[:, None]
    inside = (np.abs(directions[:, :2] * 199.6) < 19.9).all(axis=1)
    assert np.isfinite(hits.distance[inside]).all()
    assert np.isnan(hits.distance[(np.abs(directions[:, :2] * 191) > 20.1).any(axis=1)]).all()
    x, y, z = points[inside].T
    expected = 200.0 - (8.0 * np.exp(-(x**2 + y**2) / 50.0) + 0.5)
    assert np.abs(z - expected).max() < 0.02  # the sag of the bilinear surface


def test_shadows_fall_away_from_the_light() -> None:
    bodies = np.stack(
        (
            cast.rectangle(np.array([0.0, 0.0, 100.0]), np.eye(3)[0], np.eye(3)[1]),
            cast.sphere(np.array([0.0, 0.0, 80.0]), 5.0),
        )
    )
    directions = np.array([[0.0, 0.35, 1.0], [0.0, -0.35, 1.0], [0.0, -0.04, 1.0], [0.0, 0.055, 1.0]])
    hits = cast.cast_rays(np.zeros(3), directions, bodies, None)
    assert hits.body.tolist() == [0, 0, 1, 1]
    # Light from above (-y): the shadow lies below the ball, the ball's lower limb faces away.
    lit = cast.lit_points(np.zeros(3), directions, hits, np.array([0.0, -60.0, 60.0]), bodies, None)
    assert lit.tolist() == [False, True, True, False]


# --- scenes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", scene_names())
def test_every_scene_is_lit_and_its_truth_is_exact(name: str) -> None:
    v = seen(name)
    r = rig("quick")
    truth = v.truth
    assert truth.lit.mean() > 0.2
    assert (v.shade[~truth.lit] == 0).all()
    assert (v.shade[truth.lit] > 0).mean() > 0.99
    assert np.isnan(truth.rows).sum() == np.isnan(truth.xyz[..., 2]).sum()
    xyz = truth.xyz[truth.lit].astype(np.float64)
    y, x = np.nonzero(truth.lit)
    assert np.abs(r.calibration.camera.project(xyz) - np.stack((x, y), -1)).max() < 1e-3
    pixel = r.calibration.projector.project(r.calibration.to_projector(xyz))
    assert np.abs(pixel - np.stack((truth.columns, truth.rows), -1)[truth.lit]).max() < 1e-3
    assert np.abs(v.row[truth.lit] - truth.rows[truth.lit] - 0.5).max() < 1e-3


def test_blur_carries_light_beyond_the_picture_and_the_truth_says_where_it_ends() -> None:
    """The board of bench2026, where the end of the projected picture is in view."""
    r = rig("bench2026")
    v = view.view_scene(r, build_scene("board", SceneOptions(), r, 0), Optics(), stride=4, spill=5)
    middle = (v.truth.columns - 959.5, v.truth.rows - 539.5)
    beyond = np.maximum(np.abs(middle[0]) - 960, np.abs(middle[1]) - 540)
    near, far = (beyond > 0.01) & (beyond < 4.99), beyond > 5.01
    assert near.sum() > 100
    assert (v.shade[near] > 0).all()
    assert not v.truth.lit[near | far].any()
    assert not v.shade[far].any()
    assert np.abs(v.column[near] - v.truth.columns[near] - 0.5).max() < 1e-3


def test_scene_surfaces_are_those_of_scenes_json() -> None:
    r = rig("quick")

    def scene_points(name: str) -> np.ndarray:
        points = r.to_scene(seen(name).truth.xyz)
        return points[np.isfinite(points[..., 2])]

    assert scene_points("board")[:, 2] == pytest.approx(1346, abs=1e-3)
    tilt = scene_points("tilt_x30")
    assert tilt[:, 2] - 1346 == pytest.approx(np.tan(np.radians(30)) * tilt[:, 1], abs=1e-3)
    points = scene_points("sphere_board")
    ball = points[points[:, 2] < 1345]
    assert np.linalg.norm(ball - (0, 0, 1226), axis=1) == pytest.approx(80, abs=1e-3)
    wedge = scene_points("wedge")
    assert wedge[:, 2] == pytest.approx(1346 - 42 + 84 * np.abs(wedge[:, 0]) / 220, abs=1e-3)
    heights = 1346 - scene_points("blocks")[:, 2]
    for height in (15, 30, 45, 60, 83):
        assert (np.abs(heights - height) < 0.01).sum() > 100
    relief = build_scene("bust", SceneOptions(), r, 0).field
    assert relief is not None
    rows, columns = np.nonzero(relief.height > 0)
    size = (np.ptp(columns) * relief.cell_mm, np.ptp(rows) * relief.cell_mm, relief.height.max())
    assert size == pytest.approx((190, 260, 150), abs=3)
    bust = scene_points("bust")[:, 2]
    assert bust[bust < 1499].min() == pytest.approx(1346 - 75, abs=1)


def test_tilt_takes_any_angle() -> None:
    points = rig("quick").to_scene(seen("tilt", SceneOptions(tilt_deg=20.0, about="y")).truth.xyz)
    assert points[..., 2] - 1346 == pytest.approx(np.tan(np.radians(20)) * points[..., 0], abs=1e-3)


def test_albedos_are_those_of_scenes_json() -> None:
    textured = seen("textured", rig_name="casey2011")
    ratio = textured.floor / seen("board", rig_name="casey2011").floor * 0.8
    assert ratio.min() == pytest.approx(0.05, abs=0.01)
    assert ratio.max() == pytest.approx(0.9, abs=0.01)
    two = seen("two_albedo")
    ratio = two.floor / seen("board").floor * 0.8
    assert sorted({round(float(a), 2) for a in np.percentile(ratio, (20, 80))}) == [0.03, 0.9]
    assert two.shade.max() > 1.05 * seen("board").shade.max()


# --- targets -----------------------------------------------------------------------------------------------------


def white_frame(device: str) -> np.ndarray:
    bench = Bench(device)
    c = bench.projector.capabilities
    (frame,) = bench.captured([np.full((c.height, c.width), 255, dtype=np.uint8)])
    return frame


@pytest.mark.parametrize("pose", [0, 7])
def test_chessboard_corners_are_seen_where_its_pose_says(pose: int) -> None:
    """To 0.01 px, by saddles fitted to the picture without noise."""
    scene, r = "chessboard_poses", rig("casey2011")
    found = detect(white_frame(f"casey2011/{scene}?pose={pose}&seed=1&noise=false&bits=12"), parse_target(CHESSBOARD))
    assert isinstance(found, Detection)
    where = targets.target_poses(scene, r, 1)[pose]
    points = targets.target_points(scene, r) @ where.rotation.T + where.translation
    expected = r.calibration.camera.project(points)
    assert min(np.abs(found.points - seen[found.ids]).max() for seen in (expected, expected[::-1])) < 0.01


def test_charuco_corners_are_seen_where_the_pose_says() -> None:
    scene, r = "charuco_poses", rig("casey2011")
    frame = white_frame(f"casey2011/{scene}?pose=3").astype(np.uint8)
    detector = cv2.aruco.CharucoDetector(targets.charuco_board())
    corners, ids, _, _ = detector.detectBoard(frame)
    assert ids is not None
    assert len(ids) >= 50
    where = targets.target_poses(scene, r, 0)[3]
    points = targets.target_points(scene, r)[ids.ravel()]
    expected = r.calibration.camera.project(points @ where.rotation.T + where.translation)
    assert np.median(np.abs(corners.reshape(-1, 2) - expected)) < 0.03


@pytest.mark.parametrize("scene", sorted(targets.POSED))
@pytest.mark.parametrize("name", rig_names())
def test_poses_span_their_depths_and_tilts(scene: str, name: str) -> None:
    r = rig(name)
    poses = targets.target_poses(scene, r, 2)
    assert len(poses) == 12
    depth = [float(r.to_scene(pose.translation)[2]) for pose in poses]
    assert min(depth) >= 1216
    assert max(depth) <= 1416
    assert np.ptp(depth) > 150
    tilts = [np.degrees(np.arccos(pose.rotation[2, 2])) for pose in poses]
    assert 20 < max(tilts) <= 30.001
    assert not np.allclose(targets.target_poses(scene, r, 3)[0].rotation, poses[0].rotation)


def test_wedge_discs_are_dark_where_they_are_said_to_be() -> None:
    r = rig("casey2011")
    v = seen("wedge", rig_name="casey2011")
    pixels = np.rint(r.calibration.camera.project(targets.wedge_points(r))).astype(int)
    assert len(pixels) == 18
    dark = v.floor[pixels[:, 1], pixels[:, 0]]
    beside = v.floor[pixels[:, 1], pixels[:, 0] + 55]
    assert dark / beside == pytest.approx(0.3 / 0.8, rel=0.05)
