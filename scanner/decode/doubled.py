"""Frames of a fringe set that show what they should not: a stale buffer, a late flip, two that changed places.

Told from a sample of pixels, set by set: an order of the frames that leaves much less than the one that was meant, and
no more than noise would (`frame_orders`). Whether a capture is in step is asked with more care, and before anything
else, by the sequencer's witnesses, which refuse it; this is for frames that come to a decoder without them. With three
shifts nothing is left but the set's mean light, which a doubled frame changes and an exchange does not
(`between_sets`). A set that is rotated as a whole leaves nothing at any number (`rotated`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.frame_orders import (
    ALL_UP_TO,
    LEAST_SHARE,
    LIT2,
    MOST_SHIFTS,
    NONE,
    Order,
    beside,
    least_left,
    left_beside_overtones,
    lies_beside,
    orders_late,
    orders_of,
    orders_without,
    owed,
)
from scanner.decode.noise import default_noise
from scanner.decode.pmp_frames import AxisFrames
from scanner.decode.pmp_sample import Sample

EXPLAINED = 0.35
"""Of what a set leaves beyond noise, at most, in an order that is believed; see `sequencer.witness_fringes`."""

BEYOND, BEYOND_OWN = 0.25, 0.5
"""Of noise's part in what a set leaves: what there must be beyond it, to be judged; and where no other set tells how
high noise is, but the best order's own rest"""

EQUALLY, EQUALLY_NOISE, EQUALLY_BEYOND = 0.02, 0.3, 3.0
"""Orders cannot be told from the best one that leave no more beyond noise than so much of what that takes off, and of
noise, and of what it leaves beyond noise itself: where its fit is not perfect, another one's need not be."""

ALIKE = 1 / 16
"""Of two frames: mean square of their difference over that which the set's fit has there. In frames that are what they
should be it is 1 and noise on top; noise of B / 10 hides a doubled one of eight."""

UNEXPLAINED = 0.5
"""Of what a doubled neighbour leaves, from where on a set that nothing explains is out of step, if others are not"""

HARMLESS = 0.1
"""Radians of a set's phase, 1-sigma, that frames beside their places may cost: a sixtieth of a fringe"""

MEDIAN_SQUARE = 0.455
"""Of a normal variable's square, over its mean"""

LEAST_HEIGHT = 4.5
"""Of fringes over noise, as seen, noise and all: lower ones give no values that could be wrong"""

MOST_PIXELS = 1024
LEAST_PIXELS = 60
MEANS_APART = 0.02
"""Of B^2: mean square of what a set's mean light differs from the other sets' by. A doubled one of three frames makes
it .17; the third overtone of an uncorrected gamma 2.3 less than .001."""

FEWEST_LEFT = 4
"""Frames of a set, without false ones, from where on it is decoded without them: three would fit whatever they show"""

MOST_PAIRS = 3
"""Of doubled frames in one set, of which each combination is tried"""

_TRIED = 12


@dataclass(frozen=True)
class Misplaced:
    """What is wrong with the frames of one set.

    of_set: its number. mended: whether it is plain which frames are false, and it can be decoded without them, or with
    two of them exchanged. orders: those that fit, and cannot be told apart; none where nothing explains what is left.
    source: (set, frame) of another set that shows the same as the one that is false, where there is one.
    """

    of_set: int
    mended: bool
    orders: tuple[Order, ...]
    source: tuple[int, int] | None = None

    @property
    def late(self) -> int:
        """1 where a set's first frame shows nothing of it, or what the second one shows, -1 where its last one shows
        nothing, or what the one before shows: all of its others may be late by a shift then, or early, which no
        residual tells; else 0."""
        if len(self.orders) != 1 or len(self.orders[0].false) != 1:
            return 0
        shows, (false,) = self.orders[0].shows, self.orders[0].false
        last = len(shows) - 1
        if false not in (0, last) or shows[false] not in (NONE, 1 if false == 0 else last - 1):
            return 0
        return 1 if false == 0 else -1

    def says(self, position: Callable[[int, int], int]) -> str:
        """In words. position: of (set, frame) in the sequence."""
        if not self.orders:
            return (
                "its frames are no shifts of one fringe, nor are they with two of them exchanged, while those of other "
                "frequencies are: the set is out of step"
            )
        told = list(dict.fromkeys(self._told(order, position) for order in self.orders))
        involved = sorted({n for order in self.orders for n in (*order.false, order.shows[order.false[0]])})
        if len(told) > 1 and not any(order.exchanged for order in self.orders) and len(involved) == 2:
            told = [f"frames {' and '.join(str(position(self.of_set, n)) for n in involved)} show the same"]
        done = ": the set is out of step"
        if self.mended:
            false = len(self.orders[0].false)
            done = f", and {'was' if false == 1 else 'were'} left out"
            if self.orders[0].exchanged:
                done = ", and were taken in each other's place"
        return f"{', or '.join(told)}{done}"

    def mend(self, frames: dict[int, NDArray[Any]], first: int) -> None:
        """Leave out what is false, or exchange it. frames: by fringe index, changed. first: of the set."""
        if not self.mended:
            return
        (order,) = self.orders
        taken = [frames.pop(first + n) for n in order.false]
        if order.exchanged:
            for n, frame in zip(order.false, reversed(taken), strict=True):
                frames[first + n] = frame

    def _told(self, order: Order, position: Callable[[int, int], int]) -> str:
        false = [position(self.of_set, n) for n in order.false]
        if order.exchanged:
            return f"frames {false[0]} and {false[1]} changed places"
        if order.late:
            return (
                f"frames {false[0]}..{false[-1]} show what the one {'before' if order.late > 0 else 'after'} each does"
            )
        shown = [self.source if m == NONE else (self.of_set, m) for m in (order.shows[n] for n in order.false)]
        named = [f"what frame {position(*of)} shows" if of else "nothing of its set" for of in shown]
        return ", ".join(f"frame {n} shows {what}" for n, what in zip(false, named, strict=True))


