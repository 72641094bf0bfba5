"""The fit of the trigger board's clock: its bound holds for every clock and delay, and is no wider than it must be."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from drivers.serial_trigger.clock_fit import KEPT, ClockFit, Reading
from drivers.serial_trigger.protocol import Unwrapped

OFFSET_NS = 77_000_000_000_123


class Clock:
    """A board's clock with a true rate, read over a line that delays at random."""

    def __init__(self, rate: float, seed: int, delay_us: float = 400.0) -> None:
        self.rate, self.delay_us = rate, delay_us
        self.rng = np.random.default_rng(seed)

    def host_ns(self, board_us: float) -> float:
        return OFFSET_NS + 1e3 * board_us * self.rate

    def reading(self, board_us: int) -> Reading:
        before, after = self.rng.exponential(1e3 * self.delay_us, 2)
        true = self.host_ns(board_us)
        return Reading(board_us, int(true - before), int(true + after) + 1)


def fitted(clock: Clock, times_us: list[int]) -> ClockFit:
    fit = ClockFit()
    for board_us in times_us:
        fit.add(clock.reading(board_us))
    return fit


@settings(deadline=None, max_examples=60)
@given(
    ppm=st.floats(-5_900, 5_900),
    seed=st.integers(0, 1000),
    steps=st.lists(st.integers(1_000, 20_000_000), min_size=1, max_size=30),
    asked=st.integers(-5_000_000, 700_000_000),
)
def test_the_true_time_is_always_within_the_bound(ppm: float, seed: int, steps: list[int], asked: int) -> None:
    clock = Clock(1 + 1e-6 * ppm, seed)
    fit = fitted(clock, [int(t) for t in np.cumsum(steps)])
    told = fit.at(asked)
    assert abs(told.t_ns - clock.host_ns(asked)) <= told.bound_ns + 1
    assert abs(fit.rate - clock.rate) <= fit.rate_bound + 1e-12
    assert fit.breaks == 0


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("asked", [-1_000_000, 3_000_000, 60_000_000])
def test_the_bound_is_that_of_linear_programming(seed: int, asked: int) -> None:
    clock = Clock(1.0007, seed)
    readings = [clock.reading(500_000 * i) for i in range(12)]
    fit = ClockFit()
    for reading in readings:
        fit.add(reading)
    x = np.array([1e3 * r.board_us for r in readings])
    rows = np.stack((np.ones_like(x), x), axis=1)
    high = np.array([float(r.high_ns - OFFSET_NS) for r in readings])
    low = np.array([float(r.low_ns - OFFSET_NS) for r in readings])
    # Unknowns: offset in ms and rate in ppm from 1, or the solver's tolerances would show.
    met = np.concatenate((rows, -rows)) * [1.0, 1e-12]
    limits = np.concatenate((high - x, x - low)) / 1e6
    ends = []
    for sign in (1.0, -1.0):
        cost = sign * np.array([1.0, 1e3 * asked * 1e-12])
        solved = linprog(cost, A_ub=met, b_ub=limits, bounds=[(None, None), (-6_000, 6_000)])
        assert solved.success
        ends.append(sign * 1e6 * solved.fun + 1e3 * asked)
    told = fit.at(asked)
    assert told.t_ns - told.bound_ns == pytest.approx(OFFSET_NS + ends[0], abs=200)
    assert told.t_ns + told.bound_ns == pytest.approx(OFFSET_NS + ends[1], abs=200)


def test_more_readings_make_it_better() -> None:
    clock = Clock(1.003, 1)
    few, many = fitted(clock, [0, 50_000, 100_000]), fitted(clock, list(range(0, 20_000_000, 1_000_000)))
    assert many.at(20_000_000).bound_ns < few.at(200_000).bound_ns
    assert many.rate_bound < 1e-4
    assert few.rate_bound > 1e-3
    assert many.residual_ns < 3_000_000
    assert abs(many.offset_ns - OFFSET_NS) < 1_000_000


def test_a_clock_that_begins_anew_breaks_with_its_past() -> None:
    clock = Clock(1.0, 2)
    fit = fitted(clock, [0, 1_000_000, 2_000_000])
    for board_us in (3_000_000, 4_000_000):
        reading = clock.reading(board_us)
        fit.add(Reading(board_us, reading.low_ns + 10**9, reading.high_ns + 10**9))
    assert fit.breaks == 3
    told = fit.at(4_000_000)
    assert abs(told.t_ns - clock.host_ns(4_000_000) - 10**9) <= told.bound_ns


def test_it_forgets_the_distant_past() -> None:
    fit = fitted(Clock(1.0, 3), [0, 1_000_000, 900_000_000])
    assert len(fit) == 1
    fit = fitted(Clock(1.0, 3), [1_000_000 * i for i in range(100)])
    assert len(fit) == KEPT
    fit.forget()
    with pytest.raises(ValueError, match="not read yet"):
        fit.at(0)


@given(st.lists(st.integers(0, 2**31 - 1), min_size=1, max_size=40), st.integers(0, 2**32 - 1))
def test_the_wrap_is_undone(steps: list[int], start: int) -> None:
    unwrapped = Unwrapped()
    true = start
    first = unwrapped(true % 2**32)
    for step in steps:
        true += step
        assert unwrapped(true % 2**32) - first == true - start


def test_a_time_from_a_little_before_is_not_taken_for_a_wrap() -> None:
    unwrapped = Unwrapped()
    assert [unwrapped(t) for t in (10, 2**32 - 5, 20)] == [10, -5, 20]
