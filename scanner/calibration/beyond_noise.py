"""What a form has beyond the noise of its points, and how sure that is.

Noise is what a point differs by from those a few pixels away: feature, lens and calibration move these alike. It is
asked of the points themselves, so that it has their tails and grows where theirs does; stated sigmas, which are good
as an average, need not be right for every point. Widths add up in quadrature, as normal deviations do.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.geometry import Array

NEAREST, FARTHEST = 2, 3
"""Pixels, in lines or columns, of the points that one is compared with: near enough to share the feature's form, too
far to share what a colour camera's or a driver's own smoothing makes of one pixel"""
FEWEST_AROUND = 8
"""Of forty such points: a third of those at a straight rim"""
FEWEST_POINTS = 1000
"""Below, the three in a thousand that a width leaves out are too few to know it by"""
COVERAGE_FACTOR = 2.0


@dataclass(frozen=True)
class Beyond:
    """Of one width, mm. noise_mm: what a perfect feature has; noise_random: its 1-sigma by the points that
    happen to be there; noise_doubt: half-width that ripple leaves of it; squared: of the width less that of
    the noise, below 0 by chance; unsure: U of it, without the calibration's part."""

    noise_mm: float
    noise_random: float
    noise_doubt: float
    squared: float
    unsure: float

    def limits(self, width_mm: float, of_calibration: float = 0.0) -> tuple[float, float, float]:
        """What is beyond noise, and the least and the most of it (k = 2); 0 is where noise explains it.

        Args:
            width_mm: the feature's. of_calibration: half-width that the calibration leaves of it.
        """
        unsure = float(np.hypot(self.unsure, 2 * width_mm * of_calibration))
        found, least, most = np.sqrt(np.maximum((self.squared, self.squared - unsure, self.squared + unsure), 0.0))
        return float(found), float(least), float(most)


def beyond_noise(
    off: Array, at: NDArray[np.intp], shape: tuple[int, int], left_out: float, ripple_mm: float = 0.0
) -> Beyond | None:
    """What the width of deviations has beyond that of noise.

    Args:
        off: (n,) mm. at: (n,) their places in the scan, flat. shape: the scan's. left_out: share outside the width.
        ripple_mm: standard uncertainty of them that is common to many points, but for the calibration's: a perfect
            feature may show it, though it is no noise.

    Returns:
        None where too few points have others around them.
    """
    noise, known = _noise(off, at, shape)
    if known.sum() < FEWEST_POINTS:
        return None
    width, of_width = _width(off, left_out)
    alone, of_noise = _width(noise[known], left_out)
    # Both are of the same points: what makes one wider by chance makes the other so.
    both = 2 * width * of_width[known] - 2 * alone * of_noise
    rippled = (alone / max(float(noise[known].std()), 1e-30) * ripple_mm) ** 2
    random = float(of_noise.std()) / np.sqrt(len(of_noise))
    return Beyond(
        alone,
        random,
        float(np.sqrt(alone**2 + rippled) - alone),
        width**2 - alone**2,
        float(np.hypot(COVERAGE_FACTOR * float(both.std()) / np.sqrt(len(both)), rippled)),
    )


def _noise(off: Array, at: NDArray[np.intp], shape: tuple[int, int]) -> tuple[Array, NDArray[np.bool_]]:
    """(n,) of each deviation its own part, mm, and whether it has points enough around it to tell."""
    values, there = np.zeros(shape), np.zeros(shape)
    values.reshape(-1)[at], there.reshape(-1)[at] = off, 1.0
    total, count = (_around(each).reshape(-1)[at] for each in (values, there))
    number = np.maximum(np.rint(count), 1.0)
    return (off - total / number) / np.sqrt(1 + 1 / number), number >= FEWEST_AROUND


def _around(values: Array) -> Array:
    """Sums of the values NEAREST to FARTHEST pixels away."""
    far, near = (
        cv2.boxFilter(values, -1, (2 * reach + 1,) * 2, normalize=False, borderType=cv2.BORDER_CONSTANT)
        for reach in (FARTHEST, NEAREST - 1)
    )
    return np.asarray(far - near, dtype=np.float64)


def _width(off: Array, left_out: float) -> tuple[float, Array]:
    """The least width that holds all but a share of them, and what each of them does to it, but for a common term.

    The number of points outside two fixed limits is binomial, and in first order only that number matters (David and
    Nagaraja 2003, ch. 10): a point outside makes the width larger by the slope that it has with the share left out.
    """
    ordered = np.sort(off)
    width, low, high = _least(ordered, left_out)
    step = left_out / 3
    slope = (_least(ordered, left_out - step)[0] - _least(ordered, left_out + step)[0]) / (2 * step)
    return width, np.where((off < low) | (off > high), slope, 0.0)


def _least(ordered: Array, left_out: float) -> tuple[float, float, float]:
    """The width, and its limits."""
    out = int(left_out * len(ordered))
    spans = ordered[len(ordered) - 1 - out :] - ordered[: out + 1]
    first = int(np.argmin(spans))
    return float(spans[first]), float(ordered[first]), float(ordered[len(ordered) - 1 - out + first])
