"""From pieces of columns to maps, line by line from the top: what lies between the stripes of each column, then between
the columns.

Every column has at most one piece at a line; the pieces that begin at it replace those of their columns. A line is so
short that it stays in the cache, and its loops run over columns, side by side in vector registers: no map is written
but the result, once. Which pieces there are is decided in `dense`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.kernel import kernel

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

FIGURES = 14
"""Of a piece, t being the share of it that has been gone through, u = 1 - t, and what holds at its two knots:
0 the upper knot's y, 1 its length's inverse, 1 / px; rows as 2 + 3 t + t u (4 u - 5 t); sigma as 6 u + 7 t + 8 t u;
9 confidence; light as 10 u + 11 t; height as 12 u + 13 t."""

CONFIDENCE = 9


def draw(columns: int, pieces: tuple[Ints, Ints, Ints, Array], agree: float, maps: Array) -> None:
    """Draw the maps.

    Args:
        columns: B, four pixels each.
        pieces: of each its column, first line and line behind its last (N,) int32, and its figures (N, FIGURES); column
            by column and downwards.
        agree: difference of two columns' rows up to which they are one surface.
        maps: (5, H, W) rows, sigma, confidence, light, height; or (1, H, W): rows alone. Filled: NaN (confidence: 0)
            where there is no piece.
    """
    column, begin, end, figures = pieces
    size = maps.shape[1]
    first, of_column, which = _events(column, begin, end, size)
    nothing = np.full((1, FIGURES), np.nan, np.float32)
    nothing[0, CONFIDENCE] = 0
    _draw(first, of_column, which, np.concatenate((figures, nothing)), np.float32(agree), columns, maps)


@kernel
def _events(column: Ints, begin: Ints, end: Ints, size: int) -> tuple[Ints, Ints, Ints]:
    """What changes at each line: first event of each (size + 1,), and of each event its column and piece; piece N is
    none.
    """
    count = len(column)
    alone = np.empty(count, np.bool_)  # nothing of its column follows it at once
    first = np.zeros(size + 2, np.int32)
    for n in range(count):
        alone[n] = n + 1 == count or column[n + 1] != column[n] or begin[n + 1] != end[n]
        first[begin[n] + 1] += 1
        if alone[n]:
            first[end[n] + 1] += 1
    for y in range(size + 1):
        first[y + 1] += first[y]
    place = first.copy()
    of_column, which = np.empty(2 * count, np.int32), np.empty(2 * count, np.int32)
    for n in range(count):
        e = place[begin[n]]
        place[begin[n]] += 1
        of_column[e], which[e] = column[n], n
        if alone[n]:
            e = place[end[n]]
            place[end[n]] += 1
            of_column[e], which[e] = column[n], count
    return first, of_column, which


@kernel
def _draw(
    first: Ints, of_column: Ints, which: Ints, figures: Array, agree: np.float32, columns: int, maps: Array
) -> None:
    at = np.empty((FIGURES, columns), np.float32)
    for b in range(columns):
        at[:, b] = figures[-1]
    lines = np.empty((4, columns), np.float32)
    blend = np.empty(columns, np.int32)
    for line in range(maps.shape[1]):
        for e in range(first[line], first[line + 1]):
            for k in range(FIGURES):
                at[k, of_column[e]] = figures[which[e], k]
        y = np.float32(line)
        _rows(y, at[0], at[1], at[2], at[3], at[4], at[5], lines[0])
        for b in range(columns - 1):
            # False where either is NaN: then the nearer column counts alone.
            blend[b] = abs(lines[0, b + 1] - lines[0, b]) < agree
        _widen(lines[0], blend, maps[0, line])
        if maps.shape[0] > 1:
            _bulging(y, at[0], at[1], at[6], at[7], at[8], lines[1])
            _straight(y, at[0], at[1], at[10], at[11], lines[2])
            _straight(y, at[0], at[1], at[12], at[13], lines[3])
            _widen(lines[1], blend, maps[1, line])
            _widen(at[CONFIDENCE], blend, maps[2, line])
            _widen(lines[2], blend, maps[3, line])
            _widen(lines[3], blend, maps[4, line])


@kernel
def _rows(
    y: np.float32, top: Array, inverse: Array, row: Array, rise: Array, left: Array, right: Array, line: Array
) -> None:
    """Hermite, written as the line plus what the tangents add."""
    for b in range(len(line)):
        t = (y - top[b]) * inverse[b]
        u = np.float32(1) - t
        line[b] = row[b] + rise[b] * t + t * u * (u * left[b] - t * right[b])


@kernel
def _bulging(
    y: np.float32, top: Array, inverse: Array, above: Array, below: Array, unknown: Array, line: Array
) -> None:
    """Most is unknown half way: a parabola that is nothing at the knots."""
    for b in range(len(line)):
        t = (y - top[b]) * inverse[b]
        u = np.float32(1) - t
        line[b] = u * above[b] + t * below[b] + t * u * unknown[b]


@kernel
def _straight(y: np.float32, top: Array, inverse: Array, above: Array, below: Array, line: Array) -> None:
    for b in range(len(line)):
        t = (y - top[b]) * inverse[b]
        line[b] = (np.float32(1) - t) * above[b] + t * below[b]


@kernel
def _widen(narrow: Array, blend: Ints, wide: Array) -> None:
    """Columns four pixels apart (x = 4 b + 1.5) to all pixels of a line: (B,) to (W,).

    x = 4 b + 2 .. 4 b + 5 lie 1, 3, 5 and 7 eighths of the way from column b to the next.
    """
    last = len(narrow) - 1
    wide[0] = wide[1] = narrow[0]
    for b in range(last):
        left, right = narrow[b], narrow[b + 1]
        step = (right - left) * np.float32(0.125) if blend[b] else np.float32(0)
        far = left if blend[b] else right
        wide[4 * b + 2] = left + step
        wide[4 * b + 3] = left + step * np.float32(3)
        wide[4 * b + 4] = far + step * np.float32(5)
        wide[4 * b + 5] = far + step * np.float32(7)
    for x in range(4 * last + 2, len(wide)):
        wide[x] = narrow[last]
