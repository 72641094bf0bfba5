"""Gray code and phase measuring in one sequence: the phase of one fringe set measures, a Gray code counts its fringes.

The code's cells are half a fringe or less, one bit finer than counting alone would need (complementary Gray code:
Zhang, Su, Xiang, Sun 2012): a pixel on the border of two cells is then never on that of two fringes, and a bit that is
read wrong there names a place that is still nearest to the right fringe.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError
from scanner.patterns.description import Axis, ProjectorSize
from scanner.patterns.graycode import GrayPattern
from scanner.patterns.pmp import PmpPattern


@dataclass(frozen=True)
class GrayPmpPattern:
    """All fringe frames of `pmp`, which has one frequency, then all code frames of `gray`; the axes of both are one."""

    pmp: PmpPattern = field(default_factory=lambda: PmpPattern(frequencies=(54.0,), shifts=(4,)))
    gray: GrayPattern = field(default_factory=lambda: GrayPattern(bits=7, code_bits=10, inverse=False))

    method: ClassVar[str] = "gray+pmp"

    def __post_init__(self) -> None:
        if len(self.pmp.frequencies) != 1:
            raise DecodeError(
                f"gray+pmp takes one frequency, got {list(self.pmp.frequencies)}",
                hint="the code tells which fringe it is; use method pmp for several frequencies",
            )
        if self.pmp.axes != self.gray.axes:
            raise DecodeError("fringes and code have different axes")

    @classmethod
    def from_description(cls, description: Mapping[str, Any]) -> GrayPmpPattern:
        """Read a description: the members of both methods.

        Raises:
            DecodeError: a member is missing or wrong.
        """
        return cls(PmpPattern.from_description(description), GrayPattern.from_description(description))

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Phase directions."""
        return self.pmp.axes

    @property
    def fringe_count(self) -> int:
        """Number of fringe and code images."""
        return self.pmp.fringe_count + self.gray.fringe_count

    @property
    def cell_px(self) -> int:
        """Projector px of a cell of the code."""
        return 1 << (self.gray.code_bits - self.gray.bits)

    def validate(self, projector: ProjectorSize) -> None:
        """Raise DecodeError where the projector cannot show it, or cells are wider than half a fringe."""
        self.pmp.validate(projector)
        self.gray.validate(projector)
        for axis in self.axes:
            half = projector.along(axis) / self.pmp.frequencies[0] / 2
            if self.cell_px > half * (1 + 1e-9):
                raise DecodeError(
                    f"cells of {self.cell_px} projector px tell no fringes of {2 * half:g} px along {axis} apart",
                    hint="project more bits, so that a cell is half a fringe or less, or fewer fringes",
                )

    def fringe(self, index: int, projector: ProjectorSize) -> NDArray[np.float32]:
        """Image `index`: (height, width) float32, linear light, a broadcast view."""
        if index < self.pmp.fringe_count:
            return self.pmp.fringe(index, projector)
        return self.gray.fringe(index - self.pmp.fringe_count, projector)

    def describe(self) -> dict[str, Any]:
        """The description of formats.md: members of both."""
        return {**self.gray.describe(), **self.pmp.describe(), "method": self.method}


DEFAULT_PERIOD_PX = 16
"""Of fringes: with half of it a cell of the code, which every projector shows sharply."""


def default_gray_pmp(
    axes: tuple[Axis, ...], projector: ProjectorSize, frequency: float | None = None, shifts: int = 4
) -> GrayPmpPattern:
    """As few frames as fringes of DEFAULT_PERIOD_PX take, or of a given frequency.

    Raises:
        DecodeError: fringes of less than three projector px.
    """
    least, longest = (pick(projector.along(axis) for axis in axes) for pick in (min, max))
    # One frequency holds for both axes; on the shorter one fringes are finer than on the longer.
    frequency = least / DEFAULT_PERIOD_PX if frequency is None else frequency
    pmp = PmpPattern(axes, (float(frequency),), (shifts,))
    pmp.validate(projector)
    code_bits = max(math.ceil(math.log2(longest)), 1)
    unshown = min(max(math.floor(math.log2(least / frequency / 2) + 1e-9), 0), code_bits - 1)
    return GrayPmpPattern(pmp, GrayPattern(axes, code_bits - unshown, code_bits, inverse=False))
