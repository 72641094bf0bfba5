"""Has the rig moved since it was calibrated? What scans with both axes say of it without any mark: epipolar residuals.

Rows and columns together say more than a depth: where the projector sees a point across its epipolar line is fixed by
the rig alone. What is left there is a knock, a roll, or a lens that warmed up. A drift along the lines looks like
depth, and no scan can tell it from depth.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.geometry import Calibration

Array = NDArray[np.float64]

FIELDS = 3
"""Fields of the picture, each way, over which residuals are pooled: a roll moves opposite edges opposite ways."""
FEWEST_PIXELS = 100
"""Of a field: its median is then known to an eighth of one pixel's noise."""
MOST_SAMPLES = 40_000
NOTABLE_PX = 0.1
"""Of a field's median: 0.31 mm of depth on casey2011, if the rig had moved as far along the lines."""
NOTABLE_TIMES = 3.0
"""times what the calibration left itself, where that is more"""
STEP = 1.01
"""Ratio of two depths on a camera ray between which its epipolar line is straight, distortion or not."""

UNSEEN = (
    "epipolar residuals show knocks and roll; a drift along the baseline, a pitch towards the target and a change of "
    "scale move points along the lines and look like depth: only marks or a known length show them"
)
"""What the figures cannot say; it stands beside them in every report."""


@dataclass(frozen=True)
class Drift:
    """median_px: of the field that is off most, with its sign; rms_px: of all samples, noise included; fields: (3, 3)
    medians, line by line, None where too few pixels have both axes; allowed_px: from where it is worth a warning;
    depth_mm: what so much along the lines would do to depth, at the scan's middle distance."""

    median_px: float
    rms_px: float
    fields: tuple[tuple[float | None, ...], ...]
    allowed_px: float
    depth_mm: float
    samples: int
    cannot_see: str = UNSEEN

    @property
    def warning(self) -> str | None:
        """In words, where there is something to say."""
        if abs(self.median_px) <= self.allowed_px:
            return None
        return (
            f"rows and columns disagree by {abs(self.median_px):.2f} px across the epipolar lines (as much along them "
            f"would be {self.depth_mm:.2f} mm of depth): the rig has moved since it was calibrated, or something did "
            "during this scan, or the calibration is another rig's; scan again, and if it stays, calibrate again"
        )

    def as_dict(self) -> dict[str, Any]:
        """For report.json."""
        return asdict(self)


def drift_of(
    calibration: Calibration, rows: NDArray[np.float32], columns: NDArray[np.float32], xyz: NDArray[np.float32]
) -> Drift | None:
    """Measure a scan with both axes.

    Args:
        calibration: the one it was triangulated with.
        rows, columns: (H, W) projector px.
        xyz: (H, W, 3) mm.

    Returns:
        None where no field has enough pixels.
    """
    step = max(1, int(np.ceil(np.sqrt(rows.size / MOST_SAMPLES))))
    sampled = np.s_[::step, ::step]
    y, x = np.nonzero(np.isfinite(xyz[sampled][..., 2]) & np.isfinite(rows[sampled]) & np.isfinite(columns[sampled]))
    points = xyz[sampled][y, x].astype(np.float64)
    seen = np.column_stack((columns[sampled][y, x], rows[sampled][y, x])).astype(np.float64)
    across, along = epipolar_offsets(calibration, points, seen)
    height, width = rows[sampled].shape
    field = (y * FIELDS // height) * FIELDS + x * FIELDS // width
    medians: list[float | None] = []
    for k in range(FIELDS**2):
        here = across[field == k]
        medians.append(float(np.median(here)) if len(here) >= FEWEST_PIXELS else None)
    known = [median for median in medians if median is not None]
    if not known:
        return None
    own = ((calibration.extra.get("residuals") or {}).get("epipolar_px")) or 0.0
    worst = max(known, key=abs)
    per_px = float(np.median((STEP - 1) * points[:, 2] / along))
    return Drift(
        median_px=worst,
        rms_px=float(np.sqrt(np.mean(across**2))),
        fields=tuple(tuple(medians[i * FIELDS : (i + 1) * FIELDS]) for i in range(FIELDS)),
        allowed_px=max(NOTABLE_PX, NOTABLE_TIMES * float(own)),
        depth_mm=abs(worst) * per_px,
        samples=len(across),
    )


def epipolar_offsets(calibration: Calibration, points: Array, seen: Array) -> tuple[Array, Array]:
    """How far projector pixels lie across the lines on which their camera rays are seen.

    Args:
        points: (N, 3) mm, camera frame: anywhere near on each ray.
        seen: (N, 2) px.

    Returns:
        (N,) px across, with sign; (N,) px by which the projector's pixel moves along from depth to STEP x depth.
    """
    here = calibration.projector.project(calibration.to_projector(points))
    there = calibration.projector.project(calibration.to_projector(points * STEP))
    length = np.linalg.norm(there - here, axis=1)
    along = (there - here) / length[:, None]
    off = seen - here
    return off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0], length
