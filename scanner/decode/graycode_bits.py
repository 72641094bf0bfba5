"""Bits of Gray and binary code: frames of a tile compared, to words of bits, open bits, and how near a thing it was.

Grey levels stay in their own narrow type from the first comparison on, so that as many pixels as possible share a
vector register. What the words mean for a pixel is judged in `graycode_kernels`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.addresses import expect_pixels, pixels_at
from scanner.kernel import contracting_kernel

PLAIN, INVERSE, BOTH = 0, 1, 2
"""Which images of a bit there are."""


@contracting_kernel
def read_bits(
    addresses: NDArray[np.intp],
    kinds: NDArray[np.int64],
    levels: NDArray[np.intp],
    at: int,
    size: int,
    like: NDArray[Any],
    thresholds: NDArray[Any],
    limits: NDArray[np.float32],
    words: NDArray[np.uint16],
    nearest: NDArray[Any],
) -> None:
    """words[0]: the bits; words[1]: which are open. nearest: least and second least difference of decided bits, of
    pairs [0, 1] and of single images [2, 3]."""
    top = int(limits[6])
    for i in range(size):
        words[0, i] = 0
        words[1, i] = 0
        nearest[0, i] = top
        nearest[1, i] = top
        nearest[2, i] = top
        nearest[3, i] = top
    for bit in range(kinds.size):
        # What the next tile will ask for, pair by pair: all at once is more than a processor can have under way.
        for image in range(2):
            if addresses[bit, image] != 0:
                expect_pixels(addresses[bit, image], at + size, size, like)
        if kinds[bit] == BOTH:
            _read_pair(
                pixels_at(addresses[bit, 0], at, size, like), pixels_at(addresses[bit, 1], at, size, like),
                thresholds[0], top, size, words[0], words[1], nearest[0], nearest[1],
            )  # fmt: skip
        else:
            image = 0 if kinds[bit] == PLAIN else 1
            _read_single(
                pixels_at(addresses[bit, image], at, size, like), kinds[bit] == INVERSE,
                pixels_at(levels[0], at, size, like), pixels_at(levels[1], at, size, like),
                thresholds[1], top, size, words[0], words[1], nearest[2], nearest[3],
            )  # fmt: skip


@contracting_kernel
def _read_pair(
    image: NDArray[Any],
    inverse: NDArray[Any],
    threshold: NDArray[Any],
    top: int,
    size: int,
    word: NDArray[np.uint16],
    unsure: NDArray[np.uint16],
    nearest: NDArray[Any],
    second: NDArray[Any],
) -> None:
    # Every step in the samples' own type: what is widened in between shares a register with an eighth as many.
    narrow, one_bit = threshold.dtype.type, np.uint16(1)
    most = narrow(top)
    for i in range(size):
        one, two = image[i], inverse[i]
        difference = narrow(max(one, two) - min(one, two))
        decided = difference > threshold[i]
        margin = difference if decided else most
        word[i] = np.uint16(np.uint16(word[i] << one_bit) | np.uint16(one > two))
        unsure[i] = np.uint16(np.uint16(unsure[i] << one_bit) | np.uint16(difference <= threshold[i]))
        near = nearest[i]
        second[i] = min(second[i], max(near, margin))
        nearest[i] = min(near, margin)


@contracting_kernel
def _read_single(
    image: NDArray[Any],
    inverted: bool,
    white: NDArray[Any],
    black: NDArray[Any],
    threshold: NDArray[Any],
    top: int,
    size: int,
    word: NDArray[np.uint16],
    unsure: NDArray[np.uint16],
    nearest: NDArray[Any],
    second: NDArray[Any],
) -> None:
    narrow, one_bit = threshold.dtype.type, np.uint16(1)
    most, limit = narrow(top), np.int32(top)
    sign = np.int32(-1) if inverted else np.int32(1)
    for i in range(size):
        both = np.int32(np.int32(white[i]) + np.int32(black[i]))
        brighter = np.int32(sign * np.int32(np.int32(2) * np.int32(image[i]) - both))
        difference = narrow(min(np.int32(abs(brighter)), limit))
        decided = difference > threshold[i]
        margin = difference if decided else most
        word[i] = np.uint16(np.uint16(word[i] << one_bit) | np.uint16(brighter > np.int32(0)))
        unsure[i] = np.uint16(np.uint16(unsure[i] << one_bit) | np.uint16(difference <= threshold[i]))
        near = nearest[i]
        second[i] = min(second[i], max(near, margin))
        nearest[i] = min(near, margin)


@contracting_kernel
def value_and_spread(
    words: NDArray[np.uint16], gray: bool, size: int, value: NDArray[np.float32], spread: NDArray[np.float32]
) -> None:
    """The cell that the word names, and the largest distance in cells to what it means with its open bits turned.

    More than two open bits give a spread beyond any limit.
    """
    one = np.uint16(1)
    for i in range(size):
        open_bits = words[1, i]
        high = np.uint16(open_bits & np.uint16(open_bits - one))
        # words[2]: with the least significant open bit turned; [3]: with the next one, too.
        words[2, i] = words[0, i] ^ (open_bits ^ high)
        words[3, i] = words[0, i] ^ open_bits
        words[1, i] = high
    if gray:
        for w in (0, 2, 3):
            word = words[w]
            for i in range(size):
                v = word[i]
                v = np.uint16(v ^ v >> np.uint16(8))
                v = np.uint16(v ^ v >> np.uint16(4))
                v = np.uint16(v ^ v >> np.uint16(2))
                word[i] = np.uint16(v ^ v >> one)
    for i in range(size):
        here, low, both = np.int32(words[0, i]), np.int32(words[2, i]), np.int32(words[3, i])
        rest = np.int32(words[1, i])
        # Turning a bit of a Gray word turns all bits of the value below it: values are linear in words.
        alone = np.int32(here ^ low ^ both)
        widest = max(np.int32(abs(np.int32(low - here))), np.int32(abs(np.int32(both - here))))
        widest = max(widest, np.int32(abs(np.int32(alone - here))))
        few = np.int32(rest & np.int32(rest - np.int32(1))) == np.int32(0)
        value[i] = np.float32(here)
        spread[i] = np.float32(widest) if few else np.float32(1e6)
