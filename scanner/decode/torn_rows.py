"""Rows of a picture in which frames contradict one another from side to side: they were out of step there.

A pixel whose frames fit no fringe says that something changed between them, not what. A camera with a rolling shutter
exposes row by row, so that light which came too early or too late is wrong in whole rows; what moves in front of the
camera has sides. Rows of the first kind are told apart here. Frames that are wrong everywhere end a scan before
(`scanner.sequencer`); a body that moves across the whole width looks like rows out of step, and is none the better.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Reason
from scanner.decode.reasons import REASONS

PARTS = 4
"""Of a row, each of which must have contradictions."""

LEAST_SHARE = 0.15
"""Of a part's pixels with light: of frames that were exchanged for another shift of their set, a third of all phases
contradict by more than a fit allows (|cos| > .86), and half of that may be shadow's or print's."""

LEAST_LIT = 16
"""Pixels with light that a part of a row must have to be asked: three of them contradict then. Where one in a hundred
does by chance, three of sixteen do in one part of two thousand, and in all four of a row once in 10^13. Pixels in the
dark, of which more do, are shadow by now (`cut_at_black`)."""

_FITTED = (Reason.VALUE, Reason.UNWRAP_RISK, Reason.MOVED)
_DARK = (Reason.SHADOW, Reason.CLIPPED, Reason.LOW_MODULATION)


def leave_torn_rows_out(reason: NDArray[np.uint8], *maps: NDArray[np.float32]) -> NDArray[np.int64]:
    """Pixels of rows that are torn from side to side have no value, and are out of step.

    Those that a fit happened to agree with are no better than their neighbours: at some phases the wrong light differs
    little from the right one.

    Args:
        reason, maps: (H, W), changed in place; maps become NaN where there was a value.

    Returns:
        (REASONS,) by how much the number of pixels with each reason has changed.
    """
    moved = reason == Reason.MOVED
    rows = np.flatnonzero(moved.any(axis=1))
    here, lit = moved[rows], ~np.isin(reason[rows], _DARK)
    torn = np.ones(rows.size, np.bool_)
    for part in np.array_split(np.arange(reason.shape[1]), PARTS):
        there = np.count_nonzero(lit[:, part], axis=1)
        contradict = np.count_nonzero(here[:, part], axis=1)
        torn &= (there >= LEAST_LIT) & (contradict >= LEAST_SHARE * there)
    found = rows[torn]
    before = reason[found]
    after = np.where(np.isin(before, _FITTED), np.uint8(Reason.OUT_OF_STEP), before)
    reason[found] = after
    for values in maps:
        values[found] = np.where(after == Reason.OUT_OF_STEP, np.float32(np.nan), values[found])
    changes = np.bincount(after.ravel(), minlength=REASONS) - np.bincount(before.ravel(), minlength=REASONS)
    return changes.astype(np.int64)
