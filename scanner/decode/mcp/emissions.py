"""Soft emissions: how well each stripe's code explains the carriers seen at a peak (mcp.md, section 3.1).

Where the dissertation thresholds each channel (4.5) and multiplies error rates (5.2, eq. 6.6), the amplitude of each
carrier over the local brightness is compared with what each stripe would show, given how much of it lens and focus
leave. Mean, slope and all carriers are fitted at once by weighted least squares in a window along the chain; the
fit's residual says how far its amplitudes can be trusted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp.exponentials import exp_of, log_of
from scanner.decode.mcp.magnification import FIELD_STEP
from scanner.decode.mcp.model import PatternModel
from scanner.decode.mcp.ranks import median, quantiles
from scanner.decode.mcp.stripes import STEP
from scanner.decode.mcp.tracks import Tracks
from scanner.kernel import contracting_kernel, kernel, summing_kernel

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

GROUND = 3
"""Terms of the fit that are no carrier: mean, slope and bend of the brightness in the window."""

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
    pick = np.rint((field - 1) / FIELD_STEP).astype(np.int32)
    ratio = np.zeros((count, channels), np.float32)
    sigma = np.full((count, channels), NOTHING_SEEN)
    bright = np.zeros(count, np.float32)
    wave, begin = np.zeros((count, 2 * channels), np.float32), np.zeros(count, np.int32)
    for length in np.unique(of_chain):
        if length < 2 * STEP:
            continue  # fewer samples than unknowns say nothing
        # A shorter window resolves less: coarser steps do.
        coarse = max(1, size // int(length))
        at = of_peak == length
        steps, index = np.unique(np.rint(pick[at] / coarse).astype(np.int32) * coarse, return_inverse=True)
        pick[at] = index
        tables = [_table(omega, int(step), int(length)) for step in steps]
        chosen = np.flatnonzero(of_chain == length).astype(np.int32)
        basis, inverse = np.stack([t[0] for t in tables]), np.stack([t[1] for t in tables])
        shortness = np.float32(max(size / length, 1) ** SHORT_POWER)
        hop = max(1, int(length) // (8 * STEP))
        links = (chains.order, chains.start, chosen, pick)
        _fit(light, *links, basis, inverse, _window(int(length)), shortness, hop, ratio, sigma, bright, wave, begin)
    x = (STEP * chains.column[chains.order[begin]] + (of_peak - 1) / 2).astype(np.float32)
    y = tracks.y[chains.order[np.minimum(begin + of_peak // (2 * STEP), len(chains.order) - 1)]]
    seen = Amplitudes(ratio, sigma, bright, Waves(wave, x, y, of_peak.astype(np.float32)))
    return seen.at(tracks.place) if tracks.joined.any() else seen


@lru_cache(maxsize=256)
def _window(size: int) -> Array:
    """Hann weights with a foot, so that the ends hold the slope."""
    return (0.02 + 0.98 * np.hanning(size + 2)[1:-1]).astype(np.float32)


@lru_cache(maxsize=4096)
def _table(omega: tuple[float, ...], step: int, size: int) -> tuple[Array, Array]:
    """Weighted basis (size, Q padded to eights) and inverse normal matrix (Q, Q) for one magnification.

    Q = GROUND + 2 N: mean, slope and bend, then cosine and sine of each carrier, about the window's middle. A ridge of
    1e-3 keeps carriers that a short chain cannot tell apart finite; their sigma is then large. Frames of a series ask
    for the same tables again and again: they are kept.
    """
    t = np.arange(size) - (size - 1) / 2
    window = _window(size).astype(np.float64)
    phase = t[:, None] * (np.asarray(omega) / (1 + step * FIELD_STEP))[None, :]
    ground = np.vander(2 * t / size, GROUND, increasing=True)
    design = np.concatenate([ground, np.stack([np.cos(phase), np.sin(phase)], 2).reshape(size, -1)], axis=1)
    weighted = window[:, None] * design
    ridge = np.full(design.shape[1], 1e-3 * window.sum())
    ridge[0] = 0
    inverse = np.linalg.inv(design.T @ weighted + np.diag(ridge))
    padded = np.pad(weighted, ((0, 0), (0, -design.shape[1] % 8)))
    return padded.astype(np.float32), inverse.astype(np.float32)


@summing_kernel
def _fit(
    light: Array,
    order: Ints,
    start: Ints,
    chosen: Ints,
    pick: Ints,
    basis: Array,
    inverse: Array,
    window: Array,
    shortness: np.float32,
    hop: int,
    ratio: Array,
    sigma: Array,
    bright: Array,
    wave: Array,
    middle: Ints,
) -> None:
    unknowns, size, padded = inverse.shape[1], basis.shape[1], basis.shape[2]
    channels = (unknowns - GROUND) // 2
    sums = np.empty((4, padded), np.float32)
    right = np.empty(padded, np.float32)
    fitted = np.empty(unknowns, np.float32)
    total_weight = np.float32(0)
    for q in range(size):
        total_weight += window[q]
    # Effective number of samples: neighbours within the lens's blur are not independent, which the floor covers.
    free = max(np.float32(1), total_weight - np.float32(unknowns) * total_weight / np.float32(size))
    half = size // 8
    for n in range(len(chosen)):
        first, last = start[chosen[n]], start[chosen[n] + 1]
        previous = -1
        for p in range(first, last):
            k = order[p]
            begin = min(max(p - half, first), last - size // 4)
            if begin == previous or (p - first) % hop:  # the window stands still at a chain's ends
                j = order[p - 1]
                for i in range(channels):
                    ratio[k, i] = ratio[j, i]
                    sigma[k, i] = sigma[j, i]
                for u in range(2 * channels):
                    wave[k, u] = wave[j, u]
                bright[k] = bright[j]
                middle[k] = middle[j]
                continue
            previous = begin
            m = pick[k]
            explained = np.float32(0)
            energy = _project(light, 4 * begin, basis, m, window, sums, right)
            for u in range(unknowns):
                dot = np.float32(0)
                for v in range(unknowns):
                    dot += inverse[m, u, v] * right[v]
                fitted[u] = dot
                explained += dot * right[u]
            # The bend's mean over a Hann window, (1 / 3 - 2 / pi^2) of its value at the ends.
            mean = fitted[0] + np.float32(0.1307) * fitted[2]
            bright[k] = mean
            middle[k] = begin
            if mean <= 0:
                continue
            variance = max(energy - explained, np.float32(0)) / free
            for i in range(channels):
                c = GROUND + 2 * i
                a, b = fitted[c], fitted[c + 1]
                ratio[k, i] = np.sqrt(a * a + b * b) / mean
                wave[k, 2 * i], wave[k, 2 * i + 1] = a / mean, b / mean
                spread = np.float32(0.5) * (inverse[m, c, c] + inverse[m, c + 1, c + 1])
                sigma[k, i] = np.sqrt(variance * spread) / mean * shortness


@summing_kernel
def _project(light: Array, begin: int, basis: Array, m: int, window: Array, sums: Array, right: Array) -> np.float32:
    """right = basis[m].T @ light from `begin` on; returns the light's weighted square."""
    size, padded = basis.shape[1], basis.shape[2]
    energy = np.float32(0)
    for q in range(size):
        value = light[begin + q]
        energy += window[q] * value * value
    sums[:] = 0
    # Samples outside, unknowns inside: the sums run side by side in vector registers, and four do not wait for one
    # another.
    for q in range(0, size, 4):
        for j in range(4):
            value = light[begin + q + j]
            for u in range(padded):
                sums[j, u] += basis[m, q + j, u] * value
    for u in range(padded):
        right[u] = (sums[0, u] + sums[1, u]) + (sums[2, u] + sums[3, u])
    return energy


