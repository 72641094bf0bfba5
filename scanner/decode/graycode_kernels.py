"""The pass of Gray and binary decoding over pixels: all bits of all axes to positions, confidence and reason.

Frames are given by address and go through the image in tiles, as in `pmp_kernels`. Bits are compared as whole grey
levels, so that as many pixels as possible share a vector register; only what is left of a pixel at the end, its two
least certain bits, is weighed as probability. What the frames are is decided in `scanner.decode.graycode`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.addresses import aligned_rows, pixels_at
from scanner.decode.graycode_bits import BOTH, read_bits, value_and_spread
from scanner.decode.reasons import count_reasons
from scanner.kernel import contracting_kernel

TILE = 2048

BOTH_VARIANCE, SINGLE_VARIANCE = 2.0, 6.0
"""Variance of an image less its inverse, and of twice an image less white and black, in units of one sample's."""

_F0 = np.float32(0)
_F1 = np.float32(1)
_HALF = np.float32(0.5)
_NAN = np.float32(np.nan)
_BOTH = np.float32(BOTH_VARIANCE)
_SINGLE = np.float32(SINGLE_VARIANCE)
_ROOT12 = np.float32(12**0.5)

# erfc(x) = 1 / (1 + a1 x + ... + a6 x^6)^16, error below 3e-7 (Abramowitz and Stegun 1964, 7.1.28); x = z / sqrt(2).
_S1 = np.float32(0.0705230784 / 2**0.5)
_S2 = np.float32(0.0422820123 / 2)
_S3 = np.float32(0.0092705272 / 2**1.5)
_S4 = np.float32(0.0001520143 / 4)
_S5 = np.float32(0.0002765672 / 2**2.5)
_S6 = np.float32(0.0000430638 / 8)


@contracting_kernel
def decode_codes(
    addresses: NDArray[np.intp],
    kinds: NDArray[np.int64],
    levels: NDArray[np.intp],
    like: NDArray[Any],
    coarse: int,
    clip: int,
    gray: bool,
    shift: int,
    sizes: NDArray[np.int64],
    noise: NDArray[np.float32],
    limits: NDArray[np.float32],
    begin: int,
    end: int,
    position: NDArray[np.float32],
    sigma: NDArray[np.float32],
    confidence: NDArray[np.float32],
    albedo: NDArray[np.float32],
    modulation: NDArray[np.float32],
    reason: NDArray[np.uint8],
    counts: NDArray[np.int64],
) -> None:
    """Decode pixels begin .. end - 1.

    Args:
        addresses: (A, bits, 2) of each axis's images and their inverses, most significant bit first; 0 where `kinds`
            says that there is none. kinds: (A, bits) PLAIN, INVERSE or BOTH. levels: (2,) of white and black, or zeros.
        like: (0,) array of the frames' dtype, uint8 or uint16.
        coarse: bits of each axis whose pairs stand in for white and black where there are none.
        clip: grey level from which a sample counts as saturated.
        gray: Gray code, else binary. shift: code bits that were not projected. sizes: (A,) projector pixels an axis.
        noise: [variance at level 0, variance per level, least variance, factor].
        limits: [contrast in levels, contrast in sigmas squared, decisive share of the contrast, decisive sigmas
            squared, wrong-bit probability, cells that open bits may span, largest grey level].
        position, sigma: (A, P) float32, confidence, albedo, modulation: (P,) float32, reason: (P,) uint8; written.
        counts: (9,) int64, how many pixels have each reason, is added to.
    """
    axes, bits = kinds.shape
    work = aligned_rows(8 + 2 * axes, TILE)
    light, dark, variance, wrong, kept, contrast = work[0], work[1], work[2], work[3], work[4], work[5]
    value, spread = work[6], work[7]
    thresholds = np.empty((2, TILE), like.dtype)
    nearest = np.empty((4, TILE), like.dtype)
    words = np.empty((4, TILE), np.uint16)
    why = np.empty(TILE, np.uint8)
    for at in range(begin, end, TILE):
        size = min(TILE, end - at)
        if levels[0] != 0:
            _levels(pixels_at(levels[0], at, size, like), pixels_at(levels[1], at, size, like), size, light, dark)
        else:
            _levels_of_pairs(addresses, at, size, like, coarse, light, dark)
        late = _F0 if levels[0] != 0 else _HALF
        _contrast(
            light, dark, noise, limits, np.float32(clip) - late, size, contrast, variance, thresholds, why,
            albedo[at : at + size], modulation[at : at + size],
        )  # fmt: skip
        for i in range(size):
            kept[i] = _F1
        for axis in range(axes):
            read_bits(addresses[axis], kinds[axis], levels, at, size, like, thresholds, limits, words, nearest)
            value_and_spread(words, gray, size, value, spread)
            for i in range(size):
                wrong[i] = _F0
            pairs = 0
            for bit in range(bits):
                pairs += 1 if kinds[axis, bit] == BOTH else 0
            if pairs > 0:
                _doubt(nearest[0], nearest[1], pairs, _BOTH, variance, limits[6], size, wrong)
            if pairs < bits:
                _doubt(nearest[2], nearest[3], bits - pairs, _SINGLE, variance, limits[6], size, wrong)
            _place(
                words, value, spread, wrong, limits, shift, sizes[axis], size,
                work[8 + 2 * axis], work[9 + 2 * axis], kept, why,
            )  # fmt: skip
        for axis in range(axes):
            _keep(work[8 + 2 * axis], work[9 + 2 * axis], why, size, position[axis, at:], sigma[axis, at:])
        for i in range(size):
            confidence[at + i] = kept[i] if why[i] == 0 else _F0
            reason[at + i] = why[i]
        count_reasons(reason[at : at + size], counts)


