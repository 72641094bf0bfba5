"""The magnification of the carriers at every peak: a smooth field about what the search found.

Each window along a chain votes for the magnification at which most power lies on the carriers; a robust fit of
1, x, y and x y to these votes follows keystone, and leaves out windows that hold no carriers or an object's edge.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp import local_field
from scanner.decode.mcp.carriers import CarrierSearch, places
from scanner.decode.mcp.fits import FIELD_STEP
from scanner.decode.mcp.model import PatternModel
from scanner.decode.mcp.ranks import quantiles
from scanner.decode.mcp.stripes import STEP
from scanner.decode.mcp.tracks import Tracks
from scanner.kernel import summing_kernel

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

FIELD_RANGE = 0.07
"""Magnifications tried about the search's own, relative: what depth and the search's steps leave."""

LEAST_OFF = FIELD_STEP
"""Half of the windows lie nearer than this to a smooth field that holds (.0044 at most, on reference scenes; .008 and
more where a rolled projector draws carriers together): what the tables of emissions resolve."""

MOST_WINDOWS = 300
"""Windows that vote: the fit has four unknowns."""


def window_px(model: PatternModel, scale: float) -> int:
    """Samples of an emission's window: 1.5 beats of the two nearest carriers, a multiple of four.

    A Hann window of that length parts them by least squares with a tenth of the noise lost.
    """
    beat = scale / model.separation
    return int(STEP * np.clip(np.ceil(1.5 * beat / STEP), 6, 128))


def fit_fields(
    light: Array,
    tracks: Tracks,
    model: PatternModel,
    search: CarrierSearch,
    size: int,
    shape: tuple[int, int],
) -> tuple[Array, ...]:
    """The magnification at each place of the tracks: a smooth field; and where single windows stay away from it, a
    second one found place by place.

    Which of two is right shows when stripes are decoded: print can feign a field that varies, too.

    Args:
        light: (4 N,) float32, along the tracks.
        tracks, model: as elsewhere.
        search: mean magnification and its drift.
        size: window, samples.
        shape: (H, W) px.

    Returns:
        (N,) float32 each: magnification relative to `search.scale`.
    """
    smooth, off = _fit(light, tracks, model, search, size, shape)
    if off <= LEAST_OFF:
        return (smooth,)
    starts = _windows(tracks, size)
    cells = local_field.Cells.of(tracks, model.pitch * search.scale, size, shape)
    own = local_field.found_about(
        light, starts, tracks, smooth, local_field.Axes(_cycles(model, search.scale), size), cells
    )
    return smooth, own


def _cycles(model: PatternModel, scale: float) -> tuple[float, ...]:
    """Carriers in cycles per camera px."""
    return tuple(float(f) / scale for f in model.carriers)


def _windows(tracks: Tracks, size: int) -> Ints:
    """Where windows of `size` samples begin along the tracks, half of one apart, in places."""
    chains = tracks.chains
    hop = max(1, size // (2 * STEP))
    windows = np.maximum((chains.lengths - size // STEP) // hop + 1, 0)
    before = np.repeat(np.cumsum(windows) - windows, windows)
    return np.asarray(np.repeat(chains.start[:-1], windows) + hop * (np.arange(len(before)) - before), np.int32)


def _fit(
    light: Array,
    tracks: Tracks,
    model: PatternModel,
    search: CarrierSearch,
    size: int,
    shape: tuple[int, int],
) -> tuple[Array, float]:
    """The smooth field, and how far from it half of the votes lie."""
    x, y = places(tracks, shape)
    base = search.relative(x, y) - 1
    starts = _windows(tracks, size)
    if len(starts) < 8:
        return np.asarray(1 + base, np.float32), 0.0
    begin = starts[:: max(1, len(starts) // MOST_WINDOWS)]
    middle = tracks.chains.order[begin + size // (2 * STEP)]
    value, weight = _votes(light, begin * STEP, base[middle], model, search.scale, size)
    design = np.stack([np.ones(len(x)), x, y, x * y], axis=1)
    more = _robust_fit(design[middle], value - base[middle], weight, design)
    smooth = base + np.clip(more, -FIELD_RANGE, FIELD_RANGE)
    return np.asarray(1 + smooth, np.float32), _weighted_median(np.abs(value - smooth[middle]), weight)


def _weighted_median(values: NDArray[np.float64], weight: NDArray[np.float64]) -> float:
    """Of windows that hold carriers; no strong one counts for many."""
    order = np.argsort(values)
    total = np.cumsum(np.minimum(weight, quantiles(weight, 0.9)[0])[order])
    return float(values[order[min(int(np.searchsorted(total, total[-1] / 2)), len(order) - 1)]])


def _votes(
    light: Array, begin: Ints, base: NDArray[np.float64], model: PatternModel, scale: float, size: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Each window's best magnification relative to `scale`, less 1, and its weight."""
    step = 2 * FIELD_STEP
    count = 2 * round(FIELD_RANGE / step) + 1
    lowest = int(np.floor((base.min() - FIELD_RANGE) / step))
    first = (np.rint((base - FIELD_RANGE) / step) - lowest).clip(0).astype(np.int32)
    tries = (lowest + np.arange(int(first.max()) + count)) * step
    basis = _waves(tuple(float(f) for f in model.carriers), scale, lowest, len(tries), size)
    power = np.zeros((len(begin), count), np.float32)
    mean = np.zeros(len(begin), np.float32)
    _powers(light, begin, first, np.hanning(size + 2)[1:-1].astype(np.float32), basis, mean, power)
    best = power.argmax(axis=1)
    inside = (best > 0) & (best < count - 1) & (mean > 0)
    row, b = np.arange(len(best)), np.clip(best, 1, count - 2)
    left, top, right = power[row, b - 1], power[row, b], power[row, b + 1]
    curve = left - 2 * top + right
    shift = np.where(curve < 0, 0.5 * (left - right) / np.minimum(curve, -1e-12), 0.0)
    # A window counts by how far its best stands above its middle: those without carriers have none.
    middle = np.partition(power, count // 2, axis=1)[:, count // 2]
    weight = np.where(inside, top - middle, 0.0).clip(0, None)
    return tries[first + b] + np.clip(shift, -1, 1) * step, weight


@lru_cache(maxsize=16)
def _waves(carriers: tuple[float, ...], scale: float, lowest: int, count: int, size: int) -> Array:
    """Cosines, then sines, of all carriers at each trial magnification: (count, 2 N, size). Frames of a series ask for
    the same ones again and again: they are kept.
    """
    tries = (lowest + np.arange(count)) * 2 * FIELD_STEP
    t = np.arange(size) - (size - 1) / 2
    phase = 2 * np.pi * (np.asarray(carriers) / (scale * (1 + tries[:, None])))[:, :, None] * t[None, None, :]
    return np.concatenate([np.cos(phase), np.sin(phase)], axis=1).astype(np.float32)


@summing_kernel
def _powers(light: Array, starts: Ints, first: Ints, window: Array, basis: Array, mean: Array, power: Array) -> None:
    """Power on all carriers over squared brightness, for each window and each trial magnification."""
    waves, size = basis.shape[1], basis.shape[2]
    piece = np.empty(size, np.float32)
    total = np.float32(0)
    for q in range(size):
        total += window[q]
    for n in range(len(starts)):
        level = np.float32(0)
        for q in range(size):
            level += window[q] * light[starts[n] + q]
        level /= total
        mean[n] = level
        for q in range(size):
            piece[q] = (light[starts[n] + q] - level) * window[q]
        for j in range(power.shape[1]):
            for w in range(waves):
                wave = basis[first[n] + j, w]
                dot = np.float32(0)
                for q in range(size):
                    dot += piece[q] * wave[q]
                power[n, j] += dot * dot
            power[n, j] /= max(level * level, np.float32(1e-6))


def _robust_fit(design: Any, value: Any, weight: Any, everywhere: Any) -> NDArray[np.float64]:
    """Weighted least squares with Cauchy weights, four rounds; evaluated on the rows of `everywhere`."""
    w = np.minimum(weight, quantiles(weight, 0.9)[0]) + 1e-12
    spread = FIELD_RANGE / 2
    ridge = np.diag([1e-9, 1e-3, 1e-3, 1e-2]) * w.sum()
    centre = float(np.average(value, weights=w))
    solution = np.zeros(4)
    v = value - centre
    for _ in range(5):
        residual = v - design @ solution
        c = w / (1 + (residual / spread) ** 2)
        solution = np.linalg.solve(design.T @ (c[:, None] * design) + ridge, design.T @ (c * v))
        left = v - design @ solution
        spread = max(float(np.sqrt(c @ (left * left) / c.sum())), FIELD_STEP)
    return np.asarray(centre + everywhere @ solution)
