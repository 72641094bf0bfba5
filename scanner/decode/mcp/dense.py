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

from scanner.decode.mcp.linking import Chains
from scanner.kernel import kernel

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

STEP_RATIO = 1.5
"""Neighbouring intervals that differ by more are a step of depth, not a curved surface: a straight line then."""

UNEVEN = np.float32(0.1)
"""Share of a peak's distance from the middle between its neighbours that its error may be: what bends the surface
bends the profile within the fit window too. Measured on a bust; a curved surface alone leaves less."""

BEND_LEFT = np.float32(0.25)
"""Share of the bend between two stripes that a cubic through them leaves (the rest it follows); all of it at a step."""

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
    columns = len(knots.start) - 1
    narrow = np.full((5, columns, shape[0]), np.nan, np.float32)
    _columns(
        knots.start,
        knots.y,
        knots.row,
        knots.stripe,
        np.stack([knots.sigma, knots.confidence, knots.light, knots.height], axis=1).astype(np.float32),
        np.float32(pitch),
        narrow,
    )
    wide = np.empty((5, *shape), np.float32)
    turned = np.empty((5, shape[0], columns), np.float32)
    _turn(narrow, turned)
    _widen(turned, np.float32(step / 3), wide)
    return Maps(*wide)


@kernel
def _columns(start: Ints, y: Array, row: Array, stripe: Ints, others: Array, pitch: np.float32, narrow: Array) -> None:
    size = narrow.shape[2]
    longest = 1
    for b in range(len(start) - 1):
        longest = max(longest, start[b + 1] - start[b])
    tangent = np.empty(longest, np.float32)
    for b in range(len(start) - 1):
        k = start[b]
        while k < start[b + 1]:
            last = k
            while (
                last + 1 < start[b + 1]
                and stripe[last + 1] == stripe[last] + 1
                and y[last + 1] - y[last] > np.float32(0.25) * pitch
                and y[last + 1] - y[last] < np.float32(2.5) * pitch
            ):
                last += 1
            _tangents(y, row, k, last, tangent)
            _unevenness(y, row, others, k, last)
            if last > k:
                _ends(b, y, row, others, k, last, tangent, size, narrow)
            for j in range(k, last):
                bend = _bend_of(y, row, j, k, last)
                _between(b, y, row, others, j, tangent[j - k], tangent[j - k + 1], bend, size, narrow)
            k = last + 1


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
def _unevenness(y: Array, row: Array, others: Array, first: int, last: int) -> None:
    """Adds to sigma what uneven distances of the stripes say of a knot; the end of a run is as uncertain as its
    neighbour, and twice as much by itself: an edge is near.
    """
    for j in range(first + 1, last):
        slope = (row[j + 1] - row[j - 1]) / (y[j + 1] - y[j - 1])
        off = UNEVEN * slope * (np.float32(0.5) * (y[j - 1] + y[j + 1]) - y[j])
        others[j, 0] = np.sqrt(others[j, 0] * others[j, 0] + off * off)
    if last > first + 1:
        others[first, 0] = max(np.float32(2) * others[first, 0], others[first + 1, 0])
        others[last, 0] = max(np.float32(2) * others[last, 0], others[last - 1, 0])


@kernel
def _bend_of(y: Array, row: Array, j: int, first: int, last: int) -> np.float32:
    """How far rows may bend between knots j and j + 1: the larger change of slope at either, over the gap."""
    gap = y[j + 1] - y[j]
    slope = (row[j + 1] - row[j]) / gap
    change = np.float32(0)
    if j > first:
        change = abs(slope - (row[j] - row[j - 1]) / (y[j] - y[j - 1]))
    if j + 1 < last:
        change = max(change, abs(slope - (row[j + 2] - row[j + 1]) / (y[j + 2] - y[j + 1])))
    bent: np.float32 = change * gap
    return bent


