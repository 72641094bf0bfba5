"""Do fringes and code name the same places? A check of Gray + PMP on whole maps, not on pixels.

A wrong `offset`, frequency or order of the fringe frames leaves no residual in one fringe set, and the code puts every
phase on some fringe all the same. But where both are right, the phase's place lies within its cell, on the average in
the middle of it. So the distance between the two tells of a shift that is constant (offset, rotated shifts), of one
that grows along the projector (frequency), and of fringes that run the other way (sign): there it is anything at all.

Code images out of order leave the parity of a cell, and so nothing that the phase could contradict. But from one cell
to the next a pixel further on, the number grows by one, but for edges of depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError
from scanner.patterns.description import Axis

SAMPLES = 200_000
"""About as many pixels are looked at; a cell of the code then has hundreds."""

LEAST_IN_CELL = 8
CELLS_TOGETHER = 8
"""Neighbouring cells judged together. One that a shadow cuts is off its middle by an eighth of a fringe; that all of
eight are cut alike takes a grating."""

MOST_SHIFTED = 1 / 16
"""Of a fringe: a quarter of the way to a cell's border. Gamma, blur and texture move the borders of cells either way;
in eleven simulated scenes no eight cells together were shifted by more than .027."""

MOST_GROUPS = 0.2
"""Share of the groups of cells that may be shifted by more: surfaces that a narrow thing covers."""

TOLD_SHIFT = 0.02
CELLS_TO_TELL = 16
"""A mean over as many cells that is shifted by more than TOLD_SHIFT of a fringe is worth a warning: in the same scenes
it was shifted by .003 at most."""

LEAST_FOLLOWING = 0.6
"""Of what a cell's width makes of the mean direction of distances (a full turn being a fringe): phases that do not
follow the code point anywhere, and their mean is short."""


MOST_JUMPS = 0.1
"""Of the borders between cells, those where the number changes by two or more: edges of depth. Eleven simulated scenes
have .016 at most, code images out of order .15 and more. Coarse bits make few borders, and are judged one by one."""

LEAST_BORDERS = 500

MOST_JUMPS_OF_BIT = 0.5
"""Of the borders where one bit of the Gray code changes and no other, those where the number changes by two or more.
Two images that changed places make both bits jump at every border, however few they have. One bit alone may: along an
edge of depth that hides its borders and happens to lie halfway."""

LEAST_BORDERS_OF_BIT = 100

LEAST_HEALED = 100
HEALED_OVER_BROKEN = 4
"""Another order is believed where so many borders that jump are none in it, and so many times those that begin to jump:
in the right order every border of both bits does. The healed ones are of two kinds at least: one edge of depth along
the fringes may hide a border, and lie just so that it looks like another's."""

MOST_BEYOND = 0.02
"""Of the pixels that show fringes, those whose cell lies beyond the projector, where no light comes from: none in nine
simulated scenes; .04 to .22 where coarse bits changed places and the projector uses a part of their cells."""


@dataclass(frozen=True)
class PhaseAndCode:
    """How far the phase's places lie from the middle of their cells, along one axis. Shifts in parts of a fringe."""

    axis: Axis
    period_px: float
    groups: NDArray[np.float64]
    """(G,) mean shift of neighbouring cells, along the projector"""
    shift: float
    """mean shift of all cells"""
    following: float
    """0 to 1, where 1 is what phases of the code's cells give"""
    cells: int
    """that were seen well enough to be judged"""

    def require(self) -> None:
        """Raise DecodeError where fringes and code contradict each other in many places."""
        if not self.groups.size:
            return
        away = np.abs(self.groups) > MOST_SHIFTED
        if self.following >= LEAST_FOLLOWING and away.mean() <= MOST_GROUPS:
            return
        if self.following < LEAST_FOLLOWING:
            said, wrong = "do not follow the Gray code", "sign, frequency or order of the fringe frames"
        else:
            typical = float(np.median(np.abs(self.groups)))
            said = f"lie {typical:.2f} of a fringe ({typical * self.period_px:.1f} projector px) from the Gray code"
            grows = np.abs(np.exp(2j * np.pi * self.groups).mean()) < np.cos(2 * np.pi * MOST_SHIFTED)
            wrong = "frequency" if grows else "offset, origin or order of the fringe frames"
        raise DecodeError(
            f"along {self.axis} the fringes {said} in {100 * away.mean():.0f} % of the places: "
            f"frames and description contradict each other",
            hint=f"compare the description's {wrong} with what was projected",
        )

    def warning(self) -> str | None:
        """A shift that is small and everywhere, in words."""
        if self.cells < CELLS_TO_TELL or abs(self.shift) <= TOLD_SHIFT:
            return None
        return (
            f"along {self.axis} the fringes lie {self.shift * self.period_px:+.2f} projector px from the Gray code "
            f"({self.cells} cells): offset or origin of the description may be wrong"
        )

    def as_dict(self) -> dict[str, Any]:
        """For report.json."""
        return {"shift_px": self.shift * self.period_px, "following": self.following, "cells": self.cells}


