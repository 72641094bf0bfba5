"""The simulated trigger board: its table, run on the world's vertical blanks, fires the simulated camera's line.

It speaks no protocol (that is `serial_board`, for the serial driver): it is the board as the sequencer sees it, in
the world's time. Pulses are reckoned when somebody asks, so virtual and real time give the same ones. Its source
VSYNC is the projector's vertical blank, EXT the projector's trigger output.
"""

from __future__ import annotations

import functools
import threading
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar, cast

from drivers.simulated.lines import REMEMBERED, Line, LineName
from drivers.simulated.options import Settings
from drivers.simulated.table_run import Step, TableRun
from drivers.simulated.world import World
from scanner.devices import Source, TableSlot, TriggerCapabilities, TriggerEvent, TriggerFault, TriggerSource
from scanner.errors import DeviceBusy, DeviceError, DeviceLost
from scanner.trigger_protocol import CAPABILITIES, VSYNC_TIMEOUT_MS
from scanner.trigger_table import BoardTable, board_table

TICK_NS = 500
"""An edge is captured to a tick of the board's timer"""

EMITS = 1

_RANDOM_USE = 4

_Method = TypeVar("_Method", bound=Callable[..., Any])


def _one_at_a_time(method: _Method) -> _Method:
    """The light relay looks at the board's line from a thread of its own, and looking reckons the run further."""

    @functools.wraps(method)
    def alone(self: SimulatedTriggerBoard, *given: Any) -> Any:
        with self._lock:
            return method(self, *given)

    return cast("_Method", alone)


