"""How good a calibrated rig's scans are: a flat board, a sphere, a length, in the words of VDI/VDE 2634 part 2.

Figures are of scans as they are, by the numbers: nothing is smoothed first. Of every feature three points in a
thousand may be left out, as the guideline allows; what is no part of the feature (background, a foot) is told apart by
its distance first, and the share of points used is reported. How sure the figures are is `figure_spread`'s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.calibration.balls import sphere_points
from scanner.calibration.detection import Detection, NotFound, detect
from scanner.calibration.features import (
    FEWEST_POINTS,
    Array,
    FeaturePoints,
    belonging,
    finite_points,
    plane_distance,
    plane_through,
    sphere_through,
    spread,
)
from scanner.calibration.repeat_spread import half_width
from scanner.calibration.targets import Target
from scanner.errors import DecodeError

WILD = 100.0
"""Times the others' variance that no noise has: of three scans, chi-square with two freedoms, one pixel in e^100"""
PRINT_STEP, PRINT_CONTRAST = 2, 0.2
"""Pixels over which print changes what a board reflects, and by how much of it at least"""
LEFT_OUT = 0.003
"""Share of points that may be left out (VDI/VDE 2634-2, 2012, sec. 6)."""
OF_SHELL = 0.05
"""Share that the shell of `Probing.shell_mm` leaves out (P_Form.Sph.D95% of ISO 10360-8:2013, and of -13:2021)."""


@dataclass(frozen=True)
class Flatness:
    """A flat board. flatness_mm: the distance between two parallel planes that hold 99.7 % of the points (F of the
    guideline); rms_mm: from the plane; bow_mm: depth of the best paraboloid over the board's half diagonal,
    above 0 where the rim is nearer to the camera than the middle."""

    flatness_mm: float
    rms_mm: float
    bow_mm: float
    tilt_deg: float
    distance_mm: float
    points: int
    used: float


@dataclass(frozen=True)
class Probing:
    """A sphere. form_mm: spread of the radial distances, 99.7 % of the points (PF); shell_mm: the same of 95 % (the
    dispersion of ISO 10360-8 and -13); size_mm: diameter less the stated one (PS), None where none was stated;
    rms_mm: of the radial distances; left_out: share of the points seen within the ball's outline that no figure
    contains, since they lie too far off it; another_mm: diameter of another ball in the scan, None where none is."""

    form_mm: float
    shell_mm: float
    size_mm: float | None
    diameter_mm: float
    rms_mm: float
    centre_mm: tuple[float, float, float]
    points: int
    used: float
    left_out: float
    another_mm: float | None = None


@dataclass(frozen=True)
class LengthError:
    """A length between two marks: measured less stated, and both, mm."""

    error_mm: float
    measured_mm: float
    stated_mm: float


@dataclass(frozen=True)
class Repeatability:
    """The same scene scanned several times. depth_mm: root mean square of the pixels' standard deviations;
    expanded_mm: its U, None for two scans; drift_mm: largest mean offset in depth of a scan from the mean of all."""

    depth_mm: float
    expanded_mm: float | None
    drift_mm: float
    scans: int
    points: int


def flat_board(xyz: NDArray[Any]) -> Flatness:
    """Measure a flat board.

    Args:
        xyz: (..., 3) mm, NaN where there is no point; the board is the largest plane in it.

    Raises:
        DecodeError: too few points.
    """
    return measured_board(board_points(xyz))


def board_points(xyz: NDArray[Any]) -> FeaturePoints:
    """The points of the largest plane. Args, Raises: as `flat_board`."""
    points, at = finite_points(xyz)
    used = belonging(points, plane_distance, 3)
    return FeaturePoints(points[used], at[used], float(used.mean()))


def measured_board(on: FeaturePoints) -> Flatness:
    """Measure a board by its points."""
    return Flatness(**board_figures(on.points), points=len(on.points), used=on.used)


