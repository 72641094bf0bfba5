"""How far a scan's light is from the fringes that were meant: the overtones of each set, from a sample of pixels.

A response that is no line (gamma, a projector's picture modes) gives every fringe overtones whose phases follow its own
(Guo, He, Zhang 2004; Pan, Huang, Chiang 2006). With N shifts those of order 2 to N / 2 stand apart from the fringe, and
would be taken for noise: they are measured here, and what they explain of residuals can be taken off. Those of order
N - 1 and N + 1 cannot be told from the fringe and shift it N times a period: `scanner.decode.ripples` finds those.
Nothing here corrects a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.pmp_frames import AxisFrames
from scanner.decode.ripples import RippleFit
from scanner.decode.spectra import (
    AA,
    AB,
    BB,
    IMAGINARY,
    MEANT_IMAGINARY,
    MEANT_REAL,
    ORDERS,
    POWER,
    REAL,
    SEEN_IMAGINARY,
    SEEN_REAL,
    SUMS,
    sum_spectra,
)

MOST_SHARE = 0.45
"""Of an overtone in its fringe: gamma 3 gives .4. And each order is lower than the one before, from LEAST_SHARE on."""

LEAST_SHARE = 0.02

LEAST_PIXELS = 128
"""Fewer say nothing of a whole scan's overtones."""


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

    @property
    def of_response(self) -> bool:
        """Whether a response could have made them; frames that changed places and scenes that move make others."""
        shares = [abs(ratio) for ratio in self.ratios]
        rising = any(high > max(low, LEAST_SHARE) for low, high in pairwise(shares))
        return bool(shares) and max(shares) < MOST_SHARE and not rising

    @property
    def energy(self) -> float:
        """What a response's overtones add to a pixel's squared residual on the average, grey levels squared."""
        if not self.of_response:
            return 0.0
        # Of order N / 2 half is seen, and weighs twice.
        return self.power * self.shifts / 2 * sum(abs(ratio) ** 2 for ratio in self.ratios)


def spectra_of(
    frames: AxisFrames,
    runs: NDArray[np.intp],
    every: int,
    good: NDArray[np.bool_],
    level: NDArray[np.float32],
) -> tuple[SetSpectrum | None, ...]:
    """Of each set; None of one that lost frames, and where too few pixels are good.

    Args:
        runs: (R,) first pixels, of which one in `every` is asked. good: (R, L) pixels with light, not clipped.
        level: (R, L) mean grey level.
    """
    count = int(np.count_nonzero(good[::every]))
    found: list[SetSpectrum | None] = []
    like = frames.like
    for k, alpha in enumerate(frames.angles):
        if count < LEAST_PIXELS or not len(alpha):
            found.append(None)
            continue
        first, shifts = int(frames.starts[k]), len(alpha)
        sums = np.zeros((ORDERS + 1, SUMS))
        weights = height_weights(alpha)
        total = sum_spectra(
            frames.addresses[first : first + shifts], like, weights, _folded(shifts),
            runs, good.shape[1], every, good, level, sums,
        )  # fmt: skip
        # A few numbers: without arrays.
        rows, orders = sums.tolist(), range(2, len(weights) + 1)
        ratios = tuple(_ratio(rows[m], 2 * m == shifts) for m in orders)
        left = tuple(_left(rows[m], ratio, 2 * m == shifts) / count for m, ratio in zip(orders, ratios, strict=True))
        found.append(SetSpectrum(shifts, ratios, left, rows[1][POWER] / count, total / count))
    return tuple(found)


def height_weights(alpha: NDArray[np.float64]) -> NDArray[np.float32]:
    """(M, 2, N) of a set's samples, to the real and imaginary parts of each order's height.

    The order N / 2 is turned so that its height is real: a cosine and a sine of it cannot be told apart.
    """
    return _height_weights(tuple(alpha.tolist()))


@lru_cache(maxsize=64)
def _height_weights(angles: tuple[float, ...]) -> NDArray[np.float32]:
    # Every scan of a rig asks for the same.
    alpha, shifts = np.array(angles), len(angles)
    turns = np.arange(1, min(ORDERS, shifts // 2) + 1)[:, None] * alpha
    weights = np.stack([np.cos(turns), -np.sin(turns)], axis=1) * (2 / shifts)
    if folded := _folded(shifts):
        weights[folded - 1] = np.stack([np.cos(folded * (alpha - alpha[0])), np.zeros(shifts)]) / shifts
    return weights.astype(np.float32)


def explained_by(
    spectra: Sequence[SetSpectrum | None], frames: AxisFrames, pixels: NDArray[np.intp]
) -> NDArray[np.float32]:
    """(n,) float32: what overtones are of the squared residuals at `pixels`, grey levels squared."""
    explained = np.zeros(pixels.size, np.float32)
    for k, (spectrum, alpha) in enumerate(zip(spectra, frames.angles, strict=True)):
        if spectrum is None or not spectrum.of_response:
            continue
        first, shifts = int(frames.starts[k]), len(alpha)
        samples = np.stack([frames.frames[first + n].reshape(-1)[pixels] for n in range(shifts)]).astype(np.float32)
        weights = height_weights(alpha)
        parts = (weights.reshape(-1, shifts) @ samples).reshape(len(weights), 2, -1)
        heights = parts[:, 0] + np.complex64(1j) * parts[:, 1]
        meant = heights[0]
        turn = meant / np.maximum(np.abs(meant), np.float32(1e-12))
        for order, ratio in enumerate(spectrum.ratios, start=2):
            meant = meant * turn
            there = meant * np.complex64(ratio)
            weight = np.float32(shifts / 2)
            if 2 * order == shifts:
                there, weight = there.real, np.float32(shifts)
            explained += weight * (2 * (np.conj(there) * heights[order - 1]).real - np.abs(there) ** 2)
    return explained


def told_of(frequency: float, shifts: int, spectrum: SetSpectrum | None, variance: float, count: int) -> SetHarmonics:
    """What a spectrum says, for people. variance: of one sample; count: pixels asked."""
    if spectrum is None or not spectrum.ratios:
        return SetHarmonics(frequency, shifts)
    sigma = float(np.sqrt(variance * 2 / (shifts * spectrum.power * count))) if spectrum.power > 0 else None
    shares: list[float | None] = [float(abs(ratio)) for ratio in spectrum.ratios]
    second, third, fourth = (*shares, None, None, None)[:3]
    return SetHarmonics(frequency, shifts, second, third, fourth, sigma)


def _folded(shifts: int) -> int:
    return shifts // 2 if shifts % 2 == 0 and 2 <= shifts // 2 <= ORDERS else 0


def _ratio(sums: list[float], folded: bool) -> complex:
    """The ratio that explains most of an order's height."""
    if not folded:
        return complex(sums[REAL], sums[IMAGINARY]) / max(sums[POWER], 1e-12)
    aa, ab, bb = sums[AA], sums[AB], sums[BB]
    determinant = aa * bb - ab * ab
    if determinant < 1e-9 * aa * bb:
        return 0j
    real, imaginary = bb * sums[REAL] - ab * sums[IMAGINARY], aa * sums[IMAGINARY] - ab * sums[REAL]
    return complex(real / determinant, imaginary / determinant)


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
