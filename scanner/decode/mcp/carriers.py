"""The carriers found in the brightness along the chains.

The projected carriers are the prior: all of them are magnified alike, so one number, camera pixels per projector
pixel along the stripes, places them all (where Casey 2011, sec. 4.3, searches each by analysis-by-synthesis, and
takes one band's lobes for two carriers). That number drifts over the image, by some per cent with the projector above
the camera and by a tenth to either side with it beside: spectra are taken in tiles, and the drift is searched too.
`magnification` follows it closer.
Spectra are means over short windowed pieces (Welch 1967); where pieces are too short for spectra, the carriers are
fitted to them with the amplitudes eliminated (variable projection, Golub and Pereyra 1973).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from scanner.decode.mcp.linking import Chains
from scanner.decode.mcp.model import PatternModel
from scanner.decode.mcp.signals import Signals
from scanner.decode.mcp.stripes import STEP
from scanner.decode.mcp.tracks import Tracks
from scanner.kernel import kernel

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

SCALE_RANGE = 2.2
"""The magnification along the stripes lies within this factor of the one across them, known from the pitch: a surface
seen at 60 degrees, or projector pixels twice as wide as high."""

DRIFTS = np.arange(-0.3, 0.301, 0.06)
FINER_DRIFTS = np.arange(-0.04, 0.041, 0.02)
"""Drifts searched, from the image's middle to its border, natural logarithms, across the stripes and along them; then
about the best of these. A projector at 15 degrees to the camera drifts by .1 over 20 degrees of view across the
stripes; one that stands diagonally, before a lens of 60 degrees and a surface tilted by 30, by .2 along them."""

TILES_Y, TILES_X = 6, 4
"""Tiles of the search: within one the drift must not reach the distance of two carriers, a tenth."""

ENOUGH_PIECES = 16
"""Long pieces of stripe that suffice for the search: half a pattern's worth."""

SHORT_STEP = 5
"""The same times this for short chains, over which two such sets of carriers part by a tenth of a cycle."""

LEAST_LINE = 0.1
"""Share of a spectrum's strongest line that is no line: its skirts fall to that within the window's lobe, and where
nothing lies between the carriers they would seem to stand out of it."""

LOG_STEP = 0.004
"""Steps of the magnification: a quarter of a bin at the highest carrier."""


