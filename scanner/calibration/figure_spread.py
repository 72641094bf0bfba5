"""How sure the figures of a verification are: standard uncertainties in the manner of the GUM (JCGM 100:2008).

Of each figure two parts. Random: how much the figure changes with the points' own errors, as far as these are
independent: by order statistics for a width that holds a share of the points, else by the points that happen to be used
(bootstrap, Efron 1979). Calibration: the rig's covariance, propagated by drawing rigs that it allows (JCGM 101:2008)
and measuring the feature again in the points they would have given. Neither contains what the feature itself is
uncertain by, nor ripple that a response leaves: of form and flatness that is a part, seen as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, norm, qmc

from scanner.calibration.detection import Detection
from scanner.calibration.features import FeaturePoints, plane_through, sphere_through, spread
from scanner.calibration.targets import Target
from scanner.calibration.verification import (
    LEFT_OUT,
    OF_SHELL,
    board_figures,
    local_point,
    local_weights,
    sphere_figures,
)
from scanner.calibration_spread import PointSpread, point_spread
from scanner.geometry import Array, Calibration

COVERAGE_FACTOR = 2.0
COVERAGE = 0.9545
"""What two sigmas of a normal error hold"""
DRAWS = 300
"""Of each kind: a standard uncertainty is good to 4 % by so many"""
POINTS = 2000
"""Of a feature that are measured again in each draw: the calibration moves neighbours alike"""
WIDTH_DRAWS = 2048
"""Of rigs, for half-widths that hold COVERAGE of a width's growth; as evenly spread as Sobol's sequence has them (Owen
2003), so that another 2048 change its U by a per cent; 300 random ones by eight"""
WIDTH_POINTS = 20_000
"""Of a feature for that: of 2000 points six lie outside 99.7 %, and corners are missed, which move most"""
AT_ONCE = 64
"""Draws: ten megabytes"""
FEWEST_OF_TARGET = 12
"""Points of a target by which the places of its marks are judged: an affine map takes twelve numbers from 36"""
GRAZING_DEG = 70.0
"""Between a ray and the normal: beyond, a pixel sees three times its width of the surface"""
FEWEST_INNER = 100
LIKELY = 0.95
"""Of all rigs that a covariance allows: those whose parameters are not farther from the calibration's"""
_SEED = 2634

Figures = Callable[[Array], Mapping[str, float]]
"""Of points (n, 3), by name"""


@dataclass(frozen=True)
class Spread:
    """Standard uncertainties of one figure, in its own unit; None: unknown.

    reach: the half-width about the figure that holds COVERAGE of what the calibration makes of it, where that is not
    two standard uncertainties: calibrations that are off make form grow and never shrink. rim: bound of
    what points that are seen at grazing angles do to it, added to U as a bias that nothing corrects (JCGM 100:2008,
    F.2.4.5).
    """

    random: float | None
    calibration: float | None
    reach: float | None = None
    rim: float = 0.0

    @property
    def expanded(self) -> float | None:
        """U, k = 2; None where one of them is unknown."""
        if self.random is None or self.of_calibration is None:
            return None
        return float(np.hypot(COVERAGE_FACTOR * self.random, self.of_calibration)) + self.rim

    @property
    def of_calibration(self) -> float | None:
        """The calibration's part of U."""
        return COVERAGE_FACTOR * self.calibration if self.reach is None and self.calibration is not None else self.reach

    def as_dict(self) -> dict[str, float | None]:
        """For documents."""
        parts = {"random": self.random, "calibration": self.calibration, "expanded": self.expanded}
        return parts if self.rim == 0 else {**parts, "rim": self.rim}


