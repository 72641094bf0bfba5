"""One scan verified: every feature that is asked for, measured, and how sure its figures are. Plain data comes out.

The scan's calibration is the one that lies beside it (decoded) or in its capture (scanned), if it has the name that the
report has and its points are those of the scan; another one would give uncertainties of another rig.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scanner.calibration.balls import sphere_points
from scanner.calibration.beyond_noise import beyond_noise
from scanner.calibration.edges import edge_width
from scanner.calibration.features import FeaturePoints
from scanner.calibration.figure_spread import (
    BOARD,
    COVERAGE_FACTOR,
    SPHERE,
    Feature,
    Rig,
    Spread,
    spread_of_figures,
    spread_of_length,
)
from scanner.calibration.markers import of_another_kind
from scanner.calibration.marks import Marks, measured_marks
from scanner.calibration.sheet import measured_words
from scanner.calibration.targets import Target
from scanner.calibration.verification import (
    LEFT_OUT,
    at_print,
    board_points,
    length_between,
    measured_board,
    measured_sphere,
    plain,
    target_ends,
)
from scanner.capture import Capture
from scanner.covariance import read_covariance
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

PRINTED = 0.01
"""Share of a board's points at edges of brightness: plain boards have .1 % at the most, prints 2 % and more"""
ON_PRINT = (
    "the board is printed or stained: points at edges of brightness are off by what blur mixes there, and the flatness "
    "holds that beside what the rig does. A plain matt board tells the rig's own"
)
FEW_USED = 0.9
"""Share of a scan's points that features explain, below which a board's figures may be of a part of it: of a plain
board that fills the scan it is 99.9 %"""
NOISE_OF = {"flatness_mm": "noise_mm", "form_mm": "noise_mm", "shell_mm": "shell_noise_mm"}
"""What a figure is called that noise alone would make of a perfect feature"""

BY_PIXEL = ("pmp", "gray+pmp")
"""Methods that decode each pixel by itself. Others' sigmas are of cells, or of relief between stripes, which are no
noise, and neighbours err alike"""


@dataclass(frozen=True)
class Wanted:
    """What is to be measured in each scan. sphere_sigma_mm, length_sigma_mm: of what is stated, 1-sigma."""

    flat: bool = False
    sphere_mm: float | None = None
    sphere_sigma_mm: float = 0.0
    target: Target | None = None
    length_mm: float | None = None
    length_sigma_mm: float = 0.0
    marks: Marks | None = None
    edge: tuple[int, int, int, int] | None = None


def verified(folder: Path, scan: Scan, wanted: Wanted, given: Path | None = None) -> dict[str, Any]:
    """The figures of one scan, by kind, each with its uncertainties; and what these leave out.

    Args:
        folder: of the scan. given: a calibration file to take in place of the one kept.

    Raises:
        DecodeError: the scan has no points, or none of a feature; the edge lies beyond the picture.
        CalibrationError: the calibration file given cannot be read, or is not the scan's.
    """
    if scan.xyz is None:
        raise DecodeError(f"{folder} has no points", hint="decode it with a calibration: fringed decode --calibration")
    found: dict[str, Any] = {}
    said: list[str] = []
    rig, why = rig_of(folder, scan, given)
    if wanted.edge is not None:
        _require_within(wanted.edge, scan)
    if wanted.flat:
        board = board_points(scan.xyz)
        found["flat"] = _with_noise(plain(measured_board(board)), board, scan, BOARD, rig)
        said += [ON_PRINT] if at_print(scan.albedo, board) > PRINTED else []
    if wanted.sphere_mm is not None:
        ball = sphere_points(scan.xyz, wanted.sphere_mm)
        found["sphere"] = _with_noise(plain(measured_sphere(ball, wanted.sphere_mm)), ball, scan, SPHERE, rig)
        of_ball = found["sphere"]["uncertainty"]
        of_ball["size_mm"] = _of_error(of_ball["diameter_mm"], wanted.sphere_sigma_mm)
    if wanted.target is not None:
        seen, ends = target_ends(scan.albedo, scan.xyz, wanted.target)
        said += [*filter(None, [of_another_kind(scan.albedo, wanted.target)]), *measured_words(wanted.target)]
        of_length = spread_of_length(seen, wanted.target, scan.xyz, rig).as_dict()
        found["length"] = plain(length_between(ends, wanted.target, wanted.length_mm))
        of_error = _of_error(of_length, wanted.length_sigma_mm)
        found["length"]["uncertainty"] = {"error_mm": of_error, "measured_mm": of_length}
    if found:
        found["coverage_factor"], found["unknown"] = COVERAGE_FACTOR, why
        kept = () if rig is None or given is not None else rig.calibration.warnings
        found["warnings"] = [*_warnings(found), *said, *kept]
        found["stated_length"] = None if rig is None or why is not None else _of_stated(found, rig)
    if wanted.edge is not None:
        x, y, width, height = wanted.edge
        found["edge"] = plain(edge_width(scan.xyz[y : y + height, x : x + width]))
    if wanted.marks is not None:
        found["marks"] = measured_marks(wanted.marks, scan.albedo, scan.xyz)
    return found


