"""A pattern sequence: every image that one capture projects, in order, made on demand.

Fringe images come from the method's pattern; around and among them stand full-on and full-off frames (white,
black, sentinels) and order bars. Pre-correction for the projector's response is applied here, to all of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError
from scanner.patterns.description import Axis, FrameRole, Pattern, ProjectorSize, read_number, read_numbers
from scanner.patterns.methods import pattern_from_description

SENTINELS_BEFORE = (0.0, 1.0, 0.0)
SENTINELS_AFTER = (1.0, 0.0, 1.0)
"""Light of the sentinels: black, white, black, and white, black, white. Their order tells the direction."""

BAR_COUNT = 31
"""Order bars: a maximal-length binary sequence, which matches neither its own shifts nor its mirror image."""


@dataclass(frozen=True)
class Precorrection:
    """What was applied at projection so that the light is linear: value = light^(1 / gamma), or a table.

    `table` has 256 entries: the projector's input value for linear light k / 255.
    """

    gamma: float | None = None
    table: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if (self.gamma is None) == (self.table is None):
            raise DecodeError("precorrection takes either gamma or table")
        if self.gamma is not None and not 0.1 <= self.gamma <= 10:
            raise DecodeError(f"gamma must lie in 0.1 .. 10, got {self.gamma:g}")
        if self.table is not None:
            values = np.asarray(self.table)
            if len(values) != 256 or not np.isfinite(values).all() or values.min() < 0 or values.max() > 255:
                raise DecodeError("a precorrection table has 256 numbers in 0 .. 255")
            if (np.diff(values) < 0).any() or values[0] == values[-1]:
                raise DecodeError(
                    "a precorrection table falls, or is flat: more light would need no more input",
                    hint="entry k is the projector's input, 0 .. 255, for linear light k / 255",
                )

    def apply(self, light: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Linear light 0..1 to the projector's input values."""
        if self.gamma is not None:
            value = np.power(light, 1 / self.gamma) * 255
        else:
            value = np.interp(light * 255, np.arange(256), np.asarray(self.table, dtype=np.float64))
        return np.asarray(np.rint(value), dtype=np.uint8)

    def describe(self) -> dict[str, Any]:
        """The member of formats.md."""
        return {"gamma": self.gamma} if self.gamma is not None else {"table": list(self.table or ())}


@dataclass(frozen=True)
class PatternSequence:
    """Images by position in the frame list.

    white, black, sentinels and bars are positions; fringe images are at all others, in order. `sentinels` holds six
    positions: three before everything, three after. `bars` names one position for each axis.
    """

    projector: ProjectorSize
    pattern: Pattern
    white: int | None = None
    black: int | None = None
    sentinels: tuple[int, ...] = ()
    bars: Mapping[Axis, int] = field(default_factory=dict)
    precorrection: Precorrection | None = None

    def __post_init__(self) -> None:
        special = self._special()
        if len(set(special)) != len(special):
            raise DecodeError("white, black, sentinels and bars must be different positions")
        if any(not 0 <= position < len(self) for position in special):
            raise DecodeError(f"white, black, sentinels and bars must be positions in 0 .. {len(self) - 1}")
        if strange := set(self.bars) - set(getattr(self.pattern, "axes", ())):
            raise DecodeError(f"order bars along {', '.join(sorted(strange))}: the pattern does not measure that axis")
        if self.sentinels and len(self.sentinels) != len(SENTINELS_BEFORE + SENTINELS_AFTER):
            raise DecodeError(f"a bracketed sequence has 6 sentinels, got {len(self.sentinels)}")

    @classmethod
    def bracketed(
        cls,
        projector: ProjectorSize,
        pattern: Pattern,
        precorrection: Precorrection | None = None,
        *,
        white: bool = False,
    ) -> PatternSequence:
        """The sequence to capture: a multi-frame pattern gets sentinels, order bars and what its method needs.

        One-frame patterns are projected alone, unless `white` asks for a full-on and a full-off frame beside them.

        Raises:
            DecodeError: the pattern does not fit the projector.
        """
        pattern.validate(projector)
        if pattern.fringe_count == 1 and not white:
            return cls(projector, pattern, precorrection=precorrection)
        before, after = len(SENTINELS_BEFORE), len(SENTINELS_AFTER)
        axes: tuple[Axis, ...] = getattr(pattern, "axes", ())
        full, dark = (before, before + 1) if pattern.method == "gray" or white else (None, None)
        first = before + (2 if full is not None else 0) + pattern.fringe_count
        bars = {axis: first + i for i, axis in enumerate(axes)} if pattern.method in ("pmp", "gray", "gray+pmp") else {}
        end = first + len(bars)
        sentinels = (*range(before), *range(end, end + after))
        return cls(projector, pattern, full, dark, sentinels, bars, precorrection)

    @classmethod
    def from_description(cls, projector: ProjectorSize, description: Mapping[str, Any]) -> PatternSequence:
        """Read a description of formats.md.

        Raises:
            DecodeError: a member is missing or wrong, or the pattern does not fit the projector.
        """
        pattern = pattern_from_description(description)
        pattern.validate(projector)
        bars = description.get("bars") or {}
        if not isinstance(bars, Mapping) or any(axis not in ("x", "y") for axis in bars):
            raise DecodeError(f'pattern member "bars" must map axes to positions, got {bars!r}')
        sentinels = description.get("sentinels") or []
        if not isinstance(sentinels, list | tuple):
            raise DecodeError(f'pattern member "sentinels" must be a list of positions, got {sentinels!r}')
        for position in (*sentinels, *bars.values()):
            _required_position(position, "sentinels or bars")
        return cls(
            projector,
            pattern,
            white=_position(description.get("white"), "white"),
            black=_position(description.get("black"), "black"),
            sentinels=tuple(p for p in sentinels if p not in bars.values()),
            bars=dict(bars),
            precorrection=read_precorrection(description.get("precorrection")),
        )

    def _special(self) -> tuple[int, ...]:
        single = tuple(p for p in (self.white, self.black) if p is not None)
        return (*single, *self.sentinels, *self.bars.values())

    def __len__(self) -> int:
        return self.pattern.fringe_count + len(self._special())

    @property
    def fringes(self) -> tuple[int, ...]:
        """Positions of the fringe frames, in the pattern's order."""
        special = set(self._special())
        return tuple(p for p in range(len(self)) if p not in special)

    def role(self, position: int) -> FrameRole:
        """What the frame at `position` is for."""
        if position == self.white:
            return FrameRole.WHITE
        if position == self.black:
            return FrameRole.BLACK
        if position in self.sentinels:
            return FrameRole.SENTINEL
        return FrameRole.BARS if position in self.bars.values() else FrameRole.FRINGE

    def light(self, position: int) -> NDArray[np.float32]:
        """Linear light 0..1 of the image at `position`: (height, width) float32, possibly a broadcast view."""
        if not 0 <= position < len(self):
            raise IndexError(position)
        shape = (self.projector.height, self.projector.width)
        match self.role(position):
            case FrameRole.WHITE:
                return np.broadcast_to(np.float32(1), shape)
            case FrameRole.BLACK:
                return np.broadcast_to(np.float32(0), shape)
            case FrameRole.SENTINEL:
                level = (SENTINELS_BEFORE + SENTINELS_AFTER)[self.sentinels.index(position)]
                return np.broadcast_to(np.float32(level), shape)
            case FrameRole.BARS:
                axis = next(axis for axis, p in self.bars.items() if p == position)
                line = bar_light(np.arange(self.projector.along(axis)), self.projector.along(axis))
                return np.broadcast_to(line[:, None] if axis == "y" else line[None, :], shape)
            case FrameRole.FRINGE:
                return self.pattern.fringe(self.fringes.index(position), self.projector)

    def image(self, position: int) -> NDArray[np.uint8]:
        """The image to project at `position`: (height, width) uint8, pre-corrected, C-contiguous."""
        light = self.light(position)
        if self.precorrection is not None:
            return np.ascontiguousarray(self.precorrection.apply(light))
        return np.rint(light * 255).astype(np.uint8)

    def describe(self) -> dict[str, Any]:
        """The description of formats.md.

        `bars` is an addition of ours, absent where there are none; their positions stand among the sentinels too, so
        that a reader who does not know them takes the same frames for fringes.
        """
        described: dict[str, Any] = {
            **self.pattern.describe(),
            "white": self.white,
            "black": self.black,
            "sentinels": sorted((*self.sentinels, *self.bars.values())),
            "precorrection": self.precorrection.describe() if self.precorrection else None,
        }
        if self.bars:
            described["bars"] = dict(self.bars)
        return described


