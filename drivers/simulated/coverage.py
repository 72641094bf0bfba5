"""How much of a camera pixel's footprint each colour of a print covers, exactly: no samples, no staircases.

A footprint is the parallelogram that a pixel's square is on the printed plane. What a print has within it is an
integral over that area, and by Green's theorem one along its four sides: over a raster of square cells it is a sum
over the pieces that the cells' borders cut the sides into; over a disc, the areas between its centre and each side.
"""

# Kernels: numba types their arguments.
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

import numpy as np

from scanner.kernel import kernel


@kernel
def raster_mean(values, tiled, around, u, v, ax, ay, bx, by):
    """Mean of a raster over a parallelogram, in cells.

    Args:
        values: (H, W) float32 of the cells; cell (0, 0) spans 0 .. 1 along both axes.
        tiled: the raster repeats beyond its borders; else `around` is there.
        around: float32.
        u, v: the parallelogram's middle, along columns and rows.
        ax, ay, bx, by: its two sides.
    """
    wide, high = 0.5 * (abs(ax) + abs(bx)), 0.5 * (abs(ay) + abs(by))
    first, last = int(np.floor(u - wide)), int(np.floor(u + wide))
    top, bottom = int(np.floor(v - high)), int(np.floor(v + high))
    common = _cell(values, tiled, around, top, first)
    plain = True
    for row in range(top, bottom + 1):
        for column in range(first, last + 1):
            plain = plain and _cell(values, tiled, around, row, column) == common
    area = ax * by - ay * bx
    if plain or area == 0.0:
        return common
    # Corners in order; from the bounding box's own corner, so that no digits are lost far from the origin.
    x, y = u - first - 0.5 * (ax + bx), v - top - 0.5 * (ay + by)
    total = _side(values, tiled, around, top, first, x, y, ax, ay)
    total += _side(values, tiled, around, top, first, x + ax, y + ay, bx, by)
    total += _side(values, tiled, around, top, first, x + ax + bx, y + ay + by, -ax, -ay)
    total += _side(values, tiled, around, top, first, x + bx, y + by, -bx, -by)
    return np.float32(total / area)


@kernel
def _cell(values, tiled, around, row, column):
    height, width = values.shape
    if tiled:
        return values[row % height, column % width]
    if 0 <= row < height and 0 <= column < width:
        return values[row, column]
    return around


@kernel
def _side(values, tiled, around, top, first, x, y, dx, dy):
    """Integral along a side of (the raster's integral from column `first` to x) dy; x, y from the box's corner."""
    if dy == 0.0:
        return 0.0
    total, begun = 0.0, 0.0
    while begun < 1.0:
        # The cell that the side is in just after `begun`, and where it leaves that cell.
        column, ahead = _next_border(x, dx, begun)
        row, below = _next_border(y, dy, begun)
        ended = min(ahead, below, 1.0)
        if ended <= begun:
            ended = min(np.nextafter(begun, 2.0), 1.0)
        middle = x + 0.5 * (begun + ended) * dx
        from_left = (middle - column) * _cell(values, tiled, around, top + row, first + column)
        for c in range(column):
            from_left += _cell(values, tiled, around, top + row, first + c)
        total += from_left * (ended - begun) * dy
        begun = ended
    return total


@kernel
def _next_border(x, dx, begun):
    """Of a point x + t dx: its cell just after t = begun, 0 or more, and the t at which it leaves it."""
    at = x + begun * dx
    if dx > 0.0:
        cell = int(np.floor(at + 1e-12))
        ahead = (cell + 1 - x) / dx
    elif dx < 0.0:
        cell = int(np.ceil(at - 1e-12)) - 1
        ahead = (cell - x) / dx
    else:
        cell, ahead = int(np.floor(at)), 2.0
    return max(cell, 0), ahead


@kernel
def disc_share(u, v, ax, ay, bx, by, radius):
    """Share of a parallelogram that a disc about the origin covers.

    Args:
        u, v: the parallelogram's middle.
        ax, ay, bx, by: its two sides.
        radius: of the disc.
    """
    reach = 0.5 * (np.hypot(ax, ay) + np.hypot(bx, by))
    far = np.hypot(u, v)
    if far >= radius + reach:
        return 0.0
    if far <= radius - reach:
        return 1.0
    x, y = u - 0.5 * (ax + bx), v - 0.5 * (ay + by)
    covered = _disc_side(x, y, x + ax, y + ay, radius)
    covered += _disc_side(x + ax, y + ay, x + ax + bx, y + ay + by, radius)
    covered += _disc_side(x + ax + bx, y + ay + by, x + bx, y + by, radius)
    covered += _disc_side(x + bx, y + by, x, y, radius)
    return covered / (ax * by - ay * bx)


@kernel
def _disc_side(px, py, qx, qy, radius):
    """Signed area that the triangle of the disc's centre and a side has in common with the disc."""
    dx, dy = qx - px, qy - py
    a, half_b = dx * dx + dy * dy, px * dx + py * dy
    c = px * px + py * py - radius * radius
    root = half_b * half_b - a * c
    if root <= 0.0:
        return _sector(px, py, qx, qy, radius)
    enter, leave = (-half_b - np.sqrt(root)) / a, (-half_b + np.sqrt(root)) / a
    if enter >= 1.0 or leave <= 0.0:
        return _sector(px, py, qx, qy, radius)
    enter, leave = max(enter, 0.0), min(leave, 1.0)
    ex, ey, lx, ly = px + enter * dx, py + enter * dy, px + leave * dx, py + leave * dy
    inside = 0.5 * (ex * ly - ey * lx)
    return _sector(px, py, ex, ey, radius) + inside + _sector(lx, ly, qx, qy, radius)


@kernel
def _sector(px, py, qx, qy, radius):
    """Signed area of the disc's sector between two directions, less than half a turn apart."""
    return 0.5 * radius * radius * np.arctan2(px * qy - py * qx, px * qx + py * qy)
