"""Stripes followed from column to column, and evidence passed along them.

A chain is a run of peaks in neighbouring columns that lie on one smooth line; it ends at bends, jumps of
brightness, and where no peak follows. A chain is no claim that its peaks are one stripe: at a step of depth of a
whole pitch stripes line up again, which the switching cost of `path_along` allows for.
The dissertation grows regions instead (Casey 2011, 5.4), which crosses depth edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp.ranks import median
from scanner.decode.mcp.stripes import Peaks
from scanner.kernel import kernel

Array = NDArray[np.float32]
Ints = NDArray[np.int32]


BEND = 0.05
"""Distance of a peak from its chain's line, in pitches to a column, that ends the chain."""

REACH = 0.3
"""Most a stripe moves from one column to the next, in pitches: two stripes are 1 apart."""

STARTS = 2.5
"""Pitches up or down within which a chain's neighbour tells the way it sets out: further off is another surface."""


LEAST_HEIGHT = 0.1
"""Ratio of heights from one column to the next that ends a chain: more than print on paper makes, less than an edge of
light and shadow."""


@dataclass(frozen=True, eq=False)
class Chains:
    """order: (P,) int32, peaks chain by chain, left to right. start: (C + 1,) int32, where chains begin in `order`.
    column: (P,) int32, the column of each peak (in the order of `Peaks`).
    """

    order: Ints
    start: Ints
    column: Ints

    @property
    def lengths(self) -> Ints:
        """(C,) int32: peaks of each chain."""
        return np.diff(self.start)


def link(peaks: Peaks, pitch: float) -> Chains:
    """Chain the peaks of neighbouring columns: mutual nearest, on a smooth line, of like height.

    Limits are REACH between columns and BEND off the line so far (0.5 is the next valley; the profile's flank must stay
    in the fit window). A chain sets out the way its neighbours in the column go, or all do: a projector that is rolled
    against the camera inclines stripes by more than BEND.
    """
    column = np.repeat(np.arange(len(peaks.start) - 1, dtype=np.int32), np.diff(peaks.start))
    reach, bend = np.float32(REACH * pitch), np.float32(BEND * pitch)
    order, start = _link(
        peaks.start, peaks.y, peaks.height, reach, bend, inclination(peaks, pitch), np.float32(STARTS * pitch)
    )
    return Chains(order, start, column)


def inclination(peaks: Peaks, pitch: float) -> np.float32:
    """How far stripes move from one column to the next, px: the median over nearest peaks of neighbouring columns.

    Half the columns' stripes may be noise's or an edge's, and go anywhere; beyond REACH nobody can say which is next.
    """
    steps = np.empty(len(peaks), np.float32)
    count = _steps(peaks.start, peaks.y, np.float32(REACH * pitch), steps)
    return np.float32(median(steps[:count])) if count else np.float32(0)


@kernel
def _steps(start: Ints, y: Array, reach: np.float32, steps: Array) -> int:
    n = 0
    for b in range(0, len(start) - 2, 2):
        j = start[b + 1]
        for i in range(start[b], start[b + 1]):
            while j < start[b + 2] and y[j] < y[i] - reach:
                j += 1
            k = _nearest(y, j, min(j + 3, start[b + 2]), y[i])
            if k >= 0 and abs(y[k] - y[i]) <= reach:
                steps[n] = y[k] - y[i]
                n += 1
    return n


@kernel
def _nearest(y: Array, first: int, last: int, target: np.float32) -> int:
    best, distance = -1, np.float32(1e9)
    for k in range(first, last):
        d = abs(y[k] - target)
        if d < distance:
            best, distance = k, d
    return best


@kernel
def _set_out(first: int, last: int, y: Array, before: Ints, slope: Array, usual: np.float32, near: np.float32) -> None:
    """Slopes of a column's peaks that have none yet: the nearest one's that has, within `near`, else the usual one."""
    for i in range(first, last):
        if before[i] >= 0:
            continue
        slope[i] = usual
        distance = near
        for k in range(i - 1, first - 1, -1):
            if y[i] - y[k] >= distance:
                break
            if before[k] >= 0:
                slope[i] = slope[k]
                distance = y[i] - y[k]
                break
        for k in range(i + 1, last):
            if y[k] - y[i] >= distance:
                break
            if before[k] >= 0:
                slope[i] = slope[k]
                break


