"""How far a scan's light is from the fringes that were meant: the overtones of each set, from a sample of pixels.

A response that is no line (gamma, a projector's picture modes) gives every fringe overtones whose phases follow its own
(Guo, He, Zhang 2004; Pan, Huang, Chiang 2006). With N shifts those of order 2 to N / 2 stand apart from the fringe, and
would be taken for noise: they are measured here, and what they explain of residuals can be taken off. Those of order
N - 1 and N + 1 cannot be told from the fringe and shift it N times a period: `scanner.decode.ripples` finds those.
Nothing here corrects a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.pmp_frames import AxisFits
from scanner.decode.ripples import RippleFit
from scanner.decode.spectra import (
    LEAST_PIXELS,
    MEANT_IMAGINARY,
    MEANT_REAL,
    ORDERS,
    POWER,
    SEEN_IMAGINARY,
    SEEN_REAL,
    SUMS,
)


@dataclass(frozen=True)
class SetHarmonics:
    """Overtones of one set as shares of its fringe's height B; None where its shifts do not show them."""

    frequency: float
    shifts: int
    second: float | None = None
    third: float | None = None
    fourth: float | None = None
    sigma: float | None = None
    """1-sigma of a share"""
    ripple_px: float | None = None
    """rms of the error that overtones which pass for the fringe put into this set's coordinates, projector px; None
    where the set has too many shifts for any, or where nothing contradicts it"""
    ripple: RippleFit | None = None

    def as_dict(self) -> dict[str, Any]:
        """For report.json."""
        return {**vars(self), "ripple": None if self.ripple is None else dict(vars(self.ripple))}


@dataclass(frozen=True)
class HeightWeights:
    """What takes samples to the heights of their orders, by sets.

    weights: (K, ORDERS, 2, N) float32 of the samples, to the real and imaginary part of each order's height, 0 where a
    set has fewer. kinds: (K, 3) intp: shifts; orders that they show, 0 of a set that lost frames; the order N / 2,
    whose height is real, or 0.
    """

    weights: NDArray[np.float32]
    kinds: NDArray[np.intp]

    @classmethod
    def of(cls, fits: AxisFits) -> HeightWeights:
        """Of sets that are whole; their order N / 2 is turned so that its height is real: a cosine and a sine of it
        cannot be told apart."""
        return _height_weights(tuple(tuple(alpha.tolist()) for alpha in fits.angles))


@lru_cache(maxsize=32)
def _height_weights(angles: tuple[tuple[float, ...], ...]) -> HeightWeights:
    # Every scan of a rig asks for the same, and nobody writes into it.
    weights = np.zeros((len(angles), ORDERS, 2, max(map(len, angles))), np.float32)
    kinds = np.zeros((len(angles), 3), np.intp)
    for k, of_set in enumerate(angles):
        shifts, alpha = len(of_set), np.array(of_set)
        orders = min(ORDERS, shifts // 2)
        folded = shifts // 2 if shifts % 2 == 0 and 2 <= shifts // 2 <= ORDERS else 0
        turns = np.arange(1, orders + 1)[:, None] * alpha
        weights[k, :orders, :, :shifts] = np.stack([np.cos(turns), -np.sin(turns)], axis=1) * (2 / max(shifts, 1))
        if folded:
            weights[k, folded - 1, 0, :shifts] = np.cos(folded * (alpha - alpha[0])) / shifts
            weights[k, folded - 1, 1] = 0
        kinds[k] = shifts, orders, folded
    return HeightWeights(weights, kinds)


@dataclass(frozen=True)
class SpectraSums:
    """What `sum_sets` writes for K sets."""

    sums: NDArray[np.float64]
    levels: NDArray[np.float64]
    ratios: NDArray[np.complex128]

    @classmethod
    def empty(cls, sets: int) -> SpectraSums:
        """To be written."""
        return cls(np.zeros((sets, ORDERS + 1, SUMS)), np.zeros(sets), np.zeros((sets, ORDERS), np.complex128))

    def spectra(self, heights: HeightWeights, count: int) -> tuple[SetSpectrum | None, ...]:
        """By set, of `count` pixels; None of one that lost frames, and where too few pixels were asked."""
        if count < LEAST_PIXELS:
            return (None,) * len(self.sums)
        kinds = heights.kinds.tolist()
        return tuple(
            self._spectrum(k, shifts, orders, folded, count) if orders else None
            for k, (shifts, orders, folded) in enumerate(kinds)
        )

    def _spectrum(self, k: int, shifts: int, orders: int, folded: int, count: int) -> SetSpectrum:
        rows, ratios = self.sums[k].tolist(), self.ratios[k].tolist()
        left = tuple(_left(rows[m], ratios[m - 1], m == folded) / count for m in range(2, orders + 1))
        return SetSpectrum(shifts, tuple(ratios[1:orders]), left, rows[1][POWER] / count, float(self.levels[k]) / count)


@dataclass(frozen=True)
class SetSpectrum:
    """One set over the pixels that were asked.

    ratios: complex height of orders 2, 3, ... over the fringe's, as common to all pixels. left: mean of what they do
    not explain of each order's height, over the level. power: mean square of the fringe's height, grey levels. level:
    mean of A over that of all sets.
    """

    shifts: int
    ratios: tuple[complex, ...]
    left: tuple[complex, ...]
    power: float
    level: float


def told_of(frequency: float, shifts: int, spectrum: SetSpectrum | None, variance: float, count: int) -> SetHarmonics:
    """What a spectrum says, for people. variance: of one sample; count: pixels asked."""
    if spectrum is None or not spectrum.ratios:
        return SetHarmonics(frequency, shifts)
    sigma = float(np.sqrt(variance * 2 / (shifts * spectrum.power * count))) if spectrum.power > 0 else None
    shares: list[float | None] = [float(abs(ratio)) for ratio in spectrum.ratios]
    second, third, fourth = (*shares, None, None, None)[:3]
    return SetHarmonics(frequency, shifts, second, third, fourth, sigma)


def _left(sums: list[float], ratio: complex, folded: bool) -> complex:
    meant = ratio * complex(sums[MEANT_REAL], sums[MEANT_IMAGINARY])
    return complex(sums[SEEN_REAL], sums[SEEN_IMAGINARY]) - (meant.real if folded else meant)


def named_ripple(harmonics: SetHarmonics, ripple: RippleFit | None) -> SetHarmonics:
    """With what passes for the fringe: with three shifts the second overtone (and fourth), with four the third."""
    if ripple is None:
        return harmonics
    told = replace(harmonics, ripple_px=ripple.rms_px, ripple=ripple)
    if harmonics.shifts == 3:
        return replace(told, second=ripple.share)
    return replace(told, third=ripple.share) if harmonics.shifts == 4 else told
