"""The simulated world's trigger lines: the board's table, the projector's outputs, and the camera that they fire."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from drivers.simulated import trigger_driver
from scanner.devices import TableSlot, TriggerMode, TriggerSource
from scanner.errors import ConfigError, DeviceBusy, DeviceError
from scanner.trigger_table import board_table
from tests.unit.simulated_bench import SECOND_NS
from tests.unit.trigger_line_bench import DARK_US, REFRESH_NS, TriggeredBench, slots

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
