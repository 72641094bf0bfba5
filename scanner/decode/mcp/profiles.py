"""Profiles across a stripe, averaged along it, and the sums over them that the sub-pixel fit needs.

The sums are the normal equations of the fit in `subpixel`, two unknowns (Lucas and Kanade 1981 for the shift; the slope
is ours). The slope is shrunk by signal over signal and noise, Wiener's gain (1949), its noise from its scatter along
the stripe.
A run of one stripe's peaks is worked on in lanes, its places side by side: rows of `stride` numbers, the first place at
PAD, and what lies beyond a run's ends is nothing. What the sums mean stands in `subpixel`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.kernel import kernel
from scanner.lanes import LANES, Lanes, choose, floats, greatest, least, load, multiply_add, store

Array = NDArray[np.float32]

HALF_COLUMNS = 3
"""Columns (of four pixels) averaged to either side: 28 px in all, a carrier's period or two."""

SLOPE_COLUMNS = 14
"""Columns over which the slope of brightness is averaged to either side: shading changes slower than position."""

PAD = 16
"""Places before the first: as many as the wider window reaches."""

SUMS = 6
"""Over the window: shift x shift, shift x slope, slope x slope, odd x shift, odd x slope, odd x odd."""

EVERYWHERE = np.float32(1e6)
"""Samples that nothing limits."""


@kernel
def stride_of(longest: int) -> int:
    """Numbers to a row for runs of so many places."""
    return 2 * PAD + (longest + LANES - 1) // LANES * LANES


@kernel
def straighten(
    reduced: Array, b: int, centre: np.float32, ground: np.float32, p: int, stride: int, samples: int, profile: Array
) -> None:
    """Place p's samples of `profile`: column b above `ground` about `centre`, linear between pixels."""
    size = reduced.shape[1]
    base = int(np.floor(centre))
    f = centre - base
    begin = base - samples // 2
    inside = begin >= 0 and begin + samples < size
    for u in range(samples):
        a = begin + u if inside else min(max(begin + u, 0), size - 2)
        profile[u * stride + PAD + p] = reduced[b, a] + (reduced[b, a + 1] - reduced[b, a]) * f - ground


@kernel
def _nothing_beyond(row: Array, begin: int, count: int, value: np.float32) -> None:
    """Set what lies before and behind the places of the row that begins there."""
    for p in range(PAD):
        row[begin + p] = value
        row[begin + PAD + count + p] = value


@kernel
def add_up(
    profile: Array, usable: Array, bend: Array, count: int, stride: int, reach: int, used: Array, sums: Array
) -> None:
    """Average the profiles about each place, and sum the products of the mean's parts.

    The odd part of a mean profile, less what the bend of the surface makes of it, is explained by a shift (the even
    part's derivative) and a slope of brightness (the even part times the distance).

    Args:
        profile: (2 reach + 1) rows.
        usable: one row: samples to either side that a place's own profile may be looked at.
        bend: one row: change of the pitch, 1 / px.
        count: places of the run.
        stride, reach: of rows; samples to either side.
        used: one row, filled: samples that the window's profiles all have.
        sums: SUMS rows, filled.
    """
    samples = 2 * reach + 1
    mean = np.empty(samples * LANES, np.float32)
    share = np.empty(LANES, np.float32)
    for u in range(samples):
        _nothing_beyond(profile, u * stride, count, np.float32(0))
    _nothing_beyond(usable, 0, count, EVERYWHERE)
    for p in range(0, count, LANES):
        at = PAD + p
        for i in range(LANES):
            share[i] = np.float32(1) / np.float32(_members(p + i, count, HALF_COLUMNS))
        part = load(share, 0)
        for u in range(samples):
            row = u * stride + at
            total = load(profile, row)
            for d in range(1, HALF_COLUMNS + 1):
                total = total + (load(profile, row - d) + load(profile, row + d))
            store(mean, u * LANES, total * part)
        limit = load(usable, at)
        for d in range(1, HALF_COLUMNS + 1):
            limit = least(limit, least(load(usable, at - d), load(usable, at + d)))
        store(used, at, limit)
        _products(mean, reach, limit, load(bend, at), at, stride, sums)


