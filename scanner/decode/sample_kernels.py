"""Kernels of a PMP scan's sample: which of its pixels are good, and what each step up the ladder leaves of them.

Between the last frame and the pass over all pixels a few thousand of them are judged by one thread, while every other
one waits: what is short here is short for the scan. So these steps call one another, and the interpreter has no part in
it: a look at the frames (`look`), and a verdict (`judge`). Meanings and thresholds are the callers', `pmp_sample` and
`agreement`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.middles import middles_of_bins, nth_of
from scanner.decode.noise import FEWEST, fit_line
from scanner.decode.pmp_sums import fit_runs
from scanner.decode.spectra import LEAST_PIXELS, sum_sets
from scanner.kernel import kernel, summing_kernel

MIN_PIXELS = 400
"""Fewer usable pixels than this say nothing of how rungs agree."""

BINS = 8
"""Of pixels by their noise, in each of which remainders are judged apart."""

_PER_TURN2 = np.float32(1 / (4 * np.pi**2))


@kernel
def look(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    starts: NDArray[np.intp],
    weights: NDArray[np.float32],
    grams: NDArray[np.float32],
    whole: NDArray[np.intp],
    gains: NDArray[np.float32],
    clip: int,
    pixels: int,
    runs: NDArray[np.intp],
    length: int,
    every: int,
    finest: int,
    noise: NDArray[np.float32],
    thresholds: NDArray[np.float32],
    heights: NDArray[np.float32],
    kinds: NDArray[np.intp],
    phases: NDArray[np.float32],
    modulations: NDArray[np.float32],
    mean: NDArray[np.float32],
    residual: NDArray[np.float32],
    usable: NDArray[np.bool_],
    good: NDArray[np.bool_],
    sums: NDArray[np.float64],
    levels: NDArray[np.float64],
    ratios: NDArray[np.complex128],
) -> tuple[int, float, int, float, float]:
    """Fit a sample of pixels, and look at the spectra of one run in `every` of those that have light, by any noise.

    Args:
        addresses ... whole, clip, pixels, runs, length: see `fit_runs`. heights, kinds: `HeightWeights`.
        noise: see `mark_good`, of any camera. thresholds: [grey levels of modulation that count as light, the least
            share of the brightest, modulation over its noise].
        phases, modulations: (K, R, L) float32, mean, residual: (R, L) float32, usable, good: (R, L) bool, written.
        sums, levels, ratios: see `sum_sets`.

    Returns:
        How many pixels have light; the least modulation; how many were asked for their spectra; mean of their squared
        residuals, and of what overtones of a response are of these.
    """
    sets, size = gains.size, mean.size
    flat = modulations.reshape(sets, size)
    level, rest, mark, lit = mean.reshape(size), residual.reshape(size), usable.reshape(size), good.reshape(size)
    fit_runs(
        addresses, like, starts, weights, grams, whole, clip, pixels, runs, length,
        phases.reshape(sets, size), flat, level, rest, mark,
    )  # fmt: skip
    for i in range(size):
        mark[i] = not mark[i]
    with_light = count_lit(flat, mark, thresholds[0])
    least = max(thresholds[0], thresholds[1] * nth_of(flat[finest], int(0.99 * (size - 1))))
    limits, variance = np.empty(2, np.float32), np.empty(size, np.float32)
    limits[0], limits[1] = thresholds[2] ** 2, max(least**2, np.float32(1e-12))
    mark_good(flat, level, rest, mark, gains, noise, limits, variance, lit)
    left, count = mean_of_good(residual, good, every)
    energy = 0.0
    if count >= LEAST_PIXELS:
        energy = sum_sets(addresses, like, starts, heights, kinds, runs, every, good, mean, sums, levels, ratios)
    return with_light, float(least), count, left, energy / max(count, 1)


@kernel
def judge(
    phases: NDArray[np.float32],
    modulations: NDArray[np.float32],
    mean: NDArray[np.float32],
    residual: NDArray[np.float32],
    usable: NDArray[np.bool_],
    gains: NDArray[np.float32],
    fitting: bool,
    noise: NDArray[np.float32],
    limits: NDArray[np.float32],
    combinations: NDArray[np.float64],
    frequencies: NDArray[np.float64],
    errors2: NDArray[np.float32],
    centre: float,
    folded: NDArray[np.float64],
    floor: float,
    steps: NDArray[np.float64],
) -> tuple[NDArray[np.float32], bool]:
    """The scan's noise from a sample's residuals, and how well rungs agree over the pixels that are good by it.

    Args:
        phases, modulations, mean, residual, usable: (K, n) or (n,), as `look` wrote them. gains: (K,).
        fitting: False where `noise` is known, or nothing tells it. noise: see `mark_good`, changed if it was fitted.
        limits: see `mark_good`. The others: see `judge_steps`.

    Returns:
        (K, m) variances of good pixels' phases, cycles squared, and whether the noise was fitted.
    """
    fitted = False
    if fitting:
        level, rest = mean, residual
        count = 0
        for i in range(usable.size):
            count += usable[i]
        if count < usable.size:
            level, rest = np.empty(count, np.float32), np.empty(count, np.float32)
            to = 0
            for i in range(usable.size):
                if usable[i]:
                    level[to], rest[to] = mean[i], residual[i]
                    to += 1
        if count >= FEWEST:
            read, per_level = fit_line(level, rest, int(noise[4]))
            noise[0], noise[1] = read, per_level
            fitted = True
    good, variance = np.empty(mean.size, np.bool_), np.empty(mean.size, np.float32)
    count = mark_good(modulations, mean, residual, usable, gains, noise, limits, variance, good)
    taken, cycles2 = take_good(phases, modulations, variance, gains, good, count)
    judge_steps(taken, cycles2, combinations, frequencies, errors2, centre, folded, floor, steps)
    return cycles2, fitted


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
    """(K, count) phases of good pixels, and the variances of these, cycles squared; not to be written into.

    Arguments: as `mark_good` left them.
    """
    cycles2 = np.empty(modulations.shape, np.float32)
    for k in range(gains.size):
        for i in range(good.size):
            cycles2[k, i] = ((gains[k] * variance[i]) * _PER_TURN2) / (modulations[k, i] * modulations[k, i])
    if count == good.size:
        return phases, cycles2
    return _compressed(phases, good, count), _compressed(cycles2, good, count)


@kernel
def _compressed(rows: NDArray[np.float32], good: NDArray[np.bool_], count: int) -> NDArray[np.float32]:
    """(K, count) of the columns that are good, of (K, n)."""
    # Without a branch: the next one takes the place of one that is not good, behind the last row as well.
    taken = np.empty(rows.shape[0] * count + 1, np.float32)
    for k in range(rows.shape[0]):
        to = k * count
        for i in range(good.size):
            taken[to] = rows[k, i]
            to += good[i]
    return taken[:-1].reshape(rows.shape[0], count)


@kernel
def count_lit(modulations: NDArray[np.float32], usable: NDArray[np.bool_], least: np.float32) -> int:
    """How many usable pixels have more than `least` in all sets. modulations: (K, n). usable: (n,)."""
    lit, count = usable.copy(), 0
    for k in range(modulations.shape[0]):
        for i in range(usable.size):
            lit[i] &= modulations[k, i] > least
    for i in range(usable.size):
        count += lit[i]
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
    folded: NDArray[np.float64],
    floor: float,
    found: NDArray[np.float64],
) -> None:
    """What is left of each step up the ladder (`agreement.remainders_of`), in bins of pixels by the noise it has there.

    Args:
        phases, cycles2: (K, n) float32. combinations: (J, K). frequencies: (J,). errors2: (J - 1, K).
        centre: see `agreement.agreement`. folded: (2, m) sigmas and medians, rising (`agreement.folded_medians`).
        floor: least systematic sigma.
        found: (J - 1, 4) float64, written: expected sigma, systematic sigma, offset and agreement of `Remainder`.
    """
    steps, sets, size = errors2.shape[0], errors2.shape[1], phases.shape[1]
    if size < MIN_PIXELS:
        for j in range(steps):
            found[j, 0], found[j, 1], found[j, 2], found[j, 3] = 0.0, floor, 0.0, 0.0
        return
    absolute, remainder = np.empty(size), np.empty(size)
    variance, apart = np.empty(size, np.float32), np.empty(size, np.float32)
    first_rung(phases, combinations[0], frequencies[0] * centre, absolute)
    for j in range(steps):
        beat_of(phases, combinations[j + 1], remainder)
        ratio = frequencies[j + 1] / frequencies[j]
        step_up(absolute, remainder, ratio)
        for i in range(size):
            apart[i] = np.float32(abs(remainder[i]))
            variance[i] = np.float32(0)
        weight = 0.0
        for k in range(sets):
            weight += errors2[j, k]
            if errors2[j, k] != 0:
                for i in range(size):
                    variance[i] += errors2[j, k] * cycles2[k, i]
        x, y, by_noise = middles_of_bins(variance, apart, BINS, False)
        better = BINS // 2 * (size // BINS)
        cosine, sine = _mean_turn(remainder, by_noise[:better])
        found[j, 0] = np.sqrt(variance[by_noise[better // 2]])
        found[j, 1] = max(np.sqrt(max(_unexplained(x, y, folded), 0.0) / weight), floor)
        found[j, 2] = np.arctan2(sine, cosine) / (2 * np.pi)
        found[j, 3] = np.sqrt(cosine * cosine + sine * sine)


@kernel
def _unexplained(x: NDArray[np.float32], medians: NDArray[np.float32], folded: NDArray[np.float64]) -> float:
    """Variance over that expected, of bins: x, expected ones; medians of absolute remainders."""
    total, rest = 0.0, 0.0
    for b in range(x.size):
        # Sigma of a normal error folded into +-1/2 whose absolute value has this median; an even spread has 1/4.
        median = np.float64(medians[b])
        sigma = median / 0.6745 if median < folded[1, 0] else np.interp(median, folded[1], folded[0])
        # Weights 1 / y: a variance's own error grows with it.
        weight = 1 / max(sigma * sigma, 1e-12)
        total += weight
        rest += weight * (sigma * sigma - x[b])
    return rest / total


@kernel
def first_rung(
    phases: NDArray[np.float32], combination: NDArray[np.float64], middle: float, absolute: NDArray[np.float64]
) -> None:
    """Write the coarsest rung's absolute phase, (n,) cycles; middle: its phase at the field's centre."""
    beat_of(phases, combination, absolute)
    for i in range(absolute.size):
        absolute[i] -= np.rint(absolute[i] - middle)


@kernel
def beat_of(phases: NDArray[np.float32], combination: NDArray[np.float64], beat: NDArray[np.float64]) -> None:
    """Write one rung's phase, (n,) cycles."""
    beat[:] = 0
    for k in range(combination.size):
        if combination[k] != 0:
            for i in range(beat.size):
                beat[i] += combination[k] * phases[k, i]


@kernel
def step_up(absolute: NDArray[np.float64], beat: NDArray[np.float64], ratio: float) -> None:
    """From a rung to the next. absolute: (n,) cycles, changed to those of the next. beat: its phase, changed to what is
    left of the step. ratio: of its frequency to the one before."""
    for i in range(beat.size):
        psi = beat[i]
        difference = ratio * absolute[i] - psi
        order = np.rint(difference)
        beat[i] = difference - order
        absolute[i] = psi + order


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
