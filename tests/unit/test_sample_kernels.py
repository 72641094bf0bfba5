"""What is judged of a PMP scan's sample in kernels, against the same in plain NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from scanner.decode.agreement import folded_medians, remainders, remainders_of
from scanner.decode.middles import middle_of_squares, middles_of_bins, nth_of, order_of
from scanner.decode.noise import default_noise, fit_line
from scanner.decode.pmp_plan import plan_axis, whole_sets
from scanner.decode.pmp_sample import Sample
from scanner.decode.sample_kernels import BINS, MIN_PIXELS, judge_steps, mean_of_good
from scanner.decode.unwrapping import plan_ladder
from scanner.patterns import PmpPattern


def numbers(size, seed=0, steps=24):
    """Of both signs, with many equal ones, as means of whole grey levels are."""
    drawn = np.random.default_rng(seed).normal(20, 30, size)
    return (np.rint(drawn * steps) / steps).astype(np.float32)


@pytest.mark.parametrize("size", [70001, 33, 4096, 5001])
def test_the_nth_number_is_that_of_all_in_their_order(size):
    keys = numbers(size)
    for n in (0, size // 3, size - 1):
        assert nth_of(keys, n) == np.sort(keys)[n]


@pytest.mark.parametrize("size", [70001, 33, 4096, 5001])
def test_an_order_is_good_to_a_percent_and_equal_ones_come_as_they_were(size):
    keys = np.abs(numbers(size)) + np.float32(0.01)
    order = order_of(keys)
    assert np.array_equal(np.sort(order), np.arange(size))
    assert np.allclose(keys[order], np.sort(keys), rtol=0.011, atol=0)
    same = np.diff(keys[order]) == 0
    assert np.all(np.diff(order)[same] > 0)


def test_an_order_of_numbers_near_each_other_is_good_to_a_thousandth():
    keys = np.random.default_rng(2).uniform(50, 140, 5000).astype(np.float32)
    assert np.allclose(keys[order_of(keys)], np.sort(keys), rtol=1e-3, atol=0)


def test_one_that_lies_far_out_leaves_the_others_their_order():
    keys = np.random.default_rng(2).uniform(100, 110, 5000).astype(np.float32)
    keys[7], keys[4000], keys[3], keys[9] = 0.0, 1e8, -20.0, -0.0
    order = order_of(keys)
    assert list(order[[0, 1, 2, -1]]) == [3, 7, 9, 4000]
    assert np.allclose(keys[order[3:]], np.sort(keys)[3:], rtol=0.011, atol=0)


@pytest.mark.parametrize("size", [100, 4099])
def test_medians_of_bins_are_numpys(size):
    keys, values = np.abs(numbers(size)), numbers(size, seed=1)
    x, y, order = middles_of_bins(keys, values, BINS, False)
    assert np.array_equal(order, order_of(keys))
    bins = order[: size // BINS * BINS].reshape(BINS, -1)
    middle = bins.shape[1] // 2
    assert np.array_equal(x, keys[bins[:, middle]])
    assert np.array_equal(y, np.partition(values[bins], middle, axis=1)[:, middle])


@pytest.mark.parametrize("sigma", [0.8, 1.0, 2.0])
def test_whole_grey_levels_leave_the_noise_of_four_shifts_as_it_is(sigma):
    levels = np.rint(np.random.default_rng(1).normal(100, sigma, (4, 30, 341)))
    squares = ((levels[0] - levels[1] + levels[2] - levels[3]) ** 2 / 4).astype(np.float32)
    variances = [middle_of_squares(of_bin) / (1 - 2 / 9) ** 3 for of_bin in squares]
    assert np.mean(variances) == pytest.approx(sigma**2 + 1 / 12, rel=0.06)


def sample(size=2048, seed=0):
    """Of three sets, a third of whose pixels are dim, and a few of which are clipped."""
    random = np.random.default_rng(seed)
    mean = random.uniform(10, 200, size).astype(np.float32)
    height = mean * random.choice([0.6, 0.02, 0.9], size)
    cycles = random.uniform(0.1, 0.9, size)
    noise = random.normal(0, 0.01, (3, size))
    phases = (np.array([1, 8, 64])[:, None] * cycles + noise + 0.5) % 1 - 0.5
    return Sample(
        phases.astype(np.float32).reshape(3, -1, 64),
        (height * random.uniform(0.8, 1, (3, size))).astype(np.float32).reshape(3, -1, 64),
        mean.reshape(-1, 64),
        (4 * random.chisquare(15, size)).astype(np.float32).reshape(-1, 64),
        (random.uniform(size=size) > 0.05).reshape(-1, 64),
        np.full(3, 0.25, np.float32),
        15,
        255,
        np.arange(0, size, 64),
    )


def test_a_sample_is_judged_as_in_the_plain_form():
    drawn, least, sigmas = sample(), 3.0, 7.0
    pattern = PmpPattern(("y",), (1.0, 8.0, 64.0), (8, 8, 8))
    judged = drawn.judged(plan_axis(pattern, 500, whole_sets(pattern)), least, sigmas, 0.001)
    noise = judged.noise
    alone = fit_line(drawn.mean[drawn.usable], drawn.residual[drawn.usable], drawn.freedom)
    assert noise.measured
    assert [noise.read, noise.per_level] == pytest.approx(alone)

    model = noise.variance(drawn.mean)
    own = (np.float32(drawn.prior) * model + drawn.residual) / np.float32(drawn.prior + drawn.freedom)
    variance = drawn.gains[:, None, None] * np.maximum(own, model)
    enough = np.maximum(np.float32(sigmas**2) * variance, np.float32(least**2))
    good = (drawn.modulations**2 > enough).all(axis=0) & drawn.usable
    assert 500 < np.count_nonzero(good) < 1900
    mean, count = mean_of_good(drawn.residual, good, 8)
    assert count == np.count_nonzero(good[::8])
    assert mean == pytest.approx(drawn.residual[::8][good[::8]].mean(), rel=1e-5)
    assert mean_of_good(drawn.residual, np.zeros_like(good), 8) == (0.0, 0)
    assert np.array_equal(drawn.good(noise, least, sigmas), good)
    cycles2 = (variance / np.float32(4 * np.pi**2))[:, good] / drawn.modulations[:, good] ** 2
    assert np.allclose(judged.cycles2, cycles2, rtol=1e-6, atol=0)
    steps = np.empty((2, 4))
    judge(plan_ladder(pattern.frequencies, [0.25] * 3), drawn.phases[:, good], judged.cycles2, steps, 0.001)
    assert np.allclose(judged.steps, steps, rtol=1e-4, atol=1e-6)


def test_little_evidence_leaves_the_default_noise():
    pattern = PmpPattern(("y",), (1.0, 8.0, 64.0), (8, 8, 8))
    judged = sample(64).judged(plan_axis(pattern, 500, whole_sets(pattern)), 3.0, 7.0, 0.001)
    assert judged.noise == default_noise(255)


def judge(ladder, phases, cycles2, steps, floor=0.0):
    errors2 = (ladder.errors**2).astype(np.float32)
    combinations = ladder.combinations.astype(float)
    judge_steps(phases, cycles2, combinations, ladder.frequencies, errors2, 0.5, folded_medians(), floor, steps)


def test_few_pixels_say_nothing_of_steps():
    phases = np.zeros((3, MIN_PIXELS - 1), np.float32)
    steps = np.empty((2, 4))
    judge(plan_ladder((1, 8, 64), [0.25] * 3), phases, phases + 1, steps, 0.01)
    assert np.array_equal(steps, [[0, 0.01, 0, 0]] * 2)


@pytest.mark.parametrize("frequencies", [(1, 8, 64), (59, 64, 70)])
def test_steps_are_judged_as_in_the_plain_form(frequencies):
    random = np.random.default_rng(3)
    ladder = plan_ladder(frequencies, [0.25] * 3)
    cycles2 = random.uniform(1e-5, 1e-4, (3, 3001)).astype(np.float32)
    seen = np.array(frequencies)[:, None] * random.uniform(0.1, 0.9, 3001) + random.normal(0, np.sqrt(cycles2) * 1.5)
    phases = ((seen + 0.5) % 1 - 0.5).astype(np.float32)
    judge(ladder, phases, cycles2, steps := np.empty((len(ladder.errors), 4)))
    found = remainders(ladder, steps, phases.shape[1])

    for j, remainder in enumerate(remainders_of(ladder, phases, 0.5)):
        errors2 = (ladder.errors[j] ** 2).astype(np.float32)
        variance = errors2 @ cycles2
        bins = order_of(variance)[: variance.size // BINS * BINS].reshape(BINS, -1)
        middle = bins.shape[1] // 2
        y = (np.median(np.abs(remainder)[bins], axis=1) / 0.6745) ** 2
        rest = np.average(y - variance[bins[:, middle]], weights=1 / y)
        better = bins[: BINS // 2].reshape(-1)
        mean = np.exp(2j * np.pi * remainder[better]).mean()
        assert found[j].expected_sigma == pytest.approx(np.sqrt(variance[better[better.size // 2]]), rel=1e-5)
        assert found[j].systematic == pytest.approx(np.sqrt(rest / errors2.sum()), rel=0.02)
        assert found[j].agreement == pytest.approx(abs(mean), abs=1e-6)
        assert found[j].offset == pytest.approx(np.angle(mean) / (2 * np.pi), abs=1e-6)
    assert len(found) == len(ladder.errors) > 1
