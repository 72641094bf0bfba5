"""What the filters take and what they must leave: edges, specks, smooth surfaces, limits."""

from __future__ import annotations

import json
import math
from dataclasses import asdict

import cv2
import numpy as np
import pytest

from scanner.errors import ConfigError
from scanner.filter_settings import FilterSettings, parse_box, parse_depth
from scanner.filters import NOISE_SIGMAS, apply_filters, at_depth_edge, noise_factor
from scanner.fragments import small_fragments
from scanner.triangulation import triangulate

ONLY_LIMITS = {"edges": False}


def filtered(scene, noise_px=0.02, settings=None, change=None):
    decoded = scene.decoded(noise_px)
    found = triangulate(scene.calibration, rows=decoded.rows, sigma_rows=decoded.sigma_rows)
    if change is not None:
        change(found.xyz)
    falls, removed = apply_filters(found.xyz, found.sigma_z, decoded.confidence, settings or FilterSettings())
    return found, falls, removed


def along_rays(scene, depth):
    """Points at other depths along the scene's rays."""
    rays = scene.truth.xyz / scene.truth.xyz[..., 2:]
    return (rays * depth[..., None]).astype(np.float32)


@pytest.mark.parametrize("noise_px", [0.0, 0.02, 0.1])
@pytest.mark.parametrize("turn", [(45, 0), (-45, 0), (0, 45), (0, -45)])
def test_a_board_at_45_degrees_stays(rig_of, scene_with, noise_px, turn):
    gx, gy = (math.tan(math.radians(angle)) for angle in turn)
    scene = scene_with(rig_of("y"), lambda x, y: 700 / (1 - gx * x - gy * y))
    found, falls, _ = filtered(scene, noise_px)
    assert falls.sum() <= 0.005 * np.isfinite(found.xyz[..., 2]).sum()


@pytest.mark.parametrize("noise_px", [0.0, 0.02, 0.1])
def test_a_sphere_stays_inside_7_px_from_its_silhouette(ball, noise_px):
    _, falls, _ = filtered(ball, noise_px)
    x, y, z = np.moveaxis(ball.truth.xyz, -1, 0)
    silhouette = np.hypot(x / z, y / z) * 620  # px from the sphere's centre
    radius = 620 * math.tan(math.asin(50 / 640))
    inside = ball.lit & (silhouette < radius - 7)
    assert inside.sum() > 4000
    assert (falls & inside).sum() <= 0.005 * inside.sum()


@pytest.mark.parametrize("weights", [(0.5,), (0.2, 0.6), (0.1, 0.4, 0.8)])
def test_points_that_fly_between_sphere_and_wall_fall(ball, weights):
    z = ball.truth.xyz[..., 2].astype(np.float64)
    wall = z > 750
    flying = np.zeros(z.shape, np.bool_)
    for i in range(z.shape[0]):
        edges = np.flatnonzero(np.diff(wall[i].astype(int)))
        for edge, step in zip(edges, (1, -1), strict=False):
            for k, weight in enumerate(weights):
                j = edge + (k + 1 if step > 0 else -k)
                z[i, j] = z[i, edge - 8] * (1 - weight) + z[i, edge + 9] * weight
                flying[i, j] = True
    flying &= ball.lit

    def fly(xyz):
        xyz[flying] = along_rays(ball, z)[flying]

    found, falls, removed = filtered(ball, change=fly)
    assert flying.sum() > 100
    assert not (flying & ~falls).any()
    assert removed["edges"] + removed["fragments"] == falls.sum()
    assert np.isfinite(found.xyz[..., 2]).sum() - falls.sum() > 0.95 * ball.lit.sum()


def test_specks_fall_and_large_islands_stay(ball):
    depth = np.full(ball.lit.shape, np.nan)
    depth[50:54, 60:64] = 700  # 16 px
    depth[100:110, 60:70] = 700  # 100 px
    depth[150:210, 60:260] = 700
    xyz = along_rays(ball, depth)
    sigma = np.full(depth.shape, 0.1, np.float32)
    falls, removed = apply_filters(xyz, sigma, np.ones_like(sigma), FilterSettings())
    assert removed["fragments"] == 16
    assert falls[50:54, 60:64].all()
    assert not falls[100:110, 60:70].any()


def test_lines_one_pixel_wide_are_no_fragments_however_they_are_broken(ball):
    depth = np.full(ball.lit.shape, np.nan)
    depth[20:220:9] = 700  # whole stripes, above the limit
    depth[24:220:9, np.arange(depth.shape[1]) % 17 < 12] = 700  # dotted ones, each dot below it
    xyz = along_rays(ball, depth)
    sigma = np.full(depth.shape, 0.1, np.float32)
    for turned in (False, True):
        points = np.ascontiguousarray(xyz.transpose(1, 0, 2)) if turned else xyz
        errors = np.ascontiguousarray(sigma.T) if turned else sigma
        falls, removed = apply_filters(points, errors, np.ones(points.shape[:2]), FilterSettings())
        assert removed["fragments"] == 0
        assert not falls.any()


def test_a_map_that_is_sparse_by_its_method_keeps_its_points(ball):
    depth = np.full(ball.lit.shape, np.nan)
    depth[::3, ::3] = 700
    sigma = np.full(depth.shape, 0.1, np.float32)
    falls, _ = apply_filters(along_rays(ball, depth), sigma, np.ones_like(sigma), FilterSettings())
    assert not falls.any()


