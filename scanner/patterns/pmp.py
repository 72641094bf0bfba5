"""Phase measuring profilometry: sets of shifted sinusoidal fringes (Srinivasan, Liu, Halioua 1984).

I_n(y) = A + B cos(2 pi f (y + origin) / Y + sign 2 pi n / N + offset),     A = .5, B = .48 at projection
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError
from scanner.patterns.description import (
    Axis,
    ProjectorSize,
    read_axes,
    read_int,
    read_ints,
    read_number,
    read_numbers,
)

MEAN = 0.5
AMPLITUDE = 0.48

MIN_FREQUENCY, MAX_FREQUENCY = 0.01, 1e5
"""Cycles over the projector: a hundredth of a cycle has no phase to measure, and no projector is so wide."""

MAX_SHIFTS = 1000
MAX_OFFSET = 1e6
"""Radians, and pixels: beyond this float arithmetic has no phase left."""


@dataclass(frozen=True)
class FringeSet:
    """One frequency along one axis: `shifts` consecutive fringe frames beginning at fringe index `first`."""

    axis: Axis
    frequency: float
    shifts: int
    first: int


@dataclass(frozen=True)
class PmpPattern:
    """Frequencies in cycles per projector height (axis "y") or width ("x"), the same for all axes."""

    axes: tuple[Axis, ...] = ("y",)
    frequencies: tuple[float, ...] = (1.0, 8.0, 64.0)
    shifts: tuple[int, ...] = (8, 8, 8)
    sign: int = -1
    offset: float = 0.0
    origin: float = 0.5

    method: ClassVar[str] = "pmp"

    def __post_init__(self) -> None:
        if len(self.frequencies) != len(self.shifts):
            raise DecodeError(
                f"{len(self.frequencies)} frequencies and {len(self.shifts)} shifts: give one number of shifts for each"
            )
        if not self.frequencies:
            raise DecodeError("no frequency is given: a PMP pattern has one set of fringes or more")
        if any(not MIN_FREQUENCY <= f <= MAX_FREQUENCY for f in self.frequencies):
            raise DecodeError(
                f"frequencies must lie in {MIN_FREQUENCY:g} .. {MAX_FREQUENCY:g}, got {list(self.frequencies)}"
            )
        if len(set(self.frequencies)) != len(self.frequencies):
            raise DecodeError(
                f"a frequency is listed twice: {list(self.frequencies)}",
                hint="two sets of one frequency tell nothing more than one set of more shifts",
            )
        if any(n < 3 for n in self.shifts):
            raise DecodeError(f"three shifts or more are needed for a phase, got {list(self.shifts)}")
        if any(n > MAX_SHIFTS for n in self.shifts):
            raise DecodeError(f"more than {MAX_SHIFTS} shifts: {list(self.shifts)}")
        if not (abs(self.offset) <= MAX_OFFSET and abs(self.origin) <= MAX_OFFSET):
            raise DecodeError(
                f"offset and origin must lie within +-{MAX_OFFSET:g}, got {self.offset:g}, {self.origin:g}"
            )
        if self.sign not in (-1, 1):
            raise DecodeError(f'pattern member "sign" must be 1 or -1, got {self.sign!r}')

    @classmethod
    def from_description(cls, description: Mapping[str, Any]) -> PmpPattern:
        """Read a description.

        Raises:
            DecodeError: a member is missing or wrong.
        """
        return cls(
            axes=read_axes(description),
            frequencies=read_numbers(description, "frequencies"),
            shifts=read_ints(description, "shifts"),
            sign=read_int(description, "sign", -1),
            offset=read_number(description, "offset", 0.0),
            origin=read_number(description, "origin", 0.5),
        )

    @property
    def fringe_count(self) -> int:
        """Number of fringe images."""
        return len(self.axes) * sum(self.shifts)

    def sets(self) -> Iterator[FringeSet]:
        """The fringe sets in the order of their frames."""
        first = 0
        for axis in self.axes:
            for frequency, shifts in zip(self.frequencies, self.shifts, strict=True):
                yield FringeSet(axis, frequency, shifts, first)
                first += shifts

    def validate(self, projector: ProjectorSize) -> None:
        """Raise DecodeError where a period is shorter than three projector pixels."""
        for axis in self.axes:
            period = projector.along(axis) / max(self.frequencies)
            if period < 3:
                raise DecodeError(
                    f"frequency {max(self.frequencies):g} along {axis} has a period of {period:.2f} projector pixels",
                    hint=f"use frequencies up to {projector.along(axis) / 3:.0f}",
                )

    def fringe(self, index: int, projector: ProjectorSize) -> NDArray[np.float32]:
        """Fringe image `index`: (height, width) float32, linear light, a broadcast view."""
        for fringe_set in self.sets():
            n = index - fringe_set.first
            if 0 <= n < fringe_set.shifts:
                size = projector.along(fringe_set.axis)
                phase = 2 * np.pi * fringe_set.frequency * (np.arange(size) + self.origin) / size
                phase += self.sign * 2 * np.pi * n / fringe_set.shifts + self.offset
                line = (MEAN + AMPLITUDE * np.cos(phase)).astype(np.float32)
                line = line[:, None] if fringe_set.axis == "y" else line[None, :]
                return np.broadcast_to(line, (projector.height, projector.width))
        raise IndexError(index)

    def describe(self) -> dict[str, Any]:
        """The description of formats.md."""
        return {
            "method": self.method,
            "axes": list(self.axes),
            "frequencies": [int(f) if f == int(f) else f for f in self.frequencies],
            "shifts": list(self.shifts),
            "sign": self.sign,
            "offset": self.offset,
            "origin": self.origin,
        }
