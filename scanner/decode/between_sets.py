"""Frames out of step that only the steps between frequencies tell: of sets of three and four shifts, and of them all.

Two of three frames that changed places turn the set's phase round, and leave no residual; nor do two of four, half a
turn apart, nor a frame of three that shows something else. But its fringes count others', or are counted by them: what
each step leaves is then different at every pixel, and next to nothing once the frames are taken for what they show.
So each fault is tried at a sample of pixels. A frame that is not used has its set's mean light from the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.agreement import remainders_of
from scanner.decode.frame_orders import owed
from scanner.decode.pmp_frames import AxisFrames, design_matrix
from scanner.decode.sample_kernels import MIN_PIXELS
from scanner.decode.unwrapping import Ladder
from scanner.patterns import PmpPattern

EXPLAINED = 0.35
"""Of what a step's remainders scatter, or a set leaves, at the most once the fault is taken into account"""

LEAST_SCATTER = 0.05
"""1 less the mean vector of a step's remainders, from where on faults are looked for: normal errors of .05 fringes"""

LEAST_LEFT = 0.01
"""Of a set's squared height: mean square of what its fit leaves of a frame, from where on faults are looked for"""

SLACK = 0.02
"""By which no other step may scatter more"""

EQUALLY = 0.15
"""Of what the best explanation takes off: another one that takes off as much but for this cannot be told from it"""

MOST_SHIFTS = 4
"""Of sets whose own faults are looked for here: larger ones have residuals that tell them."""

Place = tuple[int, int]
"""(set, shift) of a frame"""


@dataclass(frozen=True)
class Disorder:
    """One fault. exchanged: two frames that have each other's place. foreign: a frame that shows nothing of its set.
    late: 1 where every frame, of `of_set` or of all sets, shows what the one before it should; -1: the one after it."""

    exchanged: tuple[Place, ...] = ()
    foreign: Place | None = None
    late: int = 0
    of_set: int | None = None

    @property
    def sets(self) -> tuple[int, ...]:
        """Whose frames are concerned; none: all."""
        if self.late:
            return () if self.of_set is None else (self.of_set,)
        places = self.exchanged if self.foreign is None else (self.foreign,)
        return tuple(sorted({k for k, _ in places}))

    def taken(self, there: Sequence[Sequence[int]]) -> dict[int, list[tuple[int, Place]]]:
        """By set whose frames are not all in their places: shifts, and the places where they are found.

        Args:
            there: by set, the shifts there are.
        """
        places = [(k, n) for k, have in enumerate(there) for n in have]
        if self.late:
            mine = places if self.of_set is None else [place for place in places if place[0] == self.of_set]
            found = dict(pairwise(mine[:: self.late]))
        elif self.foreign is not None:
            found = {place: place for place in places if place != self.foreign and place[0] == self.foreign[0]}
        else:
            one, two = self.exchanged
            found = {place: place for place in places if place[0] in self.sets} | {one: two, two: one}
        taken: dict[int, list[tuple[int, Place]]] = {}
        for (k, n), place in found.items():
            taken.setdefault(k, []).append((n, place))
        return taken

    def says(self, position: Callable[[int, int], int]) -> str:
        """In words. position: of (set, shift) in the sequence."""
        if self.late:
            whose = "every frame" if self.of_set is None else "every frame of the set"
            return f"{whose} shows what the one {'before' if self.late > 0 else 'after'} it should"
        if self.foreign is not None:
            return f"frame {position(*self.foreign)} shows nothing of its set"
        one, two = (position(*place) for place in self.exchanged)
        return f"frames {one} and {two} changed places"


def disorders(
    faults: Iterable[Disorder],
    pattern: PmpPattern,
    frames: AxisFrames,
    at: NDArray[np.intp],
    ladder: Ladder,
    along: int,
) -> tuple[Disorder, ...]:
    """Those of the faults that explain why steps scatter, and cannot be told from one another; none where nothing does.

    Args:
        at: (p,) pixels of a sample with light in them. along: projector pixels along the axis.
    """
    if at.size < MIN_PIXELS or len(frames.there) < 2:
        return ()
    judge = _Judge(pattern, frames, at, ladder, 0.5 + (pattern.origin - 0.5) / along)
    if not judge.scatters:
        return ()
    scores = [(score, one) for one in faults if (score := judge.score(one)) is not None]
    if not scores:
        return ()
    best = min(score for score, _ in scores)
    return tuple(
        one for score, one in sorted(scores, key=lambda s: s[0]) if score < best + EQUALLY * (judge.meant - best)
    )


def told_of(
    these: Sequence[Disorder], mended: bool, axis: str, pattern: PmpPattern, position: Callable[[int, int], int]
) -> str:
    """Faults that cannot be told from one another, in words. position: of (set, shift) in the sequence."""
    sets = sorted({k for one in these for k in one.sets})
    named = " and ".join(f"{pattern.frequencies[k]:g}" for k in sets)
    what = ", or ".join(dict.fromkeys(one.says(position) for one in these))
    if not sets:
        return f"along {axis} {what}: the sequence is out of step"
    done = (
        ", and were taken in each other's place"
        if mended
        else f": the {'set is' if len(sets) == 1 else 'sets are'} out of step"
    )
    return f"{'frequency' if len(sets) == 1 else 'frequencies'} {named} along {axis}: {what}{done}"


def exchange(frames: dict[int, NDArray[Any]], one: int, two: int) -> None:
    """Two frames take each other's place. frames: by fringe index, changed."""
    frames[one], frames[two] = frames[two], frames[one]


def faults_of_all(shifts: Sequence[int]) -> Iterator[Disorder]:
    """Of the whole sequence. shifts: of each set that is whole, else 0 (`AxisFrames.shifts`)."""
    if all(shifts):
        yield from (Disorder(late=by) for by in (1, -1))


