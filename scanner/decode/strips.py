"""Strips of an image shared among threads. The kernels that work on them leave the interpreter lock alone."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from functools import cache, lru_cache
from queue import SimpleQueue
from threading import Thread
from time import sleep
from typing import Any, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from scanner.decode.gate import ABANDONED, OPEN, all_gone, new_gate, set_gate

STRIPS = 6
"""Strips of the image for each thread: few enough to cost nothing, enough to even out a thread that is held up."""

MAX_THREADS = 4
"""More do not read memory faster."""

MIN_STRIP = 2048
"""Pixels: strips begin at multiples of it, so that their tiles begin with whole cache lines."""

_PATIENCE = 2e-5
"""Seconds between two looks at whether another thread is ready, where one has to wait for it"""

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


@lru_cache(maxsize=16)
def begins_of(pixels: int, threads: int) -> NDArray[np.intp]:
    """(S + 1,) where strips begin, and where the last one ends: long ones first, so that little switching is done, and
    short ones last, so that threads end together. Not to be written into."""
    begins, shortest = [0], 4 * MIN_STRIP
    while begins[-1] < pixels:
        share = (pixels - begins[-1]) // (2 * threads) if threads > 1 else pixels
        begins.append(min(begins[-1] + max(-(-share // MIN_STRIP) * MIN_STRIP, shortest), pixels))
    return np.array(begins, np.intp)


class Shared:
    """Strips that threads take by turns inside a kernel, which all but one enter before it is known what to do.

    Nobody sleeps for it: who finds the gate shut for too long leaves, and is called once more when it opens. So an
    interrupt, wherever it comes, leaves nobody behind. A context: it is left when no other thread is at work any more,
    and if it is left before `open`, none has been.
    """

    def __init__(self, work: Callable[[NDArray[np.int64], NDArray[np.int64]], bool], threads: int, counts: int) -> None:
        """work(gate, counts): waits at the gate, comes, takes strips and goes; False if the gate stayed shut too long
        (see `pmp_strips.decode_strips`). counts: how many numbers it adds to."""
        self._work, self._gate, self._opened, self._finished = work, new_gate(), False, False
        self._counts = np.zeros((threads, counts), np.int64)
        self._others: dict[int, _Call] = {}
        self._call(range(1, threads))

    def _call(self, numbers: Iterable[int]) -> None:
        """Have others wait at the gate, which is shut; where no thread can be had, this one does all by itself."""
        try:
            for n in numbers:
                self._others[n] = _crew().submit(self._work, self._gate, self._counts[n])
        except RuntimeError:
            # One that nobody knows of may have been handed over all the same: what it finds is a gate of its own.
            set_gate(self._gate, ABANDONED)
            self._gate, self._others = new_gate(), {}

    def open(self) -> None:
        """What the work needs is there: others begin."""
        self._call([n for n, other in self._others.items() if other.done()])
        self._opened = True
        set_gate(self._gate, OPEN)

    def finish(self) -> NDArray[np.int64]:
        """Take strips as well, until all is done; sums of counts."""
        self._work(self._gate, self._counts[0])
        # Others are seen to leave before the interpreter hears of it; one that did not come yet finds nothing to do.
        self._finished = all_gone(self._gate)
        if not self._finished:
            self._join()
        return np.asarray(self._counts.sum(axis=0))

    def _join(self) -> None:
        # One that has not begun is not waited for: its strips are done, and those before it may wait for this one.
        for other in self._others.values():
            if not other.cancel():
                other.result()

    def __enter__(self) -> Shared:
        return self

    def __exit__(self, *_: object) -> None:
        if not self._opened:
            set_gate(self._gate, ABANDONED)
        if not (self._finished or all(other.done() for other in self._others.values())):
            self._join()


class _Call:
    """Work for another thread, and what became of it.

    Without a lock, which an interrupt may leave taken for ever if it comes just then (`concurrent.futures` has one
    in every future): each word is written by one side only, and the interpreter keeps their order.
    """

    def __init__(self, call: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        self._call, self._arguments = call, arguments
        self._begun = self._cancelled = self._over = False
        self._value: Any = None
        self._error: BaseException | None = None

    def run(self) -> None:
        """By the other thread."""
        self._begun = True
        try:
            if not self._cancelled:
                self._value = self._call(*self._arguments)
        except BaseException as error:  # noqa: BLE001  (it is raised by who asks for the result)
            self._error = error
        self._arguments = ()
        self._over = True

    def cancel(self) -> bool:
        """Whether it has not begun, and will not."""
        self._cancelled = True
        return not self._begun

    def done(self) -> bool:
        """Whether it is over."""
        return self._over

    def result(self) -> Any:
        """What it returned or raised, when it is over."""
        while not self._over:
            sleep(_PATIENCE)
        if self._error is not None:
            raise self._error
        return self._value


class _Crew:
    """Threads that stay: to start and to end one takes as long as a twentieth of an image. They end with the process,
    whatever they are at."""

    def __init__(self) -> None:
        self._calls: SimpleQueue[_Call] = SimpleQueue()
        self._threads: list[Thread] = []

    def submit(self, call: Callable[..., Any], *arguments: Any) -> _Call:
        """Have it called by a thread.

        Raises:
            RuntimeError: there is none, and none can be had.
        """
        if len(self._threads) < MAX_THREADS - 1:
            try:
                thread = Thread(target=self._serve, name=f"strips_{len(self._threads)}", daemon=True)
                thread.start()
                self._threads.append(thread)
            except RuntimeError:
                if not self._threads:
                    raise
        handed = _Call(call, arguments)
        self._calls.put(handed)
        return handed

    def _serve(self) -> None:
        while True:
            self._calls.get().run()


@cache
def _crew() -> _Crew:
    return _Crew()


os.register_at_fork(after_in_child=_crew.cache_clear)
