"""Which bits of a code show in the image, and which are gone: stripes that blur has made one grey.

Blur that is the same on both sides leaves the borders of stripes where they are, and takes contrast from fine bits
before coarse ones. What is left of a bit decides it at each pixel (`graycode_kernels`); here it is counted, so that a
report can say what a coarse or empty scan comes from.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.graycode_kernels import BOTH_VARIANCE, SINGLE_VARIANCE, gather
from scanner.decode.noise import NoiseModel
from scanner.decode.runs import runs_of
from scanner.patterns import GrayPattern

SAMPLE = 2048
"""Pixels from which is told how often a bit is decided: a share of a half is known to 1 %."""

LEAST_TOLD = 100
"""Pixels whose noise would decide every bit, fewer than which tell nothing of blur."""

LEAST_DECIDED = 0.5
"""Of them, those that a bit must decide. A stripe whose borders blur is decided at all others; a bit that is half open
has a fifth of its contrast left."""


def shares_decided(
    addresses: NDArray[np.intp],
    levels: NDArray[np.intp],
    like: NDArray[Any],
    pixels: int,
    noise: NoiseModel,
    factor: float,
    share: float,
    sigmas: float,
) -> NDArray[np.float64]:
    """(A, bits) how often a bit is decided among bright pixels; NaN where there are too few of these.

    Args:
        addresses, levels, like: see `decode_codes`. pixels: of a frame.
        noise, factor: variance of a sample is the model's times the factor.
        share: of a pixel's contrast, by which a bit's two levels must differ. sigmas: the same over noise; pixels at
            which this asks for more than `share` are left out: their bits are open for another reason.
    """
    starts, length = runs_of(pixels, SAMPLE)
    table = np.concatenate([addresses.reshape(-1), levels])
    here = np.flatnonzero(table)
    taken = np.empty((here.size, starts.size * length), like.dtype)
    gather(table[here], like, starts, length, taken)
    found = np.zeros((table.size, taken.shape[1]), np.float32)
    found[here] = taken
    images = found[:-2].reshape(*addresses.shape, -1)
    single = (addresses == 0).any(axis=2)
    white, black = (found[-2], found[-1]) if levels.all() else (images.max(axis=(0, 1, 2)), images.min(axis=(0, 1, 2)))
    apart = np.abs(images[:, :, 0] - images[:, :, 1])
    if single.any():
        one = np.where(addresses[:, :, 0, None] != 0, images[:, :, 0], images[:, :, 1])
        apart = np.where(single[:, :, None], np.abs(2 * one - white - black), apart)
    contrast = white - black
    variance = np.float32(factor) * noise.variance((white + black) * np.float32(0.5))
    bright = share * contrast > sigmas * np.sqrt((SINGLE_VARIANCE if single.any() else BOTH_VARIANCE) * variance)
    if np.count_nonzero(bright) < LEAST_TOLD:
        return np.full(single.shape, np.nan)
    return np.asarray((apart[:, :, bright] > share * contrast[bright]).mean(axis=2, dtype=np.float64))


def blurred_bits(pattern: GrayPattern, shares: NDArray[np.float64]) -> Iterator[str]:
    """What a user should know of fine bits that are gone, axis by axis. shares: of `shares_decided`."""
    for axis, decided in zip(pattern.axes, shares, strict=True):
        shows = np.flatnonzero(decided >= LEAST_DECIDED)
        gone = pattern.bits - 1 - int(shows[-1]) if shows.size else pattern.bits
        if not gone or np.isnan(decided).any():
            continue
        cell = 1 << pattern.code_bits - pattern.bits
        # A stripe of the Gray code's last bit is two cells wide, of the binary code's one; of coarser bits twice that.
        widest = cell << gone - 1 << (pattern.code == "gray")
        last = f"{gone} finest bits along {axis} show" if gone > 1 else f"finest bit along {axis} shows"
        yield (
            f"out of focus, or finer than the camera sees: the {last} at {decided[-gone:].max():.0%} of the bright "
            f"pixels at most, stripes of {widest} projector px and less are blurred into grey, and positions are that "
            "coarse or undecided: focus projector and camera on the object, or project fewer bits "
            f"(--bits {max(pattern.bits - gone, 1)})"
        )
