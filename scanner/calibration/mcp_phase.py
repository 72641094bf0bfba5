"""MCP's code-to-phase check (Casey 2011, sec. 3.7): stripes against the rows that PMP finds on the same flat surface.

A line through (stripe index, PMP row) at every stripe peak, by least squares, outliers out. The dissertation needs it
to turn codes into phase; the default decoder knows the pattern and its rows, so here it is a check: the line must be
the ideal one, row = h index + h / 2 - 0.5, and what it deviates by is an error of response, focus or decoding. Patterns
along x have columns in place of rows throughout.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from scanner.errors import DecodeError

Array = NDArray[np.float64]

FEWEST_PEAKS = 200
ROUNDS = 6
OUTLIER_SIGMAS = 4.0
"""Peaks farther from the line than this, in robust sigmas, are wrong codes or edges: one of 16,000 right ones goes."""
COVERAGE = 0.9545
"""What k = 2 holds of a normal error, and Student's factor of one that few stripes tell"""
NOTABLE_PX = 0.2
"""Rows, of the line from the ideal one and of the peaks from the line, from which something is wrong: ten times what
peaks scatter on a plain board (0.02 rows), 0.6 mm of depth on the dissertation's rig."""
NOTABLE_OUTLIERS = 0.05
"""Share of peaks off the line, beyond which the surface is no plain flat board: 0.1 to 2 % on boards, 10 to 18 % on a
bust, on blocks and on print."""
MOST_ELSEWHERE = 0.05
"""Share of peaks where the two scans name different stripes, by no whole number of stripes: of two scenes. On one
scene, steps and print included, it is 0.1 % at most; where a ball hides a tenth of a wall, a tenth."""
MOST_WRONG = 0.5
"""Share of peaks in another stripe, by whole stripes too: the dissertation's decoder has 80 to 93 % of codes right
in the end (Casey 2011, tables 5.1 and 5.2)"""
WHOLE_SHARE = 0.125
"""Of a stripe, about its whole multiples, on either side: a wrong code moves a peak by those, another scene moves it
anywhere, one time in four by chance near one"""


@dataclass(frozen=True)
class McpPhase:
    """The line row = slope index + intercept; deviation_px: largest distance from the ideal one over the stripes seen;
    rms_px: of the peaks kept; stripes, peaks, outliers: how many; wrong_codes: outliers that are whole stripes off.

    stripe_range: the first and the last stripe seen; stripe_count: how many the pattern has.
    farthest_px: what the distance from the ideal line may be at any stripe of the pattern, its uncertainty included.
    expanded: U of slope, intercept, deviation_px and rms_px. It and farthest_px are None where too few stripes tell.
    """

    slope: float
    intercept: float
    deviation_px: float
    rms_px: float
    stripes: int
    peaks: int
    outliers: int
    wrong_codes: int
    stripe_range: tuple[int, int]
    stripe_count: int
    farthest_px: float | None
    expanded: dict[str, float | None]

    @property
    def member(self) -> dict[str, float]:
        """`mcp_phase` of the calibration file."""
        return {"slope": self.slope, "intercept": self.intercept}

    @property
    def outlying(self) -> float:
        """Share of the peaks that are off the line."""
        return self.outliers / (self.peaks + self.outliers)

    @property
    def good(self) -> bool | None:
        """Whether nothing is wrong; None: deviation and scatter are within NOTABLE_PX, but not surely so."""
        if max(self.deviation_px, self.rms_px) > NOTABLE_PX or self.outlying > NOTABLE_OUTLIERS:
            return False
        return None if self.open_questions else True

    @property
    def open_questions(self) -> tuple[str, ...]:
        """Which figures are within what is allowed, but not surely so: deviation_px, rms_px."""
        scatter, farthest = self.expanded["rms_px"], self.farthest_px
        sure = {
            "deviation_px": farthest is not None and farthest <= NOTABLE_PX,
            "rms_px": scatter is not None and self.rms_px + scatter <= NOTABLE_PX,
        }
        return tuple(name for name, known in sure.items() if not known)


