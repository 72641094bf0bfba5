"""Prints: what a camera pixel sees of them is the mean over its footprint, against forty thousand samples by NumPy."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from drivers.simulated import coverage, targets

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
