"""Gray and binary code: one bit of the projector coordinate a frame, most significant first (Inokuchi et al. 1984)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError
from scanner.patterns.description import Axis, ProjectorSize, read_axes, read_choice, read_int


@dataclass(frozen=True)
class GrayPattern:
    """The `bits` most significant of `code_bits` bits of the projector coordinate, per axis."""

    axes: tuple[Axis, ...] = ("y",)
    bits: int = 10
    code_bits: int = 10
    code: Literal["gray", "binary"] = "gray"
    inverse: bool = True

    method: ClassVar[str] = "gray"

    def __post_init__(self) -> None:
        if not 1 <= self.bits <= self.code_bits <= 16:
            raise DecodeError(
                f"bits must be 1 .. code_bits and code_bits at most 16, got {self.bits}, {self.code_bits}"
            )

    @classmethod
    def from_description(cls, description: Mapping[str, Any]) -> GrayPattern:
        """Read a description.

        Raises:
            DecodeError: a member is missing or wrong.
        """
        bits = read_int(description, "bits")
        inverse = description.get("inverse", False)
        if not isinstance(inverse, bool):
            raise DecodeError(f'pattern member "inverse" must be true or false, got {inverse!r}')
        return cls(
            axes=read_axes(description),
            bits=bits,
            code_bits=read_int(description, "code_bits", bits),
            code=read_choice(description, "code", ("gray", "binary"), "gray"),
            inverse=inverse,
        )

    @property
    def frames_per_bit(self) -> int:
        """2 where each bit is followed by its inverse."""
        return 2 if self.inverse else 1

    @property
    def fringe_count(self) -> int:
        """Number of code images."""
        return len(self.axes) * self.bits * self.frames_per_bit

    def validate(self, projector: ProjectorSize) -> None:
        """Raise DecodeError where the code has fewer words than the projector has pixels."""
        for axis in self.axes:
            if 1 << self.code_bits < projector.along(axis):
                raise DecodeError(
                    f"{self.code_bits} code bits name {1 << self.code_bits} positions, "
                    f"the projector has {projector.along(axis)} along {axis}",
                    hint="raise code_bits",
                )

    def fringe(self, index: int, projector: ProjectorSize) -> NDArray[np.float32]:
        """Code image `index`: (height, width) float32 of 0 and 1, a broadcast view."""
        if not 0 <= index < self.fringe_count:
            raise IndexError(index)
        axis_index, within = divmod(index, self.bits * self.frames_per_bit)
        bit, inverted = divmod(within, self.frames_per_bit)
        axis = self.axes[axis_index]
        position = np.arange(projector.along(axis))
        word = position ^ (position >> 1) if self.code == "gray" else position
        line = ((word >> (self.code_bits - 1 - bit)) & 1 ^ inverted).astype(np.float32)
        line = line[:, None] if axis == "y" else line[None, :]
        return np.broadcast_to(line, (projector.height, projector.width))

    def describe(self) -> dict[str, Any]:
        """The description of formats.md."""
        return {
            "method": self.method,
            "code": self.code,
            "axes": list(self.axes),
            "bits": self.bits,
            "code_bits": self.code_bits,
            "inverse": self.inverse,
        }
