"""The plan of unwrapping: which beats, in which steps, and what is refused."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from scanner.decode.unwrapping import plan_ladder
from scanner.errors import DecodeError


def test_single_sets_are_their_own_rungs():
    ladder = plan_ladder([1, 8, 64], [0.25, 0.25, 0.25])
    assert ladder.combinations.tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    assert ladder.frequencies.tolist() == [1, 8, 64]
    assert ladder.ratios.tolist() == [8, 8]
    assert ladder.errors.tolist() == [[8, -1, 0], [0, 8, -1]]
    assert ladder.periodic
    assert ladder.warnings() == ()


def test_the_order_of_the_sets_does_not_matter():
    ladder = plan_ladder([64, 1, 8], [0.25, 0.25, 0.25])
    assert ladder.combinations.tolist() == [[0, 1, 0], [0, 0, 1], [1, 0, 0]]
    assert ladder.frequencies.tolist() == [1, 8, 64]


def test_another_set_makes_the_worst_step_no_noisier():
    few, more = (plan_ladder(f, [0.25] * len(f)) for f in ([1, 8, 64], [1, 7.9, 8, 64]))
    assert (more.errors**2).sum(axis=1).max() <= (few.errors**2).sum(axis=1).max() + 1e-9


def test_heterodyne_sets_climb_by_their_beats():
    ladder = plan_ladder([59, 64, 70], [0.25] * 3)
    assert ladder.frequencies[0] == 1
    assert ladder.combinations[0].tolist() == [1, -2, 1]
    assert ladder.combinations[-1].tolist() == [0, 0, 1]
    assert np.all(np.diff(ladder.frequencies) > 0)
    assert ladder.periodic


def test_frequencies_that_are_not_whole_do_not_join_the_ends():
    assert not plan_ladder([0.9, 7.2], [0.5, 0.5]).periodic
    assert not plan_ladder([20.3, 23.45, 27.5], [0.25] * 3).periodic
    assert not plan_ladder([1, 8.5], [0.5, 0.5]).periodic


def test_one_set_of_one_period_is_a_ladder_of_one_rung():
    ladder = plan_ladder([1], [0.5])
    assert ladder.frequencies.tolist() == [1]
    assert ladder.errors.shape == (0, 1)


@pytest.mark.parametrize("frequencies", [[2], [8, 64], [16, 16], [8, 12, 20]])
def test_frequencies_that_leave_two_places_alike_are_refused(frequencies):
    named = ", ".join(map(str, frequencies))
    with pytest.raises(DecodeError, match=re.escape(f"frequencies {named} do not tell one end")) as refused:
        plan_ladder(frequencies, [0.25] * len(frequencies))
    assert "add frequency 1" in refused.value.hint


def test_wide_steps_are_warned_of():
    assert plan_ladder([1, 16], [0.5, 0.5]).warnings() == ()
    (warning,) = plan_ladder([1, 17], [0.5, 0.5]).warnings()
    assert "17 is unwrapped by 1, a step of 17 to 1" in warning
    assert "add 4.1 to the frequencies" in warning
    (warning,) = plan_ladder([1, 400], [0.5, 0.5]).warnings()
    assert "add 7.4 and 54 to the frequencies" in warning


def test_the_less_noisy_way_is_taken():
    # From 1 to 48 by way of 8 or of 6: the set with more shifts is the better step.
    by_eight = plan_ladder([1, 6, 8, 48], [0.25, 0.66, 0.1, 0.25]).frequencies.tolist()
    by_six = plan_ladder([1, 6, 8, 48], [0.25, 0.1, 0.66, 0.25]).frequencies.tolist()
    assert 8 in by_eight
    assert 6 in by_six


@given(st.lists(st.floats(0.3, 90, allow_nan=False), min_size=1, max_size=5), st.integers(3, 16))
@settings(max_examples=60, deadline=None)
def test_a_ladder_holds_for_exact_phases_wherever_they_lie(frequencies, shifts):
    try:
        ladder = plan_ladder(frequencies, [2 / shifts] * len(frequencies))
    except DecodeError:
        return
    f = np.asarray(frequencies)
    assume(f.max() / max(ladder.frequencies[0], 1e-2) < 1e4)
    assert np.allclose(ladder.combinations @ f, ladder.frequencies)
    assert ladder.frequencies[-1] == f.max()
    assert ladder.frequencies[0] <= 1 + 1e-9
    assert np.allclose(ladder.errors @ f, 0, atol=1e-6 * f.max())
    place = np.linspace(0.02, 0.98, 97)
    cycles = (np.outer(f, place) + 0.5) % 1 - 0.5
    absolute = ladder.combinations[0] @ cycles
    absolute -= np.rint(absolute - ladder.frequencies[0] * 0.5)
    for j, ratio in enumerate(ladder.ratios):
        psi = ladder.combinations[j + 1] @ cycles
        absolute = psi + np.rint(ratio * absolute - psi)
    assert np.allclose(absolute / f.max(), place, atol=1e-6)
