"""Depth along camera rays against known scenes, a plain oracle, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner.errors import CalibrationError
from scanner.geometry import Calibration, Lens
from scanner.triangulation import camera_rays, depth_share, triangulate

CAMERA_K = (-0.09, 0.05, 0.0005, -0.0003, 0.0)
PROJECTOR_K = (-0.08, 0.03, 0.0007, -0.0004, 0.01)


def wavy(x, y):
    return 700 + 40 * np.sin(12 * x) * np.cos(15 * y)


@pytest.mark.parametrize("axis", ["y", "x"])
@pytest.mark.parametrize("distorted", [False, True])
def test_exact_rows_or_columns_give_the_exact_surface(rig_of, scene_with, axis, distorted):
    rig = rig_of(axis, CAMERA_K, PROJECTOR_K) if distorted else rig_of(axis)
    scene = scene_with(rig, wavy)
    name = "rows" if axis == "y" else "columns"
    found = triangulate(rig, **{name: getattr(scene.truth, name)})
    # Rows are float32: a quantum of 3e-5 px, a few of which make 1e-3 mm here.
    np.testing.assert_allclose(found.xyz, scene.truth.xyz, atol=1e-3)
    assert found.xyz.dtype == np.float32
    assert found.impossible == 0


def test_both_axes_agree_with_a_plain_minimisation(rig_of, scene_with):
    rig = rig_of("y", CAMERA_K, PROJECTOR_K)
    scene = scene_with(rig, wavy)
    rng = np.random.default_rng(3)
    shape = scene.lit.shape
    sigma_rows = rng.uniform(0.05, 0.5, shape).astype(np.float32)
    sigma_columns = rng.uniform(0.05, 0.5, shape).astype(np.float32)
    rows = (scene.truth.rows + rng.normal(0, 1, shape) * sigma_rows).astype(np.float32)
    columns = (scene.truth.columns + rng.normal(0, 1, shape) * sigma_columns).astype(np.float32)
    found = triangulate(rig, rows=rows, columns=columns, sigma_rows=sigma_rows, sigma_columns=sigma_columns)
    x, y = camera_rays(rig.camera)
    for i, j in ((5, 7), (120, 160), (200, 300)):
        ray = np.array([x[i, j], y[i, j], 1.0])
        depths = found.xyz[i, j, 2] + np.linspace(-1, 1, 4001)
        seen = rig.projector.project(rig.to_projector(depths[:, None] * ray))
        cost = ((seen[:, 0] - columns[i, j]) / sigma_columns[i, j]) ** 2
        cost += ((seen[:, 1] - rows[i, j]) / sigma_rows[i, j]) ** 2
        assert abs(depths[cost.argmin()] - found.xyz[i, j, 2]) < 1e-3


def test_with_both_axes_a_pixel_may_lack_one(rig_of, scene_with):
    rig = rig_of("y")
    scene = scene_with(rig, wavy)
    rows, columns = scene.truth.rows.copy(), scene.truth.columns.copy()
    columns[:, ::2] = np.nan
    rows[::2, 1::4] = np.nan
    rows[1, 1] = columns[1, 1] = np.nan
    found = triangulate(rig, rows=rows, columns=columns)
    sees_rows = ~np.isnan(rows)
    np.testing.assert_allclose(found.xyz[sees_rows], scene.truth.xyz[sees_rows], atol=1e-3)
    assert np.isnan(found.xyz[1, 1]).all()


@pytest.mark.parametrize("both", [False, True])
def test_expected_sigma_is_the_spread_of_the_errors(rig_of, scene_with, both):
    rig = rig_of("y", CAMERA_K, PROJECTOR_K)
    scene = scene_with(rig, wavy)
    rng = np.random.default_rng(5)
    sigma = np.full(scene.lit.shape, 0.05, np.float32)
    given = {"rows": scene.truth.rows + rng.normal(0, 0.05, sigma.shape).astype(np.float32), "sigma_rows": sigma}
    if both:
        noise = rng.normal(0, 0.05, sigma.shape).astype(np.float32)
        given |= {"columns": scene.truth.columns + noise, "sigma_columns": sigma}
    found = triangulate(rig, **given)
    ratio = (found.xyz[..., 2] - scene.truth.xyz[..., 2]) / found.sigma_z
    assert 0.98 < np.sqrt(np.mean(ratio**2)) < 1.02


def test_what_was_not_measured_has_no_point(rig_of, scene_with):
    rig = rig_of("y")
    scene = scene_with(rig, wavy)
    rows = scene.truth.rows.copy()
    rows[10:20, 30:50] = np.nan
    found = triangulate(rig, rows=rows, sigma_rows=np.ones_like(rows))
    assert np.isnan(found.xyz[10:20, 30:50]).all()
    assert np.isnan(found.sigma_z[10:20, 30:50]).all()
    assert int(np.isnan(found.xyz[..., 2]).sum()) == 200
    assert found.impossible == 0


def test_points_that_cannot_be_are_counted(rig_of, scene_with):
    rig = rig_of("y")
    rows = scene_with(rig, wavy).truth.rows.copy()
    rows[:4] = -5000.0  # light from far outside the projector's image: its rays meet the camera's behind both
    found = triangulate(rig, rows=rows)
    assert np.isnan(found.xyz[:4]).all()
    assert found.impossible == 4 * 320
    assert np.isfinite(found.xyz[4:]).all()


def test_without_sigmas_depth_has_none(rig_of, scene_with):
    rig = rig_of("y")
    assert np.isnan(triangulate(rig, rows=scene_with(rig, wavy).truth.rows).sigma_z).all()


def test_a_camera_of_another_size_is_refused(rig_of):
    with pytest.raises(CalibrationError, match=r"320 x 240.*100 x 50") as error:
        triangulate(rig_of("y"), rows=np.zeros((50, 100), np.float32))
    assert "calibrat" in error.value.hint


@pytest.mark.parametrize(("stands", "given", "project"), [("y", "columns", "axis y"), ("x", "rows", "axis x")])
def test_an_axis_that_measures_no_depth_is_refused(rig_of, stands, given, project):
    rig = rig_of(stands)
    with pytest.raises(CalibrationError, match="measure no depth") as error:
        triangulate(rig, **{given: np.zeros((240, 320), np.float32)})
    assert project in error.value.hint


def test_share_of_depth_follows_the_baseline(rig_of):
    assert depth_share(rig_of("y"))["y"] > 0.99
    diagonal = rig_of("y")
    turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1.0]])  # the projector rolled about its axis
    rolled = Calibration(diagonal.camera, diagonal.projector, turn @ diagonal.rotation, turn @ diagonal.translation)
    share = depth_share(rolled)
    assert share["x"] == pytest.approx(0.6, abs=0.05)
    assert share["y"] == pytest.approx(0.8, abs=0.05)


def test_rays_are_computed_once_and_cannot_be_changed(rig_of):
    lens = rig_of("y", CAMERA_K).camera
    again = Lens(lens.size, lens.matrix.copy(), lens.distortion.copy())
    assert camera_rays(lens)[0] is camera_rays(again)[0]
    with pytest.raises(ValueError, match="read-only"):
        camera_rays(lens)[0][0, 0] = 1


@settings(max_examples=30, deadline=None)
@given(z=st.floats(300, 3000), k1=st.floats(-0.3, 0.3), k2=st.floats(-0.05, 0.05), skew=st.floats(-3, 3))
def test_any_depth_and_lens_comes_back(rig_of, scene_with, z, k1, k2, skew):
    base = rig_of("x")
    matrix = base.projector.matrix.copy()
    matrix[0, 1] = skew
    lens = Lens(base.projector.size, matrix, np.array([k1, k2, 0.001, -0.001, 0.0]))
    rig = Calibration(base.camera, lens, base.rotation, base.translation)
    scene = scene_with(rig, lambda x, y: np.full(x.shape, z))
    inside = scene.lit
    columns = np.where(inside, scene.truth.columns, np.nan).astype(np.float32)
    found = triangulate(rig, columns=columns)
    if inside.any():
        assert np.nanmax(np.abs(found.xyz[..., 2] - z)) < 3e-6 * z * z / 100 + 1e-3
        assert int(np.isfinite(found.xyz[..., 2]).sum()) == int(inside.sum())
