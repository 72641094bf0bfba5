"""Fringe orders that a pixel's own phases leave open, taken from its neighbours where these agree.

A pixel whose remainder lies near half a fringe is at risk, however good its finest phase is. Where most pixels around
it are decided, all put it on one fringe, and its phase continues theirs, that fringe is right: a surface elsewhere
would have to show the same phase by chance, and an order next to the pixel's own. Only pixels that were decided by
themselves have a say, so that errors cannot spread.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Map, Reason
from scanner.kernel import kernel

REACH = 2
"""Camera pixels to each side: two are as far as a lens's blur ties pixels together."""

MIN_NEIGHBOURS = 16
"""Decided pixels of the 24 around: a pixel on the straight border of a surface has 14 at most."""

MAX_SPREAD_CYCLES = 0.25
"""Of any neighbour's position from the pixel's, half of what would begin to leave the order open."""

MAX_BEND_CYCLES = 0.1
"""Of their mean from it: a surface's slope averages out, a jump does not."""

CONFIDENCE = 0.999
"""Of a pixel settled so: Gray code of a real scene knows 3,479 such pixels and contradicts none (3 / n at 95 %)."""

_VALUE, _RISK, _SETTLED = np.uint8(Reason.VALUE), np.uint8(Reason.UNWRAP_RISK), np.uint8(255)


def settle(
    position: Map, sigma: Map, confidence: Map, reason: NDArray[np.uint8], width: int, cycles_per_px: float
) -> int:
    """Settle what neighbours can settle of the pixels at risk; the rest of them become NaN.

    Args:
        position, sigma: (P,) float32, tentative where `reason` is UNWRAP_RISK. confidence: (P,) float32.
        reason: (P,) uint8. All four are changed.
        width: pixels a row. cycles_per_px: of the finest set, by projector pixel.

    Returns:
        How many were settled.
    """
    rows = (-1, width)
    return _settle(
        position.reshape(rows), sigma.reshape(rows), confidence.reshape(rows), reason.reshape(rows),
        np.float32(cycles_per_px), np.float32(CONFIDENCE),
    )  # fmt: skip


def warm_up() -> None:
    """Compile what only an image with pixels at risk comes to."""
    position, sigma, confidence = np.zeros((3, 4), np.float32)
    settle(position, sigma, confidence, np.zeros(4, np.uint8), 2, 1.0)


@kernel
def _settle(
    position: Map,
    sigma: Map,
    confidence: Map,
    reason: NDArray[np.uint8],
    cycles_per_px: np.float32,
    settled_confidence: np.float32,
) -> int:
    height, width = reason.shape
    settled = 0
    at_risk = np.zeros(height, np.bool_)
    for y in range(height):
        at_risk[y] = _any_at_risk(reason[y])
        if at_risk[y]:
            for x in range(width):
                if reason[y, x] == _RISK:
                    agreed, order = _order_of_neighbours(position, reason, y, x, cycles_per_px)
                    if agreed:
                        # Not yet a value: it has no say about others.
                        reason[y, x] = _SETTLED
                        position[y, x] += order / cycles_per_px
                        settled += 1
    for y in range(height):
        if at_risk[y]:
            for x in range(width):
                if reason[y, x] == _SETTLED:
                    reason[y, x] = _VALUE
                    confidence[y, x] = settled_confidence
                elif reason[y, x] == _RISK:
                    position[y, x] = np.float32(np.nan)
                    sigma[y, x] = np.float32(np.nan)
    return settled


@kernel
def _any_at_risk(reason: NDArray[np.uint8]) -> bool:
    # Without a way out of the loop: sixty-four pixels at once are faster than one and then none.
    found = np.uint8(0)
    for x in range(reason.size):
        found |= np.uint8(reason[x] == _RISK)
    return bool(found)


@kernel
def _order_of_neighbours(
    position: Map, reason: NDArray[np.uint8], y: int, x: int, cycles_per_px: np.float32
) -> tuple[bool, np.float32]:
    """(whether all agree, whole cycles from the pixel's tentative position to the fringe they are on)."""
    height, width = reason.shape
    count, total, order = 0, np.float32(0), np.float32(0)
    for j in range(max(y - REACH, 0), min(y + REACH + 1, height)):
        for i in range(max(x - REACH, 0), min(x + REACH + 1, width)):
            if reason[j, i] != _VALUE:
                continue
            cycles = (position[j, i] - position[y, x]) * cycles_per_px
            whole = np.float32(np.rint(cycles))
            if abs(whole) > 1 or abs(cycles - whole) > MAX_SPREAD_CYCLES or (count > 0 and whole != order):
                return False, order
            order = whole
            total += cycles - whole
            count += 1
    return count >= MIN_NEIGHBOURS and bool(abs(total) <= MAX_BEND_CYCLES * count), order
