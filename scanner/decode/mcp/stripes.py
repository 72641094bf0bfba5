"""Stripe finding: the pitch, and in each column of the image the stripes' peaks with their valleys (Casey 2011, 4.1).

Columns are averaged by fours first: sample b stands for x = 4 b + 1.5. The dissertation binarises with a hole filter
in two passes to learn the stripes' frequency; here the columns' mean spectrum is matched with the pattern's own on a
logarithmic frequency axis, which also tells a stripe from a pair of them in the published pattern, whose stripes are
bright and dim in turn.
Not here: which stripe a peak is, and where it lies to a fraction of a pixel.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len, rfft

from scanner.decode.mcp.model import PatternModel
from scanner.decode.mcp.ranks import median, quantiles
from scanner.kernel import kernel

Array = NDArray[np.float32]
Image = NDArray[Any]
"""(H, W) uint8 or uint16"""

STEP = 4
"""Image columns averaged into one. A twelfth of the smallest object worth decoding (50 px), a quarter of the work."""

TURNED = 16
"""Rows turned together: a cache line of the turned image."""

MIN_PITCH_PX = 5.0
"""Finer stripes have less than two samples on a flank once blurred by camera and projector."""

MIN_STRIPES = 3.0
"""Stripes in the image below which nothing can be decoded: a code word needs neighbours."""

_LOG_STEP = 0.01
"""Ratio between neighbours of the logarithmic frequency axis: a tenth of the spread that depth gives the pitch."""

APART = 15
"""Steps of that axis between candidates: nearer ones find the same stripes."""

HEIGHT_FLOOR = 0.04
"""Stripes lower than this share of the 99th percentile are left out: what lies outside the object (mcp.md, sec. 3)."""

LEAST_FLANK = 0.45
"""Least ratio of a stripe's two flanks: below it one is cut off by an edge of the object."""


@dataclass(frozen=True, eq=False)
class Peaks:
    """Stripe peaks, column by column from left to right, from top to bottom within one.

    start: (B + 1,) int32, where each column's peaks begin. Of each peak (P,) float32: y px; height above the line
    between its valleys and brightness of that line, grey levels; above, below: y of the valleys. clear: uint8,
    0 where a flank is missing. A flank that the image's border cuts is taken for the other's mirror image; a peak on
    the border row itself may lie beyond it.
    """

    start: NDArray[np.int32]
    y: Array
    height: Array
    valley: Array
    above: Array
    below: Array
    clear: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.y)

    def where(self, kept: NDArray[np.bool_]) -> Peaks:
        """Those of the peaks that are `kept` (P,)."""
        start = np.concatenate(([0], np.cumsum(kept)))[self.start].astype(np.int32)
        lines = (self.y[kept], self.height[kept], self.valley[kept], self.above[kept], self.below[kept])
        return Peaks(start, *lines, self.clear[kept])


