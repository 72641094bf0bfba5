"""The serial trigger driver on a board that misbehaves: noise, silence, resets, unplugging; ports it cannot open."""

from __future__ import annotations

import errno
import os
import threading
import time
import tty
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from drivers.serial_trigger import board_clock, driver, ports, transport, trigger_driver
from drivers.serial_trigger.board import SerialTriggerBoard
from drivers.simulated.serial_board_pty import LineFaults, PtyBoard
from scanner.clock import MonotonicClock
from scanner.devices import Source, TableSlot, TriggerEvent, TriggerSource
from scanner.errors import (
    ConfigError,
    DeviceBusy,
    DeviceError,
    DeviceLost,
    DeviceNotFound,
    PermissionDenied,
)

pytestmark = pytest.mark.alone

CLOCK = MonotonicClock()
VSYNC_US = 4_000


@contextmanager
def opened(path: str, options: Mapping[str, Any] | None = None) -> Iterator[SerialTriggerBoard]:
    board = trigger_driver.open(path, options or {}, CLOCK)
    try:
        yield board
    finally:
        board.close()


def slots(count: int, **changes: Any) -> list[TableSlot]:
    given = {"exposure_us": 1_000, "dark_us": 500, "wait_trigger": True, **changes}
    return [TableSlot(image=i, **given) for i in range(count)]


def events_of(board: SerialTriggerBoard, count: int, timeout_s: float = 4.0) -> list[TriggerEvent]:
    deadline = time.monotonic() + timeout_s
    while len(events := list(board.events())) < count and time.monotonic() < deadline:
        time.sleep(0.01)
    return events


def started(board: SerialTriggerBoard, count: int, source: TriggerSource = TriggerSource.VSYNC) -> None:
    board.program(slots(count, wait_trigger=source is not TriggerSource.INTERNAL), source)
    board.arm()


# --- time -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ppm", [-4_500.0, 60.0])
def test_events_are_at_their_true_time_within_their_bound(ppm: float) -> None:
    with PtyBoard(vsync_us=VSYNC_US, clock_ppm=ppm) as there, opened(there.path) as board:
        started(board, 60)
        events = events_of(board, 60)
        rises = [there.host_ns(edge.t_ns) for edge in there.pins if edge.pin == "CAM1" and edge.level]
        assert len(rises) == 60
        for event, true in zip(events, rises, strict=True):
            assert abs(event.t_ns - true) <= event.bound_ns
        fit = board.clock_fit
        assert abs(fit.rate - 1 / (1 + 1e-6 * ppm)) <= fit.rate_bound
        assert fit.rate_bound < 5e-3
        assert fit.breaks == 0
        assert events[0].bound_ns < 2_000_000
        assert {event.source for event in events} == {Source.HARDWARE}


def test_a_clock_that_runs_unevenly_is_noticed(caplog: pytest.LogCaptureFixture) -> None:
    """The board's clock jumps in the middle of a run: times are estimates from then on, and a warning says so."""
    with PtyBoard(vsync_us=VSYNC_US) as there, opened(there.path) as board:
        started(board, 1_000)
        events_of(board, 5)
        there.jump(200_000_000)
        deadline = time.monotonic() + 2
        while board.clock_fit.breaks == 0 and time.monotonic() < deadline:
            board.events()
            time.sleep(0.01)
        assert board.events()[-1].source is Source.ESTIMATED
        assert "does not run evenly" in caplog.text
        board.abort()
        time.sleep(0.02)
        board.arm()
        assert {event.source for event in events_of(board, 3)[:3]} == {Source.HARDWARE}


# --- noise ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 2])
def test_noise_is_recognised_and_answered_by_asking_again(seed: int) -> None:
    faults = LineFaults(flip=0.06, garbage=0.06, seed=seed)
    with PtyBoard(vsync_us=VSYNC_US, faults=faults) as there, opened(there.path) as board:
        table = [slot for i in range(5) for slot in slots(1, exposure_us=1_000 + i)]
        board.program(table, TriggerSource.VSYNC)
        for run in range(2):
            board.arm()
            events = events_of(board, 5)
            assert [(event.sequence, event.step) for event in events] == [(run, step) for step in range(5)]
            assert list(board.faults()) == []
        steps = [edge for edge in there.pins if edge.pin == "CAM1"]
        lengths = [fall.t_ns - rise.t_ns for rise, fall in zip(steps[::2], steps[1::2], strict=True)]
        assert lengths == [1_000_000 + 1_000 * i for i in range(5)] * 2


