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

from scanner.decode.mcp.carriers import FIELD_RANGE, FIELD_STEP
from scanner.decode.mcp.linking import Chains
from scanner.decode.mcp.model import PatternModel
from scanner.kernel import kernel

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

MODULATION_FLOOR = 0.15
"""Share of a carrier's amplitude below which it is taken for lost: a dark frame must not latch on to noise."""

SPREAD = 0.22
"""Relative spread of a carrier's amplitude over a scene: focus, gloss and albedo within the window."""

GROUND = 3
"""Terms of the fit that are no carrier: mean, slope and bend of the brightness in the window."""

SHORT_POWER = 1.5
"""A chain shorter than the window leaves the fit few degrees of freedom, and what is not white (texture, shading) hides
in the carriers instead of the residual: sigma grows by this power of window over length."""

OUTLIER = 0.01
"""Probability that an amplitude says nothing. It bounds what one channel can say to a factor of a hundred."""


@dataclass(frozen=True, eq=False)
class Amplitudes:
    """ratio: (P, N) float32, carrier amplitude over brightness. sigma: (P, N) float32, its noise (one component).
    light: (P,) float32, brightness above the valleys in the window.
    """

    ratio: Array
    sigma: Array
    light: Array


def measure(light: Array, chains: Chains, field: Array, model: PatternModel, scale: float, size: int) -> Amplitudes:
    """Carrier amplitudes at every peak.

    Args:
        light: (4 P,) float32, brightness along the chains.
        chains: the chains.
        field: (P,) magnification relative to `scale` at each peak.
        model: the pattern's tables.
        scale: camera px per projector px.
        size: window, samples, a multiple of four. Chains shorter than it are fitted whole.

    Returns:
        Amplitudes in the order of the peaks.
    """
    count, channels = len(field), model.channels
    steps = np.arange(-FIELD_RANGE, FIELD_RANGE + 1e-9, FIELD_STEP)
    omega = (2 * np.pi * model.carriers / scale).astype(np.float64)
    lengths = chains.lengths
    short = np.unique(np.minimum(lengths * 4, size))
    ratio = np.zeros((count, channels), np.float32)
    sigma = np.full((count, channels), np.float32(10))
    bright = np.zeros(count, np.float32)
    pick = np.clip(np.rint((field - 1 + FIELD_RANGE) / FIELD_STEP), 0, len(steps) - 1).astype(np.int32)
    for length in short:
        if length < 8:
            continue  # fewer samples than unknowns say nothing
        chosen = np.flatnonzero(np.minimum(lengths * 4, size) == length).astype(np.int32)
        basis, inverse, window = _tables(omega, steps, int(length))
        shortness = np.float32((size / length) ** SHORT_POWER)
        tables = (basis, inverse, window)
        _fit(light, chains.order, chains.start, chosen, pick, *tables, shortness, ratio, sigma, bright)
    return Amplitudes(ratio, sigma, bright)


def _tables(omega: NDArray[np.float64], steps: NDArray[np.float64], size: int) -> tuple[Array, Array, Array]:
    """Weighted bases (K, size, 16 or more) and inverse normal matrices (K, Q, Q) per magnification; window (size,).

    Q = GROUND + 2 N: mean, slope and bend, then cosine and sine of each carrier, about the window's middle. A ridge of
    1e-3 keeps carriers that a short chain cannot tell apart finite; their sigma is then large.
    """
    t = np.arange(size) - (size - 1) / 2
    window = 0.02 + 0.98 * np.hanning(size + 2)[1:-1]
    bases, inverses = [], []
    for step in steps:
        phase = t[:, None] * (omega / (1 + step))[None, :]
        design = np.concatenate(
            [
                np.vander(2 * t / size, GROUND, increasing=True),
                np.stack([np.cos(phase), np.sin(phase)], 2).reshape(size, -1),
            ],
            axis=1,
        )
        normal = design.T @ (window[:, None] * design)
        ridge = np.full(design.shape[1], 1e-3 * window.sum())
        ridge[0] = 0
        bases.append(np.pad(window[:, None] * design, ((0, 0), (0, -design.shape[1] % 8))))
        inverses.append(np.linalg.inv(normal + np.diag(ridge)))
    return (
        np.ascontiguousarray(bases, np.float32),
        np.ascontiguousarray(inverses, np.float32),
        window.astype(np.float32),
    )


