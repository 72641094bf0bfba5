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

LEAST_APART = 0.02
"""Of white: what two showings of a level may differ by in any case"""

MOST_APART = 0.7
"""The same, as a share of the step to the next level: a frame that is out of step shows that one, a whole step off"""

ODD_TIMES = 8.0
"""The same, over what the others differ by (median), as shares of their light: a lamp flickers at all levels, and
chance goes so far once in ten million"""

MOST_UNSTEADY = 0.1
"""Of their light, the median of the levels: more is no lamp's flicker"""

CLIPPED_SHARE = 0.05
"""Of lit pixels: so many that are the brightest there are, and no brighter at white than a level before, have reached
what the camera can give; others rise by several grey levels"""

LEAST_SIGMA = 1e-4
"""Of an exponent: a calibration file has it in four decimals"""

MOST_MISFIT = 0.004
"""Rms that a pure exponent may leave, of white: half a second harmonic of a hundredth. Beyond, a table is wanted."""

CHANCE_TIMES = 2.5
"""Of what unsteady light makes: of sixteen levels, shown twice, one set in a thousand is beyond by chance (F test)"""


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
    unsteady: float | None = None
    """1-sigma by which the light of one level differs from shot to shot, share of it, without what drifts evenly; None
    where no level was shown twice"""
    chance: float = 0.0
    """misfit that unsteady light makes"""

    @property
    def response(self) -> dict[str, Any]:
        """`response.projector` of a calibration file: the exponent where it fits, but for chance, else the table."""
        if self.misfit <= max(MOST_MISFIT, CHANCE_TIMES * self.chance):
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
            "unsteady": self.unsteady,
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
    _refuse_clipped(means[:, use], steps)
    weight = contrast[use] / float(contrast[use] @ contrast[use])
    shots = np.array([(np.asarray(frame, np.float64)[use] - means[0, use]) @ weight for frame in frames])
    shown = np.array([np.count_nonzero(values == v) for v in steps])
    light = np.bincount(np.searchsorted(steps, values), shots) / shown
    falls = np.flatnonzero(np.diff(light) < -0.01)
    if falls.size:
        raise CalibrationError(
            f"level {steps[falls[0] + 1]} is darker than level {steps[falls[0]]}",
            hint="are the frames in the order of their levels? Switch dynamic contrast off",
        )
    _refuse_out_of_step(steps, light, values, shots)
    light = np.clip(np.maximum.accumulate(light), 0, 1)
    # Rounding is averaged over pixels only where noise or texture dithers it: it is taken as the same in all.
    gamma, sigma, misfit = _exponent(steps, light, float(1 / np.sqrt(12 * np.mean(contrast[use] ** 2))))
    table = np.clip(PchipInterpolator(steps, light)(np.arange(256)), 0, 1)
    unsteady = _unsteadiness(values, shots)
    chance = 0.0 if unsteady is None else unsteady * float(np.sqrt(np.mean(light[1:] ** 2 / shown[1:])))
    return LevelResponse(
        gamma, sigma, misfit, tuple(float(v) for v in table), tuple(int(v) for v in steps),
        tuple(float(v) for v in light), int(np.count_nonzero(use)), unsteady, chance,
    )  # fmt: skip


def _refuse_clipped(means: NDArray[np.float64], steps: NDArray[Any]) -> None:
    """Raise CalibrationError where lit pixels, (L, n) at each level, end below full scale."""
    still = (means[-1] == means[-2]) & (means[-1] > means[0]) & (means[-1] > means[-1].max() - 1)
    if np.mean(still) > CLIPPED_SHARE:
        raise CalibrationError(
            f"{np.mean(still):.0%} of the lit pixels are as bright at level {steps[-2]} as at {steps[-1]}, at grey "
            f"level {np.median(means[-1][still]):g}: the camera clips there",
            hint="expose shorter: white must stay below the camera's range",
        )


