"""The serial trigger board as the sequencer sees it: tables, runs, events on the host's clock, faults, and its loss.

    connected --port gone, silence--> lost --program or arm--> connected

A lost board says so at every call; `program` and `arm` look for it again, so a board that was plugged in anew needs
nobody's help. What noise destroyed is asked again; what cannot be had again is reported as a fault.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Literal, Protocol

from pydantic import Field

from drivers.option_table import Options
from drivers.serial_trigger import orders
from drivers.serial_trigger.board_clock import BoardClock
from drivers.serial_trigger.clock_fit import ClockFit
from drivers.serial_trigger.link import Link, RefusedError
from drivers.serial_trigger.protocol import Message, Ok, Pulse, Ready, pulse_from
from drivers.serial_trigger.run import Places, Run
from scanner.clock import Clock
from scanner.devices import TableSlot, TriggerCapabilities, TriggerEvent, TriggerFault, TriggerSource
from scanner.errors import DeviceBusy, DeviceError
from scanner.trigger_protocol import CAPABILITIES, EVENTS_KEPT, OUTPUTS, TIMEOUT_MAX_MS
from scanner.trigger_table import BoardTable, board_table

STILL_THERE_NS = 300_000_000
"""Silence of an armed board after which it is asked whether it is still there"""


class BoardOptions(Options):
    """The rig file's table `[trigger.options]`."""

    outputs: tuple[Literal["CAM1", "CAM2", "SYNC", "LED"], ...] = Field(default=("CAM1", "SYNC", "LED"), min_length=1)
    """what a slot with `emit_trigger` raises"""
    edge: Literal["rising", "falling"] = "rising"
    """of the source that counts"""
    timeout_ms: int | None = Field(default=None, ge=0, le=TIMEOUT_MAX_MS)
    """longest wait for an edge before it is a fault, 0: none. None: 200 for VSYNC, none for EXT"""


