"""Where a map's coordinates are near an end of the projected field, as boxes of pixels, by a look at a grid of them.

For decoders that do not tell it while they decode. What is done there is the business of `code_end`.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Map
from scanner.decode.field_end import margin_px
from scanner.kernel import kernel

GRID_POINTS = 1000
"""As many pixels are asked whether any is near. Only things smaller than a thousandth of the picture are missed, where
all of them lies near an end, and nothing around them does."""


def boxes_near_ends(position: Map, width: int, along: int) -> dict[int, tuple[int, int, int, int]]:
    """Where coordinates are near an end: by end, 0 the first and 1 the last, (top, bottom, left, right) in pixels.

    Args:
        position: (P,) float32. width, along: see `mind_ends`.
    """
    grid, corners = _grid(position.size, along), np.empty((2, 4), np.int64)
    if not _near(position, width, *grid, corners):
        return {}
    height, around = position.size // width, 2 * grid[0]
    return {
        end: (max(top - around, 0), min(bottom + around, height), max(left - around, 0), min(right + around, width))
        for end, (top, bottom, left, right) in enumerate(corners.tolist())
        if bottom > top
    }


@lru_cache(maxsize=16)
def _grid(pixels: int, along: int) -> tuple[int, float, float]:
    """(pixels from one point to the next, coordinates below which and above which one is near an end)."""
    margin = margin_px(along)
    return max(math.isqrt(pixels // GRID_POINTS), 1), margin - 0.5, along - margin - 0.5


@kernel
def _near(position: Map, width: int, step: int, low: float, high: float, boxes: NDArray[np.int64]) -> bool:
    """Whether a grid of pixels meets coordinates near an end; boxes: (2, 4) top, bottom, left, right of those near the
    first end, and of those near the last."""
    height = position.size // width
    boxes[:, 0], boxes[:, 1], boxes[:, 2], boxes[:, 3] = height, 0, width, 0
    found = False
    for line in range((height + step - 1) // step):
        for place in range((width + step - 1) // step):
            # Sheared both ways: no straight edge passes between its lines.
            y, x = line * step + place * 5 % step, place * step + line * 7 % step
            if y < height and x < width:
                value = position[y * width + x]
                if value < low or value > high:
                    box = boxes[0] if value < low else boxes[1]
                    box[0], box[1] = min(box[0], y), max(box[1], y + 1)
                    box[2], box[3] = min(box[2], x), max(box[3], x + 1)
                    found = True
    return found