def _of_error(measured: dict[str, float | None], reference: float) -> dict[str, float | None]:
    """Uncertainties of an error, from those of what was measured and the 1-sigma of what it is measured against."""
    if reference == 0:
        return measured
    expanded, rim = measured["expanded"], measured.get("rim") or 0.0
    if expanded is not None:
        expanded = float(np.hypot(expanded - rim, COVERAGE_FACTOR * reference)) + rim
    return {**measured, "reference": reference, "expanded": expanded}


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
    if "sphere" in found and found["sphere"]["another_mm"] is not None:
        warnings.append(
            f"there is another ball in the scan, of {found['sphere']['another_mm']:.2f} mm: the figures are of the one "
            f"of {found['sphere']['diameter_mm']:.2f} mm, which is nearer to what was stated. To measure the other, "
            "keep this one out (fringed decode --box)"
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
    if _method(scan) not in (*BY_PIXEL, None):
        return None, "points of one stripe or cell err together, on slopes most, and by how much is not known"
    if calibration.extra.get("covariance") is None:
        simulated = calibration.id.startswith(SIMULATED)
        return rig, f"the calibration has no covariance{' (the true one of a simulated rig)' if simulated else ''}"
    try:
        read_covariance(calibration.extra["covariance"])
    except ValueError as error:
        return rig, f"the calibration's covariance cannot be read: {error}"
    return rig, None


def _method(scan: Scan) -> str | None:
    """That decoded it, as far as its report tells."""
    decoder, capture = (scan.report.get(part) or {} for part in ("decoder", "capture"))
    return decoder.get("method") or capture.get("method")


def _kept(folder: Path, scan: Scan) -> Calibration | None:
    """The calibration that lies beside the scan, or that its capture names, in the scan's folder or around it."""
    name = (scan.report.get("rig") or {}).get("calibration")
    for place in (None, folder / "capture", folder.resolve().parent):
        try:
            path = folder / "calibration.json" if place is None else Capture.open(place).calibration_path
            found = None if path is None else load_calibration(path)
        except ScannerError:
            continue  # none there, or another capture: there is nothing to know of it
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


def _with_noise(
    figures: dict[str, Any], on: FeaturePoints, scan: Scan, feature: Feature, rig: Rig | None
) -> dict[str, Any]:
    """The figures with their uncertainties; and of widths what a perfect feature has by noise, and what is beyond."""
    spreads = spread_of_figures(on, scan.shape[1], feature, rig)
    found = {**figures, "uncertainty": {name: spread.as_dict() for name, spread in spreads.items()}, "beyond": {}}
    deviations = feature.deviations(on.points)
    # A point moves along its ray: by as much of that as goes along the normal.
    across = (on.points / on.points[:, 2:] * deviations.normals).sum(axis=1)
    ripple = _rippled(scan) * float(np.sqrt(np.mean(across**2)))
    for name, left_out in feature.widths.items():
        told = beyond_noise(deviations.off, on.at, scan.shape, left_out, ripple) if _method(scan) in BY_PIXEL else None
        found[NOISE_OF[name]] = None if told is None else told.noise_mm
        if told is None:
            continue
        found["uncertainty"][NOISE_OF[name]] = Spread(told.noise_random, told.noise_doubt / COVERAGE_FACTOR).as_dict()
        of_calibration = spreads[name].of_calibration
        beyond, least, most = told.limits(figures[name], of_calibration or 0.0)
        known = of_calibration is not None
        found["beyond"][name] = {
            "mm": beyond if known or least > 0 else 0.0,
            "least_mm": least if known else None,
            "most_mm": most if known else None,
        }
    return found


def _rippled(scan: Scan) -> float:
    """What is systematic in a scan besides its calibration, as far as it is known, 1-sigma, mm of depth."""
    budget = (scan.report.get("uncertainty") or {}).get("contributions") or ()
    systematic = [one["mm"] for one in budget if one["kind"] == "systematic" and one["name"] != "calibration"]
    return float(np.sqrt(sum(mm**2 for mm in systematic if mm is not None)))


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
