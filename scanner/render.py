"""A shaded view of an organised cloud from the side: a mesh over the camera's grid, a z-buffer, two lights.

Every quad of four neighbouring points becomes two triangles, a point of no quad a dot; the z-buffer keeps for each
sub-pixel which place of the camera's grid it sees, and the shading, made once on that grid, is looked up there. Shading
uses smoothed normals and darkens what lies behind its surroundings (Luft, Colditz, Deussen 2006, unsharp masking of the
depth buffer).
It is a picture for people; no measurement is taken from it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.colours import Picture
from scanner.kernel import kernel
from scanner.normals import normals_of

Map = NDArray[np.float32]

SUPERSAMPLING = 2
MAX_VERTICES = 1_600_000
"""Larger grids are thinned: the picture has no more pixels than this."""

DOT = 2
"""Side of the square that stands for a point without neighbours, px."""

_FOV = math.radians(24)
"""Angle of view of the picture's height: long enough a lens for calm perspective."""

_LONGEST = 11.4
"""Longest side of a quad over the pixel's footprint: tan(85 degrees), so that no sheet closes a depth edge."""


@dataclass(frozen=True)
class View:
    """Where the cloud is seen from: degrees around it (positive: from the camera's right) and above the camera."""

    azimuth_deg: float = 35.0
    elevation_deg: float = 18.0


def render(xyz: Map, albedo: Map, size: tuple[int, int], view: View | None = None) -> Picture:
    """Draw a cloud, framed on the bulk of its points, before a quiet background.

    Args:
        xyz: (H, W, 3) float32 mm, camera frame, NaN = no point.
        albedo: (H, W) float32 grey levels; tints the surface a little.
        size: (width, height) of the picture, px.
        view: where from.
    """
    picture = _background(size)
    stride = math.ceil(math.sqrt(xyz.shape[0] * xyz.shape[1] / MAX_VERTICES))
    grid = np.ascontiguousarray(xyz[::stride, ::stride])
    tone = np.ascontiguousarray(albedo[::stride, ::stride])
    seen = _in_view(grid, size, view or View())
    if seen is None:
        return np.asarray(picture.round(), dtype=np.uint8)
    screen, rotation, diameter = seen
    fine = (size[1] * SUPERSAMPLING, size[0] * SUPERSAMPLING)
    depth = np.full(fine, np.inf, np.float32)
    place = np.full((2, *fine), -9, np.float32)  # outside the grid: black
    alone = ~np.isnan(grid[..., 2])
    _rasterise(grid, screen, _footprint(grid) * _LONGEST, depth, place, alone)
    _dots(screen, alone, DOT * SUPERSAMPLING, depth, place)
    colour = cv2.remap(_shade(grid, tone, rotation), place[0], place[1], cv2.INTER_LINEAR)
    there = np.isfinite(depth)
    cover = cv2.resize(there.view(np.uint8) * np.uint8(255), size, interpolation=cv2.INTER_AREA)[..., None]
    front = cv2.resize(colour, size, interpolation=cv2.INTER_AREA)
    picture *= 1 - cover / np.float32(255)
    picture += front * _occlusion(depth, there, diameter, size)[..., None]
    return np.asarray(np.clip(picture, 0, 255).round(), dtype=np.uint8)


def warm_up() -> None:
    """Compile the kernel."""
    xyz = np.ones((2, 2, 3), np.float32)
    depth, place, alone = np.ones((2, 2), np.float32), np.zeros((2, 2, 2), np.float32), np.ones((2, 2), np.bool_)
    _rasterise(xyz, xyz, 1.0, depth, place, alone)
    _dots(xyz, alone, 1, depth, place)


