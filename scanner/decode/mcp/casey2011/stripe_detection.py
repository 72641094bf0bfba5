"""Stripes and their peaks, to the pixel (Casey 2011, sec. 4.1): adaptive threshold, two passes, local maxima.

Peaks are whole pixels of the image without the hole filter, whose asymmetry displaces them: no sub-pixel position is
estimated anywhere in this decoder. What the stripes mean is not asked here.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from scanner.kernel import kernel

Array = NDArray[np.float32]
Binary = NDArray[np.uint8]

SMOOTHING = 5
"""Side of the moving average on the thresholded image, px ("default sized", sec. 4.1): it damps what is shorter than
the finest stripes that have a peak of their own."""

ALONG, ACROSS = 0.25, 3
"""Moving average against the camera's noise: wavelengths along the stripe, px across. Without it noise of 1 % turns the
tip of a triangle into a choice among several pixels (board of the reference scenes: 1.4 mm rms instead of .7; rounding
to whole pixels alone makes .65). Along a stripe nothing is moved across it; three rows are symmetric about the tip."""

FEWEST_STRIPES = 4
"""Lowest frequency taken for stripes, cycles per image height: below it lies shading, which the threshold leaves."""

SHORTEST_RUN = 0.25
"""Shortest stripe region along a column, in wavelengths. A triangle stands above its own mean over .5."""


@dataclass(frozen=True, eq=False)
class Peaks:
    """Peak pixels, column by column, top to bottom.

    start: (W + 1,) int32, peaks of column c are start[c] .. start[c + 1] - 1.
    y: (P,) int32, pixel row.
    column: (P,) int32, pixel column.
    """

    start: NDArray[np.int32]
    y: NDArray[np.int32]
    column: NDArray[np.int32]

    def image(self, shape: tuple[int, int]) -> Binary:
        """The stripe image (sec. 4.1): (H, W) uint8, 1 on peaks."""
        marked = np.zeros(shape, np.uint8)
        marked[self.y, self.column] = 1
        return marked


@dataclass(frozen=True, eq=False)
class Stripes:
    """What detection leaves: calm and enhanced (H, W) float32; region (H, W) uint8; the peaks.

    wavelength: px between peaks, both kinds of stripe. dark, threshold: grey levels.
    """

    calm: Array
    enhanced: Array
    region: Binary
    peaks: Peaks
    wavelength: float
    dark: float
    threshold: float


def detect(image: NDArray[np.uint8] | NDArray[np.uint16], stripes: int, weakest: float) -> Stripes:
    """Find the stripes in two passes (sec. 4.1).

    Args:
        image: (H, W), stripes horizontal.
        stripes: of the pattern, both kinds. The first pass takes the image to hold just the whole pattern.
        weakest: mean light of the dimmest stripe over the brightest's.
    """
    grey = image.astype(np.float32)
    first = grey.shape[0] / stripes
    wavelength = grey.shape[0] / stripe_frequency(regions(enhance(grey, first)))
    enhanced = enhance(grey, wavelength)
    region = regions(enhanced)
    dark, threshold = intensity_threshold(image, weakest)
    calm = calmed(grey, wavelength)
    peaks = find_peaks(calm, region, threshold, max(2, round(SHORTEST_RUN * wavelength)))
    return Stripes(calm, enhanced, region, peaks, wavelength, dark, threshold)


def calmed(grey: Array, wavelength: float, across: int = ACROSS) -> Array:
    """The image in which peaks are sought (sec. 4.1: the unfiltered one), after a short moving average, (H, W) float32.

    The average is ours: without it the camera's noise decides among the pixels of a tip (see ACROSS).

    Minima and mid-levels are sought with `across` 1: rows on either side of a minimum between unequal stripes differ.
    """
    return np.asarray(cv2.blur(grey, (2 * round(ALONG * wavelength / 2) + 1, across)), np.float32)


def enhance(grey: Array, wavelength: float) -> Array:
    """Image less its hole-filtered self (sec. 4.1, fig. 4.2, eq. 5.1-5.3): stripes about zero, (H, W) float32.

    The filter is one column wide and one wavelength high, the average of all its pixels but the middle one. Borders
    are reflected.
    """
    length = max(3, 2 * round((wavelength - 1) / 2) + 1)
    total = cv2.boxFilter(grey, cv2.CV_32F, (1, length), normalize=False, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(grey - (total - grey) / np.float32(length - 1), np.float32)


def regions(enhanced: Array) -> Binary:
    """Stripe regions: the enhanced image above zero (sec. 4.1, fig. 4.4), (H, W) uint8."""
    return np.asarray(cv2.threshold(enhanced, 0, 1, cv2.THRESH_BINARY)[1]).astype(np.uint8)


def stripe_frequency(region: Binary) -> float:
    """Cycles per image height: the largest value of the spectrum's first column, DC removed (sec. 4.1).

    The first column of a two-dimensional transform is the transform of the rows' sums; no more is computed.
    """
    smooth = cv2.blur(region.astype(np.float32), (SMOOTHING, SMOOTHING))
    rows = smooth.sum(axis=1, dtype=np.float64)
    column = np.abs(fft.rfft(rows - rows.mean()))
    return float(FEWEST_STRIPES + int(np.argmax(column[FEWEST_STRIPES:])))


def intensity_threshold(image: NDArray[np.uint8] | NDArray[np.uint16], weakest: float) -> tuple[float, float]:
    """The dark level and the intensity below which nothing is a stripe (sec. 4.1, "final step").

    The dissertation leaves the value to the user. Here it lies half the dimmest stripe's mean above the dark level
    (1st percentile), with the 99th percentile for the brightest stripe's peak.
    """
    low, high = (float(v) for v in np.percentile(image[::3, ::3], (1, 99)))
    return low, low + 0.5 * weakest * (high - low)


def find_peaks(calm: Array, region: Binary, threshold: float, shortest: int) -> Peaks:
    """Largest pixel in each region of each column (sec. 4.1).

    Args:
        calm: (H, W), the image but for noise.
        region: (H, W) uint8.
        threshold: least grey level of a peak.
        shortest: regions with fewer pixels along the column are noise.
    """
    upright = np.asarray(cv2.transpose(calm), np.float32)
    found, counts = _peaks(upright, np.asarray(cv2.transpose(region), np.uint8), threshold, shortest)
    start = np.concatenate(([0], np.cumsum(counts))).astype(np.int32)
    column = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    return Peaks(start, found, column)


@kernel
def _peaks(
    upright: Array, inside: Binary, threshold: float, shortest: int
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Peaks of each line of the transposed images; of equal pixels (a clipped peak) the middle one."""
    columns, height = upright.shape
    found = np.empty(columns * (height // 2 + 1), np.int32)
    counts = np.zeros(columns, np.int32)
    n = 0
    for c in range(columns):
        r = 0
        while r < height:
            if not inside[c, r]:
                r += 1
                continue
            begin = r
            best = first = last = r
            while r < height and inside[c, r]:
                if upright[c, r] > upright[c, best]:
                    best = first = last = r
                elif upright[c, r] == upright[c, best]:
                    last = r
                r += 1
            # A region that the border cuts has its peak outside, perhaps.
            if begin > 0 and r < height and r - begin >= shortest and upright[c, best] > threshold:
                found[n] = (first + last) // 2
                counts[c] += 1
                n += 1
    return found[:n].copy(), counts
