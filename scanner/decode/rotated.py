"""Sets of fringes that are out of step as a whole: each of their frames shows the next shift, or one farther on.

Such a set fits its fringe without a rest; its phase is off by so many shifts at every pixel. What steps between
frequencies leave is then off by the same at every pixel, too, and tells which set it may be, unless the error is whole
fringes in every step: that only an absolute witness sees (the sequencer's order bars), and `cannot_reveal` says so.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from scanner.decode.agreement import Remainder
from scanner.decode.sample_kernels import MIN_PIXELS
from scanner.decode.unwrapping import Ladder, plan_ladder

LEAST_OFFSET = 0.045
"""Of a fringe, mean of what a step leaves, from where on a set may be out of step: one of 16 shifts makes .0625. Other
causes leave .015 at the most in simulated scenes, with 3 % of flicker .025 where sets have four shifts or more."""

APART, APART_SPREAD = 0.005, 0.12
"""Of a fringe, from what a rotation leaves of any step: of rotated sets means are right to .001 with four shifts and
more; with three, whose remainders overtones of the response spread, to an eighth of their sigma."""

LEAST_AGREEMENT = 0.85
"""Of the pixels' remainders: a rotation is the same at all of them, and light that surfaces throw at one another is
not. Noise of .09 fringes and gamma 1.3 at three shifts leave that much."""


@dataclass(frozen=True)
class Rotated:
    """by: shifts that a set is off, in the sense of its phase; of_set: its number, or None: all sets by as many."""

    of_set: int | None
    by: int

    def says(self, frequencies: Sequence[float], shifts: Sequence[int]) -> str:
        """In words."""
        if self.of_set is None:
            return "every frequency by one shift"
        count, n = shifts[self.of_set], min(self.by, shifts[self.of_set] - self.by)
        return f"frequency {frequencies[self.of_set]:g} by {n} of its {count} shifts"


def rotated_sets(ladder: Ladder, steps: Sequence[Remainder], shifts: Sequence[int]) -> tuple[Rotated, ...]:
    """Rotations that explain what every step leaves, where that is more than other causes make; any one of them.

    Args:
        steps: of the ladder. shifts: by set, of the pattern.
    """
    apart = [s for s in steps if abs(s.offset) >= LEAST_OFFSET]
    if not apart or not all(map(_alike_everywhere, apart)) or min(s.pixels for s in steps) < MIN_PIXELS:
        return ()
    seen, most = np.array([s.offset for s in steps]), np.array([_most_apart(s) for s in steps])
    return tuple(
        rotated
        for rotated in _rotations(shifts)
        if (np.abs(_folded(ladder.climb(_turns(rotated, shifts))[0] - seen)) < most).all()
    )


def still_apart(axis: str, steps: Sequence[Remainder]) -> tuple[str, ...]:
    """What a user should know where frames were put in step, and steps still leave the same at every pixel.

    Other causes than frames out of step may leave as much (a scene that drifts, light that surfaces throw at one
    another); beside frames that were out of step nobody can tell.
    """
    if not any(abs(s.offset) >= LEAST_OFFSET and _alike_everywhere(s) for s in steps):
        return ()
    return (
        f"along {axis} frequencies differ by the same part of a fringe at every pixel without these frames, too: more "
        "of them are out of step; capture again",
    )


def out_of_step(
    axis: str, rotated: Sequence[Rotated], frequencies: Sequence[float], shifts: Sequence[int]
) -> tuple[str, ...]:
    """What a user should know of `rotated_sets`."""
    if not rotated:
        return ()
    named = dict.fromkeys(one.says(frequencies, shifts) for one in rotated)
    return (
        f"along {axis} frequencies differ by the same part of a fringe at every pixel: {' or '.join(named)} out of "
        "step; capture again",
    )


@lru_cache(maxsize=32)
def cannot_reveal(frequencies: tuple[float, ...], shifts: tuple[int, ...]) -> tuple[str, ...]:
    """Faults of order that frames of these sets would not show, for a report."""
    ladder = plan_ladder(frequencies, [2 / n for n in shifts])
    found = []
    for k, (frequency, count) in enumerate(zip(frequencies, shifts, strict=True)):
        hidden = [n for n in range(1, count) if _is_hidden(ladder, Rotated(k, n), shifts)]
        if hidden:
            turns = ", ".join(map(str, hidden))
            found.append(f"frequency {frequency:g} shown {turns} of its {count} shifts late or early as a whole")
    if set(shifts) == {3} and len(shifts) > 1 and _is_hidden(ladder, Rotated(None, 1), shifts):
        found.append("every frame of the sequence one late or early")
    if len(shifts) == 1 and shifts[0] in (3, 4):
        found.append("two frames exchanged" if shifts[0] == 3 else "two frames half a turn apart exchanged")
    return tuple(found)


def hides_late_set(ladder: Ladder, of_set: int, by: int, shifts: Sequence[int]) -> bool:
    """Whether no step would tell that a set shows each shift `by` too late, 1, or too early, -1."""
    return _is_hidden(ladder, Rotated(of_set, by), shifts)


def _is_hidden(ladder: Ladder, rotated: Rotated, shifts: Sequence[int]) -> bool:
    return bool(np.abs(ladder.climb(_turns(rotated, shifts))[0]).max(initial=0.0) < LEAST_OFFSET)


def _alike_everywhere(step: Remainder) -> bool:
    return step.agreement >= LEAST_AGREEMENT


def _most_apart(step: Remainder) -> float:
    # Mardia 1972, sec. 3.4: of normal errors of sigma s the mean vector is e^(-s^2 / 2) long.
    return APART + APART_SPREAD * float(np.sqrt(-2 * np.log(min(step.agreement, 1.0)))) / (2 * np.pi)


def _rotations(shifts: Sequence[int]) -> Iterator[Rotated]:
    for k, count in enumerate(shifts):
        yield from (Rotated(k, n) for n in range(1, count))
    for n in (1, -1):
        yield Rotated(None, n)


def _turns(rotated: Rotated, shifts: Sequence[int]) -> NDArray[np.float64]:
    """(K,) cycles that the sets' phases are off."""
    turns = np.zeros(len(shifts))
    for k, count in enumerate(shifts):
        if rotated.of_set in (k, None):
            turns[k] = rotated.by / count
    return turns


def _folded(cycles: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(cycles - np.rint(cycles))
