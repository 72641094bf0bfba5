"""Brightness along each chain, and the carriers found in it.

The projected carriers are the prior: all of them are magnified alike, so one number, camera pixels per projector
pixel along the stripes, places them all (where the dissertation searches each by analysis-by-synthesis, 4.3, and
takes one band's lobes for two carriers). The magnification varies by some per cent over the image, on a convergent
rig by keystone and with depth; a field linear in x, y and x y follows it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from scanner.decode.mcp.linking import Chains
from scanner.decode.mcp.model import PatternModel
from scanner.decode.mcp.stripes import STEP, Image, Peaks
from scanner.kernel import kernel, summing_kernel

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

SCALE_RANGE = 2.2
"""The magnification along the stripes lies within this factor of the one across them, known from the pitch: a surface
seen at 60 degrees, or projector pixels twice as wide as high."""

FIELD_RANGE = 0.07
"""Magnifications searched locally, relative to the mean: keystone makes 2.7 % (mcp.md, Pitfalls), depth as much."""

FIELD_STEP = 0.005
"""Steps of the tables of emissions: .05 cycles at the end of a window of 20 periods."""


@dataclass(frozen=True, eq=False)
class Signals:
    """light: (4 P,) float32, brightness above the valleys along each chain, four samples to a peak, in chain order.
    clipped: (P,) float32, share of clipped pixels about each peak.
    """

    light: Array
    clipped: Array


def signals_along(image: Image, peaks: Peaks, chains: Chains, pitch: float, limit: int) -> Signals:
    """Image brightness along the chains, above the valleys.

    Args:
        image: (H, W) as captured.
        peaks: P peaks.
        chains: their chains.
        pitch: px. Rows within a sixth of it are averaged.
        limit: largest grey level: pixels at it are clipped.
    """
    light = np.empty(STEP * len(peaks), np.float32)
    clipped = np.zeros(len(peaks), np.float32)
    reach = max(1, round(pitch / 6))
    _signals(image, peaks.y, peaks.valley, chains.order, chains.start, chains.column, reach, limit, light, clipped)
    return Signals(light, clipped)


@kernel
def _signals(
    image: Image,
    y: Array,
    valley: Array,
    order: Ints,
    start: Ints,
    column: Ints,
    reach: int,
    limit: int,
    light: Array,
    clipped: Array,
) -> None:
    height = image.shape[0]
    for c in range(len(start) - 1):
        first, last = start[c], start[c + 1] - 1
        for p in range(first, last + 1):
            k = order[p]
            before = order[max(p - 1, first)]
            after = order[min(p + 1, last)]
            for j in range(4):
                # x = 4 b + j lies (j - 1.5) / 4 of a column from the peak's own x = 4 b + 1.5.
                t = np.float32((j - 1.5) / 4)
                other = before if t < 0 else after
                t = abs(t)
                row = int(np.floor(y[k] + (y[other] - y[k]) * t + 0.5))
                base = valley[k] + (valley[other] - valley[k]) * t
                x = 4 * column[k] + j
                a, b = max(row - reach, 0), min(row + reach, height - 1)
                total = np.float32(0)
                high = 0
                for r in range(a, b + 1):
                    value = image[r, x]
                    total += np.float32(value)
                    high += 1 if value >= limit else 0
                light[4 * p + j] = total / np.float32(b - a + 1) - base
                clipped[k] += np.float32(high) / np.float32(4 * (b - a + 1))


@dataclass(frozen=True)
class CarrierSearch:
    """scale: camera px per projector px along the stripes. contrast: (N,) each carrier's amplitude over what lies
    between the carriers.
    """

    scale: float
    contrast: tuple[float, ...]


def search_carriers(signals: Signals, chains: Chains, model: PatternModel, around: float) -> CarrierSearch:
    """Find the magnification at which all carriers stand out of the chains' spectrum.

    Args:
        signals: P peaks' brightness.
        chains: their chains.
        model: the pattern's tables.
        around: magnification expected, from the pitch.
    """
    # Long enough to part the two nearest carriers at the largest magnification's period.
    size = int(np.clip(2 ** np.ceil(np.log2(2.0 * around / model.separation)), 64, 1024))
    spectrum = _mean_spectrum(signals.light, chains, size)
    if spectrum is None:
        return CarrierSearch(around, (0.0,) * model.channels)
    frequency = np.arange(len(spectrum)) / (2 * (len(spectrum) - 1))
    scales = around * np.exp(np.arange(-np.log(SCALE_RANGE), np.log(SCALE_RANGE), 0.004))
    ordered = np.sort(model.carriers)
    between = np.concatenate(
        ([ordered[0] - model.separation / 2], (ordered[1:] + ordered[:-1]) / 2, [ordered[-1] + model.separation / 2])
    )
    # Beyond .45 cycles a pixel neither columns of four pixels nor a blurred lens show a carrier.
    scales = scales[ordered[-1] / scales <= 0.45]
    if not len(scales):
        return CarrierSearch(around, (0.0,) * model.channels)
    on = np.interp(model.carriers[None, :] / scales[:, None], frequency, spectrum)
    off = np.interp(between[None, :] / scales[:, None], frequency, spectrum)
    # Each carrier against its own two neighbours: a slope of the background favours none.
    rank = np.argsort(np.argsort(model.carriers))
    ratio = on / np.maximum(np.sqrt(off[:, rank] * off[:, rank + 1]), 1e-9)
    logs = np.log(np.maximum(ratio, 0.1))
    best = int(np.argmax(logs.clip(-1, 1.5).sum(axis=1) + 0.5 * logs.min(axis=1)))
    return CarrierSearch(float(scales[best]), tuple(float(r) for r in ratio[best]))


def _mean_spectrum(light: Array, chains: Chains, size: int) -> NDArray[np.float64] | None:
    """Mean amplitude spectrum of Hann windows of `size` samples along the chains, relative to their brightness."""
    window = np.hanning(size).astype(np.float32)
    starts: list[int] = []
    lengths: list[int] = []
    for first, last in zip(chains.start[:-1] * STEP, chains.start[1:] * STEP, strict=True):
        if last - first >= size:
            starts.extend(range(first, last - size + 1, size // 2))
        elif last - first >= size // 3:
            starts.append(first)
        lengths.extend([min(last - first, size)] * (len(starts) - len(lengths)))
    if not starts:
        return None
    thin = max(1, len(starts) // 256)  # enough for a mean
    begin, length = np.asarray(starts)[::thin], np.asarray(lengths)[::thin]
    sample = np.arange(size)
    present = sample[None, :] < length[:, None]
    block = np.where(present, light[np.minimum(begin[:, None] + sample[None, :], len(light) - 1)], np.float32(0))
    weight = present * window
    mean = (block * weight).sum(axis=1, keepdims=True) / np.maximum(weight.sum(axis=1, keepdims=True), 1e-6)
    block = (block - mean) * weight
    # Dark pieces weigh by their own spread, or a valley's noise outweighs stripes.
    spread = np.sqrt((block**2).sum(axis=1, keepdims=True) / (window**2).sum())
    block /= np.maximum(np.maximum(np.abs(mean), spread), 1e-6)
    amplitude = np.abs(rfft(block.astype(np.float32), 2 * size, axis=1))
    return np.asarray(np.sqrt((amplitude**2).mean(axis=0)), np.float64)


def window_px(model: PatternModel, scale: float) -> int:
    """Samples of an emission's window: 1.5 beats of the two nearest carriers, a multiple of four.

    A Hann window of that length parts them by least squares with a tenth of the noise lost.
    """
    beat = scale / model.separation
    return int(STEP * np.clip(np.ceil(1.5 * beat / STEP), 6, 128))


def fit_field(
    light: Array, peaks: Peaks, chains: Chains, model: PatternModel, scale: float, size: int, shape: tuple[int, int]
) -> Array:
    """The magnification at each peak, from a robust fit of 1, x, y, x y to the windows' own best ones.

    Args:
        light: (4 P,) float32.
        peaks, chains, model: as elsewhere.
        scale: mean magnification.
        size: window, samples.
        shape: (H, W) px.

    Returns:
        (P,) float32: magnification relative to `scale`.
    """
    trial = np.arange(-FIELD_RANGE, FIELD_RANGE + 1e-9, 2 * FIELD_STEP)
    t = np.arange(size) - (size - 1) / 2
    window = np.hanning(size + 2)[1:-1]
    starts, middles = [], []
    for first, last in zip(chains.start[:-1], chains.start[1:], strict=True):
        for a in range(int(first), int(last) - size // STEP + 1, max(1, size // (2 * STEP))):
            starts.append(a)
            middles.append(a + size // (2 * STEP))
    if len(starts) < 8:
        return np.ones(len(peaks), np.float32)
    basis = np.empty((len(trial), 2 * model.channels, size), np.float32)
    for j, delta in enumerate(trial):
        phase = 2 * np.pi * t[None, :] * (model.carriers / (scale * (1 + delta)))[:, None]
        basis[j, : model.channels], basis[j, model.channels :] = np.cos(phase), np.sin(phase)
    power = np.zeros((len(starts), len(trial)), np.float32)
    mean = np.zeros(len(starts), np.float32)
    _powers(light, np.asarray(starts, np.int32) * STEP, window.astype(np.float32), basis, mean, power)
    best = power.argmax(axis=1)
    inside = (best > 0) & (best < len(trial) - 1) & (mean > 0)
    row = np.arange(len(best))
    b = np.clip(best, 1, len(trial) - 2)
    left, top, right = power[row, b - 1], power[row, b], power[row, b + 1]
    curve = left - 2 * top + right
    shift = np.where(curve < 0, 0.5 * (left - right) / np.minimum(curve, -1e-12), 0.0)
    value = trial[b] + np.clip(shift, -1, 1) * 2 * FIELD_STEP
    # A window counts by how far its best stands above its middle: those without carriers have none.
    weight = np.where(inside, top - np.median(power, axis=1), 0.0).clip(0, None)
    at = chains.order[np.asarray(middles)]
    height, width = shape
    x, y = chains.column * (2.0 * STEP / width) - 1, peaks.y * (2.0 / height) - 1
    design = np.stack([np.ones(len(x)), x, y, x * y], axis=1)
    field = _robust_fit(design[at], value, weight, design)
    return np.asarray(1 + np.clip(field, -FIELD_RANGE, FIELD_RANGE), np.float32)


@summing_kernel
def _powers(light: Array, starts: Ints, window: Array, basis: Array, mean: Array, power: Array) -> None:
    """Power on all carriers over squared brightness, for each window and each trial magnification."""
    trials, waves, size = basis.shape
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
        for j in range(trials):
            for w in range(waves):
                wave = basis[j, w]
                dot = np.float32(0)
                for q in range(size):
                    dot += piece[q] * wave[q]
                power[n, j] += dot * dot
            power[n, j] /= max(level * level, np.float32(1e-6))


def _robust_fit(design: Any, value: Any, weight: Any, everywhere: Any) -> NDArray[np.float64]:
    """Weighted least squares with Cauchy weights, four rounds; evaluated on the rows of `everywhere`."""
    w = np.minimum(weight, np.percentile(weight, 90)) + 1e-12
    spread = FIELD_RANGE / 2
    ridge = np.diag([1e-9, 1e-3, 1e-3, 1e-2]) * w.sum()
    centre = float(np.average(value, weights=w))
    solution = np.zeros(4)
    v = value - centre
    for _ in range(5):
        residual = v - design @ solution
        c = w / (1 + (residual / spread) ** 2)
        solution = np.linalg.solve(design.T @ (c[:, None] * design) + ridge, design.T @ (c * v))
        spread = max(float(np.sqrt(np.average((v - design @ solution) ** 2, weights=c))), FIELD_STEP)
    return np.asarray(centre + everywhere @ solution)
