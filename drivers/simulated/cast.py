"""Ray casting: what each camera pixel sees, and whether the projector's light reaches it.

Planes, spheres and boxes are met exactly; a height field is marched and its crossing bisected. Nothing here knows
of light: shading and patterns are in `optics`. Bodies are rows of one float64 array, so that one kernel meets all.
"""

# Kernels: numba types their arguments.
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.kernel import kernel

Array = NDArray[np.float64]

RECTANGLE, SPHERE, BOX, HEIGHT_FIELD = 0.0, 1.0, 2.0, 3.0

BODY_LENGTH = 16
"""kind, centre (3), axes u, v, w (9), half extents (3); see the constructors below"""

MARCH_STEP_MM = 0.75
TILE_CELLS = 12
"""Tiles of a height field, whose greatest heights let rays pass over empty space"""
BISECTIONS = 40
"""Halvings of one march step: 0.75 mm / 2^40 is below float64's resolution of a depth."""


@dataclass(frozen=True, eq=False)
class HeightField:
    """Surface z = base_z - height(x, y) on a regular grid, bilinear between its nodes; nothing where height < 0.

    height: (ny, nx) float64 mm towards the camera. The first node stands at (x0, y0).
    """

    x0: float
    y0: float
    base_z: float
    cell_mm: float
    height: Array


@dataclass(frozen=True, eq=False)
class Hits:
    """What rays met, N rays. distance: along the ray's own vector, NaN for nothing; body: its index or -1."""

    distance: Array
    body: NDArray[np.int32]
    normal: Array
    """(N, 3), turned towards the camera"""


def rectangle(centre: Array, u: Array, v: Array, half_u: float = np.inf, half_v: float = np.inf) -> Array:
    """A rectangle, endless by default; u, v: unit vectors in it."""
    return _body(RECTANGLE, centre, np.stack((u, v, np.cross(u, v))), (half_u, half_v, 0.0))


def sphere(centre: Array, radius: float) -> Array:
    """A sphere."""
    return _body(SPHERE, centre, np.eye(3), (radius, radius, radius))


def box(centre: Array, axes: Array, half: Array) -> Array:
    """A box; axes: (3, 3) rows are its unit axes, half: (3,) half extents along them."""
    return _body(BOX, centre, axes, tuple(half))


def height_body(field: HeightField) -> Array:
    """The body that stands for the scene's height field."""
    centre = np.array([field.x0, field.y0, field.base_z])
    return _body(HEIGHT_FIELD, centre, np.eye(3), (field.cell_mm, float(field.height.max()), 0.0))


def cast_rays(origin: Array, directions: Array, bodies: Array, field: HeightField | None) -> Hits:
    """First meeting of each ray with the bodies.

    Args:
        origin: (3,) mm.
        directions: (N, 3), any length; distances are in units of it.
        bodies: (M, BODY_LENGTH).
        field: what a body of kind HEIGHT_FIELD means.
    """
    n = len(directions)
    hits = Hits(np.empty(n), np.empty(n, dtype=np.int32), np.empty((n, 3)))
    height, slope_x, slope_y, tiles = _field_arrays(field)
    _first_hits(origin, directions, bodies, height, slope_x, slope_y, tiles, hits.distance, hits.body, hits.normal)
    return hits


def lit_points(
    origin: Array, directions: Array, hits: Hits, light: Array, bodies: Array, field: HeightField | None
) -> NDArray[np.bool_]:
    """(N,) bool: what the ray met faces `light` (3,) and no body stands between. Arguments as for `cast_rays`."""
    lit = np.empty(len(directions), dtype=np.bool_)
    height, slope_x, slope_y, tiles = _field_arrays(field)
    _lit(origin, directions, hits.distance, hits.normal, hits.body, light, bodies, height, slope_x, slope_y, tiles, lit)
    return lit


def _body(kind: float, centre: Array, axes: Array, half: tuple[float, ...]) -> Array:
    return np.concatenate(([kind], centre, axes.ravel(), half)).astype(np.float64)


def _field_arrays(field: HeightField | None) -> tuple[Array, Array, Array, Array]:
    if field is None:
        empty = np.zeros((2, 2))
        return empty, empty, empty, empty
    slope_y, slope_x = np.gradient(field.height, field.cell_mm)
    return field.height, np.ascontiguousarray(slope_x), np.ascontiguousarray(slope_y), _tile_tops(field.height)


