"""What is taken out of a cloud: points that fly at depth edges, specks, and what lies outside the user's limits.

A filter takes points (xyz), never measurements: rows and columns stay as decoded. Each counts what it removed.
The edge filter asks one question of each pair of neighbouring pixels: is the step between their points steeper than a
surface that can be measured (as May et al. 2009 find jump edges)? Two neighbours on one surface differ along the line
of sight by at most the pixel's footprint x tan(80 degrees), plus their noise. Where they differ by more there is a
depth edge, and both pixels may have seen both sides of it: both fall. What is left of a flying sheet are specks, which
fall by their size.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from scanner.filter_settings import DEFAULT_MAX_ANGLE_DEG, FilterSettings
from scanner.fragments import small_fragments
from scanner.kernel import contracting_kernel, kernel

Map = NDArray[np.float32]
Mask = NDArray[np.bool_]

NOISE_SIGMAS = 4.0
"""Of the difference of two neighbours: 6 in 100,000 steps on a smooth surface exceed it by chance."""

SPARSE_SHARE = 0.95
"""If this share of all points lies in fragments below the limit, the map is sparse by its method, and its points are no
specks: the fragment filter then leaves it alone. A noisy background around one object stays well below it."""

LINE_SHARE = 0.5
"""If this share of all points has a neighbour along one axis of the image and none along the other, they lie on lines
one pixel wide, sparse by the method as well (MCP's reference decoder: stripe peaks), however long the lines are."""

_QUIET = 0.6745 * math.sqrt(6.0)
"""Median of second differences over sigma, of depths exactly as noisy as sigma says."""


def apply_filters(xyz: Map, sigma_z: Map, confidence: Map, settings: FilterSettings) -> tuple[Mask, dict[str, int]]:
    """Which points fall, and how many to which filter.

    A point counts for the first filter that takes it: confidence, edges, depth, box, fragments. Fragments come last, so
    that what a limit leaves of something else falls with it.

    Args:
        xyz: (H, W, 3) float32 mm, camera frame, NaN = no point.
        sigma_z: (H, W) float32 mm; NaN counts as no noise.
        confidence: (H, W) float32.
        settings: which filters.

    Returns:
        (H, W) bool, True where a point there was falls; counts by filter, 0 for those that were not asked for.
    """
    z = xyz[..., 2]
    there = ~np.isnan(z)
    keep = there.copy()
    removed: dict[str, int] = {}

    def take(name: str, falls: Mask | None) -> None:
        removed[name] = 0
        if falls is not None:
            before = int(np.count_nonzero(keep))
            np.greater(keep, falls, out=keep)
            removed[name] = before - int(np.count_nonzero(keep))

    take("confidence", confidence < settings.min_confidence if settings.min_confidence > 0 else None)
    take("edges", at_depth_edge(xyz, sigma_z, keep, settings.max_angle_deg) if settings.edges else None)
    take("depth", _outside(z, settings.depth) if settings.depth else None)
    take("box", _outside_box(xyz, settings.box) if settings.box else None)
    take("fragments", _in_fragment(keep, settings.min_fragment) if settings.edges else None)
    return np.greater(there, keep), removed


def at_depth_edge(xyz: Map, sigma_z: Map, there: Mask, max_angle_deg: float = DEFAULT_MAX_ANGLE_DEG) -> Mask:
    """(H, W) bool: pixels with a neighbour (left, right, above, below) on the other side of a depth edge.

    The noise that is allowed for is the larger of sigma_z and what the points themselves show, so that a map noisier
    than it says is not torn apart.
    """
    noise = NOISE_SIGMAS * math.sqrt(2.0) * noise_factor(xyz[..., 2], sigma_z)
    edge = np.zeros(there.shape, np.bool_)
    _mark_edges(xyz, sigma_z, there, math.tan(math.radians(max_angle_deg)), noise, edge)
    return edge


def noise_factor(z: Map, sigma_z: Map) -> float:
    """How many times noisier the depths are than sigma_z says, at least 1.

    From second differences along lines, z[j-1] - 2 z[j] + z[j+1], which see noise (sqrt 6 sigma) and hardly any shape;
    their median is blind to edges.
    """
    second = np.empty(-(-z.shape[0] // 4) * z.shape[1], np.float32)
    count, quiet = _second_differences(z, sigma_z, np.float32(_QUIET), second)
    if count < 100 or quiet > count // 2:
        return 1.0  # both values in the middle lie below the limit
    return max(1.0, _median(second[:count]) / _QUIET)


def _median(values: NDArray[np.float32]) -> float:
    # np.median looks for NaN as well, at ten times the price.
    middle = values.size // 2
    parted = np.partition(values, middle)
    low = parted[middle] if values.size % 2 else parted[:middle].max()
    return float((low + parted[middle]) * np.float32(0.5))


def warm_up() -> None:
    """Compile the kernels."""
    xyz, z = np.ones((2, 2, 3), np.float32), np.ones((2, 2), np.float32)
    at_depth_edge(xyz, z, np.ones((2, 2), np.bool_))


def _outside(values: Map, limits: tuple[float, float]) -> Mask:
    return ~((values >= limits[0]) & (values <= limits[1]))


def _outside_box(xyz: Map, box: tuple[float, ...]) -> Mask:
    outside = _outside(xyz[..., 0], (box[0], box[1]))
    for axis in (1, 2):
        outside |= _outside(xyz[..., axis], (box[2 * axis], box[2 * axis + 1]))
    return outside


def _in_fragment(there: Mask, min_pixels: int) -> Mask:
    """(H, W) bool: pixels in connected regions (4 neighbours) smaller than `min_pixels`."""
    if min_pixels <= 1:
        return np.zeros_like(there)
    falls, count = small_fragments(there, min_pixels)
    if count > SPARSE_SHARE * np.count_nonzero(there) or _on_lines(there):
        return np.zeros_like(there)
    return falls


def _on_lines(there: Mask) -> bool:
    """Whether most points lie on lines one pixel wide."""
    beside, above = np.zeros_like(there), np.zeros_like(there)
    beside[:, 1:] = there[:, :-1]
    beside[:, :-1] |= there[:, 1:]
    above[1:] = there[:-1]
    above[:-1] |= there[1:]
    return bool(np.count_nonzero(there & (beside ^ above)) > LINE_SHARE * np.count_nonzero(there))


@contracting_kernel
def _second_differences(z: Map, sigma_z: Map, limit: np.float32, out: NDArray[np.float32]) -> tuple[int, int]:
    """|z[j-1] - 2 z[j] + z[j+1]| / sigma_z[j] of every fourth line, where finite: how many, and how many <= limit."""
    count, quiet = 0, 0
    for i in range(0, z.shape[0], 4):
        for j in range(1, z.shape[1] - 1):
            ratio = abs(z[i, j - 1] - np.float32(2) * z[i, j] + z[i, j + 1]) / sigma_z[i, j]
            out[count] = ratio
            finite = ratio < np.float32(np.inf)
            count += finite
            quiet += finite & (ratio <= limit)
    return count, quiet


@kernel
def _mark_edges(xyz: Map, sigma_z: Map, there: Mask, steepest: float, noise: float, edge: Mask) -> None:
    """Mark both pixels of every pair of neighbours whose step along the line of sight no surface explains."""
    height, width = there.shape
    here, below = np.empty((3, width), np.float32), np.empty((3, width), np.float32)
    across, down = np.zeros(width, np.uint8), np.zeros(width, np.uint8)
    steepest2 = np.float32(steepest * steepest)
    _split(xyz[0], here)
    for i in range(height):
        if _may_jump(here, 0, here, 1, width - 1, steepest2, across):
            for j in range(width - 1):
                if across[j] == 0 or not (there[i, j] and there[i, j + 1]):
                    continue
                if _jump(xyz, sigma_z, i, j, i, j + 1, steepest, noise):
                    edge[i, j] = edge[i, j + 1] = True
        if i + 1 == height:
            return
        _split(xyz[i + 1], below)
        if _may_jump(here, 0, below, 0, width, steepest2, down):
            for j in range(width):
                if down[j] == 0 or not (there[i, j] and there[i + 1, j]):
                    continue
                if _jump(xyz, sigma_z, i, j, i + 1, j, steepest, noise):
                    edge[i, j] = edge[i + 1, j] = True
        here, below = below, here


@contracting_kernel
def _split(points: Map, line: Map) -> None:
    for j in range(points.shape[0]):
        line[0, j], line[1, j], line[2, j] = points[j, 0], points[j, 1], points[j, 2]


@contracting_kernel
def _may_jump(
    ones: Map, at: int, others: Map, other_at: int, count: int, steepest2: np.float32, found: NDArray[np.uint8]
) -> bool:
    """Which of `count` pairs of points may lie steeper than `steepest2` (squared) allows, for `_jump` to look at.

    Points are columns of (3, W) from `at` and `other_at` on.

    In single precision and with a hundredth to spare: nearly all pairs are left behind here, many at a time.
    """
    limit, half = np.float32(0.99) * steepest2, np.float32(0.5)
    some = np.uint8(0)
    x, y, z = ones[0, at:], ones[1, at:], ones[2, at:]
    u, v, w = others[0, other_at:], others[1, other_at:], others[2, other_at:]
    for j in range(count):
        dx, dy, dz = u[j] - x[j], v[j] - y[j], w[j] - z[j]
        sx, sy, sz = x[j] + half * dx, y[j] + half * dy, z[j] + half * dz
        dot = dx * sx + dy * sy + dz * sz
        squares = (dx * dx + dy * dy + dz * dz) * (sx * sx + sy * sy + sz * sz)
        # dot^2 > limit x (squares - dot^2), without the difference
        steep = np.uint8(dot * dot * (np.float32(1) + limit) > limit * squares)
        found[j] = steep
        some |= steep
    return bool(some)


@kernel
def _jump(xyz: Map, sigma_z: Map, i: int, j: int, k: int, m: int, steepest: float, noise: float) -> bool:
    """Whether the step between two pixels' points is steeper than `steepest` (along / across sight) plus noise."""
    x, y, z = xyz[i, j, 0], xyz[i, j, 1], xyz[i, j, 2]
    dx, dy, dz = xyz[k, m, 0] - x, xyz[k, m, 1] - y, xyz[k, m, 2] - z
    # The line of sight through the middle of the two points; what the step has along it and across it.
    sx, sy, sz = x + 0.5 * dx, y + 0.5 * dy, z + 0.5 * dz
    square = sx * sx + sy * sy + sz * sz
    dot = dx * sx + dy * sy + dz * sz
    across2 = max((dx * dx + dy * dy + dz * dz) * square - dot * dot, 0.0)
    if dot * dot <= steepest * steepest * across2:
        return False
    sigma = max(sigma_z[i, j], sigma_z[k, m])
    allowed = noise * sigma if sigma > 0.0 else 0.0
    return bool((abs(dot) - steepest * math.sqrt(across2)) > allowed * math.sqrt(square))