def first_modulation(seen: Amplitudes, model: PatternModel) -> Array:
    """Each channel's modulation (share of the projected amplitude that the image shows) before anything is decoded.

    The share of peaks that carry channel i is known from the pattern; so the same quantile of all ratios seen is
    compared with the pattern's own. (N,) float32, floored.
    """
    lit = model.level > 0
    good = seen.light > 0
    result = np.ones(model.channels, np.float32)
    for i in range(model.channels):
        own = model.ratio[lit, i]
        share = float((own > 0).mean())
        if share == 0 or not good.any():
            continue
        quantile = 1 - share / 2
        expected = float(np.quantile(own, quantile, method="nearest"))
        result[i] = quantiles(seen.ratio[good, i], quantile)[0] / max(expected, 1e-6)
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
        if square > 1e-3 * len(posterior) * float(model.ratio[:, i].max()) ** 2:
            modulation[i] = np.clip(product / square, MODULATION_FLOOR, MODULATION_TOP)
        if count[i] > 10:
            # Rayleigh: the median is 1.177 sigma. What texture adds here and there is in each fit's own residual.
            floor[i] = np.clip(median(off[i, : count[i]]) / 1.177, 0.008, 0.1)
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
    result = np.zeros((count, model.stripes), np.float32)
    stray = np.zeros(count, np.float32)
    logs = np.empty(count, np.float32)
    for i in range(model.channels):
        ratio, noise = np.ascontiguousarray(seen.ratio[:, i]), np.ascontiguousarray(seen.sigma[:, i])
        own = model.ratio[:, i]
        # Anything from nothing to half as much again as the strongest, and the noise on top.
        widest = np.float32(max(1.5 * own.max(), 1e-3))
        _of_nothing(noise, floor[i], widest, stray)
        # Few different amplitudes per channel: 2 ("equal") or up to N + 1 ("composite").
        for value in np.unique(own):
            if value == 0:
                _switched_off(ratio, noise, floor[i], widest, logs)
            else:
                _switched_on(ratio, noise, floor[i], widest, np.float32(value * modulation[i]), logs)
            _add(logs, own == value, result)
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


@kernel
def _add(logs: Array, those: NDArray[np.bool_], result: Array) -> None:
    """result[k, s] += logs[k] for those s."""
    for k in range(len(logs)):
        value = logs[k]
        for s in range(result.shape[1]):
            result[k, s] += value if those[s] else np.float32(0)
