"""Channels: band-pass, two-sigma threshold, error rates, code image (Casey 2011, sec. 4.4, 4.5).

The isolated bands are not shifted to zero frequency: local deviations of a carrier would be lost (fig. 4.10, 4.11).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from scanner.decode.mcp.casey2011.stripe_detection import Array, Binary

FALSE_POSITIVE = 0.159
"""Initial false positive rate of every channel (sec. 4.5): the share of a normal distribution below minus one sigma."""

MISS_LIMITS = (0.01, 0.5)
"""Bounds of the estimated miss rates: none is free of misses, and above one half a channel would be read inverted."""


def isolate(
    spectrum: NDArray[np.complex64], frequency: float, sigma: float, wavelength: float, shape: tuple[int, int]
) -> Array:
    """One channel by a Gaussian band-pass, still on its carrier (sec. 4.4), (H, W) float32.

    Args:
        spectrum: (H, W // 2 + 1) of the image less its mean.
        frequency, sigma: of the band found, cycles per px along x.
        wavelength: of the stripes, px. Along y the band reaches to about the stripe frequency (sec. 4.3), which is the
            Gaussian's sigma there.
        shape: of the image.
    """
    height, width = shape
    low = max(0, int(np.floor((frequency - 3 * sigma) * width)))
    high = min(spectrum.shape[1], int(np.ceil((frequency + 3 * sigma) * width)) + 1)
    across = np.exp(-((np.arange(low, high) / width - frequency) ** 2) / (2 * sigma**2))
    along = np.exp(-((fft.fftfreq(height) * wavelength) ** 2) / 2)
    band = spectrum[:, low:high] * (along[:, None] * across).astype(np.float32)
    # All other columns are zero: the transform along y is needed for these alone.
    lines = np.zeros(spectrum.shape, np.complex64)
    lines[:, low:high] = fft.ifft(band, axis=0)
    return np.asarray(fft.irfft(lines, n=width, axis=1), np.float32)


def two_sigma(channel: Array, mask: Binary) -> float:
    """Mean plus two standard deviations of a channel's magnitude inside the mask (sec. 4.5)."""
    mean, deviation = cv2.meanStdDev(channel, mask=mask)
    return float(mean[0, 0] + 2 * deviation[0, 0])


def binarize(channel: Array, frequency: float, mask: Binary) -> Binary:
    """Threshold, then close the carrier's zero crossings (sec. 4.4, 4.5, fig. 5.10), (H, W) uint8.

    Both half waves count: crests of the magnitude lie half a period apart, and a dilation by as much joins them.
    """
    magnitude = np.abs(channel)
    _, bits = cv2.threshold(magnitude, two_sigma(magnitude, mask), 1, cv2.THRESH_BINARY)
    length = 2 * int(np.ceil(0.25 / frequency)) + 1
    return np.asarray(cv2.dilate(bits.astype(np.uint8), np.ones((1, length), np.uint8)))


def code_words(bits: list[Binary], y: NDArray[np.int32], column: NDArray[np.int32]) -> NDArray[np.int32]:
    """Code image on the peaks: sum of 2^i times channel i (fig. 4.1, 5.11), (P,) int32; 0: no channel is high."""
    word = np.zeros(len(y), np.int32)
    for i, channel in enumerate(bits):
        word |= channel[y, column].astype(np.int32) << i
    return word


def miss_rates(word: NDArray[np.int32], expected: NDArray[np.float64]) -> NDArray[np.float64]:
    """Miss rate of each channel: 1 - high stripe pixels found / expected (sec. 4.5), (N,).

    Args:
        word: (P,) code word of each stripe pixel.
        expected: (N,) share of all stripe pixels that the pattern makes high in each channel.
    """
    high = np.array([float((word >> i & 1).sum()) for i in range(len(expected))])
    rate = 1 - high / np.maximum(expected * len(word), 1)
    return np.asarray(np.clip(rate, *MISS_LIMITS))
