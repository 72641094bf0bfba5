"""Witness marks: fixed discs, or a fixed plate, in the field of view, measured once and again in each scan, mm.

They show what no scan can say of itself: a projector that pitches, a baseline that grows, a scale that changes. Marks
are discs, dark or light, on flat ground twice as wide as they are; a plate is a rectangle of the picture in which
nothing but it is seen. A mark that is hidden in a scan is said to be, and is no error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.bounded_files import read_small_json
from scanner.calibration.discs import disc_centres
from scanner.calibration.verification import local_point, plane_of
from scanner.errors import CalibrationError, DecodeError

Array = NDArray[np.float64]

FORMAT, VERSION = "fringed-marks", 1
FEWEST_MARKS = 3
MOST_MARKS = 100
MOST_RADIUS_PX = 1e4
WINDOW_PX = 60
"""Half width of the window in which a mark is looked for the first time; later three of its radii."""
GROUND = 2.0
"""Radii around a mark within which its ground's plane is fitted."""
IN_LINE = 0.05
"""Of marks' spread along a line: when they are no farther from it, what turns about it moves them by too little."""
AREA_RATIO = 1.3
"""By which a mark's area in the picture may differ from the reference's: one that is ten pixels across, and whose edge
another exposure moves by half a pixel. Of one that is smaller a part is hidden."""
TURN_SIGMAS = 4.0
"""By which a plate must have turned beyond noise: neighbouring points err alike, so that noise turns it by some more
than it is taken for."""
UNIT = 1e-3
"""By which a normal's length in a file may differ from 1."""
NOTABLE_SHARE = 1e-4
"""Of the distance: movement from which it is worth a warning, 0.13 mm at 1346 mm, a third of a projector pixel on
casey2011. Below, a disc's place in the picture (a twentieth of a pixel) and the scan's noise are as large."""


@dataclass(frozen=True)
class Mark:
    """One disc: its name, centre and radius in the picture, px, and its place, mm, camera frame."""

    name: str
    at: tuple[float, float]
    radius_px: float
    xyz: tuple[float, float, float]


@dataclass(frozen=True)
class Plate:
    """A flat plate: (x, y, width, height) px in the picture; a point of it and its unit normal, mm, camera frame."""

    region: tuple[int, int, int, int]
    point: tuple[float, float, float]
    normal: tuple[float, float, float]


@dataclass(frozen=True)
class Marks:
    """The reference: three marks or more, or a plate, or both. calibration: id of the one they were measured with."""

    points: tuple[Mark, ...] = ()
    plate: Plate | None = None
    calibration: str = ""

    @property
    def in_line(self) -> bool:
        """Whether there are no others than marks on a line, about which a rig may turn unseen."""
        if self.plate is not None:
            return False
        places = np.array([mark.xyz for mark in self.points])
        spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
        return bool(spread[1] < IN_LINE * spread[0])

    def as_dict(self) -> dict[str, Any]:
        """The file's content."""
        return {"format": FORMAT, "version": VERSION, "units": "mm", **asdict(self)}


def reference_marks(
    albedo: NDArray[Any],
    xyz: NDArray[Any],
    places: Sequence[tuple[float, float]],
    region: tuple[int, int, int, int] | None = None,
    calibration: str = "",
) -> Marks:
    """Measure marks for the first time.

    Args:
        albedo: (H, W) in which discs are seen.
        xyz: (H, W, 3) mm.
        places: camera px on or beside each disc.
        region: (x, y, width, height) px of a plate.
        calibration: id of the scan's.

    Raises:
        DecodeError: a disc or a plate is not there or has no points, a disc is given twice, or there are too few.
    """
    if len(places) < FEWEST_MARKS and region is None:
        raise DecodeError(f"{len(places)} marks are too few: give {FEWEST_MARKS} or more, or a plate")
    points: list[Mark] = []
    for number, place in enumerate(places, 1):
        found = _disc(albedo, np.array(place, dtype=np.float64), None)
        if found is None:
            raise DecodeError(
                f"no disc within {WINDOW_PX} px of ({place[0]:g}, {place[1]:g})",
                hint="marks are discs of one grey on another, ten pixels across or more",
            )
        centre, radius = found
        point = local_point(xyz, centre, _reach(radius))
        if point is None:
            raise DecodeError(
                f"the mark at ({centre[0]:.1f}, {centre[1]:.1f}) has no scanned surface around it",
                hint="half of its ground, twice as wide as the mark, must have points",
            )
        if any(np.hypot(*np.subtract(other.at, centre)) < radius for other in points):
            raise DecodeError(f"the disc at ({centre[0]:.1f}, {centre[1]:.1f}) is given twice", hint="give each once")
        points.append(Mark(str(number), _pair(centre), radius, _triple(point)))
    plate = None if region is None else Plate(region, *_plate(xyz, region))
    return Marks(tuple(points), plate, calibration)


