"""report.json: what a scan says of itself in figures, and which programs made it (formats.md, Scan)."""

from __future__ import annotations

import json
import platform
from collections import Counter
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from scanner.bounded_files import read_small_text
from scanner.capture import Capture
from scanner.capture.exposure import exposure_report
from scanner.decode import Decoded, Reason
from scanner.decode.reasons import tally
from scanner.errors import StorageError
from scanner.filter_settings import FilterSettings
from scanner.geometry import Calibration

if TYPE_CHECKING:
    from scanner.scan import Scan
    from scanner.sequencer import CaptureCheck

Map = NDArray[np.float32]

FORMAT = "fringed-report"
VERSION = 1

NOT_LIT = (Reason.SHADOW, Reason.LOW_MODULATION)
DECODED = (Reason.VALUE, Reason.FILTERED)


def report_of(
    scan: Scan,
    decoded: Decoded,
    calibration: Calibration | None,
    settings: FilterSettings,
    removed: Mapping[str, int],
    timings: Mapping[str, float],
) -> dict[str, Any]:
    """The report of a scan just built, as plain data; `removed`: points by filter, `timings`: seconds by stage."""
    counts = tally(scan.reason)
    reasons = {kind.name.lower(): int(counts[kind]) for kind in Reason}
    pixels, values = scan.reason.size, counts[list(DECODED)].sum()
    lit = pixels - counts[list(NOT_LIT)].sum()
    points = 0 if scan.xyz is None else np.count_nonzero(scan.valid)
    report: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "points": int(points),
        "counts": {"pixels": int(pixels), "lit": int(lit), "decoded": int(values), "reasons": reasons},
        "coverage": {
            "image": share(values, pixels),
            "lit": share(values, lit),
            "points_of_lit": share(points, lit),
            "undecided_of_lit": share(lit - values, lit),
            "too_dark": share(pixels - lit, pixels),
            "saturated_of_lit": share(counts[Reason.CLIPPED], lit),
        },
        "removed": dict(removed),
        "filters": settings.as_dict(),
        "rows_px": spread(scan.rows),
        "columns_px": spread(scan.columns),
        "sigma_rows_px": spread(scan.sigma_rows),
        "sigma_columns_px": spread(scan.sigma_columns),
        "depth_mm": spread(None if scan.xyz is None else scan.xyz[..., 2]),
        "sigma_z_mm": spread(scan.sigma_z),
        "rig": None if calibration is None else _rig(calibration),
        "decoder": dict(decoded.details),
        "warnings": list(decoded.warnings),
        "timings": dict(timings),
        "versions": versions(),
    }
    return report


def report_of_capture(capture: Capture) -> dict[str, Any]:
    """The report's `capture`: what was captured, and how that ended."""
    header = capture.header
    return {
        "id": header.id,
        "created": header.created,
        "method": header.sequence.pattern.method,
        "frames": len(capture.records),
        "shows": Counter(str(header.sequence.role(n)) for n in range(len(header.sequence))),
        "missing": list(capture.missing),
        "retaken": sorted(pattern for pattern, record in capture.records.items() if record.attempt),
        "state": header.state,
        "reason": header.reason,
        "repeat": header.repeat,
        "exposure": exposure_report(header),
    }


def report_of_check(check: CaptureCheck, decoder: Mapping[str, Any]) -> dict[str, Any]:
    """The report's `sync`, what the scan as a whole `cannot_reveal`, and its `decoder` without a list of its own.

    The decoder knows its fringes alone: what those hide the order bars show, where the scene shows the bars. Fringes
    whose phase a code must agree with cannot turn unseen.

    Args:
        decoder: the decoder's details.
    """
    sync, sequence = check.as_dict(), check.capture.header.sequence
    blind: list[str] = sync.pop("cannot_reveal")
    if "phase_and_code" in decoder:
        blind = [text for text in blind if not text.startswith("rotations of sets")]
    agreed = {found.name for found in check.witnesses.items if found.passed}
    if not all(f"order bars {axis}" in agreed for axis in getattr(sequence.pattern, "axes", ())):
        blind += decoder.get("cannot_reveal", ())
    return {
        "sync": sync,
        "decoder": {name: value for name, value in decoder.items() if name != "cannot_reveal"},
        "cannot_reveal": blind,
    }


def read_report(path: Path) -> dict[str, Any]:
    """report.json; empty where there is none.

    Raises:
        StorageError: unreadable, or of another format or version.
    """
    try:
        report = json.loads(read_small_text(path))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise StorageError(f"cannot read {path}: {error}") from error
    if not isinstance(report, dict) or report.get("format") != FORMAT or report.get("version") != VERSION:
        raise StorageError(f"{path} is no version {VERSION} of {FORMAT}", hint="update fringed, or remove the file")
    return report


def versions() -> dict[str, str]:
    """What made the scan: fringed, Python and the libraries whose numbers could differ."""
    try:
        own = metadata.version("fringed")
    except metadata.PackageNotFoundError:
        own = "not installed"
    return {
        "fringed": own,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "numba": numba.__version__,
    }


def spread(values: Map | None) -> dict[str, float] | None:
    """1st, 50th and 99th percentile of a map, from every fourth pixel each way where it is large."""
    if values is None:
        return None
    sample = values[::4, ::4] if values.size > 100_000 else values
    sample = sample[np.isfinite(sample)]
    if sample.size == 0:
        return None
    # Sorting takes less than np.percentile, which looks for each rank by itself.
    sample.sort()
    ranks = np.array([0.01, 0.5, 0.99]) * (sample.size - 1)
    below = ranks.astype(np.intp)
    above = np.minimum(below + 1, sample.size - 1)
    low, median, high = sample[below] + (sample[above] - sample[below]) * (ranks - below)
    return {"p1": float(low), "median": float(median), "p99": float(high)}


def share(part: int | np.intp, whole: int | np.intp) -> float:
    """part / whole, 0 of nothing."""
    return float(part) / float(whole) if whole else 0.0


def _rig(calibration: Calibration) -> dict[str, Any]:
    return {"calibration": calibration.id, "projector_centre_mm": calibration.projector_centre.tolist()}
