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
"""Height where there is no bust: behind its base, which ends the surface"""


@cache
def relief(height_mm: float, width_mm: float, depth_mm: float) -> HeightField:
    """The bust, centred on the target, `depth_mm` from the tip of the nose to the base it is cut off at."""
    nx, ny = int(width_mm / CELL_MM) + 5, int(height_mm / CELL_MM) + 5
    x = (np.arange(nx) - (nx - 1) / 2) * CELL_MM
    y = (np.arange(ny) - (ny - 1) / 2) * CELL_MM
    # Drawn on a canvas 190 wide, 260 high, 150 deep, x right, y down from the middle, z towards the viewer.
    u, v = np.meshgrid(x * 190.0 / width_mm, y * 260.0 / height_mm)
    z = _sculpt(u, v)
    z = np.where(z > 0, z * (depth_mm / z.max()), OFF_MM)
    return HeightField(float(x[0]), float(y[0]), REFERENCE_AIM_MM + depth_mm / 2, CELL_MM, np.ascontiguousarray(z))


def _sculpt(u: Array, v: Array) -> Array:
    """Height over the canvas, mm: u to the right, v down, both from its middle. Negative: nothing there."""
    body = _soft_max(_torso(u, v), _neck(u, v), 14.0)
    head = _soft_max(_cranium(u, v), _face(u, v), 6.0)
    head = head + _features(u, v) + _hair(u, v)
    whole = _soft_max(_soft_max(head, _ears(u, v), 2.0), body, 5.0)
    return np.where(_outline(u, v), whole, OFF_MM)


def _cranium(u: Array, v: Array) -> Array:
    return _ellipsoid(u, v, (0.0, -76.0, 50.0), (49.0, 53.0, 70.0))


def _face(u: Array, v: Array) -> Array:
    # The jaw narrows downwards: the half width falls from the cheekbones to the chin.
    narrowing = 44.0 - 17.0 * _rise(v, -52.0, 12.0)
    return _ellipsoid(u / narrowing, v, (0.0, -44.0, 52.0), (1.0, 53.0, 67.0))


def _neck(u: Array, v: Array) -> Array:
    flare = 29.0 + 0.010 * np.maximum(v - 8.0, 0.0) ** 2
    column = 22.0 + 40.0 * np.sqrt(np.maximum(1.0 - (u / flare) ** 2, 0.0)) - 3.0 * np.maximum(np.abs(u) - flare, 0.0)
    column = column + 5.0 * _ridge(u, v, (-33.0, -25.0), (-5.0, 56.0), 5.0)
    column = column + 5.0 * _ridge(u, v, (33.0, -25.0), (5.0, 56.0), 5.0)
    return column - 60.0 * _rise(-v, 30.0, 60.0) - 9.0 * _bump(u, v, (0.0, 60.0), (6.0, 6.0))


def _torso(u: Array, v: Array) -> Array:
    # The shoulder line falls outwards; below it the chest comes forward and turns away at the arms.
    shoulder = 47.0 + 0.0042 * u**2 + 0.16 * np.abs(u)
    below = v - shoulder
    thick = 66.0 * np.sqrt(np.maximum(1.0 - (np.clip(30.0 - below, 0.0, 30.0) / 30.0) ** 2, 0.0))
    chest = thick * np.sqrt(np.maximum(1.0 - (np.abs(u) / 104.0) ** 3.2, 0.0)) + 8.0
    chest = chest + 0.10 * np.clip(below, 0.0, 60.0)
    chest = chest + 4.5 * _ridge(u, v, (-9.0, 66.0), (-70.0, 62.0), 4.5)
    chest = chest + 4.5 * _ridge(u, v, (9.0, 66.0), (70.0, 62.0), 4.5)
    chest = chest + _drapery(u, v)
    return np.where(below > 0.0, chest, 8.0 + 5.0 * below)


def _drapery(u: Array, v: Array) -> Array:
    """A cloak from the viewer's right shoulder: folds that run down to the left, and their hem."""
    across = (v - 92.0) * 0.86 + u * 0.50
    cloth = _rise(across, -2.0, 8.0)
    fold = np.sin(across / 4.6 + 0.9 * np.sin(u / 23.0) + 0.4 * np.sin(v / 17.0))
    return cloth * (6.0 + 3.2 * fold)


def _features(u: Array, v: Array) -> Array:
    side = np.abs(u)
    nose = _rise(v, -82.0, -43.0) * (1.0 - _rise(v, -42.0, -35.0))
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
    tilt = side - 0.10 * (v + 62.0)
    shell = _ellipsoid(tilt, v, (50.0, -62.0, 36.0), (9.0, 18.0, 20.0))
    hollow = 7.5 * _bump(tilt, v, (50.0, -64.0), (3.2, 8.0))
    return shell - hollow + 2.0 * _bump(tilt, v, (45.0, -60.0), (2.0, 3.5))


def _hair(u: Array, v: Array) -> Array:
    """Locks combed forward from the crown, in two rows of curls that end on the forehead and before the ears."""
    hairline = -101.0 + 0.013 * u**2 - 0.000010 * u**4
    on = np.maximum(_rise(hairline - v, -2.5, 3.0), _rise(np.abs(u), 40.5, 44.0) * _rise(-v, 64.0, 74.0))
    radius = np.hypot(u, 0.9 * (v + 122.0))
    angle = np.arctan2(u, v + 124.0)
    lock = np.sin(13.0 * angle + 0.07 * radius + 0.7 * np.sin(radius / 7.0))
    curl = np.cos(radius / 5.6 + 1.6 * np.sin(6.5 * angle))
    return on * (5.0 + 1.9 * lock + 1.3 * curl)


def _outline(u: Array, v: Array) -> NDArray[np.bool_]:
    """The cut of a portrait bust: a round lower edge under the chest, straight at the canvas's sides."""
    low = (np.abs(u) / 99.0) ** 2.6 + (np.maximum(v - 52.0, 0.0) / 77.0) ** 2.6
    return np.asarray(low < 1.0)


# --- shapes --------------------------------------------------------------------------------------------------------


def _ellipsoid(u: Array, v: Array, centre: tuple[float, float, float], radii: tuple[float, float, float]) -> Array:
    """Front half of an ellipsoid; beyond its outline it falls away steeply."""
    q = np.hypot((u - centre[0]) / radii[0], (v - centre[1]) / radii[1])
    return centre[2] + radii[2] * (np.sqrt(np.maximum(1.0 - q**2, 0.0)) - 4.0 * np.maximum(q - 1.0, 0.0))


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
