"""The noise model: what residuals say of shot and read noise, and what stands in where they say nothing."""

from __future__ import annotations

import numpy as np
import pytest

from scanner.decode.noise import ROUNDING_VARIANCE, default_noise, fit_noise


def residuals(read, per_level, freedom, count=30_000, seed=2):
    random = np.random.default_rng(seed)
    level = random.uniform(5, 220, count).astype(np.float32)
    squares = (read + per_level * level) * random.chisquare(freedom, count)
    return level, squares.astype(np.float32)


@pytest.mark.parametrize("freedom", [1, 3, 15])
@pytest.mark.parametrize(("read", "per_level"), [(0.6, 0.02), (4.0, 0.0), (0.1, 0.1)])
def test_the_model_is_found_again(read, per_level, freedom):
    level, squares = residuals(read, per_level, freedom)
    model = fit_noise(level, squares, freedom, 255)
    assert model.measured
    at = np.array([10, 100, 200], np.float32)
    assert np.allclose(model.variance(at), read + per_level * at, rtol=0.12, atol=0.05)


def test_pixels_that_moved_do_not_spoil_it():
    level, squares = residuals(0.6, 0.02, 5)
    squares[::10] *= 400
    model = fit_noise(level, squares, 5, 255)
    assert model.variance(np.float32(100)) == pytest.approx(2.6, rel=0.3)


def test_no_frame_is_better_than_its_rounding():
    level, squares = residuals(1e-6, 0.0, 5)
    model = fit_noise(level, squares, 5, 255)
    assert model.variance(np.float32([0, 255])).tolist() == pytest.approx([ROUNDING_VARIANCE] * 2)


def test_noise_that_falls_with_the_level_is_taken_as_even():
    level, squares = residuals(6.0, -0.02, 5)
    model = fit_noise(level, squares, 5, 255)
    assert model.per_level == 0
    assert 1.6 < model.read < 6


def test_a_single_grey_level_gives_its_variance():
    squares = np.random.default_rng(0).chisquare(4, 5000).astype(np.float32) * 3
    model = fit_noise(np.full(5000, 80, np.float32), squares, 4, 255)
    assert model.variance(np.float32(80)) == pytest.approx(3, rel=0.1)


@pytest.mark.parametrize(("count", "freedom"), [(99, 5), (5000, 0)])
def test_little_evidence_leaves_the_default(count, freedom):
    level, squares = residuals(9.0, 0.0, max(freedom, 1), count)
    assert fit_noise(level, squares, freedom, 255) == default_noise(255)
    assert not default_noise(255).measured


def test_the_default_scales_with_the_range():
    assert default_noise(4095).read == pytest.approx(default_noise(255).read * (4095 / 255) ** 2)
