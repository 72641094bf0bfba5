"""The reference scenes: which bodies stand where, and how they reflect. Coordinates of scenes.json, mm.

A scene is data: bodies for `cast`, one material a body. Geometry never depends on the world's seed (which is noise),
except the poses of printed targets, which are drawn from it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.simulated import bust, targets, textures
from drivers.simulated.cast import HeightField, box, height_body, rectangle, sphere
from drivers.simulated.rigs import REFERENCE_AIM_MM, Rig, reference

Array = NDArray[np.float64]

TARGET = np.array([0.0, 0.0, REFERENCE_AIM_MM])
X, Y, Z = np.eye(3)


@dataclass(frozen=True, eq=False)
class Material:
    """How a body reflects. albedo 0..1, or a picture printed on a rectangle."""

    albedo: float | textures.Print
    gloss: float = 0.0


@dataclass(frozen=True, eq=False)
class Scene:
    """Bodies, the material of each, and the height field if one of them is one."""

    bodies: Array
    materials: tuple[Material, ...]
    field: HeightField | None = None


@dataclass(frozen=True)
class SceneOptions:
    """What a scene can be asked: tilt and place of `tilt`, the number of a printed target's pose."""

    tilt_deg: float = field(default=30.0, metadata={"low": -60.0, "high": 60.0})
    """of the board of `tilt`, degrees"""
    about: str = field(default="x", metadata={"choices": ("x", "y")})
    """axis of the camera's picture about which it is turned"""
    offset_mm: float = field(default=0.0, metadata={"low": -400.0, "high": 400.0})
    """of the board of `tilt`: farther than the aim by this, in the scene's mm (casey2011's)"""
    pose: int = field(default=0, metadata={"low": 0, "high": 11})
    """number of a printed target's pose, drawn from `seed`"""


def scene_names() -> tuple[str, ...]:
    """Names of all scenes, tilted boards spelt out."""
    return (*reference()["scenes"], *targets.DISC_POSES, *_TILTS)


def build_scene(name: str, options: SceneOptions, rig: Rig, seed: int) -> Scene:
    """The scene of that name.

    Args:
        name: one of `scene_names`.
        options: for `tilt` and the scenes of poses.
        rig: printed targets are posed so that its two devices see them whole.
        seed: of the poses.

    Raises:
        KeyError: there is no such scene.
    """
    if name in _TILTS:
        about, degrees = _TILTS[name]
        return _tilt(degrees, about)
    if name == "tilt":
        return _tilt(options.tilt_deg, options.about, options.offset_mm)
    if name in targets.POSED:
        return _posed(name, options.pose, rig, seed)
    return _SCENES[name]()


_TILTS: Mapping[str, tuple[str, float]] = {
    f"tilt_{about}{degrees}": (about, float(degrees)) for about in ("x", "y") for degrees in (15, 30, 45)
}


def _albedo() -> float:
    return float(reference()["optics"]["albedo"])


def _plane(z_mm: float) -> Array:
    return rectangle(np.array([0.0, 0.0, z_mm]), X, Y)


def _board() -> Scene:
    return Scene(_plane(REFERENCE_AIM_MM)[None], (Material(_albedo()),))


def _tilt(degrees: float, about: str, offset_mm: float = 0.0) -> Scene:
    angle = np.radians(degrees)
    u = X if about == "x" else np.cos(angle) * X + np.sin(angle) * Z
    v = np.cos(angle) * Y + np.sin(angle) * Z if about == "x" else Y
    return Scene(rectangle(TARGET + offset_mm * Z, u, v)[None], (Material(_albedo()),))


def _textured() -> Scene:
    return Scene(_plane(REFERENCE_AIM_MM)[None], (Material(textures.sampler()),))


def _two_albedo() -> Scene:
    description = reference()["scenes"]["two_albedo"]
    material = Material(textures.chequer(*description["albedo"]), gloss=float(description["gloss"]))
    return Scene(_plane(REFERENCE_AIM_MM)[None], (material,))


