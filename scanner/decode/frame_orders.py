"""Orders in which the frames of one fringe set may have been shown, and what each would leave of its samples.

A frame that shows another shift than its own takes the place of that shift in the fit: it is then a row of the design
matrix twice, or two rows have changed places. Whichever order was true leaves noise alone; any other one a share of the
fringe's height. Where two orders' fits span the same, no residual tells them apart: of four shifts, two exchanged next
to each other are as good as the two others. Overtones of a response and light that flickers leave something, too: they
are fitted beside each order, so that neither passes for frames out of step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from math import pi, sin

import numpy as np
from numpy.typing import NDArray

NONE = -1
"""In place of a shift: what the frame shows is none of its set's."""

LEAST_SHARE = 0.06
"""Of what a doubled neighbour leaves where all phases are seen, from where on frames are looked at and named. Less
than that moves phases by .1 of a radian at the most with four shifts, .04 with eight, and counts no fringe wrong."""

MOST_SHIFTS = 64
"""Of a set that is looked at: one frame of more moves a phase by a hundredth of a cycle at the most."""

LIT2 = 1 / 16
"""Of the brightest pixels' height, squared"""

ALL_UP_TO = 16
"""Shifts of a set for which every exchange is tried; of larger ones those no farther than NEAR apart, round the turn"""

NEAR = 2

MOST_SHARES = np.array([0.45, 0.2, 0.15])
"""Of the second, third and fourth overtone in their fringe: gamma 3 gives .4, .05 and less."""

MOST_FLICKER = 0.5
"""Of a frame's light, and of its fringe: lamps on mains, at exposures that are no whole number of periods"""

OWED = 0.5
"""Of the fringe that a frame should show: one that shows more of it is in its place, in another light or moved"""

MOST_TREMBLING, MOST_OF_SHIFT = 0.25, 0.25
"""Radians that a frame's fringe lies beside its place where a scene or a device trembles, and of a shift, at the most:
what is beyond is not taken for that alone"""

TRUSTED = 0.15
"""Of a shift, 1-sigma, that frames lie beside their places where an order is believed: of frames that tremble more one
in some hundreds lies nearer to another's place than to its own."""

FEWEST_TREMBLING = 5
"""Shifts of a set that shows it: of four, the one residual is as good for that as for another order."""

_OVERTONES = (2, 3, 4)


@dataclass(frozen=True)
class Order:
    """shows: by frame, the shift that it shows, or NONE. false: frames that show another one than their own."""

    shows: tuple[int, ...]
    false: tuple[int, ...]

    @classmethod
    def of(cls, shifts: int, shown: Mapping[int, int]) -> Order:
        """shown: by false frame, what it shows."""
        return cls(tuple(shown.get(n, n) for n in range(shifts)), tuple(sorted(shown)))

    @property
    def exchanged(self) -> bool:
        """Two frames changed places; otherwise each shows another one's picture, or none of its set."""
        return len(self.false) == 2 and tuple(self.shows[n] for n in self.false) == self.false[::-1]

    @property
    def late(self) -> int:
        """1 where several frames in a row show what the one before each shows, -1 the one after; else 0."""
        by = {n - self.shows[n] for n in self.false}
        in_a_row = len(self.false) > 1 and self.false[-1] - self.false[0] == len(self.false) - 1
        return by.pop() if in_a_row and by in ({1}, {-1}) else 0


@dataclass(frozen=True)
class Orders:
    """orders: the one that was meant first. rests: (H, N * N), what takes means of the frames' products to the mean sum
    of squares that each order leaves."""

    orders: tuple[Order, ...]
    rests: NDArray[np.float64]

    def left(self, products: NDArray[np.float64]) -> NDArray[np.float64]:
        """(H,) of (N, N) means of products."""
        return np.asarray(self.rests @ products.reshape(-1))


def least_left(shifts: int) -> float:
    """What one frame that shows its neighbour leaves of a set, over B^2, all phases alike: the least of all faults.

    The difference of two neighbours is 2 B sin(pi / N) times a sine; the fit takes three of N parts of it.
    """
    return 2 * sin(pi / shifts) ** 2 * (1 - 3 / shifts)


@lru_cache(maxsize=16)
def orders_of(shifts: int) -> Orders:
    """As meant; each frame in place of each other one; each two exchanged. Four shifts or more."""
    orders, frames = [Order.of(shifts, {})], range(shifts)
    for n, m in ((n, m) for n in frames for m in frames if n != m and _tried(n, m, shifts)):
        orders.append(Order.of(shifts, {n: m}))
        if n < m:
            orders.append(Order.of(shifts, {n: m, m: n}))
    return _left_by(orders)


@lru_cache(maxsize=16)
def orders_late(shifts: int) -> Orders:
    """Each with some frames in a row that show what the one before each shows, or the one after: a frame came twice and
    another one not at all. The others are as meant. ALL_UP_TO shifts or fewer."""
    rows = [(a, b) for a in range(shifts) for b in range(a + 2, shifts + 1)]
    late = [Order.of(shifts, {n: n - 1 for n in range(a, b)}) for a, b in rows if a > 0]
    early = [Order.of(shifts, {n: n + 1 for n in range(a, b)}) for a, b in rows if b < shifts]
    return _left_by([*late, *early])


def _left_by(orders: list[Order]) -> Orders:
    """What orders leave all of whose frames show something of their set."""
    turns = 2 * pi / len(orders[0].shows) * np.array([order.shows for order in orders])
    design = np.stack([np.ones_like(turns), np.cos(turns), np.sin(turns)], axis=2)
    rests = np.eye(turns.shape[1]) - design @ np.linalg.pinv(design)
    return Orders(tuple(orders), rests.reshape(len(orders), -1))


