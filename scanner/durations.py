"""The distribution of many durations in little room: a count for each half millisecond, and what lies beyond.

Latencies of a live run are gathered here, in the worker that measures them and in the daemon that sums them up; the
counts can be sent piece by piece. Plain Python: the daemon loads no array library.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

BIN_MS = 0.5
LAST_BIN = 20_000
"""Durations of ten seconds and more share one bin."""


class Durations:
    """Counts by half millisecond. Percentiles are exact to the bin; the largest is kept as it was."""

    def __init__(self) -> None:
        self.count = 0
        self.largest_ms = 0.0
        self._bins: Counter[int] = Counter()
        self._fresh: Counter[int] = Counter()

    def add(self, duration_ms: float) -> None:
        """Take one; less than nothing (a stamp within its bound) counts as nothing."""
        index = min(max(int(duration_ms / BIN_MS), 0), LAST_BIN)
        self._fresh[index] += 1
        self._count(index, 1, duration_ms)

    def take_fresh(self) -> list[tuple[int, int]]:
        """(bin, count) of what `add` took since the last call, by bin."""
        fresh, self._fresh = self._fresh, Counter()
        return sorted(fresh.items())

    def add_counts(self, counts: Iterable[tuple[int, int]], largest_ms: float) -> None:
        """Take what another one's `take_fresh` gave, and its largest."""
        for index, count in counts:
            self._count(index, count, largest_ms)

    def percentile(self, share: float) -> float | None:
        """Upper edge of the bin in which that share (0..1) of all is reached, ms; None where there are none."""
        if not self.count:
            return None
        reached = 0
        for index in sorted(self._bins):
            reached += self._bins[index]
            if reached >= share * self.count:
                return min((index + 1) * BIN_MS, round(self.largest_ms, 3))
        raise AssertionError("the bins hold all that was counted")

    def as_dict(self, *, bins: bool = False) -> dict[str, Any]:
        """Count, percentiles and the largest, ms; with `bins` the whole distribution as [lower edge, count]."""
        found: dict[str, Any] = {
            "count": self.count,
            "p50": self.percentile(0.5),
            "p90": self.percentile(0.9),
            "p99": self.percentile(0.99),
            "max": round(self.largest_ms, 3) if self.count else None,
        }
        if bins:
            found["bins"] = [[index * BIN_MS, self._bins[index]] for index in sorted(self._bins)]
        return found

    def _count(self, index: int, count: int, largest_ms: float) -> None:
        self._bins[index] += count
        self.count += count
        self.largest_ms = max(self.largest_ms, largest_ms)
