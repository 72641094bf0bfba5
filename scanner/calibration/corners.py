"""Corners of squares to a few hundredths of a pixel: a blurred saddle fitted to the image around each.

Two edges cross in a corner and both are blurred alike by lens and pixel: the model is the product of two error
functions on a sloping ground, eleven quantities to some hundred pixels, by Gauss-Newton. Corners of squares keep their
place under perspective; a lens that distorts bends the edges, by as much as `bends` tells of the whole view. Finding
corners in the first place is `detection`'s task.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

Array = NDArray[np.float64]

STEPS = 12
LEAST_RADIUS_PX = 3.0
MOST_SHIFT = 0.75
"""Share of the window's radius a corner may move from where it was found: beyond, it is another feature."""
MOST_SIGMA_PX = 6.0
"""Blur beyond which an edge is no edge; a lens that far out of focus cannot be calibrated."""


@dataclass(frozen=True, eq=False)
class Corners:
    """points: (N, 2) px; sigma: (N,) px, 1-sigma of each coordinate from the fit's residual; NaN where it failed."""

    points: Array
    sigma: Array


def refine_corners(
    image: NDArray[Any], points: Array, along: Array, down: Array, radius: Array, bends: Array | None = None
) -> Corners:
    """Fit each corner.

    Args:
        image: (H, W) grey levels, any unit.
        points: (N, 2) px, where the corners were found.
        along, down: (N, 2) directions of the two edges in the image, any length.
        radius: (N,) px of the round window; must hold nothing but the two edges.
        bends: (N, 2) 1/px, curvature of the edges along and down (`line_bends`); None: they are straight.

    Returns:
        Corners, NaN where the window leaves the image or the fit does not settle within it.
    """
    picture = np.asarray(image, dtype=np.float64)
    found = np.full((len(points), 2), np.nan)
    sigma = np.full(len(points), np.nan)
    for i, point in enumerate(points):
        angles = np.arctan2(along[i, 1], along[i, 0]), np.arctan2(down[i, 1], down[i, 0])
        curved = (0.0, 0.0) if bends is None else (float(bends[i, 0]), float(bends[i, 1]))
        fitted = _fit(picture, point, angles, curved, max(float(radius[i]), LEAST_RADIUS_PX))
        if fitted is not None:
            found[i], sigma[i] = fitted
    return Corners(found, sigma)


def _fit(
    picture: Array, point: Array, angles: tuple[float, float], bends: tuple[float, float], radius: float
) -> tuple[Array, float] | None:
    height, width = picture.shape
    reach = int(np.ceil(radius))
    column, row = (round(float(v)) for v in point)
    if not (reach <= column < width - reach and reach <= row < height - reach):
        return None
    y, x = np.mgrid[row - reach : row + reach + 1, column - reach : column + reach + 1]
    window = picture[row - reach : row + reach + 1, column - reach : column + reach + 1]
    near = np.hypot(x - point[0], y - point[1]) <= radius
    x, y, values = x[near].astype(np.float64), y[near].astype(np.float64), window[near]
    if not np.isfinite(values).all():
        return None
    return _gauss_newton(x - point[0], y - point[1], values, angles, bends, radius, point)


def _gauss_newton(
    x: Array,
    y: Array,
    values: Array,
    angles: tuple[float, float],
    bends: tuple[float, float],
    radius: float,
    point: Array,
) -> tuple[Array, float] | None:
    """Steps on (x0, y0, angle 1, angle 2, log sigma); the six levels are linear and solved for in each."""
    state: Array = np.array([0.0, 0.0, angles[0], angles[1], 0.0])
    step: NDArray[Any] = np.zeros(5)
    for _ in range(STEPS):
        product, slopes = _saddle(x, y, state, bends)
        ground = np.column_stack((np.ones_like(x), x, y))
        linear = np.column_stack((ground, ground * product[:, None]))
        levels, *_ = np.linalg.lstsq(linear, values, rcond=None)
        contrast = ground @ levels[3:]
        jacobian = np.column_stack((linear, slopes * contrast[:, None]))
        residual = values - linear @ levels
        try:
            normal = jacobian.T @ jacobian
            step = np.linalg.solve(normal, jacobian.T @ residual)[6:]
        except np.linalg.LinAlgError:
            return None
        step = np.clip(step, -np.array([2.0, 2.0, 0.2, 0.2, 0.7]), np.array([2.0, 2.0, 0.2, 0.2, 0.7]))
        state = state + step
        if np.hypot(*state[:2]) > MOST_SHIFT * radius or np.exp(state[4]) > MOST_SIGMA_PX:
            return None
        if np.abs(step[:2]).max() < 1e-4:
            break
    if np.abs(step[:2]).max() > 0.05:
        return None
    freedom = max(len(values) - 11, 1)
    spread = residual @ residual / freedom
    covariance = np.linalg.pinv(normal)[6:8, 6:8] * spread
    return point + state[:2], float(np.sqrt(np.trace(covariance) / 2))


def _saddle(x: Array, y: Array, state: Array, bends: tuple[float, float]) -> tuple[Array, Array]:
    """The product of both edges, -1 .. 1, (N,), and its slopes by the five quantities, (N, 5)."""
    x0, y0, first, second, log_sigma = state
    sigma = np.exp(log_sigma)
    u, v = x - x0, y - y0
    edges, slopes = [], []
    for angle, bend in zip((first, second), bends, strict=True):
        c, s = np.cos(angle), np.sin(angle)
        on, aside = c * u + s * v, -s * u + c * v
        tilt = bend * on
        off = (aside - 0.5 * tilt * on) / sigma
        edges.append(erf(off / np.sqrt(2.0)))
        density = np.sqrt(2.0 / np.pi) * np.exp(-0.5 * off * off)
        steep = density / sigma
        slopes.append((steep * (s + tilt * c), steep * (tilt * s - c), -steep * (on + tilt * aside), -density * off))
    (a, b), (da, db) = edges, slopes
    return a * b, np.column_stack(
        (da[0] * b + a * db[0], da[1] * b + a * db[1], da[2] * b, a * db[2], da[3] * b + a * db[3])
    )
