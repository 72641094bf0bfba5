"""A kernel: the maps of two PMP axes, decoded apart, become those of a scan."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.decode.reasons import count_reasons
from scanner.kernel import contracting_kernel

STRETCH = 4096
"""Pixels joined together: what a second-level cache holds of twelve maps."""

_HALF = np.float32(0.5)
_NAN = np.float32(np.nan)


@contracting_kernel
def join_maps(
    position: NDArray[np.float32],
    sigma: NDArray[np.float32],
    confidence: NDArray[np.float32],
    albedo: NDArray[np.float32],
    modulation: NDArray[np.float32],
    reason: NDArray[np.uint8],
    other_position: NDArray[np.float32],
    other_sigma: NDArray[np.float32],
    other_confidence: NDArray[np.float32],
    other_albedo: NDArray[np.float32],
    other_modulation: NDArray[np.float32],
    other_reason: NDArray[np.uint8],
    counts: NDArray[np.int64],
) -> None:
    """A pixel is decided when both its coordinates are. All (P,); the first six become those of both axes.

    Args:
        counts: (REASONS,) int64, how many pixels have each reason, is added to.
    """
    for begin in range(0, reason.size, STRETCH):
        end = min(begin + STRETCH, reason.size)
        for i in range(begin, end):
            why = reason[i] if reason[i] != 0 else other_reason[i]
            reason[i] = why
            confidence[i] *= other_confidence[i]
            albedo[i] = _HALF * (albedo[i] + other_albedo[i])
            modulation[i] = min(modulation[i], other_modulation[i])
        for i in range(begin, end):
            good = reason[i] == 0
            position[i] = position[i] if good else _NAN
            sigma[i] = sigma[i] if good else _NAN
            other_position[i] = other_position[i] if good else _NAN
            other_sigma[i] = other_sigma[i] if good else _NAN
        count_reasons(reason[begin:end], counts)
