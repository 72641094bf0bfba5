"""The carriers as captured, found by analysis by synthesis (Casey 2011, sec. 4.3).

One frequency for each carrier and image (or segment of one), as published. The projected carriers enter as prior
knowledge of two kinds only: where they can lie at all, and how near one another.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

Array = NDArray[np.float32]
Spectrum = NDArray[np.complex64]

TOLERANCE = 0.25
"""Share by which a carrier may lie off the frequency that stripe spacing predicts: slant, keystone, oblong pixels."""

TRIES = 4
"""Most bands synthesised for each carrier: lobes of a band already found take a turn each."""

NARROWEST = 1 / 4
"""Least sigma of a band, in spacings of the carriers. The projector's keystone moves a carrier from place to place, on
the dissertation's rig by +-2.7 % or a quarter of the spacing; a band as narrow as the second derivative's zeros say
loses the code words at both ends of the image."""

WIDEST = 1 / 3
"""Largest sigma of a band, in spacings: a Gaussian then lets through 1 % of its neighbour's middle."""


FLOOR_PERCENTILE = 10
"""Of A between the lowest and the highest carrier: the level between bands, even where they fill nine tenths."""


@dataclass(frozen=True, eq=False)
class Search:
    """Carriers found, lowest first, and the arrays of fig. 4.9.

    frequency: (N,) float64, cycles per px along x. sigma: (N,) float64, of the Gaussian found. strength: (N,) M.
    A, B, C, D: (W // 2 + 1,) float64.
    contrast: the weakest band found over the low end of A where carriers were sought.
    complete: False where fewer bands than carriers were found; all are then where the projected ones predict.
    """

    frequency: NDArray[np.float64]
    sigma: NDArray[np.float64]
    strength: NDArray[np.float64]
    A: NDArray[np.float64]
    B: NDArray[np.float64]
    C: NDArray[np.float64]
    D: NDArray[np.float64]
    contrast: float
    complete: bool


def spectrum(image: Array) -> Spectrum:
    """The Fourier transform of the image less its mean (sec. 4.3; sec. 4.4 takes the bands from it): (H, W // 2 + 1)
    complex64. The mean is taken out as for the stripes' spectrum (sec. 4.1)."""
    return np.asarray(fft.rfft2(image - image.mean()))


def folded_psd(image: Array, wavelength: float) -> Array:
    """Power spectral density, four quadrants averaged, up to the stripe frequency (fig. 4.7, 5.8).

    Rows: vertical frequencies 0 .. H / wavelength. Columns: horizontal ones 0 .. W // 2. A Hann window along x keeps
    the borders' step from spreading DC over the carriers.
    """
    height, width = image.shape
    window = np.hanning(width).astype(np.float32)
    lines = fft.rfft((image - image.mean()) * window, axis=1)
    full = fft.fft(lines, axis=0)
    power = full.real**2 + full.imag**2
    top = max(1, min(round(height / wavelength), height // 2 - 1))
    # A real image's other two quadrants repeat these two.
    folded = power[: top + 1].copy()
    folded[1:] = 0.5 * (folded[1:] + power[: -top - 1 : -1])
    return np.asarray(folded, np.float32)


def search(
    folded: Array, expected: NDArray[np.float64], width: int, near: bool = False, spacing: float | None = None
) -> Search:
    """Analysis by synthesis (sec. 4.3).

    Args:
        folded: `folded_psd`.
        expected: (N,) cycles per px at the scale of the stripes, ascending.
        width: of the image, px.
        near: seek each carrier within half a spacing of where it is expected times the one factor at which all stand
            out best, instead of all between the lowest and the highest: the dissertation's enhancement by prior
            knowledge, for surfaces with a texture of their own.
        spacing: of the carriers, cycles per px, which bounds the bands' widths; None: the least of `expected`.
    """
    A = cv2.GaussianBlur(folded.sum(axis=0, dtype=np.float64)[None, :], (0, 0), 1.0).ravel()
    D = second_derivative(A)
    B = np.zeros_like(A)
    bins = np.arange(len(A))
    spacing = (float(np.diff(expected).min()) if spacing is None else spacing) * width
    low = int(np.ceil((1 - TOLERANCE) * expected[0] * width))
    high = min(int((1 + TOLERANCE) * expected[-1] * width), len(A) - 2)
    found: list[tuple[float, float, float]] = []
    allowed = (bins >= low) & (bins <= high)
    windows = (
        np.abs(bins - (common_factor(A, expected * width) if near else 1.0) * expected[:, None] * width) <= spacing / 2
    )
    if near:
        allowed &= windows.any(axis=0)
    C = A.copy()
    for _ in range(TRIES * len(expected)):
        if len(found) == len(expected) or not allowed.any():
            break
        x = int(np.argmax(np.where(allowed, C, -np.inf)))
        if C[x] <= 0:
            break
        below, above = zeros_about(D, x)
        M, sigma = float(C[x]), max((above - below) / 2, 0.5)
        B += M * np.exp(-((bins - x) ** 2) / (2 * sigma**2))
        C = A - B
        # A residue beside a band already found is its lobe, not another carrier.
        if all(abs(x - other) > spacing / 2 for other, _, _ in found):
            found.append((float(x), sigma, M))
            if near:
                allowed &= ~windows[windows[:, x]].any(axis=0)
    complete = len(found) == len(expected)
    if not complete:
        found = [(f * width, spacing * NARROWEST, 0.0) for f in expected]
    found.sort()
    columns = np.array(found)
    sigma = np.clip(columns[:, 1], NARROWEST * spacing, WIDEST * spacing)
    floor = float(np.percentile(A[low : high + 1], FLOOR_PERCENTILE)) if high > low else 0.0
    contrast = float(columns[:, 2].min()) / floor if floor > 0 else 0.0
    return Search(columns[:, 0] / width, sigma / width, columns[:, 2], A, B, C, D, contrast, complete)


def common_factor(A: NDArray[np.float64], lines: NDArray[np.float64]) -> float:
    """The factor, 1 -+ TOLERANCE, at which A is largest on all `lines` (N,) together, by the mean of logarithms.

    Ours: sec. 4.3 says that optics change the projected frequencies, and to search without them. Printed texture puts
    bands of its own beside the carriers, which no other knowledge tells from them.
    """
    factors = np.arange(1 - TOLERANCE, 1 + TOLERANCE, 0.5 / lines[-1])
    at = np.clip(np.rint(factors[:, None] * lines).astype(np.intp), 0, len(A) - 1)
    return float(factors[np.argmax(np.log(np.maximum(A[at], 1e-12 * A.max() + 1e-30)).sum(axis=1))])


def second_derivative(A: NDArray[np.float64]) -> NDArray[np.float64]:
    """Discrete Laplace filter (sec. 4.3), same length, 0 at the ends."""
    D = np.zeros_like(A)
    D[1:-1] = A[2:] - 2 * A[1:-1] + A[:-2]
    return D


def zeros_about(D: NDArray[np.float64], x: int) -> tuple[float, float]:
    """Z- and Z+: the nearest zeros of D below and above x, linearly between bins (sec. 4.3).

    The second derivative of a Gaussian is zero one sigma from its middle.
    """
    below = x
    while below > 0 and D[below - 1] < 0:
        below -= 1
    above = x
    while above < len(D) - 1 and D[above + 1] < 0:
        above += 1
    low, high = float(below), float(above)
    if below > 0 and D[below] < 0:
        low -= float(D[below] / (D[below] - D[below - 1]))
    if above < len(D) - 1 and D[above] < 0:
        high += float(D[above] / (D[above] - D[above + 1]))
    return low, high
