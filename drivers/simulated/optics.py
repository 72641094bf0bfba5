"""From a projected image to the light on the camera's pixels: the projector's optics, and a lookup per pixel.

An image becomes a table of the light in its own plane (gamma, then pixel square and lens blur, evaluated exactly at
positions finer than the pixel grid); a camera pixel looks its projector coordinate up there, linearly. An image that
is constant along one axis, as fringes are, needs only a line. The table's steps are fine enough that linear lookup
shifts no fringe by more than 0.002 projector px (a step h and a period p shift it by at most
0.016 (2 pi h / p)^3 p / (2 pi): 0.0004 px at p = 13.5 and h = 1/2).
"""

# Kernels: numba types their arguments.
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.kernel import kernel

Array = NDArray[np.float64]
Plane = NDArray[np.float32]
Image = NDArray[np.uint8]

STEPS_PER_PX_LINE = 16
STEPS_PER_PX_GRID = 2


@dataclass(frozen=True)
class Optics:
    """Optics and sensor of both devices; defaults are those of scenes.json."""

    full_well_e: float = field(default=15000.0, metadata={"low": 10.0, "high": 1e7})
    """electrons at full scale and 0 dB: fewer make more shot noise"""
    read_noise_dn: float = field(default=0.8, metadata={"low": 0.0, "high": 100.0})
    """1-sigma, grey levels at 8 bits and 0 dB"""
    bits: int = field(default=8, metadata={"low": 8, "high": 16})
    """of the camera's pixels"""
    projector_blur_sigma_px: float = field(default=0.7, metadata={"low": 0.3, "high": 50.0})
    """of its normal blur, projector px"""
    camera_blur_sigma_px: float = field(default=0.7, metadata={"low": 0.0, "high": 20.0})
    """of its normal blur, camera px"""
    gamma: float = field(default=2.3, metadata={"low": 0.1, "high": 10.0})
    """of the projector: its light is (grey level / 255) ^ gamma; another than `precorrection` is a response that nobody
    corrects"""
    precorrection: float = field(default=2.3, metadata={"low": 0.1, "high": 10.0})
    """the gamma that the rig's calibration believes in"""
    ambient: float = field(default=0.04, metadata={"low": 0.0, "high": 10.0})
    """share of the projector's full light at the aim point, from everywhere"""
    exposure_scale: float = field(default=1.0, metadata={"low": 0.0, "high": 100.0})
    """times the light that reaches the sensor: at 1 and the default exposure, 99 % of a board in full light stay below
    230 of 255"""
    projector_falloff: float = field(default=2.0, metadata={"low": 0.0, "high": 8.0})
    """exponent p: the projected picture darkens off its axis as cos^p"""
    vignetting: float = field(default=2.0, metadata={"low": 0.0, "high": 8.0})
    """exponent p: the camera's image darkens off its axis as cos^p"""
    noise: bool = True
    """false: neither shot nor read noise, for tests of exactness"""


@dataclass(frozen=True, eq=False)
class Line:
    """Light along one axis of the picture, the other axis constant: ((size + 2 border) * steps + 2,) float32."""

    axis: Literal["row", "column"]
    steps: int
    border: int
    """px before the picture's beginning at which the table begins"""
    light: Plane


@dataclass(frozen=True, eq=False)
class Grid:
    """Light over the picture: ((height + 2 border) * steps + 2, (width + 2 border) * steps + 2) float32."""

    steps: int
    border: int
    """px before the picture's beginning at which the table begins, along both axes"""
    light: Plane


Light = Line | Grid


# --- the projected picture ---------------------------------------------------------------------------------------


def flat_axis(image: Image) -> Literal["row", "column"] | None:
    """The axis along which the image changes if it is constant along the other ("row": rows differ); else None."""
    if np.array_equal(image[:, :1], image[:, -1:]) and (image == image[:, :1]).all():
        return "row"
    if np.array_equal(image[:1], image[-1:]) and (image == image[:1]).all():
        return "column"
    return None


def spill_px(sigma_px: float) -> int:
    """How far beyond the picture's ends its light reaches, px: the pixel square and 4.5 sigmas of blur."""
    return int(np.ceil(1.0 + 4.5 * sigma_px))