class Connection(Protocol):
    """What `driver.connect` gives."""

    @property
    def link(self) -> Link:
        """The conversation."""

    @property
    def identity(self) -> str:
        """Its answer to `*IDN?`."""


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
        self._host = clock
        self._clock = BoardClock()
        self._heard: deque[Message] = deque()
        self._table: BoardTable | None = None
        self._source = TriggerSource.INTERNAL
        self._loaded = False
        self._run: Run | None = None
        self._runs = 0
        self._open = True
        self._take(connect(self._heard.append))

    def _take(self, found: Connection) -> None:
        self._link, self.identity = found.link, found.identity
        self._heard.clear()
        self._loaded = False
        try:
            self._begin_clock()
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

    @property
    def clock_fit(self) -> ClockFit:
        """What is known of the board's clock."""
        return self._clock.fit

    def program(self, table: Sequence[TableSlot], source: TriggerSource) -> None:
        """Load the whole table; see `scanner.devices.TriggerBoard.program`. A lost board is looked for again."""
        self._check_open()
        folded = board_table(table, source, CAPABILITIES, self.name)
        self._make_ready()
        self._clear()
        self._table, self._source = folded, source
        self._fill(folded)

    def arm(self) -> None:
        """Wait for the source; see `scanner.devices.TriggerBoard.arm`. A lost board is looked for again."""
        self._check_open()
        if self._table is None:
            raise DeviceError("nothing is programmed", device=self.name, hint="load a table before arming")
        self._make_ready()
        self._listen()
        if self._loaded:
            try:
                self._once("ARM", undone="IDLE")
            except RefusedError:
                if orders.state(self._link).state != "IDLE":
                    raise self._busy() from None
                self._loaded = False  # it has begun anew, and noise took its word of it
                self._begin_clock()
        if not self._loaded:
            self._clear()
            self._fill(self._table)
            self._once("ARM", undone="IDLE")
        self._begin_run(self._table)

    def fire(self) -> None:
        """Start the table now; see `scanner.devices.TriggerBoard.fire`."""
        self._check_open()
        if self._source is not TriggerSource.INTERNAL:
            raise DeviceError(f"the source is {self._source.value}, not INT", device=self.name)
        try:
            self._once("FIRE", undone="ARMED")
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
        return [] if run is None else run.events()

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
        """Load the table; the clock is read once more, since a run may follow."""
        ask, options = self._link.ask, self._options
        mask = sum(OUTPUTS[name] for name in options.outputs)
        for i, step in enumerate(table.steps):
            outputs = mask if step.emit else 0
            orders.append(self._link, i, f"SEQ:ADD {step.dark_us},{step.exposure_us},{outputs},{step.edges}")
        falling = options.edge == "falling" and self._source is not TriggerSource.INTERNAL
        ask(f"SEQ:SOURCE {self._source.value}{',FALL' if falling else ''}")
        if options.timeout_ms is not None:
            ask(f"SEQ:TIMEOUT {options.timeout_ms}")
        ask(f"SEQ:REPEAT {table.repeats}")
        self._loaded = True
        self._clock.read(self._link)

    def _once(self, command: str, undone: str) -> None:
        """Send a command that must not be obeyed twice.

        A run so short that it is over already shows by a first pulse that is younger than the command.
        """
        sent = self._host.now_ns()
        orders.once(self._link, command, undone, lambda: self._ran_since(sent))

    def _ran_since(self, t_ns: int) -> bool:
        pulse = self._told_again(0)
        if pulse is None:
            return False
        given = self._clock.at(pulse.t_us)
        return given.t_ns + given.bound_ns >= t_ns

    # --- what the board says by itself ---------------------------------------------------------------------------

    def _heard_so_far(self) -> Run | None:
        """The run, with all that has come; a board that has been quiet for long is asked for what it has."""
        self._check_open()
        self._check_lost()
        self._listen()
        run, now, given = self._run, self._host.now_ns(), 0
        if run is None:
            return None
        if now - self._link.heard_ns > STILL_THERE_NS:
            state = orders.state(self._link)
            self._listen()
            run.ended(state.fault)
            given = state.pulses
        self._fetch(run, given)
        if self._clock.is_due(now):
            self._clock.read(self._link)
            self._listen()
        self._check_lost()
        return run

    def _fetch(self, run: Run, given: int) -> None:
        """Ask again for pulses that should be there; those that the board has forgotten are lost."""
        given = max(given, run.heard)
        for count in run.missing(given):
            run.fetched(count, self._told_again(count) if count >= given - EVENTS_KEPT else None)

    def _told_again(self, count: int) -> Pulse | None:
        """A pulse that the board still knows."""
        try:
            return pulse_from(self._link.ask(f"EVT? {count}"))
        except RefusedError:
            return None

    def _listen(self) -> None:
        """Take what the reader has heard."""
        while self._heard:
            message = self._heard.popleft()
            if isinstance(message, Ready):
                self._began_anew()
            elif self._run is not None:
                self._run.note(message)

    def _begin_run(self, table: BoardTable) -> None:
        """From ARM's answer on lines are of this run; those before it are of the run before."""
        heard: list[Message] = []
        while self._heard:
            heard.append(self._heard.popleft())
        answers = [i for i, message in enumerate(heard) if isinstance(message, Ok)]
        self._run = Run(self._runs, Places.of(table), self._source, self._clock)
        self._runs += 1
        self._heard.extendleft(reversed(heard[answers[-1] + 1 if answers else 0 :]))
        self._listen()

    def _began_anew(self) -> None:
        """A reset: table and clock are gone, and so is the run."""
        self._loaded = False
        if self._run is not None:
            self._run.began_anew()
        self._link.ask("*CRC 1")
        self._link.require_sums()
        self._begin_clock()

    def _begin_clock(self) -> None:
        if self._run is not None:
            self._run.keep()
        self._clock.begin(self._link)

    # --- there or not --------------------------------------------------------------------------------------------

    def _check_open(self) -> None:
        if not self._open:
            raise DeviceError("the board is closed", device=self.name)

    def _check_lost(self) -> None:
        if self._link.lost is not None:
            raise self._link.lost

    def _busy(self) -> DeviceBusy:
        return DeviceBusy("a run is under way", device=self.name, hint="wait for its end, or abort it first")

    def _make_ready(self) -> None:
        """Connect again if it was lost; know its clock."""
        if self._link.lost is not None:
            self._link.close()
            self._take(self._connect(self._heard.append))
        elif self._clock.is_stale(self._host.now_ns()):
            self._begin_clock()
