"""Soft emissions: how well each stripe's code explains the carriers seen at a peak (mcp.md, section 3.1).

Where the dissertation thresholds each channel (4.5) and multiplies error rates (5.2, eq. 6.6), the amplitude of each
carrier over the local brightness is compared with what each stripe would show, given how much of it lens and focus
leave. Mean, slope and all carriers are fitted at once by weighted least squares in a window along the chain; the
fit's residual says how far its amplitudes can be trusted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp.exponentials import exp_of, log_of
from scanner.decode.mcp.fits import FIELD_STEP, Along, Fitted, fit
from scanner.decode.mcp.model import PatternModel
from scanner.decode.mcp.ranks import median, quantiles
from scanner.decode.mcp.stripes import STEP
from scanner.decode.mcp.tracks import Tracks
from scanner.kernel import contracting_kernel, kernel

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

MODULATION_FLOOR = 0.15
"""Share of a carrier's amplitude below which it is taken for lost: a dark frame must not latch on to noise."""

MODULATION_TOP = 1.6
"""Above 1 where blur lifts the valleys beside dim stripes, so that their brightness is underrated; not more."""

SPREAD = 0.22
"""Relative spread of a carrier's amplitude over a scene: focus, gloss and albedo within the window. True on the
reference scenes: .01 to .13 with equally bright stripes, .05 to .27 with the published pattern. The widest counts: sure
peaks, by which a scan could tell its own, are those that spread little, and with what they tell two thirds more peaks
are wrong (bench/mcp_hmm.py, decisions/0014)."""

SHORT_POWER = 1.5
"""A chain shorter than the window leaves the fit few degrees of freedom, and what is not white (texture, shading) hides
in the carriers instead of the residual: sigma grows by this power of window over length."""

NOTHING_SEEN = np.float32(10)
"""Sigma of an amplitude that was not measured: wider than anything a carrier can do."""

OUTLIER = 0.01
"""Probability that an amplitude says nothing. It bounds what one channel can say to a factor of a hundred. True: of
carriers that are on 0 to .06 lie beyond three sigmas, of those off 0 to .04; a quarter to four times it moves right by
.0002 and recall by .002."""


@dataclass(frozen=True, eq=False)
class Waves:
    """parts: (P, 2 N) float32, each carrier's cosine and sine about the window's middle, over brightness. x, y, length:
    (P,) float32 px, that middle, and how long the window is.
    """

    parts: Array
    x: Array
    y: Array
    length: Array


@dataclass(frozen=True, eq=False)
class Amplitudes:
    """ratio: (P, N) float32, carrier amplitude over brightness. sigma: (P, N) float32, its noise (one component).
    light: (P,) float32, brightness above the valleys in the window; about 1 on joined tracks. waves: with their phases.
    """

    ratio: Array
    sigma: Array
    light: Array
    waves: Waves | None = None

    def at(self, index: Ints) -> Amplitudes:
        """Those of some peaks."""
        wide = index.astype(np.intp)  # NumPy takes rows by numbers of that kind in a tenth of the time
        ratio, sigma, light = (np.take(part, wide, axis=0) for part in (self.ratio, self.sigma, self.light))
        waves = self.waves and Waves(*(np.take(part, wide, axis=0) for part in vars(self.waves).values()))
        return Amplitudes(ratio, sigma, light, waves)


