"""Calibration targets as geometry: which points they have, and how they are named on the command line.

A target's frame: x right, y down, z away from the viewer, origin in the middle of its points, mm. Printing a target
is `target_svg`'s, finding it in a picture `detection`'s. A wedge or any other body with discs comes from a file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from scanner.bounded_files import read_small_json
from scanner.errors import ConfigError

Array = NDArray[np.float64]

Kind = Literal["chessboard", "charuco", "circles", "acircles", "wedge"]

FORMS = (
    "chessboard:COLUMNSxROWS:SQUARE (inner corners, mm)",
    "charuco:COLUMNSxROWS:SQUARE[:MARKER[:DICTIONARY]] (squares, mm)",
    "circles:COLUMNSxROWS:SPACING[:DIAMETER] (mm)",
    "acircles:COLUMNSxROWS:SPACING[:DIAMETER] (mm)",
    "wedge:FILE (discs in space)",
)
DISCS_FILE = (
    'a target in space is a file {"format": "fringed-target", "version": 1, "diameter_mm": 28, "points": [[x, y, z], '
    '...], "normals": [[x, y, z], ...]}, mm; without normals the discs\' centres take no correction for perspective'
)
"""What to say to who has none."""
MOST_POINTS_A_SIDE = 200
MARKER_SHARE = 0.75
"""Side of a marker over that of its square, where none is said: a module is then an eighth of a square."""
FEWEST_DISCS = 12
"""Of a target in space: 11 unknowns of the Hall model take 6 points, twice as many leave something to judge by."""


@dataclass(frozen=True, eq=False)
class Target:
    """One target. `points`: (N, 3) mm, in the order of its point numbers."""

    spec: str
    kind: Kind
    columns: int
    rows: int
    spacing_mm: float
    points: Array
    diameter_mm: float = 0.0
    """of discs; 0 for corners"""
    normals: Array | None = None
    """(N, 3) of discs in space; None: all along z"""
    marker_mm: float = 0.0
    dictionary: str = ""

    @property
    def flat(self) -> bool:
        """Whether all points lie in the plane z = 0."""
        return self.kind != "wedge"

    @property
    def discs(self) -> bool:
        """Whether the points are centres of discs, which perspective moves."""
        return self.diameter_mm > 0

    @property
    def same_when_turned(self) -> bool:
        """Whether a quarter turn makes it look the same, so that no picture tells its rows from its columns."""
        return self.kind in ("chessboard", "circles") and self.columns == self.rows

    @cached_property
    def half_extent(self) -> tuple[float, float]:
        """Half width and height of the field of points, mm."""
        spread = np.abs(self.points[:, :2]).max(axis=0)
        return float(spread[0]), float(spread[1])

    @cached_property
    def longest(self) -> tuple[int, int]:
        """Numbers of the first and last point of the longest straight side: what a rule is laid along."""
        if not self.flat:
            return 0, len(self.points) - 1
        x, y = self.half_extent
        side = 0 if x >= y else 1
        ends = self.points[:, [side, 1 - side]]
        first = int(np.lexsort((ends[:, 0], ends[:, 1]))[0])
        row = np.flatnonzero(np.abs(ends[:, 1] - ends[first, 1]) < 1e-9)
        return first, int(row[np.argmax(ends[row, 0])])

    @property
    def longest_mm(self) -> float:
        """Nominal distance of `longest`."""
        a, b = self.longest
        return float(np.linalg.norm(self.points[b] - self.points[a]))


def parse_target(text: str) -> Target:
    """The target that a command line names.

    Raises:
        ConfigError: not of one of FORMS, or sizes that make no target.
    """
    kind, _, rest = text.partition(":")
    if kind == "wedge" and rest:
        return load_discs(Path(rest))
    parts = rest.split(":")
    makers = {"chessboard": (_chessboard, 2, 2), "charuco": (_charuco, 2, 4), "circles": (_circles, 2, 3)}
    makers["acircles"] = (_asymmetric, 2, 3)
    if kind not in makers or not makers[kind][1] <= len(parts) <= makers[kind][2]:
        raise ConfigError(f"target {text!r} is of no known form", hint="; ".join(FORMS))
    columns, rows = _counts(parts[0], text)
    spacing = _length(parts[1], text)
    return makers[kind][0](text, columns, rows, spacing, parts[2:])


def load_discs(path: Path) -> Target:
    """Discs in space, from a file of the form that DISCS_FILE says.

    Raises:
        ConfigError: unreadable, or not such a file.
    """
    try:
        content = read_small_json(path)
    except OSError as error:
        raise ConfigError(f"cannot read target {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"target {path} cannot be read as JSON: {error}") from error
    if not isinstance(content, dict) or content.get("format") != "fringed-target" or content.get("version") != 1:
        raise ConfigError(f"target {path} is no fringed-target file of version 1", hint=DISCS_FILE)
    points = _vectors(content.get("points"), f"target {path}: points")
    if len(points) < FEWEST_DISCS:
        raise ConfigError(f"target {path} has {len(points)} points, a target in space needs {FEWEST_DISCS}")
    normals = content.get("normals")
    turned = None if normals is None else _vectors(normals, f"target {path}: normals")
    if turned is not None:
        if len(turned) != len(points):
            raise ConfigError(f"target {path}: {len(turned)} normals for {len(points)} points")
        lengths = np.linalg.norm(turned, axis=1, keepdims=True)
        if not lengths.all():
            raise ConfigError(f"target {path}: normal {int(lengths.argmin())}, from 0 on, has no direction")
        turned = turned / lengths
    diameter = content.get("diameter_mm", 0.0)
    if not isinstance(diameter, int | float) or not 0 < diameter < 1e4:
        raise ConfigError(f"target {path}: diameter_mm must be a length in mm, got {diameter!r}")
    near = np.linalg.norm(points[:, None] - points[None], axis=-1) + np.diag(np.full(len(points), np.inf))
    first, second = np.divmod(int(near.argmin()), len(points))
    if near[first, second] < diameter / 2:
        raise ConfigError(f"target {path}: points {first} and {second}, from 0 on, are the same disc")
    spacing = float(np.median(near.min(axis=1)))
    return Target(f"wedge:{path}", "wedge", len(points), 1, spacing, points, float(diameter), turned)


def _chessboard(spec: str, columns: int, rows: int, spacing: float, _: list[str]) -> Target:
    if min(columns, rows) < 3:
        raise ConfigError(f"target {spec!r}: a chessboard needs 3 x 3 inner corners or more")
    return Target(spec, "chessboard", columns, rows, spacing, _lattice(columns, rows, spacing))


def _charuco(spec: str, columns: int, rows: int, spacing: float, rest: list[str]) -> Target:
    import cv2  # noqa: PLC0415  (a name of its dictionaries)

    if min(columns, rows) < 3:
        raise ConfigError(f"target {spec!r}: a ChArUco board needs 3 x 3 squares or more")
    marker = _length(rest[0], spec) if rest else MARKER_SHARE * spacing
    if marker >= spacing:
        raise ConfigError(f"target {spec!r}: markers of {marker:g} mm do not fit squares of {spacing:g} mm")
    needed = columns * rows // 2
    dictionary = rest[1] if len(rest) > 1 else _dictionary_for(needed)
    if not (dictionary.startswith("DICT_") and hasattr(cv2.aruco, dictionary)):
        known = ", ".join(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
        raise ConfigError(f"target {spec!r}: no dictionary {dictionary!r}", hint=known)
    available = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)).bytesList)
    if needed > available:
        raise ConfigError(f"target {spec!r}: needs {needed} markers, {dictionary} has {available}")
    points = _lattice(columns - 1, rows - 1, spacing)
    return Target(spec, "charuco", columns, rows, spacing, points, marker_mm=marker, dictionary=dictionary)


def _circles(spec: str, columns: int, rows: int, spacing: float, rest: list[str]) -> Target:
    if min(columns, rows) < 3:
        raise ConfigError(f"target {spec!r}: a grid of circles needs 3 x 3 or more")
    diameter = _length(rest[0], spec) if rest else 0.5 * spacing
    if diameter >= spacing:
        raise ConfigError(f"target {spec!r}: circles of {diameter:g} mm overlap at {spacing:g} mm")
    return Target(spec, "circles", columns, rows, spacing, _lattice(columns, rows, spacing), diameter)


def _asymmetric(spec: str, columns: int, rows: int, spacing: float, rest: list[str]) -> Target:
    if columns < 2 or rows < 3:
        raise ConfigError(f"target {spec!r}: an asymmetric grid needs 2 columns and 3 rows or more")
    diameter = _length(rest[0], spec) if rest else 0.8 * spacing
    if diameter >= math.sqrt(2) * spacing:
        raise ConfigError(f"target {spec!r}: circles of {diameter:g} mm overlap")
    row, column = np.divmod(np.arange(columns * rows), columns)
    # OpenCV's convention: odd rows stand half a step to the right, neighbours in a row are two spacings apart.
    points = np.stack(((2 * column + row % 2) * spacing, row * spacing, 0.0 * row), axis=-1)
    points -= (points.max(axis=0) + points.min(axis=0)) / 2
    return Target(spec, "acircles", columns, rows, spacing, points, diameter)


def _lattice(columns: int, rows: int, spacing: float) -> Array:
    y, x = np.mgrid[:rows, :columns]
    points = np.stack((x - (columns - 1) / 2, y - (rows - 1) / 2, np.zeros_like(x)), axis=-1)
    return np.asarray(points.reshape(-1, 3) * spacing, dtype=np.float64)


def _dictionary_for(markers: int) -> str:
    return next((f"DICT_4X4_{size}" for size in (50, 100, 250) if markers <= size), "DICT_4X4_1000")


def _counts(text: str, spec: str) -> tuple[int, int]:
    columns, _, rows = text.partition("x")
    if not (columns.isdecimal() and rows.isdecimal()):
        raise ConfigError(f"target {spec!r}: expected COLUMNSxROWS, got {text!r}", hint="; ".join(FORMS))
    if max(int(columns), int(rows)) > MOST_POINTS_A_SIDE:
        raise ConfigError(f"target {spec!r}: more than {MOST_POINTS_A_SIDE} points a side")
    return int(columns), int(rows)


def _length(text: str, spec: str) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise ConfigError(f"target {spec!r}: expected a length in mm, got {text!r}") from error
    if not 1e-3 <= value <= 1e5:
        raise ConfigError(f"target {spec!r}: {text} mm is no length of a target")
    return value


def _vectors(content: Any, name: str) -> Array:
    try:
        array = np.asarray(content, dtype=np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise ConfigError(f"{name}: not a list of [x, y, z]") from error
    if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all():
        raise ConfigError(f"{name}: not a list of [x, y, z]")
    return array