@dataclass(frozen=True)
class PartSequence(PatternSequence):
    """One method's images among those of a sequence that has two, at the positions they have there."""

    chosen: tuple[int, ...] = ()
    """positions of this method's images, in the pattern's order"""
    total: int = 0
    """positions in all"""

    def __len__(self) -> int:
        return self.total

    @property
    def fringes(self) -> tuple[int, ...]:
        """Positions of this method's images alone."""
        return self.chosen

    @classmethod
    def of(cls, whole: PatternSequence, pattern: Pattern, first: int) -> PartSequence:
        """The part of `whole` whose images are `pattern`'s and begin at its fringe `first`."""
        chosen = whole.fringes[first : first + pattern.fringe_count]
        return cls(
            whole.projector, pattern, whole.white, whole.black, whole.sentinels, whole.bars, whole.precorrection,
            chosen, len(whole),
        )  # fmt: skip


def bar_light(position: NDArray[Any], size: int) -> NDArray[np.float32]:
    """Light (0 or 1) of the order bars at projector coordinate `position`, on a projector `size` px along the axis."""
    bar = np.clip((np.asarray(position) + 0.5) * (BAR_COUNT / size), 0, BAR_COUNT - 1).astype(np.intp)
    return _maximal_length_sequence()[bar]


def _maximal_length_sequence() -> NDArray[np.float32]:
    # Fibonacci register of x^5 + x^2 + 1, period 31 (Golomb 1967): each cyclic shift differs in 16 places of 31.
    state, bits = 1, []
    for _ in range(BAR_COUNT):
        bits.append(state & 1)
        state = (state >> 1) | ((state ^ (state >> 2)) & 1) << 4
    return np.array(bits, dtype=np.float32)


def _position(value: Any, key: str) -> int | None:
    return None if value is None else _required_position(value, key)


def _required_position(value: Any, key: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise DecodeError(f'pattern member "{key}" must be a position in the frame list, got {value!r}')
    return value


def read_precorrection(value: Any) -> Precorrection | None:
    """A description's "precorrection".

    Raises:
        DecodeError: it is none.
    """
    if value is None:
        return None
    if not isinstance(value, Mapping):
        raise DecodeError(
            f'pattern member "precorrection" must be null, {{"gamma": g}} or {{"table": [...]}}, got {value!r:.80}'
        )
    given = {f"precorrection.{key}": member for key, member in value.items() if member is not None}
    gamma, table = "precorrection.gamma", "precorrection.table"
    return Precorrection(
        gamma=read_number(given, gamma) if gamma in given else None,
        table=read_numbers(given, table) if table in given else None,
    )