def measure(light: Array, tracks: Tracks, field: Array, model: PatternModel, scale: float, size: int) -> Amplitudes:
    """Carrier amplitudes at every peak.

    Args:
        light: (4 N,) float32, brightness along the tracks.
        tracks: where it was read.
        field: (N,) magnification relative to `scale` at each place.
        model: the pattern's tables.
        scale: camera px per projector px.
        size: window, samples, a multiple of four; twice that on joined tracks, where lines of the print stand between
            the carriers. Shorter tracks are fitted whole.

    Returns:
        Amplitudes in the order of the P peaks.
    """
    count, channels = len(field), model.channels
    omega = tuple(float(w) for w in 2 * np.pi * model.carriers.astype(np.float64) / scale)
    chains = tracks.chains
    of_chain = np.minimum(chains.lengths * STEP, size * (1 + tracks.joined)).astype(np.int32)
    of_peak = np.zeros(count, np.int32)  # places that a joined track passes over keep none
    of_peak[chains.order] = np.repeat(of_chain, chains.lengths)
    step = np.rint((field - 1) / FIELD_STEP).astype(np.int32)
    ratio, sigma = np.zeros((count, channels), np.float32), np.full((count, channels), NOTHING_SEEN)
    light_above, wave = np.zeros(count, np.float32), np.zeros((count, 2 * channels), np.float32)
    fitted = Fitted(ratio, sigma, light_above, wave, np.zeros(count, np.int32))
    for length in np.unique(of_chain):
        if length < 2 * STEP:
            continue  # fewer samples than unknowns say nothing
        chosen = np.flatnonzero(of_chain == length).astype(np.int32)
        windows = Along(light, chains.order, chains.start, chosen, step, max(1, int(length) // (8 * STEP)))
        # A shorter window resolves less: coarser steps do.
        fit(windows, omega, int(length), max(1, size // int(length)), max(size / length, 1) ** SHORT_POWER, fitted)
    x = (STEP * chains.column[chains.order[fitted.begin]] + (of_peak - 1) / 2).astype(np.float32)
    y = tracks.y[chains.order[np.minimum(fitted.begin + of_peak // (2 * STEP), len(chains.order) - 1)]]
    seen = Amplitudes(ratio, sigma, light_above, Waves(wave, x, y, of_peak.astype(np.float32)))
    return seen.at(tracks.place) if tracks.joined.any() else seen


def first_modulation(seen: Amplitudes, model: PatternModel) -> Array:
    """Each channel's modulation (share of the projected amplitude that the image shows) before anything is decoded.

    The share of peaks that carry channel i is known from the pattern; so the same quantile of all ratios seen is
    compared with the pattern's own. (N,) float32, floored.
    """
    ratio = seen.ratio[seen.light > 0].T
    result = np.ones(model.channels, np.float32)
    for i, (share, expected) in enumerate(model.usual):
        if share > 0 and ratio.size:
            result[i] = quantiles(ratio[i], share)[0] / max(expected, 1e-6)
    return np.clip(result, MODULATION_FLOOR, MODULATION_TOP)


def refined_modulation(seen: Amplitudes, model: PatternModel, posterior: Array, previous: Array) -> tuple[Array, Array]:
    """Modulation (N,) and noise floor (N,) of each channel, re-estimated from what the peaks were decoded as.

    Args:
        seen: the amplitudes.
        model: the pattern's tables.
        posterior: (P, S) probabilities.
        previous: (N,) modulation so far; kept for channels that no peak carries.
    """
    modulation = previous.copy()
    floor = np.full(model.channels, 0.02, np.float32)
    sums, off, count = (
        np.zeros((2, model.channels)),
        np.empty(seen.ratio.T.shape, np.float32),
        np.zeros(model.channels, int),
    )
    _carried(posterior, model.ratio, seen.ratio, sums, off, count)
    for i in range(model.channels):
        # Where carried for certain, the expected ratio is the pattern's own: least squares through the origin.
        square, product = (float(part) for part in sums[:, i])
        if square > 1e-3 * len(posterior) * float(model.amplitudes[i][-1]) ** 2:
            modulation[i] = min(max(product / square, MODULATION_FLOOR), MODULATION_TOP)
        if count[i] > 10:
            # Rayleigh: the median is 1.177 sigma. What texture adds here and there is in each fit's own residual.
            floor[i] = min(max(median(off[i, : count[i]]) / 1.177, 0.008), 0.1)
    return modulation, floor


@kernel
def _carried(
    posterior: Array, own: Array, seen: Array, sums: NDArray[np.float64], off: Array, count: NDArray[np.int64]
) -> None:
    """Of each channel: sums of expected x expected and expected x seen, and what is seen where it is switched off."""
    peaks, states = posterior.shape
    channels = own.shape[1]
    expected, on = np.empty(channels, np.float32), np.empty(channels, np.float32)
    for k in range(peaks):
        expected[:] = 0
        on[:] = 0
        for s in range(states):
            share = posterior[k, s]
            if share > np.float32(1e-4):  # most states have no share worth the sum
                for i in range(channels):
                    expected[i] += share * own[s, i]
                    on[i] += share if own[s, i] > 0 else np.float32(0)
        for i in range(channels):
            sums[0, i] += expected[i] * expected[i]
            sums[1, i] += expected[i] * seen[k, i]
            if on[i] < np.float32(0.1):
                off[i, count[i]] = seen[k, i]
                count[i] += 1


def log_likelihood(seen: Amplitudes, model: PatternModel, modulation: Array, floor: Array) -> tuple[Array, Array]:
    """Log-likelihood of every stripe at every peak, (P, S) float32, and of no stripe at all, (P,) float32.

    Switched off, an amplitude is Rayleigh distributed; on, Gaussian about what is expected (Rice 1945, for amplitudes
    well above the noise); either is mixed with a flat density of weight OUTLIER.
    """
    count = len(seen.light)
    stray = np.zeros(count, np.float32)
    logs = np.empty((len(model.shows), count), np.float32)
    n = 0
    for i, own in enumerate(model.amplitudes):
        ratio, noise = np.ascontiguousarray(seen.ratio[:, i]), np.ascontiguousarray(seen.sigma[:, i])
        # Anything from nothing to half as much again as the strongest, and the noise on top.
        widest = np.float32(max(1.5 * own[-1], 1e-3))
        _of_nothing(noise, floor[i], widest, stray)
        for value in own:
            if value == 0:
                _switched_off(ratio, noise, floor[i], widest, logs[n])
            else:
                _switched_on(ratio, noise, floor[i], widest, np.float32(value * modulation[i]), logs[n])
            n += 1
    result = np.empty((count, model.stripes), np.float32)
    _add(logs, model.shows, result)
    dark = model.level == 0
    if dark.any():
        # A stripe without light has no peak: only a stray one could be taken for it.
        result[:, dark] += np.float32(np.log(1e-4))
    return result, stray


@contracting_kernel
def _of_nothing(noise: Array, floor: np.float32, widest: np.float32, stray: Array) -> None:
    """Adds the logarithm of the flat density."""
    for k in range(len(noise)):
        sigma = np.sqrt(noise[k] * noise[k] + floor * floor)
        stray[k] -= log_of(widest + np.float32(2.5) * sigma)


@contracting_kernel
def _switched_off(ratio: Array, noise: Array, floor: np.float32, widest: np.float32, logs: Array) -> None:
    for k in range(len(ratio)):
        sigma = np.sqrt(noise[k] * noise[k] + floor * floor)
        flat = np.float32(1) / (widest + np.float32(2.5) * sigma)
        inverse = np.float32(1) / sigma
        z = ratio[k] * inverse
        density = max(z, np.float32(0.02)) * inverse * exp_of(np.float32(-0.5) * z * z)
        logs[k] = log_of(np.float32(1 - OUTLIER) * density + np.float32(OUTLIER) * flat)


@contracting_kernel
def _switched_on(
    ratio: Array, noise: Array, floor: np.float32, widest: np.float32, mean: np.float32, logs: Array
) -> None:
    for k in range(len(ratio)):
        square = noise[k] * noise[k] + floor * floor
        flat = np.float32(1) / (widest + np.float32(2.5) * np.sqrt(square))
        inverse = np.float32(1) / np.sqrt(square + np.float32(SPREAD * SPREAD) * mean * mean)
        z = (np.sqrt(mean * mean + square) - ratio[k]) * inverse
        density = np.float32(0.39894) * inverse * exp_of(np.float32(-0.5) * z * z)
        logs[k] = log_of(np.float32(1 - OUTLIER) * density + np.float32(OUTLIER) * flat)


@contracting_kernel
def _add(logs: Array, those: Array, result: Array) -> None:
    """result[k, s] = the sum of logs[n, k] over the n whose those[n, s] is 1, not 0."""
    for k in range(result.shape[0]):
        for s in range(result.shape[1]):
            result[k, s] = logs[0, k] * those[0, s]
        for n in range(1, len(logs)):
            for s in range(result.shape[1]):
                result[k, s] += logs[n, k] * those[n, s]
