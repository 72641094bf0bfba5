"""Lateral resolution: how wide a straight step in depth is in a scan, from 10 to 90 % of its height.

The profile across the edge is put together from all lines of the picture at their own distance from it (slanted edge,
as in ISO 12233), so that it is known far finer than a pixel. Pixels without a point are part of the width: a decoder
that leaves out what is mixed shows as wide an edge as one that smears it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError

Array = NDArray[np.float64]

BIN_PX = 0.25
REACH_PX = 15.0
"""Of the profile, each way."""
CLEAR_PX = 8.0
"""From the edge: the sides are what they are from here on."""
FEWEST_LINES = 10
NO_POINTS = "is it in view and in the light, and did filters leave its points? preview.png shows where points are"
FEWEST_PIXELS = 300
LEAST_STEP = 10.0
"""Height of the step over the noise beside it: the tenths of the height are then a sigma of one pixel each."""
ROUNDS = 10
LOW, HIGH = 0.1, 0.9


@dataclass(frozen=True)
class EdgeWidth:
    """width_px, width_mm: across the edge, between 10 and 90 % of the step, on the nearer side's scale; step_mm: its
    height in depth; noise_mm: beside it, 1-sigma; gap_px: of that width, without any point; lines: of the picture that
    took part."""

    width_mm: float
    width_px: float
    gap_px: float
    step_mm: float
    noise_mm: float
    lines: int


def edge_width(xyz: NDArray[Any]) -> EdgeWidth:
    """Measure the one straight edge in part of a scan.

    Args:
        xyz: (H, W, 3) mm, NaN where there is no point: two flat sides, one nearer.

    Raises:
        DecodeError: too few points, no step in depth, or no straight edge.
    """
    depth = np.asarray(xyz[..., 2], dtype=np.float64)
    y, x = np.nonzero(np.isfinite(depth))
    if len(x) < FEWEST_PIXELS:
        raise DecodeError(f"{len(x)} points are too few for an edge, {FEWEST_PIXELS} are needed", hint=NO_POINTS)
    z = depth[y, x]
    terms: Array = np.column_stack((np.ones(len(x)), x, y)).astype(np.float64)
    near, far, side, noise = _two_planes(terms, z)
    step = (terms @ far) - (terms @ near)
    height = float(np.median(step))
    if not height > LEAST_STEP * max(noise, 1e-9):
        raise DecodeError(
            f"no step in depth: {height:.3f} mm between the sides, noise of {noise:.3f} mm",
            hint="give a part of the picture with one straight edge between two flat sides",
        )
    line, lines = _edge_line(x, y, side, depth.shape)
    off = (terms @ line) / np.hypot(line[1], line[2])  # px from the edge, positive on the farther side
    (near, quiet), (far, loud) = (_plane_beyond(terms[part], z[part], np.abs(off[part])) for part in (~side, side))
    step = terms @ far - terms @ near
    level = (z - terms @ near) / step
    low, high, gap = _crossings(off, np.clip(level, -0.5, 1.5))
    scale = _mm_per_px(np.asarray(xyz, dtype=np.float64), line[1:] / np.hypot(line[1], line[2]), side, (y, x))
    return EdgeWidth((high - low) * scale, high - low, gap, float(np.median(step)), max(quiet, loud), lines)


def _two_planes(terms: Array, z: Array) -> tuple[Array, Array, NDArray[np.bool_], float]:
    """Coefficients of the nearer and the farther plane in depth, which points are on the farther, and the noise, mm."""
    centred = terms.copy()
    centred[:, 1:] -= centred[:, 1:].mean(axis=0)
    # The side that a step's own slope names comes first: a tilted pair of planes has no level between them.
    best = None
    for start in (z, *centred[:, 1:].T):
        side = start > np.median(start)
        for _ in range(ROUNDS):
            if not 0.02 < side.mean() < 0.98:
                break
            planes = [np.linalg.lstsq(terms[part], z[part], rcond=None)[0] for part in (~side, side)]
            off = np.abs([terms @ plane - z for plane in planes])
            moved = off[1] < off[0]
            if (moved == side).all():
                break
            side = moved
        if not 0.02 < side.mean() < 0.98:
            continue
        left = np.minimum(*off)
        if best is None or np.median(left) < best[0]:
            best = float(np.median(left)), planes, side
    if best is None:
        raise DecodeError("no step in depth: one plane holds all points")
    noise, planes, side = 1.4826 * best[0], best[1], best[2]
    if np.median(terms @ planes[1] - terms @ planes[0]) < 0:
        return planes[1], planes[0], ~side, noise
    return planes[0], planes[1], side, noise


def _plane_beyond(terms: Array, z: Array, away: Array) -> tuple[Array, float]:
    """A side's plane without the points that its edge bends, and the noise from it, mm."""
    clear = away > min(CLEAR_PX, float(np.median(away)))
    plane = np.asarray(np.linalg.lstsq(terms[clear], z[clear], rcond=None)[0], dtype=np.float64)
    return plane, 1.4826 * float(np.median(np.abs(z[clear] - terms[clear] @ plane)))


