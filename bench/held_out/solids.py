"""Solids as signed distances, and rays that meet them by sphere tracing (Hart 1996).

A scene is a table, one primitive a line: kind, then its numbers. Distances are in mm and positive outside; the frame is
the camera's, its origin moved to the target.
"""

from __future__ import annotations

import math

import numba
import numpy as np

COLUMNS = 20
PLANE, SPHERE, BOX, TORUS, ROD, BOWL, GROOVE, CLOTH, BALL = range(9)
"""BALLs melt into one another; all others are joined as they are."""

EPSILON = 1e-5
"""mm: nearer than this is met"""


def plane(normal, offset):
    """Solid below: normal . p < offset."""
    n = np.asarray(normal, float)
    return _row(PLANE, *(n / np.linalg.norm(n)), offset)


def sphere(centre, radius):
    return _row(SPHERE, *centre, radius)


def box(centre, half, turned_deg=(0.0, 0.0, 0.0), rounded=0.5):
    return _row(BOX, *centre, *half, rounded, *_turn(turned_deg).ravel())


def torus(centre, radius, thick, turned_deg=(0.0, 0.0, 0.0)):
    return _row(TORUS, *centre, radius, thick, *_turn(turned_deg).ravel())


def rod(start, end, radius):
    return _row(ROD, *start, *end, radius)


def bowl(centre, radius, face):
    """A ball taken out of the solid behind z = face."""
    return _row(BOWL, *centre, radius, face)


def groove(depth, half_opening, face, turned_deg):
    """A straight V taken out of the solid behind z = face."""
    across = half_opening * math.cos(math.radians(turned_deg)), half_opening * math.sin(math.radians(turned_deg))
    n = np.hypot(depth, half_opening)
    return _row(GROOVE, across[0] / half_opening, across[1] / half_opening, depth / n, half_opening / n, depth, face)


def cloth(amplitudes, waves, face):
    """z = face + sum a sin(kx x + ky y + p), four waves of (kx, ky, p)."""
    steep = sum(abs(a) * math.hypot(w[0], w[1]) for a, w in zip(amplitudes, waves, strict=True))
    numbers = [n for a, w in zip(amplitudes, waves, strict=True) for n in (a, *w)]
    return _row(CLOTH, face, 1 / math.hypot(1, steep), *numbers)


def ball(centre, radius, melting):
    return _row(BALL, *centre, radius, melting)


def _row(*numbers):
    return np.concatenate((np.asarray(numbers, np.float64), np.zeros(COLUMNS - len(numbers))))


def _turn(degrees):
    a, b, c = np.radians(degrees)
    rx = np.array([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]])
    ry = np.array([[math.cos(b), 0, math.sin(b)], [0, 1, 0], [-math.sin(b), 0, math.cos(b)]])
    rz = np.array([[math.cos(c), -math.sin(c), 0], [math.sin(c), math.cos(c), 0], [0, 0, 1]])
    return rz @ ry @ rx


@numba.njit(cache=True, error_model="numpy")
def _primitive(s, x, y, z):  # noqa: PLR0911  (one for each kind)
    kind = int(s[0])
    if kind == 0:
        return s[1] * x + s[2] * y + s[3] * z - s[4]
    if kind == 1 or kind == 8:  # noqa: PLR1714  (numba would make a set of them, each time)
        return math.sqrt((x - s[1]) ** 2 + (y - s[2]) ** 2 + (z - s[3]) ** 2) - s[4]
    if kind == 2 or kind == 3:  # noqa: PLR1714
        dx, dy, dz = x - s[1], y - s[2], z - s[3]
        o = 8 if kind == 2 else 6
        u = s[o] * dx + s[o + 3] * dy + s[o + 6] * dz
        v = s[o + 1] * dx + s[o + 4] * dy + s[o + 7] * dz
        w = s[o + 2] * dx + s[o + 5] * dy + s[o + 8] * dz
        if kind == 3:
            return math.hypot(math.hypot(u, v) - s[4], w) - s[5]
        r = s[7]
        u, v, w = abs(u) - s[4] + r, abs(v) - s[5] + r, abs(w) - s[6] + r
        out = math.sqrt(max(u, 0.0) ** 2 + max(v, 0.0) ** 2 + max(w, 0.0) ** 2)
        return out + min(max(u, v, w), 0.0) - r
    if kind == 4:
        ax, ay, az = s[4] - s[1], s[5] - s[2], s[6] - s[3]
        dx, dy, dz = x - s[1], y - s[2], z - s[3]
        h = min(max((dx * ax + dy * ay + dz * az) / (ax * ax + ay * ay + az * az), 0.0), 1.0)
        return math.sqrt((dx - h * ax) ** 2 + (dy - h * ay) ** 2 + (dz - h * az) ** 2) - s[7]
    if kind == 5:
        return max(s[5] - z, s[4] - math.sqrt((x - s[1]) ** 2 + (y - s[2]) ** 2 + (z - s[3]) ** 2))
    if kind == 6:
        across = abs(s[1] * x + s[2] * y)
        return max(s[6] - z, s[4] * (s[6] + s[5] - z) - s[3] * across)
    height = s[1]
    for k in range(4):
        height += s[3 + 4 * k] * math.sin(s[4 + 4 * k] * x + s[5 + 4 * k] * y + s[6 + 4 * k])
    return (height - z) * s[2]


