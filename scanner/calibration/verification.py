"""How good a calibrated rig's scans are: a flat board, a sphere, a length, in the words of VDI/VDE 2634 part 2.

Figures are of scans as they are, by the numbers: nothing is smoothed first. Of every feature three points in a
thousand may be left out, as the guideline allows; what is no part of the feature (background, a foot) is told apart by
its distance first, and the share of points used is reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.calibration.detection import NotFound, detect
from scanner.calibration.targets import Target
from scanner.errors import DecodeError

Array = NDArray[np.float64]

LEFT_OUT = 0.003
"""Share of points that may be left out (VDI/VDE 2634-2, 2012, sec. 6)."""
FEWEST_POINTS = 500
DRAWS = 400
"""Random planes or spheres among which the feature is looked for: it is missed once in 10^20 if half of the points
belong to it, and once in fifty if a fifth does."""
GROSS_SPREADS = 8.0
"""Distance from the feature, in units of the median one, from which a point belongs to something else."""
OTHER_SIZES = 1.2 ** np.arange(-5.0, 6.0)
"""Where there is no sphere of the diameter given, one of so many times that is looked for, each to a tenth: a radius
taken for a diameter, and scales that are wrong by as much"""
OTHER_SAMPLE = 4000
"""Points of a scan that are asked for it"""
ROUND_SHARE = 0.02
"""Of its diameter, rms: what fits a sphere worse is something else that is round, as a head (4 to 7 %)"""
SAMPLE = 20_000


@dataclass(frozen=True)
class Flatness:
    """A flat board. flatness_mm: the distance between two parallel planes that hold 99.7 % of the points (F of the
    guideline); rms_mm: from the plane; bow_mm: depth of the best paraboloid over the board's half diagonal."""

    flatness_mm: float
    rms_mm: float
    bow_mm: float
    tilt_deg: float
    distance_mm: float
    points: int
    used: float


@dataclass(frozen=True)
class Probing:
    """A sphere. form_mm: spread of the radial distances, 99.7 % of the points (PF); size_mm: diameter less the stated
    one (PS), None where none was stated; rms_mm: of the radial distances."""

    form_mm: float
    size_mm: float | None
    diameter_mm: float
    rms_mm: float
    centre_mm: tuple[float, float, float]
    points: int
    used: float


@dataclass(frozen=True)
class LengthError:
    """A length between two marks: measured less stated, and both, mm."""

    error_mm: float
    measured_mm: float
    stated_mm: float


@dataclass(frozen=True)
class Repeatability:
    """The same scene scanned several times. depth_mm: root mean square of the pixels' standard deviations;
    drift_mm: largest mean offset in depth of a scan from the mean of all."""

    depth_mm: float
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
    points = _finite(xyz)
    used = _belonging(points, _plane_distance, 3)
    on = points[used]
    centre, normal, axes = _plane(on)
    off = (on - centre) @ normal
    across = (on - centre) @ axes.T
    size = float(np.linalg.norm(across, axis=1).max())
    terms = np.column_stack(((across / size) ** 2, across, np.ones(len(on))))
    bend = np.linalg.lstsq(terms, off, rcond=None)[0][:2].mean()
    return Flatness(
        flatness_mm=_spread(off),
        rms_mm=float(np.sqrt((off**2).mean())),
        bow_mm=float(bend),
        tilt_deg=float(np.degrees(np.arccos(np.clip(abs(normal[2]), 0, 1)))),
        distance_mm=float(abs(centre @ normal)),
        points=len(on),
        used=float(used.mean()),
    )


def plane_of(xyz: NDArray[Any]) -> tuple[Array, Array]:
    """A point of the largest plane in a scan, (3,) mm, and its unit normal towards the camera.

    Raises:
        DecodeError: too few points.
    """
    points = _finite(xyz)
    centre, normal, _ = _plane(points[_belonging(points, _plane_distance, 3)])
    return centre, -np.sign(normal @ centre) * normal


def sphere(xyz: NDArray[Any], diameter_mm: float | None = None) -> Probing:
    """Measure a sphere.

    Args:
        xyz: (..., 3) mm, NaN where there is no point.
        diameter_mm: the calibrated one; helps to find the sphere before a background.

    Raises:
        DecodeError: too few points, or nothing round of that size among them.
    """
    points = _finite(xyz)
    reach = 0.7 * diameter_mm if diameter_mm is not None else 0.3 * float(np.ptp(points, axis=0).max())
    used = _belonging(points, _sphere_distance(diameter_mm), 4, reach)
    if used.sum() < FEWEST_POINTS:
        raise _no_sphere(points, int(used.sum()), diameter_mm)
    on = points[used]
    centre, radius = _sphere(on)
    off = np.linalg.norm(on - centre, axis=1) - radius
    rms = float(np.sqrt((off**2).mean()))
    if rms > ROUND_SHARE * 2 * radius:
        raise _no_sphere(points, 0, diameter_mm)
    x, y, z = (float(c) for c in centre)
    return Probing(
        form_mm=_spread(off),
        size_mm=None if diameter_mm is None else 2 * radius - diameter_mm,
        diameter_mm=2 * radius,
        rms_mm=rms,
        centre_mm=(x, y, z),
        points=len(on),
        used=float(used.mean()),
    )


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
    # Three pixels in a thousand may be left out here too: one on a depth edge may belong to either side.
    kept = variance <= np.quantile(variance, 1 - LEFT_OUT)
    drift = (values - values.mean(axis=0))[:, kept].mean(axis=1)
    return Repeatability(
        depth_mm=float(np.sqrt(variance[kept].mean())),
        drift_mm=float(np.abs(drift).max()),
        scans=len(scans),
        points=int(kept.sum()),
    )


