"""Which points of a scan are a ball's, which ball it is where there are two, and what there is where there is none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.calibration.edges import NO_POINTS
from scanner.calibration.features import (
    FEWEST_POINTS,
    Array,
    FeaturePoints,
    belonging,
    finite_points,
    sphere_distance,
    sphere_through,
)
from scanner.errors import DecodeError

OTHER_SIZES = 1.2 ** np.arange(-5.0, 6.0)
"""Where there is no sphere of the diameter given, one of so many times that is looked for, each to a tenth: a radius
taken for a diameter, and scales that are wrong by as much"""
OTHER_SAMPLE = 4000
"""Points of a scan that are asked for it"""
OUTLINE = 0.9
"""Of a ball's radius: rays that pass it nearer than that see nothing else, however blurred its edge is."""
BESIDE = 1.3
"""Of a ball's radius: another one that touches it begins beyond, nearly, and its foot ends within"""
AS_SOUGHT = 0.15
"""Of the diameter by which a ball may differ from what it was looked for as: to a tenth, and what fitting adds"""
SAME_SIZE = 0.02
"""Of the diameter: as much as the best sphere through a hundred points is off"""
ROUND_SHARE = 0.02
"""Of its diameter, rms: what fits a sphere worse is something else that is round, as a head (4 to 7 %)"""


def sphere_points(xyz: NDArray[Any], diameter_mm: float | None = None) -> FeaturePoints:
    """The points of a sphere; of two, of the one whose diameter is nearer to what was stated.

    Args, Raises: as `verification.sphere`.
    """
    points, at = finite_points(xyz)
    found = _ball(points, diameter_mm)
    if found.count < FEWEST_POINTS or not found.round:
        raise _no_sphere(points, found.count if found.round else 0, diameter_mm)
    found, another = (found, None) if diameter_mm is None else _nearer(points, found, diameter_mm)
    seen, used = _within_outline(points, found, OUTLINE), found.used
    return FeaturePoints(
        points[used], at[used], float(used.mean()), float((seen & ~used).sum() / max(seen.sum(), 1)),
        None if another is None else another.diameter_mm,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Ball:
    """used: (n,) the points that lie on it; centre, radius, mm; rms_mm: of the points' distances from it."""

    used: NDArray[np.bool_]
    centre: Array
    radius: float
    rms_mm: float

    @property
    def count(self) -> int:
        return int(self.used.sum())

    @property
    def diameter_mm(self) -> float:
        return 2 * self.radius

    @property
    def round(self) -> bool:
        return self.rms_mm < ROUND_SHARE * self.diameter_mm


def _ball(points: Array, diameter_mm: float | None, among: NDArray[np.bool_] | None = None) -> _Ball:
    """The best ball of that diameter, to a tenth; among: (n,) points that it may have."""
    own = points if among is None else points[among]
    reach = 0.7 * diameter_mm if diameter_mm is not None else 0.3 * float(np.ptp(own, axis=0).max())
    used = belonging(own, sphere_distance(diameter_mm), 4, reach)
    if used.sum() < 4:
        return _Ball(np.zeros(len(points), bool), np.zeros(3), 0.0, float("inf"))
    centre, radius = sphere_through(own[used])
    rms = float(np.sqrt(np.mean((np.linalg.norm(own[used] - centre, axis=1) - radius) ** 2)))
    if among is not None:
        used = np.isin(np.arange(len(points)), np.flatnonzero(among)[used])
    return _Ball(used, centre, radius, rms)


def _nearer(points: Array, found: _Ball, diameter_mm: float) -> tuple[_Ball, _Ball | None]:
    """Of this ball and another one, clear of its outline, the one whose diameter is nearer; and the other, if any."""
    rest = ~_within_outline(points, found, BESIDE)
    another = _ball(points, diameter_mm, rest) if rest.sum() >= FEWEST_POINTS else None
    if another is None or another.count < FEWEST_POINTS or not another.round:
        return found, None
    swapped = abs(another.diameter_mm - diameter_mm) < abs(found.diameter_mm - diameter_mm)
    return (another, found) if swapped else (found, another)


def _within_outline(points: Array, ball: _Ball, share: float) -> NDArray[np.bool_]:
    """Points on rays from the camera, which is at 0, that pass a ball's middle within a share of its radius."""
    rays = points / np.linalg.norm(points, axis=1)[:, None]
    beside = np.linalg.norm(ball.centre - (rays @ ball.centre)[:, None] * rays, axis=1)
    return np.asarray(beside < share * ball.radius)


def _no_sphere(points: Array, on_best: int, diameter_mm: float | None) -> DecodeError:
    """The error for a sphere that is not there, with the one of another size that is. on_best: points on the best one,
    fewer than are needed; 0 where these are enough, and not round."""
    if diameter_mm is None:
        return DecodeError(f"no sphere among the points: {on_best} lie on the best one")
    few = points[:: -(-len(points) // OTHER_SAMPLE)]
    for other in sorted(diameter_mm * OTHER_SIZES, key=lambda size: abs(float(np.log(size / diameter_mm)))):
        seen = _ball(few, other)
        # What grew out of a plane's points is no ball, however well these lie on one of twenty metres.
        if seen.count >= FEWEST_POINTS // 5 and seen.round and abs(seen.diameter_mm / other - 1) < AS_SOUGHT:
            if on_best and abs(seen.diameter_mm / diameter_mm - 1) < SAME_SIZE:
                return DecodeError(
                    f"{on_best} points of the sphere of {diameter_mm:g} mm are too few to measure it by, "
                    f"{FEWEST_POINTS} are needed",
                    hint=NO_POINTS,
                )
            doubled = abs(seen.radius / diameter_mm - 1) < 0.1
            return DecodeError(
                f"no sphere of {diameter_mm:g} mm diameter among the points; there is one of {seen.diameter_mm:.2f} "
                f"mm ({seen.used.mean():.0%} of the points, {seen.rms_mm:.3f} mm rms)",
                hint="give its diameter, not its radius"
                if doubled
                else "is that its diameter, in mm? Else the scale of the calibration is wrong",
            )
    return DecodeError(
        f"no sphere of {diameter_mm:g} mm diameter among the points, and none of {OTHER_SIZES[0]:.1f} to "
        f"{OTHER_SIZES[-1]:.1f} times that",
        hint="if there is one, keep its surroundings out of the scan: fringed decode --box or --depth",
    )