@kernel
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
    ratio: Array,
    sigma: Array,
    bright: Array,
) -> None:
    unknowns, size, padded = inverse.shape[1], basis.shape[1], basis.shape[2]
    channels = (unknowns - GROUND) // 2
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
            if begin == previous:  # the window stands still at a chain's ends
                j = order[p - 1]
                for i in range(channels):
                    ratio[k, i] = ratio[j, i]
                    sigma[k, i] = sigma[j, i]
                bright[k] = bright[j]
                continue
            previous = begin
            piece = light[4 * begin : 4 * begin + size]
            table = basis[pick[k]]
            energy = np.float32(0)
            explained = np.float32(0)
            right[:] = 0
            for q in range(size):  # samples outside, unknowns inside: the sums run side by side in vector registers
                value = piece[q]
                energy += window[q] * value * value
                for u in range(padded):
                    right[u] += table[q, u] * value
            for u in range(unknowns):
                dot = np.float32(0)
                for v in range(unknowns):
                    dot += inverse[pick[k], u, v] * right[v]
                fitted[u] = dot
                explained += dot * right[u]
            # The bend's mean over a Hann window, (1 / 3 - 2 / pi^2) of its value at the ends.
            mean = fitted[0] + np.float32(0.1307) * fitted[2]
            bright[k] = mean
            if mean <= 0:
                continue
            variance = max(energy - explained, np.float32(0)) / free
            for i in range(channels):
                c = GROUND + 2 * i
                a, b = fitted[c], fitted[c + 1]
                ratio[k, i] = np.sqrt(a * a + b * b) / mean
                spread = np.float32(0.5) * (inverse[pick[k], c, c] + inverse[pick[k], c + 1, c + 1])
                sigma[k, i] = np.sqrt(variance * spread) / mean * shortness


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
        result[i] = np.quantile(seen.ratio[good, i], quantile) / max(expected, 1e-6)
    return np.clip(result, MODULATION_FLOOR, 1.3)


CLEAR = 5.0
"""Logarithm of the odds between the best code word and the next above which a peak's own word counts as clear."""


@dataclass(frozen=True)
class Agreement:
    """How far what was decoded agrees with the description.

    clear: share of the peaks whose own carriers name a code word clearly (other than "all off", which unmodulated
    stripes show too). agree: share of these that the columns' model took for a stripe of that word. order: share of
    neighbouring stripes in a column that follow one another. hits: share of switched-on carriers seen with more than
    half their amplitude.
    """

    clear: float
    agree: float
    order: float
    hits: float

    @property
    def holds(self) -> bool:
        """Whether this is the pattern described.

        On simulated scenes from boards to strong texture agree was .94 or more, hits .93 (.80 on the strongest); with
        another code order agree was .77 or less; with other carriers, fewer or more bits, fringes or an upside-down
        image few clear words were left and hits were .78 or less. The limits stand between.
        """
        if self.clear < 0.02:
            return self.hits >= 0.9
        return self.agree >= 0.85 and self.hits >= 0.7


