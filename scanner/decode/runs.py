"""Which pixels stand for a whole image: runs of neighbours spread over it, so that little of each frame is read."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

RUN = 64
"""Pixels side by side: a cache line of an 8-bit frame."""

_GOLDEN = (5**0.5 - 1) / 2


def runs_of(pixels: int, size: int) -> tuple[NDArray[np.intp], int]:
    """Some `size` of `pixels`, counted row by row: (R,) first pixels of runs, and how long each run is.

    One run lies in each of R equal parts of the image, at places that fall into no step with its width; a small image
    is taken whole.
    """
    return spread_runs(pixels, size, RUN)


@lru_cache(maxsize=16)
def spread_runs(pixels: int, size: int, run: int) -> tuple[NDArray[np.intp], int]:
    """The same with runs of another length: short ones are many, and see more phases of fringes that run along rows.

    The same array each time: not to be written into.
    """
    length = min(run, pixels)
    if size * 2 >= pixels:
        return np.arange(0, pixels - length + 1, length, dtype=np.intp), length
    count = size // length
    within = np.arange(count) * _GOLDEN % 1
    return ((np.arange(count) + within) * ((pixels - length) / count)).astype(np.intp), length
