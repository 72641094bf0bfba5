"""The trigger board's driver on the kernel's own USB serial line: a simulated board talks on the gadget's end of it."""

from __future__ import annotations

import os
import time
import tty
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
AUTHORIZED = Path("/sys/bus/usb/devices/1-1/authorized")
"""The host drops a device that it is told to refuse. Pulling the gadget's own plug is final: dummy_hcd of 6.1 cannot be
enumerated a second time"""
PULSES = 20
PERIOD_US = 20_000


class GadgetBoard(PtyBoard):
    """The simulated board on the gadget's end, which is hung up when the host drops the device, and opened anew."""

    def _serve(self) -> None:
        while not self._closing.is_set():
            try:
                super()._serve()
            except OSError:
                os.close(self._slave)
                os.close(self._master)
                self._master, self._slave = _gadget_ends()
                tty.setraw(self._slave)
                self.reset()
                self._to_host.clear()

    def _receive(self, data: bytes) -> None:
        if not data:
            raise OSError("hung up")
        super()._receive(data)


def _gadget_ends() -> tuple[int, int]:
    """Both ends of a pty are one here: what is written to the gadget's tty comes out at the host's."""
    return os.open(GADGET, FLAGS), os.open(GADGET, FLAGS)


def plug(state: bool) -> None:
    """Give the gadget to the host or take it away, and wait for its tty to follow."""
    if _is_there() == state:
        return
    AUTHORIZED.write_text("1" if state else "0")
    deadline = time.monotonic() + 10
    while _is_there() != state:
        assert time.monotonic() < deadline
        time.sleep(0.02)


def _is_there() -> bool:
    return any(Path("/dev").glob("ttyACM*"))


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch) -> Iterator[PtyBoard]:
    """The board behind the line."""
    plug(True)
    monkeypatch.setattr(os, "openpty", _gadget_ends)
    with GadgetBoard(vsync_us=PERIOD_US) as board:
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
    assert [info.details["serial_number"] for info in trigger_driver.discover()] == [NUMBER]
    with opened(f"serial:{NUMBER}") as board:
        for _ in range(ATTEMPTS):
            _begin(board, PULSES)
            if _told(board, PULSES):
                return
            assert board.faults(), "pulses are missing, and nobody said so"
            board.abort()
    pytest.fail("never a whole run")


@pytest.mark.real_time
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


@pytest.mark.real_time
@pytest.mark.usefixtures("simulated")
def test_a_board_put_back_works_within_seconds() -> None:
    def put_back() -> float:
        with opened(f"serial:{NUMBER}") as board:
            plug(False)
            before = time.monotonic()
            plug(True)
            _begin(board, 3)
            assert _told(board, 3)
        return time.monotonic() - before

    punctual(5, put_back)
