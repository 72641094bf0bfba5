"""Middles of bins: what pixels of like brightness, or of like noise, have in the middle.

Medians stand against the few that are out of the way. Bins hold equal counts, so that each has its median with the same
certainty. Sorted and searched by the bits of the numbers: a few thousand of them take microseconds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.kernel import kernel

_DIGITS = 1 << 11
_OCTAVES = 24
_SIGN = np.uint32(1 << 31)
_BLOCK = 64
_COUNTED = 1 << 15
"""Fewer than 16 bits can count."""


@kernel
def middles_of_bins(
    keys: NDArray[np.float32], values: NDArray[np.float32], bins: int, squares: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int32]]:
    """Values' medians in bins of equal count by key; those of the greatest keys that fill no bin are left out.

    Args:
        keys, values: (n,) float32 without NaN, n >= bins. squares: take `middle_of_squares` of the values.

    Returns:
        (bins,) float32 median of each bin's keys. (bins,) float32 median of its values. (n,) int32, all in the order of
        their keys; equal ones keep theirs. Of an even count the medians are the upper of both in the middle.
    """
    order = order_of(keys)
    x, y = middles_in_order(order, keys, values, bins, squares)
    return x, y, order


@kernel
def middles_in_order(
    order: NDArray[np.int32], keys: NDArray[np.float32], values: NDArray[np.float32], bins: int, squares: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """`middles_of_bins` of those that `order` names, bins or more of them, in the order of their keys."""
    count = order.size // bins
    x, y, part = np.empty(bins, np.float32), np.empty(bins, np.float32), np.empty(count, np.float32)
    for b in range(bins):
        first = b * count
        for i in range(count):
            part[i] = values[order[first + i]]
        x[b] = keys[order[first + count // 2]]
        y[b] = middle_of_squares(part) if squares else nth_of(part, count // 2)
    return x, y


@kernel
def nth_of(values: NDArray[np.float32], n: int) -> np.float32:
    """The value that n others, 0 <= n < size, are not greater than. values: float32 without NaN.

    By the upper halves of all words first, as many of which fill a register, then by the lower ones of the few that
    have the same upper half.
    """
    words = _ordered(values)
    halves, lower, count = np.empty(words.size, np.uint16), np.empty(words.size, np.uint16), 0
    for i in range(words.size):
        halves[i] = np.uint16(words[i] >> np.uint32(16))
    upper, below = _nth_half(halves, n)
    for begin in range(0, words.size, _BLOCK):
        block = halves[begin : begin + _BLOCK]
        if _how_many(block, upper, True) > 0:
            for i in range(block.size):
                if block[i] == upper:
                    lower[count] = np.uint16(words[begin + i] & np.uint32(0xFFFF))
                    count += 1
    last, _ = _nth_half(lower[:count], n - below)
    return _number(np.uint32(np.uint32(upper) << np.uint32(16) | np.uint32(last)))


@kernel
def _nth_half(halves: NDArray[np.uint16], n: int) -> tuple[np.uint16, int]:
    """The greatest of 16 bits that no more than n lie below, bit by bit; and how many do."""
    found, least = np.uint16(0), 0
    for bit in range(15, -1, -1):
        tried = np.uint16(found | np.uint16(1 << bit))
        below = 0
        for begin in range(0, halves.size, _COUNTED):
            below += _how_many(halves[begin : begin + _COUNTED], tried, False)
        if below <= n:
            found, least = tried, below
    return found, least


@kernel
def _how_many(halves: NDArray[np.uint16], limit: np.uint16, same: bool) -> int:
    """How many of _COUNTED at the most lie below a limit, or are the same."""
    # Narrow counters are what makes this a few vector instructions.
    found = np.uint16(0)
    if same:
        for i in range(halves.size):
            found = np.uint16(found + np.uint16(halves[i] == limit))
    else:
        for i in range(halves.size):
            found = np.uint16(found + np.uint16(halves[i] < limit))
    return int(found)


@kernel
def middle_of_squares(squares: NDArray[np.float32]) -> np.float32:
    """The median of squares, (n,) float32, 0 or more, of numbers that may be whole multiples of something.

    Of whole grey levels few differences are possible, and the median would jump from one's square to the next one's.
    Where several are the same as the middle one they stand for all numbers that round to it, half a level to either
    side at the most: the median lies among these as if they were spread evenly (the median of grouped data).
    """
    middle = nth_of(squares, squares.size // 2)
    below, same, before, after = 0, 0, np.float32(-1), np.float32(np.inf)
    for i in range(squares.size):
        if squares[i] < middle:
            below += 1
            before = max(before, squares[i])
        elif squares[i] > middle:
            after = min(after, squares[i])
        else:
            same += 1
    if same == 1 or after == np.inf:
        return middle
    root = np.sqrt(middle)
    low = root - min((root - np.sqrt(before)) / 2, 0.5) if below > 0 else 0.0
    high = root + min((np.sqrt(after) - root) / 2, 0.5)
    return np.float32((low + (high - low) * (squares.size / 2 - below) / same) ** 2)


@kernel
def order_of(keys: NDArray[np.float32]) -> NDArray[np.int32]:
    """(n,) int32: which come first. keys: (n,) float32 without NaN; below 0 they count as 0.

    Equal ones keep their order, and so do those that differ by no more than what _DIGITS leave of the octaves between
    the least and the greatest: a thousandth of themselves over an octave and a half, a percent at the very most, since
    what lies more than _OCTAVES below the greatest counts as least. One round of sorting does then, and medians of bins
    of some hundred pixels are no better than that.
    """
    bits, size = keys.view(np.uint32), keys.size
    words = np.empty(size, np.uint32)
    for i in range(size):
        words[i] = bits[i] if bits[i] < _SIGN else np.uint32(0)
    low, high = words[0], words[0]
    for i in range(size):
        low, high = min(low, words[i]), max(high, words[i])
    low = max(low, np.uint32(high - min(high, np.uint32(_OCTAVES << 23))))
    drop = np.uint32(0)
    while np.uint32(high - low) >> drop >= np.uint32(_DIGITS):
        drop += np.uint32(1)
    starts, digits, order = np.zeros(_DIGITS, np.int32), np.empty(size, np.int32), np.empty(size, np.int32)
    for i in range(size):
        digits[i] = np.uint32(max(words[i], low) - low) >> drop
    for i in range(size):
        starts[digits[i]] += 1
    below = 0
    for d in range(_DIGITS):
        here = starts[d]
        starts[d] = below
        below += here
    for i in range(size):
        d = digits[i]
        order[starts[d]] = i
        starts[d] += 1
    return order


@kernel
def _number(word: np.uint32) -> np.float32:
    """The number of one of `_ordered`'s words."""
    one = np.empty(1, np.uint32)
    one[0] = np.uint32(word ^ _SIGN) if word & _SIGN else np.uint32(~word)
    return np.float32(one.view(np.float32)[0])


@kernel
def _ordered(values: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Words of 32 bits that are in the order of the numbers."""
    bits = values.view(np.uint32)
    words = np.empty(values.size, np.uint32)
    for i in range(values.size):
        # -0 is 0.
        bit = bits[i] if bits[i] != _SIGN else np.uint32(0)
        words[i] = ~bit if bit & _SIGN else bit ^ _SIGN
    return words
