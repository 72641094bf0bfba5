"""What the daemon knows of its workers and of what each was given: seats, and deliveries of series to them.

Plain facts; `service.worker_pool` acts on them.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

from scanner.errors import DecodeError
from scanner.stream import Ready
from service.live_series import LiveSeries
from service.series import Series


@dataclass
class Delivery:
    """One sending of a series to one worker. Its number is never used again."""

    number: int
    series: Series | LiveSeries
    acked: int = 0
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    sender: asyncio.Task[None] | None = None


@dataclass
class Seat:
    """One worker that is there."""

    identity: bytes
    ready: Ready
    heard: float
    delivery: Delivery | None = None
    releasing: int | None = None
    """a delivery that it was told to let go"""

    @property
    def free(self) -> bool:
        """Whether it can take a series."""
        return self.delivery is None and self.releasing is None


class WorkerLost(Exception):
    """A series was sent as often as it may be, and no worker survived it. `error` is for its client."""

    def __init__(self, error: DecodeError) -> None:
        super().__init__(error.message)
        self.error = error
