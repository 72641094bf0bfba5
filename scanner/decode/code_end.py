"""The end of the projected field in Gray and binary code, whose last cell names what lies beyond it as well.

A pixel that looks beyond the end, but within reach of the blur, reads the same bits as one inside. What it lacks is
contrast: on the end itself half of a blur's light is missing, farther out more. So pixels that name a place near the
end are held against others a few pixels away; those that have little more than half of their contrast are left out.
Texture that is darker by as much is left out with them, there and nowhere else.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Map
from scanner.decode.field_end import boxes_near_ends

ALSO_NEAR_PX = 4.0
"""Beyond the end's cell, projector px: a blur of 4 px draws inward by no more what lies beyond the end"""

AROUND = (8, 16)
"""Camera pixels to those that a pixel is held against, in all four directions: the nearer ones are of its surface, the
farther ones clear of a wide blur"""


def beyond_ends(
    position: Map,
    width: int,
    along: int,
    cell_px: int,
    least_share: float,
    light_and_dark: Sequence[tuple[NDArray[Any], NDArray[Any]]],
) -> NDArray[np.intp]:
    """Pixels that look beyond an end of the field, by their contrast.

    Args:
        position: (P,) float32 projector px, NaN where undecided. width: pixels a row.
        along: projector px of the field. cell_px: of a cell of the code.
        least_share: of the contrast around that a pixel inside has.
        light_and_dark: frames that differ by the contrast, of any shape; the pair counts that differs most.
    """
    found = [np.empty(0, np.intp)]
    for end, (top, bottom, left, right) in boxes_near_ends(position, width, along).items():
        inside = position.reshape(-1, width)[top:bottom, left:right] + np.float32(0.5)
        y, x = np.nonzero((along - inside if end else inside) < cell_px + ALSO_NEAR_PX)
        found.append((y + top) * width + x + left)
    near = np.unique(np.concatenate(found))
    if not near.size:
        return near
    y, x = np.divmod(near, width)
    best = np.zeros(near.size, np.float32)
    for far in AROUND:
        for down, across in ((far, 0), (-far, 0), (0, far), (0, -far)):
            there = np.clip(y + down, 0, position.size // width - 1) * width + np.clip(x + across, 0, width - 1)
            best = np.maximum(best, _contrast(light_and_dark, there))
    return near[_contrast(light_and_dark, near) < least_share * best]


def _contrast(pairs: Sequence[tuple[NDArray[Any], NDArray[Any]]], pixels: NDArray[np.intp]) -> NDArray[np.float32]:
    levels = ((light.reshape(-1)[pixels], dark.reshape(-1)[pixels].astype(np.float32)) for light, dark in pairs)
    return np.asarray(np.max([np.abs(light - dark) for light, dark in levels], axis=0), np.float32)
