"""Short chains of one stripe joined to tracks, over which its carriers are read where print breaks it up.

At the edge of a dark cell a stripe's peak moves, by half the cell at worst, and its chain ends. What goes on at the
same height within a few columns is the same stripe, unless the surface steps by a whole pitch there; pieces so short
say little each for itself. A track has one place in every column, on a line smoothed over the cells, so that the
carriers' phases go on. A chain that is long enough is a track of its own, as it is.
Not here: chains (`linking`), along which peaks are averaged; what the image shows along a track (`carriers`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp.linking import Chains
from scanner.decode.mcp.ranks import quantiles
from scanner.decode.mcp.stripes import STEP, Peaks
from scanner.kernel import kernel

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

PIECE = 1.5
"""Length in pitches from which on a chain is joined to no other. Print that breaks stripes up has cells of about a
pitch: on larger ones a stripe runs through. What is longer ends at the surface's own edges, where a step of depth of a
whole pitch lines stripes up again."""

ACROSS = 0.3
"""Distance of two pieces' mean heights in pitches, below which they are one stripe: two stripes are 1 apart."""

COLUMNS = 8
"""Columns over which those means are taken from where the pieces meet: 32 px, a cell of print or two."""

OVERLAP, HOLE = 4, 4
"""Columns by which a piece may reach into the next (a stripe on oblique print has two peaks there), and columns that
may be without a peak: a period of a carrier."""

BESIDE = 0.45
"""Distance in pitches below which a piece that goes on no other belongs to the track that runs beside it."""

WIDE = 0.42
"""Rows to either side over which a joined track's light is summed, in pitches: all of a stripe but its feet. Cells up
to half as high as a stripe then weigh alike in every column."""

PATTERN_SHARE = np.float32(1 - WIDE)
"""Mean of a stripe's profile over these rows, as a share of its height."""

LOW = 0.25
"""Quantile of the light at a track's feet that is taken for what is not the pattern's: print makes valleys where there
are none."""

MOST_AMBIENT = 0.9
"""Share of light that is not the pattern's beyond which a track shows too little of it to be drawn out."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Where the carriers of P peaks are read: at P places and more, between pieces, that have no peak.

    y, valley: (P + V,) float32, px and grey levels; of joined tracks y is smooth and valley 0. chains: of places, one
    to a column; those joined come last. links: of peaks, track by track, column by column. place: (P,) int32, where
    each peak is read: itself or the one it shares a column with. joined: (C,) bool, tracks of several pieces. ambient:
    (C,) float32, share of their light that is not the pattern's. broken: (P,) bool, peaks of joined tracks.
    """

    y: Array
    valley: Array
    chains: Chains
    links: Chains
    place: Ints
    joined: NDArray[np.bool_]
    ambient: Array
    broken: NDArray[np.bool_]


def single(peaks: Peaks, chains: Chains) -> Tracks:
    """Each chain a track of its own."""
    count, own = len(chains.lengths), np.arange(len(peaks), dtype=np.int32)
    none = np.zeros(count, np.float32)
    return Tracks(peaks.y, peaks.valley, chains, chains, own, none > 0, none, np.zeros(len(peaks), np.bool_))


def join(peaks: Peaks, chains: Chains, pitch: float, long: int) -> Tracks:
    """Tracks of all peaks.

    Args:
        peaks: P peaks.
        chains: their chains, in the order of their first columns, as `linking.link` makes them.
        pitch: px.
        long: columns that a joined track has at least: as many as tell carriers apart.
    """
    piece = int(PIECE * pitch / STEP)
    track = _leaders(peaks.y, chains.order, chains.start, chains.column, np.float32(ACROSS * pitch), piece, long)
    leaders = np.flatnonzero(np.bincount(track, minlength=len(track)) > 1)
    if not len(leaders):
        return single(peaks, chains)
    rank = np.full(len(track), -1, np.int32)
    rank[leaders] = np.arange(len(leaders))
    rank = rank[track]
    smooth = max(1, round(pitch / (2 * STEP)))
    lines = _lines(peaks, chains, rank, smooth)
    alone, reach = np.flatnonzero((rank < 0) & (chains.lengths < piece)), np.float32(BESIDE * pitch)
    before = rank.copy()
    _adopt(alone, peaks.y, chains.order, chains.start, chains.column, lines.first, lines.begin, lines.y, reach, rank)
    if not np.array_equal(rank, before):
        lines = _lines(peaks, chains, rank, smooth)
    return _joined(peaks, chains, rank, lines)


