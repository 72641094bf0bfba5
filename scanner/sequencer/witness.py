"""What the content of the frames says about their order: the witnesses. Pure: thumbnails in, findings out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from scanner.devices import Pixels
from scanner.patterns import PatternSequence


@dataclass(frozen=True)
class Witness:
    """One finding. `value` is held against `limit`; `frames` are positions."""

    name: str
    passed: bool
    value: float
    limit: float
    frames: tuple[int, ...] = ()
    says: str = ""
    whole: bool = False
    """the order of the whole sequence is in doubt: single retakes cannot mend it"""

    def as_dict(self) -> dict[str, Any]:
        """Plain data for capture.json."""
        return {
            "name": self.name,
            "passed": self.passed,
            "value": float(self.value),
            "limit": float(self.limit),
            "frames": list(self.frames),
            "says": self.says,
        }


@dataclass(frozen=True)
class Witnesses:
    """All findings of a capture, and what they could not have revealed."""

    items: tuple[Witness, ...] = ()
    cannot_reveal: tuple[str, ...] = ()
    hint: str | None = None

    @property
    def suspects(self) -> tuple[int, ...]:
        """Positions of frames that content speaks against."""
        return tuple(sorted({frame for item in self.items if not item.passed for frame in item.frames}))

    @property
    def whole(self) -> bool:
        """Whether the order of the whole sequence is in doubt."""
        return any(item.whole and not item.passed for item in self.items)

    @property
    def passed(self) -> bool:
        """Whether nothing speaks against the plan."""
        return all(item.passed for item in self.items)

    def joined(self, other: Witnesses) -> Witnesses:
        """The findings of two repetitions together."""
        cannot = tuple(dict.fromkeys((*self.cannot_reveal, *other.cannot_reveal)))
        return Witnesses((*self.items, *other.items), cannot, self.hint or other.hint)

    def as_list(self) -> list[dict[str, Any]]:
        """Plain data for capture.json's `witnesses`."""
        return [item.as_dict() for item in self.items]


def witness(sequence: PatternSequence, thumbnails: Mapping[int, Pixels], max_value: int) -> Witnesses:
    """Question the frames of one repetition.

    Args:
        thumbnails: by position, (h, w) uint8 or uint16 each, all of one size; absent positions are missing frames.
        max_value: the camera's largest grey level.
    """
    found: Sequence[Witness] = ()
    return Witnesses(tuple(found))