def test_events_that_noise_took_for_good_are_told() -> None:
    """The board tells again what it still knows, which is the last 32 pulses."""
    with PtyBoard() as there, opened(there.path) as board:
        rest = slots(49, wait_trigger=False, dark_us=100, exposure_us=100)
        board.program([*slots(1, wait_trigger=False, dark_us=50_000), *rest], TriggerSource.INTERNAL)
        board.arm()
        board.fire()
        there.faults = LineFaults(lose=1.0)
        time.sleep(0.1)
        there.faults = LineFaults()
        time.sleep(0.3)
        assert [event.step for event in board.events()] == list(range(18, 50))
        assert [fault.kind for fault in board.faults()] == ["lost_events"] * 18


# --- silence --------------------------------------------------------------------------------------------------------


def test_a_hung_board_is_lost_within_a_second_and_found_again() -> None:
    with PtyBoard(vsync_us=VSYNC_US) as there, opened(there.path) as board:
        started(board, 500)
        events_of(board, 3)
        there.hang()
        since = time.monotonic()
        with pytest.raises(DeviceLost, match="does not answer") as caught:
            events_of(board, 500)
        assert time.monotonic() - since < 1.0
        assert "reset" in str(caught.value.hint)
        there.hang(hung=False)
        board.arm()
        assert len(events_of(board, 3)) >= 3


def test_an_unplugged_board_is_found_again_when_it_is_back(tmp_path: Path) -> None:
    port = tmp_path / "trigger"
    with PtyBoard(vsync_us=VSYNC_US) as there:
        port.symlink_to(there.path)
        board = trigger_driver.open(str(port), {}, CLOCK)
        started(board, 500)
        events_of(board, 2)
    with pytest.raises(DeviceLost):
        events_of(board, 500)
    with pytest.raises(DeviceError):
        board.arm()
    with PtyBoard(vsync_us=VSYNC_US) as there:
        port.unlink()
        port.symlink_to(there.path)
        since = time.monotonic()
        board.arm()
        assert time.monotonic() - since < 5.0
        assert [event.step for event in events_of(board, 3)][:3] == [0, 1, 2]
        board.close()


def test_a_board_that_begins_anew_says_so_and_gets_its_table_again() -> None:
    with PtyBoard(vsync_us=VSYNC_US) as there, opened(there.path) as board:
        started(board, 500)
        events_of(board, 2)
        there.reset()
        deadline = time.monotonic() + 1
        while not board.faults() and time.monotonic() < deadline:
            time.sleep(0.01)
        assert [fault.kind for fault in board.faults()] == ["reset"]
        board.arm()
        events = events_of(board, 3)
        assert [event.step for event in events][:3] == [0, 1, 2]
        assert board.faults() == []


def test_closing_lets_the_outputs_go_low() -> None:
    with PtyBoard(vsync_us=VSYNC_US) as there:
        with opened(there.path) as board:
            board.program(slots(1, exposure_us=2_000_000), TriggerSource.VSYNC)
            board.arm()
            deadline = time.monotonic() + 1
            while not there.pins and time.monotonic() < deadline:
                time.sleep(0.005)
        assert [edge.level for edge in there.pins if edge.pin == "CAM1"] == [1, 0]


# --- ports ----------------------------------------------------------------------------------------------------------


def test_a_port_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(DeviceNotFound, match="no such port") as caught:
        trigger_driver.open(str(tmp_path / "ttyACM7"), {}, CLOCK)
    assert "fringed devices" in str(caught.value.hint)


def test_a_port_that_somebody_else_holds() -> None:
    with PtyBoard() as there, opened(there.path), pytest.raises(DeviceBusy, match="another program") as caught:
        trigger_driver.open(there.path, {}, CLOCK)
    assert "fuser" in str(caught.value.hint)


def test_a_port_that_this_user_may_not_open() -> None:
    with PtyBoard() as there:
        Path(there.path).chmod(0)
        user = os.geteuid()
        try:
            if user == 0:
                os.seteuid(65534)
            with pytest.raises(PermissionDenied) as caught:
                trigger_driver.open(there.path, {}, CLOCK)
        finally:
            os.seteuid(user)
    assert "usermod -aG" in str(caught.value.hint)


@pytest.mark.parametrize("path", ["/dev/null", "/"])
def test_what_is_no_serial_port(path: str) -> None:
    with pytest.raises(ConfigError, match="no serial port"):
        trigger_driver.open(path, {}, CLOCK)


