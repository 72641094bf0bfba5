"""The orders in which code frames may have come, each as what would put it right. Pure combinatorics, no pixels.

Not every permutation: those that displays, drivers and people make. Pairs change places, a bit is taken for its
inverse, a run of bits is turned by a place or two, all is backwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import combinations

MAX_TURN = 2
"""Places by which a part of the bits may be turned; all of them together by any number."""


@dataclass(frozen=True)
class Order:
    """What to read as bit i: bit `bits[i]` of the capture, `inverted[i]` or not."""

    bits: tuple[int, ...]
    inverted: tuple[bool, ...]
    says: str

    @property
    def moved(self) -> tuple[int, ...]:
        """Bits that this order changes."""
        pairs = enumerate(zip(self.bits, self.inverted, strict=True))
        return tuple(i for i, (bit, inverted) in pairs if bit != i or inverted)


@cache
def as_captured(count: int) -> Order:
    """The order in which the frames claim to be."""
    return Order(tuple(range(count)), (False,) * count, "as they are")


@cache
def orders_of(count: int, *, inverse: bool) -> tuple[Order, ...]:
    """Every other order of `count` bits that is looked at. inverse: each bit has an inverse it may be taken for."""
    plain, none, every = tuple(range(count)), (False,) * count, (True,) * count
    found: dict[tuple[tuple[int, ...], tuple[bool, ...]], Order] = {}

    def add(bits: tuple[int, ...], inverted: tuple[bool, ...], says: str) -> None:
        if (bits, inverted) != (plain, none):
            found.setdefault((bits, inverted), Order(bits, inverted, says))

    if inverse:
        for bit in plain:
            add(plain, tuple(i == bit for i in plain), "exchanged")
        for a, b in combinations(plain, 2):
            add(plain, tuple(i in (a, b) for i in plain), "each exchanged with its inverse")
        add(plain, every, "each exchanged with its inverse")
        add(plain[::-1], every, "reversed")
    for a, b in combinations(plain, 2):
        swapped = list(plain)
        swapped[a], swapped[b] = b, a
        add(tuple(swapped), none, "exchanged")
    add(plain[::-1], none, "reversed")
    for first, last in combinations(plain, 2):
        part = plain[first : last + 1]
        turns = range(1, len(part)) if len(part) == count else (*range(1, MAX_TURN + 1), *range(-MAX_TURN, 0))
        for turn in turns:
            turned = part[turn % len(part) :] + part[: turn % len(part)]
            add((*plain[:first], *turned, *plain[last + 1 :]), none, "turned round")
    return tuple(found.values())
