"""What stands before the rigs. Lengths are shares of what the camera sees across at the target, so that any rig's
picture is full; none is a scene of scenes.json."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from held_out import solids


@dataclass(frozen=True)
class Material:
    """albedo 0..1; texture: (N, 3) mm, camera width mm -> factor on it; gloss: GGX roughness or None; milky: share of
    light that leaves the surface `mean_mm` away from where it came in."""

    albedo: float = 0.7
    texture: Callable | None = None
    gloss: float | None = None
    milky: float = 0.0
    mean_mm: float = 0.0


@dataclass(frozen=True)
class Scene:
    """solids: primitives of a width; materials: one each, the last for the rest."""

    name: str
    solids: Callable
    materials: tuple[Material, ...] = (Material(),)
    bounces: int = 0
    exposure: float = 1.0
    ambient: float = 1.0
    """times the rig's"""
    note: str = field(default="", compare=False)


def _noise(points, scale, seed):
    """Smooth noise of unit variance, from a few dozen plane waves."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(size=(24, 3)) * 2 * np.pi / scale
    phases = rng.uniform(0, 2 * np.pi, 24)
    return sum(np.sin(points @ w + p) for w, p in zip(waves, phases, strict=True)) / np.sqrt(12)


def weave(points, width):
    """Threads 1/180 of the width thick, dyed in broad bands."""
    k = 2 * np.pi * 180 / width
    threads = 0.9 + 0.1 * np.sin(k * points[:, 0]) * np.sin(k * points[:, 1])
    bands = np.where(np.sin(2 * np.pi * (0.8 * points[:, 0] + points[:, 1]) / (0.14 * width)) > 0.2, 1.0, 0.35)
    return threads * bands


def print_(points, width):
    """Patches, thin lines and smears, as on a carton."""
    cells = np.floor(points[:, :2] / (0.045 * width)).astype(int)
    patch = np.where((cells[:, 0] * 7 + cells[:, 1] * 13) % 5 == 0, 0.25, 1.0)
    lines = np.where(np.sin(2 * np.pi * points[:, 0] / (0.02 * width)) > 0.85, 0.4, 1.0)
    lines = np.where(points[:, 1] > 0.05 * width, lines, 1.0)
    return np.clip(patch * lines * (0.85 + 0.15 * _noise(points, 0.05 * width, 3)), 0.08, 1.0)


def skin(points, width):
    return np.clip(0.9 + 0.1 * _noise(points, 0.06 * width, 5), 0.3, 1)


def _board(w, tilt=(0.05, -0.08), back=0.0):
    return solids.plane((tilt[0], tilt[1], -1.0), -back * w)


def _tilted(w):
    return [solids.plane((0.35, -0.45, -1.0), 0.0)]


def _groove(w, turned):
    return [solids.groove(0.22 * w, 0.24 * w, -0.08 * w, turned)]


def _bowl(w):
    return [solids.bowl((0.02 * w, -0.01 * w, -0.04 * w), 0.3 * w, 0.0)]


def _blob(w):
    balls = [
        ((-0.12, 0.05, 0.0), 0.12),
        ((0.02, -0.06, -0.03), 0.14),
        ((0.13, 0.04, 0.02), 0.1),
        ((0.0, 0.12, 0.0), 0.1),
    ]
    return [
        *(solids.ball(np.array(c) * w, r * w, 0.09 * w) for c, r in balls),
        solids.torus((0.02 * w, 0.0, -0.02 * w), 0.27 * w, 0.035 * w, (25, 20, 0)),
        _board(w, back=0.22),
    ]


def _sphere(w):
    return [solids.sphere((0.0, 0.0, 0.0), 0.21 * w), _board(w, back=0.24)]


def _cloth(w):
    k = 2 * np.pi / w
    waves = [(2.1 * k, 0.9 * k, 0.3), (-1.3 * k, 3.4 * k, 1.9), (5.6 * k, 1.2 * k, 0.7), (3.1 * k, -7.3 * k, 2.5)]
    return [solids.cloth((0.03 * w, 0.022 * w, 0.008 * w, 0.005 * w), waves, 0.0)]


def _stairs(w):
    steps = [
        solids.box(((0.0, (0.27 - 0.09 * k) * w, 0.0)), (0.34 * w, 0.045 * w, (0.01 + 0.022 * k) * w), (0, 0, 7))
        for k in range(7)
    ]
    return [*steps, _board(w, (0.0, 0.03))]


def _rods(w):
    thick = (0.006, 0.009, 0.013, 0.02, 0.03)
    standing = [
        solids.rod(((-0.3 + 0.13 * k) * w, -0.3 * w, -0.1 * w), ((-0.24 + 0.13 * k) * w, 0.3 * w, -0.03 * w), r * w)
        for k, r in enumerate(thick)
    ]
    lying = [solids.rod((-0.34 * w, 0.1 * w, -0.2 * w), (0.3 * w, -0.02 * w, -0.16 * w), 0.012 * w)]
    return [*standing, *lying, _board(w, back=0.1)]


_MATT = Material(0.75)
_DARK = Material(0.02)

SCENES = {
    scene.name: scene
    for scene in (
        Scene("tilted", _tilted, (_MATT,), note="a plane, 30 degrees"),
        Scene("groove", lambda w: _groove(w, 80), (Material(0.85),), bounces=2, note="a concave V, 2 bounces"),
        Scene("groove_x", lambda w: _groove(w, -5), (Material(0.85),), bounces=2, note="the same, turned"),
        Scene("bowl", _bowl, (Material(0.85),), bounces=2, note="a hollow half ball, 2 bounces"),
        Scene("blob", _blob, (*(Material(0.65, skin),) * 4, Material(0.5, None, 0.3), _MATT), note="torus round blobs"),
        Scene("blob_dark", _blob, (*(Material(0.65, skin),) * 4, _MATT, _DARK), note="the same before a black board"),
        Scene("glossy", _sphere, (Material(0.45, None, 0.12), _MATT), note="a ball with a sharp highlight"),
        Scene("shiny", _sphere, (Material(0.2, None, 0.06), Material(0.5, None, 0.2)), note="darker, overexposed",
              exposure=1.8),
        Scene("milky", _sphere, (Material(0.75, None, 0.25, 0.6, 2.0), _MATT), note="light spreads by 2 mm under it"),
        Scene("cloth", _cloth, (Material(0.8, weave),), note="folds, weave and dyed bands"),
        Scene("carton", lambda w: [_board(w, (0.2, 0.25))], (Material(0.85, print_, 0.35),), note="print, half gloss"),
        Scene("stairs", _stairs, (Material(0.7),), bounces=1, note="seven steps, 1 bounce"),
        Scene("rods", _rods, (Material(0.6, None, 0.3),), note="rods of 1/80 to 1/16 of the width"),
        Scene("dim", _blob, (*(Material(0.65, skin),) * 5, _MATT), exposure=0.25, ambient=6.0, note="in daylight"),
    )
}  # fmt: skip
