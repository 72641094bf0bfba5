"""Is there a fringe at all? A check of PMP with one frequency, where noise can have nothing to contradict it.

Three samples of anything make a phase: with three shifts there is no residual, and with one frequency no other that a
fringe order is held against. But phases of neighbouring pixels have to do with one another where a fringe was seen.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError
from scanner.patterns.description import Axis

MOST_BENDING = 0.15
"""Cycles, median magnitude of the phase's second difference. Phases that have nothing to do with one another give a
quarter, and noise of a twentieth of a cycle, more than any scan is worth taking with, .08."""

LEAST_TRIPLES = 1000


def require_fringes(position: NDArray[np.float32], period_px: float, axis: Axis) -> None:
    """Raise DecodeError where phases of neighbouring pixels do not follow one another.

    Args:
        position: (H, W) projector px, NaN where undecided.
        period_px: of the one frequency, projector px.
        axis: along which.
    """
    bending = [np.diff(position / np.float32(period_px), n=2, axis=along).reshape(-1) for along in (0, 1)]
    cycles = np.concatenate(bending)
    cycles = cycles[np.isfinite(cycles)]
    if cycles.size >= LEAST_TRIPLES and np.median(np.abs(cycles - np.rint(cycles))) > MOST_BENDING:
        raise DecodeError(
            f"no fringes along {axis}: phases of neighbouring pixels have nothing to do with one another",
            hint="check that the projector shows the pattern, and its focus; further frequencies tell noise apart",
        )
