"""What a sample of pixels tells about a whole PMP scan: its noise, its light, how well its frequencies agree.

A few thousand pixels are fitted before the pass over all of them, so that the pass knows every threshold when it
begins. Runs of neighbouring pixels lie spread over the image: what is read of a frame then is little, and pixels side
by side can be compared.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.decode.agreement import PAIR_DISTANCE, Remainder, agreement, noise_of_pairs
from scanner.decode.middles import nth_of
from scanner.decode.noise import ROUNDING_VARIANCE, NoiseModel, default_noise, fit_noise
from scanner.decode.pmp_frames import AxisFrames
from scanner.decode.pmp_sums import fit_runs
from scanner.decode.runs import runs_of, spread_runs
from scanner.decode.sample_kernels import count_lit, mark_good, take_good
from scanner.decode.unwrapping import Ladder

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

    def brightest(self, finest: int) -> float:
        """99th percentile of the finest set's modulation, grey levels."""
        b = self.modulations[finest].reshape(-1)
        return float(nth_of(b, int(0.99 * (b.size - 1))))

    def noise(self, ladder: Ladder, centre: float, least: float, sigmas: float) -> NoiseModel:
        """The scan's noise model, from residuals; where fits leave none (three shifts), from pairs of pixels.

        Args:
            centre: the field's centre, fraction of it. least, sigmas: modulation a usable pixel of a pair has, in grey
                levels and over its noise.
        """
        if self.freedom:
            mean, residual = self.mean.reshape(-1), self.residual.reshape(-1)
            if not self.usable.all():
                usable = np.flatnonzero(self.usable)
                mean, residual = mean.take(usable), residual.take(usable)
            return fit_noise(mean, residual, self.freedom, self.max_value)
        good = self.good(default_noise(self.max_value), least, sigmas)
        pair = good[:, :-PAIR_DISTANCE] & good[:, PAIR_DISTANCE:]
        pixels = slice(None, -PAIR_DISTANCE), slice(PAIR_DISTANCE, None)
        phases = np.stack([self.phases[:, :, at][:, pair] for at in pixels])
        gains = self.gains[:, None] / np.float32(4 * np.pi**2)
        per_variance = np.stack([gains / self.modulations[:, :, at][:, pair] ** 2 for at in pixels])
        level = (self.mean[:, pixels[0]][pair] + self.mean[:, pixels[1]][pair]) * np.float32(0.5)
        return noise_of_pairs(ladder, phases, per_variance, level, centre, self.max_value)

    def judged(self, noise: NoiseModel, least: float, sigmas: float) -> Judged:
        """The `good` ones."""
        sets = len(self.gains)
        good, variance, count = self._marked(noise, least, sigmas)
        phases, modulations = self.phases.reshape(sets, -1), self.modulations.reshape(sets, -1)
        return Judged(*take_good(phases, modulations, variance, self.gains, good, count))

    def good(self, noise: NoiseModel, least: float, sigmas: float) -> NDArray[np.bool_]:
        """(R, L) bool: pixels not clipped whose sets all have `least` modulation, and `sigmas` times its noise."""
        return self._marked(noise, least, sigmas)[0].reshape(self.mean.shape)

    def overtone_share2(self, finest: int) -> float:
        """Mean square that overtones leave at the worst phase, over the finest set's B^2 of a typical pixel."""
        if not self.overtones:
            return 0.0
        typical = float(np.median(self.modulations[finest][self.usable] ** 2)) if self.usable.any() else 0.0
        return 2 * self.overtones / max(self.freedom * typical, 1e-6)

    def lit(self, least: float, sigmas: float) -> NDArray[np.bool_]:
        """The same before anything is known of the noise: by that of any camera, whatever the residuals."""
        return self._marked(default_noise(self.max_value), least, sigmas, trusting=False)[0].reshape(self.mean.shape)

    def _marked(
        self, noise: NoiseModel, least: float, sigmas: float, trusting: bool = True
    ) -> tuple[NDArray[np.bool_], NDArray[np.float32], int]:
        """(n,) which are good, (n,) variance of one sample, and how many are. trusting: residuals count."""
        weights = (self.prior, self.freedom, 1) if trusting else (1, 0, 0)
        good, variance = np.empty(self.mean.size, np.bool_), np.empty(self.mean.size, np.float32)
        count = mark_good(
            self.modulations.reshape(len(self.gains), -1), self.mean.reshape(-1), self.residual.reshape(-1),
            self.usable.reshape(-1), self.gains,
            np.array([noise.read, noise.per_level, ROUNDING_VARIANCE, *weights], np.float32),
            np.array([sigmas**2, max(least**2, 1e-12)], np.float32), variance, good,
        )  # fmt: skip
        return good, variance, count


@dataclass(frozen=True)
class Judged:
    """Pixels of a sample that are good. phases: (K, n) float32, cycles. cycles2: (K, n) float32, their variances."""

    phases: NDArray[np.float32]
    cycles2: NDArray[np.float32]

    def agreement(self, ladder: Ladder, centre: float, floor_cycles: float) -> list[Remainder]:
        """How well the ladder's rungs agree."""
        return agreement(ladder, self.phases, self.cycles2, centre, floor_cycles)

    def phase_sigma(self, finest: int) -> float:
        """Random 1-sigma of the finest set's phase, cycles, median; NaN without any."""
        if not self.cycles2.size:
            return float("nan")
        of_set = self.cycles2[finest]
        return float(np.sqrt(nth_of(of_set, of_set.size // 2)))


def take_sample(frames: AxisFrames, pixels: int, max_value: int, clip: int, least: float) -> Sample:
    """A sample that has light in it, if the image has.

    Args:
        pixels: of a frame. clip: grey level from which a sample counts as saturated. least: grey levels of modulation
            that count as light.
    """
    size = SIZE if frames.freedom else PAIRS_SIZE
    while True:
        sample = _fit(frames, *runs_of(pixels, size), max_value, clip)
        modulations = sample.modulations.reshape(len(frames.gains), -1)
        lit = count_lit(modulations, sample.usable.reshape(-1), np.float32(least))
        if lit >= ENOUGH or size >= pixels:
            return sample
        size *= _GROWTH


def take_fine_sample(frames: AxisFrames, pixels: int, max_value: int, clip: int) -> Sample:
    """A sample of as many pixels as a first one has, in runs of FINE_RUN: many places, of few pixels each."""
    return _fit(frames, *spread_runs(pixels, SIZE, FINE_RUN), max_value, clip)


def _fit(frames: AxisFrames, runs: NDArray[np.intp], length: int, max_value: int, clip: int) -> Sample:
    sets, shape = len(frames.gains), (runs.size, length)
    phases, modulations = (np.empty((sets, runs.size * length), np.float32) for _ in range(2))
    mean, residual = (np.empty(runs.size * length, np.float32) for _ in range(2))
    clipped = np.empty(runs.size * length, np.bool_)
    fit_runs(
        frames.addresses, frames.like, frames.starts, frames.weights, frames.grams, frames.whole, clip,
        frames.frames[0].size, runs, length, phases, modulations, mean, residual, clipped,
    )  # fmt: skip
    return Sample(
        phases.reshape(sets, *shape), modulations.reshape(sets, *shape), mean.reshape(shape), residual.reshape(shape),
        ~clipped.reshape(shape), np.array(frames.gains, np.float32), frames.freedom, max_value, runs,
    )  # fmt: skip
