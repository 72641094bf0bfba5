"""A lens's pixels and how they move with its numbers and with the point: what an adjustment differentiates.

The model is `scanner.geometry.Lens`'s (Brown 1966, OpenCV's order); here its derivatives stand beside it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.geometry import Lens

Array = NDArray[np.float64]

LENS_NUMBERS = 9
"""fx, fy, cx, cy, k1, k2, p1, p2, k3"""


def lens_numbers(lens: Lens) -> Array:
    """(9,) fx, fy, cx, cy, k1, k2, p1, p2, k3."""
    m = lens.matrix
    return np.array([m[0, 0], m[1, 1], m[0, 2], m[1, 2], *lens.distortion])


def lens_of(numbers: Array, size: tuple[int, int]) -> Lens:
    """The lens with these numbers."""
    fx, fy, cx, cy = (float(n) for n in numbers[:4])
    return Lens(
        size, np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), np.array(numbers[4:9], dtype=np.float64)
    )


def seen(numbers: Array, points: Array) -> tuple[Array, Array, Array]:
    """Pixels of points in the lens's frame.

    Args:
        numbers: (9,), see `lens_numbers`.
        points: (N, 3) mm.

    Returns:
        (N, 2) px; (N, 2, 9) by the lens's numbers; (N, 2, 3) by the point, px / mm.
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = numbers
    depth = points[:, 2]
    x, y = points[:, 0] / depth, points[:, 1] / depth
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    pixels = np.column_stack((fx * xd + cx, fy * yd + cy))
    by_lens = np.zeros((len(points), 2, LENS_NUMBERS))
    by_lens[:, 0, 0], by_lens[:, 0, 2] = xd, 1.0
    by_lens[:, 1, 1], by_lens[:, 1, 3] = yd, 1.0
    terms = np.column_stack((r2, r2 * r2, r2 * r2 * r2))
    by_lens[:, 0, [4, 5, 8]] = fx * x[:, None] * terms
    by_lens[:, 1, [4, 5, 8]] = fy * y[:, None] * terms
    by_lens[:, 0, 6], by_lens[:, 0, 7] = fx * 2 * x * y, fx * (r2 + 2 * x * x)
    by_lens[:, 1, 6], by_lens[:, 1, 7] = fy * (r2 + 2 * y * y), fy * 2 * x * y
    xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
    by_direction = np.stack((np.stack((fx * xx, fx * xy), -1), np.stack((fy * xy, fy * yy), -1)), axis=1)
    by_point = np.empty((len(points), 2, 3))
    by_point[:, :, :2] = by_direction / depth[:, None, None]
    by_point[:, :, 2] = -(by_direction @ np.stack((x, y), -1)[..., None])[..., 0] / depth[:, None]
    return pixels, by_lens, by_point


def rotation_of(vector: Array) -> Array:
    """(3, 3) rotation about a vector by its length, radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3) + _cross(vector)
    k = _cross(vector / angle)
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k), dtype=np.float64)


def vector_of(rotation: Array) -> Array:
    """The inverse of `rotation_of`, length at most pi."""
    import cv2  # noqa: PLC0415

    return np.asarray(cv2.Rodrigues(rotation)[0], dtype=np.float64).reshape(3)


def left_jacobian(vector: Array) -> Array:
    """(3, 3): how a rotation moves, seen from outside, with its vector (Chirikjian 2012, eq. 10.86)."""
    angle = float(np.linalg.norm(vector))
    k = _cross(vector)
    if angle < 1e-6:
        return np.asarray(np.eye(3) + 0.5 * k, dtype=np.float64)
    first, second = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + first * k + second * (k @ k), dtype=np.float64)


def turned_slopes(left: Array, turned: Array) -> Array:
    """(N, 3, 3): how points already turned move with their rotation's vector: -[R p]x times its `left_jacobian`.

    Args:
        left: (3, 3), or (N, 3, 3) one for each point.
        turned: (N, 3) mm.
    """
    crossed = np.zeros((len(turned), 3, 3))
    x, y, z = turned.T
    crossed[:, 0, 1], crossed[:, 0, 2] = -z, y
    crossed[:, 1, 0], crossed[:, 1, 2] = z, -x
    crossed[:, 2, 0], crossed[:, 2, 1] = -y, x
    return np.asarray(-crossed @ left, dtype=np.float64)


def _cross(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