def compare_phase_and_code(
    position: NDArray[np.float32],
    cells: NDArray[np.float32],
    sound: NDArray[np.bool_],
    axis: Axis,
    period_px: float,
    cell_px: float,
) -> PhaseAndCode:
    """Compare places by phase, on any fringe, with the middles of their cells by code.

    Args:
        position: (P,) projector px by the phase.
        cells: (P,) projector px, the middle of the cell that the code names.
        sound: (P,) where both were read.
        axis: along which.
        period_px: of the fringes, projector px.
        cell_px: of a cell of the code, projector px; at most half a period.
    """
    chosen = np.flatnonzero(sound)
    chosen = chosen[:: max(1, chosen.size // SAMPLES)]
    names, cell = np.unique(np.rint(cells[chosen] / cell_px).astype(np.int64), return_inverse=True)
    turns = np.exp(2j * np.pi * (position[chosen].astype(np.float64) - cells[chosen]) / period_px)
    count = np.bincount(cell, minlength=names.size)
    seen = count >= LEAST_IN_CELL
    summed = np.bincount(cell, turns.real, names.size) + 1j * np.bincount(cell, turns.imag, names.size)
    mean = summed[seen] / count[seen]
    whole = mean.size // CELLS_TOGETHER
    groups = mean[: whole * CELLS_TOGETHER].reshape(whole, CELLS_TOGETHER).mean(axis=1)
    return PhaseAndCode(
        axis=axis,
        period_px=period_px,
        groups=np.angle(groups) / (2 * np.pi),
        shift=float(np.angle(mean.sum()) / (2 * np.pi)),
        following=float(np.abs(groups).mean() / np.sinc(cell_px / period_px)) if whole else 0.0,
        cells=int(seen.sum()),
    )


def require_code_order(
    cells: NDArray[np.float32], sound: NDArray[np.bool_], beyond: int, axis: Axis, cell_px: float, *, gray: bool
) -> None:
    """Raise DecodeError where numbers of neighbouring cells jump: the code's images are not in the order described.

    Args:
        cells: (H, W) projector px, the middle of the cell that the code names. sound: (H, W) where it was read.
        beyond: how many more pixels name a cell beyond the projector.
        axis, cell_px: see `compare_phase_and_code`. gray: whether neighbouring cells differ in one bit.
    """
    numbers = np.zeros(cells.shape, np.int32)
    numbers[sound] = np.floor((cells[sound] + 0.5) / cell_px)
    pairs, counts = _borders(numbers, sound)
    jumped = np.abs(pairs[0] - pairs[1]) > 1
    borders, jumps = int(counts.sum()), int(counts[jumped].sum())
    said = f"along {axis} the Gray code jumps at"
    if borders >= LEAST_BORDERS and jumps > MOST_JUMPS * borders:
        said += f" {100 * jumps / borders:.0f} % of the borders of its cells"
    elif gray and len(jumping := _jumping_bits(_borders_of_bits(pairs, counts, jumped))) > 1:
        said += f" borders where one bit changes, of {len(jumping)} bits"
    elif (exchanged := _exchanged_bits(pairs, counts, gray=gray)) is not None:
        high, low = exchanged
        said += f" borders that are none with the bits of {2**high} and {2**low} cells exchanged"
    elif beyond > MOST_BEYOND * (seen := beyond + np.count_nonzero(sound)):
        said = (
            f"along {axis} the Gray code names cells beyond the projector at {100 * beyond / seen:.0f} % of the pixels"
        )
    else:
        return
    raise DecodeError(
        f"{said}: its frames are not in the order described",
        hint='compare the description\'s "bits", "code" and order of frames with what was projected',
    )


def _jumping_bits(borders: NDArray[np.int64]) -> NDArray[np.intp]:
    whole = np.maximum(borders.sum(axis=1), LEAST_BORDERS_OF_BIT)
    return np.flatnonzero(borders[:, 1] > MOST_JUMPS_OF_BIT * whole)


def _borders(numbers: NDArray[np.int32], sound: NDArray[np.bool_]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Each kind of border between cells, (2, B) smaller and larger number, and how many pixels it has, (B,)."""
    found = []
    for here, there in (np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1]):
        on_border = sound[here] & sound[there] & (numbers[here] != numbers[there])
        one, other = numbers[here][on_border].astype(np.int64), numbers[there][on_border]
        found.append(np.minimum(one, other) << 32 | np.maximum(one, other))
    kinds, counts = np.unique(np.concatenate(found), return_counts=True)
    return np.stack([kinds >> 32, kinds & 0xFFFFFFFF]).astype(np.int32), counts


def _borders_of_bits(
    pairs: NDArray[np.int32], counts: NDArray[np.int64], jumped: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """(32, 2) borders at which this bit of the Gray code changes and no other, to the next cell and to one further."""
    words = pairs ^ pairs >> 1
    changed = words[0] ^ words[1]
    alone = changed & (changed - 1) == 0
    bits = np.frexp(changed[alone].astype(np.float64))[1] - 1
    found = np.zeros(64, np.int64)
    np.add.at(found, bits * 2 + jumped[alone], counts[alone])
    return found.reshape(32, 2)


def _exchanged_bits(pairs: NDArray[np.int32], counts: NDArray[np.int64], *, gray: bool) -> tuple[int, int] | None:
    """Two bits, counted from the finest, whose exchange heals many borders and breaks few; None without such a pair."""
    if not counts.size:
        return None
    words = pairs ^ pairs >> 1 if gray else pairs
    jumped = np.abs(pairs[0] - pairs[1]) > 1
    for low, high in combinations(range(int(pairs.max()).bit_length()), 2):
        differ = (words >> low ^ words >> high) & 1
        one, other = _number_of(words ^ (differ << low | differ << high), gray=gray)
        jumps = np.abs(one - other) > 1
        healed, broken = jumped & ~jumps, jumps & ~jumped
        kinds = np.count_nonzero(counts[healed] > LEAST_HEALED / HEALED_OVER_BROKEN)
        if kinds > 1 and counts[healed].sum() > max(LEAST_HEALED, HEALED_OVER_BROKEN * counts[broken].sum()):
            return high, low
    return None


def _number_of(words: NDArray[np.int32], *, gray: bool) -> NDArray[np.int32]:
    """The numbers of cells that have these code words."""
    numbers = words.copy()
    for shift in (1, 2, 4, 8, 16) if gray else ():
        numbers ^= numbers >> shift
    return numbers
