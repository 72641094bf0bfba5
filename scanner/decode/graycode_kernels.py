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

from scanner.decode.addresses import CACHE_LINE, aligned_rows, copies_of, keep, pixels_at
from scanner.decode.graycode_bits import BOTH, levels_of_pairs, read_bits, value_and_spread
from scanner.decode.reasons import count_reasons
from scanner.kernel import contracting_kernel, inlined_kernel
from scanner.lane_memory import stream
from scanner.lanes import (
    LANES,
    Lanes,
    any_of,
    as_samples,
    choose,
    expect,
    floats,
    greatest,
    least,
    load,
    root,
    samples,
    store,
)

AHEAD = 512
"""Pixels between the one that is worked on and the one that is asked for."""

STRETCH = 16384
"""Pixels whose reasons are counted together."""

BOTH_VARIANCE, SINGLE_VARIANCE = 2.0, 6.0
"""Variance of an image less its inverse, and of twice an image less white and black, in units of one sample's."""

_F0 = np.float32(0)
_F1 = np.float32(1)
_HALF = np.float32(0.5)
_NAN = np.float32(np.nan)
_BOTH = np.float32(BOTH_VARIANCE)
_SINGLE = np.float32(SINGLE_VARIANCE)
_ROOT12 = np.float32(12**0.5)

_SURE2 = np.float32(6**2)
"""Square of the sigmas from which a bit is certain: 1e-9 of being wrong, times sixteen bits, is nothing beside 1 in
float32."""

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
    coarse: int,
    clip: int,
    gray: bool,
    shift: int,
    sizes: NDArray[np.int64],
    noise: NDArray[np.float32],
    limits: NDArray[np.float32],
    begin: int,
    end: int,
    brief: bool,
    maps: NDArray[np.float32],
    reason: NDArray[np.uint8],
    counts: NDArray[np.int64],
) -> None:
    """Decode pixels begin .. end - 1; begin is a multiple of LANES.

    Args:
        addresses: (A, bits, 2) of each axis's images and their inverses, most significant bit first; 0 where `kinds`
            says that there is none. kinds: (A, bits) PLAIN, INVERSE or BOTH. levels: (2,) of white and black, or zeros.
        like: (0,) array of the frames' dtype, uint8 or uint16.
        coarse: bits of each axis whose pairs stand in for white and black where there are none.
        clip: grey level from which a sample counts as saturated.
        gray: Gray code, else binary. shift: code bits that were not projected. sizes: (A,) projector pixels an axis.
        noise: [variance at level 0, variance per level, least variance, factor].
        limits: [contrast in levels, contrast in sigmas squared, decisive share of the contrast, decisive sigmas
            squared, wrong-bit probability, cells from the first to the last that open bits leave, largest grey level].
        brief: write positions, confidence and reason alone.
        maps: (2 A + 3, P + up to LANES) float32 whose rows begin with a cache line; positions, sigmas, confidence,
            albedo, modulation. reason: (P + up to LANES,) uint8. Both are written up to a multiple of LANES.
        counts: (9,) int64, how many pixels have each reason, is added to.
    """
    table, flat, stride = addresses.reshape(-1), maps.reshape(-1), maps.shape[1]
    spot = aligned_rows(2 * kinds.shape[0], LANES).reshape(-1)
    pairs = np.zeros(kinds.shape[0], np.int64)
    for axis in range(kinds.shape[0]):
        for bit in range(kinds.shape[1]):
            pairs[axis] += 1 if kinds[axis, bit] == BOTH else 0
    line, solid = CACHE_LINE // like.itemsize, end // LANES * LANES
    for at in range(begin, solid, LANES):
        if at % line == 0:
            for n in range(table.size):
                # One that is not there has address 0, and asking for it does no harm.
                expect(table, n, at + AHEAD, like)
        _decode_lanes(
            addresses, kinds, pairs, levels, like, coarse, clip, gray, shift, sizes, noise, limits, brief,
            at, stride, spot, flat, reason,
        )  # fmt: skip
    if solid < end:
        # What is left goes into vectors of its own: nothing may be read beyond a frame's last pixel.
        spare, spare_levels = np.zeros((table.size, LANES), like.dtype), np.zeros((2, LANES), like.dtype)
        near = copies_of(table, solid, end - solid, like, spare)
        of_levels = copies_of(levels, solid, end - solid, like, spare_levels)
        _decode_lanes(
            near.reshape(addresses.shape), kinds, pairs, of_levels, like, coarse, clip, gray, shift, sizes, noise,
            limits, brief, solid, stride, spot, flat, reason,
        )  # fmt: skip
        keep(spare)
        keep(spare_levels)
    for at in range(begin, end, STRETCH):
        count_reasons(reason[at : min(at + STRETCH, end)], counts)


