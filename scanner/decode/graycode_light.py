"""Light of a line of pixels that Gray and binary code fell on: whether it is enough, and what it asks of bits.

Part of the pass over pixels (`graycode_kernels`), between sums of the coarse bits' images and the reading of bits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.graycode_bits import BRIGHT, DARK, LIGHT, OF_ONE, OF_PAIRS
from scanner.kernel import inlined_kernel
from scanner.lanes import Lanes, any_of, as_samples, choose, floats, greatest, least, root, samples, store
from scanner.sample_lanes import LINE, floats_at

BOTH_IMAGES, SINGLE = np.float32(2), np.float32(6)
"""Variance of an image less its inverse, and of twice an image less white and black, in units of one sample's."""

SURE2 = np.float32(6**2)
"""Square of the sigmas from which a bit is certain: 1e-9 of being wrong, times sixteen bits, is nothing beside 1 in
float32."""

_SLACK = np.float32(1.00001)
"""A root of what is larger by this is larger in float32, too."""

_F0 = np.float32(0)
_F1 = np.float32(1)
_HALF = np.float32(0.5)


@inlined_kernel
def light_and_dark(
    levels: NDArray[np.intp], like: NDArray[Any], summed: int, at: int, half: int, sums: NDArray[Any]
) -> tuple[Lanes, Lanes]:
    """White and black, or the means of the brighter and of the darker of the coarse bits' images and inverses."""
    if levels[0] != 0:
        return floats(samples(levels, 0, at + half, like)), floats(samples(levels, 1, at + half, like))
    share = _F1 / np.float32(summed)
    return floats_at(sums, LIGHT * LINE + half) * share, floats_at(sums, DARK * LINE + half) * share


@inlined_kernel
def judge_light(
    has_pairs: bool,
    has_single: bool,
    levels: NDArray[np.intp],
    like: NDArray[Any],
    summed: int,
    clip: int,
    noise: NDArray[np.float32],
    limits: NDArray[np.float32],
    at: int,
    half: int,
    lines: NDArray[Any],
    sums: NDArray[Any],
    reason: NDArray[np.uint8],
) -> bool:
    """Reasons of LANES pixels as far as their light goes, and by how much their bits' images must differ.

    Whether that leaves a decided bit that may be wrong.
    """
    light, dark = light_and_dark(levels, like, summed, at, half, sums)
    contrast, middle = light - dark, _HALF * (light + dark)
    variance = noise[3] * greatest(noise[0] + noise[1] * middle, noise[2])
    enough = (contrast > limits[0]) & (contrast * contrast > limits[1] * variance)
    late = _F0 if levels[0] != 0 else _HALF
    store(reason, at + half, choose(dark >= np.float32(clip) - late, 2, choose(enough, 0, 1)))
    margins = False
    if has_pairs:
        margins |= _limit(contrast, BOTH_IMAGES * variance, enough, limits, lines, OF_PAIRS * LINE + half, like)
    if has_single:
        margins |= _limit(contrast, SINGLE * variance, enough, limits, lines, OF_ONE * LINE + half, like)
    return margins


@inlined_kernel
def _limit(
    contrast: Lanes,
    variance: Lanes,
    enough: Any,
    limits: NDArray[np.float32],
    lines: NDArray[Any],
    at: int,
    like: NDArray[Any],
) -> bool:
    """Keep by how much images must differ, whose difference has this variance, in whole levels.

    Whether an image that differs by more may be wrong all the same, where the light is enough.
    """
    margins = False
    # |d| > t for whole |d| is |d| > floor(t).
    limit = greatest(limits[2] * contrast, _F0)
    if any_of(enough & (limit * limit < max(SURE2, limits[3]) * _SLACK * variance)):
        limit = greatest(limit, root(limits[3] * variance))
        after = floats(as_samples(least(limit, limits[6]), like)) + _F1
        margins = any_of(enough & (after * after < SURE2 * variance))
    store(lines, at, as_samples(least(limit, limits[6]), like))
    return margins


@inlined_kernel
def find_bright(
    has_single: bool,
    levels: NDArray[np.intp],
    like: NDArray[Any],
    summed: int,
    noise: NDArray[np.float32],
    limits: NDArray[np.float32],
    at: int,
    half: int,
    lines: NDArray[Any],
    sums: NDArray[Any],
) -> None:
    """Which of LANES pixels have more contrast than noise asks of a bit that is decided, into BRIGHT.

    At others bits are open for another reason than blur.
    """
    light, dark = light_and_dark(levels, like, summed, at, half, sums)
    variance = noise[3] * greatest(noise[0] + noise[1] * (_HALF * (light + dark)), noise[2])
    asked, share = limits[3] * (SINGLE if has_single else BOTH_IMAGES) * variance, limits[2] * (light - dark)
    bright = choose((share > _F0) & (share * share > asked), 1, 0)
    store(lines, BRIGHT * LINE + half, bright)
