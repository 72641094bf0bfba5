"""The hidden Markov model of a column and its best path (Casey 2011, sec. 5.2, 5.3).

States: the symbols s_1 .. s_n, the pattern's code words in the order of their stripes, then the error states
e_0 .. e_n, where e_i stands between s_i and s_i+1. Left to right: a symbol or an error state leads to any later
symbol, or to the error state behind it. Observations are the nonzero code words of one column.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.kernel import kernel

Table = NDArray[np.float64]
Labels = NDArray[np.int32]
Confidence = NDArray[np.float32]

ERROR = 0.05
"""p_e, probability of a transition into an error state: "very small" (sec. 5.2)."""

SKIP = 2.0
"""k of the schedule: each further symbol skipped is less likely by this factor. The text gives no value. A carrier's
troughs break a modulated stripe in about every second column, so a skip has even odds."""


@dataclass(frozen=True, eq=False)
class Model:
    """Logarithms: start (S,), step (S, S) from row to column, emission (S, 2^bits); S = 2 n + 1."""

    start: Table
    step: Table
    emission: Table

    @property
    def symbols(self) -> int:
        """n."""
        return (len(self.start) - 1) // 2


def model(symbols: NDArray[np.int32], false_positive: Table, miss: Table) -> Model:
    """The model of a pattern (sec. 5.2).

    Args:
        symbols: (n,) int32, nonzero code words in the order of the stripes.
        false_positive, miss: (bits,) error rates of the channels.
    """
    with np.errstate(divide="ignore"):
        return Model(
            np.log(start_matrix(len(symbols))),
            np.log(transition_matrix(len(symbols))),
            np.log(emission_matrix(symbols, false_positive, miss)),
        )


def emission_matrix(symbols: NDArray[np.int32], false_positive: Table, miss: Table) -> Table:
    """Probability of each code word (columns) in each state (rows), (2 n + 1, 2^bits) (sec. 5.2, eq. 6.5-6.7).

    A channel that is sent is received with 1 - P_m, missed with P_m; one that is not sent appears with P_f. An error
    state emits every code word but 0 alike.
    """
    bits = len(miss)
    words = 1 << bits
    table = np.ones((2 * len(symbols) + 1, words))
    received = (np.arange(words)[:, None] >> np.arange(bits)) & 1
    for s, symbol in enumerate(symbols):
        sent = (int(symbol) >> np.arange(bits)) & 1
        chance = np.where(
            sent == 1, np.where(received, 1 - miss, miss), np.where(received, false_positive, 1 - false_positive)
        )
        table[s] = chance.prod(axis=1)
    table[len(symbols) :] = 1 / (words - 1)
    table[len(symbols) :, 0] = 0
    return table


def transition_matrix(n: int, error: float = ERROR, skip: float = SKIP) -> Table:
    """Probabilities from state (row) to state (column), (2 n + 1, 2 n + 1) (sec. 5.2, fig. 5.3, eq. 6.9).

    From s_i or e_i: to e_i with p_e; to s_j, j > i, with (1 - p_e) C k^-(j - i), C so that the row's sum is 1. From
    the last symbol only its error state is left.
    """
    table = np.zeros((2 * n + 1, 2 * n + 1))
    for i in range(n + 1):
        row = np.zeros(2 * n + 1)
        later = np.arange(i, n)
        if len(later):
            weight = skip ** -(later - i + 1.0)
            row[later] = (1 - error) * weight / weight.sum()
            row[n + i] = error
        else:
            row[n + i] = 1
        table[n + i] = row
        if i > 0:
            table[i - 1] = row
    return table


def start_matrix(n: int) -> Table:
    """All symbols and e_0 alike (sec. 5.2), (2 n + 1,)."""
    first = np.zeros(2 * n + 1)
    first[: n + 1] = 1 / (n + 1)
    return first


def best_paths(word: NDArray[np.int32], start: NDArray[np.int32], known: Model) -> NDArray[np.int32]:
    """Viterbi path of every column (sec. 5.3, eq. 6.3, 6.4), in logarithms.

    Args:
        word: (P,) code words on the peaks; zeros are no observations.
        start: (W + 1,) first peak of each column.
        known: the model.

    Returns:
        (P,) int32: symbol 1 .. n, 0 in an error state or without observation.
    """
    return _viterbi(word, start, known.start, known.step, known.emission)


def fitting(word: NDArray[np.int32], path: NDArray[np.int32], symbols: NDArray[np.int32]) -> float:
    """Share of the observed code words that are the symbols of the path; 0 if there are none.

    Ours: the dissertation knows that the pattern is there, in the order described; a scanner has to notice where not.
    """
    seen = word > 0
    expected = np.concatenate(([0], symbols))[path[seen]]
    return float((word[seen] == expected).mean()) if seen.any() else 0.0


def posteriors(
    word: NDArray[np.int32], start: NDArray[np.int32], path: NDArray[np.int32], known: Model
) -> NDArray[np.float32]:
    """Probability of the path's symbol at each peak by forward and backward sums, (P,) float32; 0 without one.

    Ours, from the model of sec. 5.2: the dissertation has no confidence, and each point of a scan needs one. It
    is as modest as the model's error rates are crude.
    """
    return _posteriors(word, start, path, np.exp(known.start), np.exp(known.step), np.exp(known.emission))


@kernel
def _observed(word: Labels, begin: int, end: int, at: NDArray[np.int64]) -> int:
    """Fill `at` with the places of a column's nonzero code words; their number."""
    count = 0
    for p in range(begin, end):
        if word[p] > 0:
            at[count] = p
            count += 1
    return count


