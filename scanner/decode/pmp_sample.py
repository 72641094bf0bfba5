"""What a sample of pixels tells about a whole PMP scan: its noise, its light, how well its frequencies agree.

A few thousand pixels are fitted before the pass over all of them, so that the pass knows every threshold when it
begins. Runs of neighbouring pixels lie spread over the image: what is read of a frame then is little, and pixels side
by side can be compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanner.decode.agreement import folded_medians
from scanner.decode.harmonics import SetSpectrum, SpectraSums
from scanner.decode.middles import nth_of
from scanner.decode.noise import ROUNDING_VARIANCE, NoiseModel, default_noise
from scanner.decode.pair_noise import noise_of_pairs
from scanner.decode.pmp_frames import AxisFrames
from scanner.decode.pmp_plan import AxisPlan
from scanner.decode.pmp_sums import fit_runs
from scanner.decode.runs import runs_of, spread_runs
from scanner.decode.sample_kernels import judge, look, mark_good
from scanner.decode.spectra import take_explained_off

SIZE = 4096
"""Pixels of a first sample: the median of a twelfth of it is good to 5 %, its noise model to 2 %."""

PAIRS_SIZE = 8 * SIZE
"""The same where fits leave no residual (three shifts): pairs of pixels tell read and shot noise apart so much worse
that with SIZE dark pixels had a tenth too little sigma in one scan of three."""

ENOUGH = 2048
"""Pixels with light in them that a sample should have; larger ones are taken until it has, or there are no more. Those
of a run share their surface: fewer are a handful of places, and what these have in common is not the scene's."""

FINE_RUN = 8
"""Pixels of a run where places count more than memory read: five hundred phases of fringes that run along rows"""

THINNED = 8
"""Of the sample's runs, one in so many is asked for overtones: five hundred pixels tell a share to .0005."""

_GROWTH = 8
PRIOR_FREEDOM = 8.0
"""Weight of the scan's noise model against a pixel's own residual, in degrees of freedom (conjugate prior)."""


@dataclass(frozen=True)
class Sample:
    """Fits at R runs of L pixels.

    phases, modulations: (K, R, L) float32, cycles and grey levels. mean, residual: (R, L) float32, A and the sum of
    squared residuals. usable: (R, L) bool, not clipped. gains, freedom: of `AxisFrames`. max_value: of the camera.
    runs: (R,) first pixels. prior: weight of the scan's noise model against a pixel's residual. overtones: what they
    add to a pixel's squared residual on the average, grey levels squared, where it is not next to nothing.
    """

    phases: NDArray[np.float32]
    modulations: NDArray[np.float32]
    mean: NDArray[np.float32]
    residual: NDArray[np.float32]
    usable: NDArray[np.bool_]
    gains: NDArray[np.float32]
    freedom: int
    max_value: int
    runs: NDArray[np.intp]
    prior: float = PRIOR_FREEDOM
    overtones: float = 0.0

    def judged(self, plan: AxisPlan, least: float, sigmas: float, floor: float) -> Judged:
        """Noise and agreement, from pixels that are not clipped, and good by that noise.

        The noise is that of residuals; where fits leave none (three shifts), of pairs of pixels.

        Args:
            least, sigmas: modulation a pixel must have, in grey levels and over its noise. floor: least systematic
                sigma of a set's phase, cycles.
        """
        sets, steps = len(self.gains), np.empty((len(plan.errors2), 4))
        noise = default_noise(self.max_value)
        if not self.freedom:
            good = self.good(noise, least, sigmas)
            noise = noise_of_pairs(plan, self.phases, self.modulations, self.mean, good, self.max_value)
        weights = self._weights(noise)
        cycles2, fitted = judge(
            self.phases.reshape(sets, -1), self.modulations.reshape(sets, -1), self.mean.reshape(-1),
            self.residual.reshape(-1), self.usable.reshape(-1), self.gains, self.freedom > 0, weights,
            _limits(least, sigmas), plan.combinations, plan.ladder.frequencies, plan.errors2, plan.centre,
            folded_medians(), floor, steps,
        )  # fmt: skip
        if fitted:
            noise = NoiseModel(float(weights[0]), float(weights[1]), measured=True)
        return Judged(noise, steps, cycles2)

    def good(self, noise: NoiseModel, least: float, sigmas: float) -> NDArray[np.bool_]:
        """(R, L) bool: pixels not clipped whose sets all have `least` modulation, and `sigmas` times its noise."""
        good, variance = np.empty(self.mean.size, np.bool_), np.empty(self.mean.size, np.float32)
        mark_good(
            self.modulations.reshape(len(self.gains), -1), self.mean.reshape(-1), self.residual.reshape(-1),
            self.usable.reshape(-1), self.gains, self._weights(noise), _limits(least, sigmas), variance, good,
        )  # fmt: skip
        return good.reshape(self.mean.shape)

    def overtone_share2(self, finest: int) -> float:
        """Mean square that overtones leave at the worst phase, over the finest set's B^2 of a typical pixel."""
        if not self.overtones:
            return 0.0
        typical = float(np.median(self.modulations[finest][self.usable] ** 2)) if self.usable.any() else 0.0
        return 2 * self.overtones / max(self.freedom * typical, 1e-6)

    def without_overtones(self, frames: AxisFrames, plan: AxisPlan, seen: Look) -> Sample:
        """The sample without what overtones are of its residuals: they are the same at every pixel, noise is not."""
        residual = self.residual.copy()
        take_explained_off(
            frames.addresses, frames.like, frames.starts, plan.heights.weights, plan.heights.kinds, seen.sums.ratios,
            self.runs, residual,
        )  # fmt: skip
        return replace(self, residual=residual, overtones=seen.energy)

    def _weights(self, noise: NoiseModel) -> NDArray[np.float32]:
        """Of `mark_good`, where residuals count."""
        return np.array([noise.read, noise.per_level, ROUNDING_VARIANCE, self.prior, self.freedom, 1], np.float32)


