"""Overtones that pass for a set's fringe: by how the frequencies of a scan contradict one another N times a period.

With N shifts, overtones of order N - 1 and N + 1 move the fringe's phase N times a period, and no residual shows them.
What unwrapping leaves, the remainder, does: it is the sum of the sets' errors, each times its weight. A coarse set's
error weighs as much as the ratio of the frequencies, so that it is told by far more precisely than the finest set's
own; but all sets went through one response, and their ripples are the same share of a period where their shifts are as
many, but for what blur takes from the finer ones. That one ripple is fitted here. Nothing here corrects a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.decode.unwrapping import Ladder

FEWEST_SHIFTS_UNHARMED = 6
"""From these on, overtones of a response shift no fringe by much: the fifth is the first that would."""

LEAST_PIXELS = 128
"""Fewer say nothing of a whole scan's ripple."""

LEAST_PERIODS = 4.0
"""Over the projector: what surfaces throw at one another moves fringes of fewer as smoothly as a ripple would."""

ROUNDING_CYCLES = 0.0005
"""Rms phase error that projected images of 8 bits have with three shifts: an error of sqrt(1/12) / 255 of the input, by
the slope of a gamma of 2.3 (rms 1.6 over a fringe), times sqrt(2/3) over the fringe's height of .48, over 2 pi. All of
it repeats N times a period; it is spread over the period / (2 N) orders that the pixels can show."""

NEAR_CYCLES = 0.3
"""From the median remainder: farther ones are of another order, and tell nothing of a ripple."""

_WHOLE = 0.02
"""Of a ratio: orders of two sets that are nearer than this to one another run along together over the projector."""


@dataclass(frozen=True)
class RippleFit:
    """Overtones that pass for a set's fringe: its error is cosine_px cos(N phase) + sine_px sin(N phase).

    share: of the fringe's height. sigma_px: 1-sigma of either coefficient, projector px.
    """

    share: float
    cosine_px: float
    sine_px: float
    sigma_px: float

    @property
    def rms_px(self) -> float:
        """Over all phases."""
        return float(np.hypot(self.cosine_px, self.sine_px) / np.sqrt(2))


@dataclass(frozen=True)
class _Told:
    """What the remainders tell of one set alone: cycles of its phase, and the variance of either coefficient."""

    ripple: complex
    variance: float


def ripples(
    ladder: Ladder,
    remainders: Sequence[NDArray[np.float64]],
    phases: NDArray[np.float32],
    heights: NDArray[np.float32],
    shifts: Sequence[int],
    frequencies: Sequence[float],
    along: int,
) -> list[RippleFit | None]:
    """By set, what of it repeats N times a period.

    Args:
        remainders: (n,) of each step of the ladder, cycles. phases: (K, n) cycles. heights: (K,) typical B of each
            set, which tells the blur. frequencies: by set, cycles over the projector. along: its pixels.

    Returns:
        None for a set of many shifts, one that no other contradicts, and where there are too few pixels.
    """
    periods = [along / f for f in frequencies]
    told = _by_set(ladder, remainders, phases, shifts, periods)
    found: list[RippleFit | None] = [None] * len(shifts)
    sharpest = max(float(heights[int(np.argmax(periods))]), 1e-9)
    for count in set(shifts):
        alike = [k for k, n in enumerate(shifts) if n == count and k in told]
        if not alike:
            continue
        # A Gaussian blur that leaves m of a fringe leaves m^(o^2) of its overtone o: m^(o^2 - 1) of the share.
        left = {k: min(float(heights[k]) / sharpest, 1.0) ** ((count - 1) ** 2 - 1) for k in alike}
        asked = [k for k in alike if frequencies[k] >= LEAST_PERIODS] or alike
        common, variance = _common([told[k] for k in asked], [left[k] for k in asked])
        for k in alike:
            ripple, px = left[k] * common, periods[k]
            sigma_px = left[k] * float(np.sqrt(variance)) * px
            found[k] = RippleFit(float(2 * np.pi * abs(ripple)), ripple.real * px, ripple.imag * px, sigma_px)
    return found


def _common(told: Sequence[_Told], left: Sequence[float]) -> tuple[complex, float]:
    """The unblurred ripple of all, and the variance of either coefficient. left: what blur leaves of each."""
    m, v = np.array(left), np.array([one.variance for one in told])
    seen = np.array([one.ripple for one in told])
    weight = max(float((m * m / v).sum()), 1e-30)
    common = complex((m * seen / v).sum() / weight)
    # Sets that differ by more than their variances say are no better than their differences (Birge 1932).
    freedom = 2 * (len(told) - 1)
    excess = float((np.abs(seen - m * common) ** 2 / v).sum() / freedom) if freedom else 1.0
    return common, max(excess, 1.0) / weight


def _by_set(
    ladder: Ladder,
    remainders: Sequence[NDArray[np.float64]],
    phases: NDArray[np.float32],
    shifts: Sequence[int],
    periods: Sequence[float],
) -> dict[int, _Told]:
    """What all steps together tell of each harmed set: least squares, each step weighted by its noise."""
    harmed = [k for k, n in enumerate(shifts) if 3 <= n < FEWEST_SHIFTS_UNHARMED and np.any(ladder.errors[:, k] != 0)]
    if not harmed:  # as where one set lost a frame, and the others have many shifts
        return {}
    width = 2 * len(harmed)
    normal, right = np.zeros((width, width)), np.zeros(width)
    spreads: list[float] = []
    for remainder, errors in zip(remainders, ladder.errors, strict=True):
        near = np.abs(remainder - np.median(remainder)) < NEAR_CYCLES if remainder.size else np.zeros(0, np.bool_)
        if np.count_nonzero(near) < LEAST_PIXELS:
            spreads.append(float("inf"))
            continue
        columns = []
        for k in harmed:
            turns = 2 * np.pi * shifts[k] * phases[k][near].astype(np.float64)
            columns += [errors[k] * np.cos(turns), errors[k] * np.sin(turns)]
        design, values = np.stack(columns, axis=1), remainder[near]
        design -= design.mean(axis=0)
        values = values - values.mean()
        spreads.append(max(float(np.std(values)), 1e-9))
        normal += design.T @ design / spreads[-1] ** 2
        right += design.T @ values / spreads[-1] ** 2
    if not np.isfinite(spreads).any():
        return {}
    covariance = np.linalg.pinv(normal)
    solved, noise = covariance @ right, np.diag(covariance)
    return {
        k: _Told(
            complex(solved[2 * i], solved[2 * i + 1]),
            float(noise[2 * i : 2 * i + 2].mean()) + _rounding(ladder, k, periods, np.array(spreads)),
        )
        for i, k in enumerate(harmed)
    }


def _rounding(ladder: Ladder, k: int, periods: Sequence[float], spreads: NDArray[np.float64]) -> float:
    """Variance of a coefficient of set k by the rounding of images: its own, and that of coarser sets.

    A coarse set whose period is a whole number of this one's shows orders of its own in this one's place, and weighs
    more: it cannot be told from this one's ripple.
    """
    own = ROUNDING_CYCLES**2 * 6 / np.array(periods)
    asked = np.abs(ladder.errors[:, k]) / spreads
    parts = asked**2 / max(float((asked**2).sum()), 1e-30)
    variance = float(own[k])
    for errors, part in zip(ladder.errors, parts, strict=True):
        for other, period in enumerate(periods):
            times = period / periods[k]
            if errors[k] != 0 and other != k and abs(times - round(times)) < _WHOLE:
                variance += float((part * errors[other] / errors[k]) ** 2 * own[other])
    return variance
