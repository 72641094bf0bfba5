"""From a scene and a rig to what each camera pixel gets of each projector pixel: cast once, then any image is shown.

A pixel is the mean of a few rays. A ray's surface point has a place in the projector's image, a spread of that image
(the projector's focus), and gains of scattered and of mirrored light. Light from other surfaces goes by way of coarse
patches of what the camera sees (radiosity).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np

from held_out import solids

OVER = 2
"""Projector pixels are drawn this many times finer, to be squares after the lens"""
SPREADS = 5
PATCH_PX = 24
LEAST_FACTOR = 2e-6


@dataclass(frozen=True, eq=False)
class Rays:
    """S rays a pixel: places in the projector's image, gains; (S, H, W) float32. spread: level of blur, from 0 on."""

    u: np.ndarray
    v: np.ndarray
    spread: np.ndarray
    scattered: np.ndarray
    mirrored: np.ndarray


@dataclass(frozen=True, eq=False)
class View:
    """A scene before a rig. rows, columns, xyz, lit: the truth at pixels' centres."""

    rig: object
    scene: object
    rays: Rays
    blurs: np.ndarray
    """projector px of each level"""
    albedo: np.ndarray
    shade: np.ndarray
    """(H, W) vignetting of the camera"""
    milky: np.ndarray
    milky_px: float
    rows: np.ndarray
    columns: np.ndarray
    xyz: np.ndarray
    lit: np.ndarray
    factors: np.ndarray | None
    patches: np.ndarray | None
    """(P, 2) rows and columns of the patch grid"""


def view_of(scene, rig, per_side=2):
    """Cast a scene. per_side: rays along a pixel's side."""
    table = np.stack(scene.solids(rig.width))
    width, height = rig.camera.size
    offsets = (np.arange(per_side) + 0.5) / per_side - 0.5
    middle = _hits(rig, table, 0.0, 0.0)
    near = _near_edges(middle)
    parts = [_seen(scene, rig, _hits(rig, table, dx, dy, middle, near)) for dy in offsets for dx in offsets]
    stacked = {k: np.stack([part[k] for part in parts]) for k in ("u", "v", "spread", "scattered", "mirrored")}
    centre = _seen(scene, rig, middle)
    # Half of the rows are half a pixel further: their mean is what a calibration calls the place.
    stacked["u"] += np.float32(0.25 if rig.staggered else 0)
    blurs = np.geomspace(rig.blur_px, rig.blur_px + 4 * rig.defocus_px, SPREADS)
    stacked["spread"] = np.interp(stacked["spread"], blurs, np.arange(SPREADS)).astype(np.float32)
    y, x = np.mgrid[:height, :width]
    dx, dy = rig.camera.directions(x, y)
    factors, patches = _patches(table, rig, centre) if scene.bounces else (None, None)
    return View(
        rig, scene, Rays(**stacked), blurs, centre["albedo"],
        _vignette(dx, dy, rig.camera, rig.vignetting), centre["milky"],
        max((m.mean_mm for m in scene.materials), default=0) * rig.camera.focal[0] / rig.distance,
        centre["v"], centre["u"], centre["xyz"], centre["lit"], factors, patches,
    )  # fmt: skip


