"""The loops of triangulation: a depth along each camera ray, from a row, or from row and column.

Loops over a line of pixels have no branches, touch few arrays and write each result once, so that the compiler can
prove the arrays apart and use vector instructions: 2 ms against 70 ms for 1392 x 1040 pixels. `numbers` is a tuple for
that reason. What the figures mean, and what is refused, stands in `scanner.triangulation`; the closed form is that of
Casey 2011, sec. 3.5, distortion Brown's (1966).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from scanner.geometry import Array
from scanner.kernel import contracting_kernel, kernel

Map = NDArray[np.float32]
Numbers = tuple[float, ...]
"""rotation (9), translation (3), fx, skew, cx, fy, cy, k1, k2, p1, p2, k3 of the projector"""
Triple = tuple[float, float, float]

MAX_RELATIVE_SIGMA = 0.1
"""A depth whose expected 1-sigma is above a tenth of itself is no measurement: at three sigma it is a third off."""

CONVERGED_PX = 1e-6
"""Newton's method has ended when the row's residual is this small: far below any sigma, far above rounding."""


@kernel
def along_rows(ray_x: Array, ray_y: Array, rows: Map, sigma_rows: Map, numbers: Numbers, xyz: Map, sigma_z: Map) -> int:
    """Fill xyz and sigma_z from rows alone; return how many measured pixels got no point."""
    height, width = rows.shape
    points = xyz.reshape(height, 3 * width)
    flat = np.array(numbers[17:22]) == 0.0
    ones, nowhere = np.ones(width, np.float32), np.empty(width, np.float32)
    impossible = 0
    for i in range(height):
        spread = sigma_rows[i] if sigma_rows.size > 0 else ones
        sigma = sigma_z[i] if sigma_rows.size > 0 else nowhere
        if flat.all():
            missing = _line_of_planes(ray_x[i], ray_y[i], rows[i], spread, numbers, points[i], sigma)
        else:
            missing = _line_of_curves(ray_x[i], ray_y[i], rows[i], spread, numbers, points[i], sigma)
            if missing > 0:
                missing = _rest_of_line(ray_x[i], ray_y[i], rows[i], spread, numbers, points[i], sigma)
        impossible += missing
    if sigma_rows.size == 0:
        sigma_z[:] = np.nan
    return impossible


@kernel
def along_both(
    ray_x: Array,
    ray_y: Array,
    rows: Map,
    columns: Map,
    sigma_rows: Map,
    sigma_columns: Map,
    numbers: Numbers,
    xyz: Map,
    sigma_z: Map,
) -> int:
    """Fill xyz and sigma_z from rows and columns, or from the one that a pixel has; return as `along_rows`."""
    height, width = rows.shape
    z, square = np.empty(width), np.empty(width)
    row, column = np.empty(width), np.empty(width)
    share, weight = np.empty(width), np.empty(width)
    impossible = 0
    for i in range(height):
        xs, ys = ray_x[i], ray_y[i]
        for j in range(width):
            sigma_row = np.float64(sigma_rows[i, j]) if sigma_rows.size > 0 else 1.0
            sigma_column = np.float64(sigma_columns[i, j]) if sigma_columns.size > 0 else 1.0
            row[j], weight_row = _weigh(np.float64(rows[i, j]), sigma_row)
            column[j], weight_column = _weigh(np.float64(columns[i, j]), sigma_column)
            weight[j] = weight_row + weight_column
            share[j] = weight_column / max(weight[j], 1e-300)
        for j in range(width):
            direction = _direction(xs[j], ys[j], numbers)
            depth = _start(row[j], column[j], share[j], direction, numbers)
            depth += _step(depth, row[j], column[j], share[j], direction, numbers)[0]
            z[j] = depth + _step(depth, row[j], column[j], share[j], direction, numbers)[0]
        for j in range(width):
            direction = _direction(xs[j], ys[j], numbers)
            step, per_mm = _step(z[j], row[j], column[j], share[j], direction, numbers)
            square[j] = per_mm if step * step * per_mm < CONVERGED_PX * CONVERGED_PX else np.nan
        for j in range(width):
            if weight[j] == 0.0:
                z[j] = np.nan
            elif math.isnan(square[j]):
                direction = _direction(xs[j], ys[j], numbers)
                z[j], square[j] = _finish(row[j], column[j], share[j], direction, numbers)
                impossible += math.isnan(z[j])
            square[j] = 1.0 / np.sqrt(square[j] * weight[j])
        impossible += _write(z, square, xs, ys, numbers, xyz[i], sigma_z[i])
    if sigma_rows.size == 0 and sigma_columns.size == 0:
        sigma_z[:] = np.nan
    return impossible


@kernel
def _line_of_planes(xs: Array, ys: Array, rows: Map, spread: Map, numbers: Numbers, points: Map, sigma_z: Map) -> int:
    """Write one line of points where the projector's lens distorts nothing; return how many rows gave none."""
    t1, t2, fy, cy = numbers[10], numbers[11], numbers[15], numbers[16]
    missing = 0
    for j in range(xs.size):
        _, a1, a2 = _direction(xs[j], ys[j], numbers)
        v = (np.float64(rows[j]) - cy) / fy
        across = a1 - v * a2
        z = (v * t2 - t1) / across
        before = z * a2 + t2
        sigma = np.float64(spread[j]) * before / (fy * abs(across))
        possible = (z > 0.0) & (before > 0.0) & (sigma <= MAX_RELATIVE_SIGMA * z)
        missing += (not possible) & (not math.isnan(rows[j]))
        _put(j, z if possible else np.nan, sigma if possible else np.nan, xs, ys, points, sigma_z)
    return missing