def agreement(
    seen: Amplitudes, evidence: Array, model: PatternModel, modulation: Array, path: Ints, columns: tuple[Ints, Ints]
) -> Agreement:
    """Compare what the peaks say one by one with what the columns' model made of them.

    Args:
        seen: the amplitudes.
        evidence: (P, S) log-likelihoods, without votes.
        model: the pattern's tables.
        modulation: (N,).
        path: (P,) int32, -1 for stray peaks.
        columns: where columns begin (B + 1,), and the table to each peak (P,) of `hmm.gaps`; 0 is one pitch.
    """
    words, of_word = np.unique(model.ratio > 0, axis=0, return_inverse=True)
    each = np.stack([evidence[:, of_word == w].max(axis=1) for w in range(len(words))], axis=1)
    ranked = np.sort(each, axis=1)
    best = each.argmax(axis=1)
    clear = (ranked[:, -1] - ranked[:, -2] > CLEAR) & words[best].any(axis=1)
    agrees = (path >= 0) & (of_word.ravel()[np.maximum(path, 0)] == best)
    start, gap = columns
    first = np.zeros(len(path), bool)
    first[start[:-1][start[:-1] < len(path)]] = True
    pair = ~first & (gap == 0) & (path >= 0) & (np.roll(path, 1) >= 0)
    follows = path == np.roll(path, 1) + 1
    own = model.ratio[np.maximum(path, 0)] * (path >= 0)[:, None]
    over = seen.ratio > 0.5 * modulation * own
    return Agreement(
        *(float(part.mean()) if part.size else 0.0 for part in (clear, agrees[clear], follows[pair], over[own > 0]))
    )


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
    for i in range(model.channels):
        expected = posterior @ model.ratio[:, i]
        square = posterior @ model.ratio[:, i] ** 2
        if square.sum() > 1e-3 * len(posterior):
            modulation[i] = np.clip((expected * seen.ratio[:, i]).sum() / square.sum(), MODULATION_FLOOR, 1.3)
        off = seen.ratio[posterior @ (model.ratio[:, i] == 0).astype(np.float32) > 0.9, i]
        if len(off) > 10:
            # Rayleigh: the median is 1.177 sigma. What texture adds here and there is in each fit's own residual.
            floor[i] = np.clip(np.median(off) / 1.177, 0.008, 0.1)
    return modulation, floor


def log_likelihood(seen: Amplitudes, model: PatternModel, modulation: Array, floor: Array) -> tuple[Array, Array]:
    """Log-likelihood of every stripe at every peak, (P, S) float32, and of no stripe at all, (P,) float32.

    Switched off, an amplitude is Rayleigh distributed; on, Gaussian about what is expected (Rice 1945, for amplitudes
    well above the noise); either is mixed with a flat density of weight OUTLIER.
    """
    count = len(seen.light)
    result = np.zeros((count, model.stripes), np.float32)
    stray = np.zeros(count, np.float32)
    _likelihood(seen.ratio, seen.sigma, model.ratio, modulation, floor, result, stray)
    dark = model.level == 0
    if dark.any():
        # A stripe without light has no peak: only a stray one could be taken for it.
        result[:, dark] += np.float32(np.log(1e-4))
    return result, stray


@kernel
def _likelihood(
    seen: Array, noise: Array, own: Array, modulation: Array, floor: Array, result: Array, stray: Array
) -> None:
    count, channels = seen.shape
    stripes = own.shape[0]
    for i in range(channels):
        # Few different amplitudes per channel: 2 ("equal") or up to N + 1 ("composite").
        values = np.empty(stripes, np.float32)
        index = np.empty(stripes, np.int32)
        different = 0
        top = np.float32(0)
        for s in range(stripes):
            top = max(top, own[s, i])
            found = -1
            for d in range(different):
                if values[d] == own[s, i]:
                    found = d
            if found < 0:
                values[different] = own[s, i]
                found = different
                different += 1
            index[s] = found
        widest = max(np.float32(1.5) * top, np.float32(1e-3))
        logs = np.empty(different, np.float32)
        for k in range(count):
            sigma = np.sqrt(noise[k, i] * noise[k, i] + floor[i] * floor[i])
            r = seen[k, i]
            # Anything from nothing to half as much again as the strongest, and the noise on top.
            flat = np.float32(1) / (widest + np.float32(2.5) * sigma)
            stray[k] += np.log(flat)
            for d in range(different):
                if values[d] == 0:
                    density = r / (sigma * sigma) * np.exp(np.float32(-0.5) * r * r / (sigma * sigma))
                    density = max(
                        density, np.float32(0.02) / sigma * np.exp(np.float32(-0.5) * r * r / (sigma * sigma))
                    )
                else:
                    mean = values[d] * modulation[i]
                    wide = np.sqrt(sigma * sigma + np.float32(SPREAD * SPREAD) * mean * mean)
                    z = (np.sqrt(mean * mean + sigma * sigma) - r) / wide
                    density = np.float32(0.39894) / wide * np.exp(np.float32(-0.5) * z * z)
                logs[d] = np.log(np.float32(1 - OUTLIER) * density + np.float32(OUTLIER) * flat)
            for s in range(stripes):
                result[k, s] += logs[index[s]]
