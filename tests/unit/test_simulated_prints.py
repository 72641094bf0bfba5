"""Prints: what a camera pixel sees of them is the mean over its footprint, against forty thousand samples by NumPy."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.special import erf

from drivers.simulated import coverage, sensor, targets
from drivers.simulated.print_blur import print_gain
from drivers.simulated.textures import Footprints, chequer

SAMPLES = 200
S, T = np.meshgrid(*(2 * [(np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5]))


def footprints(count: int) -> list[np.ndarray]:
    """Middles and sides (u, v, ax, ay, bx, by): small and large ones, either way round, some along the raster."""
    generator = np.random.default_rng(7)
    drawn = [
        np.concatenate((generator.uniform(-2, 9, 2), generator.normal(size=4) * size))
        for size in np.resize([0.1, 0.6, 2.0], count)
    ]
    return [*drawn, np.array([1.5, 2.5, 1, 0, 0, 1]), np.array([2.0, 2.0, 2, 0, 0, 1]), np.array([3.5, 3, 1, 1, -1, 1])]


@pytest.mark.parametrize("tiled", [False, True])
def test_a_rasters_mean_over_a_footprint_is_exact(tiled: bool) -> None:
    values = np.random.default_rng(8).random((5, 7), dtype=np.float32)
    height, width = values.shape
    for u, v, ax, ay, bx, by in footprints(24):
        c, r = np.floor(u + S * ax + T * bx).astype(int), np.floor(v + S * ay + T * by).astype(int)
        seen = values[r % height, c % width]
        if not tiled:
            seen = np.where((r >= 0) & (r < height) & (c >= 0) & (c < width), seen, np.float32(0.5))
        found = coverage.raster_mean(values, tiled, np.float32(0.5), u, v, ax, ay, bx, by)
        assert found == pytest.approx(seen.mean(dtype=np.float64), abs=1.5 / SAMPLES)


def test_a_discs_share_of_a_footprint_is_exact() -> None:
    for (u, v, ax, ay, bx, by), radius in zip(footprints(24), np.resize([0.3, 2.0, 5.0], 27), strict=True):
        inside = (u + S * ax + T * bx) ** 2 + (v + S * ay + T * by) ** 2 < radius**2
        assert coverage.disc_share(u, v, ax, ay, bx, by, radius) == pytest.approx(inside.mean(), abs=5e-4)


def test_the_charuco_print_is_the_board_that_opencv_draws() -> None:
    print_ = targets.POSED["charuco_poses"].texture(30.0)
    drawn = targets.charuco_board().generateImage((1200, 840)) < 128
    assert np.array_equal(cv2.resize(print_.values, (1200, 840), interpolation=cv2.INTER_NEAREST) < 0.4, drawn)


@pytest.mark.parametrize(("sigma", "turn_deg"), [(0.7, 0.0), (0.7, 12.0), (0.7, 40.0), (0.4, 25.0), (1.5, 33.0)])
def test_a_print_is_blurred_before_pixels_gather_it(sigma: float, turn_deg: float) -> None:
    """Where four squares meet: a product of two error functions, since a Gaussian is the same in every direction."""
    for place in np.random.default_rng(9).uniform(-0.5, 0.5, (4, 2)):
        footprints, own = turned_chequer(turn_deg, place)
        albedo = footprints.means(np.arange(own.size))[:, 0, 0].reshape(own.shape)
        taps = sensor.blur_taps(sigma)
        reach, whole = len(taps) - 1, np.concatenate((taps[:0:-1], taps))
        inside = np.s_[reach:-reach, reach:-reach]
        gain = np.ones(own[inside].shape, dtype=np.float32)
        print_gain(albedo, own, sigma, footprints, gain)
        folded = cv2.sepFilter2D(albedo, cv2.CV_32F, whole, whole)[inside]
        exact = blurred_corner(sigma, turn_deg, place)[inside]
        assert np.abs(folded * gain - exact).max() < 1.5e-3
        assert sigma > 1 or np.abs(folded - exact).max() > 5e-3


def test_a_print_beside_another_body_is_left_as_pixels_fold_it() -> None:
    footprints, own = turned_chequer(12.0, np.zeros(2))
    albedo = footprints.means(np.arange(own.size))[:, 0, 0].reshape(own.shape)
    own[:, 20:] = False
    gain = np.ones((35, 35), dtype=np.float32)
    print_gain(albedo, own, 0.7, footprints, gain)
    assert np.all(gain[:, 14:] == 1)
    assert not np.all(gain[:, :14] == 1)


def turned_chequer(turn_deg: float, place: np.ndarray) -> tuple[Footprints, np.ndarray]:
    """41 x 41 pixels of 1 mm whose middle one is `place` px off the corner of four squares of 0.1 and 0.9."""
    along, down = corner_axes(turn_deg, place)
    directions = np.column_stack((along.ravel() / 9, down.ravel() / 9, np.ones(41 * 41)))
    rectangle = np.array([0.0, 0, 0, 9, 1, 0, 0, 0, 1, 0, 0, 0, 1, 99, 99, 0])
    return Footprints(chequer(0.1, 0.9), rectangle, directions, np.zeros(3), 41), np.ones((41, 41), dtype=bool)


def corner_axes(turn_deg: float, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[-20.0:21, -20.0:21]
    x, y, c, s = x + place[0], y + place[1], np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    return c * x + s * y, c * y - s * x


def blurred_corner(sigma: float, turn_deg: float, place: np.ndarray) -> np.ndarray:
    nodes, weights = np.polynomial.legendre.leggauss(9)
    total = np.zeros((41, 41))
    for dy, wy in zip(nodes / 2, weights / 2, strict=True):
        for dx, wx in zip(nodes / 2, weights / 2, strict=True):
            u, v = corner_axes(turn_deg, place + np.array([dx, dy]))
            total += wx * wy * erf(u / sigma / np.sqrt(2)) * erf(v / sigma / np.sqrt(2))
    return 0.5 - 0.4 * total