def line_of_light(values: Image, response: Plane, sigma_px: float, axis: Literal["row", "column"]) -> Line:
    """Light of an image that changes along `axis` only.

    Args:
        values: (size,) uint8.
        response: (256,) float32 light of each value.
        sigma_px: projector blur.
        axis: see `flat_axis`.
    """
    steps, reach = STEPS_PER_PX_LINE, spill_px(sigma_px)
    padded = np.pad(response[values].astype(np.float64), 2 * reach)
    end = (len(values) + 2 * reach) * steps
    fine = np.zeros(end + 2, dtype=np.float32)
    for phase in range(steps):
        weights = _pixel_weights(phase / steps - 0.5, reach, sigma_px)
        fine[phase:end:steps] = np.convolve(padded, weights[::-1], mode="valid")
    return Line(axis, steps, reach, fine)


def grid_of_light(image: Image, response: Plane, sigma_px: float) -> Grid:
    """Light of any image: (height, width) uint8."""
    steps = STEPS_PER_PX_GRID if sigma_px >= 0.5 else 2 * STEPS_PER_PX_GRID
    reach = spill_px(sigma_px)
    around = 2 * reach
    padded = cv2.copyMakeBorder(response[image], around, around, around, around, cv2.BORDER_CONSTANT, value=0.0)
    height, width = ((n + around) * steps for n in image.shape)
    fine = np.zeros((height + 2, width + 2), dtype=np.float32)
    weights = [_pixel_weights(phase / steps - 0.5, reach, sigma_px) for phase in range(steps)]
    for r, down in enumerate(weights):
        for c, across in enumerate(weights):
            part = cv2.sepFilter2D(padded, cv2.CV_32F, across, down)
            fine[r:height:steps, c:width:steps] = part[reach:-reach, reach:-reach]
    return Grid(steps, reach, fine)


def look_up(light: Light, row: Plane, column: Plane, gain: Plane, floor: Plane, out: Plane) -> None:
    """out = light at each camera pixel * gain + floor, all (H, W) float32; out may be floor.

    row, column: projector coordinates + 0.5, so that the picture begins at 0; within the table.
    """
    steps, begin = np.float32(light.steps), np.float32(light.steps * light.border)
    if isinstance(light, Grid):
        _look_up_grid(row, column, light.light, steps, begin, gain, floor, out)
    else:
        coordinate = row if light.axis == "row" else column
        _look_up_line(coordinate, light.light, steps, begin, gain, floor, out)


def _pixel_weights(offset: float, reach: int, sigma_px: float) -> Array:
    """Share of each neighbour j = -reach .. reach in the light at `offset` from a pixel's centre; sums to 1.

    The response of a square pixel seen through a Gaussian blur: 1/2 (erf((x + 1/2) / s) - erf((x - 1/2) / s)).
    """
    x = offset - np.arange(-reach, reach + 1)
    s = np.sqrt(2.0) * sigma_px
    # A few dozen values: the standard library's erf, without the third of a second that SciPy takes to load.
    fall = np.array([math.erf(edge / s) for edge in np.append(x[0] + 0.5, x - 0.5)])
    weights = -0.5 * np.diff(fall)
    return np.asarray(weights / weights.sum(), dtype=np.float64)


@kernel
def _look_up_line(coordinate, table, steps, begin, gain, floor, out):
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            t = coordinate[r, c] * steps + begin
            i = np.uint32(t)
            low = table[i]
            out[r, c] = (low + (t - np.float32(i)) * (table[i + np.uint32(1)] - low)) * gain[r, c] + floor[r, c]


@kernel
def _look_up_grid(row, column, table, steps, begin, gain, floor, out):
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            v, u = row[r, c] * steps + begin, column[r, c] * steps + begin
            i, j = np.uint32(v), np.uint32(u)
            a, b = u - np.float32(j), v - np.float32(i)
            upper = table[i, j] + a * (table[i, j + np.uint32(1)] - table[i, j])
            i += np.uint32(1)
            lower = table[i, j] + a * (table[i, j + np.uint32(1)] - table[i, j])
            out[r, c] = (upper + b * (lower - upper)) * gain[r, c] + floor[r, c]


def warm_up() -> None:
    """Compile the kernels (or load them from their cache)."""
    flat = np.zeros((2, 2), dtype=np.float32)
    table = np.zeros((8, 8), dtype=np.float32)
    _look_up_line(flat, table[0], np.float32(2), np.float32(0), flat, flat, flat.copy())
    _look_up_grid(flat, flat, table, np.float32(2), np.float32(0), flat, flat, flat.copy())
