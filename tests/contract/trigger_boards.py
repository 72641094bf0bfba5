"""The contract of trigger boards, as a test class: see `suite`."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

from scanner.clock import Clock
from scanner.devices import (
    TableSlot,
    TriggerBoard,
    TriggerEvent,
    TriggerFault,
    TriggerSource,
)
from scanner.errors import ConfigError, DeviceBusy, DeviceError, DeviceLost

SECOND_NS = 1_000_000_000


@dataclass
class TriggerBench:
    """An open, idle trigger board, a vertical blank beating on its input VSYNC."""

    board: TriggerBoard
    clock: Clock
    refresh_ns: int
    stop_vsync: Callable[[], None]
    """no further vertical blank comes"""
    unplug: Callable[[], None] | None
    """the board is gone at once; None where the bench cannot"""
    uneven_ns: int = 0
    """by which the board's own time may be off: a chip simulated in real time stands still while others compute"""

    def wait(self, ns: int) -> None:
        """Let time pass."""
        self.clock.sleep_until(self.clock.now_ns() + ns)

    def events(self, count: int, timeout_ns: int = 3 * SECOND_NS) -> list[TriggerEvent]:
        """The run's events, once there are `count`, or when they should have come."""
        deadline = self.clock.now_ns() + timeout_ns
        while len(events := list(self.board.events())) < count and self.clock.now_ns() < deadline:
            self.wait(SECOND_NS // 100)
        return events

    def run(self, slots: list[TableSlot], source: TriggerSource, pulses: int) -> list[TriggerEvent]:
        """Program, arm, fire where that is needed, and the events."""
        self.board.program(slots, source)
        self.board.arm()
        if source is TriggerSource.INTERNAL:
            self.board.fire()
        return self.events(pulses)


class TriggerContract:
    """What every `TriggerBoard` keeps."""

    def test_is_a_board_with_sane_capabilities(self, bench: TriggerBench) -> None:
        c = bench.board.capabilities
        assert isinstance(bench.board, TriggerBoard)
        assert bench.board.name
        assert c.sources
        assert c.max_steps > 0
        assert c.max_repeats > 0
        assert 0 < c.dark_min_us < c.time_max_us
        assert 0 < c.exposure_min_us < c.time_max_us
        assert c.jitter_ns >= 0
        assert list(bench.board.events()) == []
        assert list(bench.board.faults()) == []

    def test_its_own_timer_runs_the_table_from_fire_on(self, bench: TriggerBench) -> None:
        slots = self._slots(6, dark_us=7_000, exposure_us=3_000, wait_trigger=False)
        bench.board.program(slots, TriggerSource.INTERNAL)
        bench.board.arm()
        bench.wait(SECOND_NS // 50)
        assert list(bench.board.events()) == []
        called = bench.clock.now_ns()
        bench.board.fire()
        returned = bench.clock.now_ns()
        events = bench.events(6)
        first = events[0]
        slack = first.bound_ns + bench.board.capabilities.jitter_ns + bench.uneven_ns
        assert called + 7_000_000 - slack <= first.t_ns <= returned + 7_000_000 + slack + SECOND_NS // 100
        self._spaced(bench, events, [10_000_000] * 5)
        assert list(bench.board.faults()) == []

    def test_each_slot_follows_its_vertical_blank(self, bench: TriggerBench) -> None:
        events = bench.run(self._slots(8), TriggerSource.VSYNC, 8)
        assert [event.step for event in events] == list(range(8))
        self._spaced(bench, events, [bench.refresh_ns] * 7)
        bench.wait(3 * bench.refresh_ns)
        assert len(bench.board.events()) == 8
        assert list(bench.board.faults()) == []

    def test_edges_are_counted_from_the_one_that_began_the_slot_before(self, bench: TriggerBench) -> None:
        slots = self._slots(3, edges=2, exposure_us=bench.refresh_ns // 1000)
        self._spaced(bench, bench.run(slots, TriggerSource.VSYNC, 3), [2 * bench.refresh_ns] * 2)

    def test_slots_that_do_not_wait_follow_the_one_before(self, bench: TriggerBench) -> None:
        slots = [*self._slots(1, exposure_us=500), *self._slots(2, exposure_us=500, wait_trigger=False)]
        self._spaced(bench, bench.run(slots, TriggerSource.VSYNC, 3), [2_500_000] * 2)

    def test_a_slot_that_emits_nothing_has_no_event(self, bench: TriggerBench) -> None:
        slots = self._slots(4, exposure_us=500)
        slots[1] = self._slots(1, exposure_us=500, emit_trigger=False)[0]
        events = bench.run(slots, TriggerSource.VSYNC, 3)
        assert [event.step for event in events] == [0, 2, 3]
        self._spaced(bench, events, [2 * bench.refresh_ns, bench.refresh_ns])

    def test_a_table_longer_than_its_memory_runs_if_it_repeats(self, bench: TriggerBench) -> None:
        count = 2 * bench.board.capabilities.max_steps + 2
        slots = self._slots(count, wait_trigger=False, dark_us=1_500, exposure_us=1_000)
        events = bench.run(slots, TriggerSource.INTERNAL, count)
        assert [event.step for event in events] == list(range(count))
        self._spaced(bench, events, [2_500_000] * (count - 1))

    def test_event_times_are_known_with_a_bound(self, bench: TriggerBench) -> None:
        for event in bench.run(self._slots(3), TriggerSource.VSYNC, 3):
            assert 0 < event.bound_ns < SECOND_NS // 50
            assert event.t_ns - event.bound_ns <= bench.clock.now_ns() + bench.uneven_ns

    def test_runs_are_numbered_and_forget_the_one_before(self, bench: TriggerBench) -> None:
        assert [event.sequence for event in bench.run(self._slots(2), TriggerSource.VSYNC, 2)] == [0, 0]
        bench.wait(bench.refresh_ns)
        bench.board.arm()
        events = bench.events(2)
        assert [(event.sequence, event.step) for event in events] == [(1, 0), (1, 1)]

    def test_tables_it_cannot_run_are_refused(self, bench: TriggerBench) -> None:
        c = bench.board.capabilities
        for slots, source in (
            ([], TriggerSource.VSYNC),
            (self._slots(1, dark_us=c.dark_min_us - 1), TriggerSource.VSYNC),
            (self._slots(1, exposure_us=c.exposure_min_us - 1), TriggerSource.VSYNC),
            (self._slots(1, exposure_us=c.time_max_us + 1), TriggerSource.VSYNC),
            (self._slots(1, edges=0), TriggerSource.VSYNC),
            (self._slots(1, wait_trigger=False), TriggerSource.VSYNC),
            (self._slots(1), TriggerSource.INTERNAL),
            ([*self._slots(c.max_steps), *self._slots(1, exposure_us=60)], TriggerSource.VSYNC),
        ):
            with pytest.raises(ConfigError):
                bench.board.program(slots, source)

    def test_arm_and_fire_need_what_comes_before_them(self, bench: TriggerBench) -> None:
        with pytest.raises(DeviceError):
            bench.board.arm()
        bench.board.program(self._slots(2, wait_trigger=False), TriggerSource.INTERNAL)
        with pytest.raises(DeviceError):
            bench.board.fire()
        bench.board.program(self._slots(2), TriggerSource.VSYNC)
        with pytest.raises(DeviceError):
            bench.board.fire()

    def test_a_run_under_way_is_not_disturbed(self, bench: TriggerBench) -> None:
        bench.board.program(self._slots(500), TriggerSource.VSYNC)
        bench.board.arm()
        bench.events(2)
        with pytest.raises(DeviceBusy):
            bench.board.arm()
        with pytest.raises(DeviceBusy):
            bench.board.program(self._slots(1), TriggerSource.VSYNC)
        assert len(bench.events(6)) >= 6

    def test_abort_stops_the_run_and_keeps_the_table(self, bench: TriggerBench) -> None:
        bench.board.abort()
        bench.board.program(self._slots(500), TriggerSource.VSYNC)
        bench.board.arm()
        bench.events(3)
        bench.board.abort()
        given = len(bench.board.events())
        bench.wait(3 * bench.refresh_ns)
        assert len(bench.board.events()) == given
        bench.board.arm()
        assert len(bench.events(2)) >= 2
        bench.board.abort()

    def test_a_slot_longer_than_its_refresh_ends_the_run_as_an_overrun(self, bench: TriggerBench) -> None:
        bench.board.program(self._slots(5, exposure_us=bench.refresh_ns // 1000), TriggerSource.VSYNC)
        bench.board.arm()
        faults = self._faults(bench)
        assert [(fault.kind, fault.step) for fault in faults] == [("overrun", 1)]
        assert len(bench.board.events()) == 1
        # The same table would overrun again within two refreshes, before a busy host has asked.
        bench.board.program(self._slots(1), TriggerSource.VSYNC)
        bench.board.arm()
        assert list(bench.board.faults()) == []
        bench.board.abort()

    def test_a_missing_vertical_blank_ends_the_run(self, bench: TriggerBench) -> None:
        bench.board.program(self._slots(500), TriggerSource.VSYNC)
        bench.board.arm()
        bench.events(2)
        bench.stop_vsync()
        faults = self._faults(bench)
        given = len(bench.board.events())
        assert [(fault.kind, fault.step) for fault in faults] == [("missing_edge", given)]
        bench.board.program(self._slots(1), TriggerSource.VSYNC)

    def test_an_unplugged_board_is_lost_within_a_second(self, bench: TriggerBench) -> None:
        if bench.unplug is None:
            return
        bench.board.program(self._slots(500), TriggerSource.VSYNC)
        bench.board.arm()
        bench.events(2)
        bench.unplug()
        gone = bench.clock.now_ns()
        lost: DeviceLost | None = None
        while lost is None and bench.clock.now_ns() < gone + 2 * SECOND_NS:
            try:
                bench.board.events()
            except DeviceLost as error:
                lost = error
            bench.wait(SECOND_NS // 100)
        assert lost is not None
        assert lost.hint
        assert bench.clock.now_ns() - gone < SECOND_NS
        with pytest.raises(DeviceLost):
            bench.board.faults()

    def test_closes_twice_and_then_refuses(self, bench: TriggerBench) -> None:
        bench.board.program(self._slots(500), TriggerSource.VSYNC)
        bench.board.arm()
        bench.board.close()
        bench.board.close()
        for call in (bench.board.arm, bench.board.fire, bench.board.abort, bench.board.events, bench.board.faults):
            with pytest.raises(DeviceError):
                call()

    @staticmethod
    def _slots(count: int, **changes: Any) -> list[TableSlot]:
        given: dict[str, Any] = {"exposure_us": 3_000, "dark_us": 2_000, "wait_trigger": True, **changes}
        return [TableSlot(image=i, **given) for i in range(count)]

    @staticmethod
    def _spaced(bench: TriggerBench, events: list[TriggerEvent], wanted_ns: list[int]) -> None:
        """Events follow one another at these distances, to their bounds, the board's jitter and 100 ppm."""
        assert len(events) == len(wanted_ns) + 1
        for wanted, (before, after) in zip(wanted_ns, itertools.pairwise(events), strict=True):
            slack = before.bound_ns + after.bound_ns + 2 * bench.board.capabilities.jitter_ns + wanted // 10_000
            slack += bench.uneven_ns
            assert abs(after.t_ns - before.t_ns - wanted) <= slack

    @staticmethod
    def _faults(bench: TriggerBench) -> list[TriggerFault]:
        """The faults, once there are any."""
        deadline = bench.clock.now_ns() + 2 * SECOND_NS
        while not (faults := list(bench.board.faults())) and bench.clock.now_ns() < deadline:
            bench.wait(SECOND_NS // 100)
        return faults
