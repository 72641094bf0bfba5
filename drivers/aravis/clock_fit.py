"""The camera's clock against the host's: a line through pairs of readings, with a bound that holds.

Two kinds of pairs. *Latched*: the camera was told to read its clock between two readings of ours; the true time lies
between them (Cristian 1989). *Arrival*: a stamped frame came; its stamp is not later than that, by an unknown delay
of which only the least is of use (lower envelope; Moon, Skelley, Towsley 1999). Crystals are within 100 ppm of their
nominal rate, which holds a fit that has seen little. Pure: no clock is read here. One thread may feed a fit while
another one asks it.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

CRYSTAL = 1e-4
"""Two crystals differ by less than this share, whatever was measured"""

BASE_NS = 2_000_000_000
"""The rate is fitted once readings lie this far apart; before, the nominal one is more certain"""

KEPT = 64
BIN_NS = 500_000_000
"""Of the readings within this time only the best is kept"""


@dataclass(frozen=True)
class Reading:
    """The camera's clock stood at `device_ns` when ours stood within middle_ns +- half_ns."""

    device_ns: int
    middle_ns: int
    half_ns: int


@dataclass(frozen=True)
class Line:
    """host = middle_ns + rate x (device - device_ns)."""

    device_ns: int
    middle_ns: float
    rate: float

    def host_ns(self, device_ns: int) -> float:
        """Our clock when the camera's stood at `device_ns`."""
        return self.middle_ns + self.rate * (device_ns - self.device_ns)


class ClockFit:
    """Maps the camera's time to the host's.

    `latched` says which kind of pairs it is fed. Forget it when the camera restarts: its clock begins anew.
    """

    def __init__(self, latched: bool, slack_ns: int = 0) -> None:
        """slack_ns: what is added to every bound; with arrivals, the believed spread of the least delay."""
        self.latched = latched
        self._slack_ns = slack_ns
        self._readings: deque[Reading] = deque(maxlen=KEPT)
        self._line: Line | None = None
        self._bin_start = 0
        self._bounds: list[tuple[int, float]] = []
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._readings)

    def add(self, device_ns: int, low_ns: int, high_ns: int) -> None:
        """A pair. Latched: our time lay between low and high. Arrival: high is when the frame came, low the same."""
        reading = Reading(device_ns, (low_ns + high_ns) // 2, (high_ns - low_ns + 1) // 2)
        with self._lock:
            self._take(reading)

    def _take(self, reading: Reading) -> None:
        last = self._readings[-1] if self._readings else None
        if last is not None and reading.device_ns - self._bin_start < BIN_NS:
            if self._better(reading, last):
                self._readings[-1] = reading
                self._line = None
            return
        self._bin_start = reading.device_ns
        self._readings.append(reading)
        self._line = None

    def host(self, device_ns: int) -> tuple[int, int]:
        """(time, bound) of a reading of the camera's clock, ns of ours.

        Raises:
            ValueError: nothing was fed yet.
        """
        with self._lock:
            line = self._fitted()
            return round(line.host_ns(device_ns)), round(self._bound(device_ns)) + self._slack_ns

    @property
    def newest_ns(self) -> int:
        """The camera's clock at the last reading; 0 before the first."""
        return self._readings[-1].device_ns if self._readings else 0

    @property
    def rate(self) -> float:
        """Our nanoseconds to one of the camera's."""
        with self._lock:
            return self._fitted().rate

    @property
    def residual_ns(self) -> float:
        """How far the worst reading lies from the line beyond its own width; 0: the line explains all of them."""
        with self._lock:
            line = self._fitted()
            return max(max(0.0, abs(self._off(line, r)) - r.half_ns) for r in self._readings)

    def _better(self, reading: Reading, last: Reading) -> bool:
        if self.latched:
            return reading.half_ns <= last.half_ns
        # The earlier arrival for its stamp: clocks drift 50 us at most within a bin.
        return reading.middle_ns - reading.device_ns <= last.middle_ns - last.device_ns

    def _fitted(self) -> Line:
        if self._line is None:
            if not self._readings:
                raise ValueError("the clock was never compared")
            self._line = self._fit()
            self._bounds = sorted((r.device_ns, abs(self._off(self._line, r)) + r.half_ns) for r in self._readings)
        return self._line

    def _fit(self) -> Line:
        """Weighted least squares; the rate is the nominal one until the readings' own spread allows better."""
        readings = list(self._readings)
        origin = readings[-1].device_ns
        weights = [1.0 / max(r.half_ns, 500) ** 2 for r in readings]
        total = sum(weights)
        x = sum(w * (r.device_ns - origin) for w, r in zip(weights, readings, strict=True)) / total
        # Relative to the last reading: sums of times since boot would lose nanoseconds in floating point.
        base = readings[-1].middle_ns
        y = sum(w * (r.middle_ns - base) for w, r in zip(weights, readings, strict=True)) / total
        rate = 1.0
        if readings[-1].device_ns - readings[0].device_ns >= BASE_NS:
            both = zip(weights, readings, strict=True)
            pairs = [(w, r.device_ns - origin - x, r.middle_ns - base - y) for w, r in both]
            rate = sum(w * dx * dy for w, dx, dy in pairs) / sum(w * dx * dx for w, dx, dy in pairs)
            rate = min(max(rate, 1.0 - CRYSTAL), 1.0 + CRYSTAL)
        return Line(origin, base + y - rate * x, rate)

    @staticmethod
    def _off(line: Line, reading: Reading) -> float:
        return reading.middle_ns - line.host_ns(reading.device_ns)

    def _bound(self, device_ns: int) -> float:
        """At a reading the line is wrong by its residual and width at most; away from it, by the rate's error more."""
        first, last = self._bounds[0], self._bounds[-1]
        base = last[0] - first[0]
        # Two readings hold the line at both ends: its slope is wrong by no more than their bounds allow.
        slope = min(2 * CRYSTAL, (first[1] + last[1]) / base) if base >= BASE_NS else CRYSTAL
        return min(bound + slope * abs(device_ns - at) for at, bound in self._bounds)