@contracting_kernel
def _line_of_curves(xs: Array, ys: Array, rows: Map, spread: Map, numbers: Numbers, points: Map, sigma_z: Map) -> int:
    """`_line_of_planes` for any lens, by two steps of Newton's method; where these are not enough there is no point.

    Without its lens the projector sees a camera's ray as a straight line, x = x0 + k (y - y0): the unknown is y, from
    which the depth follows.
    """
    t0, t1, t2, fy, cy = numbers[9], numbers[10], numbers[11], numbers[15], numbers[16]
    missing = 0
    for j in range(xs.size):
        a0, a1, a2 = _direction(xs[j], ys[j], numbers)
        y0 = (np.float64(rows[j]) - cy) / fy
        across, along = a1 - y0 * a2, y0 * t2 - t1
        before = along * a2 + across * t2
        inverse = 1.0 / (before * across)
        x0 = (along * a0 + across * t0) * (inverse * across)
        k = (a0 - x0 * a2) * (inverse * before)
        seen, slope = _bent(x0, y0, k, numbers)
        y = y0 + (y0 - seen) / slope
        seen, slope = _bent(x0 + k * (y - y0), y, k, numbers)
        y += (y0 - seen) / slope
        across = a1 - y * a2
        z = (y * t2 - t1) / across
        before = z * a2 + t2
        sigma = np.float64(spread[j]) * before / (fy * abs(slope * across))
        possible = (z > 0.0) & (before > 0.0) & (sigma <= MAX_RELATIVE_SIGMA * z)
        # Quadratic convergence: after a step of 0.01 px less than 1e-6 px is left.
        possible &= abs(y0 - seen) * fy < 0.01
        missing += (not possible) & (not math.isnan(rows[j]))
        _put(j, z if possible else np.nan, sigma if possible else np.nan, xs, ys, points, sigma_z)
    return missing


@contracting_kernel
def _bent(x: float, y: float, k: float, numbers: Numbers) -> tuple[float, float]:
    """Where the lens puts the direction (x, y), in y, and how that moves with y where x moves k times as far."""
    k1, k2, p1, p2, k3 = numbers[17:]
    r2 = x * x + y * y
    half = x * k + y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    dradial = half * (2.0 * k1 + r2 * (4.0 * k2 + 6.0 * r2 * k3))
    bent = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return bent, radial + y * dradial + p1 * (2.0 * half + 4.0 * y) + 2.0 * p2 * (x + y * k)


@kernel
def _put(j: int, z: float, sigma: float, xs: Array, ys: Array, points: Map, sigma_z: Map) -> None:
    points[3 * j], points[3 * j + 1], points[3 * j + 2] = z * xs[j], z * ys[j], z
    sigma_z[j] = sigma


@kernel
def _rest_of_line(xs: Array, ys: Array, rows: Map, spread: Map, numbers: Numbers, points: Map, sigma_z: Map) -> int:
    """Points for rows that `_line_of_curves` left without; return how many stay so."""
    missing = 0
    for j in range(xs.size):
        if math.isnan(rows[j]) or not math.isnan(points[3 * j + 2]):
            continue
        direction = _direction(xs[j], ys[j], numbers)
        z, square = _finish(np.float64(rows[j]), 0.0, 0.0, direction, numbers)
        sigma = np.float64(spread[j]) / np.sqrt(square)
        if z > 0.0 and z * direction[2] + numbers[11] > 0.0 and sigma <= MAX_RELATIVE_SIGMA * z:
            _put(j, z, sigma, xs, ys, points, sigma_z)
        else:
            missing += 1
    return missing


