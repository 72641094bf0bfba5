"""Lenses against their formula, OpenCV and round trips; calibration files and what is refused."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner.errors import CalibrationError
from scanner.geometry import Lens, calibration_from_dict, load_calibration

MATRIX = np.array([[2400.0, 0.7, 959.5], [0, 2390.0, 599.5], [0, 0, 1]])
DISTORTIONS = ([0.0] * 5, [-0.09, 0.05, 0.0005, -0.0003, 0.0], [0.2, -0.1, 0.001, 0.002, 0.03])


@pytest.mark.parametrize("k", DISTORTIONS)
def test_projecting_agrees_with_opencv(k):
    lens = Lens((1920, 1200), MATRIX * [[1, 0, 1], [1, 1, 1], [1, 1, 1]], np.array(k))
    points = np.random.default_rng(1).uniform((-250, -150, 600), (250, 150, 900), (500, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)
    np.testing.assert_allclose(lens.project(points), expected[:, 0], atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(
    k1=st.floats(-0.2, 0.3),
    k2=st.floats(-0.1, 0.1),
    p1=st.floats(-0.003, 0.003),
    p2=st.floats(-0.003, 0.003),
    x=st.floats(-200, 2100),
    y=st.floats(-100, 1300),
)
def test_a_pixel_seen_along_its_ray_is_that_pixel(k1, k2, p1, p2, x, y):
    lens = Lens((1920, 1200), MATRIX, np.array([k1, k2, p1, p2, 0.0]))
    ray = lens.normalised(np.array([x, y]))
    back = lens.project(np.append(ray, 1.0) * 700)
    np.testing.assert_allclose(back, (x, y), atol=1e-6)


def test_rays_keep_the_shape_of_what_was_asked():
    lens = Lens((7, 5), MATRIX, np.array(DISTORTIONS[1]))
    grid = lens.pixel_grid()
    assert grid.shape == (5, 7, 2)
    assert grid[4, 6].tolist() == [6, 4]
    rays = lens.normalised(grid)
    assert rays.shape == grid.shape
    np.testing.assert_array_equal(rays[3, 2], lens.normalised(grid[3, 2]))


def test_a_direction_beyond_the_fold_of_the_distortion_has_no_ray():
    lens = Lens((1920, 1200), MATRIX, np.array([-0.5, 0, 0, 0, 0.0]))  # x (1 - x^2 / 2) never exceeds 0.544
    assert np.isnan(lens.normalised(np.array([959.5 + 0.6 * 2400, 599.5]))).all()
    assert np.isfinite(lens.normalised(np.array([959.5 + 0.5 * 2400, 599.5]))).all()


def test_the_axis_that_measures_depth_is_where_the_projector_stands(rig_of):
    assert rig_of("y").phase_axis == "y"
    assert rig_of("x").phase_axis == "x"


def test_a_calibration_survives_its_file(rig_of, tmp_path):
    rig = rig_of("x", projector_k=(-0.03, 0.01, 0.0, 0.0, 0.0))
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps({**rig.as_dict(), "scale": "unverified"}))
    back = load_calibration(path)
    assert back.id == rig.id
    assert back.camera.size == rig.camera.size
    assert back.extra["scale"] == "unverified"
    np.testing.assert_array_equal(back.rotation, rig.rotation)
    np.testing.assert_array_equal(back.projector.distortion, rig.projector.distortion)
    assert load_calibration(path).as_dict() == back.as_dict()


@pytest.mark.parametrize("absent", [None, ""])
def test_a_calibration_without_an_id_is_named_by_its_contents(rig_of, tmp_path, absent):
    content = {**rig_of("x").as_dict(), "id": absent}
    path = tmp_path / "calibration.json"
    names = []
    for baseline in (0, 0, 1):
        content["translation"][1] += baseline
        path.write_text(json.dumps(content))
        names.append(load_calibration(path).id)
    assert names[0] == names[1] != names[2]
    content["id"] = names[2]  # which is the one it would have been written with
    path.write_text(json.dumps(content))
    assert not any("edited by hand" in said for said in load_calibration(path).warnings)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c.update(format="other"), "not a fringed-calibration"),
        (lambda c: c.update(version=2), "version 2"),
        (lambda c: c.pop("camera"), "camera is missing"),
        (lambda c: c["camera"].update(size=[320]), "size"),
        (lambda c: c["camera"].update(size=[10**400, 240]), "is no picture's"),
        (lambda c: c["camera"]["matrix"][0].__setitem__(0, float("nan")), "NaN"),
        (lambda c: c["camera"]["matrix"][0].__setitem__(0, 0.0), "singular"),
        (lambda c: c["projector"].update(matrix=[[1, 0], [0, 1]]), "shape"),
        (lambda c: c["rotation"][0].__setitem__(0, -c["rotation"][0][0]), "not a rotation"),
        (lambda c: c.update(translation=[0, 0, 0]), "translation is zero"),
        (lambda c: c.update(translation=["a", 0, 0]), "not an array of numbers"),
        (lambda c: c["camera"]["distortion"].__setitem__(0, "0.1"), "not an array of numbers"),
        (lambda c: c["camera"]["distortion"].__setitem__(0, True), "not an array of numbers"),
        (lambda c: c.update(translation=[10**400, 0, 0]), "not an array of numbers"),
        (lambda c: c.update(units="m"), "units"),
        (lambda c: c["camera"].update(distortion=[1e9] * 5), "folds the image"),
        (lambda c: c["camera"].update(distortion=[-50.0, 0, 0, 0, 0]), "folds the image"),
        (lambda c: c.update(hall={"camera": [[1]], "projector": [[1]]}), r"hall\.camera has shape"),
        (lambda c: c.update(world=5), "world must be"),
        (lambda c: c.update(world={"rotation": np.diag([1, 1, -1]).tolist(), "translation": [0, 0, 0]}), "world.rot"),
        (lambda c: c.update(mcp_phase={"slope": 1.0}), r"mcp_phase\.intercept is missing"),
        (lambda c: c.update(response=[2.3]), "response must be"),
        (lambda c: c.update(id=float("nan")), "id is nan, it must be text"),
    ],
)
def test_what_is_no_calibration_is_refused_and_named(rig_of, change, says):
    content = json.loads(json.dumps(rig_of("y").as_dict()))
    change(content)
    with pytest.raises(CalibrationError, match=says) as error:
        calibration_from_dict(content, name="file.json")
    assert "file.json" in str(error.value)


def test_an_unreadable_calibration_file_is_named(tmp_path):
    with pytest.raises(CalibrationError, match="cannot read"):
        load_calibration(tmp_path / "none.json")
    (tmp_path / "text.json").write_text("no json")
    with pytest.raises(CalibrationError, match="as JSON"):
        load_calibration(tmp_path / "text.json")


def test_a_member_that_is_there_twice_is_refused(rig_of, tmp_path):
    text = json.dumps(rig_of("y").as_dict())
    path = tmp_path / "edited.json"
    path.write_text(text[:-1] + ', "translation": [0, 0, 1]}')
    with pytest.raises(CalibrationError, match="'translation' is there twice"):
        load_calibration(path)
