"""Bits of Gray and binary code: frames of a line of pixels compared, to numbers of cells, and how near a thing it was.

Grey levels stay in their own type from the first comparison on (`scanner.sample_lanes`), and what is found of a line
stays in memory of a few lines until it is judged, lane by lane, in `graycode_kernels`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.kernel import inlined_kernel
from scanner.lanes import Lanes, any_of, choose, floats, greatest, least
from scanner.sample_lanes import (
    LINE,
    Line,
    all_the_same,
    count_of,
    expect_line,
    keep_gray,
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

OF_PAIRS, OF_ONE, ONES, LEAST_PAIR, BRIGHT, LEAST_ONE, WEIGHTS, NEAR, APART = 0, 1, 2, 3, 4, 5, 6, 22, 30
"""Rows of samples: by how much images must differ, of pairs and of single ones; 1; the least difference of any bit's
pair; 1 at bright pixels; the least difference of single images; the weight of each bit, in the half of the number that
it belongs to; of each axis OF_NEAR rows; and the difference of each axis's bits."""

NEAR_PAIR, NEXT_PAIR, NEAR_ONE, NEXT_ONE, OF_NEAR = 0, 1, 2, 3, 4
"""The least and second least difference of decided bits, of pairs and then of single images."""


@inlined_kernel
def compare_images(
    addresses: NDArray[np.intp],
    kinds: NDArray[np.int64],
    levels: NDArray[np.intp],
    coarse: int,
    at: int,
    like: NDArray[Any],
    top: int,
    gray: bool,
    all_pairs: bool,
    lines: NDArray[Any],
    sums: NDArray[Any],
    words: NDArray[np.uint16],
) -> None:
    """Read every frame once: each bit's difference, each axis's number, and the sums of the coarse bits' images.

    Args:
        coarse: bits of each axis whose brighter and whose darker images are added up; 0 for no sums.
        top: the largest level, which stands for the difference of no bit. all_pairs: there are both images of all bits.
        lines, sums, words: flat. The others: see `decode_codes`.
    """
    axes, bits = kinds.shape
    zero, most = all_the_same(0, like), all_the_same(top, like)
    # One that is read is not turned into something else by the compiler, which takes longer.
    one_more = line_at(lines, ONES * LINE)
    light, light_high, dark, dark_high = zero, zero, zero, zero
    near_pair, near_one = most, most
    for axis in range(axes):
        cell, cell_high, first = zero, zero, 0
        for last in (max(bits - 8 * like.itemsize, 0), bits):
            cell_high, cell = cell, zero
            for bit in range(first, last):
                m = axis * bits + bit
                # One that is not there has address 0, and asking for it does no harm.
                expect_line(addresses, 2 * m, at + AHEAD, like)
                expect_line(addresses, 2 * m + 1, at + AHEAD, like)
                if all_pairs or kinds[axis, bit] == BOTH:
                    one, two = line_of(addresses, 2 * m, at, like), line_of(addresses, 2 * m + 1, at, like)
                    brighter, darker, is_one = greatest(one, two), least(one, two), one > two
                    difference = brighter - darker
                    near_pair = least(near_pair, difference)
                    if bit < coarse:
                        # A sum that is less than what was added has gone beyond the largest sample.
                        light, dark = light + brighter, dark + darker
                        light_high = pick(light < brighter, light_high + one_more, light_high)
                        dark_high = pick(dark < darker, dark_high + one_more, dark_high)
                else:
                    inverted = kinds[axis, bit] == INVERSE
                    single = line_of(addresses, 2 * m + 1 if inverted else 2 * m, at, like)
                    above, below = _beside_levels(single, levels, at, like)
                    difference = least(greatest(above, below) - least(above, below), most)
                    near_one = least(near_one, difference)
                    is_one = (below > above) if inverted else (above > below)
                keep_line(lines, (APART + m) * LINE, difference)
                cell = pick(is_one, cell + line_at(lines, (WEIGHTS + bit) * LINE), cell)
            first = last
        if gray:
            keep_gray(words, (axis * OF_WORDS + CELL) * LINE, cell, cell_high)
        else:
            keep_words(words, (axis * OF_WORDS + CELL) * LINE, cell, cell_high)
    keep_line(lines, LEAST_PAIR * LINE, near_pair)
    keep_line(lines, LEAST_ONE * LINE, near_one)
    if coarse > 0:
        keep_words(sums, LIGHT * LINE, light, light_high)
        keep_words(sums, DARK * LINE, dark, dark_high)


