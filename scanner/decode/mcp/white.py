"""A second frame, full on, for textured scenes that stand still: the pattern's frame divided by it.

What is printed on a surface, its shading and its gloss are in both frames alike; their ratio shows the pattern as on a
plain board. Not here: the decoding, which takes the ratio as it takes any image.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp.locate import Array
from scanner.errors import DecodeError

RATIO_BITS = 12
ONE = 3072
"""Grey levels of a ratio of 1, of 4095: glints that move leave some more."""

DARKEST_SHARE = 0.025
"""Share of the white frame's 99th percentile below which nothing is divided: print has a fortieth of paper's albedo."""

DARKEST_LEVELS = 1 / 64
"""The same as a share of the range: four grey levels of eight bits, where rounding alone moves the ratio by a tenth."""


def divided(image: NDArray[Any], white: NDArray[Any], black: NDArray[Any] | None, limit: int) -> NDArray[np.uint16]:
    """The ratio of two frames, 12 bits: ONE where they are equal, 0 where there is too little light.

    Args:
        image, white: (H, W) uint8 or uint16, one channel.
        black: (H, W), light that is not the projector's; None: none is taken off.
        limit: largest grey level; a pixel of `image` at it comes out clipped (4095).

    Raises:
        DecodeError: the white frame is dark.
    """
    light, full = image.astype(np.float32), white.astype(np.float32)
    if black is not None:
        light, full = light - black, full - black
    top = float(np.percentile(full[::4, ::4], 99))
    least = max(DARKEST_SHARE * top, DARKEST_LEVELS * limit)
    if top < 4 * least:
        raise DecodeError(
            f"the white frame is dark (grey level {top:.0f} at its brightest)",
            hint="check that the projector showed it, and the exposure",
        )
    ratio = np.rint(np.clip(light / np.maximum(full, least), 0, 4094 / ONE) * ONE).astype(np.uint16)
    ratio[full < least] = 0
    # Where white alone is clipped its grey level is too low, and the surface keeps some of its own brightness.
    ratio[image >= limit] = (1 << RATIO_BITS) - 1
    return ratio


def in_grey_levels(ratio: Array, white: NDArray[Any], black: NDArray[Any] | None) -> Array:
    """A map of brightness that was decoded from the ratio, (H, W) float32, in the camera's grey levels."""
    full = white if black is None else cv2.subtract(white, black)
    return np.asarray(ratio * (full.astype(np.float32) / ONE), np.float32)
