"""The simulated camera on a trigger line: in step with the board, with the faults of real lines; a table's run."""

from __future__ import annotations

import pytest

from drivers.simulated.gige_time import Edges
from drivers.simulated.table_run import Step, TableRun
from scanner.devices import TriggerMode, TriggerSource
from scanner.errors import DeviceLost
from tests.unit.simulated_bench import SECOND_NS
from tests.unit.trigger_line_bench import EXPOSURE_US, TriggeredBench, slots

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
