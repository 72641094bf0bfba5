"""How noisy Gray and binary code are, over what the default model says: from a sample of the coarse bits' images.

An image and its inverse add up to the same in all bits; without inverses an image is as light as white or as dark as
black. What they differ by is noise, of whatever the camera is.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.addresses import expect_pixels, pixels_at
from scanner.decode.graycode_bits import BOTH, INVERSE
from scanner.decode.middles import nth_of
from scanner.kernel import kernel

_HALF = np.float32(0.5)
_ONE_SIGMA2 = 0.455
"""The median square of a normal variable. Whole grey levels make it too coarse to be the measure itself."""
_WITHIN = 0.973
"""Mean square of what three sigmas leave: borders of cells are cut off there."""


@kernel
def noise_factor(
    addresses: NDArray[np.intp],
    kinds: NDArray[np.int64],
    levels: NDArray[np.intp],
    like: NDArray[Any],
    starts: NDArray[np.intp],
    length: int,
    noise: NDArray[np.float32],
) -> tuple[int, float]:
    """How many pixels of a sample have light in them, and the variance over that of the default model, of these.

    Args:
        addresses: (bits, 2) of images and inverses; 0 where there is none. kinds: (bits,) PLAIN, INVERSE or BOTH.
        levels: (2,) of white and black, or zeros: bits then are all BOTH. like: (0,) array of the frames' dtype.
        starts, length: runs of pixels (`scanner.decode.runs`).
        noise: [variance at level 0, variance per level, least variance, least contrast, largest grey level].
    """
    bits, size = kinds.size, starts.size * length
    _expect_runs(addresses.reshape(-1), like, starts, length)
    _expect_runs(levels, like, starts, length)
    image, inverse = np.zeros((bits, size), np.float32), np.zeros((bits, size), np.float32)
    white, black = np.zeros(size, np.float32), np.zeros(size, np.float32)
    for bit in range(bits):
        _take(addresses[bit, 0], like, starts, length, image[bit])
        _take(addresses[bit, 1], like, starts, length, inverse[bit])
    if levels[0] != 0:
        _take(levels[0], like, starts, length, white)
        _take(levels[1], like, starts, length, black)
    else:
        for bit in range(bits):
            for i in range(size):
                white[i] += max(image[bit, i], inverse[bit, i])
                black[i] += min(image[bit, i], inverse[bit, i])
        for i in range(size):
            white[i], black[i] = white[i] / np.float32(bits), black[i] / np.float32(bits)
    here = np.empty(size, np.int64)
    lit = 0
    for i in range(size):
        here[lit] = i
        lit += 1 if white[i] - black[i] > noise[3] and white[i] < noise[4] else 0
    if lit == 0:
        return 0, 1.0
    expected, quiet = np.empty(lit, np.float32), np.empty(lit, np.float32)
    for n in range(lit):
        both = white[here[n]] + black[here[n]]
        expected[n] = max(noise[0] + noise[1] * (both * _HALF), noise[2])
        quiet[n] = noise[2] / expected[n]
    ratios = np.empty((bits, lit), np.float32)
    for bit in range(bits):
        _ratios(image[bit], inverse[bit], white, black, kinds[bit], levels[0] != 0, here, expected, ratios[bit])
    return lit, _mean_square(ratios.reshape(-1), float(nth_of(quiet, lit // 2)))


@kernel
def _expect_runs(addresses: NDArray[np.intp], like: NDArray[Any], starts: NDArray[np.intp], length: int) -> None:
    for n in range(addresses.size):
        for r in range(starts.size):
            expect_pixels(addresses[n], starts[r], length, like)


@kernel
def _take(address: int, like: NDArray[Any], starts: NDArray[np.intp], length: int, out: NDArray[np.float32]) -> None:
    """Runs of a frame; nothing of one that is not there."""
    if address == 0:
        return
    for r in range(starts.size):
        run, part = pixels_at(address, starts[r], length, like), out[r * length : (r + 1) * length]
        for i in range(length):
            part[i] = run[i]


@kernel
def _ratios(
    image: NDArray[np.float32],
    inverse: NDArray[np.float32],
    white: NDArray[np.float32],
    black: NDArray[np.float32],
    kind: int,
    has_levels: bool,
    here: NDArray[np.int64],
    expected: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Squares of what one bit's images show of noise, over what the model expects of it."""
    of_pairs = np.float32(4 if has_levels else 3)
    for n in range(out.size):
        i = here[n]
        light, dark = white[i], black[i]
        if kind == BOTH:
            off = image[i] + inverse[i] - (light + dark)
            out[n] = off * off / (of_pairs * expected[n])
        else:
            one = inverse[i] if kind == INVERSE else image[i]
            off = min(abs(one - light), abs(one - dark))
            out[n] = off * off / (np.float32(2) * expected[n])


@kernel
def _mean_square(ratios: NDArray[np.float32], least: float) -> float:
    """The mean of ratios without those of borders, never below `least`."""
    limit = np.float32(9 * max(float(nth_of(ratios, ratios.size // 2)) / _ONE_SIGMA2, least))
    total, count = 0.0, 0
    for n in range(ratios.size):
        within = ratios[n] <= limit
        total += float(ratios[n]) if within else 0.0
        count += 1 if within else 0
    return max(total / count / _WITHIN, least)
