"""The end of the projected field in Gray and binary code, whose last cell names what lies beyond it as well.

A pixel that looks beyond the end, but within reach of the blur, reads the same bits as one inside. What it lacks is
contrast: on the end itself half of a blur's light is missing, farther out more. So pixels that name a place near the
end are held against others a few pixels away; those that have little more than half of their contrast are left out.
Texture that is darker by as much is left out with them, there and nowhere else.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Map
from scanner.decode.addresses import pixels_at
from scanner.kernel import kernel
from scanner.sample_lanes import LINE

ALSO_NEAR_PX = 4.0
"""Beyond the end's cell, projector px: a blur of 4 px draws inward by no more what lies beyond the end"""

AROUND = (8, 16)
"""Camera pixels to those that a pixel is held against, in all four directions: the nearer ones are of its surface, the
farther ones clear of a wide blur"""


def between_ends(along: int, cell_px: int, least_share: float) -> tuple[float, float]:
    """Places below and above which `beyond_ends` looks at a pixel, projector px. Arguments: see there."""
    near = cell_px + ALSO_NEAR_PX if least_share else 0.0
    return near - 0.5, along - 0.5 - near


def beyond_ends(
    position: Map,
    width: int,
    along: int,
    cell_px: int,
    least_share: float,
    pairs: NDArray[np.intp],
    like: NDArray[Any],
    marked: NDArray[np.uint8],
) -> NDArray[np.intp]:
    """Pixels that look beyond an end of the field, by their contrast.

    Args:
        position: (P,) float32 projector px, NaN where undecided. width: pixels a row.
        along: projector px of the field. cell_px: of a cell of the code.
        least_share: of the contrast around that a pixel inside has.
        pairs: (N, 2) addresses of frames that differ by the contrast, which is that of the pair that differs most.
        like: (0,) of the frames' dtype.
        marked: (P / LINE and more,) 1 where any pixel of a line of LINE is not `between_ends`; others may be 1, too.
    """
    if not least_share or not marked.any():
        return np.empty(0, np.intp)
    return _beyond(position, width, along, cell_px + ALSO_NEAR_PX, least_share, pairs, like, marked)


@kernel
def _beyond(
    position: Map,
    width: int,
    along: int,
    near: float,
    least_share: float,
    pairs: NDArray[np.intp],
    like: NDArray[Any],
    marked: NDArray[np.uint8],
) -> NDArray[np.intp]:
    """See `beyond_ends`. near: projector px from an end, within which a pixel is held against others."""
    height, found = position.size // width, 0
    out = np.empty(LINE * np.count_nonzero(marked), np.intp)
    for begin in np.flatnonzero(marked) * LINE:
        for i in range(int(begin), min(int(begin) + LINE, position.size)):
            inside = position[i] + np.float32(0.5)
            if min(inside, along - inside) < near:
                y, x, best = i // width, i % width, np.float32(0)
                for far in AROUND:
                    for down, across in ((far, 0), (-far, 0), (0, far), (0, -far)):
                        row, column = min(max(y + down, 0), height - 1), min(max(x + across, 0), width - 1)
                        best = max(best, _contrast(row * width + column, pairs, like))
                if _contrast(i, pairs, like) < np.float32(least_share) * best:
                    out[found] = i
                    found += 1
    return out[:found]


@kernel
def _contrast(pixel: int, pairs: NDArray[np.intp], like: NDArray[Any]) -> np.float32:
    most = np.float32(0)
    for n in range(len(pairs)):
        light, dark = pixels_at(pairs[n, 0], pixel, 1, like)[0], pixels_at(pairs[n, 1], pixel, 1, like)[0]
        most = max(most, abs(np.float32(light) - np.float32(dark)))
    return most
