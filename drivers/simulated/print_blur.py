"""Prints as a lens shows them: blurred first, gathered by pixels afterwards.

The sensor blurs the light of whole pixels (`sensor`). For light that changes little from one pixel to the next that is
the same; the edges of a print have detail that whole pixels fold into coarser detail (aliasing) before the blur can
take it away, which moves corners by thousandths of a pixel. So blurred light is multiplied by what the blurred print
has over the blurred pixels of it: exact where the projected light is even over the blur, of second order elsewhere.
Where the blur reaches another body, pixels are left as they are.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.simulated.sensor import blur_taps
from drivers.simulated.textures import Footprints

Plane = NDArray[np.float32]

PARTS = 4
"""Of a pixel along each side; what they fold still moves corners by a sixteenth of what whole pixels do."""
BAND = 64
"""Rows of pixels that are split into parts at a time."""


def print_gain(
    albedo: Plane,
    own: NDArray[np.bool_],
    sigma_px: float,
    footprints: Footprints,
    gain: Plane,
) -> None:
    """Set the gain of each pixel whose blur holds an edge of a body's print, and nothing but this body.

    Args:
        albedo: (H + 2 m, W + 2 m) float32, each pixel's mean, m px beyond the picture: as far as the blur reaches.
        own: of that shape: which pixels see the body.
        sigma_px: of the lens's blur, more than 0.
        footprints: of the pixels of `albedo` on the body.
        gain: (H, W) float32, set in place.
    """
    taps = blur_taps(sigma_px)
    reach = len(taps) - 1
    inside = np.s_[reach:-reach, reach:-reach]
    whole = np.concatenate((taps[:0:-1], taps))
    blurred = cv2.sepFilter2D(albedo, cv2.CV_32F, whole, whole)[inside]
    alone = cv2.erode(own.astype(np.uint8), _window(reach)) > 0
    sought = (alone & _varies(albedo, reach))[inside]
    mixed = own & _varies(albedo, 1)
    weights = _weights(sigma_px, reach)
    for first in range(0, len(gain), BAND):
        rows, around = slice(first, first + BAND), slice(first, first + BAND + 2 * reach)
        if sought[rows].any():
            parts = footprints.means(np.flatnonzero(mixed[around]) + first * albedo.shape[1], PARTS)
            fine = _split(albedo[around], mixed[around], parts)
            exact = _gathered(_gathered(fine, weights).T, weights).T
            np.divide(exact, blurred[rows], out=gain[rows], where=sought[rows])


def _window(reach: int) -> NDArray[np.uint8]:
    return np.ones((2 * reach + 1, 2 * reach + 1), dtype=np.uint8)


def _varies(plane: Plane, reach: int) -> NDArray[np.bool_]:
    """Whether pixels so near have another value; beyond the plane there are none."""
    differs: NDArray[np.bool_] = cv2.dilate(plane, _window(reach)) != cv2.erode(plane, _window(reach))
    return differs


def _weights(sigma_px: float, reach: int) -> Plane:
    """(PARTS (2 reach + 1),) of a pixel's parts and those around it: the Gaussian blur of its square, summing to 1."""
    offset = np.arange(-reach * PARTS, reach * PARTS + 1) / PARTS
    weights = np.convolve(np.exp(-0.5 * (offset / sigma_px) ** 2), np.ones(PARTS))
    return np.asarray(weights / weights.sum(), dtype=np.float32)


def _split(albedo: Plane, mixed: NDArray[np.bool_], parts: Plane) -> Plane:
    """(PARTS H, PARTS W) of the pixels' parts: their own means where they are `mixed`, else the pixel's."""
    height, width = albedo.shape
    fine = np.empty((height, PARTS, width, PARTS), dtype=np.float32)
    fine[:] = albedo[:, None, :, None]
    fine.transpose(0, 2, 1, 3)[mixed] = parts
    return fine.reshape(height * PARTS, width * PARTS)


def _gathered(fine: Plane, weights: Plane) -> Plane:
    """Of rows of parts, rows of pixels."""
    count = (len(fine) - len(weights)) // PARTS + 1
    rows = np.zeros((count, fine.shape[1]), dtype=np.float32)
    for k, weight in enumerate(weights):
        rows += weight * fine[k : k + PARTS * count : PARTS]
    return rows
