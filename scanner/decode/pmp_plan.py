"""What a PMP decode knows of an axis before its frames come: weights, ladder and all, in the form that kernels take.

Pattern, projector and the frames that are there say all of it. It is made while frames are being exposed, for sets that
are whole, and anew after the last one only where frames were lost or left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from scanner.decode.harmonics import HeightWeights
from scanner.decode.pmp_frames import AxisFits, fits_of
from scanner.decode.unwrapping import Ladder, plan_ladder
from scanner.patterns import PmpPattern


@dataclass(frozen=True)
class AxisPlan:
    """Of one axis with K sets and a ladder of J rungs. Nobody writes into it.

    finest: index of the finest set. along: projector pixels along the axis. centre: the field's centre, fraction of it,
    where the pattern's phase is counted from its origin before pixel 0. gains: (K,) float32, rungs: (J, K) float32,
    ratios: (J - 1,) float32, errors2: (J - 1, K) float32, scale: (5,) float32, see `decode_pixels`. combinations:
    (J, K) float64. step_errors2: (J - 1,) float64, the sum of each step's.
    """

    fits: AxisFits
    heights: HeightWeights
    ladder: Ladder
    finest: int
    along: int
    centre: float
    gains: NDArray[np.float32]
    rungs: NDArray[np.float32]
    ratios: NDArray[np.float32]
    errors2: NDArray[np.float32]
    scale: NDArray[np.float32]
    combinations: NDArray[np.float64]
    step_errors2: NDArray[np.float64]

    @property
    def per_cycle(self) -> float:
        """Projector px a cycle of the finest set."""
        return self.along / float(self.ladder.frequencies[-1])


def plan_axis(
    pattern: PmpPattern, along: int, there: tuple[tuple[int, ...], ...], ladder: Ladder | None = None
) -> AxisPlan:
    """The plan for one axis.

    Args:
        along: projector pixels along the axis. there: frames of each set that there are (`AxisFits`). ladder: the way
            up to the finest set; None: as `plan_ladder` finds it.
    """
    return _of_ladder(pattern, along, there) if ladder is None else _planned(pattern, along, there, ladder)


@lru_cache(maxsize=32)
def _of_ladder(pattern: PmpPattern, along: int, there: tuple[tuple[int, ...], ...]) -> AxisPlan:
    # Every scan of a rig asks for the same.
    return _planned(pattern, along, there, plan_ladder(pattern.frequencies, fits_of(pattern, there).gains))


def _planned(pattern: PmpPattern, along: int, there: tuple[tuple[int, ...], ...], ladder: Ladder) -> AxisPlan:
    fits, centre = fits_of(pattern, there), 0.5 + (pattern.origin - 0.5) / along
    errors2 = ladder.errors**2
    scale = [along, pattern.origin, ladder.frequencies[0] * centre, ladder.frequencies[-1], centre - 0.5]
    rungs, ratios, of_steps = (np.asarray(one, np.float32) for one in (ladder.combinations, ladder.ratios, errors2))
    return AxisPlan(
        fits, HeightWeights.of(fits), ladder, finest_of(pattern), along, centre, np.array(fits.gains, np.float32),
        rungs, ratios, of_steps, np.array(scale, np.float32), ladder.combinations.astype(np.float64),
        errors2.sum(axis=1),
    )  # fmt: skip


def whole_sets(pattern: PmpPattern) -> tuple[tuple[int, ...], ...]:
    """The frames of each set of an axis, of which none is lost."""
    return tuple(tuple(range(shifts)) for shifts in pattern.shifts)


def finest_of(pattern: PmpPattern) -> int:
    """Index of the finest set."""
    f = pattern.frequencies
    return max(range(len(f)), key=lambda k: (f[k], k))
