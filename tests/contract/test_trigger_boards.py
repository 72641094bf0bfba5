"""The trigger board's contract: simulated in virtual time, and the serial driver on a simulated and on the real board.

The real board is the firmware's own binary in simavr, its UART on a pty; see tests/firmware.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drivers.serial_trigger import trigger_driver as serial_driver
from drivers.simulated import projector_driver, trigger_driver
from drivers.simulated.serial_board_pty import PtyBoard
from scanner.clock import MonotonicClock, VirtualClock
from tests.contract.suite import TriggerBench, TriggerContract
from tests.firmware.simavr import Simavr, build, on_pty

REFRESH_US = 8_333

SLOW_REFRESH_US = 16_667
UNEVEN_NS = 7_000_000
"""simavr stands still while the machine has no time for it, by 3 ms on a busy one. Less than half of a refresh, so that
a pulse at the wrong edge is found all the same; tests/firmware holds the pulses to the cycle."""


@pytest.fixture(scope="module")
def simavr(tmp_path_factory: pytest.TempPathFactory) -> Simavr:
    return build(tmp_path_factory.mktemp("firmware"))


class TestSimulatedTriggerBoard(TriggerContract):
    @pytest.fixture
    def bench(self) -> Iterator[TriggerBench]:
        clock = VirtualClock()
        projector = projector_driver.open("quick/board", {}, clock)
        board = trigger_driver.open("quick/board", {}, clock)
        refresh = projector.capabilities.refresh_ns
        yield TriggerBench(board, clock, refresh, projector.close, None)
        board.close()
        projector.close()


@pytest.mark.alone
class TestSerialTriggerBoardOnSimulatedOne(TriggerContract):
    @pytest.fixture
    def bench(self) -> Iterator[TriggerBench]:
        clock = MonotonicClock()
        with PtyBoard(vsync_us=REFRESH_US, clock_ppm=300.0) as there:
            board = serial_driver.open(there.path, {}, clock)
            yield TriggerBench(board, clock, 1000 * REFRESH_US, there.stop_vsync, there.close)
            board.close()


@pytest.mark.alone
@pytest.mark.real_time
class TestSerialTriggerBoardOnTheFirmware(TriggerContract):
    @pytest.fixture
    def bench(self, simavr: Simavr) -> Iterator[TriggerBench]:
        clock = MonotonicClock()
        with on_pty(simavr, SLOW_REFRESH_US) as there:
            board = serial_driver.open(there.path, {}, clock)
            yield TriggerBench(board, clock, 1000 * SLOW_REFRESH_US, there.stop_vsync, there.unplug, UNEVEN_NS)
            board.close()
