"""Modified Composite Pattern: one image of coded stripes (Casey 2011, sec. 2.1, eq. 3.1-3.6).

2^(bits + 1) stripes of equal height, modulated and unmodulated in turn; a modulated stripe's code word switches
carriers on that run along it. "composite" is the published form; "equal" gives every stripe the same mean light.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError
from scanner.patterns.description import (
    Axis,
    ProjectorSize,
    read_choice,
    read_int,
    read_ints,
    read_number,
    read_numbers,
)

PERMUTED_CODES = (0, 10, 13, 6, 1, 8, 15, 4, 3, 9, 14, 5, 2, 11, 12, 7)
"""Four-bit code order whose neighbours at distance 1, 2 and 3 differ in two bits or more."""

MIN_CARRIER_SEPARATION = 4.0
"""Cycles per field: two carriers nearer than this fall into one another's band over a quarter of the field."""


@dataclass(frozen=True)
class McpPattern:
    """Carriers in cycles per projector width (axis "y") or height ("x"); `codes[k]` is modulated stripe k's word."""

    axis: Axis = "y"
    bits: int = 4
    carriers: tuple[float, ...] = (98.0, 136.0, 185.0, 222.0)
    codes: tuple[int, ...] = PERMUTED_CODES
    profile: Literal["triangle", "cosine"] = "triangle"
    first: Literal["modulated", "unmodulated"] = "modulated"
    unmodulated: float = 1.0
    levels: Literal["composite", "equal"] = "equal"

    method: ClassVar[str] = "mcp"

    def __post_init__(self) -> None:
        if not 2 <= self.bits <= 6:
            raise DecodeError(f"MCP takes 2 to 6 bits, got {self.bits}")
        if len(self.carriers) != self.bits:
            raise DecodeError(f"{self.bits} bits need {self.bits} carriers, got {len(self.carriers)}")
        words = 1 << self.bits
        if sorted(self.codes) != list(range(words)):
            raise DecodeError(f"codes must name each of 0 .. {words - 1} once", hint="any order will do")
        if not 0 < self.unmodulated <= 1:
            raise DecodeError(f'pattern member "unmodulated" must be in (0, 1], got {self.unmodulated:g}')
        ordered = sorted(self.carriers)
        if ordered[0] <= 0:
            raise DecodeError(f"carriers must be positive, got {list(self.carriers)}")
        gaps = np.diff(ordered)
        if gaps.min() < MIN_CARRIER_SEPARATION:
            raise DecodeError(
                f"carriers {list(self.carriers)} lie {gaps.min():g} cycles apart",
                hint=f"keep them {MIN_CARRIER_SEPARATION:g} or more apart; wider spacing decodes smaller objects",
            )

    @classmethod
    def from_description(cls, description: Mapping[str, Any]) -> McpPattern:
        """Read a description.

        Raises:
            DecodeError: a member is missing or wrong.
        """
        return cls(
            axis=read_choice(description, "axis", ("x", "y")),
            bits=read_int(description, "bits"),
            carriers=read_numbers(description, "carriers"),
            codes=read_ints(description, "codes"),
            profile=read_choice(description, "profile", ("triangle", "cosine"), "triangle"),
            first=read_choice(description, "first", ("modulated", "unmodulated"), "modulated"),
            unmodulated=read_number(description, "unmodulated", 1.0),
            levels=read_choice(description, "levels", ("composite", "equal"), "composite"),
        )

    @property
    def fringe_count(self) -> int:
        """One image."""
        return 1

    @property
    def stripe_count(self) -> int:
        """Number of stripes, both kinds."""
        return 1 << (self.bits + 1)

    def pitch_px(self, projector: ProjectorSize) -> float:
        """Height of one stripe, projector px."""
        return projector.along(self.axis) / self.stripe_count

    def code_of(self, stripe: int) -> int | None:
        """Code word of stripe `stripe` (0 = first from the top or left); None for an unmodulated one."""
        k, parity = divmod(stripe, 2)
        return self.codes[k] if (parity == 0) == (self.first == "modulated") else None

    def validate(self, projector: ProjectorSize) -> None:
        """Raise DecodeError where carriers or stripes are too fine for the projector."""
        across = projector.along("x" if self.axis == "y" else "y")
        if max(self.carriers) > across / 3:
            raise DecodeError(
                f"carrier {max(self.carriers):g} has a period of {across / max(self.carriers):.2f} projector pixels",
                hint=f"use carriers up to {across / 3:.0f} on this projector",
            )
        if self.pitch_px(projector) < 4:
            raise DecodeError(
                f"{self.stripe_count} stripes are {self.pitch_px(projector):.2f} projector pixels high",
                hint="use fewer bits",
            )

    def fringe(self, index: int, projector: ProjectorSize) -> NDArray[np.float32]:
        """The image: (height, width) float32, linear light."""
        if index != 0:
            raise IndexError(index)
        along = projector.along(self.axis)
        across = projector.along("x" if self.axis == "y" else "y")
        position = (np.arange(along) + 0.5) / self.pitch_px(projector)
        stripe = np.floor(position).astype(np.intp)
        t = position - stripe
        profile = 1 - np.abs(2 * t - 1) if self.profile == "triangle" else (1 - np.cos(2 * np.pi * t)) / 2
        levels = np.stack([self._stripe_level(s, across) for s in range(self.stripe_count)])
        image = (profile[:, None] * levels[stripe]).astype(np.float32)
        return image if self.axis == "y" else np.ascontiguousarray(image.T)

    def _stripe_level(self, stripe: int, across: int) -> NDArray[np.float64]:
        code = self.code_of(stripe)
        if code is None:
            return np.full(across, self.unmodulated if self.levels == "composite" else 0.5)
        switched = [f for i, f in enumerate(self.carriers) if code >> i & 1]
        waves = [np.cos(2 * np.pi * f * (np.arange(across) + 0.5) / across) for f in switched]
        total = np.sum(waves, axis=0) if waves else np.zeros(across)
        if self.levels == "composite":
            return np.asarray((len(switched) + total) / (2 * self.bits))
        return np.asarray(0.5 + total / (2 * self.bits))

    def describe(self) -> dict[str, Any]:
        """The description of formats.md."""
        return {
            "method": self.method,
            "axis": self.axis,
            "bits": self.bits,
            "carriers": [int(f) if f == int(f) else f for f in self.carriers],
            "codes": list(self.codes),
            "profile": self.profile,
            "first": self.first,
            "unmodulated": self.unmodulated,
            "levels": self.levels,
        }