@contracting_kernel
def gather(
    addresses: NDArray[np.intp], like: NDArray[Any], starts: NDArray[np.intp], length: int, out: NDArray[Any]
) -> None:
    """Copy runs of `length` pixels from `starts` on of frames into out: (F, R x length) of the frames' dtype."""
    for f in range(addresses.size):
        for r in range(starts.size):
            run = pixels_at(addresses[f], starts[r], length, like)
            for i in range(length):
                out[f, r * length + i] = run[i]


# --- levels -----------------------------------------------------------------------------------------------------------


@contracting_kernel
def _levels(
    white: NDArray[Any], black: NDArray[Any], size: int, light: NDArray[np.float32], dark: NDArray[np.float32]
) -> None:
    for i in range(size):
        light[i] = np.float32(white[i])
        dark[i] = np.float32(black[i])


@contracting_kernel
def _levels_of_pairs(
    addresses: NDArray[np.intp],
    at: int,
    size: int,
    like: NDArray[Any],
    coarse: int,
    light: NDArray[np.float32],
    dark: NDArray[np.float32],
) -> None:
    """Mean of the brighter and of the darker of the coarse bits' images and inverses."""
    share = _F1 / np.float32(addresses.shape[0] * coarse)
    for i in range(size):
        light[i] = _F0
        dark[i] = _F0
    for axis in range(addresses.shape[0]):
        for bit in range(coarse):
            one = pixels_at(addresses[axis, bit, 0], at, size, like)
            two = pixels_at(addresses[axis, bit, 1], at, size, like)
            for i in range(size):
                light[i] += np.float32(max(one[i], two[i]))
                dark[i] += np.float32(min(one[i], two[i]))
    for i in range(size):
        light[i] *= share
        dark[i] *= share


