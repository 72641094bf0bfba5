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
    named_ripple,
    told_of,
)
from scanner.decode.noise import NoiseModel
from scanner.decode.pmp_frames import AxisFrames
from scanner.decode.pmp_plan import AxisPlan
from scanner.decode.pmp_sample import PRIOR_FREEDOM, THINNED, Look, Sample, take_fine_sample
from scanner.decode.ripples import FEWEST_SHIFTS_UNHARMED, ripples

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


def honest(sample: Sample, seen: Look, frames: AxisFrames, plan: AxisPlan) -> Sample:
    """The sample without what overtones are of its residuals, where that is more than next to nothing."""
    noise = max(seen.left - seen.energy, 1e-6)
    if seen.energy <= LEAST_EXPLAINED * noise:
        return sample
    sample = sample.without_overtones(frames, plan, seen)
    variance = float(sample.residual[seen.good].mean()) / max(frames.freedom, 1)
    prior = seen.energy / max(MOST_EXPLAINED * variance, 1e-6) - frames.freedom
    return replace(sample, prior=max(PRIOR_FREEDOM, prior))


def judge_light(sample: Sample, seen: Look, frequencies: Sequence[float], plan: AxisPlan) -> Light:
    """What is to be told of the light.

    Args:
        sample: of `honest`. frequencies: by set, cycles over the projector.
    """
    spectra = seen.spectra(plan)
    squares = float(sample.residual[seen.good].mean()) if sample.overtones else max(seen.left - seen.energy, 0.0)
    variance = squares / max(sample.freedom, 1)
    told = (
        told_of(float(frequency), shifts, spectrum, variance, max(seen.count, 1))
        for frequency, shifts, spectrum in zip(frequencies, plan.fits.shifts, spectra, strict=True)
    )
    asked, period_px = seen.good[::THINNED], plan.along / frequencies[plan.finest]
    return Light(tuple(told), _changes(spectra, sample, asked, variance, plan.finest, period_px))


def judge_ripple(
    light: Light,
    frames: AxisFrames,
    plan: AxisPlan,
    sample: Sample,
    pixels: int,
    clip: int,
    noise: NoiseModel,
    least: float,
    sigmas: float,
) -> Light:
    """The same with the overtones that pass for the fringe.

    A sample of its own is taken for them: what rounding of the projected images does is a function of the phase, too,
    and only many phases tell the two apart.

    Args:
        pixels: of a frame. clip: see `take_sample`. The others: see `Sample.judged`.
    """
    if all(s.shifts >= FEWEST_SHIFTS_UNHARMED for s in light.harmonics):
        return light
    fine = replace(take_fine_sample(frames, plan, pixels, sample.max_value, clip), prior=sample.prior)
    good = fine.good(noise, least, sigmas)
    phases = fine.phases[:, good]
    heights = np.median(fine.modulations[:, good], axis=1) if good.any() else np.zeros(len(phases), np.float32)
    shifts, frequencies = [s.shifts for s in light.harmonics], [s.frequency for s in light.harmonics]
    left = remainders_of(plan.ladder, phases, plan.centre)
    found = ripples(plan.ladder, left, phases, heights, shifts, frequencies, plan.along)
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
