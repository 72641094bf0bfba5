"""One run of a trigger board's table, as the firmware runs it: when each step begins, and what ends the run early.

Pure: it is told the edges of its source in order and holds what follows from them; times are ns of any one clock.
The rules are those of docs/reference/trigger-protocol.md. With source INT steps follow one another from `fire` on.
With an external source a step begins at the `edges`-th edge after the one that the step before it counted from
(0: when that step ends). An edge that should begin a step while another runs is an overrun; none within the
time-out is a missing edge. Both end the run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

FaultName = Literal["NOEDGE", "OVERRUN"]


@dataclass(frozen=True)
class Step:
    """One step of the table: dark for a while, then its outputs high for the exposure."""

    dark_ns: int
    exposure_ns: int
    outputs: int
    edges: int = 1


@dataclass(frozen=True)
class Pulse:
    """A step that began: outputs are high from `rise_ns` to `fall_ns`."""

    run: int
    """which pass through the table, from 0"""
    step: int
    begin_ns: int
    rise_ns: int
    fall_ns: int
    outputs: int


@dataclass(frozen=True)
class RunFault:
    """What ended a run, and the step that did not come."""

    name: FaultName
    run: int
    step: int
    t_ns: int


class TableRun:
    """A run of `repeats` passes (0: without end), from `armed_ns` on. timeout_ns 0: waits for ever."""

    def __init__(self, steps: Sequence[Step], repeats: int, internal: bool, armed_ns: int, timeout_ns: int = 0) -> None:
        self.steps = tuple(steps)
        self.repeats = repeats
        self.internal = internal
        self.timeout_ns = timeout_ns
        self.pulses: list[Pulse] = []
        self.fault: RunFault | None = None
        self.last_edge_ns = armed_ns
        """the last edge that was told, or the time of arming"""
        self._edges = 0
        self._next = 0
        self._free_ns: int | None = None
        """when the step before is over; None: none has begun"""
        self._stopped_ns: int | None = None

    @property
    def begun(self) -> bool:
        """Whether the first step has."""
        return self._next > 0

    @property
    def stopped_ns(self) -> int | None:
        """When it was stopped or failed; None: neither."""
        return self._stopped_ns

    @property
    def over_ns(self) -> int | None:
        """When the last step ends, or the run was ended before; None: not known yet."""
        if self._stopped_ns is not None:
            return self._stopped_ns
        return self._free_ns if self._complete else None

    @property
    def waits(self) -> bool:
        """Whether the next step begins at an edge (or at `fire`)."""
        if self._complete or self._stopped_ns is not None:
            return False
        return self._free_ns is None or (not self.internal and self.steps[self._next % len(self.steps)].edges > 0)

    def fire(self, t_ns: int) -> None:
        """Begin the first step (source INT)."""
        if self.internal and self.waits:
            self._begin(t_ns)

    def follow(self) -> bool:
        """Begin the next step if it follows by itself; whether it did."""
        if self._free_ns is None or self.waits or self._complete or self._stopped_ns is not None:
            return False
        self._begin(self._free_ns)
        return True

    def edge(self, t_ns: int) -> None:
        """Tell an edge of the source, later than those before. Steps that follow must have been begun."""
        if self.internal or self._stopped_ns is not None or self._complete:
            return
        self.check_time(t_ns)
        if self.fault is not None:
            return
        self.last_edge_ns = t_ns
        self._edges += 1
        if self._edges != self._wanted:
            return
        if not self.waits or (self._free_ns is not None and t_ns < self._free_ns):
            self._fail("OVERRUN", t_ns)
        else:
            self._edges = 0
            self._begin(t_ns)

    def check_time(self, now_ns: int) -> None:
        """Fail if an edge that is waited for has not come within the time-out."""
        due = self.due_ns
        if due is not None and now_ns > due:
            self._fail("NOEDGE", due)

    @property
    def due_ns(self) -> int | None:
        """Until when an edge must come; None: none is waited for, or for ever."""
        if not self.timeout_ns or self.internal or not self.waits:
            return None
        return self.last_edge_ns + self.timeout_ns

    def stop(self, t_ns: int) -> None:
        """End it now: pulses that have not begun never do, one that has ends."""
        if self.over_ns is None or t_ns < self.over_ns:
            self._stopped_ns = t_ns
            self.fault = None  # it would have come later
            kept = (pulse for pulse in self.pulses if pulse.rise_ns <= t_ns)
            self.pulses = [_cut(pulse, t_ns) for pulse in kept]

    @property
    def _complete(self) -> bool:
        return self.repeats > 0 and self._next >= self.repeats * len(self.steps)

    @property
    def _wanted(self) -> int:
        """Edges from the last that began a step to the one that begins the next waiting step; 0: none waits."""
        if self._free_ns is None:
            return max(1, self.steps[0].edges)
        left = self.repeats * len(self.steps) - self._next if self.repeats else len(self.steps)
        ahead = (self.steps[(self._next + i) % len(self.steps)].edges for i in range(min(left, len(self.steps))))
        return next((edges for edges in ahead if edges > 0), 0)

    def _begin(self, t_ns: int) -> None:
        run, place = divmod(self._next, len(self.steps))
        step = self.steps[place]
        rise = t_ns + step.dark_ns
        self.pulses.append(Pulse(run, place, t_ns, rise, rise + step.exposure_ns, step.outputs))
        self._free_ns = rise + step.exposure_ns
        self._next += 1

    def _fail(self, name: FaultName, t_ns: int) -> None:
        run, place = divmod(self._next, len(self.steps))
        self.stop(t_ns)
        self.fault = RunFault(name, run, place, t_ns)


def _cut(pulse: Pulse, t_ns: int) -> Pulse:
    if pulse.fall_ns <= t_ns:
        return pulse
    return Pulse(pulse.run, pulse.step, pulse.begin_ns, pulse.rise_ns, t_ns, pulse.outputs)