def local_point(xyz: NDArray[Any], at: Array, reach: int = 4) -> Array | None:
    """(3,) mm: the surface's point at a sub-pixel place of the picture, by a plane through the points around it.

    None where fewer than half of the pixels have a point.
    """
    column, row = round(float(at[0])), round(float(at[1]))
    height, width = xyz.shape[:2]
    if not (reach <= column < width - reach and reach <= row < height - reach):
        return None
    window = np.s_[row - reach : row + reach + 1, column - reach : column + reach + 1]
    values = xyz[window].reshape(-1, 3).astype(np.float64)
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).astype(np.float64)
    good = np.isfinite(values).all(axis=1)
    if good.mean() < 0.5:
        return None
    terms = np.column_stack((np.ones(good.sum()), u[good] + column - at[0], v[good] + row - at[1]))
    return np.asarray(np.linalg.lstsq(terms, values[good], rcond=None)[0][0], dtype=np.float64)


def plain(result: Any) -> dict[str, Any]:
    """A result as plain data."""
    return asdict(result)


def _finite(xyz: NDArray[Any]) -> Array:
    flat = np.asarray(xyz).reshape(-1, 3)
    points: Array = flat[np.isfinite(flat).all(axis=1)].astype(np.float64)
    if len(points) < FEWEST_POINTS:
        raise DecodeError(f"{len(points)} points are too few to measure a feature by, {FEWEST_POINTS} are needed")
    return points


def _spread(off: Array) -> float:
    """Smallest interval that holds all but the share that may be left out."""
    ordered = np.sort(off)
    out = int(LEFT_OUT * len(off))
    spans = ordered[len(off) - 1 - out :] - ordered[: out + 1]
    return float(spans.min())


def _belonging(points: Array, distances: Any, needed: int, reach: float = np.inf) -> NDArray[np.bool_]:
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


def _plane(points: Array) -> tuple[Array, Array, Array]:
    """Centre, unit normal, and two unit axes (2, 3) in the plane."""
    centre = points.mean(axis=0)
    _, vectors = np.linalg.eigh((points - centre).T @ (points - centre))
    return centre, vectors[:, 0], vectors[:, 1:].T


def _plane_distance(given: Array, points: Array) -> Array:
    centre, normal, _ = _plane(given)
    return np.asarray((points - centre) @ normal, dtype=np.float64)


def _sphere(points: Array) -> tuple[Array, float]:
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


def _no_sphere(points: Array, on_best: int, diameter_mm: float | None) -> DecodeError:
    """The error for a sphere that is not there, with the one of another size that is."""
    if diameter_mm is None:
        return DecodeError(f"no sphere among the points: {on_best} lie on the best one")
    few = points[:: -(-len(points) // OTHER_SAMPLE)]
    for other in sorted(diameter_mm * OTHER_SIZES, key=lambda size: abs(float(np.log(size / diameter_mm)))):
        used = _belonging(few, _sphere_distance(other), 4, 0.7 * other)
        if used.sum() < FEWEST_POINTS // 5:
            continue
        centre, radius = _sphere(few[used])
        rms = float(np.sqrt(np.mean((np.linalg.norm(few[used] - centre, axis=1) - radius) ** 2)))
        if rms < ROUND_SHARE * 2 * radius:
            doubled = abs(radius / diameter_mm - 1) < 0.1
            return DecodeError(
                f"no sphere of {diameter_mm:g} mm diameter among the points; there is one of {2 * radius:.2f} mm "
                f"({used.mean():.0%} of the points, {rms:.3f} mm rms)",
                hint="give its diameter, not its radius"
                if doubled
                else "is that its diameter, in mm? Else the scale of the calibration is wrong",
            )
    return DecodeError(
        f"no sphere of {diameter_mm:g} mm diameter among the points, and none of {OTHER_SIZES[0]:.1f} to "
        f"{OTHER_SIZES[-1]:.1f} times that",
        hint="keep its surroundings out of the scan: fringed decode --box or --depth",
    )


def _sphere_distance(diameter_mm: float | None) -> Any:
    def distance(given: Array, points: Array) -> Array | None:
        centre, radius = _sphere(given)
        if diameter_mm is not None and abs(2 * radius / diameter_mm - 1) > 0.1:
            return None
        return np.asarray(np.linalg.norm(points - centre, axis=1) - radius, dtype=np.float64)

    return distance