@dataclass(frozen=True)
class CarrierSearch:
    """scale: camera px per projector px along the stripes, in the image's middle; drift_x, drift_y: its change to the
    image's border, natural logarithm. contrast: (N,) each carrier's amplitude over what lies between the carriers.
    """

    scale: float
    drift_x: float
    drift_y: float
    contrast: tuple[float, ...]
    aspect: float = 1.0
    """by which the projector's pixels were taken to be larger along the stripes than across, see `locate.ASPECTS`"""

    def relative(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
        """Magnification over `scale` at places -1 .. 1 across the image."""
        return np.asarray(np.exp(self.drift_x * x + self.drift_y * y))


def places(tracks: Tracks, shape: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where the tracks' places lie in an image of `shape` (H, W): x and y from -1 to 1."""
    x = tracks.chains.column.astype(np.float64) * (2.0 * STEP / shape[1]) - 1
    return x, tracks.y.astype(np.float64) * (2.0 / shape[0]) - 1


def are_short(chains: Chains, model: PatternModel, around: float) -> bool:
    """Whether hardly any chain is two beats of the two nearest carriers long, so that spectra do not part them.

    Args:
        chains: the chains.
        model: the pattern's tables.
        around: magnification expected.
    """
    return bool((chains.lengths * (1.5 * STEP) >= _window_px(model, around)).sum() < ENOUGH_PIECES)


def _window_px(model: PatternModel, around: float) -> int:
    """Three beats of the two nearest carriers: what lies between is then outside a Hann window's lobes of both."""
    return STEP * round(float(np.clip(3 * around / model.separation, 64, 1024)) / STEP)


def search_carriers(
    signals: Signals, tracks: Tracks, model: PatternModel, around: float, shape: tuple[int, int]
) -> CarrierSearch:
    """Find the magnification, and its drift, at which all carriers stand out of the chains' spectra.

    Args:
        signals: brightness along the tracks.
        tracks: where it was read.
        model: the pattern's tables.
        around: magnification expected, from the pitch.
        shape: (H, W) of the image.
    """
    size, chains = _window_px(model, around), tracks.chains
    steps = np.arange(-np.log(SCALE_RANGE), np.log(SCALE_RANGE), LOG_STEP)
    scales = around * np.exp(steps)
    # Beyond .45 cycles a pixel neither columns of four pixels nor a blurred lens show a carrier.
    scales = scales[float(model.carriers.max()) / scales <= 0.45]
    if len(scales) >= 2 and are_short(chains, model, around):
        return _by_least_squares(signals.light, chains, model, scales[::SHORT_STEP], around, size)
    power, middle = _spectra(signals.light, chains, size)
    if not len(power) or len(scales) < 2:
        return CarrierSearch(around, 0.0, 0.0, (0.0,) * model.channels)
    x, y = (place[middle] for place in places(tracks, shape))
    column = np.clip(((x + 1) * (TILES_X / 2)).astype(int), 0, TILES_X - 1)
    tile = np.clip(((y + 1) * (TILES_Y / 2)).astype(int), 0, TILES_Y - 1) * TILES_X + column
    logs, weights, at = [], [], []
    for t in np.unique(tile):
        inside = tile == t
        logs.append(_contrasts(np.sqrt(power[inside].mean(axis=0)), scales, model))
        weights.append(np.sqrt(inside.sum()))
        at.append((x[inside].mean(), y[inside].mean()))
    return _align(np.stack(logs), np.asarray(weights), np.asarray(at), scales, around)


def _contrasts(spectrum: NDArray[np.float64], scales: NDArray[np.float64], model: PatternModel) -> NDArray[np.float64]:
    """Logarithm of each carrier's amplitude over what lies to its two sides, at each magnification: (Q, N)."""
    frequency = np.arange(len(spectrum)) / (2 * (len(spectrum) - 1))
    ordered = np.sort(model.carriers)
    half = model.separation / 2
    between = np.concatenate(([ordered[0] - half], (ordered[1:] + ordered[:-1]) / 2, [ordered[-1] + half]))
    on = np.interp(model.carriers[None, :] / scales[:, None], frequency, spectrum)
    off = np.interp(between[None, :] / scales[:, None], frequency, spectrum)
    # Each carrier against its own two neighbours: a slope of the background favours none.
    rank = np.argsort(np.argsort(model.carriers))
    ground = np.sqrt(off[:, rank] * off[:, rank + 1])
    least = LEAST_LINE * float(spectrum.max()) + 1e-9
    return np.asarray(np.log((on + least) / (ground + least)))


def _align(
    logs: NDArray[np.float64],
    weights: NDArray[np.float64],
    at: NDArray[np.float64],
    scales: NDArray[np.float64],
    around: float,
) -> CarrierSearch:
    """The magnification and drifts at which the tiles' contrasts (T, Q, N) agree best."""
    # One line of texture must not stand for a set of carriers: none counts for more than a factor of three.
    score = np.ascontiguousarray(logs.clip(0, np.log(3)) * weights[:, None, None])
    # Short chains resolve little: between like scores the one nearest to what the pitch says.
    doubt = 4 * weights.sum() * np.log(scales / around) ** 2
    best = (-np.inf, 0, 0.0, 0.0)
    each = np.empty((len(scales), logs.shape[2]))
    for steps in (DRIFTS, FINER_DRIFTS):
        _, _, middle_x, middle_y = best
        for drift_y in middle_y + steps:
            for drift_x in middle_x + steps:
                shift = np.rint((at[:, 0] * drift_x + at[:, 1] * drift_y) / LOG_STEP).astype(np.int32)
                _shifted_sum(score, shift, each)
                # A tile's few stripes may lack a carrier, the image none: another set's lines fit some of ours only.
                total = each.sum(axis=1) + each.shape[1] * each.min(axis=1)
                # Without need no drift: a hundredth of the score for each tenth.
                total = total - doubt - 0.1 * (abs(drift_x) + abs(drift_y)) * np.abs(total)
                q = int(np.argmax(total))
                if total[q] > best[0]:
                    best = (float(total[q]), q, float(drift_x), float(drift_y))
    _, q, drift_x, drift_y = best
    own = np.clip(q + np.rint((at[:, 0] * drift_x + at[:, 1] * drift_y) / LOG_STEP).astype(int), 0, len(scales) - 1)
    seen = np.average(logs[np.arange(len(at)), own], axis=0, weights=weights)
    return CarrierSearch(float(scales[q]), drift_x, drift_y, tuple(float(c) for c in np.exp(seen)))


def warm_up() -> None:
    """Compile what only images with long stripes come to."""
    _shifted_sum(np.zeros((1, 2, 1)), np.zeros(1, np.int32), np.zeros((2, 1)))


@kernel
def _shifted_sum(score: NDArray[np.float64], shift: Ints, total: NDArray[np.float64]) -> None:
    """Sum over the tiles of `score` (T, Q, N), each moved by its own `shift` along Q; (Q, N)."""
    tiles, size, channels = score.shape
    total[:] = 0
    for t in range(tiles):
        for q in range(size):
            moved = min(max(q + shift[t], 0), size - 1)
            for i in range(channels):
                total[q, i] += score[t, moved, i]


def _by_least_squares(
    light: Array, chains: Chains, model: PatternModel, scales: NDArray[np.float64], around: float, size: int
) -> CarrierSearch:
    """The magnification at which ground and carriers, fitted to each short chain, leave least of it.

    Carriers that lie nearer than a chain resolves are no lines in its spectrum, but of the right set of frequencies all
    chains are made up. Where any set fits (fewer samples than three for each unknown) nothing is said.
    """
    sets = model.carriers[None, :] / scales[:, None]
    left = _left_by(light, chains, sets, size)
    if not left.any():
        return CarrierSearch(around, 0.0, 0.0, (0.0,) * model.channels)
    # Between like remainders the magnification nearest to what the pitch says.
    best = int(np.argmin(left / np.median(left) + 0.5 * np.log(scales / around) ** 2))
    # One wave that is all there is lies on one carrier of many a set: what it leaves alone, the set must better.
    step = LOG_STEP * SHORT_STEP
    single = np.exp(np.arange(np.log(sets.min()), np.log(sets.max()) + step, step))
    alone = _left_by(light, chains, single[:, None], size, model.channels)
    contrast = min(float(np.median(left)), float(alone.min())) / float(left[best])
    return CarrierSearch(float(scales[best]), 0.0, 0.0, (contrast,) * model.channels)


def _left_by(
    light: Array, chains: Chains, sets: NDArray[np.float64], size: int, channels: int | None = None
) -> NDArray[np.float64]:
    """Energy that ground and waves leave of all pieces, for each set of waves.

    Args:
        light: along the tracks.
        chains: the chains.
        sets: (Q, N) cycles per px.
        size: most samples of a piece.
        channels: pieces are as long as so many waves ask for; by default N.
    """
    unknowns = 3 + 2 * (sets.shape[1] if channels is None else channels)
    lengths = np.minimum(chains.lengths * STEP, size)
    left = np.zeros(len(sets))
    for length in np.unique(lengths[lengths >= 3 * unknowns]):
        begin = STEP * chains.start[:-1][lengths == length]
        pieces = light[begin[:, None] + np.arange(length)].astype(np.float64)
        t = np.arange(length) - (length - 1) / 2
        window = np.sqrt(np.sin(np.pi * (np.arange(length) + 0.5) / length))
        ground = np.linalg.qr(np.vander(2 * t / length, 3) * window[:, None])[0]
        pieces *= window / np.maximum(np.abs(pieces.mean(axis=1, keepdims=True)), 1e-6)
        pieces -= (pieces @ ground) @ ground.T
        for i, waves_per_px in enumerate(sets):
            phase = 2 * np.pi * t[:, None] * waves_per_px
            waves = np.concatenate([np.cos(phase), np.sin(phase)], axis=1) * window[:, None]
            waves -= ground @ (ground.T @ waves)
            axes, strength, _ = np.linalg.svd(waves, full_matrices=False)
            fitted = pieces @ axes[:, strength > 0.1 * strength[0]]
            left[i] += float((pieces**2).sum() - (fitted**2).sum())
    return left


def _spectra(light: Array, chains: Chains, size: int) -> tuple[NDArray[np.float64], Ints]:
    """Power spectra of Hann windows of `size` samples along the chains, relative to their brightness, and the peak in
    the middle of each.
    """
    window = np.hanning(size).astype(np.float32)
    starts: list[int] = []
    lengths: list[int] = []
    for first, last in zip(chains.start[:-1] * STEP, chains.start[1:] * STEP, strict=True):
        if last - first >= size:
            starts.extend(range(first, last - size + 1, size // 2))
        elif last - first >= size // 6:
            starts.append(first)
        lengths.extend([min(last - first, size)] * (len(starts) - len(lengths)))
    begin, length = np.asarray(starts, np.int64), np.asarray(lengths, np.int64)
    # Short pieces resolve little and are often texture: they count where there are hardly any others.
    long = length >= size // 3
    if long.sum() >= ENOUGH_PIECES:
        begin, length = begin[long], length[long]
    thin = max(1, len(begin) // 384)  # enough for a mean in each tile
    begin, length = begin[::thin], length[::thin]
    sample = np.arange(size)
    present = sample[None, :] < length[:, None]
    block = np.where(present, light[np.minimum(begin[:, None] + sample[None, :], len(light) - 1)], np.float32(0))
    # Pieces of short chains get a sine window of their own length: a Hann window would blur what little they resolve.
    own = np.sin(np.pi * (sample[None, :] + 0.5) / length[:, None]).astype(np.float32) * present
    weight = np.where(length[:, None] == size, window[None, :], own)
    mean = (block * weight).sum(axis=1, keepdims=True) / np.maximum(weight.sum(axis=1, keepdims=True), 1e-6)
    block = (block - mean) * weight
    # Dark pieces weigh by their own spread, or a valley's noise outweighs stripes.
    spread = np.sqrt((block**2).sum(axis=1, keepdims=True) / (window**2).sum())
    block /= np.maximum(np.maximum(np.abs(mean), spread), 1e-6)
    amplitude = np.abs(rfft(block.astype(np.float32), 2 * size, axis=1)) if len(block) else np.zeros((0, size + 1))
    return np.asarray(amplitude**2, np.float64), chains.order[(begin + length // 2) // STEP]
