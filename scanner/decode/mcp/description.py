"""How far what was decoded agrees with the description: another pattern, and code words that changed places.

The columns' model knows the order of the stripes, and finds it where a word or two are wrong: then what single peaks
say contradicts it, peak by peak. Not here: the stripes of an image (`decision`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp.emissions import Amplitudes
from scanner.decode.mcp.hmm import MAX_GAP
from scanner.decode.mcp.model import PatternModel
from scanner.kernel import kernel

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

CLEAR = 3.0
"""Logarithm of the odds between two code words above which a peak clearly shows the one."""

LEAST_CLEAR = 0.02
"""Share of the peaks that must show a word clearly for a description to be judged by them. By chance, with carriers of
another magnification or none, two in a thousand do and mostly none; two in a hundred of the MOST_ASKED are forty."""

LEAST_RUN = 4
"""Peaks of a run that agree on where they stand in the order: both kinds of stripe twice."""

LEAST_PEAKS = 8
"""Peaks at a stripe's place that have to say the same before its word is doubted."""

LEAST_ORDER = 0.45
"""Share of neighbouring stripes that follow one another in an image of the pattern: half way between rods, steps and
blocks before rolled and diagonal rigs, which leave .70 of them in order and more, and grids of two waves, whose stripes
show words by chance, of which .25 and less follow."""

MOST_ASKED = 2000
"""Peaks that are asked: enough for a share."""


@dataclass(frozen=True)
class Agreement:
    """How far what was decoded agrees with the description.

    clear: share of the peaks whose own carriers name a code word clearly (other than "all off", which unmodulated
    stripes show too). agree: share of these that the columns' model took for a stripe of that word. order: share of
    neighbouring stripes in a column that follow one another, 1 where no stripe has a neighbour. wraps: how often, in a
    whole pattern's height, one of its last stripes is followed by one of its first without a gap, which no surface does
    but a code order that was rotated (about once) or exchanged carriers do. hits: share of switched-on carriers seen
    with more than half their amplitude. exchanged: code words that stand in one another's places.
    """

    clear: float
    agree: float
    order: float
    hits: float
    wraps: float
    exchanged: tuple[int, ...] = ()

    @property
    def tells(self) -> bool:
        """Whether enough is clear for the description to be judged by."""
        return self.clear >= LEAST_CLEAR

    @property
    def holds(self) -> bool:
        """Whether this is the pattern described.

        On simulated scenes from boards to strong texture agree was .94 or more, hits .93 (.80 on the strongest); with
        another code order agree was .77 or less; with other carriers, fewer or more bits, fringes or an upside-down
        image few clear words were left and hits were .78 or less. The limits stand between. Without clear words there
        is no telling: a wrong magnification fits them all. Steps of depth jump back by a few stripes, never by half of
        them along a third of the image. Words alone do not make a pattern: where something else waves along its lines,
        each shows one, and only their order says that nobody projected them.
        """
        right = self.tells and self.agree >= 0.85 and self.hits >= 0.7 and self.order >= LEAST_ORDER
        return right and self.wraps < 0.3 and not self.exchanged


