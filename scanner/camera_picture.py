"""Pictures of the preview: what the camera sees while nothing is scanned, and how bright and how sharp it is.

For aiming, focusing and choosing a lens opening; a scan is not judged by it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.wire_images import PreviewHeader, decode_preview

SATURATED = 0.995
"""Share of the range from which a pixel counts as saturated: noise keeps some just below"""


@dataclass(frozen=True, eq=False)
class CameraPicture:
    """One picture. pixels: (h, w) uint8 or uint16, every `header.stride`-th of the camera's, read-only."""

    header: PreviewHeader
    pixels: NDArray[Any]
    missed: int
    """pictures between this one and the one before that this client did not get"""

    @classmethod
    def of(cls, data: bytes, before: CameraPicture | None) -> CameraPicture:
        """A message of the preview socket; `before` is the one before it.

        Raises:
            ProtocolError: it is no such message.
        """
        header, values = decode_preview(data)
        pixels = np.frombuffer(values, np.dtype(header.dtype).newbyteorder("<")).reshape(header.height, header.width)
        # A preview that was started again counts from 1.
        gap = 0 if before is None else header.number - before.header.number - 1
        return cls(header, pixels, max(gap, 0))

    def figures(self, bits: int) -> Mapping[str, float]:
        """`mean` and `bright` (99.5th percentile), shares of the camera's range; `saturated`, share of the pixels;
        `sharpness`, see there. bits: of the camera.
        """
        full = float(2**bits - 1)
        return {
            "mean": float(self.pixels.mean()) / full,
            "bright": float(np.percentile(self.pixels, 99.5)) / full,
            "saturated": float(np.mean(self.pixels >= SATURATED * full)),
            "sharpness": sharpness(self.pixels),
        }


def sharpness(pixels: NDArray[Any]) -> float:
    """How strong edges are, against brightness: 100 x rms gradient over mean grey level, noise taken off.

    Gradient energy (Tenengrad; Krotkov 1988), by central differences two pixels apart. Noise is told from differences
    of second order in both directions, which straight edges leave at zero (Immerkaer 1996), robustly. It is highest
    where the lens is in focus; its value means nothing from one scene to another.
    """
    picture = np.asarray(pixels, dtype=np.float32)
    if min(picture.shape) < 3 or not picture.any():
        return 0.0
    across, down = picture[1:-1, 2:] - picture[1:-1, :-2], picture[2:, 1:-1] - picture[:-2, 1:-1]
    laplacian = cv2.filter2D(picture, cv2.CV_32F, _IMMERKAER)[1:-1, 1:-1]
    # The mask's own gain on noise of variance 1 is 36; the median of |normal| is .6745 sigma.
    noise2 = (float(np.median(np.abs(laplacian))) / 0.6745) ** 2 / 36
    energy = float(np.mean(across**2 + down**2)) - 4 * noise2
    return 100 * float(np.sqrt(max(energy, 0.0))) / float(picture.mean())


_IMMERKAER = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
