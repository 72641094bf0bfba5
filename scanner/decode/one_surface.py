"""Fringe orders that a coarse phase out of true has put wrong by one, told by the surface they stand on.

Light that surfaces throw at one another, in hollows, shifts the phase of wide fringes, here more, there less. Where the
shift reaches half a fringe of the next rung, the order changes by one: pixels beyond look as sound as those before. But
there the coarse phase itself runs on, as the surface does, and it is the rounding that jumped; where a surface jumps by
a fringe, the coarse phase does as well. So pixels side by side are joined into surfaces, with the orders' jumps between
them, and the order that most of a surface has is right: its wide fringes would have to be shifted by more than half a
fringe on most of it. The rest of the surface is left without values.

Nothing is told of a surface that all lies beyond, or that edges cut off from the rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Map, Reason
from scanner.decode.agreement import Remainder
from scanner.decode.pmp_frames import AxisFrames
from scanner.decode.pmp_sums import fit_runs
from scanner.decode.unwrapping import Ladder
from scanner.kernel import kernel

LEAST_SYSTEMATIC = 0.05
"""Of a fringe, sigma over the image, by which rungs differ beyond noise, below which no surface is looked at: half a
fringe is ten sigmas then. Of twenty-one scans of the held-out bowl and groove none below it had a wrong order in ten
thousand; other scenes were not looked at."""

SMOOTH = np.float32(0.25)
"""Cycles by which neighbours on one surface may differ, in either phase: half of what would leave the order open."""

ORDERS = 7
"""Orders of a surface that are told apart, -3 .. 3 from its first pixel's; those beyond count as the outermost."""

CLEAR = np.float32(2.0)
"""Votes of the order that is right over those of all others."""

_VALUE, _RISK = np.uint8(Reason.VALUE), np.uint8(Reason.UNWRAP_RISK)


def doubtful_steps(remainders: Sequence[Remainder]) -> list[int]:
    """Which steps of the ladder may count fringes wrong although noise does not."""
    return [j for j, found in enumerate(remainders) if found.beyond_noise > LEAST_SYSTEMATIC]


def doubt_axis(
    frames: AxisFrames,
    ladder: Ladder,
    steps: Sequence[int],
    clip: int,
    width: int,
    turns: Map,
    confidence: Map,
    reason: NDArray[np.uint8],
) -> int:
    """`doubt_wrong_orders` for some steps of one axis.

    Args:
        frames, clip: see `decode_pixels`. steps: of `doubtful_steps`.
        width: pixels a row. turns: (P,) float32, the coordinate as a fraction of the projector, counted from where the
            pattern's phases are 0; tentative where `reason` is UNWRAP_RISK.
    """
    sets, pixels = len(frames.gains), turns.size
    phases, modulations = (np.empty((sets, pixels), np.float32) for _ in range(2))
    mean, residual = (np.empty(pixels, np.float32) for _ in range(2))
    fit_runs(
        frames.addresses, frames.like, frames.starts, frames.weights, frames.grams, frames.whole, clip, pixels,
        np.arange(0, pixels, width), width, phases, modulations, mean, residual, np.empty(pixels, np.bool_),
    )  # fmt: skip
    lost = 0
    for j in steps:
        low, high = (np.float32(f) for f in ladder.frequencies[j : j + 2])
        coarse = ladder.combinations[j].astype(np.float32) @ phases
        coarse += np.rint(turns * low - coarse)
        lost += doubt_wrong_orders(turns * high, coarse * (high / low), confidence, reason, width)
    return lost


def doubt_wrong_orders(cycles: Map, coarse: Map, confidence: Map, reason: NDArray[np.uint8], width: int) -> int:
    """Pixels whose order is not that of their surface are at risk of a wrong one, and so are those of a surface that
    has no order of its own.

    Args:
        cycles: (P,) float32 of the finer rung over the projector, as decided; tentative where `reason` is UNWRAP_RISK.
        coarse: (P,) float32, the same by the coarser rung alone.
        confidence: (P,) float32, reason: (P,) uint8, changed in place.
        width: pixels a row.

    Returns:
        How many lost their value.
    """
    parent = np.arange(cycles.size, dtype=np.int32)
    jump = np.zeros(cycles.size, np.int16)
    _join(cycles, coarse, reason, width, parent, jump)
    return _doubt(cycles, coarse, confidence, reason, parent, jump)


def warm_up() -> None:
    """Compile what only scans of hollows come to."""
    cycles, coarse, confidence = np.zeros((3, 4), np.float32)
    doubt_wrong_orders(cycles, coarse, confidence, np.zeros(4, np.uint8), 2)


@kernel
def _join(
    cycles: Map,
    coarse: Map,
    reason: NDArray[np.uint8],
    width: int,
    parent: NDArray[np.int32],
    jump: NDArray[np.int16],
) -> None:
    """Join pixels with those to the right and below. parent: each one's surface; jump: its order over its parent's."""
    for here in range(cycles.size):
        if reason[here] != _VALUE and reason[here] != _RISK:
            continue
        for there in (here + 1, here + width):
            if there >= cycles.size or (there == here + 1 and there % width == 0):
                continue
            if reason[there] != _VALUE and reason[there] != _RISK:
                continue
            apart = cycles[there] - cycles[here]
            whole = np.float32(np.rint(apart))
            if abs(whole) > 1 or abs(apart - whole) > SMOOTH or abs(coarse[there] - coarse[here]) > SMOOTH:
                continue
            one, mine = _surface(parent, jump, here)
            other, its = _surface(parent, jump, there)
            if one != other:
                parent[other] = one
                jump[other] = mine + int(whole) - its


@kernel
def _surface(parent: NDArray[np.int32], jump: NDArray[np.int16], pixel: int) -> tuple[int, int]:
    """(first pixel of the surface, order over its); the way to it is shortened."""
    first, total = pixel, 0
    while parent[first] != first:
        total += jump[first]
        first = parent[first]
    left, at = total, pixel
    while parent[at] != first and at != first:
        following, step = parent[at], jump[at]
        parent[at], jump[at] = first, left
        left -= step
        at = following
    return first, total


@kernel
def _doubt(
    cycles: Map,
    coarse: Map,
    confidence: Map,
    reason: NDArray[np.uint8],
    parent: NDArray[np.int32],
    jump: NDArray[np.int16],
) -> int:
    """Vote, and leave out what is not of its surface's order; how many."""
    middle = ORDERS // 2
    row = np.full(cycles.size, -1, np.int32)
    surfaces = 0
    for i in range(cycles.size):
        first, order = _surface(parent, jump, i)
        if order != 0 and row[first] < 0:
            row[first] = surfaces
            surfaces += 1
    votes = np.zeros((surfaces, ORDERS), np.float32)
    for i in range(cycles.size):
        first, order = _surface(parent, jump, i)
        if row[first] >= 0 and reason[i] == _VALUE:
            # One next to half a fringe could be either's.
            weight = max(1 - 2 * abs(coarse[i] - cycles[i]), np.float32(0))
            votes[row[first], min(max(order + middle, 0), ORDERS - 1)] += weight
    lost = 0
    for i in range(cycles.size):
        first, order = _surface(parent, jump, i)
        if row[first] >= 0 and reason[i] == _VALUE:
            mine, most = votes[row[first], min(max(order + middle, 0), ORDERS - 1)], votes[row[first]].max()
            if mine < most or most < CLEAR * (votes[row[first]].sum() - most):
                reason[i], confidence[i] = _RISK, np.float32(0)
                lost += 1
    return lost