class SimulatedTriggerBoard:
    """A board in a simulated world; see `scanner.devices.TriggerBoard`."""

    def __init__(self, world: World, settings: Settings, name: str) -> None:
        world.hold("trigger", self, name)
        self._lock = threading.RLock()
        self._world = world
        self._clock = world.clock
        self._name = name
        self._options = settings.trigger
        self._faults = settings.trigger_faults
        self._random = world.random(_RANDOM_USE)
        self._table: BoardTable | None = None
        self._source = TriggerSource.INTERNAL
        self._run: TableRun | None = None
        self._runs = 0
        self._pulses_before = 0
        """pulses given by runs before this one"""
        self._reckoned = 0
        """pulses of the run that are on the line or kept off it by a fault"""
        self._edges: list[int] = []
        self._told = 0
        """edges of the source that this run was told"""
        self._last_told_ns = 0
        self._stamps: list[TriggerEvent] = []
        self._open = True
        world.lines["trigger"] = self

    @property
    def name(self) -> str:
        """The device's name in messages."""
        return self._name

    @property
    def capabilities(self) -> TriggerCapabilities:
        """What it can do."""
        return replace(CAPABILITIES, event_bound_ns=round(1e3 * self._options.stamp_bound_us))

    @_one_at_a_time
    def program(self, table: Sequence[TableSlot], source: TriggerSource) -> None:
        """Load the whole table; see `scanner.devices.TriggerBoard.program`."""
        self._check_idle()
        self._table = board_table(table, source, CAPABILITIES, self._name)
        self._source = source

    @_one_at_a_time
    def arm(self) -> None:
        """Wait for the source; see `scanner.devices.TriggerBoard.arm`."""
        self._check_idle()
        if self._table is None:
            raise DeviceError("nothing is programmed", device=self._name, hint="load a table before arming")
        now = self._clock.now_ns()
        internal = self._source is TriggerSource.INTERNAL
        timeout = 1_000_000 * VSYNC_TIMEOUT_MS if self._source is TriggerSource.VSYNC else 0
        self._pulses_before += 0 if self._run is None else len(self._run.pulses)
        self._run = TableRun(self._steps(self._table), self._table.repeats, internal, now, timeout)
        self._runs += 1
        self._reckoned = self._told = 0
        self._last_told_ns = now
        self._edges, self._stamps = [edge for edge in self._edges[-REMEMBERED:] if edge <= now], []

    @_one_at_a_time
    def fire(self) -> None:
        """Start the table now; see `scanner.devices.TriggerBoard.fire`."""
        self._check_plugged()
        if self._source is not TriggerSource.INTERNAL:
            raise DeviceError(f"the source is {self._source.value}, not INT", device=self._name)
        if self._run is None or self._run.begun or self._over(self._clock.now_ns()):
            raise DeviceError("the board is not armed", device=self._name, hint="arm it first")
        self._run.fire(self._clock.now_ns())
        self._put_on_line()

    @_one_at_a_time
    def abort(self) -> None:
        """Stop, outputs low; see `scanner.devices.TriggerBoard.abort`."""
        self._check_plugged()
        self._stop()

    @_one_at_a_time
    def events(self) -> Sequence[TriggerEvent]:
        """Pulses given since `arm`; see `scanner.devices.TriggerBoard.events`."""
        self._check_plugged()
        now = self._clock.now_ns()
        lost = self._faults.lose_events
        return [event for event in self._stamps if event.t_ns + event.bound_ns <= now and event.step not in lost]

    @_one_at_a_time
    def faults(self) -> Sequence[TriggerFault]:
        """What went wrong since `arm`; see `scanner.devices.TriggerBoard.faults`."""
        self._check_plugged()
        now = self._clock.now_ns()
        found = [
            TriggerFault("lost_events", "a pulse was given whose event did not come", event.step)
            for event in self._stamps
            if event.step in self._faults.lose_events and event.t_ns <= now
        ]
        run = self._run
        if run is not None and run.fault is not None and run.fault.t_ns <= now:
            step = run.fault.run * len(run.steps) + run.fault.step
            if run.fault.name == "NOEDGE":
                text = f"no {self._source.value} edge in {run.timeout_ns // 1_000_000} ms, slot {step} did not come"
                found.append(TriggerFault("missing_edge", text, step, run.fault.t_ns))
            else:
                text = f"the edge that slot {step} should begin at came while another slot ran"
                found.append(TriggerFault("overrun", text, step, run.fault.t_ns))
        return found

    @_one_at_a_time
    def close(self) -> None:
        """Abort and give the device back; may be called twice."""
        if self._open:
            self._open = False
            self._stop()
            self._world.release("trigger")

    # --- the line ------------------------------------------------------------------------------------------------

    @_one_at_a_time
    def next_edge(self, after_ns: int) -> int | None:
        """The camera output's next rising edge; see `drivers.simulated.lines.Line`."""
        while True:
            place = bisect_right(self._edges, after_ns)
            if place < len(self._edges):
                return self._edges[place]
            if not self._progress():
                return None

    def _progress(self) -> bool:
        """Reckon the run a little further; whether there was anything to reckon."""
        run = self._run
        if run is None or run.over_ns is not None:
            return False
        if not run.follow():
            edge = self._next_of_source()
            if run.internal or edge is None or (run.due_ns is not None and edge > run.due_ns):
                return False
            self._told += 1
            self._last_told_ns = edge
            run.edge(edge + int(self._random.integers(TICK_NS)))
        self._put_on_line()
        return True

    def _next_of_source(self) -> int | None:
        ends = self._faults.source_ends_after
        line = self._source_line()
        if line is None or (ends is not None and self._told >= ends):
            return None
        return line.next_edge(self._last_told_ns)

    def _source_line(self) -> Line | None:
        names: tuple[LineName, ...] = ("vsync",) if self._source is TriggerSource.VSYNC else ("exposure", "frame")
        return next((self._world.lines[name] for name in names if name in self._world.lines), None)

    def _put_on_line(self) -> None:
        """Edges and events of the pulses that are new, with the faults that befall them."""
        run, faults = self._run, self._faults
        if run is None:
            return
        for pulse in run.pulses[self._reckoned :]:
            self._reckoned += 1
            if faults.unplug_after is not None and self._pulses_before + self._reckoned > faults.unplug_after:
                continue
            slot = pulse.run * len(run.steps) + pulse.step
            if slot in faults.spurious:
                self._edges.append((pulse.begin_ns + pulse.rise_ns) // 2)
            if not pulse.outputs:
                continue
            if slot not in faults.drop_pulses:
                self._edges.append(pulse.rise_ns)
            bound = round(1e3 * self._options.stamp_bound_us)
            stamp = pulse.rise_ns + int(self._random.integers(-bound // 2, bound // 2 + 1))
            self._stamps.append(TriggerEvent(self._runs - 1, slot, stamp, bound, Source.HARDWARE))

    def _steps(self, table: BoardTable) -> list[Step]:
        """The table in the world's time: the board's crystal is a little off."""
        rate = 1000 * (1 + 1e-6 * self._options.clock_ppm)
        return [
            Step(round(step.dark_us * rate), round(step.exposure_us * rate), EMITS if step.emit else 0, step.edges)
            for step in table.steps
        ]

    # --- states --------------------------------------------------------------------------------------------------

    def _reckon(self, now_ns: int) -> None:
        run = self._run
        if run is not None:
            while (not run.pulses or run.pulses[-1].rise_ns <= now_ns) and self._progress():
                pass
            run.check_time(now_ns)

    def _over(self, now_ns: int) -> bool:
        return self._run is None or (self._run.over_ns is not None and self._run.over_ns <= now_ns)

    def _stop(self) -> None:
        now = self._clock.now_ns()
        self._reckon(now)
        if self._run is not None:
            self._run.stop(now)
            self._reckoned = min(self._reckoned, len(self._run.pulses))
            del self._edges[bisect_right(self._edges, now) :]
            del self._stamps[bisect_left(self._stamps, now, key=lambda event: event.t_ns - event.bound_ns) :]

    def _check_idle(self) -> None:
        self._check_plugged()
        if not self._over(self._clock.now_ns()):
            raise DeviceBusy("a run is under way", device=self._name, hint="wait for its end, or abort it first")

    def _check_plugged(self) -> None:
        if not self._open:
            raise DeviceError("the board is closed", device=self._name)
        now = self._clock.now_ns()
        self._reckon(now)
        given = self._pulses_before
        if self._run is not None:
            given += sum(pulse.rise_ns <= now for pulse in self._run.pulses)
        if self._faults.unplug_after is not None and given >= self._faults.unplug_after:
            raise DeviceLost("the board went away", device=self._name, hint="plug it in again and repeat the scan")
