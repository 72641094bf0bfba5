"""First-generation Composite Pattern: one image that carries the shifts of one PMP set (Guan, Hassebrook, Lau 2003).

    I_n(y) = A + B cos(2 pi (y + 0.5) / Y - 2 pi n / N)                      the N shifts, of unit frequency
    I(x, y) = 0.5 + sum_n I_n(y) cos(2 pi f_n (x + 0.5) / X) / (2 N)         each on a carrier of its own

written for axis "y", in linear light within 0..1; A = .5, B = .48. The dissertation compares MCP with it (Casey 2011,
sec. 5.6). One period spans the projector: no fringe can be mistaken, and none is fine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError
from scanner.patterns.description import Axis, ProjectorSize, read_choice, read_numbers
from scanner.patterns.pmp import AMPLITUDE, MEAN

FEWEST, MOST = 3, 12
"""Carriers: three shifts make a phase; with more than twelve none has a grey level of an 8-bit projector's range left
for each tenth of its amplitude."""

MIN_SEPARATION = 12.0
"""Cycles per field between two carriers, and from the lowest to zero: a channel's band-pass then averages over a
thirteenth of the field (its spatial sigma is 2 / (pi separation))."""


@dataclass(frozen=True)
class CompositePattern:
    """Carriers in cycles per projector width (axis "y") or height ("x"); `carriers[n]` carries shift n."""

    axis: Axis = "y"
    carriers: tuple[float, ...] = (50.0, 100.0, 150.0, 200.0)

    method: ClassVar[str] = "cp"

    def __post_init__(self) -> None:
        if not FEWEST <= len(self.carriers) <= MOST:
            raise DecodeError(f"a composite pattern takes {FEWEST} to {MOST} carriers, got {len(self.carriers)}")
        ordered = np.sort(np.concatenate(([0.0], self.carriers)))
        if ordered[0] < 0 or min(self.carriers) <= 0:
            raise DecodeError(f"carriers must be positive, got {list(self.carriers)}")
        if self.separation < MIN_SEPARATION:
            raise DecodeError(
                f"carriers {list(self.carriers)} lie {self.separation:g} cycles apart, or that near to zero",
                hint=f"keep them {MIN_SEPARATION:g} or more apart; wider spacing resolves smaller objects",
            )

    @classmethod
    def from_description(cls, description: Mapping[str, Any]) -> CompositePattern:
        """Read a description.

        Raises:
            DecodeError: a member is missing or wrong.
        """
        return cls(read_choice(description, "axis", ("x", "y")), read_numbers(description, "carriers"))

    @property
    def fringe_count(self) -> int:
        """One image."""
        return 1

    @property
    def shifts(self) -> int:
        """N."""
        return len(self.carriers)

    @property
    def separation(self) -> float:
        """Smallest distance between two carriers, and from the lowest to zero, cycles per field."""
        return float(np.diff(np.sort(np.concatenate(([0.0], self.carriers)))).min())

    def validate(self, projector: ProjectorSize) -> None:
        """Raise DecodeError where carriers are too fine for the projector."""
        across = projector.along("x" if self.axis == "y" else "y")
        if max(self.carriers) > across / 3:
            raise DecodeError(
                f"carrier {max(self.carriers):g} has a period of {across / max(self.carriers):.2f} projector pixels",
                hint=f"use carriers up to {across / 3:.0f} on this projector",
            )

    def fringe(self, index: int, projector: ProjectorSize) -> NDArray[np.float32]:
        """The image: (height, width) float32, linear light."""
        if index != 0:
            raise IndexError(index)
        along = projector.along(self.axis)
        across = projector.along("x" if self.axis == "y" else "y")
        n = np.arange(self.shifts)
        phase = 2 * np.pi * (np.arange(along) + 0.5) / along
        shifted = MEAN + AMPLITUDE * np.cos(phase[:, None] - 2 * np.pi * n / self.shifts)
        waves = np.cos(2 * np.pi * np.outer(self.carriers, (np.arange(across) + 0.5) / across))
        image = (0.5 + shifted @ waves / (2 * self.shifts)).astype(np.float32)
        return image if self.axis == "y" else np.ascontiguousarray(image.T)

    def describe(self) -> dict[str, Any]:
        """The description of formats.md."""
        return {
            "method": self.method,
            "axis": self.axis,
            "carriers": [int(f) if f == int(f) else f for f in self.carriers],
        }
