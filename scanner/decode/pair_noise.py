"""The noise of a PMP scan whose fits leave no residual (three shifts), from pixels side by side.

What is left of each step up the ladder would be alike in neighbours but for noise. How much it differs, over what the
noise of one sample makes of it there, is that noise's variance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.decode.middles import order_of
from scanner.decode.noise import ROUNDING_VARIANCE, NoiseModel, default_noise, fit_line_in_order
from scanner.decode.pmp_plan import AxisPlan, plan_axis, whole_sets
from scanner.decode.sample_kernels import MIN_PIXELS, beat_of, first_rung, step_up
from scanner.kernel import kernel
from scanner.patterns import PmpPattern

PAIR_DISTANCE = 2
"""Camera pixels between the two of a pair: near enough to share what is systematic, too far to share a blur's noise."""

UNFOLDED_SIGMA = 0.15
"""Predicted sigma of a pair's difference, cycles, up to which it stays within half a cycle (3.3 sigma)."""

_ROUNDS = 3
"""Of choosing such pairs by the noise model and fitting it to them; the first choice is by the default model."""

_PER_TURN2 = np.float32(1 / (4 * np.pi**2))


def noise_of_pairs(
    plan: AxisPlan,
    phases: NDArray[np.float32],
    modulations: NDArray[np.float32],
    mean: NDArray[np.float32],
    good: NDArray[np.bool_],
    max_value: int,
) -> NoiseModel:
    """The noise model under which remainders differ between pixels side by side as much as they do.

    Args:
        phases, modulations: (K, R, L) of runs of pixels, cycles and grey levels. mean: (R, L) grey level. good: (R, L)
            bool, which have light. max_value: largest grey level of the camera.

    Returns:
        The camera's default where there are too few pairs, or only one rung.
    """
    model, sets = default_noise(max_value), len(phases)
    squares, per_sample, level = _pairs(
        phases.reshape(sets, -1), modulations.reshape(sets, -1), mean, good, plan.gains, plan.combinations,
        plan.ladder.frequencies, plan.errors2, plan.centre,
    )  # fmt: skip
    found = np.array([model.read, model.per_level])
    measured = _fit(squares, per_sample, level, found)
    return NoiseModel(float(found[0]), float(found[1]), measured=True) if measured else model


def warm_up() -> None:
    """Compile what only scans of three shifts come to."""
    pattern = PmpPattern(("y",), (1.0, 8.0), (3, 3))
    plan, of_sets, one = plan_axis(pattern, 64, whole_sets(pattern)), np.ones((2, 1, 4), np.float32), (1, 4)
    noise_of_pairs(plan, of_sets, of_sets, np.ones(one, np.float32), np.ones(one, np.bool_), 255)


@kernel
def _pairs(
    phases: NDArray[np.float32],
    modulations: NDArray[np.float32],
    mean: NDArray[np.float32],
    good: NDArray[np.bool_],
    gains: NDArray[np.float32],
    combinations: NDArray[np.float64],
    frequencies: NDArray[np.float64],
    errors2: NDArray[np.float32],
    centre: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Of pairs of good pixels, by steps: (J - 1, m) squared differences, cycles squared, and their variances over that
    of one sample; (m,) grey level."""
    steps, sets, size = errors2.shape[0], errors2.shape[1], mean.size
    runs, last = mean.shape[0], max(mean.shape[1] - PAIR_DISTANCE, 0)
    pairs = 0
    for r in range(runs):
        for i in range(last):
            pairs += good[r, i] & good[r, i + PAIR_DISTANCE]
    squares, per_sample = np.empty((steps, pairs), np.float32), np.empty((steps, pairs), np.float32)
    level, absolute, left = np.empty(pairs, np.float32), np.empty(size), np.empty(size)
    own = np.empty(size, np.float32)
    first_rung(phases, combinations[0], frequencies[0] * centre, absolute)
    for j in range(steps):
        beat_of(phases, combinations[j + 1], left)
        step_up(absolute, left, frequencies[j + 1] / frequencies[j])
        own[:] = 0
        for k in range(sets):
            weight = errors2[j, k] * gains[k] * _PER_TURN2
            for i in range(size):
                own[i] += weight / (modulations[k, i] * modulations[k, i])
        to = 0
        for r in range(runs):
            for i in range(last):
                if good[r, i] & good[r, i + PAIR_DISTANCE]:
                    one, other = r * mean.shape[1] + i, r * mean.shape[1] + i + PAIR_DISTANCE
                    apart = left[one] - left[other]
                    apart -= np.rint(apart)
                    squares[j, to], per_sample[j, to] = apart * apart, own[one] + own[other]
                    level[to] = (mean[r, i] + mean[r, i + PAIR_DISTANCE]) * np.float32(0.5)
                    to += 1
    return squares, per_sample, level


@kernel
def _fit(
    squares: NDArray[np.float32],
    per_sample: NDArray[np.float32],
    level: NDArray[np.float32],
    found: NDArray[np.float64],
) -> bool:
    """Fit the model to pairs that it leaves unfolded; False where there are too few from the first.

    Args:
        squares ... level: of `_pairs`. found: (2,) variance at level 0, and per level, changed.
    """
    steps, by_level = squares.shape[0], order_of(level)
    # In the order of levels, the steps of a pair one after another: sorted once, and read straight on.
    size = squares.size
    at, spread, ratio = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    for n in range(level.size):
        i = by_level[n]
        for j in range(steps):
            to = n * steps + j
            at[to], spread[to], ratio[to] = level[i], per_sample[j, i], squares[j, i] / per_sample[j, i]
    x, y = np.empty(size + 1, np.float32), np.empty(size + 1, np.float32)
    order, used = np.arange(size).astype(np.int32), np.zeros(size, np.bool_)
    limit, measured = np.float32(UNFOLDED_SIGMA**2), False
    for _ in range(_ROUNDS):
        read, per_level, least = np.float32(found[0]), np.float32(found[1]), np.float32(ROUNDING_VARIANCE)
        count, others = 0, 0
        for n in range(size):
            use = spread[n] * max(read + per_level * at[n], least) < limit
            others += use != used[n]
            used[n] = use
            # Without a branch: the next one takes the place of one that is not used.
            x[count], y[count] = at[n], ratio[n]
            count += use
        if count < MIN_PIXELS or others == 0:
            return measured
        found[0], found[1] = fit_line_in_order(order[:count], x, y, 1)
        measured = True
    return measured