@kernel
def _direction(x: float, y: float, numbers: Numbers) -> Triple:
    """rotation @ (x, y, 1)."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = numbers[:9]
    return r00 * x + r01 * y + r02, r10 * x + r11 * y + r12, r20 * x + r21 * y + r22


@kernel
def _seen(z: float, direction: Triple, numbers: Numbers) -> tuple[float, float, float, float]:
    """Where the projector sees the ray's point at depth z, px, and how that moves with z, px / mm: row, column."""
    a0, a1, a2 = direction
    t0, t1, t2, fx, skew, cx, fy, cy, k1, k2, p1, p2, k3 = numbers[9:]
    w = 1.0 / (z * a2 + t2)
    x, y = (z * a0 + t0) * w, (z * a1 + t1) * w
    dx, dy = (a0 - x * a2) * w, (a1 - y * a2) * w
    r2 = x * x + y * y
    dr2 = 2.0 * (x * dx + y * dy)
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    dradial = dr2 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    xy, dxy = 2.0 * x * y, 2.0 * (x * dy + y * dx)
    xd = x * radial + p1 * xy + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + p2 * xy
    dxd = dx * radial + x * dradial + p1 * dxy + p2 * (dr2 + 4.0 * x * dx)
    dyd = dy * radial + y * dradial + p1 * (dr2 + 4.0 * y * dy) + p2 * dxy
    return fy * yd + cy, fx * xd + skew * yd + cx, fy * dyd, fx * dxd + skew * dyd


@kernel
def _start(row: float, column: float, share: float, direction: Triple, numbers: Numbers) -> float:
    """Depth at which the ray meets the planes of row and column, distortion left out.

    Point on plane: z (a1 - v a2) + (t1 - v t2) = 0 with v the normalised row; likewise the column; least squares with
    the column's share of the weight.
    """
    a0, a1, a2 = direction
    t0, t1, t2, fx, skew, cx, fy, cy = numbers[9:17]
    v = (row - cy) / fy
    u = (column - cx - skew * v) / fx
    gv, gu = fy * (a1 - v * a2), fx * (a0 - u * a2)
    hv, hu = fy * (t1 - v * t2), fx * (t0 - u * t2)
    return -((1.0 - share) * gv * hv + share * gu * hu) / ((1.0 - share) * gv * gv + share * gu * gu)


@kernel
def _start_of_row(row: float, direction: Triple, numbers: Numbers) -> float:
    """`_start` for a row alone."""
    _, a1, a2 = direction
    v = (row - numbers[16]) / numbers[15]
    return (v * numbers[11] - numbers[10]) / (a1 - v * a2)


@kernel
def _step(
    z: float, row: float, column: float, share: float, direction: Triple, numbers: Numbers
) -> tuple[float, float]:
    """One Gauss-Newton step: its length, mm, and the weighted square of the px that 1 mm of depth moves."""
    seen_row, seen_column, drow, dcolumn = _seen(z, direction, numbers)
    square = (1.0 - share) * drow * drow + share * dcolumn * dcolumn
    slope = (1.0 - share) * drow * (row - seen_row) + share * dcolumn * (column - seen_column)
    return slope / square, square


@kernel
def _finish(row: float, column: float, share: float, direction: Triple, numbers: Numbers) -> tuple[float, float]:
    """z and `_step`'s square after as many steps as it takes, 20 at most; NaN if they do not end."""
    z = _start(row, column, share, direction, numbers)
    for _ in range(20):
        step, square = _step(z, row, column, share, direction, numbers)
        z += step
        if not z > 0.0:
            break
        if step * step * square < CONVERGED_PX * CONVERGED_PX:
            return z, square
    return np.nan, np.nan


@kernel
def _weigh(value: float, sigma: float) -> tuple[float, float]:
    """Value and weight 1 / sigma^2, both 0 where it was not measured."""
    if math.isnan(value) or not sigma > 0.0:
        return 0.0, 0.0
    return value, 1.0 / (sigma * sigma)


@kernel
def _write(z: Array, sigma: Array, xs: Array, ys: Array, numbers: Numbers, points: Map, sigma_z: Map) -> int:
    """Write one line of points, NaN where z is NaN or impossible; return the number of the latter."""
    impossible = 0
    for j in range(z.size):
        before = z[j] * (numbers[6] * xs[j] + numbers[7] * ys[j] + numbers[8]) + numbers[11]
        possible = (z[j] > 0.0) & (before > 0.0) & (sigma[j] <= MAX_RELATIVE_SIGMA * z[j])
        impossible += (not possible) & (not math.isnan(z[j]))
        depth = z[j] if possible else np.nan
        points[j, 0], points[j, 1], points[j, 2] = depth * xs[j], depth * ys[j], depth
        sigma_z[j] = sigma[j] if possible else np.nan
    return impossible
