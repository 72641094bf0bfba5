"""Surface normals of an organised cloud: the cross product of the differences along lines and columns.

They see one pixel to each side and are as noisy as that makes them; nothing is smoothed.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from scanner.kernel import kernel

Map = NDArray[np.float32]


def normals_of(xyz: Map) -> Map:
    """Unit normals, towards the camera.

    Central differences; one-sided where one neighbour is missing.

    Args:
        xyz: (H, W, 3) float32 mm, camera frame, NaN = no point.

    Returns:
        (H, W, 3) float32; NaN where a point has no neighbour along its line or none along its column.
    """
    normals = np.empty(xyz.shape, np.float32)
    _cross_differences(np.ascontiguousarray(xyz, dtype=np.float32), normals)
    return normals


def warm_up() -> None:
    """Compile the kernel."""
    normals_of(np.ones((2, 2, 3), np.float32))


@kernel
def _cross_differences(xyz: Map, normals: Map) -> None:
    height, width = xyz.shape[:2]
    for i in range(height):
        for j in range(width):
            z = xyz[i, j, 2]
            normals[i, j, 0] = normals[i, j, 1] = normals[i, j, 2] = np.nan
            if math.isnan(z):
                continue
            left, right = max(j - 1, 0), min(j + 1, width - 1)
            above, below = max(i - 1, 0), min(i + 1, height - 1)
            left = j if math.isnan(xyz[i, left, 2]) else left
            right = j if math.isnan(xyz[i, right, 2]) else right
            above = i if math.isnan(xyz[above, j, 2]) else above
            below = i if math.isnan(xyz[below, j, 2]) else below
            if left == right or above == below:
                continue
            ux, uy = xyz[i, right, 0] - xyz[i, left, 0], xyz[i, right, 1] - xyz[i, left, 1]
            vx, vy = xyz[below, j, 0] - xyz[above, j, 0], xyz[below, j, 1] - xyz[above, j, 1]
            uz, vz = xyz[i, right, 2] - xyz[i, left, 2], xyz[below, j, 2] - xyz[above, j, 2]
            nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            square = nx * nx + ny * ny + nz * nz
            if not square > 0.0:
                continue
            # Lines run right and columns down, so the cross product points away from the camera unless noise turns it.
            away = nx * xyz[i, j, 0] + ny * xyz[i, j, 1] + nz * z
            scale = (-1.0 if away > 0.0 else 1.0) / math.sqrt(square)
            normals[i, j, 0], normals[i, j, 1], normals[i, j, 2] = nx * scale, ny * scale, nz * scale
