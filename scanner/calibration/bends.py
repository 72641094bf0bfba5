"""How much a view's straight lines are bent: by the lens's distortion, by a sheet that is not flat.

A homography keeps lines straight, so what the points of a plane leave from their best one holds all that bends: a
smooth field of shifts, here a polynomial of third or fifth degree in the picture, fitted robustly. Its second
derivative along a line is the line's curvature. A corner's window sees parabolas of that curvature (`corners`).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DEGREES = (5, 3)
"""Of the polynomial: what a lens bends first is of third degree, what it does next of fifth. The first that has no more
than half as many terms as there are points."""
ROUNDS = 5
FAR_SPREADS = 2.5
"""Of robust standard deviations: where a point's weight is a half."""


def line_bends(plane: Array, seen: Array, directions: Array) -> Array:
    """Curvature of the target's lines in the picture.

    Args:
        plane: (N, 2) points on the flat target, any unit.
        seen: (N, 2) px, where they are seen.
        directions: (N, L, 2) of L lines through each point in the picture, any length but zero.

    Returns:
        (N, L) 1/px, signed: at x px along the line it is x^2 / 2 times as many px towards (-sin, cos) of its direction
        (cos, sin). 0 of fewer than 20 points, or where no homography fits.
    """
    powers = next((each for each in map(_powers, DEGREES) if len(plane) >= 2 * len(each)), None)
    homography = cv2.findHomography(plane, seen)[0] if powers else None
    if powers is None or homography is None:
        return np.zeros(directions.shape[:2])
    ideal = cv2.perspectiveTransform(plane[:, None], homography)[:, 0]
    middle, unit = ideal.mean(axis=0), float(np.abs(ideal - ideal.mean(axis=0)).max())
    x, y = ((ideal - middle) / unit).T
    shifts = _robust_fit(_terms(x, y, powers), seen - ideal)
    slope = np.stack([_terms(x, y, powers, order) @ shifts for order in ((1, 0), (0, 1))], axis=-1) / unit
    by_xx, by_xy, by_yy = (
        (_terms(x, y, powers, order) @ shifts / unit**2)[:, None] for order in ((2, 0), (1, 1), (0, 2))
    )
    lines = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    # The direction that the lens turned into the line's, so long that the line's is 1.
    before = np.linalg.solve((np.eye(2) + slope)[:, None], lines[..., None])[..., 0]
    u, v = before[..., :1], before[..., 1:]
    bend = by_xx * u * u + 2 * by_xy * u * v + by_yy * v * v
    return np.asarray(lines[..., 0] * bend[..., 1] - lines[..., 1] * bend[..., 0])


def _powers(degree: int) -> tuple[tuple[int, int], ...]:
    """Of x and y in each term."""
    return tuple((n - j, j) for n in range(degree + 1) for j in range(n + 1))


def _terms(x: Array, y: Array, powers: tuple[tuple[int, int], ...], order: tuple[int, int] = (0, 0)) -> Array:
    """(N, T) terms of the polynomial, differentiated so many times by x and y."""
    return np.column_stack([_power(x, i, order[0]) * _power(y, j, order[1]) for i, j in powers])


def _power(x: Array, power: int, times: int) -> Array:
    """The derivative of x^power."""
    factor = 1.0
    for k in range(times):
        factor *= power - k
    return factor * x ** max(power - times, 0)


def _robust_fit(terms: Array, values: Array) -> Array:
    """(T, 2) coefficients; points far from the others' polynomial count little (Cauchy's weights)."""
    weights = np.ones(len(terms))
    for _ in range(ROUNDS):
        root = np.sqrt(weights)[:, None]
        # The least norm where the points leave terms open, as two rows of corners do.
        fitted, *_ = np.linalg.lstsq(terms * root, values * root, rcond=1e-9)
        off = np.linalg.norm(values - terms @ fitted, axis=1)
        spread = float(np.median(off)) / 1.1774  # Rayleigh's median over its sigma
        weights = 1 / (1 + (off / max(FAR_SPREADS * spread, 1e-9)) ** 2)
    return np.asarray(fitted)
