"""A Scan: what decoding made of a capture, in maps on the camera's grid and points in millimetres, and its folder.

`build_scan` makes one from decoded maps and a calibration; `Scan.save` and `load_scan` write and read the folder of
formats.md (scan.npz, cloud.ply, preview.png, report.json). Pictures are drawn in `scanner.preview`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Decoded, Reason
from scanner.errors import StorageError
from scanner.filter_settings import FilterSettings
from scanner.filters import apply_filters
from scanner.geometry import Calibration
from scanner.normals import normals_of
from scanner.npz import read_npz
from scanner.scan_files import Progress, ScanWriter
from scanner.scan_report import DECODED, NOT_LIT, read_report, report_of, share
from scanner.storage import Digests
from scanner.triangulation import triangulate

Map = NDArray[np.float32]
Mask = NDArray[np.bool_]
Picture = NDArray[np.uint8]

_MAPS = ("rows", "columns", "sigma_rows", "sigma_columns", "sigma_z", "confidence", "albedo", "modulation")
_POINTS = ("xyz", "confidence")
"""First in scan.npz: what clients wait for"""
_DTYPES = {**dict.fromkeys((*_POINTS, *_MAPS), "<f4"), "reason": "u1", "stripes": "<i2", "peaks": "<f4"}


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan; maps are (H, W) float32 on the raw camera grid, NaN where there is nothing (formats.md, Scan)."""

    rows: Map | None
    columns: Map | None
    sigma_rows: Map | None
    sigma_columns: Map | None
    confidence: Map
    albedo: Map
    modulation: Map
    reason: NDArray[np.uint8]
    xyz: Map | None = None
    """(H, W, 3) float32 mm, camera frame; None without a calibration"""
    sigma_z: Map | None = None
    stripes: NDArray[np.int16] | None = None
    peaks: Map | None = None
    report: Mapping[str, Any] = field(default_factory=dict)
    """plain data, as report.json has it"""
    error_map: Picture | None = None
    """(h, w, 3) uint8 BGR: what comparison with truth drew, saved as error_map.png"""

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        height, width = self.reason.shape
        return height, width

    @cached_property
    def valid(self) -> Mask:
        """(H, W) bool: pixels with a point, or with a decoded value where there is no calibration."""
        return self.decoded if self.xyz is None else ~np.isnan(self.xyz[..., 2])

    @property
    def decoded(self) -> Mask:
        """(H, W) bool: pixels with a decoded value, whatever the filters did."""
        return _among(DECODED)[self.reason]

    @property
    def lit(self) -> Mask:
        """(H, W) bool: pixels that the projector's light reached, as far as the decoder could see."""
        return ~_among(NOT_LIT)[self.reason]

    @property
    def points(self) -> Map:
        """(N, 3) float32 mm, camera frame, line by line; N = 0 without a calibration."""
        return np.empty((0, 3), np.float32) if self.xyz is None else self.xyz[self.valid]

    @property
    def intensity(self) -> Map:
        """(N,) float32: albedo of each point, camera grey levels."""
        return self.albedo[self.valid]

    @cached_property
    def normals(self) -> Map | None:
        """(H, W, 3) float32, unit, towards the camera; see `scanner.normals`. None without a calibration."""
        return None if self.xyz is None else normals_of(self.xyz)

    @property
    def coverage(self) -> float:
        """Share of lit pixels with a decoded value; 0 if nothing is lit."""
        return share(np.count_nonzero(self.decoded), np.count_nonzero(self.lit))

    def with_report(self, **members: Any) -> Scan:
        """The same scan with more in its report."""
        return replace(self, report={**self.report, **members})

    def save(self, folder: Path, progress: Progress | None = None, digests: Digests | None = None) -> tuple[str, ...]:
        """Write the folder: scan.npz, cloud.ply, preview.png, (error_map.png,) report.json, each whole, in this order.

        report.json is last: a folder that has it is complete. Files of an earlier scan are removed first. A cloud
        without points gets no cloud.ply, and a warning in the report.

        Args:
            progress: told each file when it is whole. digests: makes its SHA-256, by its name.

        Returns:
            Names of the files written, in order.

        Raises:
            StorageError: the folder cannot be written.
        """
        with ScanWriter(folder, digests) as writer:
            return writer.write(self, progress)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The members of scan.npz, by name; those this scan has not are absent."""
        values = {name: getattr(self, name) for name in _DTYPES}
        return {name: np.asarray(value, dtype=_DTYPES[name]) for name, value in values.items() if value is not None}


def build_scan(
    decoded: Decoded,
    calibration: Calibration | None = None,
    filters: FilterSettings | None = None,
    *,
    timings: dict[str, float] | None = None,
    points: Callable[[Map], None] | None = None,
) -> Scan:
    """Triangulate and filter decoded maps.

    Args:
        decoded: the maps.
        calibration: the rig; None gives a scan without points.
        filters: None = `FilterSettings()`.
        timings: seconds by stage so far; this function's stages are added, and the report gets them all.
        points: takes xyz as soon as it is final, before the report is made; not without a calibration.

    Raises:
        CalibrationError: see `scanner.triangulation.triangulate`.
    """
    settings = filters or FilterSettings()
    timings = {} if timings is None else timings
    xyz = sigma_z = None
    reason = decoded.reason
    removed: dict[str, int] = {}
    if calibration is not None:
        found = filtered_points(decoded, calibration, settings, timings=timings)
        xyz, sigma_z, reason, removed = found.xyz, found.sigma_z, found.reason, found.removed
        if points is not None:
            points(xyz)
    scan = Scan(
        **{name: getattr(decoded, name) for name in _MAPS if name != "sigma_z"},
        reason=reason,
        xyz=xyz,
        sigma_z=sigma_z,
        stripes=decoded.stripes,
        peaks=decoded.peaks,
    )
    return replace(scan, report=report_of(scan, decoded, calibration, settings, removed, timings))


@dataclass(frozen=True, eq=False)
class FilteredPoints:
    """Points on the camera's grid, and why there is none: xyz (H, W, 3), sigma_z (H, W), reason (H, W) as in `Scan`."""

    xyz: Map
    sigma_z: Map
    reason: NDArray[np.uint8]
    removed: dict[str, int]
    """points that could not be, and those that each filter took"""