def measured_marks(marks: Marks, albedo: NDArray[Any], xyz: NDArray[Any]) -> dict[str, Any]:
    """Measure them again in a scan: what report.json says of them.

    `points`: for each its movement, mm, or None where it is hidden; `rms_mm`, `largest_mm` over those seen;
    `as_a_whole_mm`, `shape_mm`: the mean movement, and what is left after the best turn and shift of three or more;
    `scale_ppm`: how much their distances have grown. `plate`: offset along its normal, mm, turn, mrad, and what
    both do at the edge of what is scanned, mm, without what noise turns it by.
    `allowed_mm`, and `warning`, None or in words.
    """
    each, before, now = [], [], []
    for mark in marks.points:
        found = _disc(albedo, np.array(mark.at), mark.radius_px)
        point = None if found is None else local_point(xyz, found[0], _reach(mark.radius_px))
        moved = None if point is None else point - mark.xyz
        each.append(
            {
                "name": mark.name,
                "moved_mm": None if moved is None else float(np.linalg.norm(moved)),
                "by_mm": None if moved is None else moved.tolist(),
            }
        )
        if point is not None:
            before.append(mark.xyz)
            now.append(point)
    content: dict[str, Any] = {"reference": marks.calibration, "points": each, "seen": len(now)}
    if now:
        content |= _movement(np.array(before), np.array(now))
    if marks.plate is not None:
        content["plate"] = _plate_moved(marks.plate, xyz)
    return content | _judged(marks, content)


def parse_marks(content: Any, name: str) -> Marks:
    """Marks from a file's content, checked.

    Raises:
        CalibrationError: it is no such content; `name` says where it stands.
    """
    mine = isinstance(content, Mapping) and content.get("format") == FORMAT and content.get("version") == VERSION
    if not mine or content.get("units", "mm") != "mm":
        raise CalibrationError(
            f"{name} is no {FORMAT} file of version {VERSION} in mm", hint="fringed calibrate marks makes one"
        )
    try:
        points = tuple(
            Mark(str(one["name"]), _pair(one["at"]), float(one["radius_px"]), _triple(one["xyz"]))
            for one in content.get("points") or ()
        )
        given = content.get("plate")
        plate = None
        if given is not None:
            x, y, width, height = (int(value) for value in given["region"])
            plate = Plate((x, y, width, height), _triple(given["point"]), _triple(given["normal"]))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise CalibrationError(f"{name}: points or plate are not as they should be ({error!r})") from error
    numbers = [value for mark in points for value in (*mark.at, mark.radius_px, *mark.xyz)]
    numbers += [*plate.point, *plate.normal] if plate is not None else []
    if (
        not np.isfinite(numbers).all()
        or len(points) > MOST_MARKS
        or not all(0 < mark.radius_px < MOST_RADIUS_PX for mark in points)
    ):
        raise CalibrationError(
            f"{name}: points must be finite, {MOST_MARKS} at most, their radii 0 .. {MOST_RADIUS_PX:g} px"
        )
    if plate is not None and (min(plate.region[2:]) < 1 or abs(float(np.linalg.norm(plate.normal)) - 1) > UNIT):
        raise CalibrationError(f"{name}: a plate needs a region of some width and height, and a normal of length 1")
    if any(np.linalg.norm(np.subtract(a.xyz, b.xyz)) == 0 for a, b in combinations(points, 2)):
        raise CalibrationError(f"{name}: two marks are at one place", hint="give each once")
    if len(points) < FEWEST_MARKS and plate is None:
        raise CalibrationError(f"{name} has {len(points)} marks and no plate: {FEWEST_MARKS} marks are needed")
    return Marks(points, plate, str(content.get("calibration", "")))