@dataclass(frozen=True, eq=False)
class Rig:
    """Whose scan it is: its calibration, and the axis whose coordinates told depth."""

    calibration: Calibration
    axis: str

    def spread(self, xyz: Array, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> PointSpread | None:
        """Of the points (n, 3) at pixels; None where the calibration has no covariance."""
        pixels = np.stack((columns, rows), axis=1).astype(np.float64)
        return point_spread(self.calibration, pixels, xyz, self.axis)


@dataclass(frozen=True, eq=False)
class Deviations:
    """Of points from the feature through them. off: (n,) mm along normals, (n, 3); free: (n, f) what the feature's own
    place and size would add to `off`."""

    off: Array
    normals: Array
    free: Array


@dataclass(frozen=True, eq=False)
class Feature:
    """How a kind of feature is measured. widths: figures that are the width which holds all but a share of the
    deviations, with that share. of_rim: `Spread.rim` by points (n, 3), by name."""

    figures: Figures
    deviations: Callable[[Array], Deviations]
    widths: Mapping[str, float] = field(default_factory=dict)
    of_rim: Figures = lambda _: {}


def _from_plane(points: Array) -> Deviations:
    centre, normal, axes = plane_through(points)
    across = (points - centre) @ axes.T
    free = np.column_stack((np.ones(len(points)), across))
    return Deviations((points - centre) @ normal, np.broadcast_to(normal, points.shape), free)


def _from_sphere(points: Array) -> Deviations:
    centre, radius = sphere_through(points)
    away = points - centre
    length = np.linalg.norm(away, axis=1)
    normals = away / length[:, None]
    return Deviations(length - radius, normals, np.column_stack((np.ones(len(points)), normals)))


def _rim_of_sphere(points: Array) -> Mapping[str, float]:
    """Of its diameter: pixels that look along a surface see a stretch of it, whose middle their value is not.

    The error is the same in every scan. It is the difference to the sphere through the points that are not seen so.
    """
    centre, radius = sphere_through(points)
    facing = -((points - centre) * points).sum(axis=1) / (radius * np.linalg.norm(points, axis=1))
    inner = points[facing > np.cos(np.radians(GRAZING_DEG))]
    if len(inner) < FEWEST_INNER:
        return {}
    return {"diameter_mm": float(abs(2 * (sphere_through(inner)[1] - radius)))}


BOARD = Feature(board_figures, _from_plane, {"flatness_mm": LEFT_OUT})
SPHERE = Feature(sphere_figures, _from_sphere, {"form_mm": LEFT_OUT, "shell_mm": OF_SHELL}, _rim_of_sphere)


def spread_of_figures(on: FeaturePoints, width: int, feature: Feature, rig: Rig | None) -> dict[str, Spread]:
    """Of all figures of a feature, by name.

    Args:
        on: its points. width: of the scan, pixels. feature: its kind. rig: None where it is not known.
    """
    generator = np.random.default_rng(_SEED)
    points, _ = _some(on, POINTS)
    share = np.sqrt(len(points) / len(on.points))
    again = [feature.figures(points[generator.integers(len(points), size=len(points))]) for _ in range(DRAWS)]
    random = {name: float(share * np.std([one[name] for one in again], ddof=1)) for name in again[0]}
    off = feature.deviations(on.points).off
    random |= {name: _of_width(off, left_out) for name, left_out in feature.widths.items()}
    rim = feature.of_rim(on.points)
    points, at = _some(on, WIDTH_POINTS)
    moves = None if rig is None else rig.spread(points, at // width, at % width)
    if moves is None:
        return {name: Spread(random[name], None, rim=rim.get(name, 0.0)) for name in random}
    # What the calibration has done to the form is in the points already: drawn on top of it, it would count twice.
    points = points - _likely_part(moves, feature.deviations(points))
    few = slice(None, None, -(-len(points) // POINTS))
    of_rig = _of_rig(points[few], PointSpread(moves.slopes[few], moves.covariance), feature)
    of_rig |= _of_rig_in_widths(points, moves, feature)
    return {name: Spread(random[name], *of_rig[name], rim.get(name, 0.0)) for name in random}


def _some(on: FeaturePoints, most: int) -> tuple[Array, NDArray[np.intp]]:
    """So many of a feature's points, evenly, and their places."""
    chosen = np.linspace(0, len(on.points) - 1, min(most, len(on.points))).astype(np.intp)
    return on.points[chosen], on.at[chosen]


def _of_rig(points: Array, moves: PointSpread, feature: Feature) -> dict[str, tuple[float, float | None]]:
    """Of each figure what other rigs would make of it, rms, and the half-width that holds COVERAGE of that."""
    others = [points + move for move in moves.draws(DRAWS, _SEED)]
    alone, measured = feature.figures(points), [feature.figures(other) for other in others]
    found: dict[str, tuple[float, float | None]] = {}
    for name in alone:
        apart = np.abs([one[name] - alone[name] for one in measured])
        if name == "tilt_deg" and alone[name] < np.quantile(turned := _turned(points, others), COVERAGE):
            # The angle of a board that faces the camera but grows, whichever way its normal is off.
            apart = turned
        # Two standard deviations hold COVERAGE of what is as often too small, and are better known than its quantile.
        reach = float(np.quantile(apart, COVERAGE)) if name == "tilt_deg" else None
        found[name] = float(np.sqrt(np.mean(apart**2))), reach
    return found


def _of_rig_in_widths(points: Array, moves: PointSpread, feature: Feature) -> dict[str, tuple[float, float | None]]:
    """The same of widths and the rms, by deviations that depend on the rig in first order: more rigs in less time."""
    found = feature.deviations(points)
    u, s, _ = np.linalg.svd(_modes(moves, found), full_matrices=False)
    even = qmc.Sobol(len(s), scramble=False).random(WIDTH_DRAWS) + 0.5 / WIDTH_DRAWS
    numbers = np.asarray(norm.ppf(even), dtype=np.float64).T
    drawn = [_widths((found.off[:, None] + (u * s) @ part).T, feature) for part in _parts(numbers)]
    alone = _widths(found.off[None], feature)
    of_rig: dict[str, tuple[float, float | None]] = {}
    for name, value in alone.items():
        apart = np.abs(np.concatenate([one[name] for one in drawn]) - value)
        of_rig[name] = float(np.sqrt(np.mean(apart**2))), float(np.quantile(apart, COVERAGE))
    return of_rig


def _parts(numbers: Array) -> list[Array]:
    """Columns, AT_ONCE of them each."""
    return np.array_split(numbers, -(-numbers.shape[1] // AT_ONCE), axis=1)


def _widths(off: Array, feature: Feature) -> dict[str, Array]:
    """A feature's widths, and the rms, of rows (d, n) of deviations; (d,) each."""
    found = {"rms_mm": np.sqrt(np.mean(off**2, axis=1))}
    count = off.shape[1]
    for name, left_out in feature.widths.items():
        out = int(left_out * count)
        ends = np.partition(off, (out, count - 1 - out), axis=1)
        low, high = np.sort(ends[:, : out + 1], axis=1), np.sort(ends[:, count - 1 - out :], axis=1)
        found[name] = (high - low).min(axis=1)
    return found


def _turned(points: Array, others: list[Array]) -> Array:
    """Angles by which planes through other points are turned against the one through these, degrees."""
    normal = plane_through(points)[1]
    return np.degrees([np.arccos(min(1.0, abs(float(plane_through(one)[1] @ normal)))) for one in others])


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


def _of_width(off: Array, left_out: float) -> float:
    """1-sigma of the width that holds all but a share p of n independent deviations: sqrt(p (1 - p) / n) |dW / dp|.

    The number of points between two fixed limits is binomial, the width is the least of its kind, so that in first
    order only that number matters (as for quantiles, David and Nagaraja 2003, ch. 10); the slope is the points' own.
    """
    step = left_out / 3
    slope = (spread(off, left_out - step) - spread(off, left_out + step)) / (2 * step)
    return float(np.sqrt(left_out * (1 - left_out) / len(off)) * slope)


def _modes(moves: PointSpread, found: Deviations) -> Array:
    """(n, r) mm: what numbers of unit variance add to deviations from a feature that is fitted anew."""
    modes = np.einsum("nik,ni->nk", moves.slopes, found.normals) @ moves.root
    basis = np.linalg.qr(found.free)[0]
    return np.asarray(modes - basis @ (basis.T @ modes), dtype=np.float64)


def _likely_part(moves: PointSpread, found: Deviations) -> Array:
    """(n, 3) mm: what the calibration has moved points by, as far as their deviations show it and its covariance lets
    it be likely.

    Least squares with the covariance as what is known before (Tarantola 2005, ch. 3), the feature's place and size
    left free. A feature that is bent itself may look like a calibration that is off by many sigmas: no more is
    taken than a likely one.
    """
    basis = np.linalg.qr(found.free)[0]
    root, modes = moves.root, _modes(moves, found)
    left = found.off - basis @ (basis.T @ found.off)
    noise = float(np.mean(left**2))
    u, s, v = np.linalg.svd(modes, full_matrices=False)
    if noise <= 0 or not s.any():
        return np.zeros((len(left), 3))
    taken = (s / (s**2 + noise)) * (u.T @ left)
    seen = float(np.sum(s**2 / (s**2 + noise)))
    most = float(np.sqrt(chi2.ppf(LIKELY, seen)))
    taken *= min(1.0, most / max(float(np.linalg.norm(taken)), 1e-30))
    return np.asarray(np.einsum("nik,k->ni", moves.slopes, root @ (v.T @ taken)), dtype=np.float64)


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
