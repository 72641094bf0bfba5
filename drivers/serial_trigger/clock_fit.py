"""The board's clock as seen from the host: CLOCK_MONOTONIC = offset + rate x board time, with a bound that holds.

Each reading says: when the board's clock showed x, the host's lay in [low, high]: after the request had gone out and
before the answer was there. All lines through all these intervals are the clocks that the board can have; the bound
at any time is how far they differ there. That is linear programming in two unknowns; with a few dozen readings it is
solved by looking at every vertex. Pure.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

KEPT = 24
"""Readings that the fit is made of"""

SPAN_US = 600_000_000
"""Readings older than 10 min are left out: by then a crystal's temperature has changed its rate"""

RATE_TOLERANCE = 6e-3
"""An Arduino's ceramic resonator is within 0.5 %, a crystal within 0.01 %"""


@dataclass(frozen=True)
class Reading:
    """The board's clock at some time in [low_ns, high_ns] of the host's."""

    board_us: int
    """unwrapped"""
    low_ns: int
    high_ns: int


@dataclass(frozen=True)
class HostTime:
    """A board time on the host's clock: true within +- bound_ns."""

    t_ns: int
    bound_ns: int


class ClockFit:
    """The clock's line, kept up to date by `add`.

    A reading that no clock could have given together with those before it (the board began anew, or its rate moved)
    ends those: `breaks` counts how often.
    """

    def __init__(self) -> None:
        self._readings: deque[Reading] = deque(maxlen=KEPT)
        self._corners = np.empty((3, 0))
        """(3, K) rates, and the least and greatest offset at each, ns from the first reading's low end"""
        self.breaks = 0

    def add(self, reading: Reading) -> None:
        """Take a reading, later than those before."""
        while self._readings and reading.board_us - self._readings[0].board_us > SPAN_US:
            self._readings.popleft()
        self._readings.append(reading)
        while (corners := self._feasible()) is None:
            self._readings.popleft()
            self.breaks += 1
        self._corners = corners

    def forget(self) -> None:
        """The board began anew."""
        self._readings.clear()

    def __len__(self) -> int:
        """Readings in use."""
        return len(self._readings)

    @property
    def span_us(self) -> int:
        """From the first to the last reading, board time."""
        return self._readings[-1].board_us - self._readings[0].board_us if self._readings else 0

    @property
    def last_us(self) -> int | None:
        """Board time of the last reading."""
        return self._readings[-1].board_us if self._readings else None

    @property
    def rate(self) -> float:
        """Host time over board time, 1 for a perfect crystal: the middle of what is possible."""
        return float(self._corners[0].min() + self._corners[0].max()) / 2

    @property
    def rate_bound(self) -> float:
        """The rate is true within +- this."""
        return float(np.ptp(self._corners[0])) / 2

    @property
    def offset_ns(self) -> int:
        """Host time when the board's clock showed 0."""
        return self.at(0).t_ns

    @property
    def residual_ns(self) -> int:
        """Largest distance of a reading's middle from the line: what the transport's delays vary by."""
        middles = [(r.low_ns + r.high_ns) // 2 - self.at(r.board_us).t_ns for r in self._readings]
        return max((abs(middle) for middle in middles), default=0)

    def at(self, board_us: int) -> HostTime:
        """A board time (unwrapped) on the host's clock.

        Raises:
            ValueError: there is no reading yet.
        """
        if not self._readings:
            raise ValueError("the clock was not read yet")
        first = self._readings[0]
        rates, least, greatest = self._corners
        along = rates * (1e3 * (board_us - first.board_us))
        earliest, latest = float((least + along).min()), float((greatest + along).max())
        middle = (earliest + latest) / 2
        return HostTime(first.low_ns + round(middle), round((latest - earliest) / 2) + 1)

    def _feasible(self) -> NDArray[np.float64] | None:
        """What `_corners` holds: every rate at which a bound on the offset changes hands; None: no line fits."""
        first = self._readings[0]
        x = np.array([1e3 * (r.board_us - first.board_us) for r in self._readings])
        low = np.array([float(r.low_ns - first.low_ns) for r in self._readings])
        high = np.array([float(r.high_ns - first.low_ns) for r in self._readings])
        across = x[:, None] - x[None, :]
        later = across > 0
        across = np.where(later, across, 1.0)

        def slopes(top: NDArray[np.float64], bottom: NDArray[np.float64], missing: float) -> NDArray[np.float64]:
            return np.where(later, (top[:, None] - bottom[None, :]) / across, missing)

        # A line meets all intervals if for every pair low_i <= high_j + rate (x_i - x_j), and the other way round.
        most = min(float(slopes(high, low, np.inf).min()), 1 + RATE_TOLERANCE)
        least = max(float(slopes(low, high, -np.inf).max()), 1 - RATE_TOLERANCE)
        if least > most:
            return None
        crossings = np.concatenate((slopes(low, low, np.nan)[later], slopes(high, high, np.nan)[later]))
        rates = np.concatenate((crossings[(crossings > least) & (crossings < most)], (least, most)))
        lowest = (low[:, None] - x[:, None] * rates).max(axis=0)
        highest = (high[:, None] - x[:, None] * rates).min(axis=0)
        return np.stack((rates, lowest, highest))
