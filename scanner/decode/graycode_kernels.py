"""The pass of Gray and binary decoding over pixels: all bits of one axis to a position, its confidence and reason.

Bits come as differences of two grey levels (the image and its inverse, or twice the image and white plus black) and
go through the image in tiles, as in `pmp_kernels`. What the frames are is decided in `scanner.decode.graycode`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.kernel import kernel

TILE = 1024

PLAIN, INVERSE, BOTH = 0, 1, 2
"""Which images of a bit there are."""

_F0 = np.float32(0)
_F1 = np.float32(1)
_TWO = np.float32(2)
_HALF = np.float32(0.5)

# erfc(x) = 1 / (1 + a1 x + ... + a6 x^6)^16, error below 3e-7 (Abramowitz and Stegun 1964, 7.1.28); x = z / sqrt(2).
_S1 = np.float32(0.0705230784 / 2**0.5)
_S2 = np.float32(0.0422820123 / 2)
_S3 = np.float32(0.0092705272 / 2**1.5)
_S4 = np.float32(0.0001520143 / 4)
_S5 = np.float32(0.0002765672 / 2**2.5)
_S6 = np.float32(0.0000430638 / 8)


@kernel
def decode_bits(  # noqa: PLR0915  (one pass over a tile; calls would keep loops from vectorising)
    frames: NDArray[Any],
    inverses: NDArray[Any],
    kinds: NDArray[np.int64],
    light: NDArray[np.float32],
    dark: NDArray[np.float32],
    clipped: NDArray[np.uint8],
    gray: bool,
    shift: int,
    size: int,
    noise: NDArray[np.float32],
    limits: NDArray[np.float32],
    position: NDArray[np.float32],
    sigma: NDArray[np.float32],
    confidence: NDArray[np.float32],
    reason: NDArray[np.uint8],
) -> None:
    """Decode one axis.

    Args:
        frames, inverses: (bits, P) uint8 or uint16, most significant first; unused rows where `kinds` says so.
        kinds: (bits,) PLAIN, INVERSE or BOTH. light, dark: (P,) float32 grey levels of white and black.
        clipped: (P,) uint8, 1 where black is saturated too, or image and inverse both.
        gray: Gray code, else binary. shift: code bits that were not projected. size: projector pixels along the axis.
        noise: [variance at level 0, variance per level, least variance, factor].
        limits: [contrast in levels, contrast in sigmas, decisive share of the contrast, decisive sigmas,
            wrong-bit probability, cells that open bits may span].
        position, sigma, confidence: (P,) float32, written. reason: (P,) uint8, written.
    """
    bits, pixels = frames.shape
    v0, slope, least, factor = noise[0], noise[1], noise[2], noise[3]
    min_levels, min_sigmas2, share, decisive2 = limits[0], limits[1], limits[2], limits[3]
    max_wrong, max_cells = limits[4], np.int64(limits[5])
    root12 = np.float32(12**0.5)
    step = np.float32(1 << shift)
    low_bit = np.uint32(1)
    contrast = np.empty(TILE, np.float32)
    variance = np.empty(TILE, np.float32)
    wrong = np.empty(TILE, np.float32)
    word = np.empty(TILE, np.uint32)
    unsure = np.empty(TILE, np.uint32)
    for start in range(0, pixels, TILE):
        stop = min(start + TILE, pixels)
        count = stop - start
        white, black = light[start:stop], dark[start:stop]
        for i in range(count):
            contrast[i] = white[i] - black[i]
            variance[i] = factor * max(v0 + slope * _HALF * (white[i] + black[i]), least)
            wrong[i] = _F0
            word[i] = 0
            unsure[i] = 0
        for bit in range(bits):
            kind = kinds[bit]
            row = frames[bit, start:stop]
            other = inverses[bit, start:stop]
            # Variance of the difference, in units of one sample's: of (I - I'), and of (2 I - white - black).
            times = _TWO if kind == BOTH else np.float32(6)
            for i in range(count):
                both = white[i] + black[i]
                if kind == BOTH:
                    difference = np.float32(row[i]) - np.float32(other[i])
                elif kind == PLAIN:
                    difference = _TWO * np.float32(row[i]) - both
                else:
                    difference = both - _TWO * np.float32(other[i])
                spread = times * variance[i]
                d2 = difference * difference
                decided = d2 > decisive2 * spread and abs(difference) > share * contrast[i]
                miss = _tail(abs(difference) / np.sqrt(spread))
                # A clear bit counts in the odds, an open one by what it could mean.
                wrong[i] += miss if decided else _F0
                word[i] = word[i] << low_bit | np.uint32(difference > _F0)
                unsure[i] = unsure[i] << low_bit | np.uint32(not decided)
        out_position, out_sigma = position[start:stop], sigma[start:stop]
        out_confidence, out_reason = confidence[start:stop], reason[start:stop]
        for i in range(count):
            value = _value(word[i], gray)
            # Open bits do no harm where all they could mean names cells close by: a border of cells, or blur.
            high = unsure[i] & (unsure[i] - low_bit)
            spread_cells = _spread(value, word[i], unsure[i], high, gray)
            harmless = high & (high - low_bit) == 0 and spread_cells <= max_cells
            odds = wrong[i] if harmless else _F1
            coordinate = (np.float32(value) + _HALF) * step - _HALF
            enough = contrast[i] > min_levels and contrast[i] * contrast[i] > min_sigmas2 * variance[i]
            why = 0
            if clipped[start + i] != 0:
                why = 2
            elif not enough:
                why = 1
            elif odds > max_wrong:
                why = 4
            elif np.int64(value) << shift >= size:
                why = 5
            out_position[i] = coordinate if why == 0 else np.float32(np.nan)
            out_confidence[i] = max(_F1 - odds, _F0) if why == 0 else _F0
            out_reason[i] = np.uint8(why)
            out_sigma[i] = np.float32(spread_cells + 1) * step / root12 if why == 0 else np.float32(np.nan)


@kernel
def _tail(z: np.float32) -> np.float32:
    # Probability that a normal variable of mean z and sigma 1 is negative.
    s = _F1 + z * (_S1 + z * (_S2 + z * (_S3 + z * (_S4 + z * (_S5 + z * _S6)))))
    s = s * s
    s = s * s
    s = s * s
    return _HALF / (s * s)


@kernel
def _value(word: np.uint32, gray: bool) -> np.uint32:
    if not gray:
        return word
    word ^= word >> np.uint32(8)
    word ^= word >> np.uint32(4)
    word ^= word >> np.uint32(2)
    word ^= word >> np.uint32(1)
    return word


@kernel
def _spread(value: np.uint32, word: np.uint32, unsure: np.uint32, high: np.uint32, gray: bool) -> np.int64:
    # Largest distance in cells to what the word means with its open bits turned; two of them at most are looked at.
    low = unsure ^ high
    a = abs(np.int64(_value(word ^ low, gray)) - np.int64(value))
    b = abs(np.int64(_value(word ^ high, gray)) - np.int64(value))
    c = abs(np.int64(_value(word ^ unsure, gray)) - np.int64(value))
    return max(a, b, c)
