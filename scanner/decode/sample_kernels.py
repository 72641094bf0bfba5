"""Kernels of a PMP scan's sample: which of its pixels are good, and what each step up the ladder leaves of them.

Between the last frame and the pass over all pixels a few thousand of them are judged by one thread, while every other
one waits: what is short here is short for the scan. Meanings and thresholds are the callers', `pmp_sample` and
`agreement`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.decode.middles import middles_of_bins
from scanner.kernel import kernel, summing_kernel

_PER_TURN2 = np.float32(1 / (4 * np.pi**2))


@kernel
def mark_good(
    modulations: NDArray[np.float32],
    mean: NDArray[np.float32],
    residual: NDArray[np.float32],
    usable: NDArray[np.bool_],
    gains: NDArray[np.float32],
    noise: NDArray[np.float32],
    limits: NDArray[np.float32],
    variance: NDArray[np.float32],
    good: NDArray[np.bool_],
) -> int:
    """Mark usable pixels whose sets all have enough modulation; how many there are.

    Args:
        modulations: (K, n) float32. mean, residual: (n,) float32. usable: (n,) bool. gains: (K,) float32.
        noise: [variance at level 0, variance per level, least variance, weight of these against a residual, degrees of
            freedom of a residual, 1 or 0: whether residuals count].
        limits: [squared modulation over its variance, squared modulation in grey levels].
        variance: (n,) float32, written: of one sample. good: (n,) bool, written.
    """
    read, per_level, least, prior = noise[0], noise[1], noise[2], noise[3]
    trust, weight = noise[5], noise[3] + noise[4]
    for i in range(mean.size):
        model = read + per_level * mean[i]
        model = model if model > least else least
        own = (prior * model + trust * residual[i]) / weight
        variance[i] = own if own > model else model
        good[i] = usable[i]
    for k in range(gains.size):
        for i in range(mean.size):
            enough = limits[0] * (gains[k] * variance[i])
            enough = enough if enough > limits[1] else limits[1]
            good[i] &= modulations[k, i] * modulations[k, i] > enough
    count = 0
    for i in range(mean.size):
        count += good[i]
    return count


@kernel
def take_good(
    phases: NDArray[np.float32],
    modulations: NDArray[np.float32],
    variance: NDArray[np.float32],
    gains: NDArray[np.float32],
    good: NDArray[np.bool_],
    count: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(K, count) phases of good pixels, and the variances of these, cycles squared. Arguments: as `mark_good` left."""
    taken, cycles2 = np.empty((gains.size, count), np.float32), np.empty((gains.size, count), np.float32)
    for k in range(gains.size):
        to = 0
        for i in range(good.size):
            if good[i]:
                taken[k, to] = phases[k, i]
                b = modulations[k, i]
                cycles2[k, to] = ((gains[k] * variance[i]) * _PER_TURN2) / (b * b)
                to += 1
    return taken, cycles2


@kernel
def count_lit(modulations: NDArray[np.float32], usable: NDArray[np.bool_], least: np.float32) -> int:
    """How many usable pixels have more than `least` in all sets. modulations: (K, n). usable: (n,)."""
    count = 0
    for i in range(usable.size):
        lit = usable[i]
        for k in range(modulations.shape[0]):
            lit &= modulations[k, i] > least
        count += lit
    return count


@kernel
def mean_of_good(values: NDArray[np.float32], good: NDArray[np.bool_], every: int) -> tuple[float, int]:
    """Mean of (R, L) values at good pixels of one row in `every`, 0 where there is none; and how many these are."""
    total, count = 0.0, 0
    for r in range(0, good.shape[0], every):
        for i in range(good.shape[1]):
            if good[r, i]:
                total += values[r, i]
                count += 1
    return total / max(count, 1), count


@kernel
def judge_steps(
    phases: NDArray[np.float32],
    cycles2: NDArray[np.float32],
    combinations: NDArray[np.float64],
    frequencies: NDArray[np.float64],
    errors2: NDArray[np.float32],
    centre: float,
    bins: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64]]:
    """What is left of each step up the ladder (`agreement.remainders_of`), in bins of pixels by the noise it has there.

    Args:
        phases, cycles2: (K, n) float32, n >= bins. combinations: (J, K). frequencies: (J,). errors2: (J - 1, K).

    Returns:
        By step: (J - 1, bins) each bin's median variance, and median of absolute remainders; (J - 1, 3) of the better
        half of the bins the mean cosine and sine of remainders, and the median variance.
    """
    steps, sets, size = errors2.shape[0], errors2.shape[1], phases.shape[1]
    x, y = np.empty((steps, bins), np.float32), np.empty((steps, bins), np.float32)
    means = np.empty((steps, 3))
    absolute, remainder = np.empty(size), np.empty(size)
    variance, apart = np.empty(size, np.float32), np.empty(size, np.float32)
    _beat(phases, combinations[0], absolute)
    for i in range(size):
        absolute[i] -= np.rint(absolute[i] - frequencies[0] * centre)
    for j in range(steps):
        _beat(phases, combinations[j + 1], remainder)
        ratio = frequencies[j + 1] / frequencies[j]
        for i in range(size):
            psi = remainder[i]
            difference = ratio * absolute[i] - psi
            order = np.rint(difference)
            remainder[i] = difference - order
            absolute[i] = psi + order
            apart[i] = np.float32(abs(remainder[i]))
            variance[i] = np.float32(0)
        for k in range(sets):
            if errors2[j, k] != 0:
                for i in range(size):
                    variance[i] += errors2[j, k] * cycles2[k, i]
        x[j], y[j], by_noise = middles_of_bins(variance, apart, bins, False)
        better = bins // 2 * (size // bins)
        means[j, 0], means[j, 1] = _mean_turn(remainder, by_noise[:better])
        means[j, 2] = variance[by_noise[better // 2]]
    return x, y, means


@kernel
def _beat(phases: NDArray[np.float32], combination: NDArray[np.float64], beat: NDArray[np.float64]) -> None:
    """Write one rung's phase, (n,) cycles."""
    beat[:] = 0
    for k in range(combination.size):
        if combination[k] != 0:
            for i in range(beat.size):
                beat[i] += combination[k] * phases[k, i]


@summing_kernel
def _mean_turn(cycles: NDArray[np.float64], which: NDArray[np.int32]) -> tuple[float, float]:
    """Mean cosine and sine of some angles within half a cycle, to 1e-9."""
    cosine, sine = 0.0, 0.0
    for n in range(which.size):
        # Of half the angle, Taylor's terms up to the thirteenth power; its cosine is positive.
        x = np.pi * cycles[which[n]]
        z = x * x
        s = 1.0 / 362880 - z * (1.0 / 39916800 - z * (1.0 / 6227020800))
        s = x * (1.0 - z * (1.0 / 6 - z * (1.0 / 120 - z * (1.0 / 5040 - z * s))))
        cosine += 1.0 - 2.0 * s * s
        sine += 2.0 * s * np.sqrt(max(1.0 - s * s, 0.0))
    return cosine / which.size, sine / which.size
