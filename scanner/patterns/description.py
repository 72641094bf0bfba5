"""Pattern descriptions as plain data: what all methods share, and how a description is read.

A description says what decoding needs to know and nothing else (formats.md, Pattern descriptions).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError

Axis = Literal["x", "y"]
"""Phase direction: "y" measures projector rows, "x" projector columns."""


@dataclass(frozen=True)
class ProjectorSize:
    """Size of the projected image, px."""

    width: int
    height: int

    def along(self, axis: Axis) -> int:
        """Number of projector pixels along `axis`."""
        return self.width if axis == "x" else self.height


@dataclass(frozen=True)
class CameraFormat:
    """Format of the frames: size in px, significant bits, colour mosaic if any."""

    width: int
    height: int
    bits: int = 8
    mosaic: str | None = None

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8 up to 8 bits, uint16 above."""
        return np.dtype(np.uint8 if self.bits <= 8 else np.uint16)

    @property
    def max_value(self) -> int:
        """Largest grey level."""
        return (1 << self.bits) - 1

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of a frame."""
        return (self.height, self.width)


class FrameRole(StrEnum):
    """What a position in the frame list is for."""

    FRINGE = "fringe"
    WHITE = "white"
    BLACK = "black"
    SENTINEL = "sentinel"
    BARS = "bars"


class Pattern(Protocol):
    """The description of one method's fringe images. Immutable; implementations are frozen dataclasses."""

    @property
    def method(self) -> str:
        """The method's name in descriptions."""

    @property
    def fringe_count(self) -> int:
        """Number of fringe images."""

    def validate(self, projector: ProjectorSize) -> None:
        """Raise DecodeError if the pattern cannot be shown by, or decoded from, this projector."""

    def fringe(self, index: int, projector: ProjectorSize) -> NDArray[np.float32]:
        """Fringe image `index`, (height, width) float32, linear light 0..1. May be a broadcast view."""

    def describe(self) -> dict[str, Any]:
        """The description, without the positions of white, black and sentinels."""


# --- reading members, with errors that name them ------------------------------------------------------------------


def read_int(description: Mapping[str, Any], key: str, default: int | None = None) -> int:
    """Member `key` as an integer."""
    value = description.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int):
        raise DecodeError(f'pattern member "{key}" must be an integer, got {value!r}')
    return value


def read_number(description: Mapping[str, Any], key: str, default: float | None = None) -> float:
    """Member `key` as a finite number."""
    return _finite(description.get(key, default), key)


def read_numbers(description: Mapping[str, Any], key: str) -> tuple[float, ...]:
    """Member `key` as a list of finite numbers, not empty."""
    return tuple(_finite(value, key) for value in _sequence(description, key))


def read_ints(description: Mapping[str, Any], key: str) -> tuple[int, ...]:
    """Member `key` as a list of integers, not empty."""
    values = _sequence(description, key)
    if any(isinstance(value, bool) or not isinstance(value, int) for value in values):
        raise DecodeError(f'pattern member "{key}" must be a list of integers, got {values!r}')
    return tuple(values)


def read_choice(description: Mapping[str, Any], key: str, choices: tuple[str, ...], default: str | None = None) -> Any:
    """Member `key` as one of `choices`."""
    value = description.get(key, default)
    if value not in choices:
        raise DecodeError(f'pattern member "{key}" must be one of {", ".join(choices)}, got {value!r}')
    return value


def read_axes(description: Mapping[str, Any]) -> tuple[Axis, ...]:
    """Member "axes": "x", "y" or both, without repetition."""
    axes = tuple(_sequence(description, "axes"))
    if any(axis not in ("x", "y") for axis in axes) or len(set(axes)) != len(axes):
        raise DecodeError(f'pattern member "axes" must list "x", "y" or both once, got {list(axes)!r}')
    return axes


def _sequence(description: Mapping[str, Any], key: str) -> list[Any]:
    values = description.get(key)
    if not isinstance(values, list | tuple) or not values:
        raise DecodeError(f'pattern member "{key}" must be a list that is not empty, got {values!r}')
    return list(values)


def _finite(value: Any, key: str) -> float:
    # Integers of JSON have no bound; floats have.
    if isinstance(value, bool) or not isinstance(value, int | float) or not -1e300 < value < 1e300:
        raise DecodeError(f'pattern member "{key}" must be a finite number, got {value!r:.80}')
    return float(value)
