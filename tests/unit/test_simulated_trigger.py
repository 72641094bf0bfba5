"""The simulated world's trigger lines: the board's table, the projector's outputs, and the camera that they fire."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from drivers.simulated import trigger_driver
from drivers.simulated.gige_time import Edges
from drivers.simulated.table_run import Step, TableRun
from drivers.simulated.trigger_board import SimulatedTriggerBoard
from scanner.devices import TableSlot, TriggerMode, TriggerSource
from scanner.errors import ConfigError, DeviceBusy, DeviceError, DeviceLost
from scanner.trigger_table import board_table
from tests.unit.simulated_bench import SECOND_NS, Bench

REFRESH_NS = 16_666_667
DARK_US, EXPOSURE_US = 4_600, 8_000


class TriggeredBench(Bench):
    """A rig with a trigger board, its camera on the line."""

    def __init__(self, device: str = "quick/board?noise=false&ring=2&buffers=64", **options: Any) -> None:
        super().__init__(device)
        self.board: SimulatedTriggerBoard = trigger_driver.open(device, options, self.clock)

    def armed(self, slots: list[TableSlot], source: TriggerSource = TriggerSource.VSYNC) -> None:
        self.start(TriggerMode.HARDWARE, EXPOSURE_US * 1000)
        self.board.program(slots, source)
        self.board.arm()

    def wait(self, refreshes: float) -> None:
        self.clock.sleep_until(self.clock.now_ns() + round(refreshes * REFRESH_NS))


def slots(count: int, **changes: Any) -> list[TableSlot]:
    given = {"exposure_us": EXPOSURE_US, "dark_us": DARK_US, "wait_trigger": True, **changes}
    return [TableSlot(image=i, **given) for i in range(count)]


# --- the board on the vertical blank ---------------------------------------------------------------------------------


def test_each_slot_fires_the_camera_after_its_vertical_blank() -> None:
    bench = TriggeredBench()
    bench.greys(0)
    flip = bench.projector.show(0)
    bench.armed(slots(24))
    frames = [bench.popped() for _ in range(24)]
    events = bench.board.events()
    assert [event.step for event in events] == list(range(24))
    assert [frame.trigger for frame in frames] == list(range(24))
    line = bench.camera.capabilities.line_latency
    assert line is not None
    for i, (frame, event) in enumerate(zip(frames, events, strict=True)):
        due = flip.t_ns + (i + 1) * REFRESH_NS + DARK_US * 1000
        assert due - 1000 - event.bound_ns <= event.t_ns <= due + 1000 + event.bound_ns
        delay = frame.exposure.start_ns - event.t_ns
        slack = frame.exposure.bound_ns + event.bound_ns
        assert line.low_ns - slack <= delay <= line.high_ns + slack
    assert bench.camera.pop(SECOND_NS) is None
    assert bench.board.faults() == []


def test_the_camera_sees_the_pattern_that_shines_when_it_is_fired() -> None:
    bench = TriggeredBench("quick/board?noise=false")
    values = [0, 80, 160, 255]
    bench.greys(*values, 0)
    bench.projector.show(4)
    bench.armed(slots(4))
    means = []
    for i in range(4):
        bench.projector.show(i)
        bench.wait(0.9)
        means.append(float(bench.popped().pixels.mean()))
    assert means == sorted(means)
    assert means[3] > 5 * means[0]


def test_ten_thousand_slots_at_120_hz_lose_no_frame() -> None:
    """10,000 frames in virtual time, popped in lumps as a host that is late does."""
    bench = TriggeredBench("quick/board?noise=false&ring=2&buffers=64&refresh_ns=8333333&readout_us=500")
    bench.start(TriggerMode.HARDWARE, 3_000_000)
    bench.board.program(slots(10_000, exposure_us=2_000, dark_us=1_000), TriggerSource.VSYNC)
    bench.board.arm()
    frames = []
    while len(frames) < 10_000:
        bench.clock.sleep_until(bench.clock.now_ns() + 40 * 8_333_333)
        while (frame := bench.camera.pop(0)) is not None:
            frames.append((frame.frame_id, frame.trigger))
    assert frames == [(i, i) for i in range(10_000)]
    assert len(bench.board.events()) == 10_000


def test_a_pattern_that_stays_on_takes_every_second_edge() -> None:
    bench = TriggeredBench()
    bench.armed(slots(6, edges=2, dark_us=6_000, exposure_us=16_000))
    starts = np.diff([bench.popped().exposure.start_ns for _ in range(6)])
    assert np.abs(starts - 2 * REFRESH_NS).max() < 5_000


def test_slots_that_do_not_wait_follow_one_another() -> None:
    bench = TriggeredBench(clock_ppm=0.0)
    bench.armed(slots(1, exposure_us=1_000) + slots(2, exposure_us=1_000, dark_us=14_000, wait_trigger=False))
    starts = np.diff([bench.popped().exposure.start_ns for _ in range(3)])
    assert np.abs(starts - 15_000_000).max() < 5_000


def test_source_int_runs_from_fire_on() -> None:
    bench = TriggeredBench(clock_ppm=100.0)
    bench.armed(slots(100, wait_trigger=False, dark_us=8_000), TriggerSource.INTERNAL)
    bench.wait(10)
    assert bench.camera.pop(0) is None
    bench.board.fire()
    fired = bench.clock.now_ns()
    starts = [bench.popped().exposure.start_ns for _ in range(100)]
    assert starts[0] - fired == pytest.approx(8_000_000, abs=20_000)
    assert starts[99] - starts[0] == pytest.approx(99 * 16_000_000 * (1 + 100e-6), abs=5_000)


def test_a_slot_without_a_trigger_gives_no_pulse_and_no_event() -> None:
    bench = TriggeredBench()
    bench.armed(slots(2) + slots(1, emit_trigger=False) + slots(1))
    frames = [bench.popped() for _ in range(3)]
    assert frames[2].exposure.start_ns - frames[1].exposure.start_ns == pytest.approx(2 * REFRESH_NS, abs=5_000)
    assert [event.step for event in bench.board.events()] == [0, 1, 3]


# --- states ---------------------------------------------------------------------------------------------------------


def test_a_look_at_the_line_from_another_thread_takes_no_edge_from_a_new_run() -> None:
    """As the relay of light to a camera in another process looks."""
    bench = TriggeredBench()
    bench.greys(0)
    flip = bench.projector.show(0)
    bench.armed(slots(3))
    looking, go_on, lines = threading.Event(), threading.Event(), bench.board._world.lines
    vsync = lines["vsync"]

    class Slow:
        def next_edge(self, after_ns: int) -> int | None:
            if not looking.is_set():
                looking.set()
                go_on.wait(5)
            return vsync.next_edge(after_ns)

    lines["vsync"] = Slow()
    look = threading.Thread(target=bench.board.next_edge, args=(flip.t_ns,))
    look.start()
    assert looking.wait(5)
    anew = threading.Thread(target=lambda: (bench.board.abort(), bench.board.arm()))
    anew.start()
    anew.join(0.05)
    go_on.set()
    look.join()
    anew.join()
    bench.wait(2)
    assert bench.board.events()[0].t_ns < flip.t_ns + 2 * REFRESH_NS


def test_abort_stops_the_pulses_and_keeps_the_table() -> None:
    bench = TriggeredBench()
    bench.armed(slots(100))
    for _ in range(5):
        bench.popped()
    bench.board.abort()
    given = len(bench.board.events())
    assert bench.camera.pop(SECOND_NS) is None
    assert len(bench.board.events()) == given
    bench.board.arm()
    bench.popped()
    assert [event.sequence for event in bench.board.events()] == [1]


def test_a_run_under_way_is_not_disturbed() -> None:
    bench = TriggeredBench()
    bench.armed(slots(3))
    for call in (bench.board.arm, lambda: bench.board.program(slots(2), TriggerSource.VSYNC)):
        with pytest.raises(DeviceBusy):
            call()
    bench.wait(5)
    bench.board.program(slots(2), TriggerSource.VSYNC)
    bench.board.arm()


def test_what_makes_no_sense_is_refused() -> None:
    bench = TriggeredBench()
    with pytest.raises(DeviceError, match="nothing is programmed"):
        bench.board.arm()
    bench.board.program(slots(2), TriggerSource.VSYNC)
    with pytest.raises(DeviceError, match="not INT"):
        bench.board.fire()
    bench.board.program(slots(2, wait_trigger=False), TriggerSource.INTERNAL)
    with pytest.raises(DeviceError, match="not armed"):
        bench.board.fire()


def test_a_board_is_held_by_one_and_closes_twice() -> None:
    bench = TriggeredBench()
    with pytest.raises(DeviceBusy):
        trigger_driver.open("quick/board?noise=false&ring=2&buffers=64", {}, bench.clock)
    bench.armed(slots(50))
    bench.popped()
    bench.board.close()
    bench.board.close()
    assert bench.camera.pop(SECOND_NS) is None
    with pytest.raises(DeviceError):
        bench.board.arm()


# --- the camera on the line ------------------------------------------------------------------------------------------


def test_a_busy_camera_drops_the_pulse_and_its_counter_shows_it() -> None:
    bench = TriggeredBench()
    pulse = {"exposure_us": 500}
    bench.armed(slots(3, **pulse) + slots(1, wait_trigger=False, dark_us=1_000, **pulse) + slots(3, **pulse))
    frames = [bench.popped() for _ in range(6)]
    assert [frame.frame_id for frame in frames] == list(range(6))
    assert [frame.trigger for frame in frames] == [0, 1, 2, 4, 5, 6]
    assert bench.camera.pop(SECOND_NS) is None


def test_a_latched_pulse_starts_a_late_exposure() -> None:
    bench = TriggeredBench("quick/board?noise=false&ring=2&latch=true")
    pulse = {"exposure_us": 500}
    bench.armed(slots(1, **pulse) + slots(1, wait_trigger=False, dark_us=1_000, **pulse) + slots(1, **pulse))
    frames = [bench.popped() for _ in range(3)]
    events = bench.board.events()
    late = frames[1].exposure.start_ns - events[1].t_ns
    period = bench.camera.capabilities.min_period_ns(EXPOSURE_US * 1000)
    assert late == pytest.approx(period - (events[1].t_ns - events[0].t_ns), abs=20_000)
    assert frames[1].exposure.start_ns - frames[0].exposure.start_ns >= period - 2_000


def test_a_spurious_pulse_beside_a_dropped_one_shows_in_the_counter_alone() -> None:
    bench = TriggeredBench(spurious=[3], drop_pulses=[6])
    bench.armed(slots(10))
    frames = [bench.popped() for _ in range(9)]
    assert bench.camera.pop(SECOND_NS) is None
    assert [frame.trigger for frame in frames] == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert len(bench.board.events()) == 10


def test_edges_from_before_the_start_are_not_taken() -> None:
    bench = TriggeredBench()
    bench.board.program(slots(5), TriggerSource.VSYNC)
    bench.board.arm()
    bench.wait(2.9)
    bench.start(TriggerMode.HARDWARE, 1_000_000)
    assert len(list(iter(lambda: bench.camera.pop(SECOND_NS // 5), None))) in (2, 3)


@pytest.mark.parametrize("output", ["frame", "exposure"])
def test_the_projectors_own_output_fires_the_camera(output: str) -> None:
    bench = TriggeredBench(f"quick/board?noise=false&bits=12&modulation=none&trigger_outputs={output}&line={output}")
    assert bench.projector.capabilities.trigger_outputs == {output}
    bench.greys(0, 255)
    bench.start(TriggerMode.HARDWARE, EXPOSURE_US * 1000)
    flips = [bench.projector.show(i % 2) for i in range(4)]
    bench.wait(0.9)
    latency = bench.projector.capabilities.latency
    assert latency is not None
    means = []
    for flip in flips:
        frame = bench.popped()
        delay = frame.exposure.start_ns - flip.t_ns
        assert latency.low_ns <= delay <= latency.high_ns + 12_000
        means.append(frame.pixels.mean())
    assert min(means[1], means[3]) > 5 * max(means[0], means[2])


def test_the_projectors_output_starts_the_boards_slots() -> None:
    bench = TriggeredBench("quick/board?ring=2&trigger_outputs=exposure")
    bench.greys(0, 255)
    bench.armed(slots(2, dark_us=500), TriggerSource.EXTERNAL)
    bench.wait(30)
    assert bench.camera.pop(0) is None
    assert bench.board.faults() == []
    for i in range(2):
        flip = bench.projector.show(i)
        bench.wait(0.9)
        delay = bench.popped().exposure.start_ns - flip.t_ns
        latency = bench.projector.capabilities.latency
        assert latency is not None
        assert latency.low_ns + 500_000 <= delay <= latency.high_ns + 520_000


# --- faults ---------------------------------------------------------------------------------------------------------


def test_a_missing_vertical_blank_ends_the_run_and_is_reported() -> None:
    bench = TriggeredBench(source_ends_after=4)
    bench.armed(slots(10))
    for _ in range(4):
        bench.popped()
    assert bench.board.faults() == []
    assert bench.camera.pop(SECOND_NS) is None
    (fault,) = bench.board.faults()
    assert (fault.kind, fault.step) == ("missing_edge", 4)
    bench.board.arm()


def test_a_slot_longer_than_its_refresh_is_an_overrun() -> None:
    bench = TriggeredBench()
    bench.armed(slots(5, exposure_us=14_000))
    bench.popped()
    assert bench.camera.pop(SECOND_NS) is None
    (fault,) = bench.board.faults()
    assert (fault.kind, fault.step) == ("overrun", 1)


def test_without_a_projector_no_blank_comes() -> None:
    bench = TriggeredBench()
    bench.projector.close()
    bench.armed(slots(2))
    bench.wait(20)
    assert [fault.kind for fault in bench.board.faults()] == ["missing_edge"]


def test_lost_events_are_told() -> None:
    bench = TriggeredBench(lose_events=[1])
    bench.armed(slots(3))
    bench.wait(5)
    assert [event.step for event in bench.board.events()] == [0, 2]
    assert [fault.kind for fault in bench.board.faults()] == ["lost_events"]


def test_an_unplugged_board_is_lost() -> None:
    bench = TriggeredBench(unplug_after=3)
    bench.armed(slots(6))
    for _ in range(3):
        bench.popped()
    assert bench.camera.pop(SECOND_NS) is None
    with pytest.raises(DeviceLost):
        bench.board.events()
    bench.board.close()


# --- tables ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("table", "source", "message"),
    [
        ([], TriggerSource.VSYNC, "no slots"),
        (slots(2, dark_us=10), TriggerSource.VSYNC, "slot 0: dark_us is 10, it must lie in 50"),
        (slots(2, exposure_us=10**8), TriggerSource.VSYNC, "exposure_us is 100000000"),
        (slots(2, wait_trigger=False), TriggerSource.VSYNC, "first slot must wait"),
        (slots(2), TriggerSource.INTERNAL, "waits for a trigger, and source INT"),
        (slots(2, edges=0), TriggerSource.VSYNC, "edges is 0"),
        ([*slots(64), *slots(1, dark_us=60)], TriggerSource.VSYNC, "65 different steps"),
        (slots(70_000), TriggerSource.VSYNC, "70000 times"),
    ],
)
def test_tables_that_do_not_fit_are_refused(table: list[TableSlot], source: TriggerSource, message: str) -> None:
    bench = TriggeredBench()
    with pytest.raises(ConfigError, match=message):
        bench.board.program(table, source)


def test_a_long_table_is_folded_into_its_shortest_repetition() -> None:
    bench = TriggeredBench()
    block = [*slots(2), *slots(1, emit_trigger=False)]
    folded = board_table(block * 40, TriggerSource.VSYNC, bench.board.capabilities, "board")
    assert (len(folded.steps), folded.repeats, len(folded)) == (3, 40, 120)
    whole = board_table([*block, *slots(1)], TriggerSource.VSYNC, bench.board.capabilities, "board")
    assert (len(whole.steps), whole.repeats) == (4, 1)


# --- the run, by itself -----------------------------------------------------------------------------------------------


def test_an_edge_that_comes_while_steps_follow_is_not_counted_twice() -> None:
    run = TableRun([Step(10, 10, 1, 1), Step(100, 10, 1, 0), Step(10, 10, 1, 1)], 1, internal=False, armed_ns=0)
    run.edge(100)
    assert run.follow()
    run.edge(150)
    assert run.fault is not None
    assert (run.fault.name, run.fault.step) == ("OVERRUN", 2)


def test_a_run_without_end_goes_on() -> None:
    run = TableRun([Step(10, 10, 1, 1)], 0, internal=False, armed_ns=0, timeout_ns=100)
    for t in range(50, 5_000, 50):
        run.edge(t)
    assert len(run.pulses) == 99
    assert run.over_ns is None
    run.check_time(5_100)
    assert run.fault is not None
    assert run.over_ns == 5_050


def test_a_stop_takes_back_what_was_reckoned_ahead() -> None:
    run = TableRun([Step(10, 10, 1, 1)], 5, internal=False, armed_ns=0)
    run.edge(100)
    run.edge(115)
    assert run.fault is not None
    run.stop(112)
    assert run.fault is None
    assert run.pulses[0].fall_ns == 112
    run.stop(105)
    assert run.pulses == []


def test_a_counter_that_has_forgotten_edges_still_counts_them() -> None:
    seen = Edges()
    for t in range(10):
        seen.add(t)
    seen.reset(4)
    assert [seen.count(t) for t in (3, 4, 9)] == [0, 1, 6]
    for t in range(10, 10_000):
        seen.add(t)
    assert [seen.count(t) for t in (9_000, 9_999)] == [8_997, 9_996]
    assert len(seen._times) < 3_000