def _vignette(x, y, optic, mechanical):
    """cos^4, and what the barrel takes: growing with the fourth power to `mechanical` in the corner."""
    corner = np.hypot(optic.size[0] / 2 / optic.focal[0], optic.size[1] / 2 / optic.focal[1])
    r2 = x * x + y * y
    return ((1 + r2) ** -2 * (1 - mechanical * np.minimum(r2 / corner**2, 1.2) ** 2)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Hits:
    """Rays of all pixels, (N, 3) and (N,): which is -1 where a ray meets nothing."""

    ray: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    which: np.ndarray
    lit: np.ndarray
    shape: tuple[int, int]


def _hits(rig, table, dx, dy, middle=None, near=None):
    """Rays through (x + dx, y + dy) of every pixel.

    Where `middle` (the same of the pixels' centres) has no edge about it (`near` is false), its tangent planes are met
    instead of the solids: within half a pixel they are the same to a micrometre.
    """
    width, height = rig.camera.size
    y, x = np.mgrid[:height, :width].astype(np.float64)
    ray = np.stack((*rig.camera.directions(x + dx, y + dy), np.ones((height, width))), axis=-1).reshape(-1, 3)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    if middle is None:
        count = len(ray)
        points, normals = np.full((count, 3), np.nan), np.zeros((count, 3))
        which, lit = np.empty(count, np.int64), np.empty(count, bool)
        anew = np.arange(count)
    else:
        eye = np.array([0.0, 0.0, -rig.distance])
        normals, which, lit = middle.normals.copy(), middle.which.copy(), middle.lit.copy()
        down = (normals * ray).sum(1)
        along = (normals * (middle.points - eye)).sum(1) / np.where(np.abs(down) < 1e-9, 1.0, down)
        points, anew = eye + along[:, None] * ray, np.flatnonzero(near)
    p, n = np.full((len(anew), 3), np.nan), np.zeros((len(anew), 3))
    w, seen = np.empty(len(anew), np.int64), np.empty(len(anew), bool)
    solids.cast(table, 0.0, 0.0, -rig.distance, ray[anew], 0.4 * rig.distance, 2.2 * rig.distance, p, n, w)
    solids.sees(table, p, n, w, *(np.array(rig.position) - (0.0, 0.0, rig.distance)), seen)
    points[anew], normals[anew], which[anew], lit[anew] = p, n, w, seen
    return _Hits(ray, points, normals, which, lit, (height, width))


def _near_edges(hits):
    """(N,) bool: pixels about which the solid, the shadow or the normal (by 5 degrees and more) changes."""
    around = np.ones((3, 3), np.uint8)

    def changes(values, by):
        values = np.nan_to_num(values, nan=-1e6).reshape(hits.shape).astype(np.float32)
        return cv2.dilate(values, around) - cv2.erode(values, around) > by

    near = changes(hits.which, 0) | changes(hits.lit, 0)
    for k in range(3):
        near |= changes(hits.normals[:, k], 0.09)
    return near.ravel()


def _seen(scene, rig, hits):
    """What those rays bring: maps (H, W) by name."""
    (height, width), points, normals, which, ray = hits.shape, hits.points, hits.normals, hits.which, hits.ray
    lit = hits.lit.copy()
    table = scene.solids(rig.width)
    rotation, translation = rig.pose
    ahead = np.array([0.0, 0.0, rig.distance])
    source = np.array(rig.position) - ahead
    xyz = points + ahead
    there = which >= 0
    seen = np.where(there[:, None], xyz, ahead) @ rotation.T + translation
    u, v = rig.projector.pixels(seen)
    lit &= (u > -0.5) & (u < rig.projector.size[0] - 0.5) & (v > -0.5) & (v < rig.projector.size[1] - 0.5)
    lit &= seen[:, 2] > 0
    materials = [scene.materials[min(k, len(scene.materials) - 1)] for k in range(len(table))]
    safe = np.where(there[:, None], points, 0.0)
    albedo, scattered, mirrored = _reflected(materials, which, safe, normals, ray, source, rig)
    light = _vignette(seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2], rig.projector, rig.vignetting) * lit
    focus = np.linalg.norm(ahead @ rotation.T + translation)
    out = np.abs(1 / np.maximum(seen[:, 2], 1.0) - 1 / focus) * focus * 10
    spread = np.hypot(rig.blur_px, rig.defocus_px * out)
    milky = np.array([m.milky for m in materials] + [0.0])[which]
    truth = np.where(there, 1.0, np.nan)
    shaped = {
        "u": u * truth, "v": v * truth, "spread": spread, "scattered": scattered * light, "mirrored": mirrored * light,
        "albedo": albedo, "milky": milky,
    }  # fmt: skip
    found = {name: value.reshape(height, width).astype(np.float32) for name, value in shaped.items()}
    found["xyz"] = xyz.reshape(height, width, 3).astype(np.float32)
    found["normals"] = normals.reshape(height, width, 3)
    found["lit"] = lit.reshape(height, width)
    return found


def _reflected(materials, which, points, normals, ray, source, rig):
    """Albedo, scattered and mirrored gain of projector light; 1 = white, facing, at the target's distance."""
    albedo = np.zeros(len(points))
    rough = np.full(len(points), np.nan)
    for k, material in enumerate(materials):
        own = which == k
        if own.any():
            factor = 1.0 if material.texture is None else material.texture(points[own], rig.width)
            albedo[own] = material.albedo * factor
            rough[own] = np.nan if material.gloss is None else material.gloss
    to_light = source - points
    far = np.linalg.norm(to_light, axis=1)
    to_light /= far[:, None]
    facing = np.maximum((normals * to_light).sum(1), 0)
    fall = (np.linalg.norm(source) / far) ** 2
    to_camera = -ray
    half = to_light + to_camera
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    nh, nv = (normals * half).sum(1), np.maximum((normals * to_camera).sum(1), 1e-3)
    a2 = rough**2  # GGX (Walter et al. 2007) with Schlick's terms, index of refraction 1.5
    lobe = a2 / (np.pi * (nh**2 * (a2 - 1) + 1) ** 2)
    k = rough / 2
    hidden = 1 / ((facing * (1 - k) + k) * (nv * (1 - k) + k))
    fresnel = 0.04 + 0.96 * (1 - np.clip((to_light * half).sum(1), 0, 1)) ** 5
    mirrored = np.nan_to_num(np.pi * lobe * hidden * fresnel / 4 * facing)
    return albedo, albedo * facing * fall, mirrored * fall


