"""How many pixels have each reason for having no value, counted while they are in the cache."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.kernel import contracting_kernel

REASONS = 9
"""Members of `scanner.decode.Reason`."""

_STRETCH = 16384


def tally(reason: NDArray[np.uint8]) -> NDArray[np.int64]:
    """(REASONS,) how many pixels of a map have each reason."""
    counts = np.zeros(REASONS, np.int64)
    _count_all(np.ascontiguousarray(reason).reshape(-1), counts)
    return counts


def warm_up() -> None:
    """Compile the kernels."""
    tally(np.zeros(4, np.uint8))


@contracting_kernel
def _count_all(reason: NDArray[np.uint8], counts: NDArray[np.int64]) -> None:
    for begin in range(0, reason.size, _STRETCH):
        count_reasons(reason[begin : begin + _STRETCH], counts)


@contracting_kernel
def count_reasons(reason: NDArray[np.uint8], counts: NDArray[np.int64]) -> None:
    """Add to counts, (REASONS,), how many of up to 65,535 pixels have each reason."""
    left = reason.size
    for why in range(REASONS):
        if left > 0:
            found = _how_many(reason, why)
            counts[why] += found
            left -= found


@contracting_kernel
def _how_many(reason: NDArray[np.uint8], why: int) -> int:
    # A tile's worth fits 16 bits; narrow counters are what makes this a few vector instructions.
    found, wanted = np.uint16(0), np.uint8(why)
    for i in range(reason.size):
        found = np.uint16(found + np.uint16(reason[i] == wanted))
    return int(found)
