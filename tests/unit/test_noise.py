"""The noise model: what residuals say of shot and read noise, and what stands in where they say nothing."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from scanner.decode.noise import CUT_SIGMAS, ROUNDING_VARIANCE, NoiseModel, default_noise, fit_line


def fit_noise(level, squares, freedom):
    return NoiseModel(*fit_line(level, squares, freedom), measured=True)


def residuals(read, per_level, freedom, count=30_000, seed=2):
    random = np.random.default_rng(seed)
    level = random.uniform(5, 220, count).astype(np.float32)
    squares = (read + per_level * level) * random.chisquare(freedom, count)
    return level, squares.astype(np.float32)


@pytest.mark.parametrize("freedom", [1, 3, 15])
@pytest.mark.parametrize(("read", "per_level"), [(0.6, 0.02), (4.0, 0.0), (0.1, 0.1)])
def test_the_model_is_found_again(read, per_level, freedom):
    level, squares = residuals(read, per_level, freedom)
    model = fit_noise(level, squares, freedom)
    at = np.array([10, 100, 200], np.float32)
    assert np.allclose(model.variance(at), read + per_level * at, rtol=0.12, atol=0.05)


def test_pixels_that_moved_do_not_spoil_it():
    level, squares = residuals(0.6, 0.02, 5)
    squares[::10] *= 400
    model = fit_noise(level, squares, 5)
    assert model.variance(np.float32(100)) == pytest.approx(2.6, rel=0.3)


def test_no_frame_is_better_than_its_rounding():
    level, squares = residuals(1e-6, 0.0, 5)
    model = fit_noise(level, squares, 5)
    assert model.variance(np.float32([0, 255])).tolist() == pytest.approx([ROUNDING_VARIANCE] * 2)


def test_noise_that_falls_with_the_level_is_taken_as_even():
    level, squares = residuals(6.0, -0.02, 5)
    model = fit_noise(level, squares, 5)
    assert model.per_level == 0
    assert 1.6 < model.read < 6


def test_a_single_grey_level_gives_its_variance():
    squares = np.random.default_rng(0).chisquare(4, 5000).astype(np.float32) * 3
    model = fit_noise(np.full(5000, 80, np.float32), squares, 4)
    assert model.variance(np.float32(80)) == pytest.approx(3, rel=0.1)


def test_the_default_scales_with_the_range():
    assert not default_noise(255).measured
    assert default_noise(4095).read == pytest.approx(default_noise(255).read * (4095 / 255) ** 2)


def clipped(level, read, per_level, shifts, seed=4):
    """(mean, sum of squared residuals) of whole grey levels that end at 0, under fringes of a fifth of the level."""
    random = np.random.default_rng(seed)
    alpha = 2 * np.pi * np.arange(shifts) / shifts
    light = level[:, None] * (1 + 0.2 * np.cos(alpha + random.uniform(0, 2 * np.pi, (level.size, 1))))
    seen = np.maximum(np.rint(light + random.normal(size=light.shape) * np.sqrt(read + per_level * light)), 0)
    design = np.stack([np.ones(shifts), np.cos(alpha), np.sin(alpha)], axis=1)
    left = seen - seen @ design @ np.linalg.inv(design.T @ design) @ design.T
    return seen.mean(axis=1).astype(np.float32), (left**2).sum(axis=1).astype(np.float32)


@pytest.mark.parametrize("shifts", [4, 8])
@pytest.mark.parametrize("dark", [0.3, 0.9])
def test_noise_that_black_cuts_off_is_not_taken_for_little_noise(shifts, dark):
    """A dark room around what is measured: sigmas there, and of dark surfaces, came out too small."""
    random = np.random.default_rng(0)
    level = np.where(np.arange(40_000) < 40_000 * dark, 0.2, random.uniform(4, 60, 40_000))
    model = fit_noise(*clipped(level, 0.64, 0.017, shifts), shifts - 3)
    at = np.array([0, 5, 50], np.float32)
    assert np.allclose(model.variance(at), 0.64 + 1 / 12 + 0.017 * at, rtol=0.15)


def test_an_image_that_is_all_black_says_what_it_can():
    model = fit_noise(*clipped(np.full(4000, 0.3), 0.64, 0.017, 8), 5)
    assert ROUNDING_VARIANCE <= model.read < 0.5


def test_above_the_limit_a_hundredth_of_the_variance_is_lost_below_it_more():
    d = np.linspace(-2, 5, 141)
    mean = d * ndtr(d) + np.exp(-(d**2) / 2) / np.sqrt(2 * np.pi)
    variance = mean * d + ndtr(d) - mean**2
    seen = mean / np.sqrt(variance)
    assert (np.diff(seen) > 0).all()
    assert np.interp(CUT_SIGMAS, seen, variance) == pytest.approx(0.99, abs=0.003)
    assert np.interp(CUT_SIGMAS / 2, seen, variance) < 0.8
