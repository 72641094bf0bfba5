"""From a projected image to the light on the camera's pixels: projector optics, shading, lookup.

An image becomes a table of the light in its own plane (gamma, then pixel square and lens blur, evaluated exactly at
positions finer than the pixel grid); a camera pixel looks its projector coordinate up there, linearly. An image that
is constant along one axis, as fringes are, needs only a line. The table's steps are fine enough that linear lookup
shifts no fringe by more than 0.002 projector px (a step h and a period p shift it by at most
0.016 (2 pi h / p)^3 p / (2 pi): 0.0004 px at p = 13.5 and h = 1/2).
"""

# Kernels: numba types their arguments.
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from drivers.simulated.cast import cast_rays, lit_points
from drivers.simulated.rigs import Rig
from drivers.simulated.scenes import Material, Scene, SceneOptions, build_scene
from scanner.devices import Truth
from scanner.kernel import kernel

Array = NDArray[np.float64]
Plane = NDArray[np.float32]
Image = NDArray[np.uint8]

STEPS_PER_PX_LINE = 16
STEPS_PER_PX_GRID = 2
SUBSAMPLES = 4
"""A textured pixel's footprint is sampled SUBSAMPLES x SUBSAMPLES times."""
GLOSS_EXPONENT = 40.0
"""Width of the highlight (Blinn 1977): half its height 10 degrees off."""


@dataclass(frozen=True)
class Optics:
    """Optics and sensor of both devices; defaults are those of scenes.json."""

    full_well_e: float = field(default=15000.0, metadata={"low": 10.0, "high": 1e7})
    read_noise_dn: float = field(default=0.8, metadata={"low": 0.0, "high": 100.0})
    """at 8 bits and 0 dB"""
    bits: int = field(default=8, metadata={"low": 8, "high": 16})
    projector_blur_sigma_px: float = field(default=0.7, metadata={"low": 0.3, "high": 50.0})
    camera_blur_sigma_px: float = field(default=0.7, metadata={"low": 0.0, "high": 20.0})
    gamma: float = field(default=2.3, metadata={"low": 0.1, "high": 10.0})
    ambient: float = field(default=0.04, metadata={"low": 0.0, "high": 10.0})
    """share of the projector's full light at the aim point, from everywhere"""
    exposure_scale: float = field(default=1.0, metadata={"low": 0.0, "high": 100.0})
    projector_falloff: float = field(default=2.0, metadata={"low": 0.0, "high": 8.0})
    """exponent p: the projected picture darkens off its axis as cos^p"""
    vignetting: float = field(default=2.0, metadata={"low": 0.0, "high": 8.0})
    """exponent p: the camera's image darkens off its axis as cos^p"""
    noise: bool = True
    """false: neither shot nor read noise, for tests of exactness"""


@dataclass(frozen=True, eq=False)
class View:
    """A scene as the camera's pixels see it, all (H, W).

    row, column: float32 projector coordinates + 0.5 (so the picture begins at 0), 0 where not lit. shade: reflected
    light for full-on light, in shares of what a white facing plane at the aim point would reflect; 0 where not lit.
    floor: reflected ambient light in the same unit.
    """

    row: Plane
    column: Plane
    shade: Plane
    floor: Plane
    truth: Truth


@dataclass(frozen=True, eq=False)
class Line:
    """Light along one axis of the projected picture, the other axis constant: (size * steps + 2,) float32."""

    axis: Literal["row", "column"]
    steps: int
    light: Plane


@dataclass(frozen=True, eq=False)
class Grid:
    """Light over the projected picture: (height * steps + 2, width * steps + 2) float32."""

    steps: int
    light: Plane


Light = Line | Grid


# --- the projected picture ---------------------------------------------------------------------------------------


def flat_axis(image: Image) -> Literal["row", "column"] | None:
    """The axis along which the image changes if it is constant along the other ("row": rows differ); else None."""
    if np.array_equal(image[:, :1], image[:, -1:]) and (image == image[:, :1]).all():
        return "row"
    if np.array_equal(image[:1], image[-1:]) and (image == image[:1]).all():
        return "column"
    return None


def line_of_light(values: Image, response: Plane, sigma_px: float, axis: Literal["row", "column"]) -> Line:
    """Light of an image that changes along `axis` only.

    Args:
        values: (size,) uint8.
        response: (256,) float32 light of each value.
        sigma_px: projector blur.
        axis: see `flat_axis`.
    """
    steps = STEPS_PER_PX_LINE
    reach = _reach(sigma_px)
    padded = np.pad(response[values].astype(np.float64), reach)
    fine = np.zeros(len(values) * steps + 2, dtype=np.float32)
    for phase in range(steps):
        weights = _pixel_weights(phase / steps - 0.5, reach, sigma_px)
        fine[phase : len(values) * steps : steps] = np.convolve(padded, weights[::-1], mode="valid")
    fine[-2:] = fine[-3]
    return Line(axis, steps, fine)