def board_figures(on: Array) -> dict[str, float]:
    """What `Flatness` says of points (n, 3) of a board, by name."""
    centre, normal, axes = plane_through(on)
    # Towards the camera: bows of one sign are hollow, whichever way the fit took its normal.
    normal = normal if normal @ centre < 0 else -normal
    off = (on - centre) @ normal
    across = (on - centre) @ axes.T
    size = float(np.linalg.norm(across, axis=1).max())
    terms = np.column_stack(((across / size) ** 2, across, np.ones(len(on))))
    bend = np.linalg.solve(terms.T @ terms, terms.T @ off)[:2].mean()
    return {
        "flatness_mm": spread(off, LEFT_OUT),
        "rms_mm": float(np.sqrt((off**2).mean())),
        "bow_mm": float(bend),
        "tilt_deg": float(np.degrees(np.arccos(np.clip(abs(normal[2]), 0, 1)))),
        "distance_mm": float(abs(centre @ normal)),
    }


def plane_of(xyz: NDArray[Any]) -> tuple[Array, Array]:
    """A point of the largest plane in a scan, (3,) mm, and its unit normal towards the camera.

    Raises:
        DecodeError: too few points.
    """
    centre, normal, _ = plane_through(board_points(xyz).points)
    return centre, -np.sign(normal @ centre) * normal


def at_print(albedo: NDArray[Any], on: FeaturePoints) -> float:
    """Share of a feature's points that lie at an edge of brightness, as of print: blur mixes both sides there, and the
    phases of both. albedo: (H, W) of the scan."""
    level, there = np.asarray(albedo, np.float64), np.zeros(albedo.shape, bool)
    there.reshape(-1)[on.at] = True
    edges = points = 0
    for first, second in ((np.s_[PRINT_STEP:], np.s_[:-PRINT_STEP]), (np.s_[:, PRINT_STEP:], np.s_[:, :-PRINT_STEP])):
        both = there[first] & there[second]
        one, other = level[first][both], level[second][both]
        edges += int(np.count_nonzero(np.abs(one - other) > PRINT_CONTRAST * np.maximum(one, other)))
        points += one.size
    return edges / max(points, 1)


def sphere(xyz: NDArray[Any], diameter_mm: float | None = None) -> Probing:
    """Measure a sphere.

    Args:
        xyz: (..., 3) mm, NaN where there is no point.
        diameter_mm: the calibrated one; helps to find the sphere before a background.

    Raises:
        DecodeError: too few points, or nothing round of that size among them.
    """
    return measured_sphere(sphere_points(xyz, diameter_mm), diameter_mm)


def measured_sphere(on: FeaturePoints, diameter_mm: float | None = None) -> Probing:
    """Measure a sphere by its points."""
    figures = sphere_figures(on.points)
    x, y, z = (float(c) for c in sphere_through(on.points)[0])
    return Probing(
        **figures,
        size_mm=None if diameter_mm is None else figures["diameter_mm"] - diameter_mm,
        centre_mm=(x, y, z),
        points=len(on.points),
        used=on.used,
        left_out=on.left_out,
        another_mm=on.another_mm,
    )


def sphere_figures(on: Array) -> dict[str, float]:
    """What `Probing` says of points (n, 3) of a sphere, by name."""
    centre, radius = sphere_through(on)
    off = np.linalg.norm(on - centre, axis=1) - radius
    return {
        "form_mm": spread(off, LEFT_OUT),
        "shell_mm": spread(off, OF_SHELL),
        "diameter_mm": 2 * radius,
        "rms_mm": float(np.sqrt((off**2).mean())),
    }


def target_length(
    albedo: NDArray[Any], xyz: NDArray[Any], target: Target, length_mm: float | None = None
) -> LengthError:
    """Measure the longest row of a flat target's points in a scan of it.

    Args:
        albedo: (H, W) in which the target is found.
        xyz: (H, W, 3) mm.
        target: what was scanned.
        length_mm: that row's length as measured; None: as it should be.

    Raises:
        DecodeError: the target is not there, or the ends of its row have no points.
    """
    return length_between(target_ends(albedo, xyz, target)[1], target, length_mm)


