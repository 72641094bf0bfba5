"""The worker's working thread: scans (`scan_work`) and live runs (`live_work`), one after another. Knows no socket."""

from __future__ import annotations

import importlib
import logging
import queue
import threading
import time
from collections.abc import Callable

from scanner.errors import DecodeError, ScannerError
from scanner.stream import Cancel, End, Failed, Frame, FromWorker, LiveBegin, LiveFrame, Released, Result, Start
from scanner.wire import error_body
from service.live_work import LiveWork
from service.scan_work import ScanWork
from service.warm_up import modules_with_kernels

Job = Start | Frame | End | LiveBegin | LiveFrame | Cancel
_log = logging.getLogger(__name__)


class _Cancelled(Exception):
    """Unwinds a series that was cancelled."""


class Work:
    """Series after series."""

    def __init__(self, answer: Callable[[FromWorker], None], *, decode: bool) -> None:
        """`answer` is called in the working thread and must not block."""
        self._answer = answer
        self._decode = decode
        self._cancelled: set[int] = set()
        self._ending = threading.Event()
        self._series: ScanWork | None = None
        self._live: LiveWork | None = None

    @property
    def idle(self) -> bool:
        """Whether no series and no live run is under way."""
        return self._series is None and self._live is None

    def cancel(self, delivery: int | None) -> None:
        """Let a series go (None: everything) at the next stage. Called from another thread."""
        if delivery is None:
            self._ending.set()
        else:
            self._cancelled.add(delivery)

    def heard(self, end: End) -> None:
        """The end of a series has come and waits its turn. Called from another thread."""
        series = self._series
        if series is not None and series.delivery == end.delivery:
            series.heard(end)

    def serve(self, jobs: queue.SimpleQueue[Job | None]) -> None:
        """Work until None comes."""
        if self._decode:
            _warm_up(self._ending)
        try:
            self._serve(jobs)
        finally:
            self._end_live()
            self._end_series()

    def _serve(self, jobs: queue.SimpleQueue[Job | None]) -> None:
        while (message := jobs.get()) is not None:
            try:
                self._do(message)
            except _Cancelled:
                self._end_series()
                self._end_live()
                self._answer(Released(message.delivery))
            except ScannerError as error:
                self._fail(message.delivery, error)
            except Exception as error:  # noqa: BLE001  (a decoder that fails on one capture serves the next)
                _log.exception("decoding failed")
                problem = f"the decoder failed: {type(error).__name__}: {error}"
                self._fail(message.delivery, DecodeError(problem, hint="look at the log for the cause"))

    def _end_live(self) -> None:
        live, self._live = self._live, None
        if live is not None:
            live.close()

    def _end_series(self) -> None:
        series, self._series = self._series, None
        if series is not None:
            series.close()

    def _fail(self, delivery: int, error: ScannerError) -> None:
        self._end_series()
        self._end_live()
        self._answer(Failed(delivery, error_body(error)))

    def _do(self, message: Job) -> None:
        if isinstance(message, Cancel):
            # Whatever has become of it: it was stopped in a stage and answered so, is answered for, or never began.
            self._cancelled.discard(message.delivery)
            under_way = self._live or self._series
            if under_way is None or under_way.delivery == message.delivery:
                raise _Cancelled
        elif isinstance(message, Start):
            self._check(message.delivery)
            self._end_series()
            self._series = ScanWork(message, self._answer, self._check, decode=self._decode)
            self._series.begin()
        elif isinstance(message, LiveBegin):
            self._check(message.delivery)
            self._live = LiveWork(message, self._answer)
        elif self._live is not None and self._live.delivery == message.delivery:
            if isinstance(message, LiveFrame):
                self._live.frame(message)
            else:
                self._end_live()
                self._answer(Result(message.delivery, []))
        elif isinstance(message, LiveFrame):
            return  # of a run that is over
        elif self._series is not None and self._series.delivery == message.delivery:
            self._check(message.delivery)
            if isinstance(message, Frame):
                self._series.frame(message)
            else:
                result = self._series.end(message)
                self._end_series()
                self._answer(result)

    def _check(self, delivery: int) -> None:
        if delivery in self._cancelled or self._ending.is_set():
            raise _Cancelled


def _warm_up(ending: threading.Event) -> None:
    """Load decoder and kernels while the devices open: the first scan should not wait for imports and caches.

    It stops where the worker ends meanwhile: a thread that still is in LLVM when Python takes itself down aborts it.
    """
    began = time.perf_counter()
    for name in modules_with_kernels():
        if ending.is_set():
            return
        if name.startswith("scanner."):
            try:
                importlib.import_module(name).warm_up()
            except Exception:  # noqa: BLE001  (one decoder that is broken fails its own scans, and not all others)
                _log.exception("%s could not be made ready", name)
    importlib.import_module("scanner.reconstruct")
    _log.info("decoder ready after %.2f s", time.perf_counter() - began)