def grid_of_light(image: Image, response: Plane, sigma_px: float) -> Grid:
    """Light of any image: (height, width) uint8."""
    steps = STEPS_PER_PX_GRID if sigma_px >= 0.5 else 2 * STEPS_PER_PX_GRID
    height, width = image.shape
    reach = _reach(sigma_px)
    padded = cv2.copyMakeBorder(response[image], reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=0.0)
    fine = np.empty((height * steps + 2, width * steps + 2), dtype=np.float32)
    weights = [_pixel_weights(phase / steps - 0.5, reach, sigma_px) for phase in range(steps)]
    for r, down in enumerate(weights):
        for c, across in enumerate(weights):
            part = cv2.sepFilter2D(padded, cv2.CV_32F, across, down)
            fine[r : height * steps : steps, c : width * steps : steps] = part[reach:-reach, reach:-reach]
    fine[-2:] = fine[-3]
    fine[:, -2:] = fine[:, -3:-2]
    return Grid(steps, fine)


def look_up(light: Light, view: View, gain: Plane, floor: Plane, out: Plane) -> None:
    """out = light at each camera pixel * gain + floor, all (H, W) float32; out may be floor."""
    if isinstance(light, Grid):
        _look_up_grid(view.row, view.column, light.light, np.float32(light.steps), gain, floor, out)
    else:
        coordinate = view.row if light.axis == "row" else view.column
        _look_up_line(coordinate, light.light, np.float32(light.steps), gain, floor, out)


def _reach(sigma_px: float) -> int:
    return int(np.ceil(1.0 + 4.5 * sigma_px))


def _pixel_weights(offset: float, reach: int, sigma_px: float) -> Array:
    """Share of each neighbour j = -reach .. reach in the light at `offset` from a pixel's centre; sums to 1.

    The response of a square pixel seen through a Gaussian blur: 1/2 (erf((x + 1/2) / s) - erf((x - 1/2) / s)).
    """
    x = offset - np.arange(-reach, reach + 1)
    s = np.sqrt(2.0) * sigma_px
    weights = 0.5 * (erf((x + 0.5) / s) - erf((x - 0.5) / s))
    return np.asarray(weights / weights.sum(), dtype=np.float64)


@kernel
def _look_up_line(coordinate, table, steps, gain, floor, out):
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            t = coordinate[r, c] * steps
            i = np.uint32(t)
            low = table[i]
            out[r, c] = (low + (t - np.float32(i)) * (table[i + np.uint32(1)] - low)) * gain[r, c] + floor[r, c]


@kernel
def _look_up_grid(row, column, table, steps, gain, floor, out):
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            v, u = row[r, c] * steps, column[r, c] * steps
            i, j = np.uint32(v), np.uint32(u)
            a, b = u - np.float32(j), v - np.float32(i)
            upper = table[i, j] + a * (table[i, j + np.uint32(1)] - table[i, j])
            i += np.uint32(1)
            lower = table[i, j] + a * (table[i, j + np.uint32(1)] - table[i, j])
            out[r, c] = (upper + b * (lower - upper)) * gain[r, c] + floor[r, c]


# --- the scene -----------------------------------------------------------------------------------------------------


def view_scene(rig: Rig, scene: Scene, optics: Optics, stride: int = 1) -> View:
    """Cast and shade a scene; stride > 1 looks at every stride-th pixel only."""
    camera, projector = rig.calibration.camera, rig.calibration.projector
    grid = camera.pixel_grid()[::stride, ::stride]
    shape = grid.shape[:2]
    directions = _directions(rig, grid)
    origin = rig.to_scene(np.zeros(3))
    hits = cast_rays(origin, directions, scene.bodies, scene.field)
    xyz = directions * (hits.distance * rig.scale)[:, None]
    light_at = rig.to_scene(rig.calibration.projector_centre)
    lit = lit_points(origin + directions * hits.distance[:, None], hits, light_at, scene.bodies, scene.field)
    seen = rig.calibration.to_projector(xyz)
    pixels = projector.project(seen)
    width, height = projector.size
    with np.errstate(invalid="ignore"):
        lit &= (seen[:, 2] > 0) & (np.abs(pixels - ((width - 1) / 2, (height - 1) / 2)) < (width / 2, height / 2)).all(
            -1
        )
    albedo, gloss = _reflectance(scene, hits.body, directions, origin, shape)
    vignette = (1.0 + (directions[:, :2] ** 2).sum(-1)) ** (-0.5 * optics.vignetting)
    irradiance, highlight = _irradiance(rig, xyz, seen, hits.normal, optics)
    shade = np.where(lit, (albedo * irradiance + gloss * highlight) * vignette, 0.0)
    floor = np.where(hits.body >= 0, albedo * optics.ambient * vignette, 0.0)
    place = np.where(lit[:, None], pixels + 0.5, 0.0).astype(np.float32)
    place = np.clip(place, 0.0, np.nextafter(np.array([width, height], dtype=np.float32), np.float32(0.0)))
    return View(
        row=np.ascontiguousarray(place[:, 1]).reshape(shape),
        column=np.ascontiguousarray(place[:, 0]).reshape(shape),
        shade=shade.astype(np.float32).reshape(shape),
        floor=floor.astype(np.float32).reshape(shape),
        truth=Truth(
            rows=pixels[:, 1].astype(np.float32).reshape(shape),
            columns=pixels[:, 0].astype(np.float32).reshape(shape),
            xyz=xyz.astype(np.float32).reshape(*shape, 3),
            lit=lit.reshape(shape),
        ),
    )


