"""How far a surface's own brightness pulls coordinates: within the camera's blur, the bright side of an edge wins.

A pixel sees its neighbourhood through a blur of some pixel's width. Fringes of the brighter side outweigh those of the
darker, so that the coordinate read is one of a place a little towards the light: by the blur's variance times the
gradient of log brightness (the first moment of a Gaussian times a slope; Burke and Zhong 2017 show the effect). That is
no noise: it stays however often a scan is repeated, but it changes sign from edge to edge. Sigmas are widened by its
size; coordinates are left as they were read.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from scanner.decode.strips import in_strips, threads_to_use
from scanner.kernel import contracting_kernel
from scanner.scan import Map, Scan
from scanner.scan_report import spread

BLUR_VARIANCE_PX2 = 0.5
"""Of a lens in focus: a spread of .7 camera pixels, a quarter of a pixel wider than the pixel itself."""

_F0 = np.float32(0)
_HALF = np.float32(0.5)
_NAN = np.float32(np.nan)
_TINY = np.float32(1e-6)


LINES = 32
"""One row, and one column, in so many is asked how far brightness really pulls."""

REACH = 4
"""Camera pixels to either side that tell where the surface is without the pull: several blurs away"""

LEAST_TEXTURED = 0.1
"""Share of the pixels asked that brightness pulls by more than noise: print has .12 to .22. Below (.03 at most on large
images), edges are the scene's own, where shape and shading change together, and the blur cannot be told from them."""

LEAST_PULLED = 3000
"""Such pixels; on images so small that they have fewer, too many of them are at silhouettes."""

MOST_VARIANCE_PX2 = 4.0
"""Blur of two pixels: beyond, no lens is taken for one in focus."""


def widen_at_edges(scan: Scan, phase_axis: str, blur_variance_px2: float | None = None) -> Scan:
    """The same scan with sigmas that cover what changes of brightness pull, in its maps and in its report.

    After the filters: how steep a step may be is told by noise, and a pull makes none.

    Args:
        scan: whose `modulation` is the height of what coordinates are read from.
        phase_axis: the axis that depth comes from, where both were projected.
        blur_variance_px2: of the camera's blur, squared camera pixels; None: as a textured scene tells it, else that
            of a lens in focus.
    """
    measured: float | None = None
    wider: dict[str, Map] = {}
    for axis, name in (("y", "rows"), ("x", "columns")):
        values, sigma = getattr(scan, name), getattr(scan, f"sigma_{name}")
        if values is not None and sigma is not None:
            if blur_variance_px2 is None and measured is None:
                measured = blur_variance_of(values, sigma, scan.modulation)
            blur = blur_variance_px2 or measured or BLUR_VARIANCE_PX2
            # Depth comes from one axis: from the only one, or from the one that changes with it.
            depth = scan.sigma_z if axis == phase_axis or scan.rows is None or scan.columns is None else None
            wider[f"sigma_{name}"], scaled = _widened(values, sigma, scan.modulation, blur, depth)
            wider |= {} if scaled is None else {"sigma_z": scaled}
    told = {f"{name}_{'mm' if name == 'sigma_z' else 'px'}": spread(v[::2, ::2]) for name, v in wider.items()}
    return replace(
        scan,
        report={**scan.report, **told, "camera_blur_px": None if measured is None else math.sqrt(measured)},
        sigma_rows=wider.get("sigma_rows", scan.sigma_rows),
        sigma_columns=wider.get("sigma_columns", scan.sigma_columns),
        sigma_z=wider.get("sigma_z", scan.sigma_z),
    )


def blur_variance_of(values: Map, sigma: Map, modulation: Map) -> float | None:
    """The variance of the camera's blur, squared camera pixels, by which brightness pulls coordinates here.

    Least squares of what a pixel's coordinate differs by from those REACH to both sides, by what brightness does.

    Returns:
        None where the scene has too little texture to tell.
    """
    across = [_pulls(*maps) for maps in ((values, sigma, modulation), (values.T, sigma.T, modulation.T))]
    apart, pull, noise = (np.concatenate([each[i] for each in across]) for i in range(3))
    strong = np.abs(pull) > noise
    if np.count_nonzero(strong) < max(LEAST_PULLED, LEAST_TEXTURED * pull.size):
        return None
    # Steps of the surface are no pull: none is further than the widest blur's.
    use = strong & (np.abs(apart) < 3 * noise + MOST_VARIANCE_PX2 * np.abs(pull))
    weight = 1 / (noise[use] ** 2 + (0.3 * pull[use]) ** 2)
    variance = float((weight * apart[use] * pull[use]).sum() / max((weight * pull[use] ** 2).sum(), 1e-12))
    return min(max(variance, 0.0), MOST_VARIANCE_PX2) or None