@lru_cache(maxsize=16)
def orders_without(shifts: int) -> Orders:
    """Each with one frame that shows nothing of its set. Five shifts or more: of fewer no residual would be left."""
    orders = tuple(Order.of(shifts, {n: NONE}) for n in range(shifts))
    rests = np.zeros((shifts, shifts, shifts))
    for n in range(shifts):
        others = np.delete(np.arange(shifts), n)
        design = _design(np.asarray(2 * pi / shifts * others, np.float64))
        rests[n][np.ix_(others, others)] = np.eye(shifts - 1) - design @ np.linalg.pinv(design)
    return Orders(orders, rests.reshape(shifts, -1))


def beside(samples: NDArray[np.float64], order: Order) -> tuple[NDArray[np.float64], float]:
    """How far frames lie beside what an order has them show, radians; and the share of what it leaves that is left once
    they are taken for lying there.

    Args:
        samples: (N, p), of FEWEST_TREMBLING shifts or more; of fewer nothing is known, 0 and 1.

    Returns:
        (n,), of the frames that show anything.
    """
    there = np.array(order.shows) != NONE
    turns = 2 * pi / len(samples) * np.array(order.shows)[there]
    if len(samples) < FEWEST_TREMBLING:
        return np.zeros(len(turns)), 1.0
    design = _design(turns)
    _, cosine, sine = np.linalg.pinv(design) @ samples[there]
    across = np.cos(turns)[:, None] * sine - np.sin(turns)[:, None] * cosine
    onto = np.eye(len(turns)) - design @ np.linalg.pinv(design)
    rest = onto @ samples[there]
    off = _bounded(onto * (across @ across.T), np.sum(rest * across, axis=1), pi)
    after = rest - onto @ (off[:, None] * across)
    return off, float(np.vdot(after, after) / max(np.vdot(rest, rest), 1e-9))


def lies_beside(samples: NDArray[np.float64], order: Order) -> bool:
    """Whether frames do not show what an order has them show, nor its other frames, but lie somewhere between."""
    there = np.flatnonzero(np.array(order.shows) != NONE)
    off, false = np.abs(beside(samples, order)[0]), np.isin(there, order.false)
    worst = max(float(np.sqrt(np.mean(off[~false] ** 2))), float(off[false].max(initial=0.0)))
    return worst > TRUSTED * 2 * pi / len(samples)


def left_beside_overtones(samples: NDArray[np.float64], order: Order) -> float:
    """Mean sum of squares that an order leaves of (N, p) samples, once overtones and flicker are fitted, too.

    A pointwise response makes overtones whose heights are shares of the fringe's, real ones and the same at all pixels
    (Pan, Huang, Chiang 2006).
    """
    there = np.array(order.shows) != NONE
    turns = 2 * pi / len(there) * np.array(order.shows)[there]
    design = _design(turns)
    fit, seen = np.linalg.pinv(design), samples[there]
    level, cosine, sine = fit @ seen
    rest = seen - design @ (fit @ seen)
    height, angles = np.hypot(cosine, sine), turns[:, None] - np.arctan2(sine, cosine)
    shapes = [height * np.cos(m * angles) for m in _OVERTONES]
    shapes = [shape - design @ (fit @ shape) for shape in shapes]
    grams = np.array([[np.vdot(a, b) for b in shapes] for a in shapes])
    shares = _bounded(grams, np.array([np.vdot(shape, rest) for shape in shapes]), MOST_SHARES)
    for share, shape in zip(shares, shapes, strict=True):
        rest -= share * shape
    onto = np.eye(len(turns)) - design @ fit
    across = -height * np.sin(angles)
    kinds: list[tuple[NDArray[np.float64], float]] = [
        (design @ (fit @ seen), MOST_FLICKER),
        (np.broadcast_to(level, seen.shape), MOST_FLICKER),
    ]
    if len(there) >= FEWEST_TREMBLING:
        # What drifts, by as much from frame to frame, and what trembles.
        steady = onto @ ((np.flatnonzero(there) - np.flatnonzero(there).mean())[:, None] * across)
        rest -= float(np.vdot(steady, rest)) / max(float(np.vdot(steady, steady)), 1e-9) * steady
        kinds.append((across, min(MOST_TREMBLING, MOST_OF_SHIFT * 2 * pi / len(there))))
    for kind, most in kinds:
        changes = _bounded(onto * (kind @ kind.T), np.sum(rest * kind, axis=1), most)
        rest -= onto @ (changes[:, None] * kind)
    return float(np.mean(np.sum(rest**2, axis=0)))


def owed(level: NDArray[np.float64], due: NDArray[np.float64], seen: NDArray[np.float64]) -> bool:
    """Whether what a frame shows is the fringe that is due over its level, in another light or moved. (p,) each."""
    shapes = np.stack([level, due])
    shares = np.linalg.lstsq(shapes @ shapes.T, shapes @ seen, rcond=None)[0]
    return bool(shares[1] > OWED)


def _bounded(
    grams: NDArray[np.float64], sums: NDArray[np.float64], most: float | NDArray[np.float64]
) -> NDArray[np.float64]:
    """Shares that fit best, not above `most`. grams: of what has shares with one another; sums: with what is fitted."""
    # A thousandth more of their own: what a set does not show has nothing to be fitted to.
    ridge = 1e-3 * max(float(np.trace(grams)) / len(grams), 1e-9) * np.eye(len(grams))
    return np.asarray(np.clip(np.linalg.solve(grams + ridge, sums), -most, most))


def _tried(n: int, m: int, shifts: int) -> bool:
    apart = abs(n - m)
    return shifts <= ALL_UP_TO or min(apart, shifts - apart) <= NEAR


def _design(turns: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([np.ones_like(turns), np.cos(turns), np.sin(turns)], axis=1)
