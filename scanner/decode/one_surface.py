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

LEAST_BORDER = 16
"""Pairs of pixels along the border of two regions from which on it tells whether they are one surface: noisy pixels,
which belong to neither, touch both. A wrong patch with a shorter one is no larger than four pixels by four."""

CLEAR = np.float32(2.0)
"""Votes of the order that is right over those of all others."""

NOWHERE, BROKEN = 99, 98
"""In place of a jump: no such pair of pixels; a pair over which no surface runs on."""

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
    parent, jump = np.arange(cycles.size, dtype=np.int32), np.zeros(cycles.size, np.int16)
    _join(cycles, coarse, reason, width, parent, jump)
    borders = _borders(cycles, coarse, reason, width, parent, jump)
    _join_regions(*_crossed(borders, cycles.size), parent, jump)
    return _doubt(cycles, coarse, confidence, reason, parent, jump)


def _crossed(borders: NDArray[np.int32], pixels: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Regions, others, and the jumps from these to those, of the borders over which the surface runs on.

    Args:
        borders: of `_borders`. pixels: of the image.
    """
    pairs, at = np.unique(borders[:, 0] * np.int64(pixels) + borders[:, 1], return_inverse=True)
    length = np.bincount(at, minlength=pairs.size)
    # For and against: most of all pairs, those over which nothing runs on included.
    up, down = (2 * np.bincount(at[borders[:, 2] == way], minlength=pairs.size) > length for way in (1, -1))
    told = (up | down) & (length >= LEAST_BORDER)
    return pairs[told] // pixels, pairs[told] % pixels, np.where(up, 1, -1)[told]


def warm_up() -> None:
    """Compile what only scans of hollows come to."""
    cycles, coarse, confidence = np.zeros((3, 4), np.float32)
    doubt_wrong_orders(cycles, coarse, confidence, np.zeros(4, np.uint8), 2)


@kernel
def _step(cycles: Map, coarse: Map, reason: NDArray[np.uint8], width: int, here: int, there: int) -> int:
    """The jump of order to a pixel right or below; BROKEN if no surface runs on to it, NOWHERE if none is known."""
    if there >= cycles.size or (there == here + 1 and there % width == 0):
        return NOWHERE
    if (reason[here] != _VALUE and reason[here] != _RISK) or (reason[there] != _VALUE and reason[there] != _RISK):
        return NOWHERE
    apart = cycles[there] - cycles[here]
    whole = np.float32(np.rint(apart))
    if abs(whole) > 1 or abs(apart - whole) > SMOOTH or abs(coarse[there] - coarse[here]) > SMOOTH:
        return BROKEN
    return int(whole)


@kernel
def _join(
    cycles: Map,
    coarse: Map,
    reason: NDArray[np.uint8],
    width: int,
    parent: NDArray[np.int32],
    jump: NDArray[np.int16],
) -> None:
    """Join pixels into regions of one order. parent: towards each one's first pixel. jump: zeros yet."""
    for here in range(cycles.size):
        for there in (here + 1, here + width):
            if _step(cycles, coarse, reason, width, here, there) == 0:
                one, other = _surface(parent, jump, here)[0], _surface(parent, jump, there)[0]
                if one != other:
                    parent[other] = one


@kernel
def _borders(
    cycles: Map,
    coarse: Map,
    reason: NDArray[np.uint8],
    width: int,
    parent: NDArray[np.int32],
    jump: NDArray[np.int16],
) -> NDArray[np.int32]:
    """(B, 3): first pixels of two regions that touch, the lower one first; jump of the second's order, 0 if broken."""
    most = 0
    for fill in (False, True):
        found, count = np.empty((most, 3), np.int32), 0
        for here in range(cycles.size):
            for there in (here + 1, here + width):
                step = _step(cycles, coarse, reason, width, here, there)
                if step == NOWHERE:
                    continue
                one, other = _surface(parent, jump, here)[0], _surface(parent, jump, there)[0]
                if one == other:
                    continue
                if fill:
                    way = 0 if step == BROKEN else step
                    found[count, 0], found[count, 1] = min(one, other), max(one, other)
                    found[count, 2] = way if one < other else -way
                count += 1
        most = count
    return found


@kernel
def _join_regions(
    one: NDArray[np.int64],
    other: NDArray[np.int64],
    step: NDArray[np.int64],
    parent: NDArray[np.int32],
    jump: NDArray[np.int16],
) -> None:
    """Join regions into surfaces. jump: each pixel's order over its parent's."""
    for i in range(one.size):
        first, mine = _surface(parent, jump, one[i])
        second, its = _surface(parent, jump, other[i])
        if first != second:
            parent[second] = first
            jump[second] = mine + step[i] - its


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
