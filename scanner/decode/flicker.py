"""Flicker: light that changes from frame to frame and owes nothing to the pattern, from a sample of pixels.

Within a set, what is left of the samples once the fringe and its overtones are taken off has no cause that is common
to pixels of all phases but the light itself; between sets the mean A would be the same. Lamps on mains, exposures that
are no whole number of refreshes and automatic gain show so. The part of it that looks like the fringe itself cannot be
told apart, and shifts all phases of a set together with it (van Wingerden, Frankena, Smorenburg 1991).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scanner.decode.harmonics import SetSpectrum


@dataclass(frozen=True)
class Flicker:
    """Changes of the light as shares of its mean."""

    frames: float | None
    """1-sigma from frame to frame within a set; None where no set has four shifts"""
    sets: float | None
    """1-sigma of the mean from set to set; None with one set"""
    floor: float
    """what noise alone makes of `frames`"""
    px: float | None
    """1-sigma of the error that `frames` puts into the finest set's coordinates, projector px"""

    def as_dict(self) -> dict[str, Any]:
        """For report.json."""
        return dict(vars(self))

    def warning(self, axis: str, random_px: float) -> str | None:
        """What a user should know, where it is a quarter of the noise's variance, in which it is counted, or more."""
        if self.frames is None or self.px is None or not (self.px > random_px / 2 and self.frames > 3 * self.floor):
            return None
        return (
            f"flicker along {axis}: the light changes by {self.frames:.1%} from frame to frame, {self.px:.2f} "
            f"projector px of error (noise is {random_px:.2f} px): expose for whole periods of lamps and projector, "
            "and switch automatic gain and exposure off"
        )


def flicker(
    spectra: Sequence[SetSpectrum | None], floor: float, finest: int, period_px: float, contrast: float
) -> Flicker | None:
    """Measure it.

    Args:
        spectra: of the sample. floor: 1-sigma that noise leaves of the mean of one sample over its level.
        finest: index of the set that coordinates are read from; its period in projector px, and B / A of its fringes.

    Returns:
        None where too few pixels are lit, or no set is whole.
    """
    there = [spectrum for spectrum in spectra if spectrum is not None]
    if not there:
        return None
    # White changes of 1-sigma s give the height of an order a mean square of 4 s^2 / N, and of s^2 / N at order N / 2.
    squares = [
        abs(left) ** 2 * s.shifts / (1 if 2 * order == s.shifts else 4)
        for s in there
        for order, left in enumerate(s.left, start=2)
    ]
    frames = float(np.sqrt(np.mean(squares))) if squares else None
    between = float(np.std([s.level for s in there], ddof=1)) if len(there) > 1 else None
    px, last = None, spectra[finest]
    if last is not None and frames is not None and contrast > 0:
        px = frames / contrast * float(np.sqrt(2 / last.shifts)) * period_px / (2 * np.pi)
    return Flicker(frames, between, floor, px)
