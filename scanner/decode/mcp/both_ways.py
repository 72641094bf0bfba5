"""Forward and backward over the columns' peaks (Baum et al. 1970), all states side by side in lanes.

What the probabilities are of stands in `hmm`. Rows of states are padded to whole vectors; states that are none have no
probability, and no way leads to them. Only sources with a share of the distribution are gone through: most peaks leave
a few.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanner.across_lanes import bits_of, greatest_of, lowest, total_of
from scanner.kernel import inlined_kernel, kernel
from scanner.lanes import LANES, floats, greatest, load, multiply_add, store

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

NEGLIGIBLE = np.float32(1e-6)
"""Shares of a distribution below which a state is passed over: far under what a jump gives every other state."""

NOTHING = np.float32(-1e30)
"""Logarithm of what a state that is none says of a peak."""

TINY = np.float32(1e-30)


def forward_backward(
    evidence: Array, start: Ints, gap: Ints, tables: Array, stray_log: Array, stray_share: float
) -> tuple[Array, Array]:
    """Probability of each state at each peak, (P, S) float32, and of a stray one, (P,) float32.

    Args:
        evidence: (P, S) float32, logarithms.
        start: (B + 1,) int32, where columns begin.
        gap: (P,) int32, which table leads to a peak.
        tables: (G, S, S) float32, from state [1] to state [2].
        stray_log: (P,) float32, logarithm of what a peak that is no stripe would show.
        stray_share: probability of such a one.
    """
    posterior, stray = np.empty_like(evidence), np.empty(len(evidence), np.float32)
    longest, states = int(np.diff(start).max(initial=0)), evidence.shape[1]
    width = -(-states // LANES) * LANES
    padded = np.pad(tables, ((0, 0), (0, width - states), (0, width - states)))
    back = np.ascontiguousarray(padded.transpose(0, 2, 1))
    rows = np.zeros((7, (longest + 1) * width), np.float32)
    work = _Rows(rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6], np.empty(longest, np.float32))
    _both_ways(
        evidence, start, gap, padded.ravel(), back.ravel(), stray_log, np.float32(stray_share), work, posterior, stray
    )
    return posterior, stray


class _Rows(NamedTuple):
    """Of a column, peak by peak: shares before (alpha) and after (beta) it, alpha moved to it, likelihoods, their
    products with beta; one row of evidence and one of posteriors. lost: likelihood of a stray peak.
    """

    alpha: Array
    beta: Array
    moved: Array
    likely: Array
    product: Array
    logs: Array
    sums: Array
    lost: Array


@inlined_kernel
def _move(source: Array, row: int, table: Array, begin: int, width: int, least: np.float32, target: Array) -> None:
    """target's row = source's row @ the table that begins at `begin`, without the sources of `least` or less."""
    for to in range(0, width, LANES):
        total = floats(np.float32(0))
        for block in range(0, width, LANES):
            left = bits_of(load(source, row + block) > least)
            while left != 0:
                state = block + lowest(left)
                left &= left - np.uint64(1)
                total = multiply_add(load(table, begin + state * width + to), floats(source[row + state]), total)
        store(target, row + to, total)


@inlined_kernel
def _likelihoods(
    evidence: Array, k: int, stray_log: np.float32, share: np.float32, row: int, width: int, work: _Rows
) -> np.float32:
    """Likelihoods of peak k, the largest at 1 - `share`; returns that of a stray peak."""
    for s in range(evidence.shape[1]):
        work.logs[s] = evidence[k, s]
    top = stray_log
    for block in range(0, width, LANES):
        top = max(top, greatest_of(load(work.logs, block)))
    for block in range(0, width, LANES):
        # exp(x) = (1 + x / 1024)^1024, exact to 1e-3 where it matters.
        x = greatest(
            multiply_add(load(work.logs, block) - top, floats(np.float32(1 / 1024)), floats(np.float32(1))),
            np.float32(0),
        )
        for _ in range(10):
            x = x * x
        store(work.likely, row + block, x * (np.float32(1) - share))
    lost: np.float32 = share * np.exp(stray_log - top)
    return lost


@inlined_kernel
def _normalise(values: Array, row: int, width: int, total: np.float32) -> None:
    scale = np.float32(1) / max(total, TINY)
    for block in range(row, row + width, LANES):
        store(values, block, load(values, block) * scale)


@inlined_kernel
def _forth(work: _Rows, row: int, width: int, lost: np.float32) -> None:
    """Alpha's next row = moved * likely + alpha * lost, normalised: the state of a stray peak is the one before it."""
    total = np.float32(0)
    for block in range(row, row + width, LANES):
        mixed = multiply_add(load(work.moved, block), load(work.likely, block), load(work.alpha, block) * lost)
        store(work.alpha, block + width, mixed)
        total += total_of(mixed)
    _normalise(work.alpha, row + width, width, total)


@inlined_kernel
def _both(work: _Rows, row: int, width: int, lost: np.float32) -> tuple[np.float32, np.float32, np.float32]:
    """Sums of posteriors (put into `sums`, not yet normalised) and of stray paths; the greatest of likely * beta."""
    good, bad, top = np.float32(0), np.float32(0), np.float32(0)
    for block in range(0, width, LANES):
        after = load(work.beta, row + width + block)
        product = load(work.likely, row + block) * after
        both = load(work.moved, row + block) * product
        store(work.product, row + block, product)
        store(work.sums, block, both)
        good += total_of(both)
        bad += total_of(load(work.alpha, row + block) * lost * after)
        top = max(top, greatest_of(product))
    return good, bad, top


@inlined_kernel
def _back(work: _Rows, row: int, width: int, lost: np.float32) -> None:
    """Beta's row = moved + beta's next row * lost, normalised."""
    total = np.float32(0)
    for block in range(row, row + width, LANES):
        mixed = multiply_add(load(work.beta, block + width), floats(lost), load(work.moved, block))
        store(work.beta, block, mixed)
        total += total_of(mixed)
    _normalise(work.beta, row, width, total)


@kernel
def _both_ways(
    evidence: Array,
    start: Ints,
    gap: Ints,
    forth: Array,
    back: Array,
    stray_log: Array,
    share: np.float32,
    work: _Rows,
    posterior: Array,
    stray: Array,
) -> None:
    states = evidence.shape[1]
    width = (states + LANES - 1) // LANES * LANES
    table = width * width
    work.logs[states:width] = NOTHING
    for b in range(len(start) - 1):
        first, size = start[b], start[b + 1] - start[b]
        for s in range(states):
            work.alpha[s] = np.float32(1) / np.float32(states)
            work.beta[size * width + s] = np.float32(1)
        for t in range(size):
            row = t * width
            lost = _likelihoods(evidence, first + t, stray_log[first + t], share, row, width, work)
            work.lost[t] = lost
            if t == 0:
                for s in range(states):
                    work.moved[s] = work.alpha[s]
            else:
                _move(work.alpha, row, forth, gap[first + t] * table, width, NEGLIGIBLE, work.moved)
            _forth(work, row, width, lost)
        for t in range(size - 1, -1, -1):
            row = t * width
            good, bad, top = _both(work, row, width, work.lost[t])
            scale = np.float32(1) / max(good + bad, TINY)
            for s in range(states):
                posterior[first + t, s] = work.sums[s] * scale
            stray[first + t] = bad * scale
            if t > 0:
                _move(work.product, row, back, gap[first + t] * table, width, NEGLIGIBLE * top, work.moved)
                _back(work, row, width, work.lost[t])