def _in_view(grid: Map, size: tuple[int, int], view: View) -> tuple[Map, NDArray[np.float64], float] | None:
    """Vertices in sub-pixels of the picture and depth, the rotation to the view's frame, and the scene's diameter."""
    sample = grid[:: max(1, grid.shape[0] // 256), :: max(1, grid.shape[1] // 256)]
    sample = sample[~np.isnan(sample[..., 2])].astype(np.float64)
    if len(sample) < 3:
        return None
    rotation = _rotation(view)
    subject = _subject(sample)
    turned = (subject - np.median(subject, axis=0)) @ rotation.T
    low, high = np.percentile(turned, (0.5, 99.5), axis=0)
    middle = (low + high) / 2
    centre = np.median(subject, axis=0) + middle @ rotation
    half = np.maximum((high - low) / 2, 1e-6)
    # Far enough that the bulk fits the picture's height and width, with room around it.
    tangent = math.tan(_FOV / 2)
    room = 1.06 if len(subject) == len(sample) else 1.3
    distance = room * max(half[1] / tangent, half[0] / (tangent * size[0] / size[1])) + half[2]
    focal = size[1] / 2 / tangent * SUPERSAMPLING
    moved = (grid - centre.astype(np.float32)) @ rotation.T.astype(np.float32)
    z = moved[..., 2] + np.float32(distance)
    scale = np.float32(focal) / np.where(z > distance * 0.05, z, np.nan)
    screen = np.empty_like(grid)
    screen[..., 0] = moved[..., 0] * scale + size[0] * SUPERSAMPLING / 2 - 0.5
    screen[..., 1] = moved[..., 1] * scale + size[1] * SUPERSAMPLING / 2 - 0.5
    screen[..., 2] = z
    return screen, rotation, float(np.linalg.norm(high - low))


def _subject(points: NDArray[Any]) -> NDArray[Any]:
    """What to frame: the points before a wall, table or board that makes up most of the cloud, or else all of them.

    The plane is found by drawing triples (Fischler, Bolles 1981), the same ones every time. Points count as before it
    from 1 % of the depth on; too few of them (1 %) are no subject.
    """
    rng = np.random.default_rng(1)
    few = points[rng.integers(0, len(points), 2000)]
    a, b, c = few[rng.integers(0, len(few), (3, 64))]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    a, normals = a[lengths > 0], normals[lengths > 0] / lengths[lengths > 0, None]
    if len(a) == 0:
        return points
    thick = 0.01 * float(np.median(points[:, 2]))
    near = np.abs(few @ normals.T - np.einsum("ij,ij->i", a, normals)) < thick / 2
    best = int(near.sum(axis=0).argmax())
    if near[:, best].mean() < 0.5:
        return points
    toward = -np.sign(normals[best] @ a[best]) * normals[best]
    before = points[(points - a[best]) @ toward > thick]
    return before if len(before) > 0.01 * len(points) else points


def _rotation(view: View) -> NDArray[np.float64]:
    a, e = math.radians(view.azimuth_deg), math.radians(view.elevation_deg)
    around = np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
    above = np.array([[1, 0, 0], [0, math.cos(e), -math.sin(e)], [0, math.sin(e), math.cos(e)]])
    return np.asarray(above @ around)


def _footprint(grid: Map) -> float:
    """Distance of neighbouring points on a surface that faces the camera, per mm of depth."""
    steps = np.abs(grid[::8, 1:, 0] / grid[::8, 1:, 2] - grid[::8, :-1, 0] / grid[::8, :-1, 2])
    steps = steps[np.isfinite(steps)]
    return float(np.median(steps)) if steps.size else 0.0


def _shade(grid: Map, albedo: Map, rotation: NDArray[np.float64]) -> Picture:
    """(H, W, 3) uint8 BGR on the camera's grid: a clay surface under two lights and a sky."""
    normals = _smooth(normals_of(grid))
    normals[~normals.any(axis=-1)] = (0, 0, -1)  # none: as if it faced the camera
    normals = normals @ rotation.T.astype(np.float32)
    toward = -normals[..., 2]
    key = np.clip(normals @ _light(-0.55, -0.65, -0.62), 0, None)
    fill = np.clip(normals @ _light(0.85, -0.1, -0.5), 0, None)
    sky = 0.5 - 0.5 * normals[..., 1]
    gloss = np.clip(normals @ _light(-0.30, -0.36, -0.88), 0, None) ** 40
    rim = np.clip(1 - toward, 0, 1) ** 3
    lights = (
        (key, (0.60, 0.66, 0.70)),
        (fill, (0.30, 0.24, 0.19)),
        (sky, (0.20, 0.17, 0.15)),
        (rim, (0.12, 0.08, 0.05)),
    )
    amounts = np.stack([amount for amount, _ in lights], axis=-1) * _tint(albedo)[..., None]
    shaded = amounts @ np.array([colour for _, colour in lights], np.float32) + np.float32(0.10) * gloss[..., None]
    # Light to screen values: a table of 1024 steps in place of a power for every pixel.
    screen = (255 * np.linspace(0, 1, 1024) ** (1 / 1.5)).round().astype(np.uint8)
    return np.asarray(screen[np.nan_to_num(np.clip(shaded, 0, 1) * 1023).astype(np.uint16)])


def _tint(albedo: Map) -> Map:
    """How light the surface is, 0.45 .. 1: texture shows and does not hide the shape."""
    there = albedo[::4, ::4]
    there = there[np.isfinite(there)]
    white = float(np.percentile(there, 98)) if there.size else 1.0
    return np.asarray(0.45 + 0.55 * np.clip(np.nan_to_num(albedo) / max(white, 1e-6), 0, 1), dtype=np.float32)


def _light(x: float, y: float, z: float) -> Map:
    return np.asarray(np.array((x, y, z)) / math.hypot(x, y, z), dtype=np.float32)


def _smooth(normals: Map) -> Map:
    """Normals averaged over 7 x 7 points, where there are any, and made unit again."""
    filled = cv2.blur(np.nan_to_num(normals), (7, 7))
    length = np.sqrt(np.einsum("ijk,ijk->ij", filled, filled))
    return np.asarray(filled / np.maximum(length, np.float32(1e-9))[..., None], dtype=np.float32)


def _occlusion(depth: Map, there: NDArray[np.bool_], diameter: float, size: tuple[int, int]) -> Map:
    """(height, width) float32, 0.58 .. 1: darker what lies behind the mean of its surroundings."""
    small = (depth.shape[1] // 4, depth.shape[0] // 4)
    weight = cv2.resize(there.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    filled = cv2.resize(np.where(there, depth, 0).astype(np.float32), small, interpolation=cv2.INTER_AREA)
    level = filled / np.maximum(weight, 1e-6)
    shade = np.zeros_like(level)
    for radius, strength in ((small[1] / 90, 0.55), (small[1] / 30, 0.45)):
        mean = cv2.GaussianBlur(filled, (0, 0), radius) / np.maximum(cv2.GaussianBlur(weight, (0, 0), radius), 1e-6)
        behind = 1 - np.exp(-np.maximum(level - mean, 0) / (0.04 * diameter))
        shade += strength * behind * (weight > 0)
    return np.asarray(cv2.resize(1 - 0.42 * shade, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def _background(size: tuple[int, int]) -> NDArray[np.float32]:
    """A soft light behind the object that fades to the corners."""
    x, y = np.meshgrid(np.linspace(-1, 1, size[0], dtype=np.float32), np.linspace(-1, 1, size[1], dtype=np.float32))
    fade = np.exp(-(x * x * 0.9 + (y + 0.15) ** 2 * 1.1))[..., None]
    edge, middle = np.array((27, 21, 17), np.float32), np.array((74, 62, 53), np.float32)
    return np.asarray(edge + fade * (middle - edge), dtype=np.float32)


@kernel
def _rasterise(grid: Map, screen: Map, longest: float, depth: Map, place: Map, alone: NDArray[np.bool_]) -> None:
    """Draw all quads: depth (h, w) gets the nearest z, place (2, h, w) the column and row of the grid seen there.

    alone: (H, W) bool, becomes false where a point belongs to a quad.
    """
    for i in range(grid.shape[0] - 1):
        for j in range(grid.shape[1] - 1):
            near = far = grid[i, j, 2]
            for k, m in ((i, j + 1), (i + 1, j), (i + 1, j + 1)):
                near, far = min(near, grid[k, m, 2]), max(far, grid[k, m, 2])
            z = grid[i, j, 2] + grid[i, j + 1, 2] + grid[i + 1, j, 2] + grid[i + 1, j + 1, 2]
            if not far - near <= longest * z * 0.25:  # NaN fails, too
                continue
            alone[i, j] = alone[i, j + 1] = alone[i + 1, j] = alone[i + 1, j + 1] = False
            _triangle(screen, i, j, i, j + 1, i + 1, j, depth, place)
            _triangle(screen, i + 1, j + 1, i + 1, j, i, j + 1, depth, place)


@kernel
def _dots(screen: Map, alone: NDArray[np.bool_], side: int, depth: Map, place: Map) -> None:
    for i in range(alone.shape[0]):
        for j in range(alone.shape[1]):
            x, y, z = screen[i, j, 0], screen[i, j, 1], screen[i, j, 2]
            # A point behind the eye has no place (NaN fails).
            if not alone[i, j] or not (abs(x) < 1e6 and abs(y) < 1e6):
                continue
            left, top = math.floor(x) - side // 2, math.floor(y) - side // 2
            for v in range(max(0, top), min(depth.shape[0], top + side)):
                for u in range(max(0, left), min(depth.shape[1], left + side)):
                    if z < depth[v, u]:
                        depth[v, u], place[0, v, u], place[1, v, u] = z, j, i


@kernel
def _triangle(screen: Map, i0: int, j0: int, i1: int, j1: int, i2: int, j2: int, depth: Map, place: Map) -> None:
    x0, y0, z0 = screen[i0, j0, 0], screen[i0, j0, 1], screen[i0, j0, 2]
    x1, y1, z1 = screen[i1, j1, 0], screen[i1, j1, 1], screen[i1, j1, 2]
    x2, y2, z2 = screen[i2, j2, 0], screen[i2, j2, 1], screen[i2, j2, 2]
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    left, right = min(x0, x1, x2), max(x0, x1, x2)
    top, bottom = min(y0, y1, y2), max(y0, y1, y2)
    if area == 0.0 or not (right >= 0 and bottom >= 0 and left < depth.shape[1] and top < depth.shape[0]):
        return
    scale = 1.0 / area
    for y in range(max(0, math.ceil(top)), min(depth.shape[0] - 1, math.floor(bottom)) + 1):
        for x in range(max(0, math.ceil(left)), min(depth.shape[1] - 1, math.floor(right)) + 1):
            b1 = ((x - x0) * (y2 - y0) - (x2 - x0) * (y - y0)) * scale
            b2 = ((x1 - x0) * (y - y0) - (x - x0) * (y1 - y0)) * scale
            if b1 < 0.0 or b2 < 0.0 or b1 + b2 > 1.0:
                continue
            z = z0 + b1 * (z1 - z0) + b2 * (z2 - z0)
            if z < depth[y, x]:
                depth[y, x] = z
                place[0, y, x] = j0 + b1 * (j1 - j0) + b2 * (j2 - j0)
                place[1, y, x] = i0 + b1 * (i1 - i0) + b2 * (i2 - i0)
