"""Mean, slope and all carriers of a window along a chain, by weighted least squares: the sums behind `emissions`.

Unknowns stand side by side in lanes, as many as they are padded to; samples follow one another. Frames of a series ask
for the same tables again and again: they are kept.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanner.across_lanes import total_of
from scanner.kernel import kernel, summing_kernel
from scanner.lanes import LANES, floats, load, multiply_add, store

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

GROUND = 3
"""Terms of the fit that are no carrier: mean, slope and bend of the brightness in the window."""

FIELD_STEP = 0.005
"""Steps of magnification of the tables: .05 cycles at the end of a window of 20 periods."""

MEAN_OF_BEND = np.float32(0.1307)
"""The bend's mean over a Hann window, (1 / 3 - 2 / pi^2) of its value at the ends."""


class Fitted(NamedTuple):
    """Of P places, written by `fit`: ratio, sigma (P, N); light (P,); wave (P, 2 N), see `emissions.Amplitudes`.
    begin: (P,) int32, the place at which the window begins.
    """

    ratio: Array
    sigma: Array
    light: Array
    wave: Array
    begin: Ints


class Along(NamedTuple):
    """Where windows lie: light (4 N,) float32; order, start of the chains, and which of them; step (N,) int32: the
    magnification at each place in FIELD_STEP about 1; a window for every `hop` places.
    """

    light: Array
    order: Ints
    start: Ints
    chosen: Ints
    step: Ints
    hop: int


