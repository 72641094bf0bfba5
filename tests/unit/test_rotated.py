"""Sets out of step as a whole: told by what steps between frequencies leave, and what cannot be told is said."""

from __future__ import annotations

import numpy as np
import pytest

from scanner.decode.agreement import Remainder
from scanner.decode.rotated import Rotated, cannot_reveal, rotated_sets
from scanner.decode.unwrapping import plan_ladder
from tests.unit.test_doubled import captured, decoded, shown


def turned(frames, first, shifts, by):
    return shown(frames, first, {n: (n - by) % shifts for n in range(shifts)})


@pytest.mark.parametrize(
    ("shifts", "k", "by", "told"),
    [
        (8, 2, 1, "frequency 16 by 1 of its 8 shifts out of step"),
        (8, 2, 5, "frequency 16 by 3 of its 8 shifts out of step"),
        (3, 1, 1, "frequency 4 by 1 of its 3 shifts"),
        (8, 0, 1, "frequency 1 by 1 of its 8 shifts"),
    ],
)
@pytest.mark.parametrize("brief", [False, True])
def test_a_set_shown_late_as_a_whole_is_named_and_nothing_is_decided(shifts, k, by, told, brief):
    sequence, frames, _ = captured(shifts)
    found = decoded(sequence, turned(frames, k * shifts, shifts, by), brief=brief)
    assert told in found.warnings[0]
    assert not np.isfinite(found.rows).any()
    assert not found.confidence.any()


def test_a_sequence_that_is_one_frame_late_from_its_first_one_is_named():
    sequence, frames, _ = captured(8)
    found = decoded(sequence, [frames[0], *frames[:-1]])
    assert not np.isfinite(found.rows).any()
    assert all("capture again" in words for words in found.warnings)


def test_what_a_sequence_cannot_reveal_is_said_and_true():
    sequence, frames, rows = captured(4)
    found = decoded(sequence, turned(frames, 0, 4, 1))
    told = found.details["cannot_reveal"]
    assert told[0] == "frequency 1 shown 1, 2, 3 of its 4 shifts late or early as a whole"
    assert np.nanmedian(np.abs(found.rows - rows)) > 90
    assert cannot_reveal((1.0, 8.0, 64.0), (7, 9, 9)) == ()
    assert len(cannot_reveal((1.0,), (8,))) == 1


@pytest.mark.parametrize("agreement", [0.99, 0.8])
def test_offsets_that_no_rotation_leaves_or_that_differ_from_pixel_to_pixel_are_none(agreement):
    ladder = plan_ladder((1.0, 8.0, 64.0), [0.25] * 3)

    def steps(*offsets):
        return [Remainder(1, 8, 0.01, 0.001, offset, agreement, 4000) for offset in offsets]

    assert rotated_sets(ladder, steps(0.01, 0.03), (8, 8, 8)) == ()
    assert rotated_sets(ladder, steps(0.01, 0.09), (8, 8, 8)) == ()
    found = rotated_sets(ladder, steps(0.0, 0.12), (8, 8, 8))
    assert found == ((Rotated(2, 7),) if agreement > 0.9 else ())
