"""Bits of Gray and binary code: frames of a line of pixels compared, to numbers of cells, and how near a thing it was.

Grey levels stay in their own type from the first comparison on (`scanner.sample_lanes`), and what is found of a line
stays in memory of a few lines until it is judged, lane by lane, in `graycode_kernels`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.addresses import CACHE_LINE
from scanner.kernel import inlined_kernel
from scanner.lanes import Lanes, any_of, choose, expect, floats, greatest, least
from scanner.sample_lanes import (
    LINE,
    Line,
    all_the_same,
    count_of,
    keep_line,
    keep_words,
    less,
    line_at,
    line_of,
    more,
    pick,
)

PLAIN, INVERSE, BOTH = 0, 1, 2
"""Which images of a bit there are."""

AHEAD = 512
"""Pixels between those that are read and those that are asked for: a pair of frames each time one is read. Were all
asked for at once, the processor would wait: it asks for a few lines of its cache at a time."""

LIGHT, DARK = 0, 1
"""Rows of sums: of the brighter and of the darker images."""

CELL, OPEN, OF_WORDS = 0, 1, 2
"""Rows of words, of each axis: the cell's number, and which of its word's bits are open."""

OF_PAIRS, OF_ONE, ONES, ADDING, BRIGHT, WEIGHTS, NEAR = 0, 1, 2, 3, 4, 5, 21
"""Rows of samples: by how much images must differ, of pairs and of single ones; 1; 1 if bits of a number are sums of
its word's; 1 at bright pixels; the weight of each bit, in the half of the number that it belongs to; and of each axis
OF_NEAR rows."""

NEAR_PAIR, NEXT_PAIR, NEAR_ONE, NEXT_ONE, OF_NEAR = 0, 1, 2, 3, 4
"""The least and second least difference of decided bits, of pairs and then of single images."""


@inlined_kernel
def sum_pairs(
    addresses: NDArray[np.intp],
    coarse: int,
    at: int,
    like: NDArray[Any],
    lines: NDArray[Any],
    sums: NDArray[Any],
) -> None:
    """Sums of the brighter and of the darker of the coarse bits' images and inverses. Arguments: see `decode_codes`."""
    axes, bits = addresses.shape[0], addresses.shape[1]
    # One that is read is not turned into something else by the compiler, which takes longer.
    zero, one_more = all_the_same(0, like), line_at(lines, ONES * LINE)
    light, light_high, dark, dark_high = zero, zero, zero, zero
    for axis in range(axes):
        for bit in range(coarse):
            n = (axis * bits + bit) * 2
            one, two = line_of(addresses, n, at, like), line_of(addresses, n + 1, at, like)
            brighter, darker = greatest(one, two), least(one, two)
            # A sum that is less than what was added has gone beyond the largest sample.
            light, dark = light + brighter, dark + darker
            light_high = pick(light < brighter, light_high + one_more, light_high)
            dark_high = pick(dark < darker, dark_high + one_more, dark_high)
    keep_words(sums, LIGHT * LINE, light, light_high)
    keep_words(sums, DARK * LINE, dark, dark_high)