def _pulls(values: Map, sigma: Map, modulation: Map) -> tuple[Map, Map, Map]:
    """(n,) of pixels of some rows: coordinate and slope of log brightness, each less its mean REACH to either side;
    and the former's noise."""
    y = np.arange(REACH, values.shape[0] - REACH, LINES)
    here, bright = values[y], modulation[y]
    slope_x, slope_y, log_x = (np.full_like(here, np.nan) for _ in range(3))
    slope_x[:, REACH:-REACH] = (here[:, 2 * REACH :] - here[:, : -2 * REACH]) / (2 * REACH)
    slope_y[:] = (values[y + REACH] - values[y - REACH]) / (2 * REACH)
    log_x[:, 1:-1] = (bright[:, 2:] - bright[:, :-2]) / (bright[:, 2:] + bright[:, :-2] + _TINY)
    log_y = (modulation[y + 1] - modulation[y - 1]) / (modulation[y + 1] + modulation[y - 1] + _TINY)
    pull = log_x * slope_x + log_y * slope_y
    middle = slice(REACH, -REACH)
    apart, of_pull = (
        m[:, middle] - _HALF * (m[:, 2 * REACH :] + m[:, : -2 * REACH]) for m in (here, pull)
    )  # fmt: skip
    # The difference of one from the mean of two others: a variance of one and a half.
    noise = np.float32(1.5**0.5) * sigma[y][:, middle]
    known = np.isfinite(apart) & np.isfinite(of_pull) & np.isfinite(noise)
    return apart[known], of_pull[known], noise[known]


def warm_up() -> None:
    """Compile the kernel."""
    one = np.ones((3, 3), np.float32)
    _widen(one, one, one, np.float32(1), one, 0, 3, one.copy(), one.copy())


def _widened(values: Map, sigma: Map, modulation: Map, variance: float, depth: Map | None) -> tuple[Map, Map | None]:
    """Sigmas of coordinates, and those of depth grown by the same factor."""
    height, width = values.shape
    wider = np.empty_like(sigma)
    no_depth = np.empty((0, 0), np.float32)
    scaled = no_depth if depth is None else np.empty_like(depth)
    widen = partial(_widen, values, sigma, modulation, np.float32(variance), no_depth if depth is None else depth)
    threads = threads_to_use()

    def rows(begin: int, end: int) -> None:
        # Whole rows: the one that a strip begins in the middle of is the next strip's.
        widen(-(-begin // width), -(-end // width), wider, scaled)

    in_strips(rows, height * width, threads)
    return wider, None if depth is None else scaled


@contracting_kernel
def _widen(
    values: NDArray[np.float32],
    sigma: NDArray[np.float32],
    modulation: NDArray[np.float32],
    variance: np.float32,
    depth: NDArray[np.float32],
    begin: int,
    end: int,
    wider: NDArray[np.float32],
    scaled: NDArray[np.float32],
) -> None:
    """Rows begin .. end - 1 of (H, W) maps; wider is written, and scaled from depth, which may be (0, 0)."""
    height, width = values.shape
    pull = np.empty(width, np.float32)
    for y in range(begin, end):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        here, up, down = values[y], values[above], values[below]
        bright, bright_up, bright_down = modulation[y], modulation[above], modulation[below]
        # The image's own rim has one-sided slopes, too.
        inside = _NAN if y in (above, below) else _HALF
        pull[0] = _NAN
        pull[width - 1] = _NAN
        for x in range(1, width - 1):
            along_x = (bright[x + 1] - bright[x - 1]) / (bright[x + 1] + bright[x - 1] + _TINY)
            along_y = (bright_down[x] - bright_up[x]) / (bright_down[x] + bright_up[x] + _TINY)
            pull[x] = along_x * _HALF * (here[x + 1] - here[x - 1]) + along_y * inside * (down[x] - up[x])
        for x in range(width):
            if np.isnan(pull[x]) and not np.isnan(here[x]):
                pull[x] = _pull_at_rim(values, modulation, y, x)
        for x in range(width):
            moved = variance * pull[x]
            wider[y, x] = np.sqrt(sigma[y, x] * sigma[y, x] + moved * moved)
        if depth.size > 0:
            for x in range(width):
                scaled[y, x] = depth[y, x] * (wider[y, x] / sigma[y, x])


@contracting_kernel
def _pull_at_rim(values: NDArray[np.float32], modulation: NDArray[np.float32], y: int, x: int) -> np.float32:
    """Where a neighbour has no value: slopes from those that have one."""
    height, width = values.shape
    total = _F0
    for down, right in ((0, 1), (1, 0)):
        y0, y1 = max(y - down, 0), min(y + down, height - 1)
        x0, x1 = max(x - right, 0), min(x + right, width - 1)
        contrast = (modulation[y1, x1] - modulation[y0, x0]) / (modulation[y1, x1] + modulation[y0, x0] + _TINY)
        if np.isnan(values[y0, x0]):
            y0, x0 = y, x
        if np.isnan(values[y1, x1]):
            y1, x1 = y, x
        apart = max(abs(y1 - y0), abs(x1 - x0))
        if apart > 0:
            total += contrast * (values[y1, x1] - values[y0, x0]) / np.float32(apart)
    return total
