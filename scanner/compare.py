"""How far a scan is from the truth, where a simulated rig knows it: figures for the report, and a map of the errors.

Figures come twice: over all lit pixels, and `inside`, 7 px and more away from the truth's depth edges and shadow
borders, where a pixel sees one surface only. Wrong pixels are never left out of an rms.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.colours import BACKGROUND, DIM, PANEL, Picture, Scale, colour_bar, fit, grouped, text
from scanner.devices import Truth
from scanner.errors import DecodeError
from scanner.filters import at_depth_edge
from scanner.scan import Scan

Map = NDArray[np.float32]
Mask = NDArray[np.bool_]

INSIDE_PX = 7
"""Ten times the blur (sigma 0.7 px) of the reference optics: no light from across the edge is left."""

WRONG_DEPTH_MM = 20.0
"""A depth this far off is no noise but another fringe, stripe or surface."""

_UNDECIDED = (40, 84, 122)


@dataclass(frozen=True)
class Errors:
    """Figures of one kind of error: rms and mean of the error, median and 99th percentile of its size."""

    count: int
    rms: float | None
    mean: float | None
    median: float | None
    p99: float | None


@dataclass(frozen=True)
class Region:
    """All figures over one set of lit pixels."""

    lit: int
    """pixels of this region"""
    decided: int
    """of these, with a decoded value"""
    points: int
    """of these, with a point that the filters left"""
    coverage: float
    """decided / lit"""
    point_coverage: float
    """points / lit"""
    too_dark: int
    """of these, without a value since the pattern does not show there"""
    too_dark_share: float
    """too_dark / lit"""
    undecided: int
    """of these, without a value where the pattern shows"""
    undecided_share: float
    """undecided / lit"""
    wrong: int
    """decided pixels off by more than half the finest period, or 20 mm"""
    wrong_share: float
    """of the decided"""
    depth_mm: Errors | None
    rows_px: Errors | None
    columns_px: Errors | None


@dataclass(frozen=True, eq=False)
class Comparison:
    """A scan against the truth."""

    lit: Region
    inside: Region
    outside_lit: int
    """pixels with a decoded value that the projector does not light"""
    outside_lit_share: float
    """of all decided pixels"""
    unlit_points: int
    """points that are in neither region, since the truth has no light, or nothing, there"""
    period_px: float | None
    """finest period that half of which counts as wrong; None: only depth was judged"""
    error: Map
    """(H, W) measured minus true: depth in mm, or projector px without a calibration; NaN where either is missing"""
    unit: str
    undecided: Mask
    """(H, W) bool: lit and without a value"""

    def as_dict(self) -> dict[str, Any]:
        """The figures as plain data, for the report."""
        return {
            "lit": asdict(self.lit),
            "inside": asdict(self.inside),
            "inside_px": INSIDE_PX,
            "outside_lit": self.outside_lit,
            "outside_lit_share": self.outside_lit_share,
            "unlit_points": self.unlit_points,
            "period_px": self.period_px,
        }

    def picture(self) -> Picture:
        """(h, w, 3) uint8 BGR: the error in colours, its scale, and the main figures."""
        return _picture(self)


def compare(scan: Scan, truth: Truth, period_px: float | None = None) -> Comparison:
    """Compare a scan with the truth of its scene.

    Args:
        scan: with or without points.
        truth: of the same camera.
        period_px: finest fringe period (stripe pitch) in projector px; errors beyond half of it are wrong orders.
            None: only errors of depth beyond 20 mm are called wrong.

    Raises:
        DecodeError: truth and scan have different sizes.
    """
    if truth.lit.shape != scan.shape:
        (th, tw), (h, w) = truth.lit.shape, scan.shape
        raise DecodeError(f"the truth is of a camera of {tw} x {th} pixels, the scan has {w} x {h}")
    rows = None if scan.rows is None else scan.rows - truth.rows
    columns = None if scan.columns is None else scan.columns - truth.columns
    depth = None if scan.xyz is None else scan.xyz[..., 2] - truth.xyz[..., 2]
    wrong = np.zeros(scan.shape, np.bool_)
    if depth is not None:
        wrong |= np.abs(depth) > WRONG_DEPTH_MM
    for error in (rows, columns):
        if period_px is not None and error is not None:
            wrong |= np.abs(error) > period_px / 2
    decided, shows = scan.decoded, scan.lit
    lit = truth.lit & np.isfinite(truth.xyz[..., 2])
    there = ~np.isnan(scan.xyz[..., 2]) if scan.xyz is not None else np.zeros_like(decided)

    def region(where: Mask) -> Region:
        pixels, values = int(where.sum()), int((where & decided).sum())
        points, off = int((where & there).sum()), int((where & decided & wrong).sum())
        dark, open_ = int((where & ~shows).sum()), int((where & shows & ~decided).sum())
        return Region(
            lit=pixels,
            decided=values,
            points=points,
            coverage=values / max(pixels, 1),
            point_coverage=points / max(pixels, 1),
            too_dark=dark,
            too_dark_share=dark / max(pixels, 1),
            undecided=open_,
            undecided_share=open_ / max(pixels, 1),
            wrong=off,
            wrong_share=off / max(values, 1),
            depth_mm=_errors(depth, where),
            rows_px=_errors(rows, where),
            columns_px=_errors(columns, where),
        )

    outside = int((decided & ~truth.lit).sum())
    main = next(error for error in (depth, rows, columns) if error is not None)
    return Comparison(
        lit=region(lit),
        inside=region(lit & inside(truth)),
        outside_lit=outside,
        outside_lit_share=outside / max(int(decided.sum()), 1),
        unlit_points=int((there & ~lit).sum()),
        period_px=period_px,
        error=np.where(truth.lit, main, np.nan).astype(np.float32),
        unit="mm" if depth is not None else "px",
        undecided=lit & ~decided,
    )


def inside(truth: Truth, distance_px: int = INSIDE_PX) -> Mask:
    """(H, W) bool: pixels at least `distance_px` from the truth's depth edges, shadow borders and ends."""
    there = np.isfinite(truth.xyz[..., 2])
    xyz = np.ascontiguousarray(truth.xyz, dtype=np.float32)
    edge = at_depth_edge(xyz, np.zeros(there.shape, np.float32), there)
    clear = (there & truth.lit & ~edge).astype(np.uint8)
    return np.asarray(cv2.distanceTransform(clear, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) >= distance_px)


