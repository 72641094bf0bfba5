"""Vectors of pixels in kernels against what NumPy makes of the same numbers."""

from __future__ import annotations

import numpy as np
import pytest

from scanner.kernel import kernel
from scanner.lanes import (
    LANES,
    all_of,
    any_of,
    choose,
    expect,
    floats,
    greatest,
    least,
    load,
    magnitude,
    multiply_add,
    nearest,
    power_of_two,
    root,
    samples,
    store,
    whole,
    with_sign,
)

F = np.float32


@kernel
def calculate(a, b, out):
    x, y = load(a, 0), load(b, 0)
    store(out[0], 0, x + y * F(2) - F(1) / x)
    store(out[1], 0, least(x, y))
    store(out[2], 0, greatest(x, F(0.5)))
    store(out[3], 0, root(magnitude(x)))
    store(out[4], 0, nearest(x * F(10)))
    store(out[5], 0, choose((x > y) | ((x <= F(-1)) & (y >= F(0))), x, F(7)))
    store(out[6], 0, with_sign(x, y))
    store(out[7], 0, power_of_two(whole(x * F(20))))
    store(out[8], 0, multiply_add(x, F(3), y))
    total = floats(F(1))
    total += x
    total -= y
    total *= x
    store(out[9], 0, total)
    return any_of(x < F(-100)), any_of(x < F(0)), all_of(x < F(0)), all_of(x < F(100))


def test_floats_are_what_numpy_has():
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, LANES)).astype(F)
    out = np.zeros((10, LANES), F)
    assert calculate(x, y, out) == (False, True, False, True)
    expected = [
        x + y * 2 - 1 / x,
        np.minimum(x, y),
        np.maximum(x, F(0.5)),
        np.sqrt(np.abs(x)),
        np.rint(x * 10),
        np.where((x > y) | ((x <= -1) & (y >= 0)), x, 7),
        np.copysign(x, y),
        2.0 ** np.trunc(x * 20),
        x * 3 + y,
        (1 + x - y) * x,
    ]
    np.testing.assert_allclose(out, np.array(expected, F), rtol=1e-5, atol=1e-6)


@kernel
def grey_levels(addresses, like, out, codes):
    expect(addresses, 0, 10**9, like)
    one, two = samples(addresses, 0, 3, like), samples(addresses, 1, 3, like)
    store(out[0], 0, floats(one - two))
    store(out[1], 0, floats(greatest(one, two) + least(one, 9)))
    store(codes, 0, choose(one < two, one, 255))
    store(out[2], 0, floats(whole(one) * 300 - whole(two) * 300))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_samples_are_whole_numbers_from_any_pixel_on(dtype):
    rng = np.random.default_rng(1)
    frames = rng.integers(0, np.iinfo(dtype).max, (2, LANES + 3), dtype, endpoint=True)
    out, codes = np.zeros((3, LANES), F), np.zeros(LANES, np.uint8)
    grey_levels(np.array([frame.ctypes.data for frame in frames]), frames[0, :0], out, codes)
    one, two = frames[:, 3:].astype(int)
    np.testing.assert_array_equal(out, [one - two, np.maximum(one, two) + np.minimum(one, 9), 300 * (one - two)])
    np.testing.assert_array_equal(codes, np.where(one < two, one, 255).astype(np.uint8))
