"""One scan verified: every feature that is asked for, measured, and how sure its figures are. Plain data comes out.

The scan's calibration is the one that its capture keeps, if it has the name that the report has and its points are
those of the scan; another one would give uncertainties of another rig.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scanner.calibration.edges import edge_width
from scanner.calibration.figure_spread import (
    BOARD,
    COVERAGE_FACTOR,
    SPHERE,
    Feature,
    Rig,
    noise_alone,
    spread_of_figures,
    spread_of_length,
)
from scanner.calibration.markers import of_another_kind
from scanner.calibration.marks import Marks, measured_marks
from scanner.calibration.targets import Target
from scanner.calibration.verification import (
    LEFT_OUT,
    FeaturePoints,
    board_points,
    length_between,
    measured_board,
    measured_sphere,
    plain,
    sphere_points,
    target_ends,
)
from scanner.capture import Capture
from scanner.contrast import sigma_z_that_scatters
from scanner.errors import DecodeError, ScannerError
from scanner.geometry import Calibration, load_calibration
from scanner.scan import Scan
from scanner.stated_length import stated_length_of

SIMULATED = "simulated-"
"""Begins the ids of calibrations that are the true ones of simulated rigs; one that is changed gets its hash"""
SAME_PX = 0.05
"""Px by which points may miss their pixels of the camera, and their projector's coordinates, under the scan's own
calibration: float32 leaves a thousandth. Points of both axes lie between the two: noise, as it is stated, comes on
top."""

FEW_USED = 0.9
"""Share of a scan's points that features explain, below which a board's figures may be of a part of it: of a plain
board that fills the scan it is 99.9 %"""
NOISE_OF = {"flatness_mm": "noise_mm", "form_mm": "noise_mm", "shell_mm": "shell_noise_mm"}
"""What a figure is called that noise alone would make of a perfect feature"""

BY_PIXEL = ("pmp", "gray+pmp")
"""Methods that decode each pixel by itself. Others' sigmas are of cells, or of relief between stripes, which are no
noise: a simulated board would be said to have 1.6 (Gray code) and 6 times (MCP) the flatness by noise that it has"""


@dataclass(frozen=True)
class Wanted:
    """What is to be measured in each scan."""

    flat: bool = False
    sphere_mm: float | None = None
    target: Target | None = None
    length_mm: float | None = None
    marks: Marks | None = None
    edge: tuple[int, int, int, int] | None = None


def verified(folder: Path, scan: Scan, wanted: Wanted, given: Path | None = None) -> dict[str, Any]:
    """The figures of one scan, by kind, each with its uncertainties; and what these leave out.

    Args:
        folder: of the scan. given: a calibration file to take in place of its capture's.

    Raises:
        DecodeError: the scan has no points, or none of a feature; the edge lies beyond the picture.
        CalibrationError: the calibration file given cannot be read, or is not the scan's.
    """
    if scan.xyz is None:
        raise DecodeError(f"{folder} has no points", hint="decode it with a calibration: fringed decode --calibration")
    found: dict[str, Any] = {}
    rig, why = rig_of(folder, scan, given)
    if wanted.edge is not None:
        _require_within(wanted.edge, scan)
    if wanted.flat:
        board = board_points(scan.xyz)
        found["flat"] = plain(measured_board(board)) | _of_noise(board, scan, BOARD, rig)
        found["flat"]["uncertainty"] = _spreads(spread_of_figures(board, scan.shape[1], BOARD, rig))
    if wanted.sphere_mm is not None:
        ball = sphere_points(scan.xyz, wanted.sphere_mm)
        spreads = _spreads(spread_of_figures(ball, scan.shape[1], SPHERE, rig))
        found["sphere"] = plain(measured_sphere(ball, wanted.sphere_mm)) | _of_noise(ball, scan, SPHERE, rig)
        found["sphere"]["uncertainty"] = {**spreads, "size_mm": spreads["diameter_mm"]}
    if wanted.target is not None:
        seen, ends = target_ends(scan.albedo, scan.xyz, wanted.target)
        of_length = spread_of_length(seen, wanted.target, scan.xyz, rig).as_dict()
        found["length"] = plain(length_between(ends, wanted.target, wanted.length_mm))
        found["length"]["uncertainty"] = {"error_mm": of_length, "measured_mm": of_length}
    if found:
        found["coverage_factor"], found["unknown"] = COVERAGE_FACTOR, why
        another = None if wanted.target is None else of_another_kind(scan.albedo, wanted.target)
        kept = () if rig is None or given is not None else rig.calibration.warnings
        found["warnings"] = [*_warnings(found), *filter(None, [another]), *kept]
        found["stated_length"] = None if rig is None or why is not None else _of_stated(found, rig)
    if wanted.edge is not None:
        x, y, width, height = wanted.edge
        found["edge"] = plain(edge_width(scan.xyz[y : y + height, x : x + width]))
    if wanted.marks is not None:
        found["marks"] = measured_marks(wanted.marks, scan.albedo, scan.xyz)
    return found


def _require_within(part: tuple[int, int, int, int], scan: Scan) -> None:
    """Raise DecodeError for a part of the picture that reaches beyond it."""
    x, y, width, height = part
    rows, columns = scan.shape
    if x + width > columns or y + height > rows:
        raise DecodeError(
            f"--edge {x},{y},{width},{height} reaches to column {x + width - 1} and row {y + height - 1}, and the "
            f"scan's picture ends at {columns - 1} and {rows - 1}",
            hint="X,Y is the upper left corner, W,H the width and height, camera pixels counted from 0",
        )


def _warnings(found: dict[str, Any]) -> list[str]:
    """What the figures do not say of themselves."""
    warnings = []
    used = sum(found[kind]["used"] for kind in ("flat", "sphere") if kind in found)
    if "flat" in found and used < FEW_USED:
        warnings.append(
            f"the board's figures are of {found['flat']['used']:.0%} of the scan's points: the others lie off its "
            "plane by more than eight times the usual. Is all of it one board? Keep what is not out of the scan "
            "(fringed decode --box or --depth), or it is bent or broken by more than these figures say"
        )
    if "sphere" in found and found["sphere"]["left_out"] > LEFT_OUT:
        warnings.append(
            f"{found['sphere']['left_out']:.1%} of the points within the ball's outline lie off it by more than eight "
            "times the usual, and are in none of its figures: form and size are no PF and PS of VDI/VDE 2634-2, which "
            "leaves three points in a thousand out. Wrong fringes or stripes do this, or something before the ball"
        )
    return warnings


def rig_of(folder: Path, scan: Scan, given: Path | None = None) -> tuple[Rig | None, str | None]:
    """The scan's rig, and why the calibration's part is not known, in words; None where it is.

    Raises:
        CalibrationError: see `verified`.
    """
    calibration = load_calibration(given) if given is not None else _kept(folder, scan)
    if calibration is None:
        return None, "the scan's folder has no calibration of the name that its report has: --calibration FILE"
    axis = calibration.phase_axis if scan.rows is not None and scan.columns is not None else None
    rig = Rig(calibration, axis or ("y" if scan.rows is not None else "x"))
    if not _made_by(rig, scan):
        return None, f"the scan's points were not made by calibration {calibration.id or given} as it stands"
    if calibration.extra.get("covariance") is None:
        simulated = calibration.id.startswith(SIMULATED)
        return rig, f"the calibration has no covariance{' (the true one of a simulated rig)' if simulated else ''}"
    return rig, None


def _kept(folder: Path, scan: Scan) -> Calibration | None:
    """The calibration that the scan's capture names, in the scan's folder or around it."""
    name = (scan.report.get("rig") or {}).get("calibration")
    for place in (folder / "capture", folder.resolve().parent):
        try:
            path = Capture.open(place).calibration_path
            found = None if path is None else load_calibration(path)
        except ScannerError:
            continue  # no capture, or another one: there is nothing to know of it
        if found is not None and found.id == name:
            return found
    return None


def _made_by(rig: Rig, scan: Scan) -> bool:
    """Whether points are seen by the camera at their pixels, and by the projector where their coordinates say."""
    values, sigmas = (scan.rows, scan.sigma_rows) if rig.axis == "y" else (scan.columns, scan.sigma_columns)
    if scan.xyz is None or values is None or scan.shape != rig.calibration.camera.size[::-1]:
        return False
    there = np.flatnonzero(scan.valid & np.isfinite(values))
    if not there.size:
        return False
    at = there[np.linspace(0, there.size - 1, min(200, there.size)).astype(np.intp)]
    points = scan.xyz.reshape(-1, 3)[at]
    pixels = np.stack((at % scan.shape[1], at // scan.shape[1]), axis=1)
    missed = np.linalg.norm(rig.calibration.camera.project(points.astype(np.float64)) - pixels, axis=1)
    if not np.median(missed) < SAME_PX:
        return False
    seen = rig.calibration.projector.project(rig.calibration.to_projector(points))[:, 1 if rig.axis == "y" else 0]
    noise = 0.0 if sigmas is None else float(np.nanmedian(sigmas.reshape(-1)[at]))
    return bool(np.median(np.abs(seen - values.reshape(-1)[at])) < SAME_PX + noise)


def _of_noise(on: FeaturePoints, scan: Scan, feature: Feature, rig: Rig | None) -> dict[str, Any]:
    """Its widths, of a perfect feature in this noise, where that is known."""
    by_pixel = (scan.report.get("decoder") or {}).get("method") in BY_PIXEL
    sigma = sigma_z_that_scatters(scan, "y" if rig is None else rig.axis) if by_pixel else None
    alone = None if sigma is None else noise_alone(on, sigma, feature, independent=True)
    return {NOISE_OF[name]: None if alone is None else alone[name] for name in feature.widths}


IN_WORDS = {
    "distance_mm": "the board's distance from the camera",
    "diameter_mm": "the sphere's diameter",
    "measured_mm": "the length between the target's ends",
}
"""Figures that are in proportion to the calibration's scale"""


def _of_stated(found: dict[str, Any], rig: Rig) -> dict[str, Any] | None:
    """The calibration's stated length, the largest share that it has of a figure's variance, and of which."""
    stated = stated_length_of(rig.calibration.extra.get("scale"))
    if stated is None:
        return None
    shares = [
        (stated.share(found[kind][name], found[kind]["uncertainty"][name]["expanded"] / COVERAGE_FACTOR), kind, name)
        for kind, name in (("flat", "distance_mm"), ("sphere", "diameter_mm"), ("length", "measured_mm"))
        if kind in found and found[kind]["uncertainty"][name]["expanded"] is not None
    ]
    if not shares:
        return None
    share, kind, name = max(shares)
    of = f"{IN_WORDS[name]}, {found[kind][name]:.1f} mm"
    return {"reference_mm": stated.reference_mm, "sigma_mm": stated.sigma_mm, "share": share, "of": of}


def _spreads(found: dict[str, Any]) -> dict[str, Any]:
    return {name: spread.as_dict() for name, spread in found.items()}
