"""The projector's response from a sequence of flat grey levels: the light of each input value, as a camera sees it.

Pixels that the projector lights see every level: their differences from black, over white's, are the response, if the
camera is linear. It comes as an exponent where one fits, else as a table, in the words of a calibration file. How
levels are shown and captured is not this file's business; a response from fringes is `response`'s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from scanner.errors import CalibrationError

LEVELS = tuple(range(0, 256, 15))
"""Eighteen, from black to white: a table between them follows an exponent to a thousandth of white"""

LEAST_LEVELS = 6

LEAST_CONTRAST = 0.05
"""White less black over the camera's range: less drowns in quantisation."""

LIT_SHARE = 0.25
"""Of the contrast of the brightest pixels: what has less is lit by the rest of the room"""

LEAST_SIGMA = 1e-4
"""Of an exponent: a calibration file has it in four decimals"""

MOST_MISFIT = 0.004
"""Rms that a pure exponent may leave, of white: half a second harmonic of a hundredth. Beyond, a table is wanted."""


@dataclass(frozen=True)
class LevelResponse:
    """What a projector makes of its input values."""

    gamma: float
    """exponent that fits best"""
    sigma: float
    """1-sigma of it: of what the fit leaves, and of grey levels that are whole numbers"""
    misfit: float
    """rms of what the exponent leaves, share of white"""
    table: tuple[float, ...]
    """(256,) light 0 .. 1 of each input value"""
    levels: tuple[int, ...]
    light: tuple[float, ...]
    """light 0 .. 1 of each level as seen"""
    pixels: int

    @property
    def response(self) -> dict[str, Any]:
        """`response.projector` of a calibration file: the exponent where it fits, else the table."""
        if self.misfit <= MOST_MISFIT:
            return {"gamma": round(self.gamma, 4)}
        return {"table": [round(value, 6) for value in self.table]}

    def as_dict(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "gamma": self.gamma,
            "sigma": self.sigma,
            "misfit": self.misfit,
            "levels": list(self.levels),
            "light": list(self.light),
            "pixels": self.pixels,
            "response": self.response,
        }


def response_of_levels(
    levels: Sequence[int], frames: Sequence[NDArray[np.uint8] | NDArray[np.uint16]], max_value: int
) -> LevelResponse:
    """The response that frames of flat levels show.

    Args:
        levels: input value of each frame, 0 .. 255, in any order; 0 and 255 among them. A level that is shown more
            than once is averaged, so that a lamp that drifts is cancelled by levels shown up and down again.
        frames: (H, W) each, of one exposure.
        max_value: the camera's largest grey level.

    Raises:
        CalibrationError: levels are missing, too few pixels are lit, or light falls where the level rises.
    """
    values = np.asarray(levels)
    if len(values) != len(frames):
        raise CalibrationError(f"{len(values)} levels and {len(frames)} frames: give one level for each frame")
    if values.min(initial=256) != 0 or values.max(initial=-1) != 255 or len(set(levels)) < LEAST_LEVELS:
        raise CalibrationError(
            f"levels {', '.join(map(str, sorted(set(levels))))} do not show a response",
            hint=f"show {LEAST_LEVELS} levels or more, 0 and 255 among them",
        )
    steps = np.unique(values)
    means = np.stack(
        [np.mean([frames[int(i)] for i in np.flatnonzero(values == v)], axis=0, dtype=np.float64) for v in steps]
    )
    contrast = means[-1] - means[0]
    brightest = float(np.percentile(contrast, 99))
    if brightest < LEAST_CONTRAST * max_value:
        raise CalibrationError(
            f"black and white differ by {max(brightest, 0.0):.1f} of {max_value} grey levels",
            hint="point the camera at what the projector lights, and expose longer",
        )
    use = (contrast > LIT_SHARE * brightest) & (means.max(axis=0) < 0.98 * max_value)
    if np.count_nonzero(use) < 100:
        raise CalibrationError(
            "too few pixels are lit without clipping", hint="expose shorter: white must stay below the camera's range"
        )
    weight = contrast[use]
    light = ((means[:, use] - means[0, use]) @ weight) / float(weight @ weight)
    falls = np.flatnonzero(np.diff(light) < -0.01)
    if falls.size:
        raise CalibrationError(
            f"level {steps[falls[0] + 1]} is darker than level {steps[falls[0]]}",
            hint="are the frames in the order of their levels? Switch dynamic contrast off",
        )
    light = np.clip(np.maximum.accumulate(light), 0, 1)
    # Rounding is averaged over pixels only where noise or texture dithers it: it is taken as the same in all.
    gamma, sigma, misfit = _exponent(steps, light, float(1 / np.sqrt(12 * np.mean(weight**2))))
    table = np.clip(PchipInterpolator(steps, light)(np.arange(256)), 0, 1)
    return LevelResponse(
        gamma, sigma, misfit, tuple(float(v) for v in table), tuple(int(v) for v in steps),
        tuple(float(v) for v in light), int(np.count_nonzero(use)),
    )  # fmt: skip


def _exponent(levels: NDArray[Any], light: NDArray[np.float64], rounding: float) -> tuple[float, float, float]:
    """Least squares of light = (level / 255)^g: g, its 1-sigma and the rms left; Gauss-Newton from a log-log fit.

    rounding: 1-sigma that rounding to whole grey levels leaves in each light, share of white.
    """
    inner = (levels > 0) & (levels < 255) & (light > 1e-4)
    v, seen = levels[inner] / 255.0, light[inner]
    logs = np.log(v)
    weight = seen**2
    gamma = float((weight * logs * np.log(seen)).sum() / (weight * logs**2).sum())
    for _ in range(5):
        slope = v**gamma * logs
        gamma += float(slope @ (seen - v**gamma) / (slope @ slope))
    left = seen - v**gamma
    misfit = float(np.sqrt(np.mean(left**2)))
    slope = v**gamma * logs
    variance = float(left @ left) / max(len(v) - 1, 1) + rounding**2
    return gamma, max(float(np.sqrt(variance / (slope @ slope))), LEAST_SIGMA), misfit
