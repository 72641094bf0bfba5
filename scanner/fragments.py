"""Small pieces of a map: connected regions of fewer pixels than a limit, found by their runs along lines.

A run is as many pixels side by side as there are; runs that touch between two lines belong together, and a forest of
them (Galler and Fischer 1964) knows which. Images have hundreds of times fewer runs than pixels, unless they are noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.kernel import kernel

Mask = NDArray[np.bool_]
Numbers = NDArray[np.int32]


def small_fragments(there: Mask, min_pixels: int) -> tuple[Mask, int]:
    """Pixels in regions of `there` (4 neighbours) that are smaller than `min_pixels`.

    Args:
        there: (H, W) bool.

    Returns:
        (H, W) bool, and how many they are.
    """
    solid = np.ascontiguousarray(there).view(np.uint8)
    runs = np.empty((_count_runs(solid), 3), np.int32)
    small = np.zeros(there.shape, np.bool_)
    return small, _mark_small(solid, runs, min_pixels, small)


def warm_up() -> None:
    """Compile the kernels."""
    small_fragments(np.ones((2, 2), np.bool_), 2)


@kernel
def _count_runs(there: NDArray[np.uint8]) -> int:
    count = 0
    for i in range(there.shape[0]):
        line = there[i]
        begins = np.int32(line[0]) if line.size else np.int32(0)
        for j in range(1, line.size):
            begins += np.int32(line[j] > line[j - 1])
        count += int(begins)
    return count


@kernel
def _mark_small(there: NDArray[np.uint8], runs: Numbers, min_pixels: int, small: Mask) -> int:
    """Args: runs: (N, 3) int32, written: first column, column behind the last, line."""
    parents, sizes = np.empty(len(runs), np.int32), np.empty(len(runs), np.int32)
    count, above = 0, 0
    for i in range(there.shape[0]):
        first = count
        count = _runs_of_line(there[i], i, runs, count)
        other = above
        for n in range(first, count):
            begin, end = runs[n, 0], runs[n, 1]
            parents[n], sizes[n] = n, end - begin
            # Runs of the line above that end before this one begins touch none of those that follow, either.
            while other < first and runs[other, 1] <= begin:
                other += 1
            touching = other
            while touching < first and runs[touching, 0] < end:
                _join(parents, sizes, n, touching)
                touching += 1
        above = first
    marked = 0
    for n in range(count):
        if sizes[_find(parents, n)] < min_pixels:
            marked += runs[n, 1] - runs[n, 0]
            for j in range(runs[n, 0], runs[n, 1]):
                small[runs[n, 2], j] = True
    return marked


@kernel
def _runs_of_line(line: NDArray[np.uint8], i: int, runs: Numbers, count: int) -> int:
    before = np.uint8(0)
    for j in range(line.size):
        if line[j] != before:
            before = line[j]
            if before:
                runs[count, 0], runs[count, 2] = j, i
            else:
                runs[count, 1] = j
                count += 1
    if before:
        runs[count, 1] = line.size
        count += 1
    return count


@kernel
def _find(parents: Numbers, n: int) -> int:
    while parents[n] != n:
        parents[n] = parents[parents[n]]
        n = parents[n]
    return n


@kernel
def _join(parents: Numbers, sizes: Numbers, one: int, other: int) -> None:
    a, b = _find(parents, one), _find(parents, other)
    if a != b:
        # The smaller goes below the larger: no path grows long.
        if sizes[a] < sizes[b]:
            a, b = b, a
        parents[b] = a
        sizes[a] += sizes[b]