@inlined_kernel
def read_bits(
    addresses: NDArray[np.intp],
    kinds: NDArray[np.int64],
    levels: NDArray[np.intp],
    axis: int,
    at: int,
    like: NDArray[Any],
    top: int,
    all_pairs: bool,
    margins: bool,
    lines: NDArray[Any],
    words: NDArray[np.uint16],
) -> bool:
    """Read one axis's bits into its rows; whether any is open.

    Args:
        top: the largest level, which stands for the difference of no bit. all_pairs: there are both images of all bits.
        margins: keep the least differences. lines, words: flat. The others: see `decode_codes`.
    """
    bits = kinds.shape[1]
    zero, most = all_the_same(0, like), all_the_same(top, like)
    of_pairs, of_one = line_at(lines, OF_PAIRS * LINE), line_at(lines, OF_ONE * LINE)
    cell, cell_high, unsure, unsure_high = zero, zero, zero, zero
    nowhere = zero < 0
    is_one, opened = nowhere, nowhere
    # A bit of a Gray code's number is the sum of all of the word's so far.
    adding = line_at(lines, ADDING * LINE) > 0
    near_pair, next_pair, near_one, next_one = most, most, most, most
    first = 0
    for last in (max(bits - 8 * like.itemsize, 0), bits):
        cell_high, unsure_high, cell, unsure = cell, unsure, zero, zero
        for bit in range(first, last):
            weight = line_at(lines, (WEIGHTS + bit) * LINE)
            n, before = (axis * bits + bit) * 2, is_one & adding
            for part in range(0, LINE, CACHE_LINE // like.itemsize):
                # One that is not there has address 0, and asking for it does no harm.
                expect(addresses, n, at + AHEAD + part, like)
                expect(addresses, n + 1, at + AHEAD + part, like)
            if all_pairs or kinds[axis, bit] == BOTH:
                one, two = line_of(addresses, n, at, like), line_of(addresses, n + 1, at, like)
                difference = greatest(one, two) - least(one, two)
                is_open, is_one = difference <= of_pairs, one > two
                if margins:
                    margin = pick(is_open, most, difference)
                    next_pair = least(next_pair, greatest(near_pair, margin))
                    near_pair = least(near_pair, margin)
            else:
                inverted = kinds[axis, bit] == INVERSE
                one = line_of(addresses, n + 1 if inverted else n, at, like)
                brighter, darker = _beside_levels(one, levels, at, like)
                difference = least(greatest(brighter, darker) - least(brighter, darker), most)
                is_open = difference <= of_one
                is_one = (darker > brighter) if inverted else (brighter > darker)
                if margins:
                    margin = pick(is_open, most, difference)
                    next_one = least(next_one, greatest(near_one, margin))
                    near_one = least(near_one, margin)
            is_one = is_one ^ before
            cell = pick(is_one, cell + weight, cell)
            unsure = pick(is_open, unsure + weight, unsure)
            opened = opened | is_open
        first = last
    keep_words(words, (axis * OF_WORDS + CELL) * LINE, cell, cell_high)
    keep_words(words, (axis * OF_WORDS + OPEN) * LINE, unsure, unsure_high)
    if margins:
        first = NEAR + axis * OF_NEAR
        keep_line(lines, (first + NEAR_PAIR) * LINE, near_pair)
        keep_line(lines, (first + NEXT_PAIR) * LINE, next_pair)
        keep_line(lines, (first + NEAR_ONE) * LINE, near_one)
        keep_line(lines, (first + NEXT_ONE) * LINE, next_one)
    return count_of(opened) > 0


@inlined_kernel
def _beside_levels(one: Line, levels: NDArray[np.intp], at: int, like: NDArray[Any]) -> tuple[Line, Line]:
    """Two lines that differ by twice an image less white and black, or by the largest sample and more if that does."""
    white, black = line_of(levels, 0, at, like), line_of(levels, 1, at, like)
    return more(less(one, black), less(one, white)), more(less(black, one), less(white, one))


@inlined_kernel
def count_decided(
    addresses: NDArray[np.intp],
    kinds: NDArray[np.int64],
    levels: NDArray[np.intp],
    at: int,
    like: NDArray[Any],
    top: int,
    lines: NDArray[Any],
    decided: NDArray[np.int64],
) -> None:
    """Add to decided, (A x bits + 1,), at how many bright pixels of the line each bit is decided; at last how many
    there are. Arguments: see `read_bits`."""
    bits, most = kinds.shape[1], all_the_same(top, like)
    of_pairs, of_one = line_at(lines, OF_PAIRS * LINE), line_at(lines, OF_ONE * LINE)
    bright = line_at(lines, BRIGHT * LINE) > 0
    for axis in range(kinds.shape[0]):
        for bit in range(bits):
            m = axis * bits + bit
            if kinds[axis, bit] == BOTH:
                one, two = line_of(addresses, 2 * m, at, like), line_of(addresses, 2 * m + 1, at, like)
                limit = of_pairs
            else:
                single = line_of(addresses, 2 * m + (1 if kinds[axis, bit] == INVERSE else 0), at, like)
                one, two = _beside_levels(single, levels, at, like)
                limit = of_one
            difference = least(greatest(one, two) - least(one, two), most)
            decided[m] += count_of((difference > limit) & bright)
    decided[kinds.size] += count_of(bright)


@inlined_kernel
def value_and_spread(cell: Lanes, unsure: Lanes, gray: bool) -> tuple[Lanes, Lanes]:
    """The middle of the cells that a pixel may see, whatever its open bits are, and from the first to the last of them.

    Any of them is as likely as the others: read as it happens to be, an open bit would name the first one or the last
    as often as those between. In cells, the middle in whole or half ones. More than two open bits give a spread beyond
    any limit.

    Args:
        cell: number of one of them. unsure: the open bits of the word.
    """
    value, spread = floats(cell), floats(np.float32(0))
    if any_of(unsure > 0):
        high = unsure & (unsure - 1)
        # With the least significant open bit turned, and with the next one, too. Turning a bit of a Gray word turns all
        # bits of the number below it: numbers are linear in words.
        low, both = cell ^ _number(unsure ^ high, gray), cell ^ _number(unsure, gray)
        alone = (cell ^ low) ^ both
        first, last = least(least(cell, low), least(both, alone)), greatest(greatest(cell, low), greatest(both, alone))
        value, spread = floats(first + last) * np.float32(0.5), floats(last - first)
        spread = choose((high & (high - 1)) > 0, np.float32(1e6), spread)
    return value, spread


@inlined_kernel
def _number(word: Lanes, gray: bool) -> Lanes:
    if gray:
        word = word ^ (word >> 8)
        word = word ^ (word >> 4)
        word = word ^ (word >> 2)
        word = word ^ (word >> 1)
    return word