def _edge_line(
    x: NDArray[np.intp], y: NDArray[np.intp], side: NDArray[np.bool_], shape: tuple[int, ...]
) -> tuple[Array, int]:
    """(c, a, b) with c + a x + b y = 0 on the edge and > 0 on the farther side; and how many lines it is from."""
    towards = np.array([x[side].mean() - x[~side].mean(), y[side].mean() - y[~side].mean()])
    along = int(abs(towards[1]) > abs(towards[0]))  # 0: the edge is crossed along lines of the picture, 1: down columns
    cross, other = (x, y) if along == 0 else (y, x)
    sign = 1.0 if towards[along] > 0 else -1.0
    places, at = [], []
    for k in range(shape[along]):
        here = other == k
        nearer, farther = sign * cross[here & ~side], sign * cross[here & side]
        if len(nearer) > 2 and len(farther) > 2:
            at.append(k)
            # The place at which as many points lie on the wrong side of it from either: what is mixed costs nothing.
            places.append(_split(nearer.astype(np.float64), farther.astype(np.float64)))
    if len(at) < FEWEST_LINES:
        raise DecodeError(f"{len(at)} lines of the picture cross the edge, {FEWEST_LINES} are needed")
    position, rows = np.array(places), np.array(at, dtype=np.float64)
    keep = np.ones(len(rows), dtype=bool)
    for _ in range(3):
        slope, offset = np.polyfit(rows[keep], position[keep], 1)
        off = np.abs(position - slope * rows - offset)
        keep = off <= max(4 * 1.4826 * float(np.median(off)), 0.5)
    if keep.mean() < 0.7 or float(np.median(off)) > 2.0:
        raise DecodeError("no straight edge between the two sides")
    line = (-offset, sign, -slope) if along == 0 else (-offset, -slope, sign)
    return np.array(line), int(keep.sum())


def _split(nearer: Array, farther: Array) -> float:
    """Where along a line the nearer side ends and the farther begins."""
    every = np.concatenate((nearer, farther))
    order = np.argsort(every, kind="stable")
    is_far = np.arange(len(every))[order] >= len(nearer)
    wrong = np.cumsum(is_far) + (~is_far).sum() - np.cumsum(~is_far)
    k = int(np.argmin(wrong))
    ordered = every[order]
    return float((ordered[k] + ordered[min(k + 1, len(ordered) - 1)]) / 2)


def _crossings(off: Array, level: Array) -> tuple[float, float, float]:
    """Where the profile leaves 10 % and reaches 90 %, px, and how much between has no point."""
    edges = np.arange(-REACH_PX, REACH_PX + BIN_PX, BIN_PX)
    number = np.digitize(off, edges) - 1
    inside = (number >= 0) & (number < len(edges) - 1)
    counts = np.bincount(number[inside], minlength=len(edges) - 1)
    sums = np.bincount(number[inside], level[inside], minlength=len(edges) - 1)
    known = counts > 0
    if known.sum() < 4:
        raise DecodeError("too few points beside the edge")
    middle = (edges[:-1] + BIN_PX / 2)[known]
    profile = sums[known] / counts[known]
    low = _crossing(middle, profile, LOW)
    high = _crossing(middle, profile, HIGH)
    empty = ~known & (edges[:-1] >= low) & (edges[1:] <= high)
    return low, high, float(empty.sum() * BIN_PX)


def _crossing(middle: Array, profile: Array, level: float) -> float:
    """The place nearest to the edge's middle at which the profile passes a level, upwards."""
    centre = int(np.argmin(np.abs(middle)))
    passes = np.flatnonzero((profile[:-1] < level) & (profile[1:] >= level))
    if not len(passes):
        raise DecodeError(f"the profile across the edge does not pass {level:.0%}")
    k = int(passes[np.argmin(np.abs(passes - centre))])
    share = (level - profile[k]) / (profile[k + 1] - profile[k])
    return float(middle[k] + share * (middle[k + 1] - middle[k]))


def _mm_per_px(xyz: Array, across: Array, side: NDArray[np.bool_], at: tuple[Any, Any]) -> float:
    """mm on the nearer side for a pixel across the edge."""
    y, x = at[0][~side], at[1][~side]
    terms = np.column_stack((np.ones(len(x)), x, y))
    slopes = np.linalg.lstsq(terms, xyz[y, x], rcond=None)[0][1:]  # (2, 3): mm by px along x and y
    return float(np.linalg.norm(across @ slopes))