def fit(along: Along, omega: tuple[float, ...], size: int, coarse: int, doubt: float, fitted: Fitted) -> None:
    """Fit ground and carriers in windows of one size.

    Args:
        along: the windows.
        omega: carriers, radians per px where the magnification is 1.
        size: of the windows, samples: a multiple of four.
        coarse: steps of magnification that are taken for one.
        doubt: factor of sigma.
        fitted: set at the places of the chains chosen.
    """
    lowest = int(along.step.min()) // coarse - 1
    used = np.zeros(int(along.step.max()) // coarse + 2 - lowest, np.bool_)
    _mark(along, coarse, lowest, used)
    steps = tuple(int(n) for n in (np.flatnonzero(used) + lowest) * coarse)
    number = np.cumsum(used, dtype=np.int32) - np.int32(1)
    basis, inverse = _bank(omega, steps, size)
    _fit(along, coarse, lowest, number, basis, inverse, window(size), np.float32(doubt), fitted)


@lru_cache(maxsize=256)
def window(size: int) -> Array:
    """Hann weights with a foot, so that the ends hold the slope."""
    return (0.02 + 0.98 * np.hanning(size + 2)[1:-1]).astype(np.float32)


@lru_cache(maxsize=64)
def _bank(omega: tuple[float, ...], steps: tuple[int, ...], size: int) -> tuple[Array, Array]:
    """Tables of several magnifications, one behind the other, flat."""
    tables = [_table(omega, step, size) for step in steps]
    return np.concatenate([t[0] for t in tables]).ravel(), np.concatenate([t[1] for t in tables]).ravel()


@lru_cache(maxsize=2048)
def _table(omega: tuple[float, ...], step: int, size: int) -> tuple[Array, Array]:
    """Weighted basis (size, LANES) and inverse normal matrix (Q, LANES) for one magnification.

    Q = GROUND + 2 N: mean, slope and bend, then cosine and sine of each carrier, about the window's middle. A ridge of
    1e-3 keeps carriers that a short chain cannot tell apart finite; their sigma is then large.
    """
    t = np.arange(size) - (size - 1) / 2
    weights = window(size).astype(np.float64)
    phase = t[:, None] * (np.asarray(omega) / (1 + step * FIELD_STEP))[None, :]
    ground = np.vander(2 * t / size, GROUND, increasing=True)
    design = np.concatenate([ground, np.stack([np.cos(phase), np.sin(phase)], 2).reshape(size, -1)], axis=1)
    weighted = weights[:, None] * design
    ridge = np.full(design.shape[1], 1e-3 * weights.sum())
    ridge[0] = 0
    inverse = np.linalg.inv(design.T @ weighted + np.diag(ridge))
    rest = (0, LANES - design.shape[1])
    return np.pad(weighted, ((0, 0), rest)).astype(np.float32), np.pad(inverse, ((0, 0), rest)).astype(np.float32)


@kernel
def _rounded(step: int, coarse: int) -> int:
    """To the nearest multiple of `coarse`, halves to even ones."""
    return int(np.rint(step / coarse))


@kernel
def _mark(along: Along, coarse: int, lowest: int, used: NDArray[np.bool_]) -> None:
    """Which multiples of `coarse` are asked for."""
    for c in along.chosen:
        for p in range(along.start[c], along.start[c + 1], along.hop):
            used[_rounded(along.step[along.order[p]], coarse) - lowest] = True


@kernel
def _fit(
    along: Along,
    coarse: int,
    lowest: int,
    number: Ints,
    basis: Array,
    inverse: Array,
    weights: Array,
    doubt: np.float32,
    fitted: Fitted,
) -> None:
    size, channels = len(weights), fitted.sigma.shape[1]
    unknowns = GROUND + 2 * channels
    right, found, half = np.empty(LANES, np.float32), np.empty(LANES, np.float32), size // 8
    total = np.float32(0)
    for q in range(size):
        total += weights[q]
    # Effective number of samples: neighbours within the lens's blur are not independent, which the floor covers.
    free = max(np.float32(1), total - np.float32(unknowns) * total / np.float32(size))
    for c in along.chosen:
        first, last = along.start[c], along.start[c + 1]
        previous = -1
        for p in range(first, last):
            k = along.order[p]
            begin = min(max(p - half, first), last - size // 4)
            if begin == previous or (p - first) % along.hop:  # the window stands still at a chain's ends
                _repeat(fitted, along.order[p - 1], k)
                continue
            previous = begin
            n = number[_rounded(along.step[k], coarse) - lowest]
            _project(along.light, 4 * begin, basis, n * size * LANES, size, right)
            explained = _solve(right, inverse, n * unknowns * LANES, unknowns, found)
            mean = found[0] + MEAN_OF_BEND * found[2]
            fitted.light[k], fitted.begin[k] = mean, begin
            if mean <= 0:
                continue
            variance = max(_energy(along.light, 4 * begin, weights) - explained, np.float32(0)) / free
            inverse_mean = np.float32(1) / mean
            for i in range(channels):
                u = GROUND + 2 * i
                a, b = found[u], found[u + 1]
                fitted.ratio[k, i] = np.sqrt(a * a + b * b) * inverse_mean
                fitted.wave[k, 2 * i], fitted.wave[k, 2 * i + 1] = a * inverse_mean, b * inverse_mean
                at = n * unknowns * LANES + u * LANES + u
                spread = np.float32(0.5) * (inverse[at] + inverse[at + LANES + 1])
                fitted.sigma[k, i] = np.sqrt(variance * spread) * inverse_mean * doubt


@kernel
def _repeat(fitted: Fitted, j: int, k: int) -> None:
    """Place k shows what place j does."""
    for i in range(fitted.sigma.shape[1]):
        fitted.ratio[k, i], fitted.sigma[k, i] = fitted.ratio[j, i], fitted.sigma[j, i]
        fitted.wave[k, 2 * i], fitted.wave[k, 2 * i + 1] = fitted.wave[j, 2 * i], fitted.wave[j, 2 * i + 1]
    fitted.light[k], fitted.begin[k] = fitted.light[j], fitted.begin[j]


@summing_kernel
def _energy(light: Array, begin: int, weights: Array) -> np.float32:
    """The light's weighted square."""
    energy = np.float32(0)
    for q in range(len(weights)):
        value = light[begin + q]
        energy += weights[q] * value * value
    return energy


@kernel
def _project(light: Array, begin: int, basis: Array, table: int, size: int, right: Array) -> None:
    """right = the basis's transpose @ light from `begin` on, in four sums that do not wait for one another."""
    a, b, c, d = floats(np.float32(0)), floats(np.float32(0)), floats(np.float32(0)), floats(np.float32(0))
    for q in range(0, size, 4):
        row = table + q * LANES
        a = multiply_add(load(basis, row), floats(light[begin + q]), a)
        b = multiply_add(load(basis, row + LANES), floats(light[begin + q + 1]), b)
        c = multiply_add(load(basis, row + 2 * LANES), floats(light[begin + q + 2]), c)
        d = multiply_add(load(basis, row + 3 * LANES), floats(light[begin + q + 3]), d)
    store(right, 0, (a + b) + (c + d))


@kernel
def _solve(right: Array, inverse: Array, table: int, unknowns: int, found: Array) -> np.float32:
    """The unknowns; returns the energy that they explain."""
    total = floats(np.float32(0))
    for u in range(unknowns):
        total = multiply_add(load(inverse, table + u * LANES), floats(right[u]), total)
    store(found, 0, total)
    explained: np.float32 = total_of(total * load(right, 0))
    return explained
