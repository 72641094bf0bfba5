"""Which way the phases of a fringe set are unwrapped: a plan made once a scan, from the frequencies alone.

Every integer combination m of the sets' phases is the phase of a beat of frequency m . f (heterodyne principle;
Cheng and Wyant 1984; Reich, Ritter, Thesing 1997). The plan is a ladder of such beats: the first rung has at most
one period over the projector, the last is the finest set itself, and each rung tells the fringe order of the next.
Sets with a unit frequency are the case where all rungs are single sets. This file has no pixels in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError

WIDE_STEP = 16.0
"""Ratio of neighbouring rungs above which the report warns: phase noise of .01 cycles is then .16 fringes."""

_TOLERANCE = 1e-9
_LOWEST_BEAT = 1e-3
"""Beats below this many periods over the projector are rounding of the frequencies, not a design."""


@dataclass(frozen=True)
class Ladder:
    """Rungs from the coarsest beat to the finest set.

    combinations: (rungs, sets) int, one row a rung. frequencies: (rungs,) float, cycles over the projector, rising.
    errors: (rungs - 1, sets) float: weight of each set's phase error in the remainder of the step from rung j to
    j + 1, which must stay within half a cycle. periodic: a step of the whole projector leaves all rungs unchanged,
    so that its two ends look alike.
    """

    combinations: NDArray[np.int64]
    frequencies: NDArray[np.float64]
    errors: NDArray[np.float64]
    periodic: bool

    @property
    def ratios(self) -> NDArray[np.float64]:
        """Frequency of each rung over that of the rung before."""
        return np.asarray(self.frequencies[1:] / self.frequencies[:-1])

    def climb(self, turns: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
        """What phases that are off by `turns`, (sets,) cycles, and nothing else, leave of every step, (rungs - 1,)
        within half a cycle, and by how many fringes the finest set is counted wrong."""
        beats = self.combinations @ turns
        off, left = float(beats[0] - np.rint(beats[0])), []
        for ratio, beat in zip(self.ratios.tolist(), beats[1:].tolist(), strict=True):
            order = round(ratio * off - beat)
            left.append(ratio * off - beat - order)
            off = beat + order
        return np.array(left), round(off - float(beats[-1]))

    def warnings(self) -> tuple[str, ...]:
        """What a user should know about steps too wide for comfort."""
        return tuple(
            f"frequency {high:g} is unwrapped by {low:g}, a step of {high / low:.3g} to 1: above {WIDE_STEP:g} to 1 "
            "noise leaves it open in which fringe a pixel is, and where it does the pixel is undecided and has no "
            f"point; add {_between(low, high)} to the frequencies, or take more shifts"
            for low, high in zip(self.frequencies[:-1], self.frequencies[1:], strict=True)
            if high / low > WIDE_STEP * (1 + _TOLERANCE)
        )


def _between(low: float, high: float) -> str:
    """Frequencies that cut a wide step into the fewest that are not, to two digits, in words."""
    steps = max(2, int(np.ceil(np.log(high / low) / np.log(WIDE_STEP) - _TOLERANCE)))
    return " and ".join(f"{float(f'{low * (high / low) ** (k / steps):.2g}'):g}" for k in range(1, steps))


def plan_ladder(frequencies: Sequence[float], gains: Sequence[float]) -> Ladder:
    """The ladder whose noisiest step is the least noisy.

    Args:
        frequencies: cycles over the projector, one a set, any order.
        gains: variance of (B cos, B sin) of each set over the variance of one sample: 2 / N for N even shifts.

    Raises:
        DecodeError: no combination of the sets has one period or less over the projector.
    """
    # Asked for by every scan of a rig, with the same answer; the gains of a fit differ in their last digits.
    return _plan(tuple(float(f) for f in frequencies), tuple(round(float(g), 9) for g in gains))


@lru_cache(maxsize=32)
def _plan(frequencies: tuple[float, ...], gains: tuple[float, ...]) -> Ladder:
    f = np.asarray(frequencies, dtype=np.float64)
    g = np.sqrt(np.asarray(gains, dtype=np.float64))
    m, beats = _candidates(f)
    finest = _row_of(m, np.eye(len(f), dtype=np.int64)[len(f) - 1 - int(np.argmax(f[::-1]))])
    starts = beats <= 1 + _TOLERANCE
    if not starts.any():
        raise DecodeError(
            f"frequencies {', '.join(f'{x:g}' for x in f)} do not tell one end of the projector from the other: "
            f"the lowest beat has {beats.min():g} periods over it",
            hint="add frequency 1, or choose frequencies with a beat of one period (59, 64, 70)",
        )
    worst, _ = _least_noisy_path(m, beats, g, starts, finest, step_cost=0.0)
    _, path = _least_noisy_path(m, beats, g, starts, finest, step_cost=worst / 2)
    rungs, rising = m[path], beats[path]
    errors = (rising[1:] / rising[:-1])[:, None] * rungs[:-1] - rungs[1:]
    whole = np.abs(f - np.rint(f)) < _TOLERANCE * np.maximum(f, 1)
    periodic = bool(whole[np.any(rungs != 0, axis=0)].all() and rising[0] > 1 - _TOLERANCE)
    return Ladder(rungs, rising, errors, periodic)


def _candidates(f: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Combinations with small weights, (rungs, sets), and their beats, sorted by beat; never above the finest set."""
    count = len(f)
    total = 6 if count <= 4 else 4 if count <= 6 else 3 if count <= 8 else 2
    rows: set[tuple[int, ...]] = set()
    for chosen in (c for size in range(1, min(count, total) + 1) for c in combinations(range(count), size)):
        for weights in product([w for w in range(-total, total + 1) if w], repeat=len(chosen)):
            if sum(map(abs, weights)) <= total:
                row = [0] * count
                for index, weight in zip(chosen, weights, strict=True):
                    row[index] = weight
                rows.add(tuple(row))
    m = np.array(sorted(rows), dtype=np.int64)
    beats = m @ f
    keep = (beats > _LOWEST_BEAT) & (beats <= f.max() * (1 + _TOLERANCE))
    m, beats = m[keep], beats[keep]
    order = np.lexsort((np.abs(m).sum(axis=1), beats))
    return m[order], beats[order]