@contracting_kernel
def _contrast(
    light: NDArray[np.float32],
    dark: NDArray[np.float32],
    noise: NDArray[np.float32],
    limits: NDArray[np.float32],
    clip: np.float32,
    size: int,
    contrast: NDArray[np.float32],
    variance: NDArray[np.float32],
    thresholds: NDArray[Any],
    why: NDArray[np.uint8],
    albedo: NDArray[np.float32],
    modulation: NDArray[np.float32],
) -> None:
    """What a bit must differ by, in whole grey levels: thresholds[0] a pair, [1] one image. Shadow, saturation."""
    v0, slope, least, factor = noise[0], noise[1], noise[2], noise[3]
    min_levels, min_sigmas2, share, decisive2, top = limits[0], limits[1], limits[2], limits[3], limits[6]
    for i in range(size):
        difference, middle = light[i] - dark[i], _HALF * (light[i] + dark[i])
        expected = factor * max(v0 + slope * middle, least)
        contrast[i] = difference
        variance[i] = expected
        albedo[i] = middle
        modulation[i] = _HALF * difference
        enough = (difference > min_levels) & (difference * difference > min_sigmas2 * expected)
        code = np.int32(0) if enough else np.int32(1)
        why[i] = np.uint8(np.int32(2) if dark[i] >= clip else code)
    for i in range(size):
        # |d| > t for whole |d| is |d| > floor(t).
        least_share = max(share * contrast[i], _F0)
        thresholds[0, i] = np.int32(min(max(least_share, np.sqrt(decisive2 * _BOTH * variance[i])), top))
        thresholds[1, i] = np.int32(min(max(least_share, np.sqrt(decisive2 * _SINGLE * variance[i])), top))


# --- verdicts ---------------------------------------------------------------------------------------------------------


@contracting_kernel
def _doubt(
    nearest: NDArray[Any],
    second: NDArray[Any],
    count: int,
    times: np.float32,
    variance: NDArray[np.float32],
    top: np.float32,
    size: int,
    wrong: NDArray[np.float32],
) -> None:
    """Add the probability that one of `count` decided bits is wrong: the least certain, and all others as the next."""
    others = np.float32(count - 1)
    for i in range(size):
        scale = _F1 / np.sqrt(times * variance[i])
        first, next_one = np.float32(nearest[i]), np.float32(second[i])
        wrong[i] += _tail(first * scale) if first < top else _F0
        wrong[i] += others * _tail(next_one * scale) if next_one < top else _F0


@contracting_kernel
def _tail(z: np.float32) -> np.float32:
    # Probability that a normal variable of mean z and sigma 1 is negative.
    s = _F1 + z * (_S1 + z * (_S2 + z * (_S3 + z * (_S4 + z * (_S5 + z * _S6)))))
    s = s * s
    s = s * s
    s = s * s
    return _HALF / (s * s)


@contracting_kernel
def _place(
    words: NDArray[np.uint16],
    value: NDArray[np.float32],
    spread: NDArray[np.float32],
    wrong: NDArray[np.float32],
    limits: NDArray[np.float32],
    shift: int,
    along: int,
    size: int,
    coordinate: NDArray[np.float32],
    deviation: NDArray[np.float32],
    kept: NDArray[np.float32],
    why: NDArray[np.uint8],
) -> None:
    max_wrong, max_cells = limits[4], limits[5]
    step = np.float32(1 << shift)
    beyond = np.float32(along)
    for i in range(size):
        # Open bits do no harm where all they could mean names cells close by: a border of cells, or blur.
        odds = wrong[i] if spread[i] <= max_cells else _F1
        coordinate[i] = (value[i] + _HALF) * step - _HALF
        deviation[i] = (spread[i] + _F1) * step / _ROOT12
        kept[i] *= max(_F1 - odds, _F0)
        code = np.int32(5) if value[i] * step >= beyond else np.int32(0)
        code = np.int32(4) if odds > max_wrong else code
        why[i] = why[i] if why[i] != 0 else np.uint8(code)


@contracting_kernel
def _keep(
    coordinate: NDArray[np.float32],
    deviation: NDArray[np.float32],
    why: NDArray[np.uint8],
    size: int,
    position: NDArray[np.float32],
    sigma: NDArray[np.float32],
) -> None:
    for i in range(size):
        position[i] = coordinate[i] if why[i] == 0 else _NAN
        sigma[i] = deviation[i] if why[i] == 0 else _NAN
