"""One hidden Markov model over both kinds of stripe, for each column (Casey 2011, 5.2 and 5.3, made soft).

States are the stripes in projector order. From one peak to the next the stripe grows, by one where nothing is
missing, by more where stripes are hidden, at a cost that is bounded however many they are (a cap on the jump forced
whole ears of a bust into wrong stripes); a jump backwards, behind a thin object in front, costs more. A peak may also
be no stripe at all: the chain then stays in its state (the dissertation's error states e_0 .. e_n).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp.both_ways import forward_backward
from scanner.kernel import kernel

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

# Beside each constant stands what is true on the reference scenes (simulated rigs casey2011, bench2026 and quick, both
# patterns), all together and from scene to scene, and what the decoder makes of other values: `bench/mcp_hmm.py`. They
# are not estimated from the scan: decisions/0014.

MISS = 0.12
"""Probability ratio of one more missing stripe to none. True: .0065 (0 to .04). What is missed is not missed here and
there but along whole edges that show nowhere else (a step of depth by whole pitches): neighbouring columns, whose votes
count, are wrong together, so that the order of stripes is to be trusted less than a single column's rate says. At the
true rates a tenth more peaks are wrong; a quarter to four times the odds move right by .0004 and recall by .004."""

JUMP = 2e-4
"""Probability of any one jump forwards, however long: what bounds the cost of a step of depth. True: 1e-5 (0 to 3e-4,
under strong print). Any from a quarter to four times it gives the same but for four peaks."""

EDGE_MISS = 0.5
EDGE_JUMP = 5e-3
"""The same where an edge lies between two peaks: only what they show themselves tells how far the stripes jump. True:
.11 (0 to .53), and 7e-6 (0 to 1e-4). A quarter to four times the odds of EDGE_MISS move right by .0003 and recall by
.003, those of EDGE_JUMP nothing."""

EDGE_SPACING = 0.27
EDGE_HEIGHT = 0.4
"""An edge lies between peaks whose distance is that far from whole pitches, or whose heights are in that ratio. On one
surface the pitch changes by a tenth over a view (keystone, tilt) and the height with the angle of light. Edges at a
quarter of EDGE_SPACING, or four times EDGE_HEIGHT, cost .003 and .005 of recall and gain .0003 and .0002 of right; none
by spacing at all costs .006 of right on one scene and gains .013 on another."""

BACK = 2e-6
"""Probability of any one jump backwards. True: 1e-6 (0 to 2e-5). A quarter to four times it moves six peaks."""

REPEAT = 0.02
"""Probability ratio of the same stripe once more: one half on an object, the other on what lies behind its edge. True:
.008 (0 to .05). A quarter to four times it moves right by .0002 and recall by .002."""

STRAY = 0.01
"""Probability that a peak is no stripe. True: .04 (0 to .19): what the image's border or an edge cuts, and what leaks
into the dark. Nine in ten of these lie in a chain of such, so that single ones are rarer. A quarter of it gains .004 of
recall (half of that on one scene); four times it loses .005, and gains .0002 of right."""

MAX_GAP = 6
"""Largest number of pitches between neighbouring peaks that is told apart; beyond it jumps cost their bound. Of 14,000
peaks of three scenes a hundred and sixty follow after two pitches, ten after more than three."""


@dataclass(frozen=True, eq=False)
class Columns:
    """Result per peak: posterior (P, S) float32, probabilities that sum to 1 - `stray`; path (P,) int32, the best
    path's stripe or -1 for a stray peak; stray (P,) float32.
    """

    posterior: Array
    path: Ints
    stray: Array


@lru_cache(maxsize=8)
def transitions(stripes: int) -> Array:
    """(2 MAX_GAP, S, S) float32, read-only: probability from stripe [1] to stripe [2] over a gap of g + 1 pitches.

    The first MAX_GAP tables are for one surface, the others for where an edge lies between the two peaks.
    """
    step = np.arange(stripes)[None, :] - np.arange(stripes)[:, None]
    tables = []
    for miss, jump in ((MISS, JUMP), (EDGE_MISS, EDGE_JUMP)):
        for gap in range(1, MAX_GAP + 1):
            regular = miss ** np.abs(step - gap) * (1 - miss)
            table = np.where(step > 0, np.maximum(regular, jump), BACK)
            tables.append(np.where(step == 0, REPEAT, table))
    result = np.ascontiguousarray(tables, np.float32)
    result.flags.writeable = False
    return result


def gaps(start: Ints, y: Array, height: Array, pitch: float, weakest: float) -> Ints:
    """Which table leads from the peak before to this one: (P,) int32, 0 for a column's first.

    Args:
        start: (B + 1,) int32, where columns begin.
        y: (P,) px.
        height: (P,) grey levels.
        pitch: px.
        weakest: light of the pattern's dimmest stripe over its brightest: heights may differ by that on one surface.
    """
    pitches = np.diff(y, prepend=np.float32(0)) / pitch
    before = np.concatenate((height[:1], height[:-1]))
    ratio = np.minimum(height, before) / np.maximum(np.maximum(height, before), 1e-6)
    edge = (np.abs(pitches - np.rint(pitches)) > EDGE_SPACING) | (ratio < EDGE_HEIGHT * weakest)
    result: Ints = np.clip(np.floor(pitches + 0.35), 1, MAX_GAP).astype(np.int32) - 1
    result[edge] += MAX_GAP
    result[start[:-1][start[:-1] < len(y)]] = 0
    return result


def smooth_columns(evidence: Array, start: Ints, gap: Ints, tables: Array, stray_log: Array) -> tuple[Array, Array]:
    """Forward-backward over each column.

    Args:
        evidence: (P, S) float32, log-likelihoods and votes.
        start: (B + 1,) int32, where columns begin.
        gap: of `gaps`.
        tables: of `transitions`.
        stray_log: (P,) float32, log-likelihood of what is seen at a peak that is no stripe.

    Returns:
        posterior (P, S) float32 and the probability of a stray peak (P,) float32.
    """
    return forward_backward(evidence, start, gap, tables, stray_log, STRAY)


@kernel
def _longest(start: Ints) -> int:
    longest = 0
    for b in range(len(start) - 1):
        longest = max(longest, start[b + 1] - start[b])
    return longest


def best_paths(evidence: Array, start: Ints, gap: Ints, tables: Array, stray_log: Array) -> Ints:
    """Viterbi (1967) over each column: (P,) int32, the stripe, or -1 where the best path takes the peak for stray.

    Arguments as for `smooth_columns`.
    """
    path = np.full(len(evidence), -1, np.int32)
    _viterbi(evidence, start, gap, np.log(tables), stray_log, path)
    return path


@kernel
def _best_sources(score: Array, logs: Array, g: int, spread: np.float32, best: Array, source: Ints) -> None:
    """Where each state is best reached from by table g, whose logarithms differ by `spread` at most."""
    states = len(score)
    top = score[0]
    for s in range(states):
        top = max(top, score[s])
        best[s] = -np.float32(1e30)
    for p in range(states):
        from_here = score[p]
        # A state worse than the best one by more than that is no state's best source.
        if from_here < top - spread:
            continue
        for s in range(states):
            value = from_here + logs[g, p, s]
            better = value > best[s]
            best[s] = value if better else best[s]
            source[s] = p if better else source[s]


@kernel
def _viterbi(evidence: Array, start: Ints, gap: Ints, logs: Array, stray_log: Array, path: Ints) -> None:
    states = evidence.shape[1]
    longest = _longest(start)
    came = np.empty((longest, states), np.int32)
    real = np.empty((longest, states), np.bool_)
    score = np.empty(states, np.float32)
    best = np.empty(states, np.float32)
    source = np.empty(states, np.int32)
    keep, lose = np.float32(np.log(1 - STRAY)), np.float32(np.log(STRAY))
    spread = logs.max() - logs.min()
    for b in range(len(start) - 1):
        first, size = start[b], start[b + 1] - start[b]
        score[:] = 0
        for t in range(size):
            if t == 0:
                best[:] = 0
                source[:] = np.arange(states)
            else:
                _best_sources(score, logs, gap[first + t], spread, best, source)
            for s in range(states):
                taken = best[s] + keep + evidence[first + t, s]
                passed = score[s] + lose + stray_log[first + t]
                real[t, s] = taken >= passed
                came[t, s] = source[s] if taken >= passed else s
                score[s] = max(taken, passed)
        s = int(np.argmax(score))
        for t in range(size - 1, -1, -1):
            if real[t, s]:
                path[first + t] = s
            s = came[t, s]