@inlined_kernel
def _decode_lanes(
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
    brief: bool,
    at: int,
    stride: int,
    spot: NDArray[np.float32],
    maps: NDArray[np.float32],
    reason: NDArray[np.uint8],
) -> None:
    """Decode LANES pixels from `at` on. maps: flat, rows of `stride`. spot: (2 A x LANES,), to work in."""
    axes, bits = kinds.shape
    v0, slope, least_variance, factor = noise[0], noise[1], noise[2], noise[3]
    top, step = limits[6], np.float32(1 << shift)
    if levels[0] != 0:
        light, dark = floats(samples(levels, 0, at, like)), floats(samples(levels, 1, at, like))
    else:
        light, dark = levels_of_pairs(addresses, coarse, at, like)
    contrast, middle = light - dark, _HALF * (light + dark)
    variance = factor * greatest(v0 + slope * middle, least_variance)
    enough = (contrast > limits[0]) & (contrast * contrast > limits[1] * variance)
    late = _F0 if levels[0] != 0 else _HALF
    why = choose(dark >= np.float32(clip) - late, 2, choose(enough, 0, 1))
    # |d| > t for whole |d| is |d| > floor(t).
    share = greatest(limits[2] * contrast, _F0)
    of_pairs = as_samples(least(greatest(share, root(limits[3] * _BOTH * variance)), top), like)
    of_one = as_samples(least(greatest(share, root(limits[3] * _SINGLE * variance)), top), like)
    kept = floats(_F1)
    for axis in range(axes):
        code, unsure, near_pair, next_pair, near_one, next_one = read_bits(
            addresses, kinds, levels, axis, at, like, of_pairs, of_one, int(top)
        )
        value, spread = value_and_spread(code, unsure, gray)
        wrong = floats(_F0)
        if pairs[axis] > 0:
            wrong += _doubt(near_pair, next_pair, pairs[axis], _BOTH * variance, top)
        if pairs[axis] < bits:
            wrong += _doubt(near_one, next_one, bits - pairs[axis], _SINGLE * variance, top)
        # Open bits do no harm where all they could mean names cells close by: a border of cells, or blur.
        odds = choose(spread <= limits[5], wrong, _F1)
        kept *= greatest(_F1 - odds, _F0)
        of_axis = choose(odds > limits[4], 4, choose(value * step >= np.float32(sizes[axis]), 5, 0))
        why = choose(why > 0, why, of_axis)
        store(spot, axis * LANES, (value + _HALF) * step - _HALF)
        store(spot, (axes + axis) * LANES, (spread + _F1) * (step / _ROOT12))
    good = why < 1
    for row in range(axes if brief else 2 * axes):
        stream(maps, row * stride + at, choose(good, load(spot, row * LANES), _NAN))
    stream(maps, 2 * axes * stride + at, choose(good, kept, _F0))
    if not brief:
        stream(maps, (2 * axes + 1) * stride + at, middle)
        stream(maps, (2 * axes + 2) * stride + at, _HALF * contrast)
    store(reason, at, why)


@inlined_kernel
def _doubt(near: Lanes, after: Lanes, count: int, variance: Lanes, top: np.float32) -> Lanes:
    """Probability that one of `count` decided bits is wrong: the least certain, and all others as the next."""
    first, second, wrong = floats(near), floats(after), floats(_F0)
    if any_of((first < top) & (first * first < _SURE2 * variance)):
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


@contracting_kernel
def gather(
    addresses: NDArray[np.intp], like: NDArray[Any], starts: NDArray[np.intp], length: int, out: NDArray[Any]
) -> None:
    """Copy runs of `length` pixels from `starts` on of frames into out: (F, R x length) of the frames' dtype."""
    for f in range(addresses.size):
        for r in range(starts.size):
            run = pixels_at(addresses[f], starts[r], length, like)
            for i in range(length):
                out[f, r * length + i] = run[i]
