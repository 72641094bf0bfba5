"""A simulated rig with a trigger board, its camera on the line."""

from __future__ import annotations

from typing import Any

from drivers.simulated import trigger_driver
from drivers.simulated.trigger_board import SimulatedTriggerBoard
from scanner.devices import TableSlot, TriggerMode, TriggerSource
from tests.unit.simulated_bench import Bench

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
