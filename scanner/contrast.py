"""How far a surface's own brightness pulls coordinates: within the camera's blur, the bright side of an edge wins.

A pixel sees its neighbourhood through a blur of some pixel's width. Fringes of the brighter side outweigh those of the
darker, so that the coordinate read is one of a place a little towards the light: by the blur's variance times the
gradient of log brightness (the first moment of a Gaussian times a slope). That is no noise: it stays
however often a scan is repeated, but it changes sign from edge to edge. Sigmas are widened by its size; coordinates are
left as they were read.
"""

from __future__ import annotations

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


def widen_at_edges(scan: Scan, phase_axis: str, blur_variance_px2: float = BLUR_VARIANCE_PX2) -> Scan:
    """The same scan with sigmas that cover what changes of brightness pull, in its maps and in its report.

    After the filters: how steep a step may be is told by noise, and a pull makes none.

    Args:
        scan: whose `modulation` is the height of what coordinates are read from.
        phase_axis: the axis that depth comes from, where both were projected.
        blur_variance_px2: of the camera's blur, squared camera pixels.
    """
    wider: dict[str, Map] = {}
    factor: Map | None = None
    for axis, name in (("y", "rows"), ("x", "columns")):
        values, sigma = getattr(scan, name), getattr(scan, f"sigma_{name}")
        if values is not None and sigma is not None:
            wider[f"sigma_{name}"] = _widened(values, sigma, scan.modulation, blur_variance_px2)
            if factor is None or axis == phase_axis:
                factor = wider[f"sigma_{name}"] / sigma
    if scan.sigma_z is not None and factor is not None:
        wider["sigma_z"] = scan.sigma_z * factor
    told = {f"{name}_{'mm' if name == 'sigma_z' else 'px'}": spread(values) for name, values in wider.items()}
    return replace(
        scan,
        report={**scan.report, **told},
        sigma_rows=wider.get("sigma_rows", scan.sigma_rows),
        sigma_columns=wider.get("sigma_columns", scan.sigma_columns),
        sigma_z=wider.get("sigma_z", scan.sigma_z),
    )


def warm_up() -> None:
    """Compile the kernel."""
    one = np.ones((3, 3), np.float32)
    _widen(one, one, one, np.float32(1), 0, 3, one.copy())


def _widened(values: Map, sigma: Map, modulation: Map, variance: float) -> Map:
    height, width = values.shape
    wider = np.empty_like(sigma)
    widen = partial(_widen, values, sigma, modulation, np.float32(variance))
    threads = threads_to_use()

    def rows(begin: int, end: int) -> None:
        # Whole rows: the one that a strip begins in the middle of is the next strip's.
        widen(-(-begin // width), -(-end // width), wider)

    in_strips(rows, height * width, threads)
    return wider


@contracting_kernel
def _widen(
    values: NDArray[np.float32],
    sigma: NDArray[np.float32],
    modulation: NDArray[np.float32],
    variance: np.float32,
    begin: int,
    end: int,
    wider: NDArray[np.float32],
) -> None:
    """Rows begin .. end - 1 of (H, W) maps; wider is written."""
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
