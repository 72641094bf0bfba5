"""Frames out of step that their own sets do not tell: by what is left of steps between frequencies."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from scanner.decode import Reason
from tests.unit.test_doubled import captured, decoded, shown

WIDE = (1.0, 4.0, 16.0)


def swapped(frames, one, two):
    taken = list(frames)
    taken[one], taken[two] = taken[two], taken[one]
    return taken


@pytest.mark.parametrize("k", [0, 1, 2])
@pytest.mark.parametrize("pair", [*combinations(range(3), 2)])
@pytest.mark.parametrize("brief", [False, True])
def test_of_three_shifts_exchanged_frames_are_named_and_taken_in_each_others_place(k, pair, brief):
    sequence, frames, _ = captured(3)
    one, two = (3 * k + n for n in pair)
    found = decoded(sequence, swapped(frames, one, two), brief=brief)
    told = f"frames {one} and {two} changed places, and were taken in each other's place; capture again"
    assert found.warnings == (f"frequency {WIDE[k]:g} along y: {told}",)
    np.testing.assert_array_equal(found.rows, decoded(sequence, frames, brief=brief).rows)


@pytest.mark.parametrize(("one", "two"), [(2, 3), (5, 6), (1, 7)])
def test_exchanged_frames_of_two_sets_of_three_are_named_and_taken_in_each_others_place(one, two):
    sequence, frames, _ = captured(3)
    found = decoded(sequence, swapped(frames, one, two))
    named = f"frequencies {WIDE[one // 3]:g} and {WIDE[two // 3]:g}"
    told = f"frames {one} and {two} changed places, and were taken in each other's place; capture again"
    assert found.warnings == (f"{named} along y: {told}",)
    np.testing.assert_array_equal(found.rows, decoded(sequence, frames).rows)


@pytest.mark.parametrize("k", [0, 1, 2])
def test_of_four_shifts_frames_half_a_turn_apart_that_changed_places_are_named(k):
    sequence, frames, rows = captured(4, frequencies=(1.0, 5.0, 23.0))
    found = decoded(sequence, shown(frames, 4 * k, {1: 3, 3: 1}))
    told = f"frames {4 * k + 1} and {4 * k + 3} changed places"
    assert told in found.warnings[0]
    off = np.abs(found.rows - rows)
    assert np.nanmax(off, initial=0.0) < 3


def test_a_set_of_three_among_others_is_put_in_step():
    sequence, frames, _ = captured((8, 8, 3))
    found = decoded(sequence, swapped(frames, 16, 17))
    assert found.warnings[0].startswith("frequency 16 along y: frames 16 and 17 changed places, and were taken")
    np.testing.assert_array_equal(found.rows, decoded(sequence, frames).rows)


def test_of_two_sets_it_is_not_guessed_which_one_is_out_of_step():
    # Either of them turned round is a mirror image of the other one.
    sequence, frames, _ = captured(3, frequencies=(1.0, 7.0))
    found = decoded(sequence, swapped(frames, 3, 4))
    assert found.warnings[0].startswith("frequencies 1 and 7 along y: frames ")
    assert "frames 3 and 4 changed places" in found.warnings[0]
    assert found.warnings[0].endswith(": the sets are out of step; capture again")
    assert not np.isfinite(found.rows).any()
    assert not found.confidence.any()


@pytest.mark.parametrize("n", [0, 1, 2])
def test_a_foreign_frame_in_a_set_of_three_is_named_and_nothing_is_decided(n):
    sequence, frames, _ = captured(3)
    frames[3 + n] = np.full_like(frames[0], 10)
    found = decoded(sequence, frames)
    assert f"frame {3 + n} shows nothing of its set" in found.warnings[0]
    assert not np.isfinite(found.rows).any()


@pytest.mark.parametrize("shifts", [3, 4, 5, 8])
@pytest.mark.parametrize("late", [1, -1])
@pytest.mark.parametrize("foreign", [10, 200, None])
def test_a_sequence_that_is_one_frame_late_or_early_is_named(shifts, late, foreign):
    sequence, frames, _ = captured(shifts, frequencies=(1.0, 8.0, 64.0))
    end = 0 if late == 1 else -1
    extra = frames[end] if foreign is None else np.full_like(frames[0], foreign)
    found = decoded(sequence, [extra, *frames[:-1]] if late == 1 else [*frames[1:], extra])
    told = f"every frame shows what the one {'before' if late == 1 else 'after'} it should"
    assert found.warnings[0] == f"along y {told}: the sequence is out of step; capture again"
    assert not np.isfinite(found.rows).any()
    assert np.mean(found.reason == Reason.OUT_OF_STEP) > 0.9


def test_a_coarse_set_of_four_that_begins_with_a_black_frame_gives_no_values():
    # A shift of it is two fringes of the next one, which no step tells from frames in their place.
    sequence, frames, _ = captured(4, frequencies=(1.0, 8.0, 32.0))
    found = decoded(sequence, [np.full_like(frames[0], 10), *frames[:3], *frames[4:]])
    assert "frame 0 shows nothing of its set" in found.warnings[0]
    assert ": the set is out of step" in found.warnings[0]
    assert not np.isfinite(found.rows).any()


def test_a_drift_by_which_fringes_are_counted_wrong_is_named_and_nothing_is_decided():
    sequence, frames, rows = captured(16, frequencies=(59.0, 64.0, 70.0), moves=lambda position: 0.03 * (position - 40))
    found = decoded(sequence, frames)
    assert "farther on from frame to frame" in found.warnings[0]
    assert not np.isfinite(found.rows).any()
    assert np.mean(found.reason == Reason.MOVED) > 0.9
    sequence, frames, rows = captured(16, moves=lambda position: 0.03 * (position - 40))
    assert np.nanmedian(np.abs(decoded(sequence, frames).rows - rows)) < 0.2
