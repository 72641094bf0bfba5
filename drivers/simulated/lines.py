"""The wires of the simulated world: rising edges in time, asked for by whoever listens.

A line gives its next edge after a given time, as far as it is known; nothing runs in the background. Listeners act
on edges that are past: those still to come may change, since an abort or a flip may come before them.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from typing import Literal, Protocol

LineName = Literal["vsync", "frame", "exposure", "trigger"]
"""vsync: the display's vertical blank; frame, exposure: the projector's trigger outputs by role; trigger: the
board's camera output"""

REMEMBERED = 4096
"""Edges that a recorded line keeps: more than any camera's buffers reach back"""


class Line(Protocol):
    """A source of rising edges."""

    def next_edge(self, after_ns: int) -> int | None:
        """The first edge later than `after_ns`, ns of the world's clock; None: none is known."""


class Regular:
    """A line that beats by itself, as a vertical blank does, until it ends."""

    def __init__(self, first_ns: int, period_ns: int) -> None:
        self._first_ns = first_ns
        self._period_ns = period_ns
        self._end_ns: int | None = None

    def next_edge(self, after_ns: int) -> int | None:
        """See `Line`."""
        beat = max(0, (after_ns - self._first_ns) // self._period_ns + 1)
        edge = self._first_ns + beat * self._period_ns
        return edge if self._end_ns is None or edge <= self._end_ns else None

    def end(self, t_ns: int) -> None:
        """No edge comes later than this."""
        self._end_ns = t_ns


class Recorded:
    """A line whose edges are put on it one by one, in order."""

    def __init__(self) -> None:
        self._edges: deque[int] = deque(maxlen=REMEMBERED)

    def add(self, t_ns: int) -> None:
        """An edge, later than those before."""
        self._edges.append(t_ns)

    def next_edge(self, after_ns: int) -> int | None:
        """See `Line`."""
        place = bisect_right(self._edges, after_ns)
        return self._edges[place] if place < len(self._edges) else None
