"""One run of the board's table as it is heard: which slots had their pulse, when, and what went wrong.

It is told messages and asks for nothing; what noise took is named (`missing`), and fetched by the board's driver.
"""

from __future__ import annotations

from dataclasses import dataclass

from drivers.serial_trigger.board_clock import EVENT_NS, BoardClock
from drivers.serial_trigger.protocol import EventsLost, Message, Pulse, RunEnded
from scanner.devices import Source, TriggerEvent, TriggerFault, TriggerSource
from scanner.trigger_table import BoardTable

_FAULTS = {"NOEDGE": "missing_edge", "OVERRUN": "overrun"}


@dataclass(frozen=True)
class Places:
    """Where the pulses of a table stand: in the table as it was programmed (slots), and among the pulses (counts)."""

    steps: int
    """of one pass"""
    repeats: int
    emitting: tuple[int, ...]
    """steps that give a pulse"""

    @classmethod
    def of(cls, table: BoardTable) -> Places:
        """Those of a table."""
        emitting = tuple(i for i, step in enumerate(table.steps) if step.emit)
        return cls(len(table.steps), table.repeats, emitting)

    def slot(self, run: int, step: int) -> int:
        """The slot of a step in a pass."""
        return run * self.steps + step

    def slot_of(self, count: int) -> int:
        """The slot of the pulse before which there were so many."""
        run, place = divmod(count, len(self.emitting))
        return self.slot(run, self.emitting[place])

    def count(self, pulse: Pulse) -> int | None:
        """How many pulses of the run came before; None: it is none of this table's."""
        if pulse.step not in self.emitting or pulse.run >= self.repeats:
            return None
        return pulse.run * len(self.emitting) + self.emitting.index(pulse.step)


class Run:
    """What was heard since `arm`."""

    def __init__(self, number: int, places: Places, source: TriggerSource, clock: BoardClock) -> None:
        """number: how often the board was armed before."""
        self.faults: list[TriggerFault] = []
        self._number, self._places, self._source, self._clock = number, places, source, clock
        self._breaks = clock.fit.breaks
        self._pulses: dict[int, tuple[int, int]] = {}
        """by their count since ARM: slot, and board time (unwrapped)"""
        self._events: dict[int, TriggerEvent] = {}
        """those whose time cannot become more certain: the clock was read after them, or began anew"""
        self._lost: set[int] = set()
        """pulses whose events cannot be had any more"""

    def note(self, message: Message) -> None:
        """Take what the board said by itself."""
        if isinstance(message, Pulse):
            self._take(message)
        elif isinstance(message, RunEnded):
            t_ns = self._clock.at(message.t_us).t_ns
            self._end(message.name, self._places.slot(message.run, message.step), t_ns)
        elif isinstance(message, EventsLost):
            self.faults.append(
                TriggerFault("lost_events", f"{message.count} events came faster than the line can tell them")
            )

    def fetched(self, count: int, pulse: Pulse | None) -> None:
        """Take a pulse that was asked for; None, or another one: it cannot be had."""
        if pulse is not None and self._places.count(pulse) == count:
            self._take(pulse)
            return
        self._lost.add(count)
        slot = self._places.slot_of(count)
        self.faults.append(TriggerFault("lost_events", f"the event of slot {slot} was destroyed on the line", slot))

    def ended(self, fault: str) -> None:
        """Take the fault that the board's state tells: NONE, or one whose message may have been destroyed."""
        if fault in _FAULTS and all(known.kind != _FAULTS[fault] for known in self.faults):
            self._end(fault, None, None)

    def began_anew(self) -> None:
        """The board was reset, and the run is gone."""
        self.faults.append(TriggerFault("reset", "the board began anew: its supply or its reset line was disturbed"))

    @property
    def heard(self) -> int:
        """Pulses that were given, going by the last one heard of."""
        return max(self._pulses, default=-1) + 1

    def missing(self, given: int) -> list[int]:
        """Of so many pulses given: counts of those neither heard of nor lost."""
        return sorted(set(range(given)) - set(self._pulses) - self._lost)

    def events(self) -> list[TriggerEvent]:
        """The pulses on the host's clock, in order, as well as that is known now."""
        return [self._event(count) for count in sorted(self._pulses)]

    def keep(self) -> None:
        """The clock is about to be forgotten: times stay as they are known now."""
        if len(self._clock.fit):
            self._events.update({count: self._event(count) for count in self._pulses})

    def _take(self, pulse: Pulse) -> None:
        count = self._places.count(pulse)
        if count is not None:
            slot = self._places.slot(pulse.run, pulse.step)
            self._pulses[count] = (slot, self._clock.unwrapped(pulse.t_us))

    def _event(self, count: int) -> TriggerEvent:
        if count in self._events:
            return self._events[count]
        slot, board_us = self._pulses[count]
        fit = self._clock.fit
        host = fit.at(board_us)
        # A clock that contradicted itself in this run may have done so before this event, or after it.
        source = Source.HARDWARE if fit.breaks == self._breaks else Source.ESTIMATED
        event = TriggerEvent(self._number, slot, host.t_ns, host.bound_ns + EVENT_NS, source)
        if fit.last_us is not None and fit.last_us > board_us:
            self._events[count] = event
        return event

    def _end(self, fault: str, step: int | None, t_ns: int | None) -> None:
        slot = "a slot" if step is None else f"slot {step}"
        if fault == "NOEDGE":
            text = f"no {self._source.value} edge in time, {slot} did not come"
            self.faults.append(TriggerFault("missing_edge", text, step, t_ns))
        else:
            text = f"the edge that {slot} should begin at came while another slot ran"
            self.faults.append(TriggerFault("overrun", text, step, t_ns))