@inlined_kernel
def any_open(all_pairs: bool, lines: NDArray[Any]) -> bool:
    """Whether any bit's images differ by too little, at any pixel of the line."""
    found = line_at(lines, LEAST_PAIR * LINE) <= line_at(lines, OF_PAIRS * LINE)
    if not all_pairs:
        found = found | (line_at(lines, LEAST_ONE * LINE) <= line_at(lines, OF_ONE * LINE))
    return count_of(found) > 0


@inlined_kernel
def find_open(
    kinds: NDArray[np.int64],
    axis: int,
    like: NDArray[Any],
    top: int,
    margins: bool,
    lines: NDArray[Any],
    words: NDArray[np.uint16],
) -> None:
    """Which of one axis's bits are open, and the least differences of the others.

    Args:
        margins: keep the least differences. The others: see `compare_images`.
    """
    bits = kinds.shape[1]
    zero, most = all_the_same(0, like), all_the_same(top, like)
    of_pairs, of_one = line_at(lines, OF_PAIRS * LINE), line_at(lines, OF_ONE * LINE)
    unsure, unsure_high = zero, zero
    near_pair, next_pair, near_one, next_one = most, most, most, most
    first = 0
    for last in (max(bits - 8 * like.itemsize, 0), bits):
        unsure_high, unsure = unsure, zero
        for bit in range(first, last):
            difference = line_at(lines, (APART + axis * bits + bit) * LINE)
            is_pair = kinds[axis, bit] == BOTH
            is_open = difference <= (of_pairs if is_pair else of_one)
            unsure = pick(is_open, unsure + line_at(lines, (WEIGHTS + bit) * LINE), unsure)
            if margins:
                margin = pick(is_open, most, difference)
                if is_pair:
                    next_pair = least(next_pair, greatest(near_pair, margin))
                    near_pair = least(near_pair, margin)
                else:
                    next_one = least(next_one, greatest(near_one, margin))
                    near_one = least(near_one, margin)
        first = last
    keep_words(words, (axis * OF_WORDS + OPEN) * LINE, unsure, unsure_high)
    if margins:
        row = NEAR + axis * OF_NEAR
        keep_line(lines, (row + NEAR_PAIR) * LINE, near_pair)
        keep_line(lines, (row + NEXT_PAIR) * LINE, next_pair)
        keep_line(lines, (row + NEAR_ONE) * LINE, near_one)
        keep_line(lines, (row + NEXT_ONE) * LINE, next_one)


@inlined_kernel
def _beside_levels(one: Line, levels: NDArray[np.intp], at: int, like: NDArray[Any]) -> tuple[Line, Line]:
    """Two lines that differ by twice an image less white and black, or by the largest sample and more if that does."""
    white, black = line_of(levels, 0, at, like), line_of(levels, 1, at, like)
    return more(less(one, black), less(one, white)), more(less(black, one), less(white, one))


@inlined_kernel
def count_decided(kinds: NDArray[np.int64], lines: NDArray[Any], decided: NDArray[np.int64]) -> None:
    """Add to decided, (A x bits + 1,), at how many bright pixels of the line each bit is decided; at last how many
    there are. Arguments: see `compare_images`."""
    of_pairs, of_one = line_at(lines, OF_PAIRS * LINE), line_at(lines, OF_ONE * LINE)
    bright, bits = line_at(lines, BRIGHT * LINE) > 0, kinds.shape[1]
    for m in range(kinds.size):
        limit = of_pairs if kinds[m // bits, m % bits] == BOTH else of_one
        decided[m] += count_of((line_at(lines, (APART + m) * LINE) > limit) & bright)
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