def load_marks(path: Path) -> Marks:
    """Read a file of marks.

    Raises:
        CalibrationError: it is not there, or no such file.
    """
    try:
        content = read_small_json(path)
    except OSError as error:
        raise CalibrationError(f"cannot read marks {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"marks {path} cannot be read as JSON: {error}") from error
    return parse_marks(content, f"marks {path}")


# --- measuring ------------------------------------------------------------------------------------------------------


def _disc(albedo: NDArray[Any], at: Array, radius: float | None) -> tuple[Array, float] | None:
    """(centre, radius) px of the disc nearest to a place; with a radius only one of that size."""
    half = WINDOW_PX if radius is None else max(round(3 * radius), 8)
    column, row = round(float(at[0])), round(float(at[1]))
    height, width = albedo.shape
    if not (0 <= column < width and 0 <= row < height):
        return None
    left, top = max(column - half, 0), max(row - half, 0)
    part = np.nan_to_num(np.asarray(albedo[top : row + half + 1, left : column + half + 1], dtype=np.float32))
    best = None
    low, high = np.percentile(part, (2, 98))
    grey = np.clip((part - low) * (255 / max(high - low, 1e-9)), 0, 255).astype(np.uint8)
    threshold, _ = cv2.threshold(grey, 0, 255, cv2.THRESH_OTSU)
    for mask in (grey <= threshold, grey > threshold):
        count, _, stats, centres = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
        for k in range(1, count):
            size = float(np.sqrt(stats[k, cv2.CC_STAT_AREA] / np.pi))
            if not _is_disc(stats[k], part.shape) or (radius is not None and not _like(size, radius)):
                continue
            away = float(np.linalg.norm(centres[k] + (left, top) - at))
            if best is None or away < best[0]:
                best = away, centres[k] + (left, top), size
    if best is None:
        return None
    _, coarse, size = best
    centre = disc_centres(np.nan_to_num(np.asarray(albedo, np.float32)), coarse[None], size * np.eye(2)[None])[0]
    return None if np.isnan(centre).any() else (centre, size)


def _is_disc(stats: NDArray[Any], shape: tuple[int, ...]) -> bool:
    """Whether a component is round, clear of the window's edge, and no speck."""
    x, y, width, height, area = (int(value) for value in stats)
    inside = x > 0 and y > 0 and x + width < shape[1] and y + height < shape[0]
    # A disc fills pi / 4 of its box however it is tilted about one of the box's sides.
    return inside and area >= 20 and 0.65 < area / (width * height) < 0.9 and 0.4 < width / height < 2.5


def _like(size: float, radius: float) -> bool:
    return 1 / AREA_RATIO < (size / radius) ** 2 < AREA_RATIO


def _reach(radius: float) -> int:
    return max(4, round(GROUND * radius))


def _plate(xyz: NDArray[Any], region: tuple[int, int, int, int]) -> tuple[tuple[float, float, float], ...]:
    """A point of the plate in a region, and its unit normal towards the camera."""
    point, normal = plane_of(_part(xyz, region))
    return _triple(point), _triple(normal)


def _part(xyz: NDArray[Any], region: tuple[int, int, int, int]) -> NDArray[Any]:
    x, y, width, height = region
    part = xyz[max(y, 0) : max(y + height, 0), max(x, 0) : max(x + width, 0)]
    if part.size == 0:
        raise DecodeError(f"the plate's region {region} lies outside the picture")
    return part


def _plate_moved(plate: Plate, xyz: NDArray[Any]) -> dict[str, Any]:
    try:
        point, normal = (np.array(each) for each in _plate(xyz, plate.region))
    except DecodeError as error:
        return {"offset_mm": None, "turn_mrad": None, "edge_mm": None, "why": str(error)}
    offset = float((np.array(plate.point) - point) @ normal)
    turn = float(np.arcsin(min(float(np.linalg.norm(np.cross(plate.normal, normal))), 1.0)))
    there = xyz[np.isfinite(xyz[..., 2])]
    # A rig that turned the plate has turned all that it scans; without a few points that are wrong.
    reach = float(np.percentile(np.linalg.norm(there - point, axis=-1), 95))
    sure = max(turn - TURN_SIGMAS * _turn_sigma(_part(xyz, plate.region), point, normal), 0.0)
    return {"offset_mm": -offset, "turn_mrad": 1e3 * turn, "edge_mm": abs(offset) + sure * reach}


def _turn_sigma(part: NDArray[Any], point: Array, normal: Array) -> float:
    """Rad that noise turns a plate's normal by, 1-sigma, here and in the reference alike."""
    points = part[np.isfinite(part[..., 2])] - point
    off = points @ normal
    noise = 1.4826 * float(np.median(np.abs(off - np.median(off))))
    across = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1]
    return float(np.sqrt(2) * noise / across)