@kernel
def _products(mean: Array, reach: int, limit: Lanes, bend: Lanes, at: int, stride: int, sums: Array) -> None:
    """The sums of the places from `at` on."""
    nothing = floats(np.float32(0))
    ss, sv, vv, os, ov, oo = nothing, nothing, nothing, nothing, nothing, nothing
    for u in range(1, reach):
        distance = np.float32(u)
        right, left = load(mean, (reach + u) * LANES), load(mean, (reach - u) * LANES)
        inner = load(mean, (reach + u - 1) * LANES) + load(mean, (reach - u + 1) * LANES)
        outer = load(mean, (reach + u + 1) * LANES) + load(mean, (reach - u - 1) * LANES)
        inside = limit > distance
        shift = choose(inside, (inner - outer) * np.float32(0.25), np.float32(0))
        slope = choose(inside, (right + left) * (np.float32(0.5) * distance), np.float32(0))
        odd = choose(inside, (right - left) * np.float32(0.5) - bend * (distance * distance) * shift, np.float32(0))
        ss, sv, vv = multiply_add(shift, shift, ss), multiply_add(shift, slope, sv), multiply_add(slope, slope, vv)
        os, ov, oo = multiply_add(odd, shift, os), multiply_add(odd, slope, ov), multiply_add(odd, odd, oo)
    store(sums, at, ss)
    store(sums, at + stride, sv)
    store(sums, at + 2 * stride, vv)
    store(sums, at + 3 * stride, os)
    store(sums, at + 4 * stride, ov)
    store(sums, at + 5 * stride, oo)


@kernel
def _members(p: int, count: int, half: int) -> int:
    """Places of a window about place p that the run has; 1 beyond its end."""
    return max(min(p, half) + min(count - 1 - p, half) + 1, 1)


@kernel
def slopes(sums: Array, used: Array, count: int, stride: int, kappa: Array, worth: Array, slope: Array) -> None:
    """The slope of brightness about each place, shrunk by its own significance (Wiener 1949).

    Args:
        sums, used, count, stride: of `add_up`.
        kappa, worth: one row each, for the slopes place by place and their weights.
        slope: one row, filled.
    """
    independent = np.empty(LANES, np.float32)
    for p in range(0, count, LANES):
        at = PAD + p
        ss, sv, vv = load(sums, at), load(sums, at + stride), load(sums, at + 2 * stride)
        os, ov = load(sums, at + 3 * stride), load(sums, at + 4 * stride)
        determinant = ss * vv - sv * sv
        apart = (load(used, at) >= np.float32(4)) & (determinant > ss * vv * np.float32(1e-4))
        store(kappa, at, choose(apart, (ss * ov - sv * os) / determinant, np.float32(0)))
        store(worth, at, choose(apart, determinant / ss, np.float32(0)))
    _nothing_beyond(kappa, 0, count, np.float32(0))
    _nothing_beyond(worth, 0, count, np.float32(0))
    for p in range(0, count, LANES):
        at = PAD + p
        for i in range(LANES):
            members = _members(p + i, count, SLOPE_COLUMNS)
            # The scatter along the stripe says how sure it is; windows of 7 columns overlap.
            independent[i] = max(np.float32(1), np.float32(members) / np.float32(2 * HALF_COLUMNS + 1))
        total, weight, square = floats(np.float32(0)), floats(np.float32(0)), floats(np.float32(0))
        for d in range(-SLOPE_COLUMNS, SLOPE_COLUMNS + 1):
            k, w = load(kappa, at + d), load(worth, at + d)
            product = w * k
            total, weight, square = total + product, weight + w, multiply_add(product, k, square)
        mean = total / weight
        scatter = greatest(square / weight - mean * mean, np.float32(0))
        squared = mean * mean
        doubt = scatter / load(independent, 0) + np.float32(1e-12)
        store(slope, at, choose(weight > np.float32(0), mean * (squared / (squared + doubt)), np.float32(0)))
