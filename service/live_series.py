"""A live run on its way from the devices to a worker: the newest frames, and the counts that come back.

The counterpart of `service.series.Series` for a run without end. Frames are passed on as they are told; where no
worker is there, or its queue is full, they are forgotten, and the next worker counts them as dropped.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from scanner.durations import Durations
from scanner.stream import EndReason, LiveBegin, LiveCounts, LiveFrame, Result
from service.pipe import Shot
from service.series import SeriesEnd

WAITING = 4
"""Frames kept for the sender: it is one turn of the event loop behind; older ones are not wanted any more."""

STEADY_S = 30.0
"""A worker that served this long was not killed by what it was given: the next one starts with a clean slate."""


@dataclass
class LiveTotals:
    """What became of a run's frames: captured = decoded + undecodable + dropped + those under way."""

    captured: int = 0
    lost: int = 0
    """counted by the camera, and never came"""
    decoded: int = 0
    undecodable: int = 0
    dropped: int = 0
    next: int = 0
    """first frame that no worker has reported on"""
    latency: Durations = field(default_factory=Durations)
    decode_ms: float = 0.0
    points: int = 0
    threads: int = 0
    problem: str | None = None

    def add(self, counts: LiveCounts) -> None:
        """Take a worker's report."""
        self.next = max(self.next, counts.next)
        self.decoded += counts.decoded
        self.undecodable += counts.undecodable
        self.dropped += counts.dropped
        self.latency.add_counts(counts.latency, counts.largest_ms)
        self.threads = counts.threads
        if counts.decoded or counts.undecodable:
            self.decode_ms, self.points, self.problem = counts.decode_ms, counts.points, counts.problem

    def settle(self, *, over: bool = False) -> None:
        """Count as dropped what a worker took with it; once all is over also what no worker was given."""
        if over:
            self.next = self.captured
        self.dropped += self.next - (self.decoded + self.undecodable + self.dropped)

    def as_dict(self) -> dict[str, Any]:
        """For status and reports."""
        return {
            "captured": self.captured,
            "lost": self.lost,
            "decoded": self.decoded,
            "undecodable": self.undecodable,
            "dropped": self.dropped,
            "points": self.points,
            "decode_ms": round(self.decode_ms, 3),
            "threads": self.threads,
            "problem": self.problem,
        }


@dataclass(eq=False)
class LiveSeries:
    """One live run as the pool of workers has it."""

    job: str
    header: Mapping[str, Any]
    calibration: Mapping[str, Any] | None
    endpoint: str
    content: Literal["rows", "xyz"]
    stride: int
    options: Mapping[str, Any]
    delivering: Callable[[int], None]
    """hears of each delivery before it begins"""
    deliveries: int = 0
    end: SeriesEnd | None = None
    cancelled: bool = False
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    outcome: asyncio.Future[Result] = field(default_factory=lambda: asyncio.get_running_loop().create_future())
    counts: LiveTotals = field(default_factory=LiveTotals)
    _shots: deque[Shot] = field(default_factory=lambda: deque(maxlen=WAITING))
    _began: float = 0.0

    def shot(self, shot: Shot) -> None:
        """A frame was taken."""
        self.counts.captured = shot.number + 1
        self.counts.lost = shot.lost
        self._shots.append(shot)
        self.changed.set()

    def finish(self, reason: EndReason) -> None:
        """There will be no more frames."""
        self.end = SeriesEnd(reason)
        self.changed.set()

    def hear(self, message: object) -> None:
        """A worker says something."""
        if isinstance(message, LiveCounts):
            self.counts.add(message)
            if time.monotonic() - self._began > STEADY_S:
                self.deliveries = 1

    def begin(self, delivery: int) -> LiveBegin:
        """What a worker is told first; frames of a worker that was lost count as dropped."""
        self._began = time.monotonic()
        self.counts.settle()
        self._shots.clear()
        return LiveBegin(
            delivery,
            self.job,
            dict(self.header),
            None if self.calibration is None else dict(self.calibration),
            self.endpoint,
            self.counts.next,
            self.content,
            self.stride,
            dict(self.options),
        )

    def take(self, delivery: int) -> list[LiveFrame]:
        """The frames that wait, for this delivery."""
        shots = list(self._shots)
        self._shots.clear()
        return [
            LiveFrame(delivery, s.number, s.path, s.offset, s.xxh3, s.frame_id, s.start_ns, s.end_ns) for s in shots
        ]
