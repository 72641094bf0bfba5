"""A scene as the camera's pixels see it: where each looks in the projected picture, how bright it is, and the truth.

Cast once per scene; what the projector shows later is looked up (`optics`). Shading is Lambert's, with the distance
and the off-axis fall-off of the projector, the camera's vignetting, ambient light, and a highlight on glossy bodies.
"""

# Kernels: numba types their arguments.
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.simulated.cast import Hits, cast_rays, lit_points
from drivers.simulated.optics import Optics, Plane
from drivers.simulated.print_blur import print_gain
from drivers.simulated.rigs import Rig
from drivers.simulated.scenes import Scene, SceneOptions, build_scene
from drivers.simulated.textures import Discs, Footprints, Picture
from scanner.devices import Truth
from scanner.geometry import Lens
from scanner.kernel import kernel

Array = NDArray[np.float64]

GLOSS_EXPONENT = 40.0
"""Width of the highlight (Blinn 1977): half its height 10 degrees off."""


@dataclass(frozen=True, eq=False)
class View:
    """A scene as the camera sees it, all (H + 2 margin, W + 2 margin); the truth is of its pixels alone, (H, W).

    Beyond its pixels lies what the lens blurs onto them: `margin` px of it on each side.
    row, column: float32 projector coordinates + 0.5 (so the picture begins at 0), 0 where no light comes. shade:
    reflected light for full-on light, in shares of what a white facing plane at the aim point would reflect; 0 where no
    light comes: light comes where the truth is lit, and as far beside the picture's ends as its blur carries (`spill`).
    floor: reflected ambient light in the same unit. print_gain: (H, W) float32, see `print_blur`; None of a scene
    without prints, or a camera without blur.
    """

    row: Plane
    column: Plane
    shade: Plane
    floor: Plane
    print_gain: Plane | None
    truth: Truth
    margin: int


def view_scene(rig: Rig, scene: Scene, optics: Optics, stride: int = 1, margin: int = 0, spill: int = 0) -> View:
    """Cast and shade a scene; stride > 1 looks at every stride-th pixel only.

    margin, spill: camera px and projector px beyond the two pictures; see `View`. Without margin, no lens blurs prints.
    """
    grid = _pixels(rig.calibration.camera, stride, margin)
    shape = grid.shape[:2]
    directions = _directions(rig.calibration.camera, grid)
    origin = rig.to_scene(np.zeros(3))
    hits = cast_rays(origin, directions, scene.bodies, scene.field)
    light = rig.to_scene(rig.calibration.projector_centre)
    lit = lit_points(origin, directions, hits, light, scene.bodies, scene.field)
    prints = {
        index: Footprints(material.albedo, scene.bodies[index], directions, origin, shape[1])
        for index, material in enumerate(scene.materials)
        if isinstance(material.albedo, Picture | Discs)
    }
    albedo = _albedo(scene, hits, prints)
    gain = _print_gain(prints, hits, albedo.reshape(shape), optics.camera_blur_sigma_px, margin)
    return _shaded(rig, scene, optics, directions, hits, lit, albedo, gain, shape, margin, spill)


