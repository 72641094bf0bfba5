"""Albedo over a flat body: printed samplers, chequers and discs, as functions of the position on it.

A texture is sampled many times within a pixel's footprint (`optics`), so it may have hard edges.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

Texture = Callable[[Array, Array], NDArray[np.float32]]
"""(u, v) mm from the rectangle's centre, any equal shapes, to albedo 0..1"""

DARK, BRIGHT = 0.05, 0.9


def sampler() -> Texture:
    """The `textured` scene: six fields of 185 x 205 mm, repeated beyond the reference field.

    Chequers of 12 mm and of 4 mm, stripes of 6 mm; smooth noise, print, a dark patch with a bright rim.
    """
    noise, text = _smooth_noise(), _print()

    def albedo(u: Array, v: Array) -> NDArray[np.float32]:
        column = np.floor(u / 185.0 + 1.5).astype(np.int64) % 3
        row = np.floor(v / 205.0 + 1.0).astype(np.int64) % 2
        du, dv = (u / 185.0 + 1.5) % 1.0 * 185.0, (v / 205.0 + 1.0) % 1.0 * 205.0
        inside = (np.abs(du - 92.5) < 62.5) & (np.abs(dv - 102.5) < 72.5)
        fields = (
            _two(_squares(u, v, 12.0)),
            _two(_squares(u, v, 4.0)),
            _two(np.floor((u + v) / (6.0 * np.sqrt(2.0))).astype(np.int64) % 2 == 0),
            _lookup(noise, du, dv),
            _lookup(text, du, dv),
            np.where(inside, np.float32(DARK), np.float32(0.6)),
        )
        return np.asarray(np.choose(row * 3 + column, fields), dtype=np.float32)

    return albedo


def chequer(dark: float, bright: float, side_mm: float = 100.0) -> Texture:
    """Squares of two albedos with edges along both axes, a dark one's corner at the centre."""

    def albedo(u: Array, v: Array) -> NDArray[np.float32]:
        return np.where(_squares(u, v, side_mm), np.float32(dark), np.float32(bright))

    return albedo


def discs(centres: Array, radius_mm: float, inside: float, outside: float) -> Texture:
    """Discs on a plain ground; centres: (N, 2) mm."""

    def albedo(u: Array, v: Array) -> NDArray[np.float32]:
        result = np.full(u.shape, outside, dtype=np.float32)
        for x, y in centres:
            result[(u - x) ** 2 + (v - y) ** 2 < radius_mm**2] = inside
        return result

    return albedo


def image(picture: NDArray[np.float32], mm_per_px: float, around: float) -> Texture:
    """A picture (H, W) of albedos, centred; `around`: albedo beyond it."""
    height, width = picture.shape

    def albedo(u: Array, v: Array) -> NDArray[np.float32]:
        column = np.floor(u / mm_per_px + width / 2).astype(np.int64)
        row = np.floor(v / mm_per_px + height / 2).astype(np.int64)
        on = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        found = picture[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
        return np.where(on, found, np.float32(around))

    return albedo


def _squares(u: Array, v: Array, side: float) -> NDArray[np.bool_]:
    even: NDArray[np.bool_] = (np.floor(u / side).astype(np.int64) + np.floor(v / side).astype(np.int64)) % 2 == 0
    return even


def _two(dark: NDArray[np.bool_]) -> NDArray[np.float32]:
    return np.where(dark, np.float32(DARK), np.float32(BRIGHT))


def _lookup(picture: NDArray[np.float32], x_mm: Array, y_mm: Array) -> NDArray[np.float32]:
    """A picture with 0.25 mm pixels, nearest."""
    row = np.minimum((y_mm * 4).astype(np.int64), picture.shape[0] - 1)
    column = np.minimum((x_mm * 4).astype(np.int64), picture.shape[1] - 1)
    return np.asarray(picture[row, column], dtype=np.float32)


def _smooth_noise() -> NDArray[np.float32]:
    generator = np.random.default_rng(4)
    coarse = sum(
        cv2.resize(
            generator.standard_normal((rows, rows)).astype(np.float32), (740, 820), interpolation=cv2.INTER_CUBIC
        )
        * weight
        for rows, weight in ((6, 1.0), (12, 0.6), (25, 0.35))
    )
    low, high = float(np.min(coarse)), float(np.max(coarse))
    return np.asarray(DARK + (BRIGHT - DARK) * (coarse - low) / (high - low), dtype=np.float32)


def _print() -> NDArray[np.float32]:
    page = np.full((820, 740), 217, dtype=np.uint8)
    lines = (
        "STRUCTURED LIGHT",
        "rows and columns",
        "one pixel each",
        "phase is a ruler",
        "0123456789 %&?",
        "fringe fringe",
    )
    for i, line in enumerate(lines):
        cv2.putText(page, line, (30, 110 + 120 * i), cv2.FONT_HERSHEY_SIMPLEX, 1.9 - 0.05 * len(line), 18, 7 - i)
    return page.astype(np.float32) / np.float32(255)
