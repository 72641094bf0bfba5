"""The width of a step in depth, of made-up edges whose width is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.special import erf

from scanner.calibration.edges import edge_width
from scanner.errors import DecodeError


def step(sigma_px: float, *, turn_deg: float = 5.0, noise_mm: float = 0.05, tilt: float = 0.0) -> np.ndarray:
    """(120, 160, 3) mm: near on one side of an edge through the middle, 10 mm farther on the other; 0.4 mm a pixel."""
    y, x = np.mgrid[:120, :160].astype(np.float64)
    angle = np.radians(turn_deg)
    off = (x - 79.3) * np.cos(angle) + (y - 59.8) * np.sin(angle)
    share = (off > 0) if sigma_px == 0 else 0.5 * (1 + erf(off / sigma_px / np.sqrt(2)))
    noise = np.random.default_rng(0).normal(0, noise_mm, x.shape)
    return np.stack((0.4 * x, 0.4 * y, 500 + 10 * share + tilt * x + noise), axis=-1)


@pytest.mark.parametrize(("turn_deg", "tilt"), [(5.0, 0.0), (84.0, 0.0), (-7.0, 0.2), (186.0, -0.1)])
def test_a_blurred_step_is_as_wide_as_its_blur(turn_deg: float, tilt: float) -> None:
    found = edge_width(step(1.5, turn_deg=turn_deg, tilt=tilt))
    # 10 to 90 % of a Gaussian's integral: 2.563 sigma.
    assert found.width_px == pytest.approx(2.563 * 1.5, rel=0.08)
    assert found.width_mm == pytest.approx(0.4 * found.width_px, rel=0.15)
    assert found.step_mm == pytest.approx(10.0, abs=0.1)
    assert found.noise_mm == pytest.approx(0.05, rel=0.3)
    assert found.gap_px == 0
    assert found.lines > 100


def test_a_sharp_step_is_narrower_than_a_pixel_and_a_gap_is_part_of_the_width() -> None:
    assert edge_width(step(0.0)).width_px < 0.5
    holes = step(0.0)
    y, x = np.mgrid[:120, :160]
    off = (x - 79.3) * np.cos(np.radians(5)) + (y - 59.8) * np.sin(np.radians(5))
    holes[np.abs(off) < 2.0] = np.nan
    found = edge_width(holes)
    assert found.width_px == pytest.approx(0.8 * 4.0, abs=0.5)
    assert found.gap_px > 2.5


def test_what_is_no_edge_is_refused() -> None:
    flat = step(1.0)
    flat[..., 2] = 500 + np.random.default_rng(1).normal(0, 0.05, flat.shape[:2])
    with pytest.raises(DecodeError, match=r"no step|no straight edge"):
        edge_width(flat)
    with pytest.raises(DecodeError, match="too few"):
        edge_width(np.full((50, 50, 3), np.nan))
    ball = step(0.0)
    disc = cv2.circle(np.zeros((120, 160), np.uint8), (80, 60), 40, 1, -1).astype(bool)
    ball[..., 2] = np.where(disc, 490, 500)
    with pytest.raises(DecodeError, match=r"no step|no straight edge|lines of the picture"):
        edge_width(ball)
