"""Dense rows between the stripes, and all maps on the camera's pixels.

Within a column, rows are interpolated between consecutive decoded stripes, never across one that is missing: a cubic
that keeps the order of its knots (Fritsch and Carlson 1980), straight where the pitch changes abruptly, as it does at
steps. Beyond the last stripe of a run half a stripe is added, no further than its own flank reaches. Between columns
(four pixels apart) rows are interpolated linearly where both sides agree to a third of a stripe.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp import dense_lines
from scanner.decode.mcp.linking import Chains
from scanner.kernel import kernel

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

STEP_RATIO = 1.5
"""Neighbouring intervals that differ by more are a step of depth, not a curved surface: a straight line then."""

UNEVEN = np.float32(0.1)
"""Share of the change of bend from stripe to stripe that a peak's error may be: what bends the surface otherwise than
its neighbours do bends the profile within the fit window too, beyond what the fit follows. Measured on a bust."""

MOST_UNEVEN = np.float32(0.3)
"""Pitches of such change that count: more is a step of depth, which bends neither side (`subpixel.MOST_BEND`)."""

BEND_LEFT = np.float32(0.5)
"""Share of the change of bend between two stripes that a cubic through them leaves: it follows an even bend."""

NOISE_SIGMAS = np.float32(1.5)
"""Of what noise may change a bend by, taken off: half as much again as peaks state (boards: 1.2 to 1.7 times)."""

MARGIN = 0.42
"""Pitches added beyond the last stripe of a run: the part of its flank that the fit has seen."""


@dataclass(frozen=True, eq=False)
class Knots:
    """Decoded peaks, column by column: start (B + 1,) int32; y, row, sigma (rows), confidence, light, height float32;
    stripe int32.
    """

    start: Ints
    y: Array
    row: Array
    sigma: Array
    confidence: Array
    light: Array
    height: Array
    stripe: Ints


@dataclass(frozen=True, eq=False)
class Maps:
    """(H, W) float32 each."""

    rows: Array
    sigma: Array
    confidence: Array
    albedo: Array
    modulation: Array


def interpolate(knots: Knots, shape: tuple[int, int], pitch: float, step: float) -> Maps:
    """Maps from decoded peaks.

    Args:
        knots: the decoded peaks.
        shape: (H, W) of the image.
        pitch: mean pitch, image px.
        step: height of a stripe, projector px.
    """
    wide = np.empty((5, *shape), np.float32)
    _interpolate(knots, pitch, step, wide)
    return Maps(*wide)


def rows_alone(knots: Knots, pitch: float, step: float, rows: Array) -> None:
    """`interpolate`'s rows without the other maps, in a third of the time, into `rows`: (H, W) float32."""
    _interpolate(knots, pitch, step, rows[None])


def _interpolate(knots: Knots, pitch: float, step: float, wide: Array) -> None:
    others = np.stack([knots.sigma, knots.confidence, knots.light, knots.height], axis=1).astype(np.float32)
    pieces = _pieces(
        knots.start, knots.y, knots.row, knots.stripe, others, np.float32(pitch), np.float32(step), wide.shape[1]
    )
    dense_lines.draw(len(knots.start) - 1, pieces, step / 3, wide)


