"""The trigger board's firmware as a model: the same lines and the same pin edges for the same input, in any time.

    board = SerialBoard(); board.receive(b"ARM\\n", t_ns); board.edge("VSYNC", True, t_ns); board.advance(t_ns)

Pure: nothing here waits or opens anything (`serial_board_pty` does). It is held to the golden files that the real
firmware is held to, and is what a driver or a client can be tried against without hardware. Not modelled: the time
that the firmware takes to answer, and events that come faster than its line can tell them.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

from drivers.simulated.table_run import Pulse, Step, TableRun
from scanner.devices import TriggerSource
from scanner.trigger_protocol import (
    ABORT_BYTE,
    CAPABILITIES,
    CLOCK_BITS,
    ERRORS,
    EVENTS_KEPT,
    LINE_MAX,
    OUTPUTS,
    TIMEOUT_MAX_MS,
    VSYNC_TIMEOUT_MS,
    framed,
    unframed,
)
from scanner.trigger_table import EDGES_MAX

TICK_NS = 500
"""Of the board's timer: edges and commands count from a whole one"""

IDENTITY = "fringed,trigger-simulated,1.0,1.0.0"

_CRC, _SYNTAX, _RANGE, _STATE, _FULL, _LINE, _UNKNOWN = ERRORS


@dataclass(frozen=True)
class Said:
    """A line that the board sent."""

    t_ns: int
    data: bytes


@dataclass(frozen=True)
class PinEdge:
    """An output that changed."""

    t_ns: int
    pin: str
    level: int


Output = Said | PinEdge