def _row_of(m: NDArray[np.int64], row: NDArray[np.int64]) -> int:
    return int(np.flatnonzero((m == row).all(axis=1))[0])


def _least_noisy_path(
    m: NDArray[np.int64],
    beats: NDArray[np.float64],
    g: NDArray[np.float64],
    starts: NDArray[np.bool_],
    finest: int,
    step_cost: float,
) -> tuple[float, list[int]]:
    # Shortest path over rising beats. A step costs the eighth power of its noise, near enough the worst step alone,
    # and something for being a step: of two ladders as safe as each other the shorter wins.
    weighted = m * g
    norms = (weighted**2).sum(axis=1)
    products = weighted @ weighted.T
    cost = np.where(starts, 0.0, np.inf)
    worst = np.zeros(len(m))
    before = np.full(len(m), -1)
    for b in range(len(m)):
        lower = np.flatnonzero(np.isfinite(cost[:b]) & (beats[:b] < beats[b] * (1 - 1e-6)))
        if lower.size == 0:
            continue
        ratio = beats[b] / beats[lower]
        variance = np.maximum(ratio**2 * norms[lower] - 2 * ratio * products[lower, b] + norms[b], 0)
        through = cost[lower] + variance**4 + step_cost
        best = int(np.argmin(through))
        if through[best] < cost[b]:
            cost[b], before[b] = through[best], lower[best]
            worst[b] = max(worst[lower[best]], variance[best] ** 4)
    path = [finest]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return float(worst[finest]), path[::-1]
