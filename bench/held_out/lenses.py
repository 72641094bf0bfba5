"""Pinhole lenses with Brown's distortion, written anew: what a check needs must not come from what it checks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Optic:
    """size (width, height) px; fx, fy, cx, cy px; k1, k2, p1, p2, k3."""

    size: tuple[int, int]
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def bend(self, x, y):
        """Undistorted to distorted directions."""
        k1, k2, p1, p2, k3 = self.distortion
        r = x * x + y * y
        scale = 1 + k1 * r + k2 * r**2 + k3 * r**3
        return (
            x * scale + 2 * p1 * x * y + p2 * (r + 2 * x * x),
            y * scale + p1 * (r + 2 * y * y) + 2 * p2 * x * y,
        )

    def directions(self, u, v):
        """Pixels to undistorted x / z, y / z, by fixed-point iteration (mild lenses: a dozen steps reach 1e-13)."""
        xt = (np.asarray(u, np.float64) - self.centre[0]) / self.focal[0]
        yt = (np.asarray(v, np.float64) - self.centre[1]) / self.focal[1]
        x, y = xt.copy(), yt.copy()
        for _ in range(25):
            bx, by = self.bend(x, y)
            x, y = x + (xt - bx), y + (yt - by)
        return x, y

    def pixels(self, points):
        """(..., 3) mm in the lens's frame to u, v px."""
        x, y = self.bend(points[..., 0] / points[..., 2], points[..., 1] / points[..., 2])
        return self.focal[0] * x + self.centre[0], self.focal[1] * y + self.centre[1]

    def described(self):
        """As calibration files have it."""
        (fx, fy), (cx, cy) = self.focal, self.centre
        return {
            "size": list(self.size),
            "matrix": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
            "distortion": list(self.distortion),
        }

    def scaled(self, factor):
        """The same lens before a sensor of another pitch."""
        size = tuple(round(n * factor) for n in self.size)
        real = tuple(s / n for s, n in zip(size, self.size, strict=True))
        focal = tuple(f * r for f, r in zip(self.focal, real, strict=True))
        centre = tuple((c + 0.5) * r - 0.5 for c, r in zip(self.centre, real, strict=True))
        return Optic(size, focal, centre, self.distortion)
