"""A colour camera's mosaic to one channel of light, for methods of one image."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError
from scanner.patterns import CameraFormat

_MOSAICS = {
    "RGGB": cv2.COLOR_BayerRGGB2GRAY,
    "BGGR": cv2.COLOR_BayerBGGR2GRAY,
    "GRBG": cv2.COLOR_BayerGRBG2GRAY,
    "GBRG": cv2.COLOR_BayerGBRG2GRAY,
}


def grey(image: NDArray[Any], camera: CameraFormat) -> NDArray[Any]:
    """One channel of light: a colour camera's mosaic is interpolated.

    Raises:
        DecodeError: a mosaic that is not known.
    """
    if camera.mosaic is None:
        return image
    if camera.mosaic not in _MOSAICS:
        raise DecodeError(f"unknown mosaic {camera.mosaic!r}", hint=f"known: {', '.join(sorted(_MOSAICS))}")
    return np.asarray(cv2.cvtColor(image, _MOSAICS[camera.mosaic]))
