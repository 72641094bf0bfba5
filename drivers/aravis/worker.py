"""One thread on which all calls into the library are made: a call that hangs there hangs there alone.

A caller waits for its result, or until the camera is known to be lost, whichever comes first; a call that was given
up runs on to its end, and what it held is let go there.
"""

from __future__ import annotations

import logging
import queue
import threading
import traceback
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from scanner.errors import DeviceLost

_T = TypeVar("_T")

LOOK_S = 0.02
"""Between two looks at whether the camera is lost"""

LONGEST_S = 20.0
"""No call of a camera that answers takes so long"""

_log = logging.getLogger(__name__)


class _Task(Generic[_T]):
    def __init__(self, work: Callable[[], _T]) -> None:
        self.done = threading.Event()
        self._work: Callable[[], _T] | None = work
        self._result: _T | None = None
        self._error: BaseException | None = None

    def run(self) -> None:
        work, self._work = self._work, None
        try:
            if work is not None:
                self._result = work()
        except BaseException as error:  # noqa: BLE001  (handed to who waits, or logged)
            # Whoever keeps the error must not keep the camera open by it: the frames hold the library's objects.
            traceback.clear_frames(error.__traceback__)
            self._error = error
        self.done.set()

    def result(self) -> _T:
        if self._error is not None:
            raise self._error
        return self._result  # type: ignore[return-value]  # None only where the work returns None

    @property
    def error(self) -> BaseException | None:
        return self._error


class Worker:
    """A thread with a queue."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._queue: queue.SimpleQueue[_Task[Any] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=f"{name} calls", daemon=True)
        self._thread.start()

    def call(self, work: Callable[[], _T], lost: threading.Event | None = None) -> _T:
        """Run `work` on the thread and return what it returns.

        Raises:
            DeviceLost: `lost` was set while it ran, or it took longer than any call may.
        """
        task = _Task(work)
        self._queue.put(task)
        waited = 0.0
        while not task.done.wait(LOOK_S):
            waited += LOOK_S
            if (lost is not None and lost.is_set()) or waited > LONGEST_S:
                raise DeviceLost("the camera does not answer", device=self._name, hint="look at its cable and power")
        return task.result()

    def post(self, work: Callable[[], object]) -> None:
        """Run `work` when its turn comes; an error is logged."""
        self._queue.put(_Posted(work, self._name))

    def end(self, patience_s: float) -> None:
        """Let the thread end after what is queued; wait for it that long."""
        self._queue.put(None)
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=patience_s)

    def _run(self) -> None:
        while (task := self._queue.get()) is not None:
            task.run()
            del task  # what it returned must not live until the next one comes


class _Posted(_Task[object]):
    def __init__(self, work: Callable[[], object], name: str) -> None:
        super().__init__(work)
        self._name = name

    def run(self) -> None:
        super().run()
        if self.error is not None:
            _log.debug("%s: %s", self._name, self.error)