@dataclass(frozen=True, eq=False)
class _Lines:
    """Of J joined tracks: y (N,) float32 in all their columns, track by track; column (N,) int32; where each track
    begins (J + 1,) int32. peak: (K,) int32, their peaks; slot: (K,) int64, where in y each of them is.
    """

    y: Array
    column: Ints
    begin: Ints
    peak: Ints
    slot: NDArray[np.int64]

    @property
    def first(self) -> Ints:
        """(J,) int32: first columns."""
        return self.column[self.begin[:-1]]


def _lines(peaks: Peaks, chains: Chains, rank: Ints, smooth: int) -> _Lines:
    """Mean heights of the peaks in each column, straight across holes, as means of `smooth` columns to either side.

    Args:
        peaks, chains: as elsewhere.
        rank: (C,) int32, the joined track of each chain, -1 for none.
        smooth: columns; fewer towards the ends, so that a mean stays where it is.
    """
    of_peak = np.repeat(rank, chains.lengths)
    peak, track = chains.order[of_peak >= 0], of_peak[of_peak >= 0]
    column = chains.column[peak]
    first, last = np.full(track.max() + 1, column.max()), np.zeros(track.max() + 1, np.int32)
    np.minimum.at(first, track, column)
    np.maximum.at(last, track, column)
    lengths = last - first + 1
    begin = np.concatenate(([0], np.cumsum(lengths))).astype(np.int32)
    slot = (begin[track] + column - first[track]).astype(np.int64)
    count = np.bincount(slot, minlength=begin[-1])
    known = np.flatnonzero(count)
    height = np.bincount(slot, weights=peaks.y[peak], minlength=begin[-1])[known] / count[known]
    # A track has a peak at both its ends: no line is drawn from one track to the next.
    place = np.arange(begin[-1])
    sums = np.concatenate(([0.0], np.cumsum(np.interp(place, known, height))))
    from_begin, to_end = place - np.repeat(begin[:-1], lengths), np.repeat(begin[1:], lengths) - 1 - place
    reach = np.minimum(np.minimum(from_begin, to_end), smooth)
    mean = (sums[place + reach + 1] - sums[place - reach]) / (2 * reach + 1)
    columns = (from_begin + np.repeat(first, lengths)).astype(np.int32)
    return _Lines(mean.astype(np.float32), columns, begin, peak, slot)


def _joined(peaks: Peaks, chains: Chains, rank: Ints, lines: _Lines) -> Tracks:
    """Single chains as they are, then the joined tracks."""
    count, peak, lengths = len(peaks), lines.peak, np.diff(lines.begin)
    at = np.full(len(lines.y), -1, np.int32)
    at[lines.slot[::-1]] = peak[::-1]  # of those that share a column the first
    holes = np.flatnonzero(at < 0)
    at[holes] = count + np.arange(len(holes))
    place, broken = np.arange(count, dtype=np.int32), np.zeros(count, np.bool_)
    place[peak], broken[peak] = at[lines.slot], True
    more = np.zeros(len(holes), np.float32)
    y, valley = np.concatenate((peaks.y, more)), np.concatenate((peaks.valley, more))
    column = np.concatenate((chains.column, np.zeros(len(holes), np.int32)))
    y[at], valley[at], column[at] = lines.y, 0, lines.column
    alone, left = chains.order[~broken[chains.order]], chains.lengths[rank < 0]
    links = peak[np.argsort(lines.slot, kind="stable")]
    ends = np.searchsorted(np.sort(lines.slot), lines.begin).astype(np.int32)
    foot = np.maximum(peaks.valley[links], 0)
    share = foot / np.maximum(foot + PATTERN_SHARE * peaks.height[links], np.float32(1e-6))
    ambient = [min(quantiles(part, LOW)[0], MOST_AMBIENT) for part in np.split(share, ends[1:-1])]
    return Tracks(
        y,
        valley,
        Chains(np.concatenate((alone, at)), _starts(left, lengths), column),
        Chains(np.concatenate((alone, links)), _starts(left, np.diff(ends)), chains.column),
        place,
        np.repeat((False, True), (len(left), len(lengths))),
        np.concatenate((np.zeros(len(left)), ambient)).astype(np.float32),
        broken,
    )