def agreement(
    seen: Amplitudes, evidence: Array, model: PatternModel, modulation: Array, path: Ints, columns: tuple[Ints, Ints]
) -> Agreement:
    """Compare what the peaks say one by one with what the columns' model made of them.

    Args:
        seen: the amplitudes.
        evidence: (P, S) log-likelihoods, without votes.
        model: the pattern's tables.
        modulation: (N,).
        path: (P,) int32, -1 for stray peaks.
        columns: where columns begin (B + 1,), and the table to each peak (P,) of `hmm.gaps`; 0 is one pitch.
    """
    words, of_word = model.words
    start, gap = columns
    # Whole columns: every third peak, say, would be the same few stripes wherever columns are alike.
    column = np.repeat(np.arange(len(start) - 1), np.diff(start))
    thin = np.flatnonzero(column % max(1, len(path) // MOST_ASKED) == 0)
    each = np.full((len(thin), len(words)), -np.inf, np.float32)
    best, ahead = np.zeros(len(thin), np.int32), np.zeros(len(thin), np.float32)
    _best_words(evidence, thin, of_word, each, best, ahead)
    clear = (ahead > CLEAR) & (words[best] != 0)
    agrees = (path[thin] >= 0) & (of_word[np.maximum(path[thin], 0)] == best)
    first = np.zeros(len(path), bool)
    first[start[:-1][start[:-1] < len(path)]] = True
    pairs, follows, wraps = (int(n) for n in _neighbours(path, first, gap, model.stripes // 2))
    on, over = (int(n) for n in _hits(path, model.ratio, seen.ratio, (0.5 * modulation).astype(np.float32)))
    clear_share, agree = (float(part.mean()) if part.size else 0.0 for part in (clear, agrees[clear]))
    exchanged = exchanged_words(each, places_in_order(path[thin], first[thin], gap[thin]), of_word, model)
    order, wrapped = (follows / pairs, wraps * model.stripes / pairs) if pairs else (1.0, 0.0)
    return Agreement(clear_share, agree, order, over / on if on else 0.0, wrapped, exchanged)


@kernel
def _neighbours(path: Ints, first: NDArray[np.bool_], gap: Ints, half: int) -> tuple[int, int, int]:
    """Neighbouring stripes one pitch apart; how many follow one another, and how many go back by more than half."""
    pairs, follows, wraps = 0, 0, 0
    for k in range(1, len(path)):
        if not first[k] and gap[k] == 0 and path[k] >= 0 and path[k - 1] >= 0:
            pairs += 1
            follows += path[k] == path[k - 1] + 1
            wraps += path[k - 1] - path[k] > half
    return pairs, follows, wraps


@kernel
def _hits(path: Ints, own: Array, seen: Array, half: Array) -> tuple[int, int]:
    """Carriers that are switched on in the peaks' stripes, and how many are seen with more than half of that."""
    on, over = 0, 0
    for k in range(len(path)):
        for i in range(own.shape[1] if path[k] >= 0 else 0):
            mean = own[path[k], i]
            on += mean > 0
            over += mean > 0 and seen[k, i] > half[i] * mean
    return on, over


@kernel
def _best_words(
    evidence: Array, thin: NDArray[np.intp], of_word: NDArray[np.intp], each: Array, best: Ints, ahead: Array
) -> None:
    """Of those peaks: the likelihood of each word's likeliest stripe, the best word, and how far the next is behind."""
    for n in range(len(thin)):
        k = thin[n]
        for s in range(len(of_word)):
            each[n, of_word[s]] = max(each[n, of_word[s]], evidence[k, s])
        top, next_one = each[n, 0], -np.float32(np.inf)
        for w in range(1, each.shape[1]):
            value = each[n, w]
            if value > top:
                top, next_one, best[n] = value, top, w
            else:
                next_one = max(next_one, value)
        ahead[n] = top - next_one


def places_in_order(path: Ints, first: NDArray[np.bool_], gap: Ints) -> Ints:
    """Which stripe each peak is by its place among its neighbours alone: (P,) int32, -1 where they do not agree.

    Peaks whole pitches apart form a run; the stripe that most of them say its first one is, counts for all.

    Args:
        path: (P,) int32, -1 for stray peaks.
        first: (P,) bool, first of a column.
        gap: of `hmm.gaps`.
    """
    place = np.full(len(path), -1, np.int32)
    _places(path, first, gap, place)
    return place


@kernel
def _places(path: Ints, first: NDArray[np.bool_], gap: Ints, place: Ints) -> None:
    count = len(path)
    offset = np.zeros(count, np.int32)
    begin = 0
    while begin < count:
        end = begin + 1
        offset[begin] = 0
        while end < count and not first[end] and gap[end] < MAX_GAP - 1:
            offset[end] = offset[end - 1] + gap[end] + 1
            end += 1
        votes, best = 0, 0
        for k in range(begin, end):
            if path[k] >= 0:
                same, asked = 0, path[k] - offset[k]
                for other in range(begin, end):
                    if path[other] >= 0 and path[other] - offset[other] == asked:
                        same += 1
                if same > votes:
                    votes, best = same, asked
        if votes >= LEAST_RUN and 2 * votes > end - begin:
            for k in range(begin, end):
                place[k] = max(best + offset[k], -1)
        begin = end


def exchanged_words(each: Array, place: Ints, of_word: NDArray[np.intp], model: PatternModel) -> tuple[int, ...]:
    """Code words that stand in one another's places, in the order of the description.

    A stripe whose place shows another word than the described one, clearly and at most of its peaks, is no proof:
    steps of depth do that to a few stripes. That the other word's place shows this one is: no scene makes words trade
    places. A stripe without light shows nothing in any place, but another word in its own.

    Args:
        each: (P, W) log-likelihood of each word.
        place: (P,) int32, stripe by the order, -1 unknown.
        of_word: (S,), word of each stripe; unmodulated ones share one with a modulated stripe.
        model: the pattern's tables.
    """
    carries = model.ratio > 0
    modulated = range(int(carries.any(axis=1).argmax()) % 2, model.stripes, 2)
    stripe_of = {int(of_word[stripe]): stripe for stripe in modulated}
    shows: dict[int, int] = {}
    asked: set[int] = set()
    count, sums = np.zeros(model.stripes, np.int64), np.zeros((model.stripes, each.shape[1]))
    _by_place(each, place, count, sums)
    other = sums.argmax(axis=1)
    against = np.zeros(model.stripes, np.int64)
    _contradictions(each, place, other, of_word, against)
    for stripe in modulated:
        if count[stripe] >= LEAST_PEAKS:
            asked.add(stripe)
            if 2 * against[stripe] > count[stripe]:
                shows[stripe] = stripe_of[int(other[stripe])]
    dark = [stripe for stripe in shows if model.level[stripe] == 0 and shows[stripe] not in asked]
    shows |= {shows[stripe]: stripe for stripe in dark}
    traded = [stripe for stripe in modulated if _comes_back(stripe, shows)]
    return tuple(int(carries[stripe] @ (1 << np.arange(model.channels))) for stripe in traded)


@kernel
def _by_place(each: Array, place: Ints, count: NDArray[np.int64], sums: NDArray[np.float64]) -> None:
    """Of each place in the order: peaks there, and what they say of each word, added up."""
    for k in range(len(place)):
        s = place[k]
        if 0 <= s < len(count):  # a run may go on past the last stripe
            count[s] += 1
            for w in range(each.shape[1]):
                sums[s, w] += each[k, w]


@kernel
def _contradictions(
    each: Array, place: Ints, other: NDArray[np.intp], own: NDArray[np.intp], against: NDArray[np.int64]
) -> None:
    """Of each place in the order: peaks that clearly show the `other` word instead of its `own`."""
    for k in range(len(place)):
        s = place[k]
        if 0 <= s < len(against):
            against[s] += each[k, other[s]] - each[k, own[s]] > np.float32(CLEAR)


def _comes_back(stripe: int, shows: Mapping[int, int]) -> bool:
    """Whether what stands in its place, and in that one's, leads back to the stripe."""
    at = stripe
    for _ in range(len(shows)):
        at = shows.get(at, -1)
        if at == stripe:
            return True
    return False
