"""Brightness along the tracks: four samples to a place, above the valleys; along joined ones over what is
printed there.

Not here: the carriers in it (`carriers`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp.stripes import STEP, Image
from scanner.decode.mcp.tracks import WIDE, Tracks
from scanner.kernel import kernel

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

FLAT = 0.35
"""Sigma, in periods of the lowest carrier, of the means by which the light of joined tracks is divided: they leave that
carrier .91 of its amplitude, and follow print of two periods to two thirds."""


@dataclass(frozen=True, eq=False)
class Signals:
    """light: (4 N,) float32, brightness along the tracks, four samples to a place, in the order of `Tracks.chains`:
    above the valleys; along joined tracks over what is printed there, 1 in the mean. clipped: (P,) float32, share of
    clipped pixels about each peak.
    """

    light: Array
    clipped: Array


def signals_along(image: Image, tracks: Tracks, pitch: float, longest: float, limit: int) -> Signals:
    """Image brightness along the tracks: above the valleys; along joined ones over what is printed there.

    Args:
        image: (H, W) as captured.
        tracks: where P peaks and V places more are read.
        pitch: px. Rows within a sixth of it are averaged; of joined tracks all of the stripe.
        longest: period of the lowest carrier, px.
        limit: largest grey level: pixels at it are clipped.
    """
    chains = tracks.chains
    light = np.empty(STEP * len(chains.order), np.float32)
    clipped = np.zeros(len(tracks.y), np.float32)
    reach = np.where(tracks.joined, max(1, round(WIDE * pitch)), max(1, round(pitch / 6))).astype(np.int32)
    _signals(image, tracks.y, tracks.valley, chains.order, chains.start, chains.column, reach, limit, light, clipped)
    if tracks.joined.any():
        half = int(np.ceil(2.5 * FLAT * longest))
        weights = np.exp(-0.5 * (np.arange(-half, half + 1) / (FLAT * longest)) ** 2).astype(np.float32)
        _flatten(light, chains.start, tracks.joined, tracks.ambient, weights)
    return Signals(light, clipped[: len(tracks.place)])


@kernel
def _flatten(light: Array, start: Ints, joined: NDArray[np.bool_], ambient: Array, weights: Array) -> None:
    """Divide the light of joined tracks by its local mean, with `weights` (odd, symmetrical), in place.

    What is printed multiplies pattern and ambient light alike: over their local mean both are without it. The pattern's
    part is then drawn out by the ambient light's share. The result is 1 in the mean.
    """
    half = len(weights) // 2
    for c in range(len(joined)):
        if not joined[c]:
            continue
        first, size = STEP * start[c], STEP * (start[c + 1] - start[c])
        total = light[first : first + size].copy()
        gain = np.float32(1) / (np.float32(1) - ambient[c])
        for q in range(size):
            mean, weight = np.float32(0), np.float32(0)
            for j in range(max(-half, -q), min(half, size - 1 - q) + 1):
                mean += weights[half + j] * total[q + j]
                weight += weights[half + j]
            over = total[q] * weight / max(mean, np.float32(1e-6))
            light[first + q] = np.float32(1) + (over - np.float32(1)) * gain


@kernel
def _signals(
    image: Image,
    y: Array,
    valley: Array,
    order: Ints,
    start: Ints,
    column: Ints,
    reaches: Ints,
    limit: int,
    light: Array,
    clipped: Array,
) -> None:
    height, width = image.shape
    pixels = image.reshape(-1)
    rows, base, sums = np.empty(4, np.int64), np.empty(4, np.float32), np.empty(4, np.int64)
    for c in range(len(start) - 1):
        first, last, reach = start[c], start[c + 1] - 1, reaches[c]
        for p in range(first, last + 1):
            k = order[p]
            before = order[max(p - 1, first)]
            after = order[min(p + 1, last)]
            for j in range(4):
                # x = 4 b + j lies (j - 1.5) / 4 of a column from the peak's own x = 4 b + 1.5.
                t = np.float32((j - 1.5) / 4)
                other = before if t < 0 else after
                t = abs(t)
                rows[j] = int(np.floor(y[k] + (y[other] - y[k]) * t + 0.5))
                base[j] = valley[k] + (valley[other] - valley[k]) * t
            a, b = max(rows[0] - reach, 0), min(rows[0] + reach, height - 1)
            if rows[0] == rows[1] == rows[2] == rows[3]:
                begin = np.uintp(a * width + 4 * column[k])
                if _sums_of_four(pixels, begin, np.uintp(width), b - a + 1, sums) < limit:  # hardly any is clipped
                    for j in range(4):
                        light[4 * p + j] = np.float32(sums[j]) / np.float32(b - a + 1) - base[j]
                    continue
            for j in range(4):
                a, b = max(rows[j] - reach, 0), min(rows[j] + reach, height - 1)
                total, high = 0, 0
                for r in range(a, b + 1):
                    value = int(image[r, 4 * column[k] + j])
                    total += value
                    high += value >= limit
                light[4 * p + j] = np.float32(total) / np.float32(b - a + 1) - base[j]
                clipped[k] += np.float32(high) / np.float32(4 * (b - a + 1))


@kernel
def _sums_of_four(pixels: NDArray[Any], at: np.uintp, width: np.uintp, count: int, sums: NDArray[np.int64]) -> int:
    """Sums over `count` rows of the four pixels from `at` on; returns a level that none of them is above.

    Indices without a sign are no distances from an array's end, which would have to be asked each time.
    """
    a, b, c, d, top = 0, 0, 0, 0, 0
    one, two, three = np.uintp(1), np.uintp(2), np.uintp(3)
    for _ in range(count):
        e, f, g, h = int(pixels[at]), int(pixels[at + one]), int(pixels[at + two]), int(pixels[at + three])
        a, b, c, d = a + e, b + f, c + g, d + h
        top = max(top, e | f | g | h)
        at += width
    sums[0], sums[1], sums[2], sums[3] = a, b, c, d
    return top


def warm_up() -> None:
    """Compile what only images with print come to."""
    one = np.ones(1, np.float32)
    _flatten(np.ones(STEP, np.float32), np.arange(2, dtype=np.int32), np.ones(1, np.bool_), one, one)
