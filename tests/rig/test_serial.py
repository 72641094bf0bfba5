"""The trigger board's driver on the kernel's own USB serial line: a simulated board talks on the gadget's end of it."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from drivers.serial_trigger import trigger_driver
from drivers.serial_trigger.board import SerialTriggerBoard
from drivers.simulated.serial_board_pty import PtyBoard
from scanner.clock import MonotonicClock
from scanner.devices import TableSlot, TriggerSource
from scanner.errors import DeviceLost, DeviceNotFound
from tests.rig.punctual import ATTEMPTS, punctual

HOST, GADGET = "/dev/ttyACM0", "/dev/ttyGS0"
NUMBER = "RIG1"
"""The gadget's serial number; see box/guest"""

FLAGS = os.O_RDWR | os.O_NOCTTY
CONNECT = Path("/sys/class/udc/dummy_udc.0/soft_connect")
PULSES = 20
PERIOD_US = 20_000


def plug(state: bool) -> None:
    """Put the gadget's plug in or pull it out, and wait for the host's end to follow."""
    if Path(HOST).exists() == state:
        return
    CONNECT.write_text("connect" if state else "disconnect")
    deadline = time.monotonic() + 10
    while Path(HOST).exists() != state:
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch) -> Iterator[PtyBoard]:
    """The board behind the line; the gadget's end takes the place of its pty."""
    plug(True)
    monkeypatch.setattr(os, "openpty", lambda: (os.open(GADGET, FLAGS), os.open(GADGET, FLAGS)))
    with PtyBoard(vsync_us=PERIOD_US) as board:
        yield board
        plug(True)


@contextmanager
def opened(device: str = HOST) -> Iterator[SerialTriggerBoard]:
    board = trigger_driver.open(device, {}, MonotonicClock())
    try:
        yield board
    finally:
        board.close()


def _begin(board: SerialTriggerBoard, count: int) -> None:
    slots = [TableSlot(image=i, exposure_us=2_000, dark_us=1_000, wait_trigger=True) for i in range(count)]
    board.program(slots, TriggerSource.VSYNC)
    board.arm()


def _told(board: SerialTriggerBoard, count: int, seconds: float = 5) -> bool:
    """Whether so many pulses were told in time."""
    deadline = time.monotonic() + seconds
    while len(board.events()) < count and time.monotonic() < deadline:
        time.sleep(0.02)
    return len(board.events()) >= count


@pytest.mark.usefixtures("simulated")
def test_a_table_runs_and_every_pulse_is_told_or_its_loss() -> None:
    """Python on an emulated machine is a slow board: what it cannot keep up with it must say."""
    assert [(info.device, info.details["serial_number"]) for info in trigger_driver.discover()] == [(HOST, NUMBER)]
    with opened(f"serial:{NUMBER}") as board:
        for _ in range(ATTEMPTS):
            _begin(board, PULSES)
            if _told(board, PULSES):
                return
            assert board.faults(), "pulses are missing, and nobody said so"
            board.abort()
    pytest.fail("never a whole run")


@pytest.mark.usefixtures("simulated")
@pytest.mark.parametrize("state", ["idle", "armed", "mid-sequence"])
def test_a_board_pulled_out_is_lost_at_once(state: str) -> None:
    def pull() -> float:
        plug(True)
        with opened() as board:
            if state != "idle":
                _begin(board, 60)
            if state == "mid-sequence":
                assert _told(board, 3)
            plug(False)
            before = time.monotonic()
            with pytest.raises((DeviceLost, DeviceNotFound)):
                _use_until_lost(board, state)
            took = time.monotonic() - before
        with pytest.raises(DeviceNotFound), opened():
            pass
        return took

    punctual(1, pull)


def _use_until_lost(board: SerialTriggerBoard, state: str) -> None:
    while True:
        if state == "idle":
            _begin(board, 1)
        else:
            board.events()
            time.sleep(0.01)


@pytest.mark.usefixtures("simulated")
def test_a_board_put_back_works_within_seconds() -> None:
    def put_back() -> float:
        with opened() as board:
            plug(False)
            before = time.monotonic()
            plug(True)
            _begin(board, 3)
            assert _told(board, 3)
        return time.monotonic() - before

    punctual(5, put_back)
