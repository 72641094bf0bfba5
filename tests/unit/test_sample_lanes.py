"""Lines of samples in kernels against what NumPy makes of the same numbers."""

from __future__ import annotations

import numpy as np
import pytest

from scanner.kernel import kernel
from scanner.lanes import greatest, least, store
from scanner.sample_lanes import (
    LINE,
    all_the_same,
    count_of,
    expect_line,
    floats_at,
    keep_gray,
    keep_line,
    keep_words,
    less,
    line_at,
    line_of,
    more,
    pick,
)


@kernel
def calculate(addresses, like, out, twice, words, numbers):
    a, b = line_of(addresses, 0, 3, like), line_of(addresses, 1, 3, like)
    keep_line(out[0], 0, a + b)
    keep_line(out[1], 0, a - b)
    keep_line(out[2], 0, less(a, b))
    keep_line(out[3], 0, more(a, b))
    keep_line(out[4], 0, greatest(a, b) - least(a, 9))
    keep_line(out[5], 0, pick((a > b) ^ (a <= 100), a, all_the_same(7, like)))
    keep_line(out[6], 0, pick(((a < b) & (b >= 50)) | (a > 200), a | b, 0))
    keep_words(twice, 0, a, b)
    keep_words(out[7], 0, a, b)
    expect_line(addresses, 0, 3, like)
    keep_gray(words, 0, a, b)
    keep_gray(out[8], 0, a, b)
    store(numbers, 0, floats_at(out[7], LINE // 2))
    return count_of(line_at(out[0], 0) < line_at(out[7], 0))


def number_of(word):
    """Of a word of Gray code: the sum, bit by bit, of it and all that are left when it is shifted down."""
    return np.bitwise_xor.reduce([word >> shift for shift in range(32)])


@pytest.mark.parametrize(("dtype", "double"), [(np.uint8, np.uint16), (np.uint16, np.uint32)])
def test_samples_are_numbers_without_a_sign(dtype, double):
    top = np.iinfo(dtype).max
    frames = np.random.default_rng(1).integers(0, top, (2, LINE + 3), dtype, endpoint=True)
    frames[:, 3:7] = [[0, top, top, 0], [top, 0, top, 0]]
    out, numbers = np.zeros((9, LINE), dtype), np.zeros(LINE // 2, np.float32)
    twice, words = np.zeros((2, LINE), double)
    count = calculate(np.array([frame.ctypes.data for frame in frames]), frames[0, :0], out, twice, words, numbers)
    a, b = frames[:, 3:].astype(int)
    expected = [
        a + b,
        a - b,
        np.maximum(a - b, 0),
        np.minimum(a + b, top),
        np.maximum(a, b) - np.minimum(a, 9),
        np.where((a > b) ^ (a <= 100), a, 7),
        np.where((a < b) & (b >= 50) | (a > 200), a | b, 0),
        a,
        number_of(a),
    ]
    np.testing.assert_array_equal(out, np.array(expected).astype(dtype))
    np.testing.assert_array_equal(twice, a + b * (top + 1))
    np.testing.assert_array_equal(words, number_of(a + b * (top + 1)))
    np.testing.assert_array_equal(numbers, a[LINE // 2 :].astype(np.float32))
    assert count == np.count_nonzero(a + b > top)
