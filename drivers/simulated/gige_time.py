"""What the simulated GigE Vision camera knows of time: a clock of its own, and counters of edges."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

REMEMBERED = 1024
"""Exposures and edges of the near past whose times are kept"""


@dataclass(frozen=True)
class DeviceClock:
    """The camera's own clock: another origin, another rate."""

    tick_hz: int
    offset_ticks: int
    ppm: float
    epoch_ns: int

    def ticks(self, t_ns: int) -> int:
        """Its reading at a time of CLOCK_MONOTONIC."""
        passed = (t_ns - self.epoch_ns) * (1.0 + self.ppm * 1e-6)
        return self.offset_ticks + round(passed * self.tick_hz / 1e9)


class Edges:
    """A counter: how many edges there were by any time of the near past."""

    def __init__(self) -> None:
        self._times: list[int] = []
        self._before = 0
        """edges that are forgotten, less those before the last reset"""

    def add(self, t_ns: int) -> None:
        """An edge, not earlier than those before."""
        self._times.append(t_ns)
        if len(self._times) > 2 * REMEMBERED:
            del self._times[:REMEMBERED]
            self._before += REMEMBERED

    def count(self, until_ns: int) -> int:
        """Edges from the last reset to this time, the time itself included."""
        return self._before + bisect_right(self._times, until_ns)

    def reset(self, t_ns: int) -> None:
        """Count from this time on."""
        self._before -= self.count(t_ns - 1)