def reduce_columns(image: Image) -> Array:
    """Average columns by fours and turn the image, so that a column is contiguous.

    Args:
        image: (H, W) uint8 or uint16.

    Returns:
        (W // 4, H) float32, grey levels. Up to three columns at the right are left out.
    """
    reduced = np.empty((image.shape[1] // STEP, image.shape[0]), np.float32)
    _reduce(image, reduced)
    return reduced


@kernel
def _reduce(image: Image, reduced: Array) -> None:
    columns, rows = reduced.shape
    lines = np.empty((TURNED, columns), np.float32)
    for y0 in range(0, rows, TURNED):
        count = min(TURNED, rows - y0)
        for j in range(count):
            _means(image, y0 + j, lines[j])
        if count == TURNED:  # a loop of fixed length is unrolled
            for b in range(columns):
                for j in range(TURNED):
                    reduced[b, y0 + j] = lines[j, b]
        else:
            for b in range(columns):
                for j in range(count):
                    reduced[b, y0 + j] = lines[j, b]


@kernel
def _means(image: Image, y: int, line: Array) -> None:
    for b in range(len(line)):
        x = 4 * b
        total = (
            np.int32(image[y, x]) + np.int32(image[y, x + 1]) + np.int32(image[y, x + 2]) + np.int32(image[y, x + 3])
        )
        line[b] = np.float32(total) * np.float32(0.25)


def noise_of(reduced: Array) -> float:
    """Noise of the averaged columns, grey levels (1 sigma).

    From second differences along the column, which vanish on a triangle's flanks; the median ignores the peaks.
    """
    return float(median(_second_differences(reduced, max(1, len(reduced) // 64))) * 1.4826 / np.sqrt(6))


@kernel
def _second_differences(reduced: Array, hop: int) -> Array:
    """Their magnitudes along every `hop`-th column."""
    columns, rows = reduced.shape
    found = np.empty(((columns + hop - 1) // hop, rows - 2), np.float32)
    for n in range(len(found)):
        line, out = reduced[n * hop], found[n]
        for y in range(len(out)):
            out[y] = abs((line[y + 2] - np.float32(2) * line[y + 1]) + line[y])
    return found


def estimate_pitch(reduced: Array, model: PatternModel, count: int = 1) -> list[tuple[float, float]]:
    """The stripes' mean pitch, and what else it could be: texture has periods too.

    Args:
        reduced: (B, H) float32.
        model: the pattern's tables.
        count: candidates wanted.

    Returns:
        best first: pitch in image px, and the correlation (0..1) of image and pattern spectrum at it. At least one.
    """
    axis = np.arange(np.log(2.0 / reduced.shape[1]), np.log(0.5), _LOG_STEP)
    seen = _log_spectrum(reduced[:: max(1, len(reduced) // 64)], axis)
    # The pattern's own, sampled at 16 to a pitch: 1 / 16 is the stripes' frequency there.
    centre = np.log(1 / 16)
    own_axis = centre + np.arange(-100, 131) * _LOG_STEP
    own = _log_spectrum(model.column[None, :], own_axis)
    low = int(np.searchsorted(axis, np.log(MIN_STRIPES / reduced.shape[1])))
    high = int(np.searchsorted(axis, np.log(1 / (MIN_PITCH_PX * 0.8))))
    # Correlation at every shift at once; where the pattern's spectrum sticks out, over what is left.
    padded = np.pad(seen, (100, 130))
    product = np.correlate(padded, own)
    energy = np.correlate(padded**2, np.ones(len(own)))
    norm = np.sqrt(energy * (own @ own)) + 1e-12
    # The share of the image's energy in the window decides between equals.
    score = product / norm * (energy / max(float(seen @ seen), 1e-12)) ** 0.25
    left = score[low:high].copy()
    found: list[tuple[float, float]] = []
    for _ in range(count):
        best = int(np.argmax(left))
        if found and left[best] < 0.5 * found[0][1]:
            break
        found.append((float(1 / np.exp(axis[low + best])), float(left[best])))
        left[max(best - APART, 0) : best + APART + 1] = -np.inf
    return found


def _log_spectrum(columns: Array, axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean amplitude spectrum of `columns` on a logarithmic axis, times frequency, smoothed by 3 %."""
    size = columns.shape[1]
    window = np.hanning(size).astype(np.float32)
    mean = (columns * window).sum(axis=1, keepdims=True) / window.sum()
    length = next_fast_len(2 * size, real=True)
    amplitude = np.abs(rfft((columns - mean) * window, length, axis=1)).mean(axis=0)
    frequency = np.arange(len(amplitude)) / length
    # Times frequency: scenes fall off with 1 / f, so this makes their part level.
    on_axis = np.interp(np.exp(axis), frequency, amplitude * frequency)
    taps = np.exp(-0.5 * (np.arange(-9, 10) / 3) ** 2)
    return np.asarray(np.convolve(on_axis, taps / taps.sum(), mode="same"))


def find_peaks(reduced: Array, pitch: float, carrier_px: float, noise: float, weakest: float = 1.0) -> Peaks:
    """Peaks of all stripes.

    Args:
        reduced: (B, H) float32.
        pitch: mean pitch, px.
        carrier_px: longest period of a carrier, px: columns are smoothed over it, or peaks break up at its troughs.
        noise: 1 sigma of `reduced`, grey levels.
        weakest: mean light of the pattern's dimmest stripe over that of its brightest.
    """
    sigma_x, sigma_y = 0.3 * carrier_px / STEP, pitch / 12
    smooth = _smoothed(reduced, sigma_x, sigma_y)
    # A Gaussian of sigma a, b leaves 1 / sqrt(4 pi a b) of white noise.
    left = noise / np.sqrt(max(1.0, 4 * np.pi * sigma_x * sigma_y))
    table = _peaks_of(smooth, np.float32(5 * left + 1e-3), np.float32(pitch))
    start, rows = table[0], np.ascontiguousarray(table[1].T)
    heights = rows[1]
    if not len(heights):
        return _as_peaks(start, rows)
    floor = HEIGHT_FLOOR * quantiles(heights, 0.99)[0]
    # The published pattern's modulated stripes are dim between two bright ones: those count by their neighbours.
    inner = np.ones(len(heights), bool)
    inner[start[:-1][start[:-1] < len(heights)]] = False
    before, after = np.full_like(heights, np.inf), np.full_like(heights, np.inf)
    before[1:] = np.where(inner[1:], heights[:-1], np.inf)
    after[:-1] = np.where(inner[1:], heights[1:], np.inf)
    beside = np.minimum(before, after)
    beside[np.isinf(beside)] = 0
    dim = (beside >= floor) & (heights >= 0.5 * weakest * beside)
    keep = ((heights >= floor) | dim) & (heights >= 8 * left)
    counts = np.add.reduceat(np.append(keep, False).astype(np.int32), np.minimum(start[:-1], len(keep)))
    counts[start[:-1] == start[1:]] = 0
    return _as_peaks(np.concatenate(([0], np.cumsum(counts))).astype(np.int32), [row[keep] for row in rows])


def _smoothed(reduced: Array, sigma_x: float, sigma_y: float) -> Array:
    """Gaussian means of the columns. Beyond a column's ends the flank that the border cuts goes on: mirrored, a peak
    near the end would run into its own image.
    """
    sides: dict[str, Any] = {"sigmaX": sigma_y, "sigmaY": sigma_x, "borderType": cv2.BORDER_REFLECT_101}
    smooth = np.asarray(cv2.GaussianBlur(reduced, (0, 0), **sides), np.float32)
    reach = int(np.ceil(3 * sigma_y))
    if reduced.shape[1] > 4 * reach:
        for lines, out in ((reduced, smooth), (reduced[:, ::-1], smooth[:, ::-1])):
            slope = (lines[:, :1] - lines[:, 2:3]) / 2
            beyond = lines[:, :1] + slope * np.arange(reach, 0, -1, dtype=np.float32)
            strip = np.ascontiguousarray(np.concatenate((beyond, lines[:, : 2 * reach]), axis=1))
            out[:, :reach] = cv2.GaussianBlur(strip, (0, 0), **sides)[:, reach : 2 * reach]
    return smooth


def spacing(peaks: Peaks) -> float:
    """Median distance of neighbouring peaks in a column, px; 0 where there are none."""
    apart = np.diff(peaks.y)
    apart = apart[apart > 0]  # not from the foot of one column to the head of the next
    return median(apart) if apart.size else 0.0


def _as_peaks(start: NDArray[np.int32], rows: Iterable[Array]) -> Peaks:
    y, height, valley, above, below, clear = rows
    return Peaks(start, y, height, valley, above, below, clear.astype(np.uint8))


@kernel
def _turning_points(line: Array, delta: np.float32, tops: NDArray[np.int32], lows: NDArray[np.int32]) -> int:
    """Maxima and minima in turn, each `delta` from its neighbours (hysteresis); returns the number of maxima.

    lows[k] lies before tops[k], lows[n] after the last.
    """
    n = 0
    rising = True
    low_at, top_at = 0, 0
    low = top = line[0]
    for y in range(1, len(line)):
        value = line[y]
        if rising:
            if value > top:
                top_at, top = y, value
            elif value < top - delta:
                if top > low + delta or n == 0:
                    lows[n] = low_at
                    tops[n] = top_at
                    n += 1
                rising = False
                low_at, low = y, value
        elif value < low:
            low_at, low = y, value
        elif value > low + delta:
            rising = True
            top_at, top = y, value
    if rising and n > 0 and top > low + delta:  # cut by the column's end
        lows[n] = low_at
        tops[n] = top_at
        n += 1
        low_at = len(line) - 1
    lows[n] = low_at
    return n


@kernel
def _describe(line: Array, top: int, above: int, below: int, pitch: np.float32, row: Array) -> None:
    """The six figures of `Peaks` for one maximum."""
    size = len(line)
    # A flank that the border cuts says nothing of its height: the other one stands for both.
    half = np.float32(0.5) * pitch
    if top < half:
        low, high, above = line[below], line[below], 2 * top - below
    elif size - 1 - top < half:
        low, high, below = line[above], line[above], 2 * top - above
    else:
        low, high = line[above], line[below]
    left, right = line[top] - low, line[top] - high
    valley = low + (high - low) * (top - above) / max(below - above, 1)
    row[0] = top
    if 0 < top < size - 1:
        curve = line[top - 1] - 2 * line[top] + line[top + 1]
        if curve < 0:
            row[0] += np.float32(0.5) * (line[top - 1] - line[top + 1]) / curve
    row[1] = line[top] - valley
    row[2] = valley
    row[3] = above
    row[4] = below
    row[5] = 1.0 if min(left, right) > np.float32(LEAST_FLANK) * max(left, right) else 0.0


@kernel
def _peaks_of(smooth: Array, delta: np.float32, pitch: np.float32) -> tuple[NDArray[np.int32], Array]:
    """All maxima of all columns with their figures: where columns begin (B + 1,), and (P, 6)."""
    columns, size = smooth.shape
    start = np.zeros(columns + 1, np.int32)
    capacity = columns * (int(size / (0.3 * pitch)) + 4)
    rows = np.empty((capacity, 6), np.float32)
    tops = np.empty(size + 2, np.int32)
    lows = np.empty(size + 2, np.int32)
    count = 0
    for b in range(columns):
        for k in range(_turning_points(smooth[b], delta, tops, lows)):
            top = tops[k]
            if count < capacity:
                # A valley further than a pitch away is flat ground: its near end counts.
                above, below = max(lows[k], top - int(pitch)), min(lows[k + 1], top + int(pitch))
                _describe(smooth[b], top, above, below, pitch, rows[count])
                count += 1
        start[b + 1] = count
    return start, rows[:count].copy()
