"""What a user may ask to be left out of a cloud, checked: the words of `scanner.filters`, without its kernels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from scanner.errors import ConfigError

DEFAULT_MAX_ANGLE_DEG = 80.0
"""Between a surface's normal and the line of sight. At 80 degrees the footprint of a pixel is 5.8 times as long as
wide, and light returned by a matt surface is a sixth: beyond it fringes blur into each other."""

DEFAULT_MIN_FRAGMENT = 30
"""Pixels. Optics spread a point over about pi (3 sigma)^2 = 28 pixels at sigma 1 px: what is smaller than that holds
no two independent measurements."""

BOX_KEYS = ("xmin:xmax", "ymin:ymax", "zmin:zmax")


@dataclass(frozen=True)
class FilterSettings:
    """Which points to take out. The default takes flying points and specks."""

    edges: bool = True
    """points at depth edges, and fragments"""
    max_angle_deg: float = DEFAULT_MAX_ANGLE_DEG
    """steepest surface that is kept, between its normal and the line of sight"""
    min_fragment: int = DEFAULT_MIN_FRAGMENT
    """fragments of fewer pixels than this fall"""
    depth: tuple[float, float] | None = None
    """nearest and farthest z, mm, camera frame"""
    box: tuple[float, float, float, float, float, float] | None = None
    """xmin, xmax, ymin, ymax, zmin, zmax, mm, camera frame"""
    min_confidence: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.max_angle_deg < 90:
            raise ConfigError(f"filter max_angle_deg must lie between 0 and 90 degrees, got {self.max_angle_deg:g}")
        if not 0 <= self.min_fragment < 2**31:
            raise ConfigError(f"filter min_fragment must be 0 or more pixels, got {self.min_fragment}")
        if not 0 <= self.min_confidence <= 1:
            raise ConfigError(f"filter min_confidence must lie in 0 .. 1, got {self.min_confidence:g}")
        if self.depth is not None:
            _check_limits(self.depth, "depth", ("near:far",))
        if self.box is not None:
            _check_limits(self.box, "box", BOX_KEYS)

    def as_dict(self) -> dict[str, Any]:
        """Plain data; a side without a limit is None."""
        return {key: _limits(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> FilterSettings:
        """The settings that `as_dict` (or `dataclasses.asdict`) described; absent members have their defaults.

        Raises:
            ConfigError: an unknown member, or a value that makes no sense.
        """
        known = {field.name for field in fields(cls)}
        if unknown := set(content) - known:
            raise ConfigError(f"unknown filter {sorted(unknown)[0]!r}", hint=f"filters: {', '.join(sorted(known))}")
        members = {key: value for key, value in content.items() if value is not None}
        try:
            for key in ("depth", "box"):
                if key in members:
                    members[key] = _unlimited(members[key])
            return cls(**members)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"filters: {error}") from error


def parse_depth(text: str) -> tuple[float, float]:
    """`NEAR:FAR` in mm, either side may be empty (no limit).

    Raises:
        ConfigError: not of that form, or near is not below far.
    """
    return _parse(text, "depth", ("near:far",))[0]


def parse_box(text: str) -> tuple[float, float, float, float, float, float]:
    """`XMIN:XMAX,YMIN:YMAX,ZMIN:ZMAX` in mm, each side may be empty (no limit).

    Raises:
        ConfigError: not of that form, or a minimum is not below its maximum.
    """
    x, y, z = _parse(text, "box", BOX_KEYS)
    return (*x, *y, *z)


def _parse(text: str, name: str, keys: tuple[str, ...]) -> list[tuple[float, float]]:
    form = ",".join(keys)
    parts = [part.split(":") for part in text.split(",")]
    if len(parts) != len(keys) or any(len(part) != 2 for part in parts):
        raise ConfigError(f"{name} must be {form} in mm, got {text!r}", hint=f"for example {_EXAMPLES[name]}")
    try:
        limits = [
            (float(low) if low.strip() else -math.inf, float(high) if high.strip() else math.inf) for low, high in parts
        ]
    except ValueError as error:
        raise ConfigError(f"{name} must be numbers {form} in mm, got {text!r}") from error
    _check_limits(tuple(limit for pair in limits for limit in pair), name, keys)
    return limits


def _limits(limits: tuple[float, ...]) -> list[float | None]:
    return [limit if math.isfinite(limit) else None for limit in limits]


def _unlimited(limits: Sequence[float | None]) -> tuple[float, ...]:
    sides = (-math.inf, math.inf)
    return tuple(sides[i % 2] if limit is None else float(limit) for i, limit in enumerate(limits))


_EXAMPLES = {"depth": "1100:1300", "box": "-100:100,-80:80,1100:1300"}


def _check_limits(limits: tuple[float, ...], name: str, keys: tuple[str, ...]) -> None:
    if len(limits) != 2 * len(keys):
        raise ConfigError(f"filter {name} takes {2 * len(keys)} numbers ({','.join(keys)}), got {len(limits)}")
    for key, low, high in zip(keys, limits[::2], limits[1::2], strict=True):
        if not low < high:
            raise ConfigError(f"filter {name}: {key} must be given smaller first, got {low:g}:{high:g}")
