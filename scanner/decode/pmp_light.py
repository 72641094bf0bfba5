"""What a PMP scan's sample tells about its light: overtones of the fringes, ripple, flicker; and its honest residuals.

Overtones are the same at every pixel, noise is not: what the response explains of the sample's residuals is taken off
before noise is judged by them. Nothing here touches a pixel outside the sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.agreement import remainders_of
from scanner.decode.flicker import Flicker, flicker
from scanner.decode.harmonics import (
    SetHarmonics,
    SetSpectrum,
    explained_by,
    named_ripple,
    spectra_of,
    told_of,
)
from scanner.decode.noise import NoiseModel
from scanner.decode.pmp_frames import AxisFrames
from scanner.decode.pmp_sample import PRIOR_FREEDOM, Sample, take_fine_sample
from scanner.decode.ripples import FEWEST_SHIFTS_UNHARMED, ripples
from scanner.decode.sample_kernels import mean_of_good
from scanner.decode.unwrapping import Ladder

THINNED = 8
"""Of the sample's runs, one in so many is asked for overtones: five hundred pixels tell a share to .0005."""

LEAST_EXPLAINED = 0.02
"""Of the noise's part in the residuals: where overtones add less, the noise model is good to 1 % as it is."""

MOST_EXPLAINED = 0.05
"""Share of a pixel's variance that overtones may add by way of its own residual: 2.5 % of its sigma. Where they are
stronger, the residual tells little of the pixel's noise, and the scan's model weighs more."""


@dataclass(frozen=True)
class Light:
    """Of one axis: overtones by set; changes of the light, None where nothing could be seen of them."""

    harmonics: tuple[SetHarmonics, ...]
    flicker: Flicker | None

    @property
    def named(self) -> str:
        """The overtone that passes for the finest set's fringe, in words; empty where none is known."""
        finest = max(self.harmonics, key=lambda s: s.frequency)
        if finest.ripple_px is None or finest.shifts not in (3, 4):
            return ""
        share, order = (finest.second, "second") if finest.shifts == 3 else (finest.third, "third")
        return (
            f", and with {finest.shifts} shifts the {order} overtone ({share:.1%} of a fringe's height) passes for it"
        )

    def as_dict(self) -> dict[str, Any]:
        """For report.json."""
        return {
            "harmonics": [found.as_dict() for found in self.harmonics],
            "flicker": None if self.flicker is None else self.flicker.as_dict(),
        }


def judge_light(
    sample: Sample,
    frames: AxisFrames,
    frequencies: Sequence[float],
    along: int,
    least: float,
    sigmas: float,
    tell: bool,
) -> tuple[Sample, Light]:
    """The sample without what overtones are of its residuals, and what is to be told of the light.

    Args:
        frequencies: by set, cycles over the projector. along: its pixels along the axis.
        least, sigmas: modulation a pixel must have to be asked, in grey levels and over its noise.
        tell: False where nobody asks for the light: there is nothing in it then.
    """
    good = sample.lit(least, sigmas)
    spectra = spectra_of(frames, sample.runs, THINNED, good, sample.mean)
    left, count = mean_of_good(sample.residual, good, THINNED)
    energy = sum(s.energy for s in spectra if s is not None)
    variance = max(left - energy, 0.0) / max(frames.freedom, 1)
    if energy > LEAST_EXPLAINED * max(left - energy, 1e-6):
        pixels = (sample.runs[:, None] + np.arange(good.shape[1])).reshape(-1)
        explained = explained_by(spectra, frames, pixels).reshape(good.shape)
        residual = np.maximum(sample.residual - explained, 0)
        variance = float(residual[good].mean()) / max(frames.freedom, 1)
        prior = energy / max(MOST_EXPLAINED * variance, 1e-6) - frames.freedom
        sample = replace(sample, residual=residual, prior=max(PRIOR_FREEDOM, prior), overtones=energy)
    if not tell:
        return sample, Light((), None)
    told = (
        told_of(float(frequency), shifts, spectrum, variance, max(count, 1))
        for frequency, shifts, spectrum in zip(frequencies, frames.shifts, spectra, strict=True)
    )
    finest = max(range(len(frequencies)), key=lambda k: frequencies[k])
    asked = good[::THINNED]
    return sample, Light(tuple(told), _changes(spectra, sample, asked, variance, finest, along / frequencies[finest]))


def judge_ripple(
    light: Light,
    frames: AxisFrames,
    sample: Sample,
    pixels: int,
    clip: int,
    ladder: Ladder,
    noise: NoiseModel,
    centre: float,
    along: int,
    least: float,
    sigmas: float,
) -> Light:
    """The same with the overtones that pass for the fringe.

    A sample of its own is taken for them: what rounding of the projected images does is a function of the phase, too,
    and only many phases tell the two apart.

    Args:
        pixels: of a frame. clip: see `take_sample`. The others: see `Sample.judged` and `judge_light`.
    """
    if all(s.shifts >= FEWEST_SHIFTS_UNHARMED for s in light.harmonics):
        return light
    fine = replace(take_fine_sample(frames, pixels, sample.max_value, clip), prior=sample.prior)
    good = fine.good(noise, least, sigmas)
    phases = fine.phases[:, good]
    heights = np.median(fine.modulations[:, good], axis=1) if good.any() else np.zeros(len(phases), np.float32)
    shifts, frequencies = [s.shifts for s in light.harmonics], [s.frequency for s in light.harmonics]
    found = ripples(ladder, remainders_of(ladder, phases, centre), phases, heights, shifts, frequencies, along)
    return replace(light, harmonics=tuple(named_ripple(s, r) for s, r in zip(light.harmonics, found, strict=True)))


def _changes(
    spectra: Sequence[SetSpectrum | None],
    sample: Sample,
    asked: NDArray[np.bool_],
    variance: float,
    finest: int,
    period_px: float,
) -> Flicker | None:
    level = np.maximum(sample.mean[::THINNED][asked], np.float32(1e-3))
    if not level.size:
        return None
    floor = float(np.sqrt(variance * np.mean(level**-2) / level.size))
    last = spectra[finest]
    contrast = 0.0 if last is None else float(np.sqrt(last.power / np.mean(level**2)))
    return flicker(spectra, floor, finest, period_px, contrast)
