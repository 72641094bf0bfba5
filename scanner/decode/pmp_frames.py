"""The frames of one PMP axis in the form kernels take them: where each lies, and what it weighs in its set's fit.

Knows which frames of a set are there, and neither noise nor fringe orders.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.addresses import addresses_of
from scanner.decode.pmp_sums import GROUP
from scanner.patterns import PmpPattern
from scanner.patterns.description import Axis


@dataclass(frozen=True)
class AxisFits:
    """What each set's frames weigh in its fit, by sets; F counts each set's up to a multiple of GROUP.

    there: which of each set's frames there are. starts: (K + 1,) intp, where sets begin. weights: (3, F) float32 of A,
    p and q. grams: (K, 6) float32 of the normal matrices. whole: (K,) shifts of sets that have all of their 4 or 8, or
    0. gains: (K,) variance of (p, q) over that of one sample. freedom: degrees of freedom of all sets' residuals.
    angles: of each set's shifts, radians; empty for a set that lost some.
    """

    there: tuple[tuple[int, ...], ...]
    starts: NDArray[np.intp]
    weights: NDArray[np.float32]
    grams: NDArray[np.float32]
    whole: NDArray[np.intp]
    gains: tuple[float, ...]
    freedom: int
    angles: tuple[NDArray[np.float64], ...]

    @property
    def shifts(self) -> tuple[int, ...]:
        """Of each set that is whole; 0 of one that lost frames."""
        return tuple(len(alpha) for alpha in self.angles)


@dataclass(frozen=True)
class AxisFrames(AxisFits):
    """The frames of one axis, and their fits. frames: kept while addresses are in use. addresses: (F,) intp."""

    frames: Sequence[NDArray[Any]]
    addresses: NDArray[np.intp]

    @property
    def like(self) -> NDArray[Any]:
        """An empty array of the frames' dtype."""
        return np.empty(0, self.frames[0].dtype)


def axis_frames(pattern: PmpPattern, axis: Axis, by_fringe: Mapping[int, NDArray[Any]]) -> AxisFrames:
    """The frames of `axis` that are there, at least three of each set.

    Args:
        by_fringe: frames without gaps in memory, by fringe index.
    """
    frames: list[NDArray[Any]] = []
    there = []
    for fringe_set in pattern.sets():
        if fringe_set.axis == axis:
            have = tuple(n for n in range(fringe_set.shifts) if fringe_set.first + n in by_fringe)
            frames += [by_fringe[fringe_set.first + n] for n in have + have[:1] * (-len(have) % GROUP)]
            there.append(have)
    fits = fits_of(pattern, tuple(there))
    return AxisFrames(**vars(fits), frames=frames, addresses=addresses_of(frames))


@lru_cache(maxsize=32)
def fits_of(pattern: PmpPattern, there: tuple[tuple[int, ...], ...]) -> AxisFits:
    """What frames weigh where only those are there that `there` names, of each set of an axis; three at least.

    Every scan of a rig asks for the same, and nobody writes into it.
    """
    starts, weights, grams, whole, gains, freedom = [0], [], [], [], [], 0
    angles: list[NDArray[np.float64]] = []
    for shifts, have in zip(pattern.shifts, there, strict=True):
        design = design_matrix(pattern, shifts, have)
        gram = design.T @ design
        inverse = np.linalg.inv(gram)
        padding = -len(have) % GROUP
        weights.append(np.pad(inverse @ design.T, ((0, 0), (0, padding))))
        grams.append([gram[0, 0], gram[1, 1], gram[2, 2], 2 * gram[0, 1], 2 * gram[0, 2], 2 * gram[1, 2]])
        whole.append(shifts if shifts == len(have) in (4, 8) else 0)
        gains.append(round(float(inverse[1, 1] + inverse[2, 2]) / 2, 9))
        freedom += len(have) - 3
        alpha = shift_angles(pattern, shifts, have)
        angles.append(alpha if len(have) == shifts else alpha[:0])
        starts.append(starts[-1] + len(have) + padding)
    return AxisFits(
        there, np.array(starts, np.intp),
        np.concatenate(weights, axis=1).astype(np.float32), np.array(grams, np.float32), np.array(whole, np.intp),
        tuple(gains), freedom, tuple(angles),
    )  # fmt: skip


def design_matrix(pattern: PmpPattern, shifts: int, have: Sequence[int]) -> NDArray[np.float64]:
    """(N, 3) rows [1, cos alpha_n, -sin alpha_n] for the shifts n in `have`.

    I = A + B cos(theta + alpha_n) = [A, B cos theta, B sin theta] . row.
    """
    alpha = shift_angles(pattern, shifts, have)
    return np.stack([np.ones_like(alpha), np.cos(alpha), -np.sin(alpha)], axis=1)


def shift_angles(pattern: PmpPattern, shifts: int, have: Sequence[int]) -> NDArray[np.float64]:
    """(N,) alpha_n = sign 2 pi n / shifts + offset, radians, for the shifts n in `have`."""
    return np.asarray(pattern.sign * 2 * np.pi * np.asarray(have) / shifts + pattern.offset)
