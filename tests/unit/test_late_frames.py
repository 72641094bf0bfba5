"""PMP: several frames in a row that show what the one before each shows, or the one after, in a set or beyond it."""

from __future__ import annotations

import numpy as np
import pytest

from tests.unit.test_doubled import captured, decoded

DEFAULT, TWO = ((1.0, 8.0, 64.0), (8, 8, 8)), ((1.0, 16.0), (16, 16))


def late(frequencies, shifts, begin, end, by):
    """What is found where frames begin .. end - 1 show the one `by` before; and the share of wrong values in it."""
    sequence, frames, rows = captured(shifts, frequencies=frequencies, seed=1)
    _, others, _ = captured(shifts, frequencies=frequencies, seed=2)
    for position in range(begin, end):
        if 0 <= position - by < len(frames):
            frames[position] = others[position - by]
    found = decoded(sequence, frames)
    told = [words for words in found.warnings if "capture again" in words]
    believed = np.isfinite(found.rows) & (found.confidence > 0.5)
    return told, np.mean(np.abs(found.rows - rows)[believed] > 1) if believed.any() else 0.0


@pytest.mark.parametrize(
    ("plan", "frames", "told"),
    [
        (TWO, (1, 14, 1), "frequency 1 along y: frames 1..13 show what the one before each does"),
        (TWO, (0, 13, -1), "frames 0..12 show what the one after each does"),
        (TWO, (17, 30, 1), "frequency 16 along y: frames 17..29 show what the one before each does"),
        (((1.0, 8.0), (8, 8)), (1, 7, 1), "frequency 1 along y: frames 1..6 show what the one before each does"),
        (DEFAULT, (10, 16, 1), "frames 10..15 show what the one before each does"),
        (DEFAULT, (9, 15, 1), "frequency 8 along y: frames 9..14 show what the one before each does"),
    ],
)
def test_frames_late_within_a_set_are_named_and_nothing_is_decided(plan, frames, told):
    words, wrong = late(*plan, *frames)
    assert len(words) == 1
    assert told in words[0]
    assert wrong == 0


@pytest.mark.parametrize(
    ("plan", "frames"),
    [
        (DEFAULT, (6, 24, 1)),
        (DEFAULT, (6, 16, 1)),
        (((59.0, 64.0, 70.0), (8, 8, 8)), (5, 16, 1)),
        (((59.0, 64.0, 70.0), (5, 5, 5)), (0, 9, -1)),
    ],
)
def test_a_sequence_late_from_within_a_set_on_has_no_wrong_values(plan, frames):
    words, wrong = late(*plan, *frames)
    assert words
    assert wrong == 0


@pytest.mark.parametrize("plan", [DEFAULT, ((1.0, 16.0), (8, 8)), ((1.0, 10.0, 50.0), (5, 5, 5))])
@pytest.mark.parametrize("by", [1, -1])
def test_a_set_that_may_be_late_as_a_whole_without_a_step_to_tell_has_no_values(plan, by):
    count = plan[1][0]
    words, wrong = late(*plan, *((1, count, 1) if by == 1 else (0, count - 1, -1)))
    first, other = (0, 1) if by == 1 else (count - 1, count - 2)
    assert words == [
        f"frequency 1 along y: frame {first} shows what frame {other} shows: the set is out of step; capture again"
    ]
    assert wrong == 0