def filtered_points(
    decoded: Decoded,
    calibration: Calibration,
    settings: FilterSettings,
    *,
    timings: dict[str, float] | None = None,
) -> FilteredPoints:
    """Triangulate decoded maps and take out what the filters find.

    Raises:
        CalibrationError: see `scanner.triangulation.triangulate`.
    """
    timings = {} if timings is None else timings
    with _timed(timings, "triangulate"):
        found = triangulate(
            calibration,
            rows=decoded.rows,
            columns=decoded.columns,
            sigma_rows=decoded.sigma_rows,
            sigma_columns=decoded.sigma_columns,
        )
    with _timed(timings, "filter"):
        falls, removed = apply_filters(found.xyz, found.sigma_z, decoded.confidence, settings)
        fallen = np.flatnonzero(falls)
        found.xyz.reshape(-1, 3)[fallen] = np.nan
        found.sigma_z.reshape(-1)[fallen] = np.nan
        reason = decoded.reason.copy()
        reason[(reason == Reason.VALUE) & np.isnan(found.xyz[..., 2])] = Reason.FILTERED
    return FilteredPoints(found.xyz, found.sigma_z, reason, {"impossible": found.impossible, **removed})


def load_scan(folder: Path) -> Scan:
    """Read a scan's folder: scan.npz, and report.json if it is there.

    Raises:
        StorageError: scan.npz is missing or damaged, or its arrays do not belong together.
    """
    path = folder / "scan.npz"
    arrays = read_npz(path, _DTYPES)
    missing = {"confidence", "albedo", "modulation", "reason"} - arrays.keys()
    if missing or not arrays.keys() & {"rows", "columns"}:
        raise StorageError(f"{path} lacks {', '.join(sorted(missing)) or 'rows and columns'}: it is no scan")
    shape = arrays["reason"].shape
    for name, array in arrays.items():
        expected = {"xyz": (*shape, 3), "peaks": (*array.shape[:1], 5)}.get(name, shape)
        if len(shape) != 2 or array.shape != expected:
            raise StorageError(f"{path}: {name} has shape {array.shape}, expected {expected}")
    for name in ("rows", "columns", "sigma_rows", "sigma_columns"):
        arrays.setdefault(name, None)  # type: ignore[arg-type]
    return Scan(**arrays, report=read_report(folder / "report.json"))


def _among(kinds: tuple[Reason, ...]) -> Mask:
    """(256,) bool, to look reasons up in."""
    table = np.zeros(256, np.bool_)
    table[list(kinds)] = True
    return table


@contextmanager
def _timed(timings: dict[str, float], stage: str) -> Iterator[None]:
    begin = time.perf_counter()
    try:
        yield
    finally:
        timings[stage] = round(timings.get(stage, 0.0) + time.perf_counter() - begin, 6)
