"""Strips of an image shared among threads. The kernels that work on them leave the interpreter lock alone."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

import numba

STRIPS = 6
"""Strips of the image for each thread: few enough to cost nothing, enough to even out a thread that is held up."""

MAX_THREADS = 4
"""More do not read memory faster."""

MIN_STRIP = 2048
"""Pixels: strips begin at multiples of it, so that their tiles begin with whole cache lines."""

_T = TypeVar("_T")


def threads_to_use() -> int:
    """As many as Numba may use (NUMBA_NUM_THREADS, else processors), up to MAX_THREADS."""
    return int(min(numba.get_num_threads(), MAX_THREADS))


def in_strips(work: Callable[[int, int], _T], pixels: int, threads: int) -> list[_T]:
    """What `work(begin, end)` returns for strips that make up all pixels, shared among threads; in no order."""
    if threads == 1 or pixels <= MIN_STRIP:
        return [work(0, pixels)]
    length = -(-pixels // (threads * STRIPS * MIN_STRIP)) * MIN_STRIP
    # The iterator is shared: its next strip goes to whoever asks first.
    begins = iter(range(0, pixels, length))

    def share() -> list[_T]:
        return [work(begin, min(begin + length, pixels)) for begin in begins]

    others = [_crew().submit(share) for _ in range(threads - 1)]
    found = share()
    # One that has not begun is not waited for: its strips are done, and those before it may wait for this one.
    return found + [result for other in others if not other.cancel() for result in other.result()]


@cache
def _crew() -> ThreadPoolExecutor:
    """Threads that stay: to start and to end one takes as long as a twentieth of an image."""
    return ThreadPoolExecutor(MAX_THREADS - 1, thread_name_prefix="strips")


os.register_at_fork(after_in_child=_crew.cache_clear)