def white_level(rig: Rig, optics: Optics) -> float:
    """99th percentile of the reflected light of the full-on board, in the unit of `View.shade`.

    The exposure rule of scenes.json: this level is 230 grey levels of 255 at the nominal exposure.
    """
    stride = max(1, rig.calibration.camera.size[0] // 160)
    board = view_scene(rig, build_scene("board", SceneOptions(), rig, 0), optics, stride)
    return float(np.percentile(board.shade + board.floor, 99))


def _pixels(camera: Lens, stride: int, margin: int) -> Array:
    """(H, W, 2) x, y of the pixels' centres, those beyond the picture's borders included."""
    x, y = (np.arange(-margin, n + margin, stride, dtype=np.float64) for n in camera.size)
    return np.stack(np.meshgrid(x, y), axis=-1)


def _directions(camera: Lens, grid: Array) -> Array:
    """(N, 3) viewing directions with z = 1."""
    directions = np.ones((grid.shape[0] * grid.shape[1], 3))
    if np.any(camera.distortion):
        directions[:, :2] = camera.normalised(grid).reshape(-1, 2)
    else:
        m = camera.matrix
        directions[:, :2] = ((grid - (m[0, 2], m[1, 2])) / (m[0, 0], m[1, 1])).reshape(-1, 2)
    return directions


def _albedo(scene: Scene, hits: Hits, prints: dict[int, Footprints]) -> Plane:
    """(N,) float32 albedo of what each pixel sees, averaged over its footprint where it is printed."""
    plain = [0.0 if index in prints else m.albedo for index, m in enumerate(scene.materials)]
    albedo = np.append(np.asarray(plain, dtype=np.float32), np.float32(0.0))[hits.body]
    for index, footprints in prints.items():
        own = np.flatnonzero(hits.body == index)
        albedo[own] = footprints.means(own)[:, 0, 0]
    return albedo


def _print_gain(prints: dict[int, Footprints], hits: Hits, albedo: Plane, blur_px: float, margin: int) -> Plane | None:
    """Of all prints; see `View`."""
    if not margin or blur_px <= 0 or not prints:
        return None
    gain = np.ones((albedo.shape[0] - 2 * margin, albedo.shape[1] - 2 * margin), dtype=np.float32)
    body = hits.body.reshape(albedo.shape)
    for index, footprints in prints.items():
        print_gain(albedo, body == index, blur_px, footprints, gain)
    return gain


def _shaded(
    rig: Rig,
    scene: Scene,
    optics: Optics,
    directions: Array,
    hits: Hits,
    lit: NDArray[np.bool_],
    albedo: Plane,
    gain: Plane | None,
    shape: tuple[int, ...],
    margin: int,
    spill: int,
) -> View:
    calibration = rig.calibration
    projector = calibration.projector
    planes = np.empty((6, len(albedo)), dtype=np.float32)
    xyz = np.empty((len(albedo), 3), dtype=np.float32)
    gloss = np.array([m.gloss for m in scene.materials] + [0.0])
    aim = calibration.to_projector(rig.aim)
    exponents = np.array([optics.projector_falloff - 3.0, optics.vignetting, optics.ambient])
    place = np.concatenate((calibration.rotation.ravel(), calibration.translation, calibration.projector_centre, aim))
    lens = np.concatenate((projector.matrix.ravel(), projector.distortion, projector.size))
    _shade(
        directions,
        hits.distance * rig.scale,
        hits.body,
        hits.normal,
        albedo,
        gloss,
        place,
        lens,
        exponents,
        float(spill),
        lit,
        planes,
        xyz,
    )
    row, column, shade, floor, rows, columns = (plane.reshape(shape) for plane in planes)
    own = np.s_[margin : shape[0] - margin, margin : shape[1] - margin]
    truth = Truth(
        rows=np.ascontiguousarray(rows[own]),
        columns=np.ascontiguousarray(columns[own]),
        xyz=np.ascontiguousarray(xyz.reshape(*shape, 3)[own]),
        lit=np.ascontiguousarray(lit.reshape(shape)[own]),
    )
    return View(row, column, shade, floor, gain, truth, margin)


@kernel
def _shade(directions, distance, body, normal, albedo, gloss, place, lens, exponents, spill, lit, planes, xyz):
    """Fill row, column, shade, floor, true rows, true columns (planes) and xyz; narrow `lit` to the picture."""
    half_power = 0.5 * exponents[1]
    aim2 = place[15] ** 2 + place[16] ** 2 + place[17] ** 2
    aim_off_axis = place[17] / np.sqrt(aim2)
    for i in range(directions.shape[0]):
        dx, dy = directions[i, 0], directions[i, 1]
        x, y, z = dx * distance[i], dy * distance[i], distance[i]
        xyz[i, 0], xyz[i, 1], xyz[i, 2] = x, y, z
        for k in range(6):
            planes[k, i] = 0.0
        if body[i] < 0:
            planes[4, i], planes[5, i] = np.nan, np.nan
            lit[i] = False
            continue
        px = place[0] * x + place[1] * y + place[2] * z + place[9]
        py = place[3] * x + place[4] * y + place[5] * z + place[10]
        pz = place[6] * x + place[7] * y + place[8] * z + place[11]
        column, row = _project(px / pz, py / pz, lens)
        planes[4, i], planes[5, i] = row, column
        vignette = (1.0 + dx * dx + dy * dy) ** -half_power
        planes[3, i] = albedo[i] * exponents[2] * vignette
        # Strictly inside, so that a lookup in single precision stays inside, too.
        beside = max(-0.5 - column, column - lens[14] + 0.501, -0.5 - row, row - lens[15] + 0.501)
        faces = lit[i] and pz > 0
        lit[i] = faces and beside < 0
        if not faces or beside >= spill:
            continue
        lx, ly, lz = place[12] - x, place[13] - y, place[14] - z
        far2 = lx * lx + ly * ly + lz * lz
        far = np.sqrt(far2)
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        # Each projector pixel carries the same light into a solid angle that shrinks as cos^3 off the axis: across
        # the axis the picture is evenly bright, but for `projector_falloff`.
        arriving = aim2 / far2 * (pz / far / aim_off_axis) ** exponents[0]
        facing = max((nx * lx + ny * ly + nz * lz) / far, 0.0)
        near = np.sqrt(x * x + y * y + z * z)
        hx, hy, hz = lx / far - x / near, ly / far - y / near, lz / far - z / near
        half = max((nx * hx + ny * hy + nz * hz) / np.sqrt(hx * hx + hy * hy + hz * hz), 0.0)
        highlight = gloss[body[i]] * half**GLOSS_EXPONENT if gloss[body[i]] > 0 else 0.0
        planes[0, i], planes[1, i] = row + 0.5, column + 0.5
        planes[2, i] = (albedo[i] * facing + highlight) * arriving * vignette


@kernel
def _project(x, y, lens):
    """Pixel of a direction in the projector's frame; lens: matrix (9), distortion (5), width, height."""
    k1, k2, p1, p2, k3 = lens[9], lens[10], lens[11], lens[12], lens[13]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return lens[0] * xd + lens[1] * yd + lens[2], lens[4] * yd + lens[5]


def warm_up() -> None:
    """Compile the kernels (or load them from their cache)."""
    one = np.ones(1)
    body = np.zeros(1, dtype=np.int32)
    planes, xyz = np.empty((6, 1), dtype=np.float32), np.empty((1, 3), dtype=np.float32)
    ray = np.array([[0.0, 0.0, 1.0]])
    albedo = np.ones(1, dtype=np.float32)
    _shade(
        ray,
        one,
        body,
        -ray,
        albedo,
        np.zeros(2),
        np.ones(18),
        np.ones(16),
        np.ones(3),
        0.0,
        np.ones(1, dtype=np.bool_),
        planes,
        xyz,
    )