def mcp_phase(
    rows: NDArray[Any], peaks: NDArray[Any], pitch_px: float, stripe_count: int, *, axis: str = "y"
) -> McpPhase:
    """Fit the line.

    Args:
        rows: (H, W) float32 projector rows (columns for axis x) by PMP, NaN where undecided.
        peaks: (M, 5) of an MCP scan of the same scene: x, y, row, stripe index, confidence.
        pitch_px: height of one stripe.
        stripe_count: stripes of the pattern.
        axis: of the pattern; only for messages.

    Raises:
        DecodeError: too few peaks on pixels that PMP measured, or those that agree all on one stripe; the scans
            are of two scenes.
    """
    index, seen = _on_measured(rows, peaks)
    if len(index) < FEWEST_PEAKS or np.ptp(index) == 0:
        raise DecodeError(
            f"{len(index)} stripe peaks lie on pixels that PMP measured: {FEWEST_PEAKS} are needed, on several stripes",
            hint=_SCAN_AGAIN.format(axis=axis),
        )
    _require_one_scene(seen - (pitch_px * index + pitch_px / 2 - 0.5), pitch_px, axis)
    slope, intercept, kept = _fitted(index, seen, pitch_px, axis)
    off = seen - slope * index - intercept
    spreads = _Spreads(index[kept], off[kept])

    def deviation(stripe: int) -> float:
        return abs((slope - pitch_px) * stripe + intercept - (pitch_px / 2 - 0.5))

    ends = int(index[kept].min()), int(index[kept].max())
    worst = max(ends, key=deviation)
    farthest = [
        deviation(stripe) + unsure for stripe in (0, stripe_count - 1) if (unsure := spreads.row(stripe)) is not None
    ]
    return McpPhase(
        slope,
        intercept,
        deviation(worst),
        float(np.sqrt((off[kept] ** 2).mean())),
        len(np.unique(index[kept])),
        int(kept.sum()),
        int((~kept).sum()),
        int((~kept & _other_stripe(off, pitch_px) & _whole(off, pitch_px)).sum()),
        ends,
        stripe_count,
        max(farthest, default=None),
        {**spreads.line(), "deviation_px": spreads.row(worst), "rms_px": spreads.rms()},
    )


_SCAN_AGAIN = (
    "scan a matt white flat board that fills the field, by PMP and by MCP, both along axis {axis}, without moving "
    "anything between"
)


def _on_measured(rows: NDArray[Any], peaks: NDArray[Any]) -> tuple[Array, Array]:
    """Stripe index, and PMP's row, of every peak of a whole stripe that lies on pixels that PMP measured."""
    sound = np.isfinite(peaks[:, :4]).all(axis=1) & (np.asarray(peaks[:, 3]) == np.round(peaks[:, 3]))
    whole = peaks[sound].astype(np.float64)
    if not len(whole):
        return np.empty(0), np.empty(0)
    x, y = (whole[:, k].astype(np.float32) for k in (0, 1))
    seen = cv2.remap(np.asarray(rows, np.float32), x[:, None], y[:, None], cv2.INTER_LINEAR, borderValue=float("nan"))[
        :, 0
    ].astype(np.float64)
    known = np.isfinite(seen)
    return whole[known, 3], seen[known]


def _fitted(index: Array, seen: Array, pitch_px: float, axis: str) -> tuple[float, float, NDArray[np.bool_]]:
    """Slope and intercept, and which peaks they are of.

    Raises:
        DecodeError: these are all on one stripe.
    """
    kept = np.ones(len(index), dtype=bool)
    slope, intercept = pitch_px, pitch_px / 2 - 0.5
    for _ in range(ROUNDS):
        off = seen - slope * index - intercept
        # From the ideal line first: wrong codes are whole stripes off and must not bend the first fit.
        spread = max(1.4826 * float(np.median(np.abs(off - np.median(off[kept])))), 1e-3)
        kept = np.abs(off - np.median(off[kept])) < OUTLIER_SIGMAS * spread
        if np.ptp(index[kept]) == 0:
            raise DecodeError("all stripe peaks that agree are on one stripe", hint=_SCAN_AGAIN.format(axis=axis))
        slope, intercept = (float(v) for v in np.polyfit(index[kept], seen[kept], 1))
    return slope, intercept, kept