@kernel
def _pieces(
    start: Ints, y: Array, row: Array, stripe: Ints, others: Array, pitch: np.float32, step: np.float32, size: int
) -> tuple[Ints, Ints, Ints, Array]:
    """The columns' pieces as `dense_lines.draw` takes them: between two knots, and beyond the ends of a run."""
    count = 2 * len(y) + 1
    column, begin, end = np.empty(count, np.int32), np.empty(count, np.int32), np.empty(count, np.int32)
    figures = np.empty((count, dense_lines.FIGURES), np.float32)
    tangent = np.empty(len(y), np.float32)
    noise = others[:, 0].copy()
    n = 0
    for b in range(len(start) - 1):
        k, of_column = start[b], n
        while k < start[b + 1]:
            last = _end_of_run(y, stripe, k, start[b + 1], pitch)
            _tangents(y, row, k, last, tangent)
            _unevenness(y, row, noise, others, k, last, MOST_UNEVEN * step)
            if last > k:
                reach = np.float32(MARGIN) * (y[k + 1] - y[k])
                slope = tangent[0] if tangent[0] > 0 else (row[k + 1] - row[k]) / (y[k + 1] - y[k])
                lines = np.ceil(y[k] - reach), np.ceil(y[k])
                n = _place(lines, size, of_column, n, begin, end)
                _beyond(y, row, others, k, slope, n - 1, figures)
            for j in range(k, last):
                lines = np.ceil(y[j]), np.floor(y[j + 1]) + np.float32(1)
                n = _place(lines, size, of_column, n, begin, end)
                bend = _bend_of(y, row, noise, j, k, last)
                _between(y, row, others, j, (tangent[j - k], tangent[j - k + 1]), bend, n - 1, figures)
            if last > k:
                reach = np.float32(MARGIN) * (y[last] - y[last - 1])
                t = tangent[last - k]
                slope = t if t > 0 else (row[last] - row[last - 1]) / (y[last] - y[last - 1])
                lines = np.floor(y[last]) + np.float32(1), np.floor(y[last] + reach) + np.float32(1)
                n = _place(lines, size, of_column, n, begin, end)
                _beyond(y, row, others, last, slope, n - 1, figures)
            k = last + 1
        column[of_column:n] = b
    return column[:n], begin[:n], end[:n], figures[:n]


@kernel
def _end_of_run(y: Array, stripe: Ints, first: int, end: int, pitch: np.float32) -> int:
    """The last knot of a run of stripes that follow one another at about a pitch."""
    last = first
    while (
        last + 1 < end
        and stripe[last + 1] == stripe[last] + 1
        and y[last + 1] - y[last] > np.float32(0.25) * pitch
        and y[last + 1] - y[last] < np.float32(2.5) * pitch
    ):
        last += 1
    return last


@kernel
def _place(lines: tuple[np.float32, np.float32], size: int, of_column: int, n: int, begin: Ints, end: Ints) -> int:
    """Put a piece on `lines` of its column, from the first to before the second; returns the number of pieces then.

    Where two runs overlap the lower one has the say.
    """
    low, high = min(max(int(lines[0]), 0), size), min(max(int(lines[1]), 0), size)
    while n > of_column and begin[n - 1] >= low:
        n -= 1
    if n > of_column:
        end[n - 1] = min(end[n - 1], low)
    begin[n], end[n] = low, max(low, high)
    return n + 1


@kernel
def _tangents(y: Array, row: Array, first: int, last: int, tangent: Array) -> None:
    """Slopes at the knots first .. last: harmonic means; the neighbour's own at steps and ends."""
    for j in range(first, last + 1):
        t = np.float32(0)
        if last > first:
            after = (row[min(j, last - 1) + 1] - row[min(j, last - 1)]) / (
                y[min(j, last - 1) + 1] - y[min(j, last - 1)]
            )
            i = max(j, first + 1)
            before = (row[i] - row[i - 1]) / (y[i] - y[i - 1])
            wa, wb = y[min(j + 1, last)] - y[j], y[j] - y[max(j - 1, first)]
            if j == first:
                t = after
                if last > first + 1:  # parabola through three knots
                    second = (row[j + 2] - row[j + 1]) / (y[j + 2] - y[j + 1])
                    w = (y[j + 1] - y[j]) / (y[j + 2] - y[j])
                    if max(after, second) < np.float32(STEP_RATIO) * min(after, second):
                        t = after + (after - second) * w
            elif j == last:
                t = before
                if last > first + 1:
                    second = (row[j - 1] - row[j - 2]) / (y[j - 1] - y[j - 2])
                    w = (y[j] - y[j - 1]) / (y[j] - y[j - 2])
                    if max(before, second) < np.float32(STEP_RATIO) * min(before, second):
                        t = before + (before - second) * w
            else:
                # Parabola's slope, which keeps order while neighbours differ by less than STEP_RATIO.
                t = (before * wa + after * wb) / (wa + wb)
                if max(before, after) > np.float32(STEP_RATIO) * min(before, after):
                    t = -np.float32(1)  # a step: each side keeps its own slope
        tangent[j - first] = t


@kernel
def _beyond_noise(change: np.float32, noise: Array, j: int) -> np.float32:
    """What is left of the third difference of knots j - 1 .. j + 2 when what noise may make of it is taken off."""
    of_noise = noise[j - 1] ** 2 + np.float32(9) * (noise[j] ** 2 + noise[j + 1] ** 2) + noise[j + 2] ** 2
    left: np.float32 = np.sqrt(max(change * change - NOISE_SIGMAS**2 * of_noise, np.float32(0)))
    return left


