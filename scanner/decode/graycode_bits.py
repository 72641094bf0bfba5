"""Bits of Gray and binary code: frames of a vector of pixels compared, to words of bits, and how near a thing it was.

Grey levels stay in their own narrow type from the first comparison on, so that as many pixels as possible share a
register. What the words mean for a pixel is judged in `graycode_kernels`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.kernel import inlined_kernel
from scanner.lanes import Lanes, any_of, as_samples, choose, floats, greatest, least, samples, whole, word

PLAIN, INVERSE, BOTH = 0, 1, 2
"""Which images of a bit there are."""


@inlined_kernel
def levels_of_pairs(addresses: NDArray[np.intp], coarse: int, at: int, like: NDArray[Any]) -> tuple[Lanes, Lanes]:
    """Mean of the brighter and of the darker of the coarse bits' images and inverses. Arguments: see `decode_codes`."""
    axes, bits = addresses.shape[0], addresses.shape[1]
    zero = as_samples(0, like)
    light, dark = whole(zero), whole(zero)
    for axis in range(axes):
        # Of one axis there are no more than sums of short numbers hold.
        brighter, darker = zero, zero
        for bit in range(coarse):
            n = (axis * bits + bit) * 2
            one, two = samples(addresses, n, at, like), samples(addresses, n + 1, at, like)
            brighter += greatest(one, two)
            darker += least(one, two)
        light += whole(brighter)
        dark += whole(darker)
    share = np.float32(1) / np.float32(axes * coarse)
    return floats(light) * share, floats(dark) * share


@inlined_kernel
def read_bits(
    addresses: NDArray[np.intp],
    kinds: NDArray[np.int64],
    levels: NDArray[np.intp],
    axis: int,
    at: int,
    like: NDArray[Any],
    of_pairs: Lanes,
    of_one: Lanes,
    top: int,
) -> tuple[Lanes, Lanes, Lanes, Lanes, Lanes, Lanes]:
    """One axis's word of bits, which of them are open, and the least and second least difference of decided bits, of
    pairs and then of single images.

    Args:
        of_pairs, of_one: what they must differ by, in whole levels. top: the largest level; of no bit. The others: see
            `decode_codes`.
    """
    bits = kinds.shape[1]
    zero, most = as_samples(0, like), as_samples(top, like)
    code, unsure = zero, zero
    near_pair, next_pair, near_one, next_one = most, most, most, most
    both = zero
    if levels[0] != 0:
        both = samples(levels, 0, at, like) + samples(levels, 1, at, like)
    for bit in range(bits):
        n = (axis * bits + bit) * 2
        code, unsure = code + code, unsure + unsure
        if kinds[axis, bit] == BOTH:
            one, two = samples(addresses, n, at, like), samples(addresses, n + 1, at, like)
            difference = greatest(one, two) - least(one, two)
            is_open = difference <= of_pairs
            margin = choose(is_open, most, difference)
            code = choose(one > two, code + 1, code)
            next_pair = least(next_pair, greatest(near_pair, margin))
            near_pair = least(near_pair, margin)
        else:
            inverted = kinds[axis, bit] == INVERSE
            one = samples(addresses, n + 1 if inverted else n, at, like)
            brighter = one + one - both
            if inverted:
                brighter = zero - brighter
            difference = least(greatest(brighter, zero - brighter), most)
            is_open = difference <= of_one
            margin = choose(is_open, most, difference)
            code = choose(brighter > 0, code + 1, code)
            next_one = least(next_one, greatest(near_one, margin))
            near_one = least(near_one, margin)
        unsure = choose(is_open, unsure + 1, unsure)
    return code, unsure, near_pair, next_pair, near_one, next_one


@inlined_kernel
def value_and_spread(code: Lanes, unsure: Lanes, gray: bool) -> tuple[Lanes, Lanes]:
    """The middle of the cells that the word names, whatever its open bits are, and from the first to the last of them.

    Any of them is as likely as the others: read as it happens to be, an open bit would name the first one or the last
    as often as those between. In cells, the middle in whole or half ones. More than two open bits give a spread beyond
    any limit.
    """
    here = _cell(code, gray)
    value, spread = floats(here), floats(np.float32(0))
    if any_of(word(unsure) > 0):
        high = unsure & (unsure - 1)
        # With the least significant open bit turned, and with the next one, too.
        low, both = _cell(code ^ (unsure ^ high), gray), _cell(code ^ unsure, gray)
        # Turning a bit of a Gray word turns all bits of the value below it: values are linear in words.
        alone = (here ^ low) ^ both
        first, last = least(least(here, low), least(both, alone)), greatest(greatest(here, low), greatest(both, alone))
        value, spread = floats(first + last) * np.float32(0.5), floats(last - first)
        spread = choose(word(high & (high - 1)) > 0, np.float32(1e6), spread)
    return value, spread


@inlined_kernel
def _cell(code: Lanes, gray: bool) -> Lanes:
    if gray:
        code = code ^ (code >> 8)
        code = code ^ (code >> 4)
        code = code ^ (code >> 2)
        code = code ^ (code >> 1)
    return word(code)