def _patches(table, rig, centre):
    """Form factors between patches of PATCH_PX camera pixels, and where they are in the grid."""
    half = PATCH_PX // 2
    xyz, normals, lit = centre["xyz"][half::PATCH_PX, half::PATCH_PX], centre["normals"], centre["albedo"]
    normals = normals[half::PATCH_PX, half::PATCH_PX]
    there = np.isfinite(xyz[..., 2]) & (lit[half::PATCH_PX, half::PATCH_PX] > 0)
    at = np.argwhere(there)
    points = xyz[there].astype(np.float64)
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    cosine = np.maximum(-(normals[there] * ray).sum(1), 0.05)
    areas = (points[:, 2] * PATCH_PX / rig.camera.focal[0]) ** 2 / cosine
    points[:, 2] -= rig.distance
    return solids.form_factors(table, points, np.ascontiguousarray(normals[there]), areas, LEAST_FACTOR), at


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _gather(levels, u, v, spread, scattered, mirrored, over, out_scattered, out_mirrored):
    """Mean over rays of the projector's light at (u, v), times gains."""
    height, width = levels.shape[1:]
    rays, rows, columns = u.shape
    for y in range(rows):
        for x in range(columns):
            s = m = 0.0
            for k in range(rays):
                gs, gm = scattered[k, y, x], mirrored[k, y, x]
                if gs == 0.0 and gm == 0.0:
                    continue
                fx = min(max((u[k, y, x] + 0.5) * over - 0.5, 0.0), width - 1.001)
                fy = min(max((v[k, y, x] + 0.5) * over - 0.5, 0.0), height - 1.001)
                ix, iy = int(fx), int(fy)
                fx, fy = fx - ix, fy - iy
                level = min(int(spread[k, y, x]), levels.shape[0] - 2)
                part = spread[k, y, x] - level
                light = 0.0
                for b in range(2):
                    image = levels[level + b]
                    top = image[iy, ix] * (1 - fx) + image[iy, ix + 1] * fx
                    low = image[iy + 1, ix] * (1 - fx) + image[iy + 1, ix + 1] * fx
                    light += (part if b else 1 - part) * (top * (1 - fy) + low * fy)
                s += gs * light
                m += gm * light
            out_scattered[y, x] = s / rays
            out_mirrored[y, x] = m / rays


def shown(view, image):
    """Radiance at each camera pixel (H, W) float32 before the camera's lens, for a projector image uint8."""
    rig = view.rig
    light = (image.astype(np.float32) / 255) ** rig.gamma
    levels = projected(light, view.blurs, rig.projector.focal, rig.staggered)
    scattered, mirrored = np.empty(view.rows.shape, np.float32), np.empty(view.rows.shape, np.float32)
    rays = view.rays
    _gather(levels, rays.u, rays.v, rays.spread, rays.scattered, rays.mirrored, OVER, scattered, mirrored)
    if view.factors is not None:
        scattered += view.albedo * _bounced(view, scattered)
    if view.milky_px:
        milky = view.milky
        there = (milky > 0).astype(np.float32)
        within = cv2.GaussianBlur(scattered * there, (0, 0), view.milky_px)
        within /= np.maximum(cv2.GaussianBlur(there, (0, 0), view.milky_px), 1e-3)
        scattered += milky * there * (within - scattered)
    return scattered + mirrored


def projected(light, blurs, focal, staggered):
    """(SPREADS, OVER H, OVER W) float32: pixels as squares, through a lens of each spread (px along rows)."""
    fine = np.repeat(np.repeat(light, OVER, axis=0), OVER, axis=1)
    if staggered:
        odd = np.arange(len(fine)) // OVER % 2 == 1
        fine[odd] = np.roll(fine[odd], OVER // 2, axis=1)
    across = [(b * OVER, b * OVER * focal[1] / focal[0]) for b in blurs]
    return np.stack([cv2.GaussianBlur(fine, (0, 0), sx, sigmaY=sy) for sx, sy in across])


def _bounced(view, scattered):
    """(H, W) irradiance by way of other patches, in units of direct light."""
    half = PATCH_PX // 2
    even = cv2.blur(scattered, (PATCH_PX, PATCH_PX))[half::PATCH_PX, half::PATCH_PX]
    albedo = view.albedo[half::PATCH_PX, half::PATCH_PX]
    y, x = view.patches.T
    sent, reached = even[y, x], np.zeros(len(y), np.float32)
    for _ in range(view.scene.bounces):
        came = view.factors @ sent
        reached += came
        sent = albedo[y, x] * came
    grid, weight = np.zeros(even.shape, np.float32), np.zeros(even.shape, np.float32)
    grid[y, x], weight[y, x] = reached, 1.0
    height, width = scattered.shape
    # Grid point (i, j) lies at pixel (half + PATCH i, ...): enlarged about there, edges held.
    ys = (np.arange(height, dtype=np.float32) - half) / PATCH_PX
    xs = (np.arange(width, dtype=np.float32) - half) / PATCH_PX
    gx, gy = np.meshgrid(xs, ys)
    total, share = (cv2.remap(g, gx, gy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for g in (grid, weight))
    return total / np.maximum(share, 1e-3) * (share > 1e-3)
