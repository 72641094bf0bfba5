"""Where the projector sees each point of a target: a local robust fit to the decoded rows and columns around it.

One pixel's value is not enough: at a corner four squares meet, at a disc's rim light and dark mix, and a mixed pixel
takes the phase of its bright part. Pixels beside an edge of the albedo are left out, dark ones count by their noise,
and what is left is fitted by a quadratic for each axis (a plane seen in perspective, to the third order over such a
window), from which outliers fall. The fit's slope says how the projector's pixel moves with the camera's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.decode import Decoded

Array = NDArray[np.float64]

REACH = 0.55
"""Half width of the window, as a share of the distance between points: squares on all sides take part."""
LEAST_REACH_PX, MOST_REACH_PX = 6, 60
MOST_SAMPLES = 900
"""Pixels of one window that are fitted, evenly thinned beyond: more says nothing new about a smooth surface."""
LEAST_SAMPLES = 30
"""Five for each of the quadratic's six coefficients."""
EDGE_SHARE = 0.2
"""Range of the albedo over 5 x 5 pixels, as a share of its local maximum, from which a pixel counts as mixed. White
paper under a projector's falloff changes by a few per cent over that distance, print by half and more."""
ROUNDS = 4
TUKEY = 4.685
"""Tukey's biweight constant: 95 % efficient for Gaussian noise."""
SIGMA_FLOOR_PX = 0.002
"""Below this the fit's own residual says nothing: response and 8-bit projection leave as much (1-sigma)."""


@dataclass(frozen=True, eq=False)
class ProjectorPoints:
    """points: (N, 2) px x, y; sigma: (N, 2) px; slope: (N, 2, 2) projector px per camera px. NaN where not measured."""

    points: Array
    sigma: Array
    slope: Array


def plain_pixels(albedo: NDArray[Any]) -> NDArray[np.bool_]:
    """(H, W): pixels that see one albedo, none of an edge."""
    level = np.nan_to_num(np.asarray(albedo, dtype=np.float32))
    square = np.ones((5, 5), np.uint8)
    high, low = cv2.dilate(level, square), cv2.erode(level, square)
    plain: NDArray[np.bool_] = high - low <= EDGE_SHARE * high
    return plain


def projector_points(decoded: Decoded, points: Array, spacing: Array) -> ProjectorPoints:
    """Fit the maps around each point.

    Args:
        decoded: with rows and columns.
        points: (N, 2) px in the camera's picture; NaN is passed on.
        spacing: (N,) px to the next point of the target.

    Raises:
        ValueError: an axis was not decoded.
    """
    if decoded.rows is None or decoded.columns is None:
        raise ValueError("projector points need rows and columns")
    columns, rows = decoded.columns, decoded.rows
    measured = np.isfinite(rows) & np.isfinite(columns)
    plain = plain_pixels(decoded.albedo) & measured
    weights = [_weights(decoded.sigma_columns, columns), _weights(decoded.sigma_rows, rows)]
    count = len(points)
    found = ProjectorPoints(np.full((count, 2), np.nan), np.full((count, 2), np.nan), np.full((count, 2, 2), np.nan))
    for i, point in enumerate(points):
        if not np.isfinite(point).all():
            continue
        reach = round(float(np.clip(REACH * spacing[i], LEAST_REACH_PX, MOST_REACH_PX)))
        window = _window(point, reach, rows.shape)
        for usable in (plain, measured):
            at = _samples(usable, window)
            if _surrounds(at, point):
                break
        else:
            continue
        _fit_point(found, i, at, point, reach, (columns, rows), weights)
    return found


def _fit_point(
    found: ProjectorPoints,
    i: int,
    at: tuple[NDArray[np.intp], NDArray[np.intp]],
    point: Array,
    reach: int,
    maps: tuple[NDArray[Any], NDArray[Any]],
    weights: list[NDArray[np.float32]],
) -> None:
    u, v = (at[1] - point[0]) / reach, (at[0] - point[1]) / reach
    terms = np.column_stack((np.ones_like(u), u, v, u * u, u * v, v * v))
    fits = [
        _robust(terms, m[at].astype(np.float64), w[at].astype(np.float64)) for m, w in zip(maps, weights, strict=True)
    ]
    for axis, fit in enumerate(fits):
        if fit is None:
            return  # the other axis alone is of no use: its NaN stays
        value, sigma = fit
        found.points[i, axis], found.sigma[i, axis] = value[0], sigma
        found.slope[i, axis] = value[1:3] / reach


def _weights(sigma: NDArray[np.float32] | None, values: NDArray[np.float32]) -> NDArray[np.float32]:
    if sigma is None:
        return np.ones_like(values)
    return np.asarray(1.0 / np.maximum(sigma, SIGMA_FLOOR_PX) ** 2, dtype=np.float32)


def _window(point: Array, reach: int, shape: tuple[int, ...]) -> tuple[slice, slice]:
    x, y = round(float(point[0])), round(float(point[1]))
    return (
        slice(max(y - reach, 0), min(y + reach + 1, shape[0])),
        slice(max(x - reach, 0), min(x + reach + 1, shape[1])),
    )


def _samples(usable: NDArray[np.bool_], window: tuple[slice, slice]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    y, x = np.nonzero(usable[window])
    step = max(1, int(np.ceil(np.sqrt(len(y) / MOST_SAMPLES))))
    if step > 1:
        # Every step-th pixel of every step-th line: the window is thinned evenly.
        keep = (y % step == 0) & (x % step == 0)
        y, x = y[keep], x[keep]
    return y + window[0].start, x + window[1].start


def _surrounds(at: tuple[NDArray[np.intp], NDArray[np.intp]], point: Array) -> bool:
    """Whether there are enough pixels, in three quadrants at least: nothing is extrapolated."""
    if len(at[0]) < LEAST_SAMPLES:
        return False
    quadrant = 2 * (at[0] > point[1]).astype(int) + (at[1] > point[0])
    return int((np.bincount(quadrant, minlength=4) >= LEAST_SAMPLES // 6).sum()) >= 3


def _robust(terms: Array, values: Array, weights: Array) -> tuple[Array, float] | None:
    """(6,) coefficients and the first one's 1-sigma, px, by Tukey's biweight; None where the fit is singular."""
    weights = weights / weights.max()
    robust = np.ones_like(values)
    solution: NDArray[Any] = np.zeros(terms.shape[1])
    for _ in range(ROUNDS):
        root = np.sqrt(weights * robust)
        solution, _, rank, _ = np.linalg.lstsq(terms * root[:, None], values * root, rcond=None)
        if rank < terms.shape[1]:
            return None
        residual = (values - terms @ solution) * np.sqrt(weights)
        spread = max(1.4826 * float(np.median(np.abs(residual))), 1e-9)
        robust = np.clip(1 - (residual / (TUKEY * spread)) ** 2, 0, None) ** 2
    normal = (terms * (weights * robust)[:, None]).T @ terms
    sigma = spread * float(np.sqrt(np.linalg.inv(normal)[0, 0]))
    return solution, float(np.hypot(sigma, SIGMA_FLOOR_PX))