def target_ends(albedo: NDArray[Any], xyz: NDArray[Any], target: Target) -> tuple[Detection, tuple[Array, Array]]:
    """What is seen of a target, and the ends of its longest row, (3,) mm each. Args, Raises: as `target_length`."""
    found = detect(albedo, target)
    if isinstance(found, NotFound):
        raise DecodeError(f"the target was not found: {found.reason}")
    ends = []
    for number in target.longest:
        at = np.flatnonzero(found.ids == number)
        point = local_point(xyz, found.points[at[0]]) if len(at) else None
        if point is None:
            raise DecodeError(
                f"point {number} at the end of the target's longest row has no scanned surface around it",
                hint="scan the whole target; points fall out where dark squares are lost: grey ones keep theirs",
            )
        ends.append(point)
    return found, (ends[0], ends[1])


def length_between(ends: tuple[Array, Array], target: Target, length_mm: float | None = None) -> LengthError:
    """The length between the ends of a target's longest row. length_mm: as in `target_length`."""
    measured = float(np.linalg.norm(ends[1] - ends[0]))
    stated = target.longest_mm if length_mm is None else length_mm
    return LengthError(measured - stated, measured, stated)


def repeatability(scans: Sequence[NDArray[Any]]) -> Repeatability:
    """Compare scans of one scene that did not move, pixel by pixel.

    Args:
        scans: two or more (H, W, 3) mm.

    Raises:
        DecodeError: they have different sizes, or no pixel has a point in all.
    """
    if len({scan.shape for scan in scans}) != 1:
        raise DecodeError("scans of different sizes cannot be compared pixel by pixel")
    depth = np.stack([scan[..., 2] for scan in scans]).astype(np.float64)
    common = np.isfinite(depth).all(axis=0)
    if common.sum() < FEWEST_POINTS:
        raise DecodeError(f"{int(common.sum())} pixels have a point in every scan, {FEWEST_POINTS} are needed")
    values = depth[:, common]
    variance = values.var(axis=0, ddof=1)
    kept = variance <= _wild(variance)
    drift = (values - values.mean(axis=0))[:, kept].mean(axis=1)
    return Repeatability(
        depth_mm=float(np.sqrt(variance[kept].mean())),
        expanded_mm=half_width(values[:, kept]),
        drift_mm=float(np.abs(drift).max()),
        scans=len(scans),
        points=int(kept.sum()),
    )


def _wild(variance: Array) -> float:
    """The most that is taken for noise: three pixels in a thousand may be left out here too, since one on a depth edge
    may belong to either side, but none that differs from the others as noise does."""
    most = float(np.quantile(variance, 1 - LEFT_OUT))
    return max(most, WILD * float(variance[variance <= most].mean()))


def local_point(xyz: NDArray[Any], at: Array, reach: int = 4) -> Array | None:
    """(3,) mm: the surface's point at a sub-pixel place of the picture, by a plane through the points around it.

    None where fewer than half of the pixels have a point.
    """
    found = local_weights(xyz, at, reach)
    if found is None:
        return None
    rows, columns, weights = found
    return np.asarray(weights @ xyz[rows, columns].astype(np.float64), dtype=np.float64)


def local_weights(
    xyz: NDArray[Any], at: Array, reach: int = 4
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array] | None:
    """(n,) rows, columns and weights of the points whose sum is `local_point`; None where there is none."""
    column, row = round(float(at[0])), round(float(at[1]))
    height, width = xyz.shape[:2]
    if not (reach <= column < width - reach and reach <= row < height - reach):
        return None
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    good = np.isfinite(xyz[row + v, column + u]).all(axis=1)
    if good.mean() < 0.5:
        return None
    rows, columns = row + v[good], column + u[good]
    terms = np.column_stack((np.ones(good.sum()), columns - at[0], rows - at[1]))
    return rows, columns, np.linalg.pinv(terms)[0]


def plain(result: Any) -> dict[str, Any]:
    """A result as plain data."""
    return asdict(result)
