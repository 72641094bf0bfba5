"""How noisy Gray and binary code are, over what the default model says: from a sample of the coarse bits' images.

An image and its inverse add up to the same in all bits; without inverses an image is as light as white or as dark as
black. What they differ by is noise, of whatever the camera is. Where black cuts that off it says nothing of it
(`scanner.decode.noise.CUT_SIGMAS`); how noisy the dark is, is told by pixels that are darker in white than in black.
"""

from __future__ import annotations

from math import erf, exp, pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.addresses import expect_pixels, pixels_at
from scanner.decode.graycode_bits import BOTH, INVERSE
from scanner.decode.middles import nth_of
from scanner.decode.noise import CUT_SIGMAS, FEWEST
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
    """How many pixels of a sample have light in them, and the variance over that of the default model.

    It is that of lit pixels, or of the dark ones if they have more; 1 or more where lit ones are fewer than FEWEST, or
    black cuts all their noise off.

    Args:
        addresses: (bits, 2) of images and inverses; 0 where there is none. kinds: (bits,) PLAIN, INVERSE or BOTH.
        levels: (2,) of white and black, or zeros: bits then are all BOTH. like: (0,) array of the frames' dtype.
        starts, length: runs of pixels (`scanner.decode.runs`).
        noise: [variance at level 0, variance per level, least variance, least contrast, largest grey level, least
            contrast in sigmas].
    """
    bits, size = kinds.size, starts.size * length
    _expect_runs(addresses.reshape(-1), like, starts, length)
    _expect_runs(levels, like, starts, length)
    image, inverse = np.zeros((bits, size), np.float32), np.zeros((bits, size), np.float32)
    white, black = np.zeros(size, np.float32), np.zeros(size, np.float32)
    for bit in range(bits):
        _take(addresses[bit, 0], like, starts, length, image[bit])
        _take(addresses[bit, 1], like, starts, length, inverse[bit])
    dark = 0.0
    if levels[0] != 0:
        _take(levels[0], like, starts, length, white)
        _take(levels[1], like, starts, length, black)
        dark = dark_factor(white, black, noise)
    else:
        _levels_of_pairs(image, inverse, white, black)
    here = np.empty(size, np.int64)
    lit = 0
    # What noise of the dark makes of white and black is no light.
    least = max(noise[3], noise[5] * np.float32(sqrt(dark * noise[0])))
    for i in range(size):
        here[lit] = i
        lit += 1 if white[i] - black[i] > least and white[i] < noise[4] else 0
    if lit < FEWEST:
        return lit, max(dark, 1.0)
    _keep_those(here[:lit], image, inverse, white, black)
    white, black = white[:lit], black[:lit]
    ratios, quiet = np.empty(bits * lit, np.float32), np.empty(bits * lit, np.float32)
    # Where black cuts depends on the noise: at first that of the model, then what the others show if it is more. The
    # last round takes all, where black cuts all.
    factor = 1.0
    for turn in range(3):
        limit = np.float32(CUT_SIGMAS**2 * max(factor, dark, 1.0)) if turn < 2 else np.float32(0)
        count, middle = 0, 0.0
        if np.all(kinds == BOTH) and not _any_cut(image, inverse, black, noise, limit):
            middle = _ratios_of_pairs(image, inverse, white, black, levels[0] != 0, noise, ratios, quiet[:lit])
            count = ratios.size
        else:
            for bit in range(bits):
                count += _ratios(
                    image[bit], inverse[bit], white, black, kinds[bit], levels[0] != 0, noise, limit,
                    ratios[count:], quiet[count:],
                )  # fmt: skip
            if count > 0:
                middle = float(nth_of(quiet[:count], count // 2))
        if count >= FEWEST:
            seen = _mean_square(ratios[:count], middle)
            factor = seen if turn < 2 else max(factor, seen)
            if turn == 1 or factor <= max(dark, 1.0):
                break
    return lit, max(factor, dark)


@kernel
def dark_factor(white: NDArray[np.float32], black: NDArray[np.float32], noise: NDArray[np.float32]) -> float:
    """The variance of the dark over that of the model; 0 where there are too few pixels that black cuts off.

    Without light white is as often darker than black as brighter, and by as much: the half that is darker tells of
    pixels without light alone, and with half of those that are alike, of all of these.
    """
    squares, order = np.empty(white.size, np.float32), 0
    total, alike = 0.0, 0
    for i in range(white.size):
        off, both = white[i] - black[i], white[i] + black[i]
        if off < 0:
            squares[order] = off * off
            order, total = order + 1, total + both * _HALF
        elif off == 0 and white[i] < noise[4]:
            alike, total = alike + 1, total + both * _HALF * _HALF
    count = order + 0.5 * alike
    if order < FEWEST:
        return 0.0
    variance = _mean_square(squares[:order], 0.0) * order / (2 * count)
    mean = total / count
    if mean * mean >= CUT_SIGMAS**2 * variance:
        return 0.0
    expected = max(float(noise[0]) + float(noise[1]) * mean, float(noise[2]))
    return float(variance / _share_left(mean / sqrt(variance)) / expected)


@kernel
def _share_left(ratio: float) -> float:
    """Of the variance of normal noise that ends at 0, what is left at this mean over 1-sigma, both as seen.

    Source: Tobin 1958 (see CUT_SIGMAS). The mean before the cut is taken for 0 or more.
    """
    least, most, share = 0.0, CUT_SIGMAS, 1.0
    for _ in range(12):
        d = 0.5 * (least + most)
        above, density = 0.5 * (1 + erf(d / sqrt(2.0))), exp(-0.5 * d * d) / sqrt(2 * pi)
        mean = d * above + density
        share = (d * d + 1) * above + d * density - mean * mean
        if mean < ratio * sqrt(share):
            least = d
        else:
            most = d
    return share


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
def _levels_of_pairs(
    image: NDArray[np.float32], inverse: NDArray[np.float32], white: NDArray[np.float32], black: NDArray[np.float32]
) -> None:
    """White and black from all bits' images and inverses."""
    bits = np.float32(image.shape[0])
    for bit in range(image.shape[0]):
        for i in range(white.size):
            white[i] += max(image[bit, i], inverse[bit, i])
            black[i] += min(image[bit, i], inverse[bit, i])
    for i in range(white.size):
        white[i], black[i] = white[i] / bits, black[i] / bits


@kernel
def _keep_those(
    here: NDArray[np.int64],
    image: NDArray[np.float32],
    inverse: NDArray[np.float32],
    white: NDArray[np.float32],
    black: NDArray[np.float32],
) -> None:
    """Put pixels that are here, in their order, before all others."""
    if here.size == white.size:
        return
    for n in range(here.size):
        white[n], black[n] = white[here[n]], black[here[n]]
    for bit in range(image.shape[0]):
        for n in range(here.size):
            image[bit, n], inverse[bit, n] = image[bit, here[n]], inverse[bit, here[n]]


@kernel
def _any_cut(
    image: NDArray[np.float32],
    inverse: NDArray[np.float32],
    black: NDArray[np.float32],
    noise: NDArray[np.float32],
    limit: np.float32,
) -> bool:
    """Whether `_ratios` would leave any of pairs out."""
    v0, slope, least, cut = noise[0], noise[1], noise[2], 0
    for bit in range(image.shape[0]):
        one, two = image[bit], inverse[bit]
        for i in range(black.size):
            seen = (min(one[i], two[i]) + black[i]) * _HALF
            cut += 1 if seen * seen < limit * max(v0 + slope * seen, least) else 0
    return cut > 0


@kernel
def _ratios_of_pairs(
    image: NDArray[np.float32],
    inverse: NDArray[np.float32],
    white: NDArray[np.float32],
    black: NDArray[np.float32],
    has_levels: bool,
    noise: NDArray[np.float32],
    out: NDArray[np.float32],
    quiet: NDArray[np.float32],
) -> float:
    """`_ratios` of all bits where all are pairs and none is left out, in simple loops. quiet: (lit,), to work in.

    Returns:
        The median of the least they could be. A pixel's is the same in all bits.
    """
    of_pairs, bits, lit = np.float32(4 if has_levels else 3), image.shape[0], white.size
    v0, slope, least = noise[0], noise[1], noise[2]
    for i in range(lit):
        quiet[i] = max(v0 + slope * ((white[i] + black[i]) * _HALF), least)
    for bit in range(bits):
        one, two, row = image[bit], inverse[bit], out[bit * lit : (bit + 1) * lit]
        for i in range(lit):
            off = one[i] + two[i] - (white[i] + black[i])
            row[i] = off * off / (of_pairs * quiet[i])
    for i in range(lit):
        quiet[i] = least / quiet[i]
    return float(nth_of(quiet, bits * lit // 2 // bits))


@kernel
def _ratios(
    image: NDArray[np.float32],
    inverse: NDArray[np.float32],
    white: NDArray[np.float32],
    black: NDArray[np.float32],
    kind: int,
    has_levels: bool,
    noise: NDArray[np.float32],
    limit: np.float32,
    out: NDArray[np.float32],
    quiet: NDArray[np.float32],
) -> int:
    """Squares of what one bit's images show of noise, over what the model expects of it; and the least they could be.

    limit: of a grey level's square over its variance, below which its noise ends at black; those are left out.

    Returns:
        How many there are.
    """
    of_pairs = np.float32(4 if has_levels else 3)
    count = 0
    for i in range(white.size):
        light, dark = white[i], black[i]
        # A level's two samples together say how bright it is, and nothing of their difference.
        if kind == BOTH:
            off, parts = image[i] + inverse[i] - (light + dark), of_pairs
            seen = (min(image[i], inverse[i]) + dark) * _HALF
        else:
            one = inverse[i] if kind == INVERSE else image[i]
            above, below = abs(one - light), abs(one - dark)
            off, parts = min(above, below), np.float32(2)
            seen = (one + (light if above < below else dark)) * _HALF
        variance = max(noise[0] + noise[1] * seen, noise[2])
        if seen * seen < limit * variance:
            continue
        expected = variance
        if kind == BOTH:
            expected = max(noise[0] + noise[1] * ((light + dark) * _HALF), noise[2])
        out[count], quiet[count] = off * off / (parts * expected), noise[2] / expected
        count += 1
    return count


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
