"""MCP's code-to-phase check (Casey 2011, sec. 3.7): stripes against the rows that PMP finds on the same flat surface.

A line through (stripe index, PMP row) at every stripe peak, by least squares, outliers out. The dissertation needs it
to turn codes into phase; the default decoder knows the pattern and its rows, so here it is a check: the line must be
the ideal one, row = h index + h / 2 - 0.5, and what it deviates by is an error of response, focus or decoding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError

Array = NDArray[np.float64]

FEWEST_PEAKS = 200
ROUNDS = 6
OUTLIER_SIGMAS = 4.0
"""Peaks farther from the line than this, in robust sigmas, are wrong codes or edges: one of 16,000 right ones goes."""
NOTABLE_PX = 0.2
"""Deviation from the ideal line, rows, from which something is wrong: a tenth of what a peak scatters on a board."""


@dataclass(frozen=True)
class McpPhase:
    """The line row = slope index + intercept; deviation_px: largest distance from the ideal one over all stripes;
    rms_px: of the peaks kept; stripes, peaks, outliers: how many."""

    slope: float
    intercept: float
    deviation_px: float
    rms_px: float
    stripes: int
    peaks: int
    outliers: int

    @property
    def member(self) -> dict[str, float]:
        """`mcp_phase` of the calibration file."""
        return {"slope": self.slope, "intercept": self.intercept}


def mcp_phase(rows: NDArray[Any], peaks: NDArray[Any], pitch_px: float, *, axis: str = "y") -> McpPhase:
    """Fit the line.

    Args:
        rows: (H, W) float32 projector rows (columns for axis x) by PMP, NaN where undecided.
        peaks: (M, 5) of an MCP scan of the same scene: x, y, row, stripe index, confidence.
        pitch_px: height of one stripe.
        axis: of the pattern; only for messages.

    Raises:
        DecodeError: too few peaks on pixels that PMP measured, or all on one stripe.
    """
    whole = peaks[np.asarray(peaks[:, 3]) == np.round(peaks[:, 3])].astype(np.float64)
    x, y = (whole[:, k].astype(np.float32) for k in (0, 1))
    seen = cv2.remap(np.asarray(rows, np.float32), x[:, None], y[:, None], cv2.INTER_LINEAR, borderValue=float("nan"))[
        :, 0
    ].astype(np.float64)
    known = np.isfinite(seen)
    index, seen = whole[known, 3], seen[known]
    if len(index) < FEWEST_PEAKS or np.ptp(index) == 0:
        raise DecodeError(
            f"{len(index)} stripe peaks lie on pixels that PMP measured: {FEWEST_PEAKS} are needed, on several stripes",
            hint="scan a matt white flat board that fills the field, by PMP and by MCP, both along axis "
            f"{axis}, without moving anything between",
        )
    kept = np.ones(len(index), dtype=bool)
    slope, intercept = pitch_px, pitch_px / 2 - 0.5
    for _ in range(ROUNDS):
        off = seen - slope * index - intercept
        # From the ideal line first: wrong codes are whole stripes off and must not bend the first fit.
        spread = max(1.4826 * float(np.median(np.abs(off - np.median(off[kept])))), 1e-3)
        kept = np.abs(off - np.median(off[kept])) < OUTLIER_SIGMAS * spread
        slope, intercept = (float(v) for v in np.polyfit(index[kept], seen[kept], 1))
    off = (seen - slope * index - intercept)[kept]
    ends = np.array([index[kept].min(), index[kept].max()])
    deviation = (slope - pitch_px) * ends + intercept - (pitch_px / 2 - 0.5)
    return McpPhase(
        slope,
        intercept,
        float(np.abs(deviation).max()),
        float(np.sqrt((off**2).mean())),
        len(np.unique(index[kept])),
        int(kept.sum()),
        int((~kept).sum()),
    )