def white_level(rig: Rig, optics: Optics) -> float:
    """99th percentile of the reflected light of the full-on board, in the unit of `View.shade`.

    The exposure rule of scenes.json: this level is 230 grey levels of 255 at the nominal exposure.
    """
    stride = max(1, rig.calibration.camera.size[0] // 160)
    board = view_scene(rig, build_scene("board", SceneOptions(), rig, 0), optics, stride)
    return float(np.percentile(board.shade + board.floor, 99))


def _directions(rig: Rig, grid: Array) -> Array:
    """(N, 3) viewing directions with z = 1."""
    camera = rig.calibration.camera
    if np.any(camera.distortion):
        rays = camera.normalised(grid)
    else:
        m = camera.matrix
        rays = (grid - (m[0, 2], m[1, 2])) / (m[0, 0], m[1, 1])
    directions = np.ones((rays.shape[0] * rays.shape[1], 3))
    directions[:, :2] = rays.reshape(-1, 2)
    return directions


def _irradiance(rig: Rig, xyz: Array, seen: Array, normal: Array, optics: Optics) -> tuple[Array, Array]:
    """Full-on light on each point, 1 at a facing aim point, and the highlight it gives a glossy one.

    Each projector pixel carries the same light into a solid angle that shrinks as cos^3 off the axis: on a plane
    across the axis the picture is evenly bright, but for `projector_falloff`.
    """
    to_light = rig.calibration.projector_centre - xyz
    distance = np.sqrt((to_light**2).sum(-1))
    to_light /= distance[:, None]
    facing = np.maximum((to_light * normal).sum(-1), 0.0)
    off_axis = seen[:, 2] / distance
    aim = rig.calibration.to_projector(rig.aim)
    aim_distance = float(np.linalg.norm(aim))
    aim_off_axis = float(aim[2]) / aim_distance
    exponent = optics.projector_falloff - 3.0
    arriving = (aim_distance / distance) ** 2 * (off_axis / aim_off_axis) ** exponent
    to_eye = -xyz / np.sqrt((xyz**2).sum(-1))[:, None]
    half = to_light + to_eye
    half /= np.sqrt((half**2).sum(-1))[:, None]
    highlight = np.maximum((half * normal).sum(-1), 0.0) ** GLOSS_EXPONENT * arriving
    return arriving * facing, highlight


def _reflectance(
    scene: Scene, body: NDArray[np.int32], directions: Array, origin: Array, shape: tuple[int, ...]
) -> tuple[Plane, Plane]:
    albedo = np.zeros(len(body), dtype=np.float32)
    gloss = np.zeros(len(body), dtype=np.float32)
    for index, material in enumerate(scene.materials):
        on = body == index
        gloss[on] = material.gloss
        if isinstance(material.albedo, float):
            albedo[on] = material.albedo
        else:
            albedo[on] = _textured(material, scene.bodies[index], on, directions, origin, shape)
    return albedo, gloss


def _textured(
    material: Material,
    rectangle: Array,
    on: NDArray[np.bool_],
    directions: Array,
    origin: Array,
    shape: tuple[int, ...],
) -> Plane:
    """Mean albedo over the footprint of each pixel of `on`, on the rectangle's own plane."""
    assert callable(material.albedo)  # noqa: S101  (for the type checker; the caller chose)
    centre, u_axis, v_axis, normal = (rectangle[k : k + 3] for k in (1, 4, 7, 10))
    points = directions * (((centre - origin) @ normal) / (directions @ normal))[:, None] + (origin - centre)
    u, v = (points @ u_axis).reshape(shape), (points @ v_axis).reshape(shape)
    u_down, u_across = (g.ravel()[on] for g in np.gradient(u))
    v_down, v_across = (g.ravel()[on] for g in np.gradient(v))
    u_on, v_on = u.ravel()[on], v.ravel()[on]
    total = np.zeros(len(u_on), dtype=np.float32)
    offsets = (np.arange(SUBSAMPLES) + 0.5) / SUBSAMPLES - 0.5
    for a in offsets:
        for b in offsets:
            total += material.albedo(u_on + a * u_across + b * u_down, v_on + a * v_across + b * v_down)
    return total / np.float32(SUBSAMPLES**2)


def warm_up() -> None:
    """Compile the kernels (or load them from their cache)."""
    flat = np.zeros((2, 2), dtype=np.float32)
    table = np.zeros((8, 8), dtype=np.float32)
    _look_up_line(flat, table[0], np.float32(2), flat, flat, flat.copy())
    _look_up_grid(flat, flat, table, np.float32(2), flat, flat, flat.copy())
