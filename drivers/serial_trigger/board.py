"""The serial trigger board as the sequencer sees it: tables, runs, events on the host's clock, faults, and its loss.

    connected --port gone, silence--> lost --program or arm--> connected

A lost board says so at every call; `program` and `arm` look for it again, so a board that was plugged in anew needs
nobody's help. What noise destroyed is asked again; what cannot be had again is reported as a fault.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from drivers.serial_trigger.clock_fit import ClockFit, Reading
from drivers.serial_trigger.link import Link, NoAnswerError, RefusedError
from drivers.serial_trigger.protocol import (
    BoardState,
    EventsLost,
    Message,
    Ok,
    Pulse,
    Ready,
    RunEnded,
    Unwrapped,
    board_state,
    pulse_from,
)
from scanner.clock import Clock
from scanner.devices import Source, TableSlot, TriggerCapabilities, TriggerEvent, TriggerFault, TriggerSource
from scanner.errors import DeviceBusy, DeviceError
from scanner.trigger_protocol import CAPABILITIES, EVENTS_KEPT, OUTPUTS
from scanner.trigger_table import BoardTable, board_table

_log = logging.getLogger(__name__)

BYTE_NS = 84_000
"""A byte takes at least this on the wire: 10 bits at the fastest that a UART may be to be understood at 115200"""

FIRST_READINGS = 4
READ_AGAIN_NS = (50_000_000, 5_000_000_000)
"""The clock is read again after a quarter of the time it has been known for, within these: its rate is then known ever
better, and a reading, which takes 3 ms of the line, is rare"""

STILL_THERE_NS = 300_000_000
"""Silence of an armed board after which it is asked whether it is still there"""

EVENT_NS = 1_000
"""An event's time is cut to microseconds, of a clock of half microseconds"""


@dataclass(frozen=True)
class BoardOptions:
    """The rig file's table `[trigger.options]`."""

    outputs: tuple[str, ...] = ("CAM1", "SYNC", "LED")
    """what a slot with `emit_trigger` raises"""
    edge: str = "rising"
    """of the source that counts: "rising" or "falling" """
    timeout_ms: int | None = None
    """longest wait for an edge before it is a fault, 0: none. None: 200 for VSYNC, none for EXT"""


class Connection(Protocol):
    """What `driver.connect` gives."""

    @property
    def link(self) -> Link:
        """The conversation."""

    @property
    def identity(self) -> str:
        """Its answer to `*IDN?`."""


@dataclass
class _Run:
    """What was heard of the run since `arm`."""

    number: int
    breaks: int
    """of the clock's fit, when it began"""
    pulses: dict[int, tuple[int, int]] = field(default_factory=dict)
    """by their count since ARM: slot, and board time (unwrapped)"""
    events: dict[int, TriggerEvent] = field(default_factory=dict)
    """those whose time cannot become more certain: the clock was read after them"""
    faults: list[TriggerFault] = field(default_factory=list)
    lost: set[int] = field(default_factory=set)
    """pulses whose events cannot be had any more"""


