"""How sure the figures of a verification are: standard uncertainties in the manner of the GUM (JCGM 100:2008).

Of each figure two parts. Calibration: the rig's covariance, propagated by drawing rigs that it allows (JCGM 101:2008)
and measuring the feature again in the points they would have given. Random: how much the figure changes with the points
that happen to be used (bootstrap, Efron 1979), as far as their errors are independent. Neither contains what the
feature itself is uncertain by, nor ripple that a response leaves: of form and flatness that is a part, seen as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.calibration.detection import Detection
from scanner.calibration.features import plane_through, sphere_through
from scanner.calibration.targets import Target
from scanner.calibration.verification import FeaturePoints, local_point, local_weights
from scanner.calibration_spread import PointSpread, point_spread
from scanner.geometry import Array, Calibration

COVERAGE_FACTOR = 2.0
DRAWS = 200
"""Of each kind: an uncertainty is good to 5 % by so many"""
POINTS = 2000
"""Of a feature that are measured again in each draw: the calibration moves neighbours alike"""
FEWEST_OF_TARGET = 12
"""Points of a target by which the places of its marks are judged: an affine map takes twelve numbers from 36"""
_SEED = 2634

Figures = Callable[[Array], Mapping[str, float]]
"""Of points (n, 3), by name"""


@dataclass(frozen=True)
class Spread:
    """Standard uncertainties of one figure, in its own unit; None: unknown."""

    random: float | None
    calibration: float | None

    @property
    def expanded(self) -> float | None:
        """U, k = 2; None where one of them is unknown."""
        if self.random is None or self.calibration is None:
            return None
        return COVERAGE_FACTOR * float(np.hypot(self.random, self.calibration))

    def as_dict(self) -> dict[str, float | None]:
        """For documents."""
        return {"random": self.random, "calibration": self.calibration, "expanded": self.expanded}


@dataclass(frozen=True, eq=False)
class Rig:
    """Whose scan it is: its calibration, and the axis whose coordinates told depth."""

    calibration: Calibration
    axis: str

    def spread(self, xyz: Array, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> PointSpread | None:
        """Of the points (n, 3) at pixels; None where the calibration has no covariance."""
        pixels = np.stack((columns, rows), axis=1).astype(np.float64)
        return point_spread(self.calibration, pixels, xyz, self.axis)


def spread_of_figures(on: FeaturePoints, width: int, figures: Figures, rig: Rig | None) -> dict[str, Spread]:
    """Of all figures of a feature, by name.

    Args:
        on: its points. width: of the scan, pixels. figures: how it is measured. rig: None where it is not known.
    """
    generator = np.random.default_rng(_SEED)
    chosen = generator.permutation(len(on.points))[:POINTS]
    points, at = on.points[chosen], on.at[chosen]
    share = np.sqrt(len(points) / len(on.points))
    again = [figures(points[generator.integers(len(points), size=len(points))]) for _ in range(DRAWS)]
    names = tuple(again[0])
    random = {name: float(share * np.std([one[name] for one in again], ddof=1)) for name in names}
    moves = None if rig is None else rig.spread(points, at // width, at % width)
    if moves is None:
        return {name: Spread(random[name], None) for name in names}
    as_is, others = figures(points), [figures(points + move) for move in moves.draws(DRAWS, _SEED)]
    # About the figure as it is: where it can but grow, as form can, its mean over the draws is off, too.
    off = {name: np.array([one[name] for one in others]) - as_is[name] for name in names}
    return {name: Spread(random[name], float(np.sqrt(np.mean(off[name] ** 2)))) for name in names}


def spread_of_length(found: Detection, target: Target, xyz: NDArray[np.float32], rig: Rig | None) -> Spread:
    """Of a target's longest row.

    Args:
        found: what is seen of the target; the ends of its row have points.
    """
    ends = [found.points[np.flatnonzero(found.ids == number)[0]] for number in target.longest]
    places = [local_point(xyz, end) for end in ends]
    if places[0] is None or places[1] is None:
        raise ValueError("the ends of the row have no points")
    along = (places[1] - places[0]) / np.linalg.norm(places[1] - places[0])
    random = _scatter_along(found, target, xyz, along)
    if rig is None:
        return Spread(random, None)
    slopes, covariance = [], None
    for end in ends:
        window = local_weights(xyz, end)
        moves = None if window is None else rig.spread(xyz[window[0], window[1]].astype(np.float64), *window[:2])
        if window is None or moves is None:
            return Spread(random, None)
        slopes.append(np.einsum("n,nik,i->k", window[2], moves.slopes, along))
        covariance = moves.covariance
    apart = slopes[1] - slopes[0]
    return Spread(random, float(np.sqrt(max(float(apart @ covariance @ apart), 0.0))))


def noise_alone(on: FeaturePoints, sigma_z: NDArray[np.float32], figures: Figures, *, round_: bool) -> dict[str, float]:
    """The figures that a perfect feature would have in this scan, by the sigmas of its points alone.

    Args:
        sigma_z: (H, W) mm of the scan. round_: a sphere, else a plane.
    """
    if round_:
        centre, radius = sphere_through(on.points)
        away = on.points - centre
        normals = away / np.linalg.norm(away, axis=1, keepdims=True)
        ideal = centre + radius * normals
    else:
        centre, normal, _ = plane_through(on.points)
        normals = np.broadcast_to(normal, on.points.shape)
        ideal = on.points - ((on.points - centre) @ normal)[:, None] * normal
    # A point moves along its ray: by as much of that as goes along the normal.
    across = np.abs((on.points / on.points[:, 2:] * normals).sum(axis=1))
    sigma = across * np.nan_to_num(sigma_z.reshape(-1)[on.at].astype(np.float64))
    off = sigma * np.random.default_rng(_SEED).normal(size=len(sigma))
    return dict(figures(ideal + off[:, None] * normals))


def _scatter_along(found: Detection, target: Target, xyz: NDArray[np.float32], along: Array) -> float | None:
    """1-sigma of the distance of two of a target's points along a direction, by how all of them fit an affine map.

    It contains where a mark is found in the picture, the noise of the points around it, and what the print is off.
    """
    places = [(number, local_point(xyz, at)) for number, at in zip(found.ids, found.points, strict=True)]
    kept = [(number, place) for number, place in places if place is not None]
    if len(kept) < FEWEST_OF_TARGET:
        return None
    wanted = target.points[[number for number, _ in kept]]
    terms = np.column_stack((wanted, np.ones(len(kept))))
    scanned = np.array([place for _, place in kept]) @ along
    solution, _, rank, _ = np.linalg.lstsq(terms, scanned, rcond=None)
    left = scanned - terms @ solution
    return float(np.sqrt(2 * (left @ left) / max(len(kept) - int(rank), 1)))