def _tile_tops(height: Array) -> Array:
    """Greatest height over each tile and its eight neighbours: nothing within a tile's width is higher."""
    rows, columns = (-(-n // TILE_CELLS) for n in height.shape)
    padded = np.pad(
        height, ((0, rows * TILE_CELLS - height.shape[0]), (0, columns * TILE_CELLS - height.shape[1])), "edge"
    )
    tops = padded.reshape(rows, TILE_CELLS, columns, TILE_CELLS).max(axis=(1, 3))
    around = np.pad(tops, 1, "edge")
    tiles: Array = np.max([around[r : r + rows, c : c + columns] for r in range(3) for c in range(3)], axis=0)
    return tiles


# --- kernels: scalars in, scalars out, so that the compiler keeps them in registers ------------------------------


@kernel
def _first_hits(origin, directions, bodies, height, slope_x, slope_y, tiles, distance, body, normal):
    ox, oy, oz = origin[0], origin[1], origin[2]
    for i in range(directions.shape[0]):
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        nearest, which = np.inf, -1
        nx, ny, nz = 0.0, 0.0, 0.0
        for m in range(bodies.shape[0]):
            if _passes(bodies, m, ox, oy, oz, dx, dy, dz):
                continue
            if bodies[m, 0] == HEIGHT_FIELD:
                t, ax, ay, az = _meet_field(
                    bodies[m], height, slope_x, slope_y, tiles, ox, oy, oz, dx, dy, dz, 0.0, nearest
                )
            else:
                t, ax, ay, az = _meet_convex(bodies[m], ox, oy, oz, dx, dy, dz)
            if 1e-9 < t < nearest:
                nearest, which, nx, ny, nz = t, m, ax, ay, az
        distance[i] = nearest if which >= 0 else np.nan
        body[i] = which
        towards = -1.0 if nx * dx + ny * dy + nz * dz > 0 else 1.0
        normal[i, 0], normal[i, 1], normal[i, 2] = towards * nx, towards * ny, towards * nz


@kernel
def _lit(origin, directions, distance, normal, body, light, bodies, height, slope_x, slope_y, tiles, lit):
    for i in range(directions.shape[0]):
        lit[i] = False
        own = body[i]
        if own < 0:
            continue
        far = distance[i]
        ox, oy, oz = (
            origin[0] + far * directions[i, 0],
            origin[1] + far * directions[i, 1],
            origin[2] + far * directions[i, 2],
        )
        dx, dy, dz = light[0] - ox, light[1] - oy, light[2] - oz
        if normal[i, 0] * dx + normal[i, 1] * dy + normal[i, 2] * dz <= 0:
            continue
        free = True
        for m in range(bodies.shape[0]):
            convex = bodies[m, 0] != HEIGHT_FIELD
            if (m == own and convex) or _passes(bodies, m, ox, oy, oz, dx, dy, dz):
                continue  # a convex body shades itself only where it faces away
            start = 1e-7
            if convex:
                t, _, _, _ = _meet_convex(bodies[m], ox, oy, oz, dx, dy, dz)
            else:
                # A marched surface is met again by rays that leave it: begin one step and a half off.
                start = start if m != own else 1.5 * MARCH_STEP_MM / np.sqrt(dx * dx + dy * dy + dz * dz)
                t, _, _, _ = _meet_field(bodies[m], height, slope_x, slope_y, tiles, ox, oy, oz, dx, dy, dz, start, 1.0)
            if start < t < 1.0 - 1e-9:
                free = False
                break
        lit[i] = free


@kernel
def _passes(bodies, m, ox, oy, oz, dx, dy, dz):
    """Whether a ray passes by the sphere around a ball or box, as most do; never true for other bodies."""
    if bodies[m, 0] != SPHERE and bodies[m, 0] != BOX:
        return False
    px, py, pz = bodies[m, 1] - ox, bodies[m, 2] - oy, bodies[m, 3] - oz
    forward = px * dx + py * dy + pz * dz
    off2 = px * px + py * py + pz * pz - forward * forward / (dx * dx + dy * dy + dz * dz)
    return off2 > bodies[m, 13] ** 2 + bodies[m, 14] ** 2 + bodies[m, 15] ** 2


@kernel
def _meet_convex(body, ox, oy, oz, dx, dy, dz):
    """Distance (inf for none) and normal of the first meeting of a ray with a body that is no height field."""
    if body[0] == RECTANGLE:
        return _meet_rectangle(body, ox, oy, oz, dx, dy, dz)
    if body[0] == SPHERE:
        return _meet_sphere(body, ox, oy, oz, dx, dy, dz)
    return _meet_box(body, ox, oy, oz, dx, dy, dz)


@kernel
def _meet_rectangle(body, ox, oy, oz, dx, dy, dz):
    nx, ny, nz = body[10], body[11], body[12]
    along = nx * dx + ny * dy + nz * dz
    px, py, pz = body[1] - ox, body[2] - oy, body[3] - oz
    t = (nx * px + ny * py + nz * pz) / along
    rx, ry, rz = t * dx - px, t * dy - py, t * dz - pz
    if abs(rx * body[4] + ry * body[5] + rz * body[6]) > body[13]:
        return np.inf, nx, ny, nz
    if abs(rx * body[7] + ry * body[8] + rz * body[9]) > body[14]:
        return np.inf, nx, ny, nz
    return (t if t > 0 else np.inf), nx, ny, nz


@kernel
def _meet_sphere(body, ox, oy, oz, dx, dy, dz):
    px, py, pz = ox - body[1], oy - body[2], oz - body[3]
    a = dx * dx + dy * dy + dz * dz
    half_b = px * dx + py * dy + pz * dz
    root = half_b * half_b - a * (px * px + py * py + pz * pz - body[13] * body[13])
    if root < 0:
        return np.inf, 0.0, 0.0, 0.0
    t = (-half_b - np.sqrt(root)) / a
    return (
        (t if t > 0 else np.inf),
        (px + t * dx) / body[13],
        (py + t * dy) / body[13],
        (pz + t * dz) / body[13],
    )


@kernel
def _meet_box(body, ox, oy, oz, dx, dy, dz):
    enter, leave, face = -np.inf, np.inf, 0
    px, py, pz = body[1] - ox, body[2] - oy, body[3] - oz
    for k in range(3):
        ax, ay, az = body[4 + 3 * k], body[5 + 3 * k], body[6 + 3 * k]
        centre = ax * px + ay * py + az * pz
        speed = ax * dx + ay * dy + az * dz
        if abs(speed) < 1e-300:
            speed = 1e-300
        t1, t2 = (centre - body[13 + k]) / speed, (centre + body[13 + k]) / speed
        if t1 > t2:
            t1, t2 = t2, t1
        if t1 > enter:
            enter, face = t1, k
        leave = min(leave, t2)
    if enter > leave or enter <= 0:
        return np.inf, 0.0, 0.0, 0.0
    return enter, body[4 + 3 * face], body[5 + 3 * face], body[6 + 3 * face]


@kernel
def _meet_field(body, height, slope_x, slope_y, tiles, ox, oy, oz, dx, dy, dz, start, stop):
    cell, top = body[13], body[14]
    x0, y0, base = body[1], body[2], body[3]
    first, last = _clip(ox, dx, x0, x0 + cell * (height.shape[1] - 1), start, stop)
    first, last = _clip(oy, dy, y0, y0 + cell * (height.shape[0] - 1), first, last)
    first, last = _clip(oz, dz, base - top - 1e-6, base, first, last)
    if first >= last:
        return np.inf, 0.0, 0.0, 0.0
    step = MARCH_STEP_MM / np.sqrt(dx * dx + dy * dy + dz * dz)
    across = max(abs(dx), abs(dy), 1e-12)
    tile = cell * TILE_CELLS
    before, t = first, first
    while True:
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        if _inside(height, cell, x0, y0, base, x, y, z):
            break
        if t >= last:
            return np.inf, 0.0, 0.0, 0.0
        before = t
        r = min(int((y - y0) / tile), tiles.shape[0] - 1)
        c = min(int((x - x0) / tile), tiles.shape[1] - 1)
        free = base - tiles[r, c] - z
        ahead = step
        if free > 0:  # nothing up to a tile's width away reaches this ray before it has gone `free` deeper
            ahead = max(step, min(tile / across, free / dz if dz > 0 else np.inf))
        t = min(t + ahead, last)
    after = t
    for _ in range(BISECTIONS):
        middle = 0.5 * (before + after)
        if _inside(height, cell, x0, y0, base, ox + middle * dx, oy + middle * dy, oz + middle * dz):
            after = middle
        else:
            before = middle
    u, v = (ox + after * dx - x0) / cell, (oy + after * dy - y0) / cell
    gx, gy = _bilinear(slope_x, u, v), _bilinear(slope_y, u, v)
    norm = np.sqrt(gx * gx + gy * gy + 1.0)
    return after, -gx / norm, -gy / norm, -1.0 / norm


@kernel
def _clip(o, d, low, high, first, last):
    if abs(d) < 1e-12:
        return (first, last) if low <= o <= high else (1.0, 0.0)
    t1, t2 = (low - o) / d, (high - o) / d
    return max(first, min(t1, t2)), min(last, max(t1, t2))


@kernel
def _inside(height, cell, x0, y0, base, x, y, z):
    return z >= base - _bilinear(height, (x - x0) / cell, (y - y0) / cell)


@kernel
def _bilinear(grid, u, v):
    c = min(max(int(u), 0), grid.shape[1] - 2)
    r = min(max(int(v), 0), grid.shape[0] - 2)
    a, b = u - c, v - r
    upper = grid[r, c] + a * (grid[r, c + 1] - grid[r, c])
    lower = grid[r + 1, c] + a * (grid[r + 1, c + 1] - grid[r + 1, c])
    return upper + b * (lower - upper)


def warm_up() -> None:
    """Compile the kernels (or load them from their cache)."""
    field = HeightField(-1.0, -1.0, 11.0, 1.0, np.ones((3, 3)))
    bodies = np.stack((rectangle(np.array([0.0, 0.0, 20.0]), np.eye(3)[0], np.eye(3)[1]), height_body(field)))
    rays = np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 1.0]])
    hits = cast_rays(np.zeros(3), rays, bodies, field)
    lit_points(np.zeros(3), rays, hits, np.array([0.0, -5.0, 0.0]), bodies, field)
