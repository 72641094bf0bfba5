"""The pass of Gray and binary decoding over pixels: all bits of all axes to positions, confidence and reason.

Frames are given by address and go through the image by vectors of pixels, as in `pmp_kernels`. Bits are compared as
whole grey levels, so that as many pixels as possible share a register; only what is left of a pixel at the end, its two
least certain bits, is weighed as probability, and only where a pixel of the vector has any to speak of. What the frames
are is decided in `scanner.decode.graycode`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.addresses import aligned_rows, copies_of, keep
from scanner.decode.graycode_bits import (
    APART,
    BOTH,
    CELL,
    NEAR,
    NEAR_ONE,
    NEAR_PAIR,
    NEXT_ONE,
    NEXT_PAIR,
    OF_NEAR,
    OF_WORDS,
    ONES,
    OPEN,
    WEIGHTS,
    any_open,
    compare_images,
    count_decided,
    find_open,
    value_and_spread,
)
from scanner.decode.graycode_light import BOTH_IMAGES, SINGLE, SURE2, find_bright, judge_light, light_and_dark
from scanner.decode.reasons import count_reasons
from scanner.kernel import contracting_kernel, inlined_kernel
from scanner.lane_memory import align_stack, stream
from scanner.lanes import (
    LANES,
    Lanes,
    any_of,
    as_samples,
    choose,
    floats,
    greatest,
    load,
    root,
    samples,
    store,
)
from scanner.sample_lanes import LINE, floats_at

STRETCH = 16384
"""Pixels whose reasons are counted together."""

_F0 = np.float32(0)
_F1 = np.float32(1)
_HALF = np.float32(0.5)
_GOLDEN = 2654435769
_WORD = 0xFFFFFFFF
"""2^32 over the golden ratio; its multiples without what is beyond 32 bits lie evenly spread among these."""
_NAN = np.float32(np.nan)
_ROOT12 = np.float32(12**0.5)

# erfc(x) = 1 / (1 + a1 x + ... + a6 x^6)^16, error below 3e-7 (Abramowitz and Stegun 1964, 7.1.28); x = z / sqrt(2).
_S1 = np.float32(0.0705230784 / 2**0.5)
_S2 = np.float32(0.0422820123 / 2)
_S3 = np.float32(0.0092705272 / 2**1.5)
_S4 = np.float32(0.0001520143 / 4)
_S5 = np.float32(0.0002765672 / 2**2.5)
_S6 = np.float32(0.0000430638 / 8)


@contracting_kernel
def decode_codes(
    addresses: NDArray[np.intp],
    kinds: NDArray[np.int64],
    levels: NDArray[np.intp],
    like: NDArray[Any],
    twice: NDArray[Any],
    coarse: int,
    clip: int,
    gray: bool,
    shift: int,
    sizes: NDArray[np.int64],
    noise: NDArray[np.float32],
    limits: NDArray[np.float32],
    ends: NDArray[np.float32],
    brief: bool,
    share: int,
    maps: NDArray[np.float32],
    reason: NDArray[np.uint8],
    marked: NDArray[np.uint8],
    begin: int,
    end: int,
    counts: NDArray[np.int64],
    decided: NDArray[np.int64],
) -> None:
    """Decode pixels begin .. end - 1; begin is a multiple of LINE.

    Args:
        addresses: (A, bits, 2) of each axis's images and their inverses, most significant bit first; 0 where `kinds`
            says that there is none. kinds: (A, bits) PLAIN, INVERSE or BOTH. levels: (2,) of white and black, or zeros.
        like: (0,) array of the frames' dtype, uint8 or uint16. twice: (0,) of unsigned numbers of twice as many bits.
        coarse: bits of each axis whose pairs stand in for white and black where there are none.
        clip: grey level from which a sample counts as saturated.
        gray: Gray code, else binary. shift: code bits that were not projected. sizes: (A,) projector pixels an axis.
        noise: [variance at level 0, variance per level, least variance, factor].
        limits: [contrast in levels, contrast in sigmas squared, decisive share of the contrast, decisive sigmas
            squared, wrong-bit probability, cells from the first to the last that open bits leave, largest grey level].
        ends: (A, 2) cells, below and above which a pixel has its line marked.
        brief: write positions, confidence and reason alone.
        share: of all lines of pixels times 2^32, those whose decided bits are counted.
        maps: (2 A + 3, P + up to LINE) float32 whose rows begin with a cache line; positions, sigmas, confidence,
            albedo, modulation. reason: (P + up to LINE,) uint8. Both are written up to a multiple of LINE.
        marked: (A, P / LINE, rounded up) uint8, set to 1 where any pixel of a line is outside `ends`.
        counts: (9,) int64, how many pixels have each reason, is added to. decided: see `count_decided`.
    """
    align_stack()
    table, flat, stride, axes = addresses.reshape(-1), maps.reshape(-1), maps.shape[1], kinds.shape[0]
    spot = aligned_rows(2 * axes, LANES).reshape(-1)
    lines = aligned_rows(APART + kinds.size, LINE).reshape(-1).view(like.dtype)
    sums, words = aligned_rows(2, LINE).reshape(-1).view(twice.dtype), np.empty(axes * OF_WORDS * LINE, np.uint16)
    lines[:] = 0
    lines[ONES * LINE : (ONES + 1) * LINE] = 1
    for bit in range(kinds.shape[1]):
        weight = 1 << ((kinds.shape[1] - 1 - bit) % (8 * like.itemsize))
        lines[(WEIGHTS + bit) * LINE : (WEIGHTS + bit + 1) * LINE] = weight
    near = np.array([lines.ctypes.data, words.ctypes.data, reason.ctypes.data])
    pairs = np.zeros(axes + 1, np.int64)
    for axis in range(axes):
        for bit in range(kinds.shape[1]):
            pairs[axis] += 1 if kinds[axis, bit] == BOTH else 0
        pairs[axes] += pairs[axis]
    solid = end // LINE * LINE
    for first in range(begin, solid, STRETCH):
        last = min(first + STRETCH, solid)
        for at in range(first, last, LINE):
            _decode_line(
                addresses, kinds, pairs, levels, like, coarse, clip, gray, shift, sizes, noise, limits, ends, brief,
                share, at, stride, spot, lines, sums, words, near, flat, reason, marked, decided,
            )  # fmt: skip
        count_reasons(reason[first:last], counts)
    if solid < end:
        # What is left goes into lines of its own: nothing may be read beyond a frame's last pixel.
        spare, spare_levels = np.zeros((table.size, LINE), like.dtype), np.zeros((2, LINE), like.dtype)
        copies = copies_of(table, solid, end - solid, like, spare)
        of_levels = copies_of(levels, solid, end - solid, like, spare_levels)
        _decode_line(
            copies.reshape(addresses.shape), kinds, pairs, of_levels, like, coarse, clip, gray, shift, sizes, noise,
            limits, ends, brief, share, solid, stride, spot, lines, sums, words, near, flat, reason, marked, decided,
        )  # fmt: skip
        keep(spare)
        keep(spare_levels)
        count_reasons(reason[solid:end], counts)
    # Mentioned once more: see `copies_of`.
    lines[0], words[0] = 0, 0


@inlined_kernel
def _decode_line(
    addresses: NDArray[np.intp],
    kinds: NDArray[np.int64],
    pairs: NDArray[np.int64],
    levels: NDArray[np.intp],
    like: NDArray[Any],
    coarse: int,
    clip: int,
    gray: bool,
    shift: int,
    sizes: NDArray[np.int64],
    noise: NDArray[np.float32],
    limits: NDArray[np.float32],
    ends: NDArray[np.float32],
    brief: bool,
    share: int,
    at: int,
    stride: int,
    spot: NDArray[np.float32],
    lines: NDArray[Any],
    sums: NDArray[Any],
    words: NDArray[np.uint16],
    near: NDArray[np.intp],
    maps: NDArray[np.float32],
    reason: NDArray[np.uint8],
    marked: NDArray[np.uint8],
    decided: NDArray[np.int64],
) -> None:
    """Decode LINE pixels from `at` on.

    Args:
        pairs: (A + 1,) how many bits of each axis, and of all, have both images.
        maps: flat, rows of `stride`. spot: (2 A x LANES,), to work in. lines, sums, words: rows to work in; see
            `graycode_bits`. near: (3,) where lines, words and reason lie.
    """
    axes, bits, top = kinds.shape[0], kinds.shape[1], int(limits[6])
    has_pairs, has_single = bool(pairs[axes] > 0), bool(pairs[axes] < axes * bits)
    summed = 0 if levels[0] != 0 else coarse
    # Whether all are pairs is known when each of these is compiled.
    if has_single:
        compare_images(addresses, kinds, levels, summed, at, like, top, gray, False, lines, sums, words)
    else:
        compare_images(addresses, kinds, levels, summed, at, like, top, gray, True, lines, sums, words)
    margins = False
    for half in range(0, LINE, LANES):
        margins |= judge_light(
            has_pairs, has_single, levels, like, axes * coarse, clip, noise, limits, at, half, lines, sums, reason
        )
    opened = any_open(not has_single, lines)
    if margins or opened:
        for axis in range(axes):
            find_open(kinds, axis, like, top, margins, lines, words)
    # Places that fall into no step with the image's width.
    if at // LINE * _GOLDEN & _WORD < share:
        for half in range(0, LINE, LANES):
            find_bright(has_single, levels, like, axes * coarse, noise, limits, at, half, lines, sums)
        count_decided(kinds, lines, decided)
    for half in range(0, LINE, LANES):
        if margins or opened:
            _judge_words(
                kinds, pairs, levels, like, axes * coarse, gray, shift, sizes, noise, limits, ends, brief, margins,
                True, at, half, stride, spot, lines, sums, words, near, maps, reason, marked,
            )  # fmt: skip
        else:
            _judge_words(
                kinds, pairs, levels, like, axes * coarse, gray, shift, sizes, noise, limits, ends, brief, margins,
                False, at, half, stride, spot, lines, sums, words, near, maps, reason, marked,
            )  # fmt: skip


@inlined_kernel
def _judge_words(
    kinds: NDArray[np.int64],
    pairs: NDArray[np.int64],
    levels: NDArray[np.intp],
    like: NDArray[Any],
    summed: int,
    gray: bool,
    shift: int,
    sizes: NDArray[np.int64],
    noise: NDArray[np.float32],
    limits: NDArray[np.float32],
    ends: NDArray[np.float32],
    brief: bool,
    margins: bool,
    unsure: bool,
    at: int,
    half: int,
    stride: int,
    spot: NDArray[np.float32],
    lines: NDArray[Any],
    sums: NDArray[Any],
    words: NDArray[np.uint16],
    near: NDArray[np.intp],
    maps: NDArray[np.float32],
    reason: NDArray[np.uint8],
    marked: NDArray[np.uint8],
) -> None:
    """Positions of LANES pixels from the bits that were read. unsure: some of them are open, or near the limit."""
    axes, bits = kinds.shape
    step, top = np.float32(1 << shift), limits[6]
    variance, contrast, middle = floats(_F0), floats(_F0), floats(_F0)
    if (unsure and margins) or not brief:
        light, dark = light_and_dark(levels, like, summed, at, half, sums)
        contrast, middle = light - dark, _HALF * (light + dark)
        variance = noise[3] * greatest(noise[0] + noise[1] * middle, noise[2])
    why, kept = samples(near, 2, at + half, reason), floats(_F1)
    for axis in range(axes):
        place = axis * OF_WORDS * LINE + half
        if unsure:
            value, spread = value_and_spread(
                samples(near, 1, place + CELL * LINE, words), samples(near, 1, place + OPEN * LINE, words), gray
            )
            wrong = floats(_F0)
            if margins:
                first = (NEAR + axis * OF_NEAR) * LINE + half
                if pairs[axis] > 0:
                    least_pair, next_pair = (
                        floats_at(lines, first + NEAR_PAIR * LINE),
                        floats_at(lines, first + NEXT_PAIR * LINE),
                    )
                    wrong += _doubt(least_pair, next_pair, pairs[axis], BOTH_IMAGES * variance, top)
                if pairs[axis] < bits:
                    least_one, next_one = (
                        floats_at(lines, first + NEAR_ONE * LINE),
                        floats_at(lines, first + NEXT_ONE * LINE),
                    )
                    wrong += _doubt(least_one, next_one, bits - pairs[axis], SINGLE * variance, top)
            # Open bits do no harm where all they could mean names cells close by: a border of cells, or blur.
            odds = choose(spread <= limits[5], wrong, _F1)
            kept *= greatest(_F1 - odds, _F0)
            why = choose(why > 0, why, choose(odds > limits[4], as_samples(4, reason), 0))
            if not brief:
                store(spot, (axes + axis) * LANES, (spread + _F1) * (step / _ROOT12))
        else:
            value = floats_at(words, place + CELL * LINE)
        if any_of((value < ends[axis, 0]) | (value > ends[axis, 1])):
            marked[axis, at // LINE] = 1
            why = choose(why > 0, why, choose(value * step >= np.float32(sizes[axis]), as_samples(5, reason), 0))
        store(spot, axis * LANES, (value + _HALF) * step - _HALF)
    good, place = why < 1, at + half
    for row in range(axes):
        stream(maps, row * stride + place, choose(good, load(spot, row * LANES), _NAN))
    stream(maps, 2 * axes * stride + place, choose(good, kept, _F0))
    if not brief:
        for row in range(axes, 2 * axes):
            sigma = load(spot, row * LANES) if unsure else floats(step / _ROOT12)
            stream(maps, row * stride + place, choose(good, sigma, _NAN))
        stream(maps, (2 * axes + 1) * stride + place, middle)
        stream(maps, (2 * axes + 2) * stride + place, _HALF * contrast)
    store(reason, place, why)


@inlined_kernel
def _doubt(near: Lanes, after: Lanes, count: int, variance: Lanes, top: np.float32) -> Lanes:
    """Probability that one of `count` decided bits is wrong: the least certain, and all others as the next."""
    first, second, wrong = floats(near), floats(after), floats(_F0)
    if any_of((first < top) & (first * first < SURE2 * variance)):
        scale = _F1 / root(variance)
        wrong = choose(first < top, _tail(first * scale), _F0)
        wrong += np.float32(count - 1) * choose(second < top, _tail(second * scale), _F0)
    return wrong


@inlined_kernel
def _tail(z: Lanes) -> Lanes:
    # Probability that a normal variable of mean z and sigma 1 is negative.
    s = _F1 + z * (_S1 + z * (_S2 + z * (_S3 + z * (_S4 + z * (_S5 + z * _S6)))))
    s = s * s
    s = s * s
    s = s * s
    return _HALF / (s * s)
