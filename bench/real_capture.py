"""What our decoder makes of a real capture, beside a reference decode and a Gray code of the same scene.

    python bench/real_capture.py [FOLDER] [--gray capture-gray.json]

Without FOLDER it is the skull of `$FRINGED_REAL_DATA`, or of shared/data beside the clone; where there is none, nothing
is measured, and it says so. FOLDER holds capture.json, calibration.json and reference.npz (`rows` or `columns`:
somebody's plain decode, NaN where it has none). Everything runs through `scanner.reconstruct`, filters and all, as
`fringed decode` does. Depth is told on the reference's pixels before and after our filters, and over all our points: a
decoder that reaches deeper into the shade than the reference has a wider range without being wrong, which the Gray
code shows.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.capture import Capture
from scanner.geometry import Calibration
from scanner.reconstruct import calibration_for, reconstruct
from scanner.scan import Scan
from scanner.triangulation import triangulate

Map = NDArray[np.float32]

REAL = Path(os.environ.get("FRINGED_REAL_DATA", Path(__file__).parents[1].parent / "shared" / "data"))


def figures(folder: Path, gray: str | None) -> dict[str, Any]:
    """All figures of one folder, plain data."""
    capture = Capture.open(folder)
    calibration = calibration_for(capture)
    scan = reconstruct(capture, calibration)
    with np.load(folder / "reference.npz") as content:
        axis = "columns" if "columns" in content else "rows"
        reference = content[axis].astype(np.float32)
    ours = getattr(scan, axis)
    known, found = np.isfinite(reference), np.isfinite(ours)
    apart = np.abs(ours - reference)[known & found]
    told: dict[str, Any] = {
        "reference_pixels": int(known.sum()),
        "decoded_share": share(known & found, known),
        "within_1_px": float(np.mean(apart < 1)),
        "pixels_beyond_the_reference": int((found & ~known).sum()),
    }
    if calibration is not None:
        told |= depths(scan, calibration, axis, reference)
    if gray is not None:
        told["gray"] = beside_gray(folder / gray, calibration, axis, ours, scan, known)
        if calibration is not None:
            told["gray"]["of_our_deepest_hundredth"] = deepest(folder / gray, calibration, axis, scan, known)
    return told


def depths(scan: Scan, calibration: Calibration, axis: str, reference: Map) -> dict[str, Any]:
    """1st and 99th percentile of depth, mm."""
    known = np.isfinite(reference)
    ours = getattr(scan, axis)
    assert scan.xyz is not None
    z = scan.xyz[..., 2]
    return {
        "depth_mm": {
            "reference": spread(triangulate(calibration, **{axis: reference}).xyz[..., 2]),
            "on_its_pixels": spread(triangulate(calibration, **{axis: np.where(known, ours, np.nan)}).xyz[..., 2]),
            "on_its_pixels_filtered": spread(z[known]),
            "all_points": spread(z),
        },
        "points": int(np.isfinite(z).sum()),
        "keep_a_point": share(known & np.isfinite(z), known),
    }


def beside_gray(
    path: Path, calibration: Calibration | None, axis: str, ours: Map, scan: Scan, known: NDArray[np.bool_]
) -> dict[str, Any]:
    """Fringes against Gray code of the same scene, on the reference's pixels and on those only we have."""
    code = getattr(reconstruct(Capture.open(path), calibration), axis)
    apart = np.abs(code - ours)
    both = np.isfinite(apart) & scan.valid
    return {
        "decoded_share": share(known & np.isfinite(code), known),
        "median_px": float(np.median(apart[both])),
        "beyond_20_px": {
            "on_its_pixels": float(np.mean(apart[both & known] > 20)),
            "elsewhere": float(np.mean(apart[both & ~known] > 20)),
        },
    }


def deepest(path: Path, calibration: Calibration, axis: str, scan: Scan, known: NDArray[np.bool_]) -> dict[str, float]:
    """Whether what lies at the far end of our depths is there: its share on the reference's pixels, and Gray code."""
    assert scan.xyz is not None
    z = scan.xyz[..., 2]
    far = z > np.nanpercentile(z, 99)
    code = getattr(reconstruct(Capture.open(path), calibration), axis)
    apart = np.abs(code - getattr(scan, axis))[far & np.isfinite(code)]
    return {
        "on_its_pixels": share(far & known, far),
        "gray_has": float(apart.size / far.sum()),
        "median_px": float(np.median(apart)),
        "beyond_20_px": float(np.mean(apart > 20)),
    }


def share(part: NDArray[np.bool_], whole: NDArray[np.bool_]) -> float:
    """Share of a mask that lies in another."""
    return float(part.sum() / whole.sum())


def spread(values: Map) -> list[float]:
    """1st and 99th percentile, to a tenth."""
    return [round(float(v), 1) for v in np.nanpercentile(values, (1, 99))]


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--gray", help="a capture of the same scene in Gray code, in the folder")
    given = parser.parse_args()
    if given.folder is None:
        given.folder, given.gray = REAL / "skull", "capture-gray.json"
        if not given.folder.is_dir():
            print(f"not run: no real capture in {given.folder}")
            return 0
    json.dump(figures(given.folder, given.gray), sys.stdout, indent=1)
    print()
    return 0


if __name__ == "__main__":
    sys.exit(main())
