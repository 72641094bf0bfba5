"""The bust: head, neck and shoulders as a smooth height field, in the manner of a classical portrait in marble.

Solids (ellipsoids and tapering columns) are joined by a smooth maximum; features (nose, brow, eyes, lips, ears,
locks of hair) are added as soft reliefs on the head. It is no scan of anybody.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from drivers.simulated.cast import HeightField
from drivers.simulated.rigs import REFERENCE_AIM_MM

Array = NDArray[np.float64]

CELL_MM = 0.5
OFF_MM = -25.0
"""Least height: well behind the base, where the surface ends; the steep way down to it is the outline"""


@cache
def relief(height_mm: float, width_mm: float, depth_mm: float) -> HeightField:
    """The bust, centred on the target, `depth_mm` from the tip of the nose to the base it is cut off at."""
    nx, ny = int(width_mm / CELL_MM) + 5, int(height_mm / CELL_MM) + 5
    x = (np.arange(nx) - (nx - 1) / 2) * CELL_MM
    y = (np.arange(ny) - (ny - 1) / 2) * CELL_MM
    # Drawn on a canvas 190 wide, 260 high, 150 deep, x right, y down from the middle, z towards the viewer.
    u, v = np.meshgrid(x * 190.0 / width_mm, y * 260.0 / height_mm)
    z = _sculpt(u, v)
    z = np.maximum(z * (depth_mm / z.max()), OFF_MM)
    return HeightField(float(x[0]), float(y[0]), REFERENCE_AIM_MM + depth_mm / 2, CELL_MM, np.ascontiguousarray(z))


def _sculpt(u: Array, v: Array) -> Array:
    """Height over the canvas, mm: u to the right, v down, both from its middle. Negative: nothing there."""
    body = _soft_max(_torso(u, v), _neck(u, v), 14.0)
    head = _soft_max(_cranium(u, v), _face(u, v), 6.0)
    head = head + _features(u, v) + _hair(u, v)
    whole = _soft_max(_soft_max(head, _ears(u, v), 2.0), body, 5.0)
    return whole - _beyond_outline(u, v)


def _cranium(u: Array, v: Array) -> Array:
    return _ellipsoid(u, v, (0.0, -72.0, 48.0), (48.0, 53.0, 72.0), 2.0)


def _face(u: Array, v: Array) -> Array:
    # The jaw narrows downwards: the half width falls from the cheekbones to the chin.
    narrowing = 44.0 - 13.0 * _rise(v, -50.0, 10.0)
    return _ellipsoid(u / narrowing, v, (0.0, -43.0, 46.0), (1.0, 51.0, 73.0), 2.35)


def _neck(u: Array, v: Array) -> Array:
    flare = 28.0 + 0.007 * np.maximum(v - 10.0, 0.0) ** 2
    column = 22.0 + 40.0 * np.sqrt(np.maximum(1.0 - (u / flare) ** 2, 0.0)) - 8.0 * np.maximum(np.abs(u) - flare, 0.0)
    column = column + 4.5 * _ridge(u, v, (-33.0, -25.0), (-4.0, 50.0), 4.5)
    column = column + 4.5 * _ridge(u, v, (33.0, -25.0), (4.0, 50.0), 4.5)
    column = column + 3.0 * _bump(u, v, (0.0, 24.0), (5.0, 7.0))
    return column - 150.0 * _rise(-v, 20.0, 60.0) - 7.0 * _bump(u, v, (0.0, 52.0), (5.5, 5.0))


def _torso(u: Array, v: Array) -> Array:
    # The shoulder line falls outwards; below it the chest comes forward and turns away at the arms.
    shoulder = 33.0 + 0.0030 * u**2 + 0.20 * np.abs(u)
    below = v - shoulder
    thick = 62.0 * np.sqrt(np.maximum(1.0 - (np.clip(34.0 - below, 0.0, 34.0) / 34.0) ** 2, 0.0))
    chest = thick * np.sqrt(np.maximum(1.0 - (np.abs(u) / 102.0) ** 3.0, 0.0)) + 8.0
    chest = chest + 0.10 * np.clip(below, 0.0, 60.0)
    chest = chest + 4.0 * _ridge(u, v, (-8.0, 57.0), (-66.0, 54.0), 3.6)
    chest = chest + 4.0 * _ridge(u, v, (8.0, 57.0), (66.0, 54.0), 3.6)
    chest = chest + _drapery(u, v)
    return np.where(below > 0.0, chest, 8.0 + 5.0 * below)


def _drapery(u: Array, v: Array) -> Array:
    """A cloak from the right of the picture: rolled hem, folds that run down to the left and fan out."""
    across = (v - 84.0) * 0.85 + u * 0.53 + 4.0 * np.sin(u / 30.0)
    along = (v - 84.0) * 0.53 - u * 0.85
    cloth = _rise(across, -3.0, 4.0)
    spread = across / (1.0 + 0.0035 * along)
    fold = np.abs(np.sin(spread / 6.8 + 0.35 * np.sin(along / 19.0))) ** 0.8
    hem = np.exp(-0.5 * ((across - 4.0) / 3.4) ** 2)
    return cloth * (4.0 + 5.5 * fold) + 3.0 * hem


def _features(u: Array, v: Array) -> Array:
    side = np.abs(u)
    nose = _rise(v, -82.0, -43.0) * (1.0 - _rise(v, -43.0, -34.0))
    width = 4.2 + 2.6 * _rise(v, -75.0, -42.0)
    relief = 21.0 * nose**1.15 * np.exp(-0.5 * (u / width) ** 2)
    relief = relief + 4.0 * _bump(u, v, (0.0, -44.5), (5.0, 4.2)) + 5.5 * _bump(side, v, (7.6, -41.5), (3.4, 3.2))
    relief = (
        relief + 6.0 * _bump(side, v, (15.0, -83.0 + 0.0), (12.0, 4.2)) + 3.0 * _bump(u, v, (0.0, -84.0), (9.0, 5.0))
    )
    relief = relief - 11.0 * _bump(side, v, (17.5, -72.0), (8.0, 5.6)) - 4.0 * _bump(side, v, (8.0, -72.0), (3.5, 5.0))
    relief = relief + _eyes(side, v)
    relief = relief + 5.5 * _bump(side, v, (27.0, -57.0), (9.0, 8.0)) - 3.0 * _bump(side, v, (25.0, -32.0), (8.0, 10.0))
    return relief + _mouth(u, v)


def _eyes(side: Array, v: Array) -> Array:
    ball = _bump(side, v, (17.5, -71.0), (7.2, 4.6))
    # Lids: thin arcs above and below the ball, the upper one heavier.
    upper = np.exp(-0.5 * ((v + 76.0 - 0.034 * (side - 17.5) ** 2) / 1.3) ** 2)
    lower = np.exp(-0.5 * ((v + 66.0 + 0.026 * (side - 17.5) ** 2) / 1.1) ** 2)
    span = np.exp(-((np.abs(side - 17.5) / 9.5) ** 4))
    return 7.5 * ball + span * (2.2 * upper + 1.2 * lower) - 0.9 * _bump(side, v, (17.2, -71.2), (1.9, 1.9))


def _mouth(u: Array, v: Array) -> Array:
    muzzle = 5.0 * _bump(u, v, (0.0, -25.0), (17.0, 12.0))
    bow = -25.6 + 0.9 * np.cos(u / 3.2) * np.exp(-((u / 9.0) ** 2))
    upper = 4.2 * np.exp(-0.5 * ((v - bow) / 2.2) ** 2) * np.exp(-((u / 14.5) ** 4))
    lower = 5.0 * np.exp(-0.5 * ((v + 18.6) / 2.7) ** 2) * np.exp(-((u / 11.5) ** 4))
    line = -3.4 * np.exp(-0.5 * ((v + 22.4 + 0.006 * u**2) / 0.95) ** 2) * np.exp(-((u / 15.5) ** 6))
    philtrum = -1.8 * _bump(u, v, (0.0, -31.5), (1.8, 3.0))
    chin = 9.5 * _bump(u, v, (0.0, -2.5), (11.0, 7.0)) - 4.2 * _bump(u, v, (0.0, -12.5), (11.0, 3.4))
    return muzzle + upper + lower + line + philtrum + chin


def _ears(u: Array, v: Array) -> Array:
    side = np.abs(u)
    tilt = side + 0.12 * (v + 62.0)
    shell = _ellipsoid(tilt, v, (49.0, -62.0, 34.0), (8.0, 16.5, 18.0), 2.0)
    hollow = 7.5 * _bump(tilt, v, (49.5, -64.0), (2.8, 7.5))
    return shell - hollow + 2.0 * _bump(tilt, v, (45.0, -60.0), (2.0, 3.5))


def _hair(u: Array, v: Array) -> Array:
    """Strands combed forward from behind the crown; a fringe of comma locks on the forehead, down to the ears."""
    hairline = -97.0 + 0.012 * u**2 - 0.8 * np.cos(u / 2.3)
    on = np.maximum(_rise(hairline - v, -2.0, 4.5), _rise(np.abs(u), 39.0, 42.5) * _rise(-v, 58.0, 66.0))
    radius = np.hypot(u, v + 150.0)
    angle = np.arctan2(u, v + 150.0)
    sweep = 0.55 * np.sin(radius / 8.5) + 0.3 * np.sin(radius / 3.9 + 9.0 * angle)
    strand = np.abs(np.sin(15.0 * angle + sweep)) ** 0.6
    fine = np.abs(np.sin(38.0 * angle + 2.2 * sweep)) ** 0.7
    fringe = np.exp(-0.5 * ((hairline - v - 5.0) / 5.0) ** 2)
    return on * (4.5 + 2.6 * strand + 1.0 * fine + 2.5 * fringe)


def _beyond_outline(u: Array, v: Array) -> Array:
    """The cut of a portrait bust, a round lower edge under the chest: a steep fall beyond it, 0 within."""
    low = (np.abs(u) / 97.5) ** 2.6 + (np.maximum(v - 52.0, 0.0) / 77.0) ** 2.6
    return 1500.0 * np.maximum(low - 1.0, 0.0)


# --- shapes --------------------------------------------------------------------------------------------------------


def _ellipsoid(
    u: Array, v: Array, centre: tuple[float, float, float], radii: tuple[float, float, float], power: float
) -> Array:
    """Front half of an ellipsoid (power 2) or a squarer body (above); beyond its outline it falls away steeply."""
    q = (np.abs((u - centre[0]) / radii[0]) ** power + np.abs((v - centre[1]) / radii[1]) ** power) ** (1.0 / power)
    return centre[2] + radii[2] * (np.sqrt(np.maximum(1.0 - q**2, 0.0)) - 20.0 * np.maximum(q - 1.0, 0.0))


def _bump(u: Array, v: Array, centre: tuple[float, float], widths: tuple[float, float]) -> Array:
    return np.exp(-0.5 * (((u - centre[0]) / widths[0]) ** 2 + ((v - centre[1]) / widths[1]) ** 2))


def _ridge(u: Array, v: Array, start: tuple[float, float], end: tuple[float, float], width: float) -> Array:
    """A rounded ridge along a line, 1 on it, with soft ends."""
    du, dv = end[0] - start[0], end[1] - start[1]
    along = np.clip(((u - start[0]) * du + (v - start[1]) * dv) / (du * du + dv * dv), 0.0, 1.0)
    distance2 = (u - start[0] - along * du) ** 2 + (v - start[1] - along * dv) ** 2
    return np.exp(-0.5 * distance2 / width**2)


def _rise(x: Array, low: float, high: float) -> Array:
    """0 below `low`, 1 above `high`, smooth between (Hermite)."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def _soft_max(a: Array, b: Array, width: float) -> Array:
    """The larger of two heights, rounded where they are within `width` of one another."""
    h = np.maximum(width - np.abs(a - b), 0.0) / width
    return np.maximum(a, b) + h * h * width / 4.0