@kernel
def _longest(start: Labels) -> int:
    most = 0
    for c in range(len(start) - 1):
        most = max(most, start[c + 1] - start[c])
    return most


@kernel
def _one_on(before: Table, step: Table, score: Table) -> None:
    """Into `score` that of the likeliest way to each state one observation later, without what is seen there.

    Left to right: symbols follow earlier symbols and error states, e_i follows s_i and e_i.
    """
    n = (len(before) - 1) // 2
    for s in range(n, 2 * n + 1):
        score[s] = before[s] + step[s, s]
        if s > n:
            score[s] = max(score[s], before[s - n - 1] + step[s - n - 1, s])
    for s in range(n):
        score[s] = before[n] + step[n, s]
    for r in range(n):
        # s_i and e_i have the same successors, with the same probabilities.
        _raise(max(before[r], before[n + r + 1]), step[r, r + 1 : n], score[r + 1 : n])


@kernel
def _raise(known: float, step: Table, score: Table) -> None:
    for s in range(len(score)):
        way = known + step[s]
        score[s] = way if way > score[s] else score[s]


@kernel
def _came_from(before: Table, step: Table, s: int, n: int) -> int:
    """The likeliest predecessor of s; of those alike the first in the order e_0, symbols, other error states."""
    if s >= n:
        symbol = s - n - 1
        return symbol if symbol >= 0 and before[symbol] + step[symbol, s] > before[s] + step[s, s] else s
    came = n
    for r in range(s):
        if before[r] + step[r, s] > before[came] + step[came, s]:
            came = r
    for r in range(n + 1, n + s + 1):
        if before[r] + step[r, s] > before[came] + step[came, s]:
            came = r
    return came


@kernel
def _viterbi(word: Labels, start: Labels, first: Table, step: Table, emission: Table) -> Labels:
    states, most = len(first), _longest(start)
    n = (states - 1) // 2
    observed = np.ascontiguousarray(emission.T)
    path = np.zeros(len(word), np.int32)
    at = np.empty(most, np.int64)
    score = np.empty((most, states))
    for c in range(len(start) - 1):
        count = _observed(word, start[c], start[c + 1], at)
        if count == 0:
            continue
        for t in range(count):
            if t == 0:
                score[0] = first
            else:
                _one_on(score[t - 1], step, score[t])
            score[t] += observed[word[at[t]]]
        state = int(np.argmax(score[count - 1]))
        for t in range(count - 1, -1, -1):
            if state < n:
                path[at[t]] = state + 1
            if t > 0:
                state = _came_from(score[t - 1], step, state, n)
    return path


@kernel
def _reached(before: Table, new: Table, step: Table) -> None:
    """Into `new` the sum over the predecessors of each state."""
    n = (len(before) - 1) // 2
    for s in range(n, 2 * n + 1):
        new[s] = before[s] * step[s, s]
        if s > n:
            new[s] += before[s - n - 1] * step[s - n - 1, s]
    for s in range(n):
        new[s] = before[n + s] * step[n + s, s]
    for r in range(n):
        of_symbol, of_error, later = step[r, r + 1 : n], step[n + r, r + 1 : n], new[r + 1 : n]
        for s in range(len(later)):
            later[s] += before[r] * of_symbol[s] + before[n + r] * of_error[s]


@kernel
def _one_back(backward: Table, new: Table, step: Table, observed: Table) -> None:
    """The backward sums one observation earlier, scaled; `new` is work space. observed: (S,) its emission."""
    states = len(new)
    n = (states - 1) // 2
    for r in range(n, states):
        # e_i and s_i have the same successors: e_i and every later symbol.
        total = step[r, r] * observed[r] * backward[r]
        for s in range(r - n, n):
            total += step[r, s] * observed[s] * backward[s]
        new[r] = total
        if r > n:
            new[r - n - 1] = total
    backward[:] = new / new.max()


@kernel
def _posteriors(word: Labels, start: Labels, path: Labels, first: Table, step: Table, emission: Table) -> Confidence:
    states, most = len(first), _longest(start)
    observed = np.ascontiguousarray(emission.T)
    sure = np.zeros(len(word), np.float32)
    at = np.empty(most, np.int64)
    forward = np.empty((most, states))
    backward = np.empty(states)
    new = np.empty(states)
    for c in range(len(start) - 1):
        count = _observed(word, start[c], start[c + 1], at)
        for t in range(count):
            if t == 0:
                forward[t] = first
            else:
                _reached(forward[t - 1], forward[t], step)
            forward[t] *= observed[word[at[t]]]
            forward[t] /= forward[t].sum()
        backward[:] = 1.0
        for t in range(count - 1, -1, -1):
            state = path[at[t]] - 1
            if state >= 0:
                total = (forward[t] * backward).sum()
                sure[at[t]] = forward[t, state] * backward[state] / total
            _one_back(backward, new, step, observed[word[at[t]]])
    return sure
