"""How images come in and maps go out: one channel of grey, and stripes that run horizontally.

Vertical stripes (axis "x") are turned into horizontal ones at the door and back at the end, so that one code serves
both phase directions; a projector that hangs upside down is turned likewise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Decoded
from scanner.decode.mcp.locate import Image
from scanner.decode.mosaic import grey
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, McpPattern


def upright_image(image: NDArray[Any], pattern: McpPattern, camera: CameraFormat) -> Image:
    """Checked, grey, with horizontal stripes, contiguous."""
    _check_frame(image, camera, 0)
    image = grey(image, camera)
    if min(image.shape) < 32:
        raise DecodeError(f"an image of {image.shape[1]} x {image.shape[0]} is smaller than a few stripes")
    return np.ascontiguousarray(image) if pattern.axis == "y" else turned(image)


def turned(array: NDArray[Any]) -> NDArray[Any]:
    """(H, W) to (W, H), contiguous."""
    return np.ascontiguousarray(array.T)


def upside_down(decoded: Decoded) -> Decoded:
    """Turn maps back that were decoded from an image upside down."""
    peaks = decoded.peaks
    if peaks is not None:
        peaks[:, 1] = decoded.confidence.shape[0] - 1 - peaks[:, 1]
    return _with_maps(decoded, lambda array: array[::-1], details={**decoded.details, "upside_down": True})


def turned_back(decoded: Decoded) -> Decoded:
    """Rows of the turned image are columns of the image."""
    peaks = decoded.peaks
    if peaks is not None:
        peaks[:, :2] = peaks[:, 1::-1]
    upright = _with_maps(decoded, turned)
    return replace(upright, rows=None, sigma_rows=None, columns=upright.rows, sigma_columns=upright.sigma_rows)


def _check_frame(frame: NDArray[Any], camera: CameraFormat, position: int) -> None:
    if frame.ndim != 2:
        raise DecodeError(
            f"frame {position} has shape {frame.shape}, expected one channel", hint="convert it to luma first"
        )
    if frame.shape != camera.shape:
        raise DecodeError(
            f"frame {position} is {frame.shape[1]} x {frame.shape[0]}, "
            f"the camera's format is {camera.width} x {camera.height}"
        )
    if frame.dtype not in (np.uint8, np.uint16):
        raise DecodeError(f"frame {position} has dtype {frame.dtype}, expected uint8 or uint16")


def _with_maps(decoded: Decoded, change: Callable[[NDArray[Any]], NDArray[Any]], **more: Any) -> Decoded:
    """`decoded` with every map changed, contiguous."""
    names = ("rows", "sigma_rows", "confidence", "albedo", "modulation", "reason", "stripes")
    changed: dict[str, Any] = {name: np.ascontiguousarray(change(getattr(decoded, name))) for name in names}
    return replace(decoded, **changed, **more)