def _movement(before: Array, now: Array) -> dict[str, Any]:
    moved = now - before
    content: dict[str, Any] = {
        "rms_mm": float(np.sqrt((moved**2).sum(axis=1).mean())),
        "largest_mm": float(np.linalg.norm(moved, axis=1).max()),
        "as_a_whole_mm": float(np.linalg.norm(moved.mean(axis=0))),
    }
    if len(now) < FEWEST_MARKS:
        return content
    a, b = before - before.mean(axis=0), now - now.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)  # Kabsch 1976
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    content["shape_mm"] = float(np.sqrt(((a @ turn - b) ** 2).sum(axis=1).mean()))
    content["scale_ppm"] = 1e6 * float(np.sqrt((b**2).sum() / (a**2).sum()) - 1)
    return content


def _judged(marks: Marks, content: Mapping[str, Any]) -> dict[str, Any]:
    places = [mark.xyz for mark in marks.points] + ([marks.plate.point] if marks.plate is not None else [])
    allowed = NOTABLE_SHARE * float(np.median(np.linalg.norm(places, axis=1)))
    moved = {"a witness mark": content.get("largest_mm", 0.0)}
    if marks.plate is not None:
        moved["the plate"] = content["plate"]["edge_mm"] or 0.0
    what = max(moved, key=lambda name: float(moved[name]))
    if moved[what] > allowed:
        warning: str | None = (
            f"{what} is off by {moved[what]:.3f} mm ({allowed:.3f} mm, a ten-thousandth of the distance, are let "
            "pass): the rig, or the mark, has moved since the reference was taken, or something hides a part of it"
        )
    else:
        warning = _too_little_seen(marks, content)
    return {"allowed_mm": allowed, "warning": warning}


def _too_little_seen(marks: Marks, content: Mapping[str, Any]) -> str | None:
    """What to say where less is seen than shows every movement."""
    seen, plate = content["seen"], content.get("plate")
    plate_seen = plate is not None and plate["edge_mm"] is not None
    if not seen and not plate_seen:
        of = [*(["witness marks"] if marks.points else []), *(["plate"] if plate is not None else [])]
        return f"nothing is seen of the {' and the '.join(of)}: nothing vouches for this scan's geometry{_why(plate)}"
    if plate is not None and not plate_seen:
        return f"the plate cannot be measured{_why(plate)}"
    if marks.points and seen < FEWEST_MARKS and not plate_seen:
        return (
            f"{seen} of {len(marks.points)} witness marks {'is' if seen == 1 else 'are'} seen: a turn about "
            f"{'it' if seen == 1 else 'their line'} does not show"
        )
    return None


def _why(plate: Mapping[str, Any] | None) -> str:
    return f" ({plate['why']})" if plate is not None and "why" in plate else ""


def _pair(values: Any) -> tuple[float, float]:
    x, y = (float(value) for value in values)
    return x, y


def _triple(values: Any) -> tuple[float, float, float]:
    if isinstance(values, str):
        raise TypeError(f"{values!r} is no list of numbers")
    x, y, z = (float(value) for value in values)
    return x, y, z