class _RefusedError(Exception):
    """A command that the board does not obey."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class SerialBoard:
    """The model. Times are ns of the board's own clock, which starts at 0 with the reset; calls come in their order."""

    def __init__(self) -> None:
        self._out: list[Output] = []
        self._line = bytearray()
        self._broken = False
        self._sums = False
        self._run: TableRun | None = None
        self._shown = 0
        """pulses whose rise was put out"""
        self._high: Pulse | None = None
        self._events: list[Pulse] = []
        self._fault_said = True
        self._forget()
        self._commands = self._all_commands()
        self._say(0, "!EVT READY")

    def _forget(self) -> None:
        self._steps: list[Step] = []
        self._repeats = 1
        self._choose_source(TriggerSource.INTERNAL, falling=False)

    def receive(self, data: bytes, t_ns: int) -> None:
        """Bytes, of which the last had arrived at `t_ns`."""
        self._go_on(t_ns)
        for byte in data:
            if byte == ABORT_BYTE[0]:
                self._stop(t_ns)
                self._line.clear()
                self._broken = False
            elif byte == ord("\n"):
                self._end_of_line(t_ns)
            elif len(self._line) == LINE_MAX - 1:
                self._broken = True
            else:
                self._line.append(byte)

    def edge(self, source: str, rising: bool, t_ns: int) -> None:
        """A change on the input VSYNC or EXT."""
        self._go_on(t_ns)
        if self._run is not None and source == self._source.value and rising != self._falling:
            self._run.edge(t_ns // TICK_NS * TICK_NS)
            self._go_on(t_ns)

    def advance(self, t_ns: int) -> list[Output]:
        """What the board put out up to `t_ns`, in order, since the call before."""
        self._go_on(t_ns)
        out, self._out = self._out, []
        return sorted(out, key=lambda output: output.t_ns)

    # --- the run -------------------------------------------------------------------------------------------------

    def _go_on(self, t_ns: int) -> None:
        """Put out what happens up to `t_ns`."""
        run = self._run
        if run is None:
            return
        while run.pulses and run.pulses[-1].fall_ns <= t_ns and run.follow():
            pass
        run.check_time(t_ns)
        while self._shown < len(run.pulses) and run.pulses[self._shown].rise_ns <= t_ns:
            self._fall(t_ns)
            self._rise(run.pulses[self._shown])
            self._shown += 1
        self._fall(t_ns)
        if run.fault is not None and not self._fault_said:
            self._fault_said = True
            fault = run.fault
            self._say(t_ns, f"!FAULT {fault.name} {fault.run} {fault.step} {_micros(fault.t_ns)}")

    def _rise(self, pulse: Pulse) -> None:
        self._set_pins(pulse.rise_ns, pulse.outputs, 1)
        self._high = pulse
        if pulse.outputs:
            self._events.append(pulse)
            self._say(pulse.rise_ns, f"!EVT {pulse.run} {pulse.step} {_micros(pulse.rise_ns)}")

    def _fall(self, t_ns: int) -> None:
        """End the pulse that is on, if it is over by now or was cut short."""
        if self._high is None or self._run is None:
            return
        stopped = self._run.stopped_ns
        falls = self._high.fall_ns if stopped is None else min(self._high.fall_ns, stopped)
        if falls <= t_ns:
            self._set_pins(falls, self._high.outputs, 0)
            self._high = None

    def _set_pins(self, t_ns: int, outputs: int, level: int) -> None:
        self._out += [PinEdge(t_ns, pin, level) for pin, bit in OUTPUTS.items() if outputs & bit]

    def _stop(self, t_ns: int) -> None:
        if self._run is not None:
            self._run.stop(t_ns)
            self._go_on(t_ns)

    def _state(self, t_ns: int) -> str:
        if self._run is None or (self._run.over_ns is not None and self._run.over_ns <= t_ns):
            return "IDLE"
        return "RUNNING" if self._run.begun else "ARMED"

    # --- lines ---------------------------------------------------------------------------------------------------

    def _say(self, t_ns: int, text: str) -> None:
        self._out.append(Said(t_ns, framed(text, sum_=self._sums)))

    def _end_of_line(self, t_ns: int) -> None:
        line, broken = bytes(self._line).removesuffix(b"\r"), self._broken
        self._line.clear()
        self._broken = False
        if not line and not broken:
            return
        text, sum_ = unframed(line)
        try:
            if broken:
                raise _RefusedError(_LINE)  # noqa: TRY301
            if sum_ == "wrong" or (self._sums and sum_ == "none"):
                raise _RefusedError(_CRC)  # noqa: TRY301
            value = self._obey(text, t_ns)
        except _RefusedError as refused:
            self._say(t_ns, f"ERR {refused.code},{ERRORS[refused.code]}")
        else:
            self._say(t_ns, f"OK {value}" if value else "OK")

    def _obey(self, text: str, t_ns: int) -> str:
        name, blank, rest = text.partition(" ")
        if name not in self._commands:
            raise _RefusedError(_UNKNOWN)
        form, act = self._commands[name]
        if (form is None) != (not blank):
            raise _RefusedError(_SYNTAX)
        if form is None:
            return act(t_ns)
        found = re.fullmatch(form, rest, flags=re.ASCII)
        if found is None:
            raise _RefusedError(_SYNTAX)
        return act(t_ns, *found.groups())

    def _all_commands(self) -> dict[str, tuple[str | None, Callable[..., str]]]:
        """Name -> the form of what follows (None: nothing), and what does it."""
        number = r"(\d+)"
        return {
            "*IDN?": (None, lambda t: IDENTITY),
            "*RST": (None, self._reset),
            "*CRC": (number, self._crc),
            "STAT?": (None, self._stat),
            "SEQ:CLEAR": (None, self._clear),
            "SEQ:ADD": (r"(\d+),(\d+),(\d+)(?:,(\d+))?", self._add),
            "SEQ:LEN?": (None, lambda t: str(len(self._steps))),
            "SEQ:SOURCE": (r"(INT|VSYNC|EXT)(?:,(RISE|FALL))?", self._set_source),
            "SEQ:REPEAT": (number, self._repeat),
            "SEQ:TIMEOUT": (number, self._set_timeout),
            "ARM": (None, self._arm),
            "FIRE": (None, self._fire),
            "ABORT": (None, self._abort),
            "TIME?": (None, lambda t: str(_micros(t))),
            "EVT?": (number, self._event),
        }

    def _check_idle(self, t_ns: int) -> None:
        if self._state(t_ns) != "IDLE":
            raise _RefusedError(_STATE)

    def _reset(self, t_ns: int) -> str:
        self._stop(t_ns)
        self._forget()
        return ""

    def _crc(self, t_ns: int, on: str) -> str:
        self._sums = bool(_within(on, 0, 1))
        return ""

    def _stat(self, t_ns: int) -> str:
        fault = self._run.fault if self._run is not None else None
        return f"{self._state(t_ns)} {len(self._events)} {fault.name if fault is not None else 'NONE'}"

    def _clear(self, t_ns: int) -> str:
        self._check_idle(t_ns)
        self._steps = []
        return ""

    def _add(self, t_ns: int, dark: str, exposure: str, outputs: str, edges: str | None) -> str:
        c = CAPABILITIES
        step = Step(
            1000 * _within(dark, c.dark_min_us, c.time_max_us),
            1000 * _within(exposure, c.exposure_min_us, c.time_max_us),
            _within(outputs, 0, sum(OUTPUTS.values())),
            _within("1" if edges is None else edges, 0, EDGES_MAX),
        )
        self._check_idle(t_ns)
        if len(self._steps) == c.max_steps:
            raise _RefusedError(_FULL)
        self._steps.append(step)
        return str(len(self._steps) - 1)

    def _set_source(self, t_ns: int, name: str, edge: str | None) -> str:
        self._check_idle(t_ns)
        self._choose_source(TriggerSource(name), falling=edge == "FALL")
        return ""

    def _choose_source(self, source: TriggerSource, *, falling: bool) -> None:
        self._source, self._falling = source, falling
        self._timeout_ms = VSYNC_TIMEOUT_MS if source is TriggerSource.VSYNC else 0

    def _repeat(self, t_ns: int, passes: str) -> str:
        repeats = _within(passes, 0, CAPABILITIES.max_repeats)
        self._check_idle(t_ns)
        self._repeats = repeats
        return ""

    def _set_timeout(self, t_ns: int, ms: str) -> str:
        timeout = _within(ms, 0, TIMEOUT_MAX_MS)
        self._check_idle(t_ns)
        self._timeout_ms = timeout
        return ""

    def _arm(self, t_ns: int) -> str:
        if not self._steps:
            raise _RefusedError(_STATE)
        self._check_idle(t_ns)
        internal = self._source is TriggerSource.INTERNAL
        self._run = TableRun(self._steps, self._repeats, internal, t_ns, 1_000_000 * self._timeout_ms)
        self._shown = 0
        self._events = []
        self._fault_said = False
        return ""

    def _fire(self, t_ns: int) -> str:
        if self._run is None or self._state(t_ns) != "ARMED" or self._source is not TriggerSource.INTERNAL:
            raise _RefusedError(_STATE)
        self._run.fire(t_ns // TICK_NS * TICK_NS)
        return ""

    def _abort(self, t_ns: int) -> str:
        self._stop(t_ns)
        return ""

    def _event(self, t_ns: int, number: str) -> str:
        count = _within(number, 0, (1 << 32) - 1)
        if not len(self._events) - EVENTS_KEPT <= count < len(self._events):
            raise _RefusedError(_RANGE)
        pulse = self._events[count]
        return f"{pulse.run} {pulse.step} {_micros(pulse.rise_ns)}"


def _within(digits: str, low: int, high: int) -> int:
    if not low <= int(digits) <= high:
        raise _RefusedError(_RANGE)
    return int(digits)


def _micros(t_ns: int) -> int:
    return t_ns // 1000 % (1 << CLOCK_BITS)