@kernel
def _between(
    b: int,
    y: Array,
    row: Array,
    others: Array,
    j: int,
    left: np.float32,
    right: np.float32,
    unknown: np.float32,
    size: int,
    narrow: Array,
) -> None:
    gap = y[j + 1] - y[j]
    rise = row[j + 1] - row[j]
    slope = rise / gap
    if left < 0 or right < 0:
        left = right = slope
    else:
        unknown *= BEND_LEFT
    a = max(int(np.ceil(y[j])), 0)
    for q in range(a, min(int(np.floor(y[j + 1])), size - 1) + 1):
        t = (q - y[j]) / gap
        u = np.float32(1) - t
        # Hermite, written as the line plus what the tangents add.
        bend = t * u * (u * (left - slope) - t * (right - slope)) * gap
        narrow[0, b, q] = row[j] + rise * t + bend
        # Most is unknown half way: a parabola that is nothing at the knots.
        narrow[1, b, q] = u * others[j, 0] + t * others[j + 1, 0] + t * u * unknown
        narrow[2, b, q] = min(others[j, 1], others[j + 1, 1])
        narrow[3, b, q] = u * others[j, 2] + t * others[j + 1, 2]
        narrow[4, b, q] = u * others[j, 3] + t * others[j + 1, 3]


@kernel
def _ends(
    b: int, y: Array, row: Array, others: Array, first: int, last: int, tangent: Array, size: int, narrow: Array
) -> None:
    reach = np.float32(MARGIN) * (y[first + 1] - y[first])
    slope = tangent[0] if tangent[0] > 0 else (row[first + 1] - row[first]) / (y[first + 1] - y[first])
    for q in range(max(int(np.ceil(y[first] - reach)), 0), min(int(np.ceil(y[first])), size)):
        narrow[0, b, q] = row[first] + slope * (q - y[first])
        _copy(b, q, others, first, narrow)
    reach = np.float32(MARGIN) * (y[last] - y[last - 1])
    t = tangent[last - first]
    slope = t if t > 0 else (row[last] - row[last - 1]) / (y[last] - y[last - 1])
    for q in range(max(int(np.floor(y[last])) + 1, 0), min(int(np.floor(y[last] + reach)) + 1, size)):
        narrow[0, b, q] = row[last] + slope * (q - y[last])
        _copy(b, q, others, last, narrow)


@kernel
def _copy(b: int, q: int, others: Array, k: int, narrow: Array) -> None:
    # Two thirds as sure and twice as uncertain: extrapolated.
    narrow[1, b, q] = 2 * others[k, 0]
    narrow[2, b, q] = np.float32(0.67) * others[k, 1]
    narrow[3, b, q] = others[k, 2]
    narrow[4, b, q] = others[k, 3]


@kernel
def _turn(narrow: Array, turned: Array) -> None:
    """(5, B, H) to (5, H, B), in blocks that stay in the cache."""
    maps, columns, size = narrow.shape
    block = 16
    for m in range(maps):
        for b0 in range(0, columns, block):
            for y0 in range(0, size, block):
                for y in range(y0, min(y0 + block, size)):
                    for b in range(b0, min(b0 + block, columns)):
                        turned[m, y, b] = narrow[m, b, y]


@kernel
def _widen(narrow: Array, agree: np.float32, wide: Array) -> None:
    """Columns four pixels apart (x = 4 b + 1.5) to all pixels: (5, H, B) to (5, H, W).

    x = 4 b + 2 .. 4 b + 5 lie 1, 3, 5 and 7 eighths of the way from column b to the next.
    """
    maps, size, columns = narrow.shape
    width = wide.shape[2]
    for y in range(size):
        for m in range(maps):
            wide[m, y, :2] = narrow[m, y, 0]
            wide[m, y, 4 * columns - 2 :] = narrow[m, y, columns - 1]
        for b in range(columns - 1):
            # False where either is NaN: then the nearer column counts alone.
            blend = abs(narrow[0, y, b + 1] - narrow[0, y, b]) < agree
            for m in range(maps):
                _four(narrow[m, y, b], narrow[m, y, b + 1], blend, wide[m, y, 4 * b + 2 : 4 * b + 6])
        for x in range(width):
            if np.isnan(wide[2, y, x]):
                wide[2, y, x] = 0


@kernel
def _four(left: np.float32, right: np.float32, blend: bool, pixels: Array) -> None:
    step = (right - left) * np.float32(0.125)
    for j in range(4):
        if blend:
            pixels[j] = left + step * np.float32(2 * j + 1)
        else:
            pixels[j] = left if j < 2 else right


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