@numba.njit(cache=True, error_model="numpy")
def distance(scene, x, y, z):
    """Signed distance of the whole scene, and which primitive is nearest."""
    nearest, which = 1e9, -1
    melted, soft = 1e9, -1
    for i in range(scene.shape[0]):
        d = _primitive(scene[i], x, y, z)
        if scene[i, 0] == 8:
            if soft < 0:
                melted, soft = d, i
            else:  # polynomial smooth minimum
                k = scene[i, 5]
                h = max(k - abs(melted - d), 0.0) / k
                melted = min(melted, d) - h * h * k * 0.25
        elif d < nearest:
            nearest, which = d, i
    return (melted, soft) if melted < nearest else (nearest, which)


@numba.njit(cache=True, error_model="numpy")
def _march(scene, ox, oy, oz, dx, dy, dz, start, end):
    """Distance along a unit ray to the surface; -1 where it passes by."""
    t = start
    for _ in range(600):
        d, _which = distance(scene, ox + t * dx, oy + t * dy, oz + t * dz)
        if d < EPSILON:
            return t
        t += d
        if t > end:
            return -1.0
    # Rays that graze: near enough to be met.
    return t if d < 1e-2 else -1.0


@numba.njit(cache=True, error_model="numpy", nogil=True)
def cast(scene, ox, oy, oz, directions, start, end, points, normals, which):
    """Rays from (ox, oy, oz) along unit directions (N, 3): points, normals (N, 3), primitive (N,), -1 where none."""
    h = 1e-3
    for i in range(directions.shape[0]):
        dx, dy, dz = directions[i]
        t = _march(scene, ox, oy, oz, dx, dy, dz, start, end)
        which[i] = -1
        if t < 0:
            continue
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        points[i, 0], points[i, 1], points[i, 2] = x, y, z
        which[i] = distance(scene, x, y, z)[1]
        gx = distance(scene, x + h, y, z)[0] - distance(scene, x - h, y, z)[0]
        gy = distance(scene, x, y + h, z)[0] - distance(scene, x, y - h, z)[0]
        gz = distance(scene, x, y, z + h)[0] - distance(scene, x, y, z - h)[0]
        n = max(math.sqrt(gx * gx + gy * gy + gz * gz), 1e-12)
        normals[i, 0], normals[i, 1], normals[i, 2] = gx / n, gy / n, gz / n


@numba.njit(cache=True, error_model="numpy", nogil=True)
def sees(scene, points, normals, which, tx, ty, tz, seen):
    """Whether the straight way from each point to (tx, ty, tz) is free."""
    for i in range(points.shape[0]):
        seen[i] = False
        if which[i] < 0:
            continue
        x, y, z = points[i]
        dx, dy, dz = tx - x, ty - y, tz - z
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx / length, dy / length, dz / length
        if normals[i, 0] * dx + normals[i, 1] * dy + normals[i, 2] * dz <= 0:
            continue
        lift = 0.02
        x, y, z = x + lift * normals[i, 0], y + lift * normals[i, 1], z + lift * normals[i, 2]
        seen[i] = _march(scene, x, y, z, dx, dy, dz, 0.05, length) < 0


@numba.njit(cache=True, error_model="numpy", nogil=True)
def form_factors(scene, points, normals, areas, least):
    """(P, P) float32: share of what patch j sends out that reaches a unit of patch i, one bounce.

    Disc to point (Howell, A catalog of radiation heat transfer factors): cos cos A / (pi r^2 + A). Of pairs below
    `least` nobody asks whether they see each other.
    """
    count = points.shape[0]
    factors = np.zeros((count, count), np.float32)
    for i in range(count):
        for j in range(count):
            dx, dy, dz = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
            r2 = dx * dx + dy * dy + dz * dz
            if i == j or r2 < 1e-6:
                continue
            r = math.sqrt(r2)
            ci = (normals[i, 0] * dx + normals[i, 1] * dy + normals[i, 2] * dz) / r
            cj = -(normals[j, 0] * dx + normals[j, 1] * dy + normals[j, 2] * dz) / r
            if ci <= 0 or cj <= 0:
                continue
            factor = ci * cj * areas[j] / (math.pi * r2 + areas[j])
            if factor < least:
                continue
            lift = 0.3
            x = points[i, 0] + lift * normals[i, 0]
            y = points[i, 1] + lift * normals[i, 1]
            z = points[i, 2] + lift * normals[i, 2]
            if _march(scene, x, y, z, dx / r, dy / r, dz / r, 0.1, r - 1.0) < 0:
                factors[i, j] = factor
    return factors