def test_a_map_noisier_than_it_says_is_not_torn_apart(ball):
    rng = np.random.default_rng(7)
    z = 700 + rng.normal(0, 3.0, ball.lit.shape)
    xyz = along_rays(ball, z)
    sigma = np.full(z.shape, 0.5, np.float32)
    assert noise_factor(xyz[..., 2], sigma) == pytest.approx(6, rel=0.05)
    assert at_depth_edge(xyz, sigma, np.ones(z.shape, np.bool_)).mean() < 0.005


def test_edges_are_those_of_plain_numpy(ball):
    rng = np.random.default_rng(3)
    z = 700 + 0.3 * rng.normal(size=ball.lit.shape) + 40 * (rng.random(ball.lit.shape) < 0.01)
    xyz = along_rays(ball, z)
    there = rng.random(z.shape) < 0.97
    sigma = np.full(z.shape, 0.3, np.float32)
    noise = NOISE_SIGMAS * math.sqrt(2) * noise_factor(xyz[..., 2], sigma)
    expected = np.zeros(z.shape, np.bool_)
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        step = (xyz[other] - xyz[one]).astype(float)
        sight = xyz[one] + 0.5 * step
        length = np.linalg.norm(sight, axis=-1)
        along = (step * sight).sum(axis=-1) / length
        across = np.sqrt(np.maximum((step * step).sum(axis=-1) - along**2, 0))
        jump = np.abs(along) - math.tan(math.radians(80)) * across > noise * 0.3
        jump &= there[one] & there[other]
        expected[one] |= jump
        expected[other] |= jump
    assert expected.sum() > 1000
    np.testing.assert_array_equal(at_depth_edge(xyz, sigma, there), expected)


@pytest.mark.parametrize("share", [0.3, 0.55, 0.9])
def test_small_fragments_are_those_of_connected_components(share):
    there = np.random.default_rng(5).random((97, 131)) < share
    _, labels, stats, _ = cv2.connectedComponentsWithStats(there.astype(np.uint8), connectivity=4)
    for limit in (1, 2, 9, 60):
        small = stats[:, cv2.CC_STAT_AREA] < limit
        small[0] = False
        falls, count = small_fragments(there, limit)
        np.testing.assert_array_equal(falls, small[labels])
        assert count == falls.sum()


def test_limits_take_what_lies_outside_and_count_it(ball):
    depth = FilterSettings(**ONLY_LIMITS, depth=(0.0, 700.0))
    found, falls, removed = filtered(ball, settings=depth)
    z = found.xyz[..., 2]
    np.testing.assert_array_equal(falls, z > 700)
    assert removed == {"confidence": 0, "edges": 0, "depth": int((z > 700).sum()), "box": 0, "fragments": 0}

    box = FilterSettings(**ONLY_LIMITS, box=(-20, math.inf, -math.inf, 30, 0, 700))
    found, falls, removed = filtered(ball, settings=box)
    x, y, z = np.moveaxis(found.xyz, -1, 0)
    kept = np.isfinite(z) & ~falls
    np.testing.assert_array_equal(kept, (x >= -20) & (y <= 30) & (z <= 700))
    assert removed["box"] == falls.sum()


def test_confidence_is_asked_first():
    xyz = np.ones((4, 4, 3), np.float32)
    confidence = np.linspace(0, 1, 16, dtype=np.float32).reshape(4, 4)
    settings = FilterSettings(**ONLY_LIMITS, min_confidence=0.5, depth=(2.0, 3.0))
    falls, removed = apply_filters(xyz, np.ones((4, 4), np.float32), confidence, settings)
    assert falls.all()
    assert removed["confidence"] == 8
    assert removed["depth"] == 8


def test_limits_are_read_from_text():
    assert parse_depth("1100:1300") == (1100, 1300)
    assert parse_depth(":1300") == (-math.inf, 1300)
    assert parse_box("-100:100,:80,1100:") == (-100, 100, -math.inf, 80, 1100, math.inf)


@pytest.mark.parametrize("text", ["", "5", "a:b", "5:5", "9:5", "1:2:3", "1:2,3:4", "nan:5"])
def test_limits_that_make_no_sense_are_refused(text):
    with pytest.raises(ConfigError, match="depth"):
        parse_depth(text)
    with pytest.raises(ConfigError, match="box"):
        parse_box(text)


@pytest.mark.parametrize(
    "members",
    [
        {"unknown": 1},
        {"depth": [5, 1]},
        {"depth": [1]},
        {"depth": "ab"},
        {"box": [0, 1, 0, 1]},
        {"min_confidence": 2},
        {"max_angle_deg": 95},
        {"min_fragment": -1},
    ],
)
def test_settings_that_make_no_sense_are_refused(members):
    with pytest.raises(ConfigError):
        FilterSettings.from_dict(members)


def test_settings_survive_plain_data():
    settings = FilterSettings(depth=(1, math.inf), box=(-1, 1, -2, 2, -math.inf, 3), min_confidence=0.3)
    assert FilterSettings.from_dict(json.loads(json.dumps(settings.as_dict(), allow_nan=False))) == settings
    assert FilterSettings.from_dict(asdict(settings)) == settings
    assert FilterSettings.from_dict({}) == FilterSettings()