@kernel
def _uneven(y: Array, row: Array, noise: Array, j: int) -> np.float32:
    """Rows by which the bend changes between knots j and j + 1, both with a neighbour beyond, more than by noise."""
    slope = (row[j + 2] - row[j - 1]) / (y[j + 2] - y[j - 1])
    third = y[j + 2] - y[j - 1] - np.float32(3) * (y[j + 1] - y[j])
    return _beyond_noise(slope * third, noise, j)


@kernel
def _unevenness(y: Array, row: Array, noise: Array, others: Array, first: int, last: int, step: np.float32) -> None:
    """Adds to sigma what uneven distances of the stripes say of a knot: not that they change, as they do on a surface
    that is seen at an angle, but that they change otherwise than beside it. The end of a run is as uncertain as its
    neighbour, and twice as much by itself: an edge is near.
    """
    for j in range(first + 1, last):
        # A knot that lies half way between its neighbours is on a straight piece, whatever comes beyond.
        slope = (row[j + 1] - row[j - 1]) / (y[j + 1] - y[j - 1])
        own, change = slope * abs(y[j - 1] + y[j + 1] - np.float32(2) * y[j]), np.float32(0)
        if j - 1 > first:
            change = _uneven(y, row, noise, j - 1)
        if j + 1 < last:
            change = max(change, _uneven(y, row, noise, j))
        if last - first == 2:  # nothing beside it says how much of its bend the surface has
            change = own
        off = UNEVEN * min(own, change, step)
        others[j, 0] = np.sqrt(noise[j] ** 2 + off * off)
    if last > first + 1:
        others[first, 0] = max(np.float32(2) * others[first, 0], others[first + 1, 0])
        others[last, 0] = max(np.float32(2) * others[last, 0], others[last - 1, 0])


@kernel
def _bend_of(y: Array, row: Array, noise: Array, j: int, first: int, last: int) -> tuple[np.float32, np.float32]:
    """How far rows may bend between knots j and j + 1: the larger change of slope at either, over the gap; and by how
    much these differ from one another more than by noise: at the end of a run, all of the one there is.
    """
    gap = y[j + 1] - y[j]
    slope = (row[j + 1] - row[j]) / gap
    before, after = np.float32(0), np.float32(0)
    if j > first:
        before = slope - (row[j] - row[j - 1]) / (y[j] - y[j - 1])
    if j + 1 < last:
        after = (row[j + 2] - row[j + 1]) / (y[j + 2] - y[j + 1]) - slope
    apart = abs(after - before) * gap
    if j > first and j + 1 < last:
        apart = _beyond_noise(apart, noise, j)
    return max(abs(before), abs(after)) * gap, apart


@kernel
def _between(
    y: Array,
    row: Array,
    others: Array,
    j: int,
    tangents: tuple[np.float32, np.float32],
    bend: tuple[np.float32, np.float32],
    n: int,
    figures: Array,
) -> None:
    """Figures of piece n, between knots j and j + 1 (`dense_lines.FIGURES`)."""
    left, right = tangents
    gap = y[j + 1] - y[j]
    rise = row[j + 1] - row[j]
    slope = rise / gap
    if left < 0 or right < 0:
        left = right = slope
        unknown = bend[0]
    else:
        unknown = BEND_LEFT * bend[1]
    figures[n, 0], figures[n, 1] = y[j], np.float32(1) / gap
    figures[n, 2], figures[n, 3] = row[j], rise
    figures[n, 4], figures[n, 5] = (left - slope) * gap, (right - slope) * gap
    figures[n, 6], figures[n, 7], figures[n, 8] = others[j, 0], others[j + 1, 0], unknown
    figures[n, 9] = min(others[j, 1], others[j + 1, 1])
    figures[n, 10], figures[n, 11] = others[j, 2], others[j + 1, 2]
    figures[n, 12], figures[n, 13] = others[j, 3], others[j + 1, 3]


