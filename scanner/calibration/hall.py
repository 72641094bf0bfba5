"""The Hall model: a camera or projector as one 3 x 4 matrix, by pseudo-inverse (Casey 2011, secs. 3.1-3.4).

It has no distortion and its eleven numbers have no names, but it needs no start: it is kept for parity with the
dissertation, and as the start of the adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.errors import CalibrationError

Array = NDArray[np.float64]

FEWEST_POINTS = 6
"""Eleven unknowns, two equations a point."""


@dataclass(frozen=True, eq=False)
class Decomposed:
    """matrix (3, 3) upper triangular, m33 = 1; rotation (3, 3); translation (3,).

    pixel ~ matrix (rotation X + translation)
    """

    matrix: Array
    rotation: Array
    translation: Array


def hall_matrix(points: Array, pixels: Array) -> Array:
    """The 3 x 4 matrix with m34 = 1 that maps world points to pixels, by linear least squares.

    Args:
        points: (N, 3) mm, not in one plane.
        pixels: (N, 2) px.

    Raises:
        CalibrationError: fewer than six points, or points in one plane.
    """
    if len(points) < FEWEST_POINTS:
        raise CalibrationError(
            f"{len(points)} points are too few for the Hall model, which takes {FEWEST_POINTS} or more"
        )
    # Normalised to unit spread first: the pseudo-inverse of raw mm and px loses six digits.
    to_unit, unit = _normaliser(points)
    to_pixel, scaled = _normaliser(pixels)
    n = len(points)
    x, y = scaled[:, :1], scaled[:, 1:]
    ones, none = np.ones((n, 1)), np.zeros((n, 4))
    full = np.hstack((unit, ones))
    equations = np.vstack((np.hstack((full, none, -x * unit)), np.hstack((none, full, -y * unit))))
    singular = np.linalg.svd(equations, compute_uv=False)
    if singular[-1] < 1e-7 * singular[0]:
        raise CalibrationError(
            "the target's points lie in one plane, or on a curve that does not fix the Hall model",
            hint="use a target in space such as the wedge, or several poses of a flat one",
        )
    solution = np.linalg.pinv(equations) @ np.concatenate((scaled[:, 0], scaled[:, 1]))
    matrix = np.linalg.inv(to_pixel) @ np.append(solution, 1.0).reshape(3, 4) @ to_unit
    return np.asarray(matrix / matrix[2, 3], dtype=np.float64)


def project_hall(matrix: Array, points: Array) -> Array:
    """(..., 3) mm to (..., 2) px."""
    homogeneous = np.asarray(points) @ matrix[:, :3].T + matrix[:, 3]
    return np.asarray(homogeneous[..., :2] / homogeneous[..., 2:], dtype=np.float64)


def triangulate_hall(camera: Array, projector: Array, rows: NDArray[Any]) -> Array:
    """World points from rows alone (Casey 2011, sec. 3.5, eqs. 4.35-4.37): three equations for X, Y, Z at each pixel.

    Args:
        camera, projector: (3, 4) Hall matrices.
        rows: (H, W) projector rows, px; NaN = not measured.

    Returns:
        (H, W, 3) float64 mm in the world's frame, NaN where not measured or where the equations are singular.
    """
    y, x = np.nonzero(np.isfinite(rows))
    measured = np.asarray(rows, dtype=np.float64)[y, x]
    # (a, b, c) . point = (p, q, r), by Cramer's rule: a million 3 x 3 systems at once.
    a, p = _equation(camera[0] - x[:, None] * camera[2])
    b, q = _equation(camera[1] - y[:, None] * camera[2])
    c, r = _equation(projector[1] - measured[:, None] * projector[2])
    bc = np.cross(b, c)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = (p * bc + q * np.cross(c, a) + r * np.cross(a, b)) / (a * bc).sum(axis=1, keepdims=True)
    points = np.full((*rows.shape, 3), np.nan)
    points[y, x] = np.where(np.isfinite(found).all(axis=1, keepdims=True), found, np.nan)
    return points


def decompose(matrix: Array) -> Decomposed:
    """A Hall matrix as focal lengths, principal point, rotation and translation.

    By RQ (Hartley & Zisserman 2004, sec. 6.2.4).

    The rotation is proper and the focal lengths are positive; of a mirrored picture the points then lie behind it.
    """
    m = matrix[:, :3]
    flipped = np.flipud(m).T
    q, r = np.linalg.qr(flipped)
    upper, rotation = np.flipud(np.fliplr(r.T)), np.flipud(q.T)
    signs = np.diag(np.sign(np.diag(upper)))
    upper, rotation = upper @ signs, signs @ rotation
    scale = upper[2, 2]
    if np.linalg.det(rotation) < 0:
        # The matrix is known up to sign: the one that makes a proper rotation.
        rotation, scale = -rotation, -scale
    translation = np.linalg.solve(upper, matrix[:, 3]) * np.sign(scale)
    return Decomposed(upper / upper[2, 2], rotation, translation)


def focal_spread(matrix: Array, points: Array, pixels: Array) -> float:
    """1-sigma of the focal length as a share of it, from what the fit leaves; by first-order propagation.

    Args:
        matrix: (3, 4), fitted.
        points: (N, 3) mm, the points it was fitted to; more than six.
        pixels: (N, 2) px.

    Returns:
        Infinite where the points do not fix it.
    """
    free = 2 * len(points) - 11
    left = float(((project_hall(matrix, points) - pixels) ** 2).sum()) / max(free, 1)
    whole = matrix.ravel()[:11]

    def values(numbers: Array) -> tuple[Array, float]:
        changed = np.append(numbers, 1.0).reshape(3, 4)
        parts = decompose(changed).matrix
        return project_hall(changed, points).ravel(), float(np.log(abs(parts[0, 0] * parts[1, 1])) / 2)

    seen, focal = values(whole)
    by, slope = np.empty((len(seen), 11)), np.empty(11)
    for k in range(11):
        step = np.zeros(11)
        step[k] = 1e-6 * max(abs(whole[k]), 1e-9)
        ahead = values(whole + step)
        by[:, k], slope[k] = (ahead[0] - seen) / step[k], (ahead[1] - focal) / step[k]
    scale = np.linalg.norm(by, axis=0)  # columns differ by many orders: px, 1, 1 / mm
    if not (np.isfinite(by).all() and (scale > 0).all()):
        return float("inf")
    covariance = np.linalg.pinv((by / scale).T @ (by / scale))
    return float(np.sqrt(left * (slope / scale) @ covariance @ (slope / scale)))


def _equation(plane: Array) -> tuple[Array, Array]:
    """(N, 3) normals and (N, 1) right-hand sides of planes (N, 4)."""
    return plane[:, :3], -plane[:, 3:]


def _normaliser(points: Array) -> tuple[Array, Array]:
    """Matrix that moves points to the origin and unit spread, and the moved points."""
    centre = points.mean(axis=0)
    spread = max(float(np.sqrt(((points - centre) ** 2).mean())), 1e-12)
    n = points.shape[1]
    matrix = np.eye(n + 1)
    matrix[:n, :n] /= spread
    matrix[:n, n] = -centre / spread
    return matrix, (points - centre) / spread
