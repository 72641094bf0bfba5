"""The real firmware, to the cycle: golden files, jitter, full tables, overload, aborts and the clock's wrap."""

from __future__ import annotations

import itertools
import re

import numpy as np
import pytest

from tests.firmware.simavr import MHZ, Log, Simavr, run
from tests.trigger_golden import Golden, actions, differences, golden_files

REFRESH_US = 16_667

Action = tuple[float, str, object]


def sent(*lines: str, at_us: float = 20_000, every_us: float = 8_000) -> list[Action]:
    return [(at_us + i * every_us, "bytes", line.encode() + b"\n") for i, line in enumerate(lines)]


def vsync(first_us: float, count: int, every_us: float = REFRESH_US) -> list[Action]:
    edges = [first_us + i * every_us for i in range(count)]
    return [(t, "VSYNC", 1) for t in edges] + [(t + 100, "VSYNC", 0) for t in edges]


def answers(log: Log) -> list[str]:
    return [line for _, line in log.lines if not line.startswith("!")]


def said(log: Log) -> list[str]:
    return [line for _, line in log.lines if line.startswith("!")][1:]


@pytest.mark.parametrize("file", golden_files(), ids=lambda file: file.name)
def test_the_firmware_keeps_the_golden_files(simavr: Simavr, file: Golden) -> None:
    assert differences(file, run(simavr, actions(file), file.end_us).transcript()) == []