def _errors(error: Map | None, where: Mask) -> Errors | None:
    if error is None:
        return None
    values = error[where].astype(np.float64)
    values = values[np.isfinite(values)]
    if values.size == 0:
        return Errors(0, None, None, None, None)
    middle, high = values.size // 2, int(0.99 * (values.size - 1))
    size = np.partition(np.abs(values), (middle, high))
    median, p99 = size[middle], size[high]
    rms = float(np.sqrt(np.mean(values * values)))
    return Errors(int(values.size), rms, float(values.mean()), float(median), float(p99))


def _picture(comparison: Comparison) -> Picture:
    error, box = comparison.error, (28, 96, 1316, 920)
    picture = np.empty((1044, 1480, 3), np.uint8)
    picture[:] = BACKGROUND
    size = np.abs(error[np.isfinite(error)])
    limit = _round_up(float(np.percentile(size, 98))) if size.size else 1.0
    scale = Scale(-limit, limit, "diverging", comparison.unit)
    x, y, width, height = box
    picture[y : y + height, x : x + width] = PANEL
    small = scale.apply(fit(error, width, height))
    missing = fit(comparison.undecided.astype(np.float32), width, height) > 0.5
    small[missing] = _UNDECIDED
    h, w = small.shape[:2]
    left, top = x + (width - w) // 2, y + (height - h) // 2
    picture[top : top + h, left : left + w] = small
    colour_bar(picture, scale, (x + width + 30, y + 40, 18, height - 60))
    text(picture, "Error against truth", (x, 40), size=26, weight=600)
    for at, line in zip((64, 86), captions(comparison), strict=False):
        text(picture, line, (x, at), size=16, colour=DIM)
    picture[60:76, 1180:1196] = _UNDECIDED
    text(picture, "lit (truth), undecided", (1206, 74), size=15, colour=DIM)
    return picture


def captions(comparison: Comparison) -> tuple[str, ...]:
    """What stands over the picture: a line of figures for each set of pixels, which it names first."""
    sets = (("all that is lit", comparison.lit), (f"{INSIDE_PX} px and more from edges", comparison.inside))
    return tuple(_caption(name, region, comparison.unit) for name, region in sets)


def _caption(name: str, region: Region, unit: str) -> str:
    errors = region.depth_mm or region.rows_px or region.columns_px
    if errors is None or errors.rms is None:
        return f"{name}: nothing to compare"
    return (
        f"{name}: rms {errors.rms:.3f} {unit}, 99 % below {errors.p99:.3f} {unit}, "
        f"{grouped(region.wrong)} wrong of {grouped(region.decided)} decided ({100 * region.coverage:.2f} %)"
    )


def _round_up(value: float) -> float:
    """The next of 1, 2, 5 times a power of ten."""
    if not value > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(m * power for m in (1, 2, 5, 10) if m * power >= value * (1 - 1e-9)))
