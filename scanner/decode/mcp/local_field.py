"""The magnification of the carriers where no smooth field over the whole image holds: found place by place.

With the baseline along the phase direction a surface stretches carriers as far as the projector sees them stretched,
and one slow field over the image follows them (`magnification`). Before a rolled projector, or one that stands
diagonally, a surface that falls away along the stripes draws them together by tens of per cent, as it does the columns
of a stereo pair. So cells of the image (half a window wide, a stripe high) ask for the magnification at which their
windows hold most power on the carriers, and pass what they found to their neighbours along rows and columns, with a
cost for every change and a most for any: semi-global matching (Hirschmueller 2008, sec. 2.3), of magnification instead
of disparity.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp.ranks import quantiles
from scanner.decode.mcp.tracks import Tracks
from scanner.kernel import summing_kernel

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

RANGE = 0.36
STEP = 0.02
"""Magnifications tried about the smooth field, relative: a surface that turns away by 60 degrees along the stripes,
seen from a projector 15 degrees to the side, is drawn together by a third. Steps are a third of a line's width."""

ACROSS, ALONG = 5, 3
"""Cells over which power is pooled: five stripes have three words, and three words nearly all carriers"""

CHANGE = 0.04
"""Cost of a change by one step from cell to cell, in shares of what a clear cell gains by being right"""
STEPS = 6
"""Changes by more cost as much as an edge does"""
EDGE = 0.4

DOUBT = 0.1
"""Cost of the furthest try against the smooth field, in the same shares: between equals the nearest"""

LEFT = 0.05
"""Share of a window's energy that is left even by the right magnification: noise, and what varies within a window"""

CLEAR = 0.75
"""Quantile of the cells' best by which gains are measured: half of the stripes and the print's dark have none"""


