"""How noisy a grey level is: shot and read noise as variance = read + per_level x level, in grey levels.

Estimated from what repeated or redundant frames leave (`fit_noise`), and a cautious default for captures that leave
nothing. This file does not know where the residuals come from.
"""

from __future__ import annotations

from dataclasses import dataclass
from operator import mul
from statistics import median

import numpy as np
from numpy.typing import NDArray

from scanner.decode.middles import middles_of_bins

ROUNDING_VARIANCE = 1 / 12
"""Variance of rounding to whole grey levels; no frame is better."""

DEFAULT_FULL_WELL_E = 10_000
"""Electrons at the top of the range of an industrial camera: for captures that show no noise of their own."""

DEFAULT_READ_SHARE = 0.004
"""Its read noise as a share of the range (1 grey level of 8 bits)."""

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


def fit_noise(level: NDArray[np.float32], squares: NDArray[np.float32], freedom: int, max_value: int) -> NoiseModel:
    """The model that fits the residuals of this capture.

    Args:
        level: (n,) float32 mean grey level. squares: (n,) float32 sum of squared residuals.
        freedom: degrees of freedom of each sum. max_value: largest grey level of the camera.

    Medians in bins of equal count stand against pixels that moved or are mixed; the median of a chi-square variable of
    k degrees is k (1 - 2 / (9 k))^3 (Wilson and Hilferty 1931). Under 100 samples, or no freedom, give the default.
    """
    if freedom < 1 or level.size < 100:
        return default_noise(max_value)
    # As many in each bin: up to eleven of the brightest are left out.
    levels, medians, _ = middles_of_bins(level, squares, _LEVELS, True)
    # A dozen numbers: without arrays.
    per_freedom = freedom * (1 - 2 / (9 * freedom)) ** 3
    x, y = levels.tolist(), [of_bin / per_freedom for of_bin in medians.tolist()]
    # A variance's own error grows with it: weights 1 / y, one round of which is enough for two parameters.
    w = [1 / max(of_bin, ROUNDING_VARIANCE) for of_bin in y]
    slope, read = _line(x, y, [one * one for one in w]) if max(x) - min(x) > 1 else (0.0, median(y))
    if slope < 0:
        slope, read = 0.0, _dot(w, y) / sum(w)
    elif read < ROUNDING_VARIANCE:
        read = ROUNDING_VARIANCE
        there = [a * a * b for a, b in zip(w, x, strict=True)]
        slope = max(_dot(there, [of_bin - read for of_bin in y]) / max(_dot(there, x), 1e-12), 0.0)
    return NoiseModel(max(read, ROUNDING_VARIANCE), slope, measured=True)


def _line(x: list[float], y: list[float], weights: list[float]) -> tuple[float, float]:
    """Slope and value at 0 of the line with the least weighted squares."""
    total = sum(weights)
    x0, y0 = _dot(weights, x) / total, _dot(weights, y) / total
    there = [w * (at - x0) for w, at in zip(weights, x, strict=True)]
    slope = _dot(there, [of_bin - y0 for of_bin in y]) / _dot(there, [at - x0 for at in x])
    return slope, y0 - slope * x0


def _dot(a: list[float], b: list[float]) -> float:
    return float(sum(map(mul, a, b)))