def _sphere(name: str) -> Scene:
    description = reference()["scenes"][name]
    background = description["background"]
    bodies = np.stack(
        (
            sphere(np.asarray(description["centre_mm"], dtype=np.float64), float(description["radius_mm"])),
            _plane(float(background["plane_z_mm"])),
        )
    )
    return Scene(bodies, (Material(_albedo()), Material(float(background.get("albedo", _albedo())))))


def _blocks() -> Scene:
    description = reference()["scenes"]["blocks"]
    heights, (least, most) = description["heights_mm"], description["sides_mm"]
    slant = np.radians(description["some_slanted_deg"])
    generator = np.random.default_rng(2011)
    bodies = [_plane(REFERENCE_AIM_MM)]
    # One block in each cell of a 4 x 3 lattice over the field: no two touch, and none leaves the view.
    for i in range(description["count"]):
        row, column = divmod(i, 4)
        cell = np.array([(column - 1.5) * 130.0, (row - 1.0) * 132.0])
        sides = generator.uniform(least, most, 2) if i else np.array([most, least])
        height = float(heights[i % len(heights)])
        room = np.maximum((128.0 - sides * 1.05) / 2, 0.0) * 0.6
        where = cell + generator.uniform(-room, room)
        turn = 0.0 if sides.max() > 100 else generator.uniform(-0.3, 0.3)
        bodies.append(_block(where, sides, height, turn, slant if i % 4 == 2 else 0.0))
    return Scene(np.stack(bodies), (Material(_albedo()),) * len(bodies))


def _block(where: Array, sides: Array, height: float, turn: float, slant: float) -> Array:
    """A block whose top's centre stands `height` above the board; a slanted one sinks into it on one side."""
    u = np.cos(turn) * X + np.sin(turn) * Y
    v = np.cos(turn) * Y - np.sin(turn) * X
    u, w = np.cos(slant) * u + np.sin(slant) * Z, np.cos(slant) * Z - np.sin(slant) * u
    depth = height + 60.0
    top = np.array([where[0], where[1], REFERENCE_AIM_MM - height])
    return box(top + w * depth / 2, np.stack((u, v, w)), np.array([sides[0] / 2, sides[1] / 2, depth / 2]))


def _bust() -> Scene:
    description = reference()["scenes"]["bust"]
    relief = bust.relief(description["height_mm"], description["width_mm"], description["depth_mm"])
    bodies = np.stack((height_body(relief), _plane(float(description["background"]["plane_z_mm"]))))
    return Scene(bodies, (Material(_albedo()), Material(_albedo())), relief)


def _wedge() -> Scene:
    planes = targets.wedge_planes()
    bodies = np.stack([rectangle(p.centre, p.u, p.v, *p.half) for p in planes])
    discs = reference()["scenes"]["wedge"]["discs"]
    radius, inside = float(discs["radius_mm"]), float(discs["albedo"])
    printed = (textures.Discs(p.disc_centres, radius, inside, _albedo()) for p in planes)
    return Scene(bodies, tuple(Material(picture) for picture in printed))


def _posed(name: str, number: int, rig: Rig, seed: int) -> Scene:
    pose = targets.target_poses(name, rig, seed)[number]
    target = targets.POSED[name]
    side = targets.square_mm(rig) / rig.scale  # in the scene's coordinates, which the rig scales
    half_u, half_v = (squares * side for squares in target.half_extent_squares)
    body = rectangle(rig.to_scene(pose.translation), pose.rotation[:, 0], pose.rotation[:, 1], half_u, half_v)
    return Scene(body[None], (Material(target.texture(side)),))


_SCENES: Mapping[str, Callable[[], Scene]] = {
    "board": _board,
    "textured": _textured,
    "sphere_board": lambda: _sphere("sphere_board"),
    "sphere_dark": lambda: _sphere("sphere_dark"),
    "blocks": _blocks,
    "bust": _bust,
    "wedge": _wedge,
    "two_albedo": _two_albedo,
}