@contextmanager
def stranger(answer: bytes) -> Iterator[str]:
    """A device that says `answer` to whatever comes."""
    master, slave = os.openpty()
    tty.setraw(slave)
    closing = threading.Event()

    def serve() -> None:
        while not closing.is_set():
            if os.read(master, 100) and answer:
                os.write(master, answer)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield os.ttyname(slave)
    finally:
        closing.set()
        os.write(slave, b"\n")
        thread.join()
        os.close(master)
        os.close(slave)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (b"", "does not answer as a trigger board"),
        (b"$GPGGA,092750.000,5321.6802,N\r\n", "lines that are none of its protocol"),
        (b"OK GRBL,1.1\n", "another device answers there: 'GRBL,1.1'"),
        (b"OK fringed,trigger-x,2.0,9\n", "speaks protocol 2.0, this program 1.0"),
    ],
)
def test_another_device_on_the_port(answer: bytes, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "BOOT_S", 0.2)
    monkeypatch.setattr(driver, "KNOCK_S", 0.1)
    with stranger(answer) as path, pytest.raises(DeviceError, match=message) as caught:
        trigger_driver.open(path, {}, CLOCK)
    assert "firmware" in str(caught.value.hint)


def test_a_boot_loader_that_keeps_it_waiting_is_waited_for() -> None:
    with PtyBoard() as there:
        there.hang()
        threading.Timer(0.3, there.hang, kwargs={"hung": False}).start()
        with opened(there.path) as board:
            assert board.identity.startswith("fringed,")


def usb(path: str, vid: int | None, pid: int | None, number: str | None = None) -> SimpleNamespace:
    return SimpleNamespace(device=path, vid=vid, pid=pid, serial_number=number)


def test_boards_are_discovered_by_their_usb_numbers_and_not_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    plugged = [
        usb("/dev/ttyUSB1", 0x1A86, 0x7523),
        usb("/dev/ttyACM0", 0x2341, 0x0043, "8543"),
        usb("/dev/ttyS0", None, None),
        usb("/dev/ttyUSB0", 0x067B, 0x2303),
    ]
    monkeypatch.setattr(ports.list_ports, "comports", lambda: plugged)
    found = trigger_driver.discover()
    assert [(info.device, info.kind) for info in found] == [("/dev/ttyACM0", "trigger"), ("/dev/ttyUSB1", "trigger")]
    assert found[0].details == {"usb": "2341:0043", "serial_number": "8543"}
    assert ports.paths_for("") == ["/dev/ttyACM0", "/dev/ttyUSB1"]
    assert ports.paths_for("serial:8543") == ["/dev/ttyACM0"]
    with pytest.raises(DeviceNotFound, match="serial:1") as caught:
        ports.paths_for("serial:1")
    assert "/dev/ttyACM0 (serial:8543)" in str(caught.value.hint)


def test_nothing_plugged_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports.list_ports, "comports", list)
    assert trigger_driver.discover() == []
    with pytest.raises(DeviceNotFound, match="no trigger board is plugged in"):
        trigger_driver.open("", {}, CLOCK)


def test_of_several_candidates_the_one_that_answers_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    with PtyBoard() as there:
        plugged = [usb("/dev/ttyACM98", 0x2341, 0x0043), usb(there.path, 0x2341, 0x0043)]
        monkeypatch.setattr(ports.list_ports, "comports", lambda: plugged)
        with opened("") as board:
            assert there.path in board.name


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"output": ["CAM1"]}, "unknown option 'output'"),
        ({"outputs": ["CAM3"]}, "CAM3"),
        ({"outputs": []}, "outputs"),
        ({"edge": "up"}, "edge: .*got 'up'"),
        ({"timeout_ms": -1}, "timeout_ms: .*got -1"),
        ({"timeout_ms": 1.5}, "timeout_ms: .*got 1.5"),
    ],
)
def test_options_that_make_no_sense(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        trigger_driver.open("/dev/null", options, CLOCK)


def test_options_reach_the_board() -> None:
    options = {"outputs": ["CAM2", "SYNC"], "edge": "falling", "timeout_ms": 700}
    with PtyBoard() as there, opened(there.path, options) as board:
        started(board, 1)
        there.pulse("VSYNC")
        events_of(board, 1)
        assert {edge.pin for edge in there.pins} == {"CAM2", "SYNC"}
        sent = b"".join(there.received)
        assert b"SEQ:SOURCE VSYNC,FALL*" in sent
        assert b"SEQ:TIMEOUT 700*" in sent


def test_every_way_a_port_can_fail_has_its_error() -> None:
    for number, kind in (
        (errno.EBUSY, DeviceBusy),
        (errno.EAGAIN, DeviceBusy),
        (errno.ENODEV, DeviceNotFound),
        (errno.EACCES, PermissionDenied),
        (errno.EIO, ConfigError),
    ):
        error = transport._cannot_open("/dev/ttyACM0", OSError(number, os.strerror(number)))
        assert type(error) is kind
        assert error.hint


def test_the_clock_is_read_again_in_the_course_of_a_long_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(board_clock, "READ_AGAIN_NS", (20_000_000, 20_000_000))
    with PtyBoard(vsync_us=VSYNC_US) as there, opened(there.path) as board:
        started(board, 40)
        before = len(board.clock_fit)
        events_of(board, 40)
        assert len(board.clock_fit) > before + 5