def faults_of_few(shifts: Sequence[int]) -> Iterator[Disorder]:
    """Of sets of three and four shifts. shifts: see `faults_of_all`."""
    few = [k for k, count in enumerate(shifts) if 0 < count <= MOST_SHIFTS]
    for k in few:
        pairs = combinations(range(shifts[k]), 2)
        yield from (Disorder(exchanged=((k, n), (k, m))) for n, m in pairs if shifts[k] == 3 or m - n == 2)
        yield from (Disorder(foreign=(k, n)) for n in range(shifts[k]))
        yield from (Disorder(late=by, of_set=k) for by in (1, -1))
    for j, k in combinations(few, 2):
        yield from (Disorder(exchanged=((j, n), (k, m))) for n, m in product(range(shifts[j]), range(shifts[k])))


@dataclass(frozen=True)
class _Fit:
    """Of one set. level: (p,) mean light. heights: (2, p) B cos, B sin. left: variance of a sample, NaN where no frame
    is left to tell it."""

    level: NDArray[np.float64]
    heights: NDArray[np.float64]
    left: float

    @property
    def cycles(self) -> NDArray[np.float64]:
        return np.asarray(np.arctan2(self.heights[1], self.heights[0]) / (2 * np.pi))


class _Judge:
    """What steps and fits leave at a sample of pixels, by what the frames are taken to show."""

    def __init__(
        self, pattern: PmpPattern, frames: AxisFrames, at: NDArray[np.intp], ladder: Ladder, centre: float
    ) -> None:
        self._pattern, self._ladder, self._centre, self._there = pattern, ladder, centre, frames.there
        self._samples = {
            (k, n): frames.frames[first + i].reshape(-1)[at].astype(np.float64)
            for k, (first, have) in enumerate(zip(frames.starts.tolist(), frames.there, strict=False))
            for i, n in enumerate(have)
        }
        self._fits = [self._fit(k, [(n, (k, n)) for n in have]) for k, have in enumerate(frames.there)]
        self._left = np.array([fit.left for fit in self._fits])
        self._floor = LEAST_LEFT * np.array([np.mean(np.sum(fit.heights**2, axis=0)) for fit in self._fits])
        self._high = self._left > self._floor
        steps = self._steps(self._fits)
        self._apart, self._scatter = 1 - steps.real, 1 - np.abs(steps)
        self.meant = float(np.sum(self._apart) + np.count_nonzero(self._high))

    @property
    def scatters(self) -> bool:
        """Whether there is anything to explain."""
        return bool((self._scatter > LEAST_SCATTER).any() or self._high.any())

    def score(self, fault: Disorder) -> float | None:
        """What is left to be explained, of `meant`; None where it is not much less in one step or set, or more in
        another one."""
        fits, taken = list(self._fits), fault.taken(self._there)
        if self._is_light(fault):
            return None
        # Sets of less than three frames come last: others' mean light is known by then.
        for k, frames in sorted(taken.items(), key=lambda one: len(one[1]) < 3):
            others = [fit.level for j, fit in enumerate(fits) if j != k and len(taken.get(j, "all")) > 2]
            if not others:
                return None
            fits[k] = self._fit(k, frames, np.median(others, axis=0))
        apart, left = 1 - self._steps(fits).real, np.array([fit.left for fit in fits])
        judged = ~np.isnan(left)
        if (apart > np.maximum(self._apart, self._scatter) + SLACK).any():
            return None
        if (left[judged] > 1.1 * np.maximum(self._left[judged], self._floor[judged])).any():
            return None
        better = (self._scatter > LEAST_SCATTER) & (apart < EXPLAINED * self._scatter)
        if not better.any() and not (self._high & (left < EXPLAINED * self._left)).any():
            return None
        return float(np.sum(apart) + np.nansum(left[self._high] / self._left[self._high]))

    def _is_light(self, fault: Disorder) -> bool:
        """Whether what would be foreign is its set's own fringe, weaker, stronger or moved: light has changed then."""
        place = fault.foreign
        if fault.late and fault.of_set is not None:
            place = fault.of_set, self._there[fault.of_set][0 if fault.late > 0 else -1]
        if place is None:
            return False
        k, n = place
        others = np.median([fit.level for j, fit in enumerate(self._fits) if j != k], axis=0)
        fit = self._fit(k, [(m, (k, m)) for m in self._there[k] if m != n], others)
        due = design_matrix(self._pattern, self._pattern.shifts[k], (n,))[0, 1:] @ fit.heights
        return owed(fit.level, due, self._samples[place])

    def _fit(self, k: int, frames: Sequence[tuple[int, Place]], others: NDArray[np.float64] | None = None) -> _Fit:
        """Of the frames at some places, by the shifts that they show. others: other sets' level, for less than three"""
        design = design_matrix(self._pattern, self._pattern.shifts[k], [n for n, _ in frames])
        seen = np.array([self._samples[place] for _, place in frames])
        if len(frames) < 3 and others is not None:
            return _Fit(others, np.linalg.pinv(design[:, 1:]) @ (seen - others), np.nan)
        found = np.linalg.pinv(design) @ seen
        freedom = len(frames) - 3
        left = float(np.mean(np.sum((seen - design @ found) ** 2, axis=0))) / freedom if freedom else np.nan
        return _Fit(found[0], found[1:], left)

    def _steps(self, fits: Sequence[_Fit]) -> NDArray[np.complex128]:
        """(J - 1,) mean vectors of what steps leave."""
        left = remainders_of(self._ladder, np.array([fit.cycles for fit in fits]), self._centre)
        return np.array([np.mean(np.exp(2j * np.pi * r)) for r in left], np.complex128)