def _refuse_out_of_step(
    steps: NDArray[Any], light: NDArray[np.float64], values: NDArray[Any], shots: NDArray[np.float64]
) -> None:
    """Raise CalibrationError where one showing of a level looks like another level's. light: (L,) mean of its shots."""
    apart = np.array([np.ptp(shots[values == v]) for v in steps])
    rises = np.abs(np.diff(light))
    nearest = np.minimum(np.append(rises, np.inf), np.insert(rises, 0, np.inf))
    share = apart / np.maximum(light, LEAST_APART)
    usual = float(np.median(share[light > LEAST_APART]))
    far = apart > np.maximum(LEAST_APART, MOST_APART * nearest)
    odd = np.flatnonzero(far & ((share > ODD_TIMES * usual) | (usual > MOST_UNSTEADY)))
    if odd.size:
        raise CalibrationError(
            f"level {steps[odd[0]]} was seen with lights that are {apart[odd[0]]:.1%} of white apart, as if another "
            "level had been shown",
            hint="frames out of step (fringed calibrate sync), or a light that flickers: measure again",
        )


def _unsteadiness(values: NDArray[Any], shots: NDArray[np.float64]) -> float | None:
    """See `LevelResponse.unsteady`.

    values: (F,) level of each shot. shots: (F,) light of each, share of white.
    """
    level, at = np.unique(values, return_inverse=True)
    light = (np.bincount(at, shots) / np.bincount(at))[at]
    use = (light > 0) & (np.bincount(at) > 1)[at]
    freedom = np.count_nonzero(use) - len(np.unique(at[use])) - 1
    if freedom < 1:
        return None
    groups, light = at[use], light[use]
    off = shots[use] / light - 1
    # An even drift is cancelled by levels that are shown up and down again: time, too, is taken from each level's mean.
    time = np.flatnonzero(use).astype(np.float64)
    time -= (np.bincount(groups, time, len(level)) / np.maximum(np.bincount(groups, minlength=len(level)), 1))[groups]
    # In the dark the camera's noise is all there is: a level counts by its light.
    weight = light**2
    drift = float((weight * time) @ off) / max(float((weight * time) @ time), 1e-12)
    share = weight / weight.mean()
    return float(np.sqrt(share @ (off - drift * time) ** 2 / freedom))


def _exponent(levels: NDArray[Any], light: NDArray[np.float64], rounding: float) -> tuple[float, float, float]:
    """Least squares of light = white (level / 255)^g: g, its 1-sigma and the rms left; Gauss-Newton from a log-log fit.

    White is one of the levels, no surer than the others, and every share of it as wrong as it is: the fit has white's
    own light free, too. rounding: 1-sigma that rounding to whole grey levels leaves in each light, share of white.
    """
    inner = (levels > 0) & (light > 1e-4)
    v, seen = levels[inner] / 255.0, light[inner]
    logs = np.log(v)
    weight = seen**2
    gamma, white = float((weight * logs * np.log(seen)).sum() / (weight * logs**2).sum()), 1.0
    for _ in range(6):
        shape = v**gamma
        slopes = np.column_stack((white * shape * logs, shape))
        step = np.linalg.lstsq(slopes, seen - white * shape, rcond=None)[0]
        gamma, white = gamma + float(step[0]), white + float(step[1])
    left = seen - white * v**gamma
    shares = np.linalg.inv(slopes.T @ slopes) @ slopes.T
    # Bright levels flicker most: each level's own remainder tells of it (HC3: MacKinnon and White 1985, J. Econometrics
    # 29, 305); of one that the fit follows closely little remains.
    followed = np.einsum("ij,ji->i", slopes, shares)
    variance = (left / np.maximum(1 - followed, 0.1)) ** 2 + rounding**2
    sigma = float(np.sqrt(shares[0] ** 2 @ variance))
    return gamma, max(sigma, LEAST_SIGMA), float(np.sqrt(np.mean(left**2)))