class SerialTriggerBoard:
    """A board behind a serial port; see `scanner.devices.TriggerBoard`."""

    def __init__(
        self, connect: Callable[[Callable[[Message], None]], Connection], options: BoardOptions, clock: Clock
    ) -> None:
        """Connect. connect: opens the port and makes sure of the board; called again after a loss.

        Raises:
            DeviceError: it cannot be opened.
        """
        self._connect = connect
        self._options = options
        self._clock = clock
        self._heard: deque[Message] = deque()
        self._table: BoardTable | None = None
        self._emitting: tuple[int, ...] = ()
        """steps of the table that give a pulse"""
        self._source = TriggerSource.INTERNAL
        self._loaded = False
        self._run: _Run | None = None
        self._runs = 0
        self._open = True
        self._take(connect(self._heard.append))

    def _take(self, found: Connection) -> None:
        self._link, self.identity = found.link, found.identity
        self._heard.clear()
        self._unwrapped = Unwrapped()
        self.clock_fit = ClockFit()
        self._read_ns = 0
        self._loaded = False
        try:
            for _ in range(FIRST_READINGS):
                self._read_clock()
        except BaseException:
            self._link.close()
            raise

    @property
    def name(self) -> str:
        """The device's name in messages."""
        return f"trigger board {self._link.name}"

    @property
    def capabilities(self) -> TriggerCapabilities:
        """What it can do."""
        return CAPABILITIES

    def program(self, table: Sequence[TableSlot], source: TriggerSource) -> None:
        """Load the whole table; see `scanner.devices.TriggerBoard.program`. A lost board is looked for again."""
        self._check_open()
        folded = board_table(table, source, CAPABILITIES, self.name)
        self._reconnect_if_lost()
        self._clear()
        self._table, self._source = folded, source
        self._emitting = tuple(i for i, step in enumerate(folded.steps) if step.emit)
        self._fill(folded)
        self._read_clock()

    def arm(self) -> None:
        """Wait for the source; see `scanner.devices.TriggerBoard.arm`. A lost board is looked for again."""
        self._check_open()
        if self._table is None:
            raise DeviceError("nothing is programmed", device=self.name, hint="load a table before arming")
        self._reconnect_if_lost()
        self._listen()
        if self._loaded:
            try:
                self._once("ARM", done=("ARMED", "RUNNING"), again=("IDLE",))
            except RefusedError:
                if self._state().state != "IDLE":
                    raise self._busy() from None
                self._loaded = False  # it has begun anew, and noise took its word of it
        if not self._loaded:
            self._clear()
            self._fill(self._table)
            self._read_clock()
            self._once("ARM", done=("ARMED", "RUNNING"), again=("IDLE",))
        self._begin_run()

    def fire(self) -> None:
        """Start the table now; see `scanner.devices.TriggerBoard.fire`."""
        self._check_open()
        if self._source is not TriggerSource.INTERNAL:
            raise DeviceError(f"the source is {self._source.value}, not INT", device=self.name)
        try:
            self._once("FIRE", done=("RUNNING", "IDLE"), again=("ARMED",))
        except RefusedError as error:
            raise DeviceError("the board is not armed", device=self.name, hint="arm it first") from error

    def abort(self) -> None:
        """Stop, outputs low; see `scanner.devices.TriggerBoard.abort`."""
        self._check_open()
        self._link.knock()
        self._link.ask("ABORT")

    def events(self) -> Sequence[TriggerEvent]:
        """Pulses given since `arm`; see `scanner.devices.TriggerBoard.events`."""
        run = self._heard_so_far()
        return [] if run is None else [self._event(run, count) for count in sorted(run.pulses)]

    def faults(self) -> Sequence[TriggerFault]:
        """What went wrong since `arm`; see `scanner.devices.TriggerBoard.faults`."""
        run = self._heard_so_far()
        return [] if run is None else list(run.faults)

    def close(self) -> None:
        """Abort and give the port back; may be called twice."""
        if self._open:
            self._open = False
            try:
                if self._link.lost is None:
                    self._link.knock()
                    self._link.ask("ABORT")
            except DeviceError:
                self._loaded = False  # it went away just now: there is nothing left to stop
            finally:
                self._link.close()

    # --- the table and its start ---------------------------------------------------------------------------------

    def _clear(self) -> None:
        """Empty the board's table, which it does only while idle."""
        try:
            self._link.ask("SEQ:CLEAR")
        except RefusedError as error:
            raise self._busy() from error
        self._loaded = False

    def _fill(self, table: BoardTable) -> None:
        ask = self._link.ask
        mask = sum(OUTPUTS[name] for name in self._options.outputs)
        for i, step in enumerate(table.steps):
            self._add(i, f"SEQ:ADD {step.dark_us},{step.exposure_us},{mask if step.emit else 0},{step.edges}")
        falling = self._options.edge == "falling" and self._source is not TriggerSource.INTERNAL
        ask(f"SEQ:SOURCE {self._source.value}{',FALL' if falling else ''}")
        if self._options.timeout_ms is not None:
            ask(f"SEQ:TIMEOUT {self._options.timeout_ms}")
        ask(f"SEQ:REPEAT {table.repeats}")
        self._loaded = True

    def _add(self, index: int, command: str) -> None:
        """Append a step, exactly once."""
        while True:
            try:
                added = self._link.ask(command, repeat=False)
            except NoAnswerError:
                length = self._link.ask("SEQ:LEN?")
                if length == str(index):
                    continue
                added = str(int(length) - 1) if length.isdigit() else length
            if added != str(index):
                raise DeviceError(
                    f"step {index} of the table became step {added}", device=self.name, hint="program it again"
                )
            return

    def _once(self, command: str, *, done: tuple[str, ...], again: tuple[str, ...]) -> None:
        """Send a command that must not be obeyed twice; where its answer is lost, the board's state tells.

        A run so short that it is over already shows by a first pulse that is younger than the command.
        """
        while True:
            sent = self._clock.now_ns()
            try:
                self._link.ask(command, repeat=False)
            except NoAnswerError:
                state = self._state().state
                if state in again and state not in done and not self._ran_since(sent):
                    continue
            return

    def _ran_since(self, t_ns: int) -> bool:
        try:
            pulse = pulse_from(self._link.ask("EVT? 0"))
        except RefusedError:
            return False
        if pulse is None:
            return False
        given = self.clock_fit.at(self._unwrapped(pulse.t_us))
        return given.t_ns + given.bound_ns >= t_ns

    def _state(self) -> BoardState:
        value = self._link.ask("STAT?")
        state = board_state(value)
        if state is None:
            raise DeviceError(f"STAT? was answered with {value!r}", device=self.name)
        return state

    # --- what the board says by itself ---------------------------------------------------------------------------

    def _heard_so_far(self) -> _Run | None:
        """The run, with all that has come; a board that has been quiet for long is asked for what it has."""
        self._check_open()
        self._check_lost()
        self._listen()
        run = self._run
        now = self._clock.now_ns()
        if run is None:
            return None
        if now - self._link.heard_ns > STILL_THERE_NS:
            state = self._state()
            self._listen()
            self._catch_up(run, state)
        self._fill_gaps(run, max(run.pulses, default=-1) + 1)
        least, most = READ_AGAIN_NS
        if now - self._read_ns > min(max(least, self.clock_fit.span_us * 250), most):
            self._read_clock()
            self._listen()
        self._check_lost()
        return run

    def _listen(self) -> None:
        """Take what the reader has heard."""
        while self._heard:
            message = self._heard.popleft()
            if isinstance(message, Ready):
                self._began_anew()
            elif self._run is not None:
                self._note(self._run, message)

    def _begin_run(self) -> None:
        """From ARM's answer on lines are of this run; those before it are of the run before."""
        self._run = None
        heard: list[Message] = []
        while self._heard:
            heard.append(self._heard.popleft())
        answers = [i for i, message in enumerate(heard) if isinstance(message, Ok)]
        self._run = _Run(self._runs, self.clock_fit.breaks)
        self._runs += 1
        for message in heard[answers[-1] + 1 if answers else 0 :]:
            self._note(self._run, message)

    def _note(self, run: _Run, message: Message) -> None:
        if isinstance(message, Pulse):
            count = self._count(message)
            if count is not None:
                run.pulses[count] = (self._slot(message.run, message.step), self._unwrapped(message.t_us))
        elif isinstance(message, RunEnded):
            t_ns = self.clock_fit.at(self._unwrapped(message.t_us)).t_ns
            run.faults.append(_ended(message.name, self._source, self._slot(message.run, message.step), t_ns))
        elif isinstance(message, EventsLost):
            run.faults.append(
                TriggerFault("lost_events", f"{message.count} events came faster than the line can tell them")
            )

    def _began_anew(self) -> None:
        """A reset: table and clock are gone, and so is the run."""
        self._loaded = False
        self.clock_fit.forget()
        self._unwrapped = Unwrapped()
        self._read_ns = 0
        if self._run is not None:
            self._run.faults.append(
                TriggerFault("reset", "the board began anew: its supply or its reset line was disturbed")
            )
        self._link.ask("*CRC 1")
        self._link.require_sums()
        self._read_clock()

    def _catch_up(self, run: _Run, state: BoardState) -> None:
        """Fetch what noise took of a board that has said nothing for a while."""
        self._fill_gaps(run, state.pulses)
        known = {"NOEDGE": "missing_edge", "OVERRUN": "overrun"}.get(state.fault)
        if known is not None and all(fault.kind != known for fault in run.faults):
            run.faults.append(_ended(state.fault, self._source, None, None))

    def _fill_gaps(self, run: _Run, count: int) -> None:
        """Ask again for events that should be there; those the board has forgotten are lost, and told."""
        for missing in sorted(set(range(count)) - set(run.pulses) - run.lost):
            pulse = None
            if missing >= count - EVENTS_KEPT:
                try:
                    pulse = pulse_from(self._link.ask(f"EVT? {missing}"))
                except RefusedError:
                    pulse = None  # it has forgotten that one meanwhile
            if pulse is not None and self._count(pulse) == missing:
                run.pulses[missing] = (self._slot(pulse.run, pulse.step), self._unwrapped(pulse.t_us))
                continue
            run.lost.add(missing)
            slot = self._slot_of_count(missing)
            run.faults.append(TriggerFault("lost_events", f"the event of slot {slot} was destroyed on the line", slot))

    # --- positions and times -------------------------------------------------------------------------------------

    def _slot(self, run: int, step: int) -> int:
        return run * len(self._table.steps) + step if self._table is not None else step

    def _slot_of_count(self, count: int) -> int:
        run, place = divmod(count, len(self._emitting))
        return self._slot(run, self._emitting[place])

    def _count(self, pulse: Pulse) -> int | None:
        """How many pulses of the run came before; None: it is none of this table's."""
        if self._table is None or pulse.step not in self._emitting or pulse.run >= self._table.repeats:
            return None
        return pulse.run * len(self._emitting) + self._emitting.index(pulse.step)

    def _event(self, run: _Run, count: int) -> TriggerEvent:
        """A pulse on the host's clock, as well as that is known now."""
        if count in run.events:
            return run.events[count]
        slot, board_us = run.pulses[count]
        host = self.clock_fit.at(board_us)
        # A clock that contradicted itself in this run may have done so before this event, or after it.
        source = Source.HARDWARE if self.clock_fit.breaks == run.breaks else Source.ESTIMATED
        event = TriggerEvent(run.number, slot, host.t_ns, host.bound_ns + EVENT_NS, source)
        if self.clock_fit.last_us is not None and self.clock_fit.last_us > board_us:
            run.events[count] = event
        return event

    def _read_clock(self) -> None:
        """One reading of the board's clock, taken when the request's last byte had arrived."""
        answer = self._link.ask_timed("TIME?")
        if not answer.value.isdigit():
            raise DeviceError(f"TIME? was answered with {answer.value!r}", device=self.name)
        low = answer.sent_ns + answer.sent_bytes * BYTE_NS
        high = answer.heard_ns - answer.heard_bytes * BYTE_NS
        if low > high:  # a line faster than any UART: a pty without one
            low, high = answer.sent_ns, answer.heard_ns
        breaks = self.clock_fit.breaks
        self.clock_fit.add(Reading(self._unwrapped(int(answer.value)), low, high + EVENT_NS))
        self._read_ns = answer.heard_ns
        if self.clock_fit.breaks != breaks:
            _log.warning("%s: its clock does not run evenly with this machine's: event times are estimates", self.name)

    # --- there or not --------------------------------------------------------------------------------------------

    def _check_open(self) -> None:
        if not self._open:
            raise DeviceError("the board is closed", device=self.name)

    def _check_lost(self) -> None:
        if self._link.lost is not None:
            raise self._link.lost

    def _busy(self) -> DeviceBusy:
        return DeviceBusy("a run is under way", device=self.name, hint="wait for its end, or abort it first")

    def _reconnect_if_lost(self) -> None:
        if self._link.lost is not None:
            self._link.close()
            self._take(self._connect(self._heard.append))


def _ended(name: str, source: TriggerSource, step: int | None, t_ns: int | None) -> TriggerFault:
    slot = "a slot" if step is None else f"slot {step}"
    if name == "NOEDGE":
        return TriggerFault("missing_edge", f"no {source.value} edge in time, {slot} did not come", step, t_ns)
    return TriggerFault("overrun", f"the edge that {slot} should begin at came while another slot ran", step, t_ns)
