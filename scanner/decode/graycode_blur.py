"""Which bits of a code show in the image, and which are gone: stripes that blur has made one grey.

Blur that is the same on both sides leaves the borders of stripes where they are, and takes contrast from fine bits
before coarse ones. What is left of a bit decides it at each pixel (`graycode_kernels`); here it is counted, so that a
report can say what a coarse or empty scan comes from.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from scanner.patterns import GrayPattern

COUNTED_LINES = 1024
"""Lines of pixels, spread over the image, whose decided bits are counted in the pass: a share of a half is known to 2 %
even where all pixels of a line have the same bits."""

LEAST_TOLD = 100
"""Pixels whose noise would decide every bit, fewer than which tell nothing of blur."""

LEAST_DECIDED = 0.5
"""Of them, those that a bit must decide. A stripe whose borders blur is decided at all others; a bit that is half open
has a fifth of its contrast left."""


def share_to_count(lines: int) -> int:
    """What `decode_codes` takes as the share of an image's lines."""
    return min(COUNTED_LINES * 2**32 // lines + 1, 2**32)


def shares_decided(decided: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """(A, bits) how often a bit is decided among bright pixels; NaN where there are too few of these.

    Args:
        decided: (A x bits + 1,) at how many of them each bit is; at last how many there are.
    """
    if decided[-1] < LEAST_TOLD:
        return np.full(shape, np.nan)
    return np.asarray(decided[:-1].reshape(shape) / decided[-1], np.float64)


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
