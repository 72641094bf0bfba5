"""A scan against the truth of a rendered scene, in figures that have the names of the issues' tables."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import mcp_accuracy
import numpy as np

from scanner.devices import Truth

DARK = 0.04
"""Share of the brightest scattered light (97th percentile) below which a surface counts as unlit"""

STEEP = 9.5
"""Depth between neighbouring pixels, in pixels' own widths, that makes an edge: a surface seen at 84 degrees"""

INSIDE_PX = 7
WRONG_MM = 20.0


@dataclass
class Found:
    """Figures by name, and what the report said."""

    figures: dict = field(default_factory=dict)
    warnings: tuple = ()
    refused: str | None = None


def truth_of(view):
    """With what is too dark to be asked for taken out of the lit."""
    strong = view.rays.scattered.mean(0)
    lit = view.lit & (strong > DARK * np.percentile(strong[view.lit], 97))
    return Truth(view.rows, view.columns, view.xyz, lit)


def inside_of(truth, calibration):
    """INSIDE_PX from edges of depth and of shadow."""
    z = np.nan_to_num(truth.xyz[..., 2], nan=1e6)
    around = np.ones((3, 3), np.uint8)
    steep = 2 * STEEP * np.nan_to_num(truth.xyz[..., 2], nan=1e3) / calibration.camera.matrix[0, 0]
    edge = (cv2.dilate(z, around) - cv2.erode(z, around) > steep) | ~truth.lit
    return cv2.dilate(edge.astype(np.uint8), np.ones((2 * INSIDE_PX + 1,) * 2, np.uint8)) == 0


def of_scan(scan, truth, calibration, period_px):
    """Of any method: figures over pixels.

    cover: lit pixels with a value; point: with a point; wrong: of the values on lit surface, those half a period and
    more off (any axis), wrong_pt: the same of points; unlit: of all points, those that are not lit; zmed, z99: depth
    error of points, mm; beyond: share of lit points beyond 20 mm; k1, k2: inside, share within 1 and 2 sigma_z;
    e1, e2: the same outside of the inside; conf_wrong: share of wrong points with a confidence above .9.
    """
    lit, inside = truth.lit, inside_of(truth, calibration)
    values = [(scan.rows, truth.rows), (scan.columns, truth.columns)]
    errors = [np.abs(v - t) for v, t in values if v is not None]
    decided = np.all([np.isfinite(e) for e in errors], axis=0)
    off = np.any([e > period_px / 2 for e in errors], axis=0)
    z = scan.xyz[..., 2]
    point = np.isfinite(z)
    depth = np.abs(z - truth.xyz[..., 2])
    on = point & lit
    ratio = depth / scan.sigma_z if scan.sigma_z is not None else np.full(z.shape, np.nan)
    told = np.isfinite(ratio)
    bad = point & ((off & lit) | ~lit | (depth > WRONG_MM))
    return {
        "cover": _share(decided & lit, lit),
        "point": _share(on, lit),
        "wrong": _share(off & lit & decided, decided & lit),
        "wrong_pt": _share(off & on, on),
        "unlit": _share(point & ~lit, point),
        "zmed": float(np.median(depth[on])) if on.any() else np.nan,
        "z99": float(np.percentile(depth[on & inside], 99)) if (on & inside).any() else np.nan,
        "beyond": _share(on & (depth > WRONG_MM), on),
        "bias": float(np.median((z - truth.xyz[..., 2])[on & inside])) if (on & inside).any() else np.nan,
        "k1": _share(ratio <= 1, told & inside & lit, among=True),
        "k2": _share(ratio <= 2, told & inside & lit, among=True),
        "e1": _share(ratio <= 1, told & ~inside & lit, among=True),
        "e2": _share(ratio <= 2, told & ~inside & lit, among=True),
        "conf_wrong": _share(bad & (scan.confidence > 0.9), point),
    }


def of_stripes(scan, sequence, truth, calibration):
    """Of MCP besides: right, recall, depth of right peaks, as the issue counts them."""
    pattern = sequence.pattern
    flip = pattern.axis == "x"
    true = truth.columns if flip else truth.rows
    pitch = pattern.pitch_px(sequence.projector)
    x, y = scan.peaks[:, 0], scan.peaks[:, 1]
    at = np.rint(y).astype(int), np.rint(x).astype(int)
    error = np.abs(scan.peaks[:, 2] - true[at])
    lit, inside = truth.lit[at], inside_of(truth, calibration)[at]
    right = lit & (error < pitch / 2)
    per_step = np.abs(mcp_accuracy.depth_per_step(truth, calibration, pattern.axis))[at]
    smooth = cv2.remap(np.nan_to_num(true, nan=-1e4), x[:, None], y[:, None], cv2.INTER_LINEAR)[:, 0]
    depth = np.abs(scan.peaks[:, 2] - smooth) * per_step
    levels = [1.0 if pattern.code_of(s) != 0 or pattern.levels == "equal" else 0.0 for s in range(pattern.stripe_count)]
    maps = [scan.stripes, true, truth.lit]
    return {
        "right": float(right.mean()) if len(right) else np.nan,
        "recall": float(mcp_accuracy.recall(*(m.T if flip else m for m in maps), pitch, np.array(levels))),
        "pzmed": float(np.median(depth[right])) if right.any() else np.nan,
        "p1mm": float(np.mean(depth[right & inside] < 1)) if (right & inside).any() else np.nan,
        "pbeyond": float(np.mean(depth[lit] > WRONG_MM)) if lit.any() else np.nan,
        "punlit": float(np.mean(~lit)) if len(lit) else np.nan,
    }


def _share(part, whole, *, among=False):
    count = np.count_nonzero(whole)
    return float(np.count_nonzero(part & whole if among else part) / count) if count else float("nan")