@dataclass(frozen=True)
class _Seen:
    """All frames of an axis at p lit pixels.

    samples: by set, (N, p) float64. products: by set, (N, N) their means. heights2: by set, mean B^2, of all that
    changes from frame to frame, whatever the order.
    """

    samples: tuple[NDArray[np.float64], ...]
    products: tuple[NDArray[np.float64], ...]
    heights2: tuple[float, ...]


def misplaced_frames(frames: AxisFrames, sample: Sample) -> list[Misplaced]:
    """What is wrong with the sets that have all their frames."""
    at = lit_pixels(sample, frames)
    if at.size < LEAST_PIXELS:
        return []
    seen = _read(frames, at)
    verdicts = {k: _Verdict(k, seen) for k, n in enumerate(frames.shifts) if 3 < n <= MOST_SHIFTS}
    found: list[Misplaced] = []
    for k, shifts in enumerate(frames.shifts):
        if shifts == 3:
            found += _of_three(k, seen)
        elif k in verdicts:
            found += verdicts[k].found(min((v.noise for j, v in verdicts.items() if j != k), default=None))
    return found


def lit_pixels(sample: Sample, frames: AxisFrames) -> NDArray[np.intp]:
    """(p,) indices of pixels of the sample, MOST_PIXELS at the most."""
    counts = np.array([max(len(have), 1) for have in frames.there], np.float32) / 2
    power = np.tensordot(counts, sample.modulations**2, 1) + sample.residual
    power[~sample.usable] = 0
    top = np.partition(power.reshape(-1), int(0.99 * (power.size - 1)))[int(0.99 * (power.size - 1))]
    # Twice what noise alone makes of as many frames.
    dark = 2 * sum(map(len, frames.there)) * default_noise(sample.max_value).variance(sample.mean)
    at = (sample.runs[:, None] + np.arange(power.shape[1]))[power > np.maximum(LIT2 * top, dark)]
    return np.asarray(at[:: max(-(-at.size // MOST_PIXELS), 1)])


def _read(frames: AxisFrames, at: NDArray[np.intp]) -> _Seen:
    samples, products, heights2 = [], [], []
    for first, count in zip(frames.starts.tolist(), frames.shifts, strict=False):
        taken = [frames.frames[first + n].reshape(-1)[at] for n in range(count if count <= MOST_SHIFTS else 0)]
        # Whole levels: sums of their products are exact, so that what is the same differs by nothing.
        grey = np.stack(taken).astype(np.float64) if taken else np.zeros((0, at.size))
        samples.append(grey)
        products.append(grey @ grey.T / at.size)
        heights2.append(2 * float(grey.var(axis=0).mean()) if taken else 0.0)
    return _Seen(tuple(samples), tuple(products), tuple(heights2))


def _of_three(k: int, seen: _Seen) -> list[Misplaced]:
    """Of a set of three: two frames that show the same, to the last bit or while its mean light is not that of others;
    or one that shows what another set's frame does."""
    own = seen.samples[k]
    pairs = [(n, m) for n, m in combinations(range(3), 2) if np.array_equal(own[n], own[m])]
    if not pairs and not _means_differ(k, seen):
        return []
    most = ALIKE * seen.heights2[k]
    pairs = pairs or [(n, m) for n, m in combinations(range(3), 2) if np.mean((own[n] - own[m]) ** 2) < most]
    if pairs:
        n, m = pairs[0]
        return [Misplaced(k, False, (Order.of(3, {n: m}), Order.of(3, {m: n})))]
    like = {n: source for n in range(3) if (source := _like(k, n, seen)) is not None}
    return [Misplaced(k, False, (Order.of(3, {n: NONE}),), source) for n, source in like.items() if len(like) == 1]


def _means_differ(k: int, seen: _Seen) -> bool:
    """Whether a set's mean light differs from that of the others, but for lamps and noise."""
    others = [samples.mean(axis=0) for j, samples in enumerate(seen.samples) if j != k and len(samples)]
    if not others:
        return False
    own, light = seen.samples[k].mean(axis=0), np.median(others, axis=0)
    own = own - float(own @ light) / max(float(light @ light), 1e-9) * light
    # Of frames that show the same the difference is noise; higher noise than would let them be seen is not looked for.
    alike = min(float(np.mean((a - b) ** 2)) for a, b in combinations(seen.samples[k], 2))
    noise = min(alike, ALIKE * seen.heights2[k]) / 2
    return bool(np.mean(own**2) > MEANS_APART * seen.heights2[k] + noise)


def _like(k: int, n: int, seen: _Seen) -> tuple[int, int] | None:
    """(set, frame) of another set that shows what frame n of this one does: differing fringes are B^2 apart."""
    own = seen.samples[k][n]
    apart = [
        (float(np.mean((frame - own) ** 2)), (j, m))
        for j, samples in enumerate(seen.samples)
        for m, frame in enumerate(samples)
        if j != k
    ]
    least, where = min(apart, default=(np.inf, (0, 0)))
    return where if least < ALIKE * seen.heights2[k] else None


class _Verdict:
    """On one set of four shifts or more. noise: variance of a sample, if one of its orders is true."""

    def __init__(self, k: int, seen: _Seen) -> None:
        self._k, self._seen, self._samples = k, seen, seen.samples[k]
        self._shifts = len(self._samples)
        self._freedom = self._shifts - 3
        self._least = least_left(self._shifts) * seen.heights2[k]
        known = orders_of(self._shifts)
        self._left = known.left(seen.products[k])
        self._before = left_beside_overtones(self._samples, known.orders[0])
        best = left_beside_overtones(self._samples, known.orders[int(np.argmin(self._left))])
        self.noise = min(self._before, best) / self._freedom
        if self._shifts > 4:
            without = orders_without(self._shifts)
            least = int(np.argmin(without.left(seen.products[k])))
            self.noise = min(
                self.noise, left_beside_overtones(self._samples, without.orders[least]) / (self._freedom - 1)
            )
        self._noise: float | None = None

    def found(self, noise: float | None) -> list[Misplaced]:
        """One fault at the most, but any number of doubled frames.

        Args:
            noise: variance of a sample by other sets; None where no other set tells.
        """
        self._noise, before = noise, self._before
        if self._seen.heights2[self._k] < LEAST_HEIGHT**2 * min(self.noise, noise or np.inf):
            return []
        if noise is not None and not self._stands_out(before, noise, BEYOND):
            return []
        orders, source = self._explaining(before) or self._several_alike(before), None
        if not orders:
            orders, source = self._foreign(before)
        if orders := orders or self._late(before):
            return [Misplaced(self._k, self._plain(orders), orders, source)]
        if noise is None or self._trembles_little():
            return []
        if min(before, self._typical()) - self._freedom * noise > UNEXPLAINED * self._least:
            return [Misplaced(self._k, False, ())]
        return []

    def _trembles_little(self) -> bool:
        """Whether frames lie beside their places, and phases are hardly worse for it."""
        off, left = beside(self._samples, orders_of(self._shifts).orders[0])
        return left < EXPLAINED and float(np.std(off)) * np.sqrt(2 / self._shifts) < HARMLESS

    def _typical(self) -> float:
        """What most pixels have left, as a mean would have it: of what moves, some have much.

        Of something that owes nothing to the fringe, rests are normal at four shifts, where their square's median is
        furthest from its mean.
        """
        rest = orders_of(self._shifts).rests[0].reshape(self._shifts, -1) @ self._samples
        return float(np.median(np.sum(rest**2, axis=0))) / MEDIAN_SQUARE

    def _stands_out(self, before: float, noise: float, share: float) -> bool:
        """Whether a set leaves more than noise makes of it."""
        expected = self._freedom * noise
        return before - expected > max(LEAST_SHARE * self._least, share * expected)

    def _explaining(self, before: float) -> tuple[Order, ...]:
        """Orders that do, as well as each other; of frames of the set."""
        known = orders_of(self._shifts)
        enough = np.flatnonzero(self._left < self._left[0] - LEAST_SHARE * self._least)
        tried = enough[np.argsort(self._left[enough], kind="stable")][:_TRIED]
        left = {int(h): left_beside_overtones(self._samples, known.orders[h]) for h in tried}
        return self._best(before, [(known.orders[h], after) for h, after in left.items()], self._freedom)

    def _late(self, before: float) -> tuple[Order, ...]:
        """Orders with several frames in a row that are late, or early."""
        if not 4 < self._shifts <= ALL_UP_TO:
            return ()
        known = orders_late(self._shifts)
        tried = np.argsort(known.left(self._seen.products[self._k]), kind="stable")[:_TRIED]
        left = [(known.orders[h], left_beside_overtones(self._samples, known.orders[h])) for h in tried]
        return self._best(before, left, self._freedom)

    def _foreign(self, before: float) -> tuple[tuple[Order, ...], tuple[int, int] | None]:
        """Orders with one frame that shows nothing of its set, and what of another set it shows."""
        orders: tuple[Order, ...] = ()
        if self._shifts > 4:
            known = orders_without(self._shifts)
            left = [(order, left_beside_overtones(self._samples, order)) for order in known.orders]
            orders = tuple(one for one in self._best(before, left, self._freedom - 1) if self._owes_nothing(one))
        like = {n: source for n in range(self._shifts) if (source := _like(self._k, n, self._seen)) is not None}
        if not orders and len(like) == 1:
            orders = tuple(Order.of(self._shifts, {n: NONE}) for n in like)
        return orders, like.get(orders[0].false[0]) if len(orders) == 1 else None

    def _best(self, before: float, left: list[tuple[Order, float]], freedom: int) -> tuple[Order, ...]:
        """Those that leave next to nothing, where `before` is left of the order that was meant."""
        if not left:
            return ()
        least = min(after for _, after in left)
        noise, share = (least / freedom, BEYOND_OWN) if self._noise is None else (self._noise, BEYOND)
        beyond = before - self._freedom * noise, least - freedom * noise
        if before - least < LEAST_SHARE * self._least or beyond[1] > EXPLAINED * beyond[0]:
            return ()
        best = next(order for order, after in left if after == least)
        if not self._stands_out(before, noise, share):
            return ()
        if lies_beside(self._samples, best):
            return ()
        equal = EQUALLY * (before - least) + EQUALLY_NOISE * freedom * noise + EQUALLY_BEYOND * max(beyond[1], 0.0)
        return tuple(order for order, after in left if after == least or after - freedom * noise < equal)

    def _owes_nothing(self, order: Order) -> bool:
        """Whether the false frame's fringe is not that which the others have there, weaker, stronger or moved."""
        (n,) = order.false
        others = np.delete(np.arange(self._shifts), n)
        turns = 2 * np.pi / self._shifts * np.arange(self._shifts)
        design = np.stack([np.ones_like(turns), np.cos(turns), np.sin(turns)], axis=1)
        level, *heights = np.linalg.pinv(design[others]) @ self._samples[others]
        due = design[n, 1:] @ np.array(heights)
        return not owed(level, due, self._samples[n])

    def _several_alike(self, before: float) -> tuple[Order, ...]:
        """Orders with each of two frames that show the same in place of the other, two such pairs or three."""
        fit = np.eye(self._shifts) - orders_of(self._shifts).rests[0].reshape(self._shifts, -1)
        products = self._seen.products[self._k]
        apart, meant = _differences(products), _differences(fit @ products @ fit.T)
        pairs = [(n, m) for n, m in combinations(range(self._shifts), 2) if apart[n, m] < ALIKE * meant[n, m]]
        if not 1 < len(pairs) <= MOST_PAIRS:
            return ()
        ways = product(*(((n, m), (m, n)) for n, m in pairs))
        orders = [Order.of(self._shifts, dict(way)) for way in ways]
        return self._best(before, [(o, left_beside_overtones(self._samples, o)) for o in orders], self._freedom)

    def _plain(self, orders: tuple[Order, ...]) -> bool:
        """Whether it is plain which frames are false, and enough are left."""
        one = orders[0]
        return len(orders) == 1 and not one.late and (one.exchanged or self._shifts - len(one.false) >= FEWEST_LEFT)


def _differences(products: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, N) mean squares of the differences of each two, from the means of their products."""
    own = np.diag(products)
    return np.asarray(np.maximum(own[:, None] + own - 2 * products, 0.0))
