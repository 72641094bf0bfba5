"""After the hidden Markov model (Casey 2011, sec. 5.4, 2.1): mode, blobs, growth, then the stripes between.

Growth goes wherever stripe regions touch, across edges of depth too: that is the published method, and its weakness.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp.casey2011.stripe_detection import Array, Binary, Peaks
from scanner.kernel import kernel

Labels = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Marks:
    """Places with a name (sec. 2.1), one row each: x, y px (whole pixels), index (k + 0.5: minimum after stripe k, 2x;
    k +- 0.25: mid-level beside its peak, 4x), confidence."""

    x: NDArray[np.int32]
    y: NDArray[np.int32]
    index: Array
    confidence: Array


def modal_filter(label: Labels, peaks: Peaks, wavelength: float) -> Labels:
    """Each named peak takes the most frequent name around it, zeros ignored (sec. 5.4), (P,) int32.

    The window is two wavelengths wide and one high: one stripe, and less than what separates two modulated ones.
    Of names equally frequent, the peak's own wins, then the lower.
    """
    reach = max(1, round(wavelength))
    return _mode(label, peaks.start, peaks.y, reach, wavelength / 2, int(label.max(initial=0)) + 1)


def eliminate_blobs(
    label: Labels, peaks: Peaks, shape: tuple[int, int], wavelength: float, gap: int, width: int
) -> Labels:
    """Remove names from short pieces of stripe by a morphological opening for each name (sec. 5.4), (P,) int32.

    Peaks are one pixel high and broken at the carrier's troughs, so each name's image is closed first, over `gap` px
    along the stripe, and thickened by half a wavelength.

    Args:
        label: (P,) names, 0 none.
        peaks: where they are.
        shape: of the image.
        wavelength: of the stripes, px.
        gap: longest gap of an unbroken stripe, px.
        width: of the opening's structuring element, px.
    """
    kept = label.copy()
    high = max(1, round(wavelength / 4))
    thick = np.ones((2 * high + 1, 1), np.uint8)
    close, least = np.ones((1, gap | 1), np.uint8), np.ones((1, width | 1), np.uint8)
    for name in np.unique(label[label > 0]):
        of = label == name
        y, x = peaks.y[of], peaks.column[of]
        top = max(0, int(y.min()) - high)
        image = np.zeros((min(shape[0], int(y.max()) + high + 1) - top, shape[1]), np.uint8)
        image[y - top, x] = 1
        band = cv2.morphologyEx(cv2.dilate(image, thick), cv2.MORPH_CLOSE, close)
        opened = cv2.morphologyEx(band, cv2.MORPH_OPEN, least)
        kept[of] = np.where(opened[y - top, x] > 0, name, 0)
    return kept


def grow(label: Labels, peaks: Peaks, region: Binary, wavelength: float) -> tuple[Labels, Binary]:
    """Region growth in two passes, forward and in reverse order; where they agree, a peak has a name (sec. 5.4).

    Args:
        label: (P,) names, 0 none.
        peaks: where they are.
        region: (H, W) stripe regions, before any intensity threshold.
        wavelength: of the stripes, px: height of the element that takes the regions beside peaks away.

    Returns:
        (P,) int32 names, and the growth mask, (H, W) uint8.
    """
    stripe = peaks.image((region.shape[0], region.shape[1]))
    beside = cv2.dilate(stripe, np.ones((2 * max(1, round(wavelength / 2)) + 1, 1), np.uint8))
    mask = np.where(beside > 0, stripe, region)
    seeds = np.flatnonzero(label)
    y, x, name = peaks.y[seeds], peaks.column[seeds], label[seeds]
    order = np.lexsort((x, y))
    passes = []
    for way in (order, order[::-1]):
        blob = np.zeros(region.shape, np.int16)
        blob[y, x] = name
        _flood(blob, mask, y[way], x[way])
        passes.append(blob[peaks.y, peaks.column])
    return np.where(passes[0] == passes[1], passes[0], 0).astype(np.int32), mask


def name_unmodulated(stripe: Labels, sure: Array, peaks: Peaks, light: Array) -> tuple[Labels, Array]:
    """Unmodulated stripes: the brightest nameless peak between two consecutive modulated ones (sec. 2.1, 5.4).

    Args:
        stripe: (P,) stripe index of modulated peaks, -1 none. Consecutive: two apart.
        sure: (P,) confidence.
        peaks: where they are.
        light: (P,) grey level of each peak.

    Returns:
        stripe and confidence with the unmodulated ones entered; their confidence is the lesser neighbour's.
    """
    filled, confidence = stripe.copy(), sure.copy()
    _between(filled, confidence, stripe, peaks.start, light)
    return filled, confidence


def name_2x_4x(calm: Array, stripe: Labels, sure: Array, peaks: Peaks) -> Marks:
    """Peaks with their minima (2x) and mid-levels (4x) between consecutive stripes (sec. 2.1, fig. 5.14).

    Between stripes of unequal light blur moves the minimum towards the dim one, by one to two pixels where the dim one
    is a fifth as bright; mid-levels move less. The published pattern has such stripes throughout, and what was
    published of depth agrees with them (tables 5.4, 5.7): they are left as they are.

    Args:
        calm: (H, W), the image but for noise, rows not averaged.
        stripe: (P,) stripe index, both kinds, -1 none. Consecutive: one apart.
        sure: (P,) confidence. Minima and mid-levels take the lesser neighbour's.
        peaks: where they are.
    """
    x, y, index, confidence = _levels(np.asarray(cv2.transpose(calm), np.float32), stripe, sure, peaks.start, peaks.y)
    return Marks(x, y, index, confidence)


@kernel
def _mode(label: Labels, start: Labels, y: Labels, reach: int, half: float, names: int) -> Labels:
    columns = len(start) - 1
    out = np.zeros(len(label), np.int32)
    most = 0
    for c in range(columns):
        most = max(most, start[c + 1] - start[c])
    votes = np.zeros((most, names), np.int32)
    for c in range(columns):
        votes[:] = 0
        for other in range(max(0, c - reach), min(columns, c + reach + 1)):
            first = start[other]
            for p in range(start[c], start[c + 1]):
                if label[p] == 0:
                    continue
                # Both columns run downwards: what lies above this peak's window lies above the next one's.
                while first < start[other + 1] and y[first] - y[p] < -half:
                    first += 1
                q = first
                while q < start[other + 1] and y[q] - y[p] <= half:
                    votes[p - start[c], label[q]] += 1
                    q += 1
        for p in range(start[c], start[c + 1]):
            if label[p] > 0:
                mine = votes[p - start[c]]
                mine[0] = 0
                best = np.argmax(mine)
                out[p] = label[p] if mine[label[p]] == mine[best] else best
    return out


@kernel
def _flood(blob: NDArray[np.int16], mask: Binary, y: Labels, x: Labels) -> None:
    """Fill blob along the mask from each seed in turn; adjacent: any of eight neighbours."""
    height, width = blob.shape
    stack = np.empty((mask.size, 2), np.int32)
    for k in range(len(y)):
        depth = 1
        stack[0, 0], stack[0, 1] = y[k], x[k]
        while depth > 0:
            depth -= 1
            r, c = stack[depth, 0], stack[depth, 1]
            for i in range(max(0, r - 1), min(height, r + 2)):
                for j in range(max(0, c - 1), min(width, c + 2)):
                    if mask[i, j] and blob[i, j] == 0:
                        blob[i, j] = blob[r, c]
                        stack[depth, 0], stack[depth, 1] = i, j
                        depth += 1


@kernel
def _between(filled: Labels, confidence: Array, stripe: Labels, start: Labels, light: Array) -> None:
    for c in range(len(start) - 1):
        last = -1
        for p in range(start[c], start[c + 1]):
            if stripe[p] < 0:
                continue
            if last >= 0 and stripe[p] == stripe[last] + 2 and p > last + 1:
                best = last + 1
                for q in range(last + 2, p):
                    if light[q] > light[best]:
                        best = q
                filled[best] = stripe[last] + 1
                confidence[best] = min(confidence[last], confidence[p])
            last = p


@kernel
def _levels(
    upright: Array, stripe: Labels, sure: Array, start: Labels, y: Labels
) -> tuple[Labels, Labels, Array, Array]:
    most = 4 * len(y) + 1
    xs = np.empty(most, np.int32)
    ys = np.empty(most, np.int32)
    index = np.empty(most, np.float32)
    confidence = np.empty(most, np.float32)
    n = 0
    for c in range(len(start) - 1):
        last = -1
        for p in range(start[c], start[c + 1]):
            if stripe[p] < 0:
                continue
            xs[n], ys[n], index[n], confidence[n] = c, y[p], stripe[p], sure[p]
            n += 1
            if last >= 0 and stripe[p] == stripe[last] + 1:
                low = _lowest(upright[c], y[last], y[p])
                least = min(sure[last], sure[p])
                for k in range(3):
                    if k == 0:
                        at = low
                    elif k == 1:
                        at = _mid_level(upright[c], y[last], low)
                    else:
                        at = _mid_level(upright[c], y[p], low)
                    if at < 0:
                        continue
                    offset = 0.5 if k == 0 else 0.25 if k == 1 else 0.75
                    xs[n], ys[n], index[n], confidence[n] = c, at, stripe[last] + offset, least
                    n += 1
            last = p
    return xs[:n].copy(), ys[:n].copy(), index[:n].copy(), confidence[:n].copy()


@kernel
def _lowest(line: Array, above: int, below: int) -> int:
    """The smallest pixel between two peaks; of equal ones the middle."""
    first = last = above + 1
    for r in range(above + 1, below):
        if line[r] < line[first]:
            first = last = r
        elif line[r] == line[first]:
            last = r
    return (first + last) // 2


@kernel
def _mid_level(line: Array, peak: int, low: int) -> int:
    """The pixel nearest to half way between peak and minimum in light; -1 where they touch."""
    step = 1 if low > peak else -1
    want = 0.5 * (float(line[peak]) + float(line[low]))
    if float(line[peak]) <= float(line[low]):
        return -1
    r = peak
    while r != low and line[r] > want:
        r += step
    if r - step != peak and abs(float(line[r - step]) - want) < abs(float(line[r]) - want):
        r -= step
    return r if (r - peak) * (r - low) != 0 else -1
