"""Surface inclination: slope of the stripes, segments of like slope, rotation (Casey 2011, sec. 4.2).

A stripe that runs obliquely turns its carriers' bands in the spectrum. Where that matters, the image is cut into
segments of positive, negligible and negative slope, and each is turned upright before its channels are isolated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp.casey2011.stripe_detection import Binary, Peaks
from scanner.kernel import kernel

Array = NDArray[np.float32]

LEAST_SHARE = 0.02
"""Share of all peaks below which a segment stays with the negligible ones: too small for a spectrum of its own."""


@dataclass(frozen=True, eq=False)
class Segment:
    """A part of the image that is decoded as one (sec. 4.2, eq. 5.11).

    name: "negligible", "positive" or "negative". mask: (H, W) uint8. slope: mean slope of its stripes, px per px.
    """

    name: str
    mask: Binary
    slope: float

    @property
    def turn(self) -> NDArray[np.float64]:
        """(2, 3) float64: the affine map that turns the segment's stripes level, about the image's centre."""
        height, width = self.mask.shape
        centre = ((width - 1) / 2, (height - 1) / 2)
        degrees = float(np.degrees(np.arctan(self.slope)))
        return np.asarray(cv2.getRotationMatrix2D(centre, degrees, 1.0), np.float64)


def slopes(peaks: Peaks, wavelength: float) -> Array:
    """Least-squares slope of the peak pixels around each peak (sec. 4.2, eq. 5.4-5.10), (P,) float32, dy / dx.

    The window is two wavelengths wide and one high, so that it holds one stripe.
    """
    return _slopes(peaks.start, peaks.y, max(2, round(wavelength)), wavelength / 2)


def negligible_slope(wavelength: float, spacing: float) -> float:
    """Slope up to which no rotation is needed: thresholds t_p = -t_n of eq. 5.11.

    A slope m shifts a band by m times the vertical frequency. At the stripe frequency that may reach half the spacing
    of the carriers (cycles per px), where channels begin to cross.
    """
    return 0.5 * spacing * wavelength


def segments(peaks: Peaks, slope: Array, limit: float, wavelength: float, shape: tuple[int, int]) -> list[Segment]:
    """Split the image by slope (sec. 4.2, eq. 5.11-5.13): negligible first; positive and negative if large enough.

    Masks are the peaks of each set, dilated by a square of two wavelengths. The negligible segment takes what is too
    small for its own, and its mask is the whole image: it is not rotated, and what lies elsewhere does it no harm.
    """
    found = [Segment("negligible", np.ones(shape, np.uint8), 0.0)]
    side = 2 * max(1, round(wavelength)) + 1
    for name, chosen in (("positive", slope > limit), ("negative", slope < -limit)):
        if chosen.sum() < LEAST_SHARE * len(slope) or not chosen.any():
            continue
        marked = np.zeros(shape, np.uint8)
        marked[peaks.y[chosen], peaks.column[chosen]] = 1
        mask = cv2.dilate(marked, np.ones((side, side), np.uint8))
        found.append(Segment(name, np.asarray(mask), float(slope[chosen].mean())))
    return found


def segment_of(found: list[Segment], slope: Array, limit: float) -> NDArray[np.intp]:
    """Index of the segment that each peak is decoded in (sec. 4.2, eq. 5.11), (P,)."""
    number = np.zeros(len(slope), np.intp)
    for k, segment in enumerate(found):
        if segment.name == "positive":
            number[slope > limit] = k
        elif segment.name == "negative":
            number[slope < -limit] = k
    return number


def turned_level(image: Array, segment: Segment) -> Array:
    """The segment, masked and turned until its stripes are level (sec. 4.2, eq. 5.12, 5.13), (H, W) float32; zero
    outside."""
    if segment.slope == 0:
        return image
    masked = image * segment.mask
    return np.asarray(_warp(masked, segment.turn, cv2.INTER_LINEAR))


def level_mask(segment: Segment) -> Binary:
    """The segment's mask, turned with it (sec. 4.2), (H, W) uint8: sec. 4.5 takes mean and sigma of what is inside."""
    return segment.mask if segment.slope == 0 else np.asarray(_warp(segment.mask, segment.turn, cv2.INTER_NEAREST))


def turned_back(bits: Binary, segment: Segment) -> Binary:
    """A binary image of the level segment turned back to how the camera saw it (sec. 4.2), (H, W) uint8.

    Channels are turned back, not code words, so that all segments are read on the same peaks.
    """
    if segment.slope == 0:
        return bits
    return np.asarray(_warp(bits, np.asarray(cv2.invertAffineTransform(segment.turn), np.float64), cv2.INTER_NEAREST))


def _warp(image: NDArray[Any], turn: NDArray[np.float64], how: int) -> NDArray[Any]:
    return np.asarray(cv2.warpAffine(image, turn, image.shape[::-1], flags=how))


@kernel
def _slopes(start: NDArray[np.int32], y: NDArray[np.int32], reach: int, half: float) -> Array:
    columns = len(start) - 1
    slope = np.zeros(len(y), np.float32)
    sums = np.zeros((len(y), 5))
    for c in range(columns):
        for other in range(max(0, c - reach), min(columns, c + reach + 1)):
            dx = other - c
            first = start[other]
            for p in range(start[c], start[c + 1]):
                # Both columns run downwards: what lies above this peak's window lies above the next one's.
                while first < start[other + 1] and y[first] - y[p] < -half:
                    first += 1
                q = first
                while q < start[other + 1] and y[q] - y[p] <= half:
                    dy = y[q] - y[p]
                    sums[p, 0] += 1
                    sums[p, 1] += dx
                    sums[p, 2] += dy
                    sums[p, 3] += dx * dx
                    sums[p, 4] += dx * dy
                    q += 1
    for p in range(len(y)):
        n, sx, sy, sxx, sxy = sums[p]
        spread = n * sxx - sx * sx
        if spread > 0:
            slope[p] = (n * sxy - sx * sy) / spread
    return slope
