"""Scans of which a part lies where the projector cannot light are refused; sound ones never are."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from scanner.calibration_spread import across_spread, moved
from scanner.covariance import PARAMETERS
from scanner.errors import DecodeError
from scanner.lit_check import EDGE_PX, MOST_OUTSIDE, outside, require_lit


def diagonal(rig):
    """The projector beside and above, its picture smaller than the camera's view: it ends within the scene."""
    angle = np.arctan2(140.0, 700.0)
    turn = cv2.Rodrigues(np.array([angle, angle, 0.0]))[0]
    lens = replace(rig.projector, matrix=rig.projector.matrix * [[1.6, 1, 1], [1, 1.6, 1], [1, 1, 1]])
    return replace(rig, projector=lens, rotation=turn, translation=turn @ [-140.0, 140.0, 0.0])


def waves(x, y):
    return 700 + 12 * np.sin(x * 30) + 12 * np.sin(y * 30)


@pytest.fixture(scope="module")
def scene(rig_of, scene_with):
    return scene_with(diagonal(rig_of("y")), waves)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_an_image_upside_down_is_refused_and_a_sound_one_is_not(scene, axis):
    decoded = scene.decoded(noise_px=0.3, axis=axis)
    values, sigma = (decoded.rows, decoded.sigma_rows) if axis == "y" else (decoded.columns, decoded.sigma_columns)
    found, said = require_lit(scene.calibration, values, sigma, axis)
    assert (found.share, said) == (0, None)
    assert found.samples > 1000
    for wrong in (np.roll(values, 60, 0), np.roll(values, 60, 1)):
        assert outside(scene.calibration, wrong, None, axis).share > 0.02
    turned = values[::-1] if axis == "x" else values[:, ::-1]
    with pytest.raises(DecodeError, match=r"cannot light.*contradicts the frames") as caught:
        require_lit(scene.calibration, turned, None, axis)
    assert "upside down" in caught.value.hint


def test_a_rig_that_was_knocked_is_a_warning(scene):
    knock = cv2.Rodrigues(np.radians([0.0, 0.8, 0.0]))[0]
    knocked = replace(scene.calibration, rotation=knock @ scene.calibration.rotation)
    found, said = require_lit(knocked, scene.decoded(noise_px=0.3).rows, None, "y")
    assert found.far_share < MOST_OUTSIDE < found.share
    assert said is not None
    assert "a knock" in said


def test_what_the_calibration_leaves_open_is_allowed_for(scene):
    """Sigma of the unmeasured coordinate: as a moved rig sees the same pixel and coordinate."""
    names = sorted(PARAMETERS)
    variance = [1e-4 if name == "rotation.x" else 0.0 for name in names]
    unsure = {"covariance": {"parameters": names, "matrix": np.diag(variance).tolist()}}
    rig = replace(scene.calibration, extra=unsure)
    pixels, depth = np.array([[100.0, 120.0], [220.0, 90.0]]), np.array([700.0, 705.0])
    rays = np.concatenate((rig.camera.normalised(pixels), np.ones((2, 1))), axis=1)

    def seen(of, z):
        return of.projector.project(of.to_projector(rays * z[:, None]))

    measured, turned = seen(rig, depth), moved(rig, "rotation.x", 0.001)
    found = depth.copy()
    for _ in range(5):  # to the depth at which the moved rig measures the same row
        slope = seen(turned, found + 0.5)[:, 1] - seen(turned, found - 0.5)[:, 1]
        found -= (seen(turned, found)[:, 1] - measured[:, 1]) / slope
    apart = np.abs(seen(turned, found)[:, 0] - measured[:, 0])
    assert across_spread(rig, pixels, depth, "y") == pytest.approx(10 * apart, rel=0.03)
    assert across_spread(scene.calibration, pixels, depth, "y") is None
    values = np.roll(scene.decoded().rows, 40, 1)
    assert outside(scene.calibration, values, None, "y").bound_px == EDGE_PX
    assert outside(rig, values, None, "y").bound_px > EDGE_PX + 1


def test_too_little_says_nothing(scene):
    few = np.full((240, 320), np.nan, np.float32)
    assert require_lit(scene.calibration, few, None, "y") == (outside(scene.calibration, few, None, "y"), None)
    few[100:110, 100:110] = 5
    assert require_lit(scene.calibration, few, None, "y")[1] is None
