"""The two passes of PMP decoding over pixels: a least-squares sinusoid for one fringe set, and unwrapping.

Both go through the image in tiles that stay in the first-level cache, one short loop over a tile's pixels at a time,
so that the compiler vectorises them: no branch, no call and no double precision inside. What to compute (weights,
ladder, thresholds) is decided in `scanner.decode.pmp`; the plain NumPy form of both stands in their test.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.kernel import kernel

TILE = 1024
"""Pixels a tile: about twenty float32 rows of it fit a 32 KiB cache twice over."""

_F0 = np.float32(0)
_F1 = np.float32(1)
_HALF = np.float32(0.5)
_QUARTER = np.float32(0.25)
_TINY = np.float32(1e-20)
_ROUND = np.float32(12582912)  # 1.5 x 2^23: adding and taking it away rounds to the nearest integer, below 2^22
_PER_TURN = np.float32(1 / (2 * np.pi))

# atan(x) / x on [-1, 1], error below 2e-8 (Abramowitz and Stegun 1964, 4.4.49), in turns.
_A0 = np.float32(1 / (2 * np.pi))
_A2 = np.float32(-0.3333314528 / (2 * np.pi))
_A4 = np.float32(0.1999355085 / (2 * np.pi))
_A6 = np.float32(-0.1420889944 / (2 * np.pi))
_A8 = np.float32(0.1065626393 / (2 * np.pi))
_A10 = np.float32(-0.0752896400 / (2 * np.pi))
_A12 = np.float32(0.0429096138 / (2 * np.pi))
_A14 = np.float32(-0.0161657367 / (2 * np.pi))
_A16 = np.float32(0.0028662257 / (2 * np.pi))

# Taylor terms of exp on [0, 2]; the eighth power reaches exp(16) to 4 %.
_E2 = np.float32(1 / 2)
_E3 = np.float32(1 / 6)
_E4 = np.float32(1 / 24)
_E5 = np.float32(1 / 120)
_E6 = np.float32(1 / 720)
_E_MAX = np.float32(16)
_E_SCALE = np.float32(1 / 8)


@kernel
def fit_set(
    frames: NDArray[Any],
    weights: NDArray[np.float32],
    gram: NDArray[np.float32],
    clip: int,
    phase: NDArray[np.float32],
    modulation: NDArray[np.float32],
    mean: NDArray[np.float32],
    residual: NDArray[np.float32],
    clipped: NDArray[np.uint8],
) -> None:
    """Fit I_n = A + p cos(alpha_n) - q sin(alpha_n) to every pixel of one set, in one pass over its frames.

    Args:
        frames: (N, P) uint8 or uint16.
        weights: (3, N) float32, the least-squares weights of A, p, q.
        gram: (3, 3) float32, the normal matrix, for the residual.
        clip: grey level from which a sample counts as saturated.
        phase: (P,) float32, written: atan2(q, p) in cycles, -.5 .. .5.
        modulation: (P,) float32, written: B.
        mean: (P,) float32, A is added.
        residual: (P,) float32, the sum of squared residuals is added.
        clipped: (P,) uint8, set to 1 where a sample is saturated.
    """
    count, pixels = frames.shape
    g00, g11, g22 = gram[0, 0], gram[1, 1], gram[2, 2]
    g01, g02, g12 = gram[0, 1] * 2, gram[0, 2] * 2, gram[1, 2] * 2
    first = np.empty(TILE, np.float32)
    a = np.empty(TILE, np.float32)
    p = np.empty(TILE, np.float32)
    q = np.empty(TILE, np.float32)
    squares = np.empty(TILE, np.float32)
    top = np.empty(TILE, frames.dtype)
    for start in range(0, pixels, TILE):
        stop = min(start + TILE, pixels)
        size = stop - start
        row = frames[0, start:stop]
        for i in range(size):
            # Differences from the first frame: small numbers, so that float32 keeps the residual of 16-bit frames.
            first[i] = np.float32(row[i])
            top[i] = row[i]
            a[i] = _F0
            p[i] = _F0
            q[i] = _F0
            squares[i] = _F0
        n = 1
        while n + 1 < count:
            _add_two(frames[n, start:stop], frames[n + 1, start:stop], weights, n, first, top, a, p, q, squares)
            n += 2
        if n < count:
            _add_one(frames[n, start:stop], weights, n, first, top, a, p, q, squares)
        out_phase, out_modulation = phase[start:stop], modulation[start:stop]
        out_mean, out_residual, out_clipped = mean[start:stop], residual[start:stop], clipped[start:stop]
        for i in range(size):
            explained = a[i] * (g00 * a[i] + g01 * p[i] + g02 * q[i])
            explained += p[i] * (g11 * p[i] + g12 * q[i]) + g22 * q[i] * q[i]
            out_residual[i] += max(squares[i] - explained, _F0)
            out_mean[i] += first[i] + a[i]
            out_modulation[i] = np.sqrt(p[i] * p[i] + q[i] * q[i])
            out_clipped[i] |= np.uint8(top[i] >= clip)
        for i in range(size):
            out_phase[i] = _turns(q[i], p[i])


@kernel
def _add_one(
    row: NDArray[Any],
    weights: NDArray[np.float32],
    n: int,
    first: NDArray[np.float32],
    top: NDArray[Any],
    a: NDArray[np.float32],
    p: NDArray[np.float32],
    q: NDArray[np.float32],
    squares: NDArray[np.float32],
) -> None:
    wa, wp, wq = weights[0, n], weights[1, n], weights[2, n]
    for i in range(row.size):
        d = np.float32(row[i]) - first[i]
        a[i] += wa * d
        p[i] += wp * d
        q[i] += wq * d
        squares[i] += d * d
        top[i] = max(top[i], row[i])


@kernel
def _add_two(
    row: NDArray[Any],
    other: NDArray[Any],
    weights: NDArray[np.float32],
    n: int,
    first: NDArray[np.float32],
    top: NDArray[Any],
    a: NDArray[np.float32],
    p: NDArray[np.float32],
    q: NDArray[np.float32],
    squares: NDArray[np.float32],
) -> None:
    wa, wp, wq = weights[0, n], weights[1, n], weights[2, n]
    va, vp, vq = weights[0, n + 1], weights[1, n + 1], weights[2, n + 1]
    for i in range(row.size):
        d = np.float32(row[i]) - first[i]
        e = np.float32(other[i]) - first[i]
        a[i] += wa * d + va * e
        p[i] += wp * d + vp * e
        q[i] += wq * d + vq * e
        squares[i] += d * d + e * e
        top[i] = max(top[i], row[i], other[i])


@kernel
def _turns(y: np.float32, x: np.float32) -> np.float32:
    # atan2 in cycles without a branch: the smaller over the larger, then the octant put back.
    ax, ay = abs(x), abs(y)
    large, small = max(ax, ay), min(ax, ay)
    t = small / max(large, _TINY)
    z = t * t
    s = _A8 + z * (_A10 + z * (_A12 + z * (_A14 + z * _A16)))
    s = t * (_A0 + z * (_A2 + z * (_A4 + z * (_A6 + z * s))))
    s = _QUARTER - s if ay > ax else s
    s = _HALF - s if x < _F0 else s
    return -s if y < _F0 else s


@kernel
def _wrong_order(remainder: np.float32, variance: np.float32) -> np.float32:
    # Odds of the neighbouring order against the nearest, for a normal error: exp(-(1 - 2 |r|) / (2 sigma^2)).
    t = min((_F1 - np.float32(2) * abs(remainder)) / (np.float32(2) * variance), _E_MAX) * _E_SCALE
    e = _F1 + t * (_F1 + t * (_E2 + t * (_E3 + t * (_E4 + t * (_E5 + t * _E6)))))
    e = e * e
    e = e * e
    return _F1 / (_F1 + e * e)


@kernel
def unwrap(  # noqa: PLR0912, PLR0915  (one pass over a tile; calls would keep loops from vectorising)
    phases: NDArray[np.float32],
    modulations: NDArray[np.float32],
    mean: NDArray[np.float32],
    residual: NDArray[np.float32],
    clipped: NDArray[np.uint8],
    gains: NDArray[np.float32],
    rungs: NDArray[np.float32],
    ratios: NDArray[np.float32],
    errors: NDArray[np.float32],
    floors: NDArray[np.float32],
    noise: NDArray[np.float32],
    scale: NDArray[np.float32],
    limits: NDArray[np.float32],
    periodic: bool,
    finest: int,
    position: NDArray[np.float32],
    sigma: NDArray[np.float32],
    confidence: NDArray[np.float32],
    reason: NDArray[np.uint8],
) -> None:
    """Climb the ladder at every pixel; write projector coordinate, its sigma, confidence and reason.

    Pixels at risk of a wrong order keep a tentative coordinate, for `neighbours.settle`.

    Args:
        phases, modulations: (K, P) float32 of the axis's sets; cycles, grey levels.
        mean: (P,) float32, A. residual: (P,) float32, sum of squared residuals of all sets. clipped: (P,) uint8.
        gains: (K,) float32, variance of (p, q) over that of one sample.
        rungs: (J, K) float32 combinations. ratios: (J - 1,). errors: (J - 1, K): squared error weights.
        floors: (J - 1,) float32, variance of the remainder that no averaging removes.
        noise: [variance at A = 0, variance per grey level, least variance, prior's weight, 1 / (weight + freedom)].
        scale: [pixels along the axis, origin, coarsest rung's phase at the field's centre, finest frequency, first
            pixel's edge as a fraction of the field].
        limits: [modulation, modulation over its noise squared, residual variance over noise variance, residual
            variance over B^2, remainder over its sigma squared, wrong-order probability, edge in sigmas].
        finest: index of the finest set.
        position, sigma, confidence: (P,) float32, written. reason: (P,) uint8, written.
    """
    sets, pixels = phases.shape
    steps = ratios.size
    v0, slope, least, prior, shrink = noise[0], noise[1], noise[2], noise[3], noise[4]
    along, origin, centre, fine, low = scale[0], scale[1], scale[2], scale[3], scale[4]
    min_b2, min_snr2, max_excess, max_share, max_remainder, max_wrong, edge = (
        limits[0] * limits[0], limits[1], limits[2], limits[3], limits[4], limits[5], limits[6],
    )  # fmt: skip
    freedom = _F1 / shrink - prior
    per_turn2 = _PER_TURN * _PER_TURN
    variance = np.empty(TILE, np.float32)
    weakest = np.empty(TILE, np.float32)
    strongest = np.empty(TILE, np.float32)
    cycles2 = np.empty((sets, TILE), np.float32)
    absolute = np.empty(TILE, np.float32)
    psi = np.empty(TILE, np.float32)
    spread = np.empty(TILE, np.float32)
    wrong = np.empty(TILE, np.float32)
    broken = np.empty(TILE, np.float32)
    for start in range(0, pixels, TILE):
        stop = min(start + TILE, pixels)
        size = stop - start
        tile_mean, tile_residual, tile_clipped = mean[start:stop], residual[start:stop], clipped[start:stop]
        for i in range(size):
            model = max(v0 + slope * tile_mean[i], least)
            # A residual can show a pixel to be noisier than the model has it; a small one is luck more often than not.
            variance[i] = max((prior * model + tile_residual[i]) * shrink, model)
            weakest[i] = np.float32(1e30)
            strongest[i] = _F0
            wrong[i] = _F0
            broken[i] = _F0
        for k in range(sets):
            b = modulations[k, start:stop]
            gain = gains[k]
            errors2 = cycles2[k]
            for i in range(size):
                b2 = b[i] * b[i]
                noise_b2 = gain * variance[i]
                # Over both thresholds, as a ratio: 1 is just enough.
                enough = min(b2 / min_b2, b2 / (min_snr2 * noise_b2))
                weakest[i] = min(weakest[i], enough)
                strongest[i] = max(strongest[i], enough)
                errors2[i] = per_turn2 * noise_b2 / max(b2, _TINY)
        _combine(phases, rungs[0], start, size, absolute)
        for i in range(size):
            offset = absolute[i] - centre
            absolute[i] -= (offset + _ROUND) - _ROUND
        for j in range(steps):
            _combine(phases, rungs[j + 1], start, size, psi)
            floor = floors[j]
            for i in range(size):
                spread[i] = floor
            for k in range(sets):
                weight = errors[j, k]
                if weight != _F0:
                    errors2 = cycles2[k]
                    for i in range(size):
                        spread[i] += weight * errors2[i]
            ratio = ratios[j]
            for i in range(size):
                expected = ratio * absolute[i]
                difference = expected - psi[i]
                order = (difference + _ROUND) - _ROUND
                remainder = difference - order
                wrong[i] += _wrong_order(remainder, spread[i])
                broken[i] = max(broken[i], remainder * remainder / spread[i])
                absolute[i] = psi[i] + order
        out_position, out_sigma = position[start:stop], sigma[start:stop]
        out_confidence, out_reason = confidence[start:stop], reason[start:stop]
        fine_b = modulations[finest, start:stop]
        fine_errors = cycles2[finest]
        for i in range(size):
            turns = absolute[i] / fine
            if periodic:
                # Both ends of the field look alike: whole turns are taken off.
                over = turns - low - _HALF
                turns -= (over + _ROUND) - _ROUND
            value = turns * along - origin
            deviation = along / fine * np.sqrt(fine_errors[i])
            margin = edge * deviation if periodic else -edge * deviation
            inside = value > margin - _HALF and value < along - _HALF - margin
            excess = tile_residual[i] / max(freedom, _F1)
            model = max(v0 + slope * tile_mean[i], least)
            moved = excess > max_excess * model and excess > max_share * fine_b[i] * fine_b[i]
            risk = wrong[i] > max_wrong or broken[i] > max_remainder
            why = 0 if inside else 5
            why = 4 if risk else why
            why = 3 if weakest[i] < _F1 else why
            why = 1 if strongest[i] < _F1 else why
            why = 7 if moved else why
            why = 2 if tile_clipped[i] != 0 else why
            good = why == 0
            known = good or why == 4
            out_position[i] = value if known else np.float32(np.nan)
            out_sigma[i] = deviation if known else np.float32(np.nan)
            out_confidence[i] = max(_F1 - wrong[i], _F0) if good else _F0
            out_reason[i] = np.uint8(why)


@kernel
def _combine(
    phases: NDArray[np.float32], rung: NDArray[np.float32], start: int, size: int, total: NDArray[np.float32]
) -> None:
    for i in range(size):
        total[i] = _F0
    for k in range(rung.size):
        weight = rung[k]
        if weight != _F0:
            phase = phases[k, start : start + size]
            for i in range(size):
                total[i] += weight * phase[i]