@kernel
def _link(
    start: Ints,
    y: Array,
    height: Array,
    reach: np.float32,
    bend: np.float32,
    usual: np.float32,
    near: np.float32,
) -> tuple[Ints, Ints]:
    count = len(y)
    after = np.full(count, -1, np.int32)
    before = np.full(count, -1, np.int32)
    slope = np.zeros(count, np.float32)
    least = np.float32(LEAST_HEIGHT)
    for b in range(len(start) - 2):
        j = start[b + 1]
        _set_out(start[b], start[b + 1], y, before, slope, usual, near)
        for i in range(start[b], start[b + 1]):
            target = y[i] + slope[i]
            while j < start[b + 2] and y[j] < target - reach:
                j += 1
            k = _nearest(y, j, min(j + 3, start[b + 2]), target)
            if k < 0 or abs(y[k] - y[i]) > reach or abs(y[k] - target) > bend:
                continue
            if height[k] < least * height[i] or height[i] < least * height[k]:
                continue
            if before[k] >= 0:  # two claim it: the nearer keeps it
                other = before[k]
                if abs(y[other] + slope[other] - y[k]) <= abs(y[k] - target):
                    continue
                after[other] = -1
            after[i] = k
            before[k] = i
            slope[k] = np.float32(0.7) * slope[i] + np.float32(0.3) * (y[k] - y[i])
    order = np.empty(count, np.int32)
    chains = np.empty(count + 1, np.int32)
    n, c = 0, 0
    for i in range(count):
        if before[i] >= 0:
            continue
        chains[c] = n
        c += 1
        k = i
        while k >= 0:
            order[n] = k
            n += 1
            k = after[k]
    chains[c] = n
    return order, chains[: c + 1].copy()


@dataclass(frozen=True, eq=False)
class Sites:
    """Peaks of every second column, where stripes are told apart: windows along a stripe are eight columns and more,
    so that its neighbours say the same.

    index: (M,) int32, which peaks. start: (C + 1,) int32, where columns begin. chains: of the sites among themselves.
    """

    index: Ints
    start: Ints
    chains: Chains