def _require_one_scene(off: Array, pitch_px: float, axis: str) -> None:
    """A peak lies in its stripe, half a pitch from the middle at most, or its code is wrong by whole stripes. Neither
    gamma nor blur moves it farther, and no decoder has most codes wrong.

    Raises:
        DecodeError: more peaks than MOST_ELSEWHERE do neither, or most are in another stripe.
    """
    lines = "rows" if axis == "y" else "columns"
    other = _other_stripe(off, pitch_px)
    share = float(np.mean(other & ~_whole(off, pitch_px)))
    if other.mean() > MOST_WRONG or share > MOST_ELSEWHERE:
        raise DecodeError(
            f"the two scans are not of one scene: at {other.mean():.0%} of the stripe peaks PMP has {lines} of another "
            f"stripe than MCP names, {pitch_px / 2:g} {lines} or more off its middle, at {share:.0%} by no whole "
            f"number of stripes, as a wrong code would make; {MOST_ELSEWHERE:.0%} are allowed",
            hint=_SCAN_AGAIN.format(axis=axis),
        )


def _other_stripe(off: Array, pitch_px: float) -> NDArray[np.bool_]:
    return np.asarray(np.abs(off) > pitch_px / 2)


def _whole(off: Array, pitch_px: float) -> NDArray[np.bool_]:
    """Near a whole number of stripes, where a wrong code puts a peak."""
    steps = off / pitch_px
    return np.asarray(np.abs(steps - np.round(steps)) < WHOLE_SHARE)


class _Spreads:
    """U of a line's figures, by how much stripes as wholes differ: along a stripe peaks are fitted together, so that
    their errors are alike and their number tells nothing. Lines are fitted without one stripe at a time (cluster
    jackknife, Tukey 1958; CR3 of Bell and McCaffrey 2002). None where fewer than three stripes tell."""

    def __init__(self, index: Array, off: Array) -> None:
        """index, off: (M,) stripe and distance from the line of every peak."""
        self._off = off
        self._stripes, self._at = np.unique(index, return_inverse=True)
        self._freedom = len(self._stripes) - 2
        if self._freedom < 1:
            return
        design = np.column_stack((index, np.ones_like(index)))
        by_stripe = [design[self._at == k] for k in range(len(self._stripes))]
        right = np.stack([rows.T @ off[self._at == k] for k, rows in enumerate(by_stripe)])
        normal = np.stack([rows.T @ rows for rows in by_stripe])
        without = np.stack(
            [np.linalg.solve(normal.sum(axis=0) - n, right.sum(axis=0) - r) for n, r in zip(normal, right, strict=True)]
        )
        apart = without - without.mean(axis=0)
        self._covariance = apart.T @ apart * (len(self._stripes) - 1) / len(self._stripes)
        self._factor = float(student.ppf((1 + COVERAGE) / 2, self._freedom))

    def row(self, stripe: float) -> float | None:
        """Of the line's row at a stripe that was chosen of two because it is off most (Bonferroni)."""
        spread = self._along(np.array([stripe, 1.0]))
        return None if spread is None else spread * float(student.ppf((3 + COVERAGE) / 4, self._freedom)) / self._factor

    def line(self) -> dict[str, float | None]:
        """Of slope and intercept."""
        return {"slope": self._along(np.array([1.0, 0.0])), "intercept": self._along(np.array([0.0, 1.0]))}

    def rms(self) -> float | None:
        """Of the peaks' rms about the line."""
        if self._freedom < 1:
            return None
        rms = float(np.sqrt((self._off**2).mean()))
        squares = np.bincount(self._at, self._off**2 - rms**2)
        spread = float(np.sqrt(squares @ squares * len(self._stripes) / self._freedom))
        return self._factor * spread / (len(self._off) * 2 * max(rms, 1e-12))

    def _along(self, direction: Array) -> float | None:
        if self._freedom < 1:
            return None
        return self._factor * float(np.sqrt(max(direction @ self._covariance @ direction, 0.0)))
