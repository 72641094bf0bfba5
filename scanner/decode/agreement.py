"""How noisy the phases of a scan really are: how well neighbouring rungs of the ladder agree over the image.

What is left of each unwrapping step, the remainder, is a phase error seen twice, whatever its cause. Its spread over a
sample of pixels says by how much this scan's noise differs from the noise model, and what no averaging takes away
(response, interreflection, blur). Whether frames stand in their right order is not judged here: `scanner.sequencer`
does that, before anything is decoded.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from scanner.decode.unwrapping import Ladder

MIN_NOISE_SCALE, MAX_NOISE_SCALE = 0.3, 4.0
"""How far the remainders may move the noise model: a noise model measured in the same capture is not raised at all,
because what a remainder has beyond it is systematic."""

MIN_PIXELS = 400
"""Fewer usable pixels than this say nothing."""

_NOISE_BINS = 8


@dataclass(frozen=True)
class Remainder:
    """One unwrapping step over the whole image."""

    low: float
    high: float
    """frequencies of its two rungs, cycles over the projector"""
    expected_sigma: float
    """by the noise model, cycles, median of the better half of the sample"""
    scale: float
    """random sigma over that of the noise model"""
    systematic: float
    """sigma of what remains where noise is least, cycles of one set's phase: response, interreflection, blur"""
    offset: float
    """circular mean, cycles"""
    agreement: float
    """length of the mean vector, 1 = all pixels alike"""
    pixels: int


def agreement(
    ladder: Ladder,
    phases: NDArray[np.float32],
    cycles2: NDArray[np.float32],
    centre: float,
    floor_cycles: float,
    measured: bool,
) -> list[Remainder]:
    """How well neighbouring rungs agree, over a sample of usable pixels.

    Args:
        phases: (K, n) cycles. cycles2: (K, n) expected variance of each. centre: the field's centre, fraction of it.
        floor_cycles: least systematic sigma of a set's phase. measured: the noise model is this capture's own.
    """
    m, f = ladder.combinations.astype(np.float64), ladder.frequencies
    absolute = m[0] @ phases
    absolute -= np.rint(absolute - f[0] * centre)
    found = []
    for j in range(len(f) - 1):
        psi = m[j + 1] @ phases
        difference = f[j + 1] / f[j] * absolute - psi
        order = np.rint(difference)
        errors2 = ladder.errors[j] ** 2
        floor = (float(errors2.sum()), floor_cycles)
        found.append(_remainder(f[j], f[j + 1], difference - order, errors2 @ cycles2, floor, measured))
        absolute = psi + order
    return found


def _remainder(
    low: float,
    high: float,
    remainder: NDArray[np.float64],
    variance: NDArray[np.float64],
    floor: tuple[float, float],
    measured: bool,
) -> Remainder:
    weight, least = floor
    if remainder.size < MIN_PIXELS:
        return Remainder(float(low), float(high), 0.0, 1.0, least, 0.0, 0.0, int(remainder.size))
    bins = np.array_split(np.argsort(variance), _NOISE_BINS)
    x = np.array([np.median(variance[b]) for b in bins])
    y = np.array([_sigma_of_median(float(np.median(np.abs(remainder[b])))) ** 2 for b in bins])
    scale2, rest = _line(x, y, upper=1.0 if measured else MAX_NOISE_SCALE**2)
    better = np.concatenate(bins[: _NOISE_BINS // 2])
    vector = np.exp(2j * np.pi * remainder[better]).mean()
    return Remainder(
        float(low),
        float(high),
        float(np.sqrt(np.median(variance[better]))),
        float(np.sqrt(scale2)),
        max(float(np.sqrt(rest / weight)), least),
        float(np.angle(vector) / (2 * np.pi)),
        float(np.abs(vector)),
        int(remainder.size),
    )


def _line(x: NDArray[np.float64], y: NDArray[np.float64], upper: float) -> tuple[float, float]:
    # y = slope x + rest, slope within bounds, rest not negative, weights 1 / y: a variance's error grows with it.
    w = 1 / np.maximum(y, 1e-12)
    slope = float(np.polyfit(x, y, 1, w=w)[0]) if np.ptp(x) > 1e-3 * x.mean() else upper
    through_zero = float(np.sum(w**2 * x * y) / np.sum(w**2 * x * x))
    slope = float(np.clip(min(slope, through_zero), MIN_NOISE_SCALE**2, upper))
    return slope, max(float(np.average(y - slope * x, weights=w)), 0.0)


def _sigma_of_median(median: float) -> float:
    # Sigma of a normal error folded into +-1/2 whose absolute value has this median; an even spread has 1/4.
    sigmas, medians = _folded_medians()
    return median / 0.6745 if median < medians[0] else float(np.interp(median, medians, sigmas))


@cache
def _folded_medians() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    sigmas = np.linspace(0.05, 0.5, 46)
    x = np.linspace(0, 0.5, 2001)
    folds = np.arange(-3, 4)[:, None]
    medians = []
    for sigma in sigmas:
        inside = (ndtr((x + folds) / sigma) - ndtr((-x + folds) / sigma)).sum(axis=0)
        medians.append(float(np.interp(0.5, inside, x)))
    return sigmas, np.maximum.accumulate(np.array(medians))
