"""Noise from pairs of pixels, where three shifts leave no residual, against the same in plain NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from scanner.decode.agreement import remainders_of
from scanner.decode.noise import NoiseModel, default_noise, fit_line
from scanner.decode.pair_noise import PAIR_DISTANCE, UNFOLDED_SIGMA, noise_of_pairs
from scanner.decode.pmp_plan import plan_axis, whole_sets
from scanner.patterns import PmpPattern

PATTERN = PmpPattern(("y",), (1.0, 8.0, 64.0), (3, 3, 3))
PLAN = plan_axis(PATTERN, 500, whole_sets(PATTERN))


def sample(noise, runs=300, seed=0):
    """Runs of 64 pixels of a sloping surface, of dark and bright places, a tenth of which have no light."""
    random = np.random.default_rng(seed)
    mean = np.repeat(random.uniform(4, 150, (runs, 1)), 64, axis=1).astype(np.float32)
    modulations = np.broadcast_to(mean * np.float32(0.9), (3, runs, 64)).copy()
    cycles = random.uniform(0.1, 0.9, (runs, 1)) + np.arange(64) * 1e-4
    sigma = np.sqrt(noise.variance(mean) * PLAN.gains[:, None, None] / (4 * np.pi**2)) / modulations
    phases = np.array(PATTERN.frequencies)[:, None, None] * cycles + random.normal(size=sigma.shape) * sigma
    return ((phases + 0.5) % 1 - 0.5).astype(np.float32), modulations, mean, random.uniform(size=mean.shape) > 0.1


def plain(phases, modulations, mean, good):
    model, pair = default_noise(255), good[:, :-PAIR_DISTANCE] & good[:, PAIR_DISTANCE:]
    ends = slice(None, -PAIR_DISTANCE), slice(PAIR_DISTANCE, None)
    one, other = (np.stack(remainders_of(PLAN.ladder, phases[:, :, at][:, pair], PLAN.centre)) for at in ends)
    apart = one - other - np.rint(one - other)
    gains = PLAN.gains[:, None] / (4 * np.pi**2)
    per_sample = PLAN.ladder.errors**2 @ sum(gains / modulations[:, :, at][:, pair] ** 2 for at in ends)
    level = np.broadcast_to(sum(mean[:, at][pair] for at in ends) / 2, apart.shape)
    for _ in range(3):
        use = per_sample * model.variance(level) < UNFOLDED_SIGMA**2
        squares = (apart[use] ** 2 / per_sample[use]).astype(np.float32)
        model = NoiseModel(*fit_line(level[use], squares, 1), measured=True)
    return model


@pytest.mark.parametrize("noise", [NoiseModel(0.7, 0.02, measured=True), NoiseModel(5.0, 0.0, measured=True)])
def test_it_is_that_of_the_plain_form_and_the_true_one(noise):
    seen = sample(noise)
    found, expected = noise_of_pairs(PLAN, *seen, 255), plain(*seen)
    levels = np.array([5, 50, 150], np.float32)
    assert found.measured
    assert np.allclose(found.variance(levels), expected.variance(levels), rtol=0.03)
    assert np.allclose(found.variance(levels), noise.variance(levels), rtol=0.2)


def test_few_pairs_and_a_single_rung_leave_the_default():
    phases, modulations, mean, good = sample(NoiseModel(5.0, 0.0, measured=True), runs=6)
    assert noise_of_pairs(PLAN, phases, modulations, mean, good, 255) == default_noise(255)
    alone = PmpPattern(("y",), (1.0,), (3,))
    seen = phases[:1].copy(), modulations[:1].copy(), mean, good
    assert noise_of_pairs(plan_axis(alone, 500, whole_sets(alone)), *seen, 255) == default_noise(255)