def _starts(alone: Ints, joined: Ints) -> Ints:
    return np.concatenate(([0], np.cumsum(np.concatenate((alone, joined))))).astype(np.int32)


@kernel
def _leaders(y: Array, order: Ints, start: Ints, column: Ints, across: np.float32, piece: int, long: int) -> Ints:
    """The first chain of each one's track: (C,) int32."""
    count = len(start) - 1
    leader, followed = np.arange(count).astype(np.int32), np.zeros(count, np.bool_)
    tail, weight = np.zeros(count, np.float32), np.zeros(count, np.int32)
    alive, many = np.empty(count, np.int32), 0
    for c in range(count):
        size = start[c + 1] - start[c]
        if size >= piece or size == 0:
            continue
        first, last = column[order[start[c]]], column[order[start[c + 1] - 1]]
        near = min(size, COLUMNS)
        head = np.float32(0)
        for p in range(start[c], start[c] + near):
            head += y[order[p]] / np.float32(near)
        best, least, kept = -1, across, 0
        for a in range(many):
            other = alive[a]
            end = column[order[start[other + 1] - 1]]
            if end < first - HOLE - 1 or followed[other]:
                continue
            alive[kept] = other
            kept += 1
            apart = abs(tail[other] - head)
            if apart < least and end < min(first + OVERLAP, last) and column[order[start[other]]] < first:
                best, least = other, apart
        alive[kept] = c
        many = kept + 1
        weight[c] = near
        for p in range(start[c + 1] - near, start[c + 1]):
            tail[c] += y[order[p]] / np.float32(near)
        if best >= 0:
            followed[best] = True
            leader[c] = leader[best]
            more = min(COLUMNS - near, weight[best])
            weight[c] += more
            tail[c] += (tail[best] - tail[c]) * np.float32(more) / np.float32(weight[c])
    _dissolve(order, start, column, long, leader)
    return leader


@kernel
def _dissolve(order: Ints, start: Ints, column: Ints, long: int, leader: Ints) -> None:
    """Pieces whose track is no longer than a chain that is read as it is are left alone."""
    count = len(leader)
    last = np.zeros(count, np.int32)
    for c in range(count):
        if start[c + 1] > start[c]:
            last[leader[c]] = max(last[leader[c]], column[order[start[c + 1] - 1]])
    for c in range(count):
        head = leader[c]
        if start[head + 1] > start[head] and last[head] - column[order[start[head]]] + 1 < long:
            leader[c] = -1 - head
    for c in range(count):
        if leader[c] < 0:
            leader[c] = c


@kernel
def _adopt(
    alone: NDArray[np.intp],
    y: Array,
    order: Ints,
    start: Ints,
    column: Ints,
    first: Ints,
    begin: Ints,
    line: Array,
    reach: np.float32,
    rank: Ints,
) -> None:
    """Give those chains to the tracks beside which they run."""
    for c in alone:
        size = start[c + 1] - start[c]
        if size == 0:
            continue
        head, end = column[order[start[c]]], column[order[start[c + 1] - 1]]
        least = reach
        for t in range(len(first)):
            if head < first[t] or end >= first[t] + begin[t + 1] - begin[t]:
                continue
            apart = np.float32(0)
            for p in range(start[c], start[c + 1]):
                apart += y[order[p]] - line[begin[t] + column[order[p]] - first[t]]
            apart = abs(apart) / np.float32(size)
            if apart < least:
                least, rank[c] = apart, t


def warm_up() -> None:
    """Compile what only an image with print comes to."""
    few, one = np.zeros(2, np.int32), np.zeros(1, np.float32)
    _adopt(np.zeros(0, np.intp), one, few, few, few, few[:1], few, one, np.float32(0), few)
