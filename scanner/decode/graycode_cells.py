"""How far from its place a pixel of Gray or binary code may be, by how wide the borders of the cells show to be.

A pixel whose bits are all decided is not anywhere in its cell: on a strip along each border, as wide as blur and noise
make it, a bit is open, and what is left of the cell is narrower. A pixel on that strip is placed on the border itself,
and is off by half the strip's width at most. That width need not be assumed: it is the share of the pixels there that
lie on borders. Both are rectangular (JCGM 100:2008, 4.3.7). Nothing here moves a position.
"""

from __future__ import annotations

import math

import numpy as np

from scanner.decode import Map
from scanner.kernel import kernel

BLOCK_LINES = 64
"""Lines of pixels that are counted together: dozens of cells, and little enough to stay in a cache"""

FEWEST = 1000
"""Decided pixels of a block that tell a share to some per cent; with fewer sigmas stay those of whole cells."""

RAGGED = 1 / 7
"""Of a strip's width, spread of its edges: in the dark a bit is open where it is less than 3.5 sigmas either way."""

_HALF = np.float32(0.5)


def narrow_cells(sigma: Map, position: Map, along: int, cell_px: int, line: int) -> None:
    """Scale one axis's sigmas in place. By one thread: blocks must not depend on how threads share the pixels.

    Args:
        sigma, position: (P,) projector px as `decode_codes` leaves them, NaN where undecided.
        along: projector px of the field. cell_px: of a cell. line: pixels of the camera's lines.
    """
    _narrow(sigma, position, float(along), float(cell_px), BLOCK_LINES * line)


@kernel
def shares(odd: float, even: float, inside: float) -> tuple[np.float32, np.float32]:
    """Sigma over that of a whole cell (its width / sqrt 12): of pixels inside cells, and of those on borders.

    Args:
        odd, even, inside: pixels on borders after an odd and after an even number of cells, and in cells. Of a Gray
            code the former are the finest bit's alone, and wider.
    """
    # Widths of the strips, in cells; every cell has one of either kind.
    both = odd + even + inside
    first, second = 2 * odd / both, 2 * even / both
    left, aside, ragged = 1 - (first + second) / 2, (first - second) / 4, RAGGED * RAGGED * (first**2 + second**2) / 2
    # A strip that is wider on one side leaves a rest that is off the middle: its spread about the cell's middle.
    of_inside = math.sqrt(left * left + 12 * (aside * aside + ragged))
    of_border = max(first, second) * math.sqrt(1 + 12 * RAGGED * RAGGED)
    return np.float32(min(of_inside, 1.0)), np.float32(min(of_border, 2.0))


@kernel
def _narrow(sigma: Map, position: Map, along: float, cell: float, block: int) -> None:
    """Of the field's first and last cell none: they have no border at the end."""
    whole, to_cells = np.float32(cell / math.sqrt(12)), np.float32(1 / cell)
    one, two = np.float32(1.5) * whole, np.float32(2.5) * whole
    first, last = np.float32(0.75 * cell - 0.5), np.float32(along - 0.75 * cell - 0.5)
    for start in range(0, sigma.size, block):
        stop = min(start + block, sigma.size)
        inside, borders, odd = _count(sigma[start:stop], position[start:stop], one, two, to_cells)
        if inside + borders >= FEWEST:
            of_inside, of_border = shares(float(odd), float(borders - odd), float(inside))
            _scale(
                sigma[start:stop], position[start:stop], (one, two), (first, last), of_inside * whole, of_border * whole
            )


@kernel
def _count(
    sigma: Map, position: Map, one: np.float32, two: np.float32, to_cells: np.float32
) -> tuple[np.int32, np.int32, np.int32]:
    """Pixels in cells, on borders, and on borders after an odd number of cells."""
    inside, borders, odd = np.int32(0), np.int32(0), np.int32(0)
    for k in range(sigma.size):
        within, border = sigma[k] < one, (sigma[k] >= one) & (sigma[k] < two)
        after = np.int32((position[k] + _HALF) * to_cells + _HALF)
        inside += np.int32(within)
        borders += np.int32(border)
        odd += np.int32(border) & after
    return inside, borders, odd


@kernel
def _scale(
    sigma: Map,
    position: Map,
    limits: tuple[np.float32, np.float32],
    ends: tuple[np.float32, np.float32],
    of_inside: np.float32,
    of_border: np.float32,
) -> None:
    for k in range(sigma.size):
        here, place = sigma[k], position[k]
        there = (place > ends[0]) & (place < ends[1])
        new = of_inside if here < limits[0] else (of_border if here < limits[1] else here)
        sigma[k] = new if there else here