@dataclass(frozen=True)
class Look:
    """What a first look at a sample shows, by the noise of any camera.

    least: grey levels of modulation that a pixel must have. good: (R, L) bool, those that have it. sums: spectra of
    `count` good pixels, of one run in THINNED. left: mean of these pixels' squared residuals; energy: what overtones of
    a response are of it, grey levels squared.
    """

    least: float
    good: NDArray[np.bool_]
    sums: SpectraSums
    count: int
    left: float
    energy: float

    def spectra(self, plan: AxisPlan) -> tuple[SetSpectrum | None, ...]:
        """By set."""
        return self.sums.spectra(plan.heights, self.count)


@dataclass(frozen=True)
class Judged:
    """The scan's noise; steps: (J - 1, 4) of `judge_steps`; cycles2: (K, n) float32, variances of good pixels' phases,
    cycles squared."""

    noise: NoiseModel
    steps: NDArray[np.float64]
    cycles2: NDArray[np.float32]

    @property
    def pixels(self) -> int:
        """How many were good."""
        return int(self.cycles2.shape[1])

    def phase_sigma(self, finest: int) -> float:
        """Random 1-sigma of the finest set's phase, cycles, median; NaN without any."""
        if not self.cycles2.size:
            return float("nan")
        of_set = self.cycles2[finest]
        return float(np.sqrt(nth_of(of_set, of_set.size // 2)))


def take_sample(
    frames: AxisFrames, plan: AxisPlan, pixels: int, max_value: int, clip: int, modulation: tuple[float, float, float]
) -> tuple[Sample, Look]:
    """A sample that has light in it, if the image has, and what it shows.

    Args:
        pixels: of a frame. clip: grey level from which a sample counts as saturated. modulation: that a pixel must
            have: grey levels that count as light, share of the brightest (99th percentile of the finest set), and over
            its noise.
    """
    any_noise = default_noise(max_value)
    noise = np.array([any_noise.read, any_noise.per_level, ROUNDING_VARIANCE, 1, 0, 0], np.float32)
    thresholds, heights = np.array(modulation, np.float32), plan.heights
    size = SIZE if frames.freedom else PAIRS_SIZE
    while True:
        runs, length = runs_of(pixels, size)
        sample, good = _empty(plan, runs, length, max_value), np.empty((runs.size, length), np.bool_)
        sums = SpectraSums.empty(len(plan.gains))
        lit, least, count, left, energy = look(
            frames.addresses, frames.like, frames.starts, frames.weights, frames.grams, frames.whole, plan.gains,
            clip, pixels, runs, length, THINNED, plan.finest, noise, thresholds, heights.weights, heights.kinds,
            sample.phases, sample.modulations, sample.mean, sample.residual, sample.usable, good,
            sums.sums, sums.levels, sums.ratios,
        )  # fmt: skip
        if lit >= ENOUGH or size >= pixels:
            return sample, Look(least, good, sums, count, left, energy)
        size *= _GROWTH


def take_fine_sample(frames: AxisFrames, plan: AxisPlan, pixels: int, max_value: int, clip: int) -> Sample:
    """A sample of as many pixels as a first one has, in runs of FINE_RUN: many places, of few pixels each."""
    runs, length = spread_runs(pixels, SIZE, FINE_RUN)
    sample, sets = _empty(plan, runs, length, max_value), len(plan.gains)
    fit_runs(
        frames.addresses, frames.like, frames.starts, frames.weights, frames.grams, frames.whole, clip, pixels,
        runs, length, sample.phases.reshape(sets, -1), sample.modulations.reshape(sets, -1), sample.mean.reshape(-1),
        sample.residual.reshape(-1), sample.usable.reshape(-1),
    )  # fmt: skip
    np.logical_not(sample.usable, out=sample.usable)
    return sample


def _empty(plan: AxisPlan, runs: NDArray[np.intp], length: int, max_value: int) -> Sample:
    """To be written."""
    shape, sets = (runs.size, length), len(plan.gains)
    phases, modulations = np.empty((sets, *shape), np.float32), np.empty((sets, *shape), np.float32)
    mean, residual, usable = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.bool_)
    return Sample(phases, modulations, mean, residual, usable, plan.gains, plan.fits.freedom, max_value, runs)


def _limits(least: float, sigmas: float) -> NDArray[np.float32]:
    """Of `mark_good`."""
    return np.array([sigmas**2, max(least**2, 1e-12)], np.float32)
