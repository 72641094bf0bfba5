"""Time, handed in: CLOCK_MONOTONIC in nanoseconds, real or virtual.

The sequencer and the simulated devices know no other time, so that a test runs a whole scan without waiting.
"""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """A monotonic clock."""

    def now_ns(self) -> int:
        """The present, ns."""

    def sleep_until(self, t_ns: int) -> None:
        """Return when `now_ns() >= t_ns`; at once if that time is past."""


class MonotonicClock:
    """CLOCK_MONOTONIC of this machine."""

    def now_ns(self) -> int:
        """The present, ns."""
        return time.monotonic_ns()

    def sleep_until(self, t_ns: int) -> None:
        """Return when `now_ns() >= t_ns`."""
        while (left := t_ns - time.monotonic_ns()) > 0:
            time.sleep(left / 1e9)


class VirtualClock:
    """A clock that moves only when somebody sleeps: one thread, no waiting, the same run every time."""

    def __init__(self, start_ns: int = 1_000_000_000) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """The present, ns."""
        return self._now_ns

    def sleep_until(self, t_ns: int) -> None:
        """Move the present to `t_ns` unless that is past."""
        self._now_ns = max(self._now_ns, t_ns)