@kernel
def _beyond(y: Array, row: Array, others: Array, k: int, slope: np.float32, n: int, figures: Array) -> None:
    """Figures of piece n, beyond knot k, at a run's end: extrapolated, two thirds as sure and twice as uncertain."""
    figures[n, 0], figures[n, 1] = y[k], np.float32(1)
    figures[n, 2], figures[n, 3], figures[n, 4], figures[n, 5] = row[k], slope, np.float32(0), np.float32(0)
    figures[n, 6] = figures[n, 7] = np.float32(2) * others[k, 0]
    figures[n, 8] = np.float32(0)
    figures[n, 9] = np.float32(0.67) * others[k, 1]
    figures[n, 10] = figures[n, 11] = others[k, 2]
    figures[n, 12] = figures[n, 13] = others[k, 3]


def stripe_map(y: Array, stripe: Ints, chains: Chains, shape: tuple[int, int]) -> NDArray[np.int16]:
    """Index of the decoded stripe at the pixel nearest to its peak, -1 elsewhere: (H, W) int16.

    Args:
        y: (P,) float32, sub-pixel peaks.
        stripe: (P,) int32, -1 where undecided.
        chains: their chains: between two columns the peak lies on the line that joins them.
        shape: (H, W).
    """
    result = np.full(shape, -1, np.int16)
    _mark(y, stripe, chains.order, chains.start, chains.column, result)
    return result


@kernel
def _mark(y: Array, stripe: Ints, order: Ints, start: Ints, column: Ints, result: NDArray[np.int16]) -> None:
    height, width = result.shape
    for c in range(len(start) - 1):
        for p in range(start[c], start[c + 1]):
            k = order[p]
            if stripe[k] < 0:
                continue
            before = order[max(p - 1, start[c])]
            after = order[min(p + 1, start[c + 1] - 1)]
            extra = width - 4 * column[k] if width - 4 * column[k] < 8 else 4  # the last column takes what is left over
            for j in range(extra):
                other = before if j < 2 else after
                t = abs(np.float32(j) - np.float32(1.5)) * np.float32(0.25)
                line = y[k]
                if stripe[other] == stripe[k]:
                    line += (y[other] - y[k]) * min(t, np.float32(1))
                row = int(np.floor(line + np.float32(0.5)))
                if 0 <= row < height:
                    result[row, 4 * column[k] + j] = stripe[k]


def spread(column: Ints, y: Array, value: NDArray[np.uint8], reach: int, around: NDArray[np.uint8]) -> None:
    """Write each peak's value on the pixels within `reach` px of it of its column, the nearer peak's where two meet.

    Args:
        column, y, value: (P,) of the peaks, column by column, from top to bottom.
        reach: px.
        around: (B, H), changed in place.
    """
    _spread(column, y, value, reach, around)


@kernel
def _spread(column: Ints, y: Array, value: NDArray[np.uint8], reach: int, around: NDArray[np.uint8]) -> None:
    count, size = len(y), around.shape[1]
    for k in range(count):
        low, high = y[k] - reach, y[k] + reach
        if k > 0 and column[k - 1] == column[k]:
            low = max(low, np.float32(0.5) * (y[k - 1] + y[k]))
        if k + 1 < count and column[k + 1] == column[k]:
            high = min(high, np.float32(0.5) * (y[k] + y[k + 1]))
        for q in range(max(int(np.ceil(low)), 0), min(int(np.floor(high)), size - 1) + 1):
            around[column[k], q] = value[k]


def widen_reasons(around: NDArray[np.uint8], rows: Array, reason: NDArray[np.uint8]) -> None:
    """Reasons of columns of four pixels to all pixels; 0 (`Reason.VALUE`) where there is a row.

    Args:
        around: (B, H) uint8.
        rows: (H, W) float32, NaN where there is none.
        reason: (H, W) uint8, set in place. The last column takes what is left over at the right.
    """
    _widen_reasons(np.ascontiguousarray(around.T), rows, reason)


@kernel
def _widen_reasons(around: NDArray[np.uint8], rows: Array, reason: NDArray[np.uint8]) -> None:
    height, columns = around.shape
    width = rows.shape[1]
    for y in range(height):
        line, out = rows[y], reason[y]
        for b in range(columns):
            value = around[y, b]
            for j in range(4):
                row = line[4 * b + j]
                out[4 * b + j] = value * np.uint8(row != row)  # noqa: PLR0124  (NaN alone differs from itself)
        for x in range(4 * columns, width):
            out[x] = around[y, columns - 1] * np.uint8(line[x] != line[x])
