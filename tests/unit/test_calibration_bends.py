"""Lines bent by a lens: their curvature from the view's points, and corners of curved edges where optics put them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.special import erf

from scanner.calibration.bends import line_bends
from scanner.calibration.detection import Detection, detect
from scanner.calibration.targets import Target, parse_target
from scanner.geometry import Lens

SIZE = (700, 540)
TARGET = parse_target("chessboard:9x6:25")
ROTATION = np.asarray(cv2.Rodrigues(np.array([0.35, -0.3, 0.1]))[0])
SHIFT = np.array([5.0, -4.0, 360.0])
BLUR_PX = 0.7
WIDE = np.array([-0.3, 0.1, 4e-4, -2e-4, 0.0])


def lens(distortion: np.ndarray) -> Lens:
    return Lens(SIZE, np.array([[800.0, 0, 349.5], [0, 800.0, 269.5], [0, 0, 1]]), distortion)


def seen(through: Lens, points: np.ndarray) -> np.ndarray:
    return through.project(np.pad(points, ((0, 0), (0, 1))) @ ROTATION.T + SHIFT)


def picture(through: Lens, target: Target) -> np.ndarray:
    """A chessboard by its edges' distances from each pixel, to first order: no samples, no staircases."""
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    pixels = np.column_stack((x.ravel(), y.ravel())).astype(np.float64)
    at = on_board(through, pixels) / target.spacing_mm
    steps = np.stack(
        [on_board(through, pixels + half) - on_board(through, pixels - half) for half in np.eye(2) / 2], -1
    )
    slope = np.linalg.norm(steps / target.spacing_mm, axis=2)
    # Corners lie half a square off whole numbers where their count is even.
    off = (np.array([target.columns, target.rows]) - 1) / 2
    line = np.clip(np.round(at + off), -1, (target.columns, target.rows))
    edges = erf((at + off - line) / slope / BLUR_PX / np.sqrt(2)) * np.where(line % 2, 1, -1)
    inside = (np.abs(at) < off + 1).all(axis=1)
    return np.where(inside, 120 + 90 * edges.prod(axis=1), 210).reshape(SIZE[::-1]).astype(np.float32)


def on_board(through: Lens, pixels: np.ndarray) -> np.ndarray:
    """(N, 2) mm on the target's plane, which each pixel sees."""
    rays = np.column_stack((through.normalised(pixels), np.ones(len(pixels))))
    normal = ROTATION[:, 2]
    return ((rays * ((normal @ SHIFT) / (rays @ normal))[:, None] - SHIFT) @ ROTATION)[:, :2]


@pytest.mark.parametrize("distortion", [np.zeros(5), np.array([-0.08, 0.03, 4e-4, -2e-4, 0.0]), WIDE])
def test_corners_of_curved_edges_are_where_the_lens_puts_them(distortion: np.ndarray) -> None:
    through = lens(distortion)
    found = detect(picture(through, TARGET), TARGET)
    assert isinstance(found, Detection)
    true = seen(through, TARGET.points[:, :2])
    nearest = np.linalg.norm(found.points[:, None] - true, axis=2).argmin(axis=1)
    assert sorted(nearest) == list(range(len(true)))
    # With straight edges 0.0011 px through the second lens, 0.0042 px through the third.
    assert np.sqrt(((found.points - true[nearest]) ** 2).mean()) < 2e-4


@pytest.mark.parametrize(("columns", "rows", "near"), [(9, 6, 0.02), (6, 5, 0.1)])
def test_curvature_is_that_of_a_line_through_the_lens(columns: int, rows: int, near: float) -> None:
    """Oracle: three points of the line close to each other. Fewer points carry fewer terms, and tell less."""
    through, points = lens(WIDE), parse_target(f"chessboard:{columns}x{rows}:25").points[:, :2]
    wanted, directions = [], []
    for along in np.eye(2):
        before, at, after = (seen(through, points + step * along) for step in (-1.0, 0.0, 1.0))
        towards = (after - before) / 2
        bend = after - 2 * at + before
        wanted.append(np.linalg.det(np.stack((towards, bend), axis=-1)) / np.linalg.norm(towards, axis=1) ** 3)
        directions.append(towards)
    found = line_bends(points, seen(through, points), np.stack(directions, axis=1))
    truth = np.stack(wanted, axis=1)
    assert np.abs(truth).max() > 1e-4
    assert np.abs(found - truth).max() < near * np.abs(truth).max()


def test_a_point_far_off_bends_no_line() -> None:
    through, points = lens(WIDE), TARGET.points[:, :2]
    directions = np.broadcast_to(np.eye(2), (len(points), 2, 2))
    right = seen(through, points)
    wrong = right.copy()
    wrong[20] += (3.0, -2.0)
    others = np.arange(len(points)) != 20
    change = line_bends(points, wrong, directions) - line_bends(points, right, directions)
    assert np.abs(change[others]).max() < 2e-6  # 0.0001 px, 10 px along a line


def test_too_few_points_are_on_straight_lines() -> None:
    points = TARGET.points[:19, :2]
    directions = np.broadcast_to(np.eye(2), (19, 2, 2))
    assert not line_bends(points, seen(lens(WIDE), points), directions).any()


@pytest.mark.parametrize("seed", [25, 36])
def test_noise_does_not_shift_a_clear_board(seed: int) -> None:
    """OpenCV's exhaustive search finds these with a row of the border's corners in place of one of the board's."""
    through = lens(np.zeros(5))
    clear = picture(through, TARGET)
    found = detect(clear + np.random.default_rng(seed).normal(0, 3, clear.shape), TARGET)
    assert isinstance(found, Detection)
    true = seen(through, TARGET.points[:, :2])
    assert len(found.ids) == len(true)
    assert np.linalg.norm(found.points[:, None] - true, axis=2).min(axis=1).max() < 0.05
