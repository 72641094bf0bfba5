"""How noisy a grey level is: shot and read noise as variance = read + per_level x level, in grey levels.

Estimated from what repeated or redundant frames leave (`fit_line`), and a cautious default for captures that leave
nothing. This file does not know where the residuals come from.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.decode.middles import middles_in_order, order_of
from scanner.kernel import kernel

ROUNDING_VARIANCE = 1 / 12
"""Variance of rounding to whole grey levels; no frame is better."""

DEFAULT_FULL_WELL_E = 10_000
"""Electrons at the top of the range of an industrial camera: for captures that show no noise of their own."""

DEFAULT_READ_SHARE = 0.004
"""Its read noise as a share of the range (1 grey level of 8 bits)."""

FEWEST = 100
"""Samples without which nothing is said of a camera's noise."""

CUT_SIGMAS = 2.5
"""Mean over 1-sigma, both as seen, from which on a pixel's noise is whole. Normal noise of mean m and sigma s, cut off
at 0, has the mean s (d P + p) and the variance s^2 ((d^2 + 1) P + d p - (d P + p)^2), where d = m / s, and P and p are
the normal distribution and its density at d (Tobin 1958). Their ratio grows with d, .68 at 0 and 2.52 at 2.5, where a
hundredth of the variance is lost: half of what the model is good to. Below, it is lost fast: a quarter at d = 1."""

_LEVELS = 12


@dataclass(frozen=True)
class NoiseModel:
    """Variance of one sample: read + per_level x its expected grey level, never below that of rounding."""

    read: float
    per_level: float
    measured: bool
    """from this capture, and not the default"""

    def variance(self, level: NDArray[np.float32]) -> NDArray[np.float32]:
        """Variance at expected grey levels `level`, any shape."""
        return np.asarray(np.maximum(self.read + self.per_level * level, ROUNDING_VARIANCE), dtype=np.float32)


def default_noise(max_value: int) -> NoiseModel:
    """The model for a camera of which nothing is known but its largest grey level."""
    return NoiseModel((DEFAULT_READ_SHARE * max_value) ** 2, max_value / DEFAULT_FULL_WELL_E, measured=False)


@kernel
def fit_line(level: NDArray[np.float32], squares: NDArray[np.float32], freedom: int) -> tuple[float, float]:
    """Variance at level 0, and per level, that fit the residuals of a capture.

    Args:
        level: (n,) float32 mean grey level, n >= FEWEST. squares: (n,) float32 sum of squared residuals.
        freedom: degrees of freedom of each sum, 1 or more.

    Medians in bins of equal count stand against pixels that moved or are mixed; the median of a chi-square variable of
    k degrees is k (1 - 2 / (9 k))^3 (Wilson and Hilferty 1931).

    Grey levels end at 0, and noise of pixels as dark as it is high is cut off there: those say nothing of it, and are
    left out where there are others (see CUT_SIGMAS).
    """
    return fit_line_in_order(order_of(level), level, squares, freedom)


@kernel
def fit_line_in_order(
    order: NDArray[np.int32], level: NDArray[np.float32], squares: NDArray[np.float32], freedom: int
) -> tuple[float, float]:
    """`fit_line` of those that `order` names, in the order of their levels."""
    # As many in each bin: up to eleven of the brightest are left out.
    per_freedom = freedom * (1 - 2 / (9 * freedom)) ** 3
    x, medians = middles_in_order(order, level, squares, _LEVELS, True)
    y = medians / per_freedom
    first = 0
    while first < _LEVELS and x[first] < CUT_SIGMAS * np.sqrt(max(y[first], ROUNDING_VARIANCE)):
        first += 1
    if 0 < first < _LEVELS:
        above, dark = CUT_SIGMAS * np.sqrt(max(y[first], ROUNDING_VARIANCE)), 0
        while dark < order.size and level[order[dark]] < above:
            dark += 1
        if order.size - dark >= FEWEST:
            x, medians = middles_in_order(order[dark:], level, squares, _LEVELS, True)
            y = medians / per_freedom
    # A variance's own error grows with it: weights 1 / y, one round of which is enough for two parameters.
    w = 1 / np.maximum(y, ROUNDING_VARIANCE)
    slope, read = 0.0, float(np.median(y))
    if x.max() - x.min() > 1:
        total = (w * w).sum()
        x0, y0 = (w * w * x).sum() / total, (w * w * y).sum() / total
        there = w * w * (x - x0)
        slope = (there * (y - y0)).sum() / (there * (x - x0)).sum()
        read = y0 - slope * x0
    if slope < 0:
        slope, read = 0.0, (w * y).sum() / w.sum()
    elif read < ROUNDING_VARIANCE:
        read = ROUNDING_VARIANCE
        slope = max((w * w * x * (y - read)).sum() / max((w * w * x * x).sum(), 1e-12), 0.0)
    return max(read, ROUNDING_VARIANCE), slope
