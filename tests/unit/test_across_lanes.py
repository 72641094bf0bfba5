"""What takes all lanes of a vector together, against what NumPy makes of the same numbers."""

from __future__ import annotations

import numpy as np
import pytest

from scanner.across_lanes import bits_of, greatest_of, lowest, total_of
from scanner.kernel import kernel
from scanner.lanes import LANES, load


@kernel
def together(values, limit, found):
    lanes = load(values, 0)
    found[0], found[1], n = total_of(lanes), greatest_of(lanes), 2
    left = bits_of(lanes > limit)
    while left != 0:
        found[n] = lowest(left)
        left &= left - np.uint64(1)
        n += 1
    return n - 2


@pytest.mark.parametrize("limit", [-9.0, 0.0, 1.0, 9.0])
def test_sums_extremes_and_lanes_that_a_mask_has(limit):
    values = np.random.default_rng(3).normal(0, 1, LANES).astype(np.float32)
    found = np.zeros(LANES + 2)
    count = together(values, np.float32(limit), found)
    assert found[0] == pytest.approx(values.sum(dtype=np.float64), abs=1e-5)
    assert found[1] == values.max()
    assert list(found[2 : 2 + count]) == list(np.flatnonzero(values > limit))
