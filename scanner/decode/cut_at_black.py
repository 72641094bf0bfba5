"""Pixels too dark to contradict a fringe: noise alone moves them, and the sensor cut its lower half off at black.

Such pixels look steadier on the whole than each of them is, since a grey level cannot be less than none; a scan's noise
model, which follows the many, then takes a level or two of noise for a scene that moved. Pixels with light in them, and
those of cameras whose black is no zero, are left as they are.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Reason
from scanner.decode.noise import default_noise
from scanner.decode.pmp_frames import AxisFrames

TOGETHER = 65536
"""Pixels looked at together: their samples of a set stay in the cache."""


def unmove_dark(reason: NDArray[np.uint8], frames: AxisFrames, least: float, sigmas: float, max_value: int) -> int:
    """Pixels that are said to have moved, and are only dark, are shadow.

    Args:
        reason: (P,), changed in place.
        frames: of the axis. max_value: of the camera.
        least, sigmas: modulation that is light, in grey levels and over the noise of any camera.

    Returns:
        How many were changed.
    """
    moved = np.flatnonzero(reason == Reason.MOVED)
    changed = 0
    for begin in range(0, moved.size, TOGETHER):
        dark = _dark(moved[begin : begin + TOGETHER], frames, least, sigmas, max_value)
        reason[dark] = Reason.SHADOW
        changed += dark.size
    return changed


def _dark(
    pixels: NDArray[np.intp], frames: AxisFrames, least: float, sigmas: float, max_value: int
) -> NDArray[np.intp]:
    """Those of some pixels that have a sample at black, and no modulation in any set."""
    noise, cut = default_noise(max_value), np.zeros(pixels.size, np.bool_)
    for k, (begin, end) in enumerate(pairwise(frames.starts)):
        samples = np.stack([frame.reshape(-1)[pixels] for frame in frames.frames[begin:end]])
        mean, p, q = frames.weights[:, begin:end] @ samples.astype(np.float32)
        of_noise = np.float32(sigmas**2 * frames.gains[k]) * noise.variance(mean)
        within = p * p + q * q <= np.maximum(of_noise, np.float32(least**2))
        cut |= samples.min(axis=0) == 0
        pixels, cut = pixels[within], cut[within]
    return pixels[cut]
