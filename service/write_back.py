"""The disk's side of a capture: synced in passing, and closed while the devices take the next one already.

One thread for each capture. At most one capture is being closed while another is taken: beyond that the disk is what
limits, and the devices wait for it between two scans, never within one.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Any, Self

from scanner.capture import CaptureWriter, State
from scanner.errors import StorageError

SYNC_EVERY_BYTES = 16 << 20
"""Written back in passing, so that little is left to wait for at the end."""

Closed = Callable[[StorageError | None], None]


class WriteBack:
    """One capture's: `frame` after each frame, `close` once. Left without `close`, the folder stays `open`."""

    def __init__(self, writer: CaptureWriter, frame_bytes: int, before: WriteBack | None) -> None:
        self._writer = writer
        self._every = max(1, SYNC_EVERY_BYTES // frame_bytes)
        self._before = before
        self._frames = 0
        self._wanted = threading.Event()
        self._closing: Callable[[], None] | None = None
        self._ended = False
        self._error: StorageError | None = None
        self._thread = threading.Thread(target=self._run, name="write-back")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended = True
        self._wanted.set()
        if self._closing is None:
            self.join()
            self._writer.abandon()

    def frame(self) -> None:
        """One more frame was written.

        Raises:
            StorageError: writing back failed.
        """
        if self._error is not None:
            raise self._error
        self._frames += 1
        if self._frames % self._every == 0:
            self._wanted.set()

    def close(self, state: State, reason: str | None, witnesses: Sequence[Mapping[str, Any]], then: Closed) -> None:
        """Close the capture soon; `then` is called with the problem, if there was one. Waits for the one before."""
        if self._before is not None:
            self._before.join()
            self._before = None

        def closing() -> None:
            problem = None
            try:
                self._writer.close(state, reason, witnesses=witnesses)
            except StorageError as error:
                problem = error
            then(problem)

        self._closing = closing

    def join(self) -> None:
        """Wait until the thread has ended."""
        self._thread.join()

    def _run(self) -> None:
        while not self._ended:
            self._wanted.wait()
            self._wanted.clear()
            if not self._ended and self._error is None:
                try:
                    self._writer.sync()
                except StorageError as error:
                    self._error = error
        if self._closing is not None:
            self._closing()


class WriteBacks:
    """Those of one process, in order."""

    def __init__(self) -> None:
        self._last: WriteBack | None = None
        self._closing: threading.Thread | None = None

    def of(self, writer: CaptureWriter, frame_bytes: int) -> WriteBack:
        """The next capture's."""
        self._last = WriteBack(writer, frame_bytes, self._last)
        return self._last

    def close_behind(self, close: Callable[[], None]) -> None:
        """Run what closes a recording while the devices go on. Waits for the one before."""
        if self._closing is not None:
            self._closing.join()
        self._closing = threading.Thread(target=close, name="live-close")
        self._closing.start()

    def wait(self) -> None:
        """Wait until everything is closed."""
        if self._last is not None:
            self._last.join()
        if self._closing is not None:
            self._closing.join()