@pytest.mark.parametrize("dark_us", [50, 51, 333, 4_600, 33_000, 40_000])
def test_pulses_follow_their_edge_to_the_cycle(
    simavr: Simavr, dark_us: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """Edges at any phase of the timer, while the line is kept busy: what is left is the timer's tick of half a us."""
    count = 60
    rng = np.random.default_rng(dark_us)
    every = max(10_000, dark_us + 2_000)
    edges = [60_000 + i * every + int(t) / MHZ for i, t in enumerate(rng.integers(0, 16_000, count))]
    script = sent(
        "SEQ:CLEAR", f"SEQ:ADD {dark_us},500,15", "SEQ:SOURCE VSYNC", f"SEQ:REPEAT {count}", "ARM", every_us=7000
    )
    script += [action for t in edges for action in ((t, "VSYNC", 1), (t + 100, "VSYNC", 0))]
    script += [(edges[0] + i * 4_100, "bytes", b"TIME?*F8\n") for i in range(int(count * every / 4_200))]
    log = run(simavr, script, edges[-1] + 100_000)
    seen, rises, falls = log.rises("VSYNC"), log.rises("CAM1"), log.falls("CAM1")
    assert len(seen) == len(rises) == len(falls) == count
    assert rises == log.rises("CAM2")
    ticks = [(cycle - log.started) // 8 + 2 * dark_us for cycle in seen]
    assert rises == [log.started + 8 * tick for tick in ticks]
    assert falls == [rise + 500 * MHZ for rise in rises]
    late = np.array(rises) - np.array(seen) - dark_us * MHZ
    sync = np.array(log.rises("SYNC")) - np.array(rises)
    assert np.ptp(late) < 2 * MHZ
    assert sync.max() < 40 * MHZ
    with capsys.disabled():
        print(
            f"\n  delay {dark_us} us: camera line {late.min() / MHZ:+.3f} .. {late.max() / MHZ:+.3f} us from its edge, "
            f"jitter {np.ptp(late) / MHZ:.3f} us; SYNC follows by {sync.min() / MHZ:.1f} .. {sync.max() / MHZ:.1f} us",
            end="",
        )


def test_event_times_are_those_of_the_pins(simavr: Simavr) -> None:
    script = sent("SEQ:CLEAR", "SEQ:ADD 4600,500,1", "SEQ:SOURCE VSYNC", "SEQ:REPEAT 20", "ARM")
    log = run(simavr, script + vsync(70_000, 20), 500_000)
    told = [int(line.split()[3]) for line in said(log)]
    counted = [(rise - log.started) // MHZ for rise in log.rises("CAM1")]
    assert told == counted
    assert len(told) == 20


def test_a_full_table_of_different_steps(simavr: Simavr) -> None:
    steps = [(50 + 3 * i, 3_000 + 7 * i, 1 + i % 15) for i in range(64)]
    lines = [f"SEQ:ADD {dark},{exposure},{outputs}" for dark, exposure, outputs in steps]
    script = sent("SEQ:CLEAR", *lines, "SEQ:ADD 50,50,1", "SEQ:LEN?", "SEQ:REPEAT 2", "ARM", "FIRE", every_us=5_000)
    log = run(simavr, script, 20_000 + 5_000 * 70 + 2 * 64 * 3_500 + 50_000)
    assert answers(log)[-5:] == ["ERR 5,full", "OK 64", "OK", "OK", "OK"]
    expected: dict[str, list[int]] = {"CAM1": [], "CAM2": []}
    t = 0
    for dark, exposure, outputs in steps * 2:
        for pin, bit in (("CAM1", 1), ("CAM2", 2)):
            if outputs & bit:
                expected[pin] += [t + dark * MHZ, t + (dark + exposure) * MHZ]
        t += (dark + exposure) * MHZ
    first = log.rises("CAM1")[0] - expected["CAM1"][0]
    for pin, edges in expected.items():
        assert [cycle - first for cycle, name, _ in log.pins if name == pin] == edges
    assert len(said(log)) == 128


def test_events_that_come_too_fast_are_counted_not_forgotten(simavr: Simavr) -> None:
    script = sent("SEQ:CLEAR", "SEQ:ADD 50,50,1", "SEQ:REPEAT 600", "ARM", "FIRE")
    log = run(simavr, [*script, *sent("STAT?", at_us=400_000)], 500_000)
    assert len(log.rises("CAM1")) == 600
    assert set(np.diff(log.rises("CAM1"))) == {100 * MHZ}
    assert answers(log)[-1] == "OK IDLE 600 NONE"
    events = [line for line in said(log) if line.startswith("!EVT")]
    lost = sum(int(line.split()[2]) for line in said(log) if line.startswith("!FAULT LOST"))
    assert len(events) + lost == 600
    assert lost > 0
    runs = [int(line.split()[1]) for line in events]
    assert runs == sorted(set(runs))


def test_abort_works_while_the_line_is_flooded(simavr: Simavr) -> None:
    script = sent("SEQ:CLEAR", "SEQ:ADD 4600,8000,15", "SEQ:SOURCE VSYNC", "SEQ:REPEAT 0", "ARM")
    script += vsync(70_000, 40)
    rng = np.random.default_rng(1)
    noise = bytes(int(byte) for byte in rng.integers(0, 256, 3_000) if byte not in (0x0A, 0x18))
    script += [(360_000, "bytes", noise + b"\x18")]
    log = run(simavr, script, 800_000)
    for pin in ("CAM1", "CAM2", "SYNC", "LED"):
        assert len(log.rises(pin)) == 18
        assert log.falls(pin)[-1] - log.started <= (360_000 + 50) * MHZ
    assert log.falls("CAM1")[-1] - log.rises("CAM1")[-1] < 8_000 * MHZ


def test_a_flooded_line_is_told_and_the_next_one_is_whole(simavr: Simavr) -> None:
    log = run(simavr, [(120_000, "bytes", b"A" * 1000 + b"\nSEQ:LEN?\n")], 200_000)
    assert answers(log) == ["ERR 6,line", "OK 0"]


def test_outputs_are_low_from_the_start(simavr: Simavr) -> None:
    log = run(simavr, [(50_000, "VSYNC", 1), (60_000, "EXT", 1)], 200_000)
    assert log.pins == []
    assert [line for _, line in log.lines] == ["!EVT READY"]


def test_a_run_without_end_until_abort(simavr: Simavr) -> None:
    script = sent("SEQ:CLEAR", "SEQ:ADD 1000,2000,1", "SEQ:SOURCE VSYNC", "SEQ:REPEAT 0", "ARM")
    script += vsync(70_000, 600, 5_000)
    log = run(simavr, [*script, *sent("ABORT", at_us=3_000_000)], 3_200_000)
    rises = np.array(log.rises("CAM1"))
    assert len(rises) == 586
    assert np.abs(np.diff(rises) - 5_000 * MHZ).max() <= 12
    assert answers(log)[-1] == "OK"


def test_the_clock_wraps_and_a_run_goes_on_across_it(simavr: Simavr) -> None:
    """71.6 min of simulated time; the chip sleeps through most of it."""
    wrap = 2**32
    script = sent("SEQ:CLEAR", "SEQ:ADD 1000,2000,1", "SEQ:SOURCE VSYNC", "SEQ:REPEAT 10", "TIME?")
    script += sent("ARM", at_us=wrap - 60_000) + vsync(wrap - 45_000, 10, 10_000)
    script += sent("TIME?", at_us=wrap + 100_000)
    log = run(simavr, script, wrap + 120_000)
    times = [int(line.split()[3]) for line in said(log)]
    steps = [(after - before) % wrap for before, after in itertools.pairwise(times)]
    assert len(times) == 10
    assert times[0] > times[-1]
    assert all(abs(step - 10_000) <= 1 for step in steps)
    first, last = (int(re.sub(r"\D", "", line)) for line in answers(log) if re.fullmatch(r"OK \d{3,}", line))
    assert first == pytest.approx(52_000, abs=100)
    assert last == pytest.approx(100_000, abs=100)
