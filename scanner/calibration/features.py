"""Planes and spheres in points: which points belong to one, the best one through them, how far points spread about it.

What the figures are called and what may be left out of them is `verification`'s.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.calibration.edges import NO_POINTS
from scanner.errors import DecodeError

Array = NDArray[np.float64]

Distances = Callable[[Array, Array], Array | None]
"""Of points from the feature through some given ones; None where these make none"""

DRAWS = 400
"""Random planes or spheres among which the feature is looked for: it is missed once in 10^20 if half of the points
belong to it, and once in fifty if a fifth does."""
GROSS_SPREADS = 8.0
"""Distance from the feature, in units of the median one, from which a point belongs to something else."""
SAMPLE = 20_000
FEWEST_POINTS = 500
"""Of a feature that is measured"""


@dataclass(frozen=True, eq=False)
class FeaturePoints:
    """Of a scan, those that belong to one feature. points: (n, 3) mm; at: (n,) their places in the scan, flat; used:
    share of the scan's points; left_out: see `Probing`; another_mm: diameter of another ball in
    the scan, None where there is none."""

    points: Array
    at: NDArray[np.intp]
    used: float
    left_out: float = 0.0
    another_mm: float | None = None


def finite_points(xyz: NDArray[Any]) -> tuple[Array, NDArray[np.intp]]:
    """(n, 3) points, and (n,) their places in the scan.

    Raises:
        DecodeError: there are too few to measure anything by.
    """
    flat = np.asarray(xyz).reshape(-1, 3)
    at = np.flatnonzero(np.isfinite(flat).all(axis=1))
    points: Array = flat[at].astype(np.float64)
    if len(points) < FEWEST_POINTS:
        raise DecodeError(
            f"{len(points)} points are too few to measure a feature by, {FEWEST_POINTS} are needed", hint=NO_POINTS
        )
    return points, at


def spread(off: Array, left_out: float) -> float:
    """Smallest interval that holds all but this share of them."""
    ordered = np.sort(off)
    out = int(left_out * len(off))
    spans = ordered[len(off) - 1 - out :] - ordered[: out + 1]
    return float(spans.min())


def belonging(points: Array, distances: Distances, needed: int, reach: float = np.inf) -> NDArray[np.bool_]:
    """Points of the feature that most points are near to: the best of random ones, then gross ones out.

    Random ones are drawn within `reach` of each other: a ball is a small part of the wall it stands before.
    """
    generator = np.random.default_rng(2634)
    sample = points if len(points) <= SAMPLE else generator.choice(points, SAMPLE, replace=False)
    best, threshold = None, 0.01 * float(np.ptp(sample, axis=0).max())
    most = -1
    for _ in range(DRAWS):
        near = sample
        if np.isfinite(reach):
            near = sample[np.linalg.norm(sample - sample[generator.integers(len(sample))], axis=1) < reach]
        off = distances(generator.choice(near, needed, replace=False), sample) if len(near) >= needed else None
        if off is None:
            continue
        count = int((np.abs(off) < threshold).sum())
        if count > most:
            best, most = sample[np.abs(off) < threshold], count
    if best is None or len(best) < 4 * needed:
        return np.zeros(len(points), dtype=bool)
    used = np.zeros(len(points), dtype=bool)
    for _ in range(5):
        off = distances(best, points)
        if off is None:
            break
        typical = float(np.median(np.abs(off[np.abs(off) < threshold]))) if (np.abs(off) < threshold).any() else 0.0
        used = np.abs(off) < max(GROSS_SPREADS * 1.4826 * typical, 1e-6)
        best = points[used] if used.sum() <= SAMPLE else generator.choice(points[used], SAMPLE, replace=False)
    return used


def plane_through(points: Array) -> tuple[Array, Array, Array]:
    """Centre, unit normal, and two unit axes (2, 3) in the plane."""
    centre = points.mean(axis=0)
    _, vectors = np.linalg.eigh((points - centre).T @ (points - centre))
    return centre, vectors[:, 0], vectors[:, 1:].T


def plane_distance(given: Array, points: Array) -> Array:
    """Of points from the plane through given ones."""
    centre, normal, _ = plane_through(given)
    return np.asarray((points - centre) @ normal, dtype=np.float64)


def sphere_through(points: Array) -> tuple[Array, float]:
    """Centre and radius: algebraic start, then Gauss-Newton on the radial distances."""
    middle = points.mean(axis=0)
    q = points - middle
    terms = np.column_stack((2 * q, np.ones(len(q))))
    solution = np.linalg.lstsq(terms, (q**2).sum(axis=1), rcond=None)[0]
    centre = solution[:3]
    radius = float(np.sqrt(max(solution[3] + centre @ centre, 1e-12)))
    for _ in range(10 if len(points) > 4 else 0):
        away = q - centre
        length = np.linalg.norm(away, axis=1)
        jacobian = np.column_stack((-away / length[:, None], -np.ones(len(q))))
        step = np.linalg.lstsq(jacobian, -(length - radius), rcond=None)[0]
        centre, radius = centre + step[:3], radius + float(step[3])
        if np.abs(step).max() < 1e-9:
            break
    return middle + centre, radius


def sphere_distance(diameter_mm: float | None) -> Distances:
    """Of points from the sphere through given ones, if it has this diameter, to a tenth."""

    def distance(given: Array, points: Array) -> Array | None:
        centre, radius = sphere_through(given)
        if diameter_mm is not None and abs(2 * radius / diameter_mm - 1) > 0.1:
            return None
        return np.asarray(np.linalg.norm(points - centre, axis=1) - radius, dtype=np.float64)

    return distance