@dataclass(frozen=True, eq=False)
class Cells:
    """A grid over the image, half a window wide and a stripe high. x, y: (N,) where the tracks' places lie in it, in
    cells, the middle of the first one being 0.
    """

    shape: tuple[int, int]
    x: NDArray[np.float64]
    y: NDArray[np.float64]

    @classmethod
    def of(cls, tracks: Tracks, pitch: float, size: int, shape: tuple[int, int]) -> Cells:
        """For windows of `size` samples in an image of `shape` (H, W), stripes `pitch` px apart."""
        rows, columns = max(1, round(shape[0] / pitch)), max(1, round(2 * shape[1] / size))
        x = tracks.chains.column.astype(np.float64) * (columns * 4.0 / shape[1]) - 0.5
        return cls((rows, columns), x, tracks.y.astype(np.float64) * (rows / shape[0]) - 0.5)

    def numbers(self, places: NDArray[Any]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns of the cells that these places lie in."""
        row, column = (
            np.clip(np.rint(at[places]).astype(np.intp), 0, most - 1)
            for at, most in zip((self.y, self.x), self.shape, strict=True)
        )
        return row, column

    def at_places(self, values: Array) -> Array:
        """(N,) float32: the cells' values at the tracks' places, between cells' middles bilinear."""
        x, y = self.x.astype(np.float32), self.y.astype(np.float32)
        # OpenCV remaps no more than 32767 lines.
        held = cv2.BORDER_REPLICATE
        parts = [
            cv2.remap(
                values,
                x[k : k + 30_000, None],
                y[k : k + 30_000, None],
                cv2.INTER_LINEAR,
                borderMode=held,
            )
            for k in range(0, len(x), 30_000)
        ]
        return np.asarray(np.concatenate(parts)[:, 0] if parts else np.zeros(0), np.float32)


@dataclass(frozen=True)
class Axes:
    """What is looked for in a window of `size` samples: carriers (N,) in cycles per camera px where the field is 1."""

    carriers: tuple[float, ...]
    size: int


def tries() -> NDArray[np.float64]:
    """Magnifications, relative to the smooth field, less 1."""
    count = round(RANGE / STEP)
    return np.arange(-count, count + 1, dtype=np.float64) * STEP


def found_about(light: Array, starts: Ints, tracks: Tracks, smooth: Array, axes: Axes, cells: Cells) -> Array:
    """The field about a smooth one.

    Args:
        light: (4 N,) float32, along the tracks.
        starts: (M,) int32, places at which windows begin.
        tracks: as elsewhere.
        smooth: (N,) float32, the smooth field, about 1.
        axes, cells: what is looked for, and where.

    Returns:
        (N,) float32, about 1.
    """
    middle = tracks.chains.order[starts + axes.size // 8]
    tried = tries()
    least = smooth[middle] - 1 + tried[0]
    lowest = int(np.floor(least.min() / STEP))
    first = (np.rint(least / STEP) - lowest).clip(0).astype(np.int32)
    ground, waves = _orthonormal(axes.carriers, lowest, int(first.max()) + len(tried), axes.size)
    share, energy = np.zeros((len(starts), len(tried)), np.float32), np.zeros(len(starts), np.float32)
    _explain(light, starts * 4, first, _window(axes.size).astype(np.float32), ground, waves, energy, share)
    return np.asarray(smooth + cells.at_places(find(share, energy, cells.numbers(middle), cells.shape)), np.float32)


def find(share: Array, energy: Array, cell: tuple[NDArray[np.intp], NDArray[np.intp]], shape: tuple[int, int]) -> Array:
    """The magnification in every cell.

    Args:
        share: (M, Q) float32, share of each window's energy that carriers explain at each of the `tries`.
        energy: (M,) float32, alternating light over squared brightness: unmodulated stripes have next to none.
        cell: rows and columns (M,) of the windows' cells.
        shape: rows and columns of cells.

    Returns:
        (rows, columns) float32, relative to the smooth field, less 1.
    """
    tried = tries()
    # Logarithm of what is left: at half a line's width beside the truth little is, but several times the noise.
    gain = -np.log(1 - np.clip(share, 0, 1) + np.float32(LEFT))
    gain -= np.median(gain, axis=1, keepdims=True)
    # One line of texture must not stand for a region: no window counts for more than a clear one.
    gain *= np.minimum(1, energy / max(quantiles(energy, CLEAR)[0], 1e-9))[:, None]
    sums, filled = np.zeros((*shape, len(tried)), np.float32), np.zeros(shape, np.float32)
    np.add.at(sums, cell, gain)
    np.add.at(filled, cell, 1)
    counts = np.maximum(_pooled(filled[..., None]), np.float32(1 / (ACROSS * ALONG)))
    pooled = np.asarray(_pooled(sums) / counts, np.float32)
    pooled /= np.float32(max(quantiles(pooled.max(axis=2)[filled > 0], CLEAR)[0], 1e-9))
    pooled -= np.asarray(DOUBT * (tried / RANGE) ** 2, np.float32)
    # Each of the four ways has a cell's own gain in it: once is enough.
    total: Array = np.float32(-3) * pooled
    for axis in (0, 1):
        for way in (1, -1):
            total += _passed(pooled, axis, way)
    return _refined(total, tried)


def _pooled(cells: Array) -> Array:
    flat = cells.reshape(*cells.shape[:2], -1)
    out = [
        cv2.blur(np.ascontiguousarray(flat[..., q]), (ALONG, ACROSS), borderType=cv2.BORDER_CONSTANT)
        for q in range(flat.shape[2])
    ]
    return np.stack(out, axis=2)


def _passed(gain: Array, axis: int, way: int) -> Array:
    """What cells gain with all that lie before them along a line: best paths, changes paid for."""
    lines = np.moveaxis(gain, axis, 0)[::way]
    total = np.empty_like(lines)
    total[0] = lines[0]
    for k in range(1, len(lines)):
        before = total[k - 1]
        best = before.max(axis=1, keepdims=True)
        reached = np.maximum(before, best - np.float32(EDGE))
        for step in range(1, STEPS + 1):
            cost = np.float32(CHANGE * step)
            reached[:, step:] = np.maximum(reached[:, step:], before[:, :-step] - cost)
            reached[:, :-step] = np.maximum(reached[:, :-step], before[:, step:] - cost)
        # Less the best: sums over long lines would lose their digits.
        total[k] = lines[k] + reached - best
    passed: Array = np.moveaxis(total[::way], 0, axis)
    return passed


def _refined(total: Array, tried: NDArray[np.float64]) -> Array:
    """Each cell's best, by a parabola through its neighbours."""
    at = total.argmax(axis=2)
    inner = np.clip(at, 1, len(tried) - 2)[..., None]
    left, top, right = (np.take_along_axis(total, inner + d, axis=2)[..., 0] for d in (-1, 0, 1))
    curve = left - 2 * top + right
    shift = np.where(curve < 0, 0.5 * (left - right) / np.minimum(curve, -1e-9), 0)
    fraction = np.where(inner[..., 0] == at, np.clip(shift, -0.5, 0.5), 0)
    return np.asarray(tried[at] + STEP * fraction, np.float32)


@lru_cache(maxsize=16)
def _window(size: int) -> NDArray[np.float64]:
    return np.asarray(np.hanning(size + 2)[1:-1])


@lru_cache(maxsize=16)
def _orthonormal(carriers: tuple[float, ...], lowest: int, count: int, size: int) -> tuple[Array, Array]:
    """Functions whose products under the window are 0 and 1: of the ground (3, size), and of all carriers besides at
    each magnification 1 + (lowest + k) STEP: (count, 2 N, size).

    Carriers that a window hardly resolves overlap: sums of their powers would count the same light twice.
    """
    t = np.arange(size) - (size - 1) / 2
    root = np.sqrt(_window(size))
    ground = np.linalg.qr(np.vander(2 * t / size, 3) * root[:, None])[0]
    every = np.empty((count, 2 * len(carriers), size), np.float32)
    for k in range(count):
        phase = 2 * np.pi * t[:, None] * (np.asarray(carriers) / max(1 + (lowest + k) * STEP, STEP))
        waves = np.concatenate([np.cos(phase), np.sin(phase)], axis=1) * root[:, None]
        waves -= ground @ (ground.T @ waves)
        found, strength, _ = np.linalg.svd(waves, full_matrices=False)
        every[k] = (found * (strength > 0.1 * strength[0]) / root[:, None]).T
    return (ground / root[:, None]).T.astype(np.float32), every


@summing_kernel
def _explain(
    light: Array, starts: Ints, first: Ints, window: Array, ground: Array, waves: Array, energy: Array, share: Array
) -> None:
    """Of each window the energy that the ground leaves, over squared brightness; of that the share of each try."""
    size = len(window)
    piece = np.empty(size, np.float32)
    weight = np.float32(0)
    for q in range(size):
        weight += window[q]
    for n in range(len(starts)):
        level, total = np.float32(0), np.float32(0)
        for q in range(size):
            value = light[starts[n] + q]
            piece[q] = value * window[q]
            level += piece[q]
            total += value * piece[q]
        level /= weight
        for g in range(ground.shape[0]):
            dot = np.float32(0)
            for q in range(size):
                dot += piece[q] * ground[g, q]
            total -= dot * dot
        if level <= 0 or total <= 0:
            continue
        energy[n] = total / (level * level)
        for j in range(share.shape[1]):
            explained = np.float32(0)
            for w in range(waves.shape[1]):
                dot = np.float32(0)
                for q in range(size):
                    dot += piece[q] * waves[first[n] + j, w, q]
                explained += dot * dot
            share[n, j] = explained / total


def warm_up() -> None:
    """Compile what only rigs come to whose carriers vary from place to place."""
    ground, waves = _orthonormal((0.1, 0.2), -1, 2, 24)
    none = np.zeros(1, np.int32)
    share, energy = np.zeros((1, 1), np.float32), np.zeros(1, np.float32)
    _explain(np.ones(24, np.float32), none, none, _window(24).astype(np.float32), ground, waves, energy, share)