def sites_of(peaks: Peaks, chains: Chains) -> Sites:
    """The sites among `peaks`, with what is left of the chains; a chain without a site is empty."""
    chosen = chains.column % 2 == 0
    number = np.cumsum(chosen, dtype=np.int32) - np.int32(1)
    in_order = chosen[chains.order]
    counts = np.diff(peaks.start)[::2]
    before = np.concatenate(([0], np.cumsum(in_order)))[chains.start]
    index = np.flatnonzero(chosen).astype(np.int32)
    left = Chains(number[chains.order[in_order]], before.astype(np.int32), chains.column[index] // 2)
    return Sites(index, np.concatenate(([0], np.cumsum(counts))).astype(np.int32), left)


def between_sites(
    label: Ints, confidence: Array, sites: Sites, chains: Chains, joined: NDArray[np.bool_]
) -> tuple[Ints, Array]:
    """What the sites were decoded as, for all peaks: a peak between two sites of its chain needs both to agree.

    Where print breaks stripes up, sites are undecided here and there: on joined tracks one decided site is enough
    beside an undecided one.

    Args:
        label: (M,) int32, -1 undecided.
        confidence: (M,) float32.
        sites: the sites.
        chains: of all P peaks; one may be a track of several pieces.
        joined: (C,) bool, which are.

    Returns:
        label (P,) int32 and confidence (P,) float32.
    """
    every, sure = np.full(len(chains.order), -1, np.int32), np.zeros(len(chains.order), np.float32)
    every[sites.index], sure[sites.index] = label, confidence
    _between_sites(chains.order, chains.start, chains.column, joined, every, sure)
    return every, sure


@kernel
def _next_site(order: Ints, column: Ints, p: int, way: int, end: int) -> int:
    """The peak of an even column next to place p, before place `end`; -1 for none."""
    q = p + way
    while q != end and column[order[q]] % 2:
        q += way
    return order[q] if q != end else -1


@kernel
def _between_sites(
    order: Ints, start: Ints, column: Ints, joined: NDArray[np.bool_], label: Ints, confidence: Array
) -> None:
    for c in range(len(start) - 1):
        for p in range(start[c], start[c + 1]):
            k = order[p]
            if column[k] % 2 == 0:
                continue
            a = _next_site(order, column, p, -1, start[c] - 1)
            b = _next_site(order, column, p, 1, start[c + 1])
            a, b = b if a < 0 else a, a if b < 0 else b
            if a < 0:
                continue
            if joined[c]:
                a, b = b if label[a] < 0 else a, a if label[b] < 0 else b
            if label[a] == label[b]:
                label[k] = label[a]
                confidence[k] = min(confidence[a], confidence[b])


def silhouettes(reduced: Array, peaks: Peaks, chains: Chains) -> NDArray[np.bool_]:
    """Peaks at a chain's end that lie beyond the object's edge: (P,) bool.

    Smoothing over a carrier's period carries a stripe past the edge of what it falls on; there the columns as they are
    show less than half the brightness of the columns further in.
    """
    beyond = np.zeros(len(peaks), np.bool_)
    _silhouettes(reduced, peaks.y, peaks.valley, chains.order, chains.start, chains.column, beyond)
    return beyond


@kernel
def _silhouettes(
    reduced: Array, y: Array, valley: Array, order: Ints, start: Ints, column: Ints, beyond: NDArray[np.bool_]
) -> None:
    inner = 8
    for c in range(len(start) - 1):
        first, size = start[c], start[c + 1] - start[c]
        for way in range(2):
            for step in range(min(size, inner)):
                p = first + step if way == 0 else first + size - 1 - step
                total, count = np.float32(0), 0
                for further in range(step + 1, min(step + 1 + inner, size)):
                    k = order[first + further] if way == 0 else order[first + size - 1 - further]
                    total += reduced[column[k], int(y[k] + np.float32(0.5))] - valley[k]
                    count += 1
                k = order[p]
                here = reduced[column[k], int(y[k] + np.float32(0.5))] - valley[k]
                if count == 0 or here * count >= np.float32(0.5) * total:
                    break
                beyond[k] = True


def floored_log(posterior: Array, floor: float) -> Array:
    """Natural logarithms of probabilities, none below that of `floor`: (P, S) float32."""
    logs = np.full(posterior.shape, np.log(floor), np.float32)
    _floored_log(posterior, np.float32(floor), logs)
    return logs


@kernel
def _floored_log(posterior: Array, floor: np.float32, logs: Array) -> None:
    # Few stripes have a share worth a logarithm.
    for k in range(posterior.shape[0]):
        for s in range(posterior.shape[1]):
            if posterior[k, s] > floor:
                logs[k, s] = np.log(posterior[k, s])


def votes_along(log_posterior: Array, chains: Chains, reach: float, gain: float) -> Array:
    """What a peak's neighbours on its chain think it is.

    Args:
        log_posterior: (P, S) float32, natural logarithms, floored by the caller.
        chains: the chains.
        reach: columns over which a vote falls to 1 / e.
        gain: worth of the mean vote, in votes.

    Returns:
        (P, S) float32: gain times the weighted mean of the neighbours' logarithms; 0 for a peak alone.
    """
    votes = np.zeros_like(log_posterior)
    _votes(log_posterior, chains.order, chains.start, np.float32(np.exp(-1 / reach)), np.float32(gain), votes)
    return votes


@kernel
def _votes(logs: Array, order: Ints, start: Ints, decay: np.float32, gain: np.float32, votes: Array) -> None:
    states = logs.shape[1]
    weight = np.zeros(len(order), np.float32)
    total = np.empty(states, np.float32)
    one = np.float32(1)
    for c in range(len(start) - 1):
        for way in range(2):
            total[:] = 0
            mass = np.float32(0)
            for step in range(start[c + 1] - start[c]):
                k = order[start[c] + step] if way == 0 else order[start[c + 1] - 1 - step]
                for s in range(states):
                    votes[k, s] += total[s]
                    total[s] = decay * (total[s] + logs[k, s])
                weight[k] += mass
                mass = decay * (mass + one)
    for k in range(len(order)):
        if weight[k] > 0:
            # Few neighbours are worth less than a full vote.
            f = gain / max(weight[k], one)
            for s in range(states):
                votes[k, s] *= f


def path_along(logs: Array, chains: Chains, switch: float) -> Ints:
    """The best stripe for each peak, chains taken one by one, with a cost for changing stripe along a chain.

    Args:
        logs: (P, S) float32 log-evidence of each peak.
        chains: the chains.
        switch: cost of a change, natural logarithm.

    Returns:
        (P,) int32.
    """
    path = np.zeros(len(logs), np.int32)
    _path(logs, chains.order, chains.start, np.float32(switch), path)
    return path


@kernel
def _path(logs: Array, order: Ints, start: Ints, switch: np.float32, path: Ints) -> None:
    states = logs.shape[1]
    longest = 0
    for c in range(len(start) - 1):
        longest = max(longest, start[c + 1] - start[c])
    came = np.empty((longest, states), np.int32)
    score = np.empty(states, np.float32)
    for c in range(len(start) - 1):
        size = start[c + 1] - start[c]
        score[:] = 0
        for step in range(size):
            k = order[start[c] + step]
            top = 0
            for s in range(states):
                if score[s] > score[top]:
                    top = s
            limit = score[top] - switch
            for s in range(states):
                if score[s] >= limit:
                    came[step, s] = s
                else:
                    came[step, s] = top
                    score[s] = limit
                score[s] += logs[k, s]
        s = 0
        for t in range(states):
            if score[t] > score[s]:
                s = t
        for step in range(size - 1, -1, -1):
            path[order[start[c] + step]] = s
            s = came[step, s]
