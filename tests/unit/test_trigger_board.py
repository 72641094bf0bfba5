"""The serial board's driver in virtual time, on the model of the firmware: long idleness, resets, lost orders."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import pytest

from drivers.serial_trigger import driver
from drivers.serial_trigger.board import BoardOptions, SerialTriggerBoard
from drivers.serial_trigger.link import NoAnswerError, RefusedError, Timed
from drivers.serial_trigger.protocol import Message, Ok, Refusal, parse
from drivers.simulated.serial_board import Said, SerialBoard
from scanner.clock import MonotonicClock, VirtualClock
from scanner.devices import Source, TableSlot, TriggerSource
from scanner.errors import DeviceError, DeviceLost
from scanner.trigger_protocol import framed

S, MS = 1_000_000_000, 1_000_000
TABLE = [TableSlot(image=0, exposure_us=1_000, dark_us=500, wait_trigger=True)] * 8


@dataclass
class VirtualLink:
    """A conversation with the model in virtual time, as `drivers.serial_trigger.link.Link`: 1 ms there, 1 ms back."""

    clock: VirtualClock
    told: Callable[[Message], None]
    name: str = "virtual"
    lost: DeviceLost | None = None
    heard_ns: int = 0
    deaf_to: str = " "
    """the command whose line never arrives"""
    board: SerialBoard = field(default_factory=SerialBoard)
    began_ns: int = 0
    """when the board's clock began"""

    def ask(self, command: str, *, repeat: bool = True, tries: int = 6) -> str:
        return self.ask_timed(command, repeat=repeat).value

    def ask_timed(self, command: str, *, repeat: bool = True) -> Timed:
        sent = self.clock.now_ns()
        self.clock.sleep_until(sent + MS)
        if command.startswith(self.deaf_to):
            raise NoAnswerError(f"no answer to {command} came through", device=self.name)
        self.board.receive(framed(command), self.board_ns)
        self.clock.sleep_until(sent + 2 * MS)
        answer = self.hear()
        if isinstance(answer, Refusal):
            raise RefusedError(answer.text, answer.code)
        assert isinstance(answer, Ok)
        return Timed(answer.value, sent, self.clock.now_ns(), 1, 1)

    @property
    def board_ns(self) -> int:
        return self.clock.now_ns() - self.began_ns

    def edge(self) -> None:
        """A vertical blank, now, and time for its pulse."""
        self.board.edge("VSYNC", True, self.board_ns)
        self.clock.sleep_until(self.clock.now_ns() + 4 * MS)
        self.hear()

    def reset(self) -> None:
        """The board begins anew."""
        self.began_ns, self.board = self.clock.now_ns(), SerialBoard()
        self.hear()

    def hear(self) -> Message | None:
        answer = None
        self.heard_ns = self.clock.now_ns()
        for said in self.board.advance(self.board_ns):
            if isinstance(said, Said):
                self.told(message := parse(said.data.rstrip(), need_sum=False))
                answer = message if isinstance(message, Ok | Refusal) else answer
        return answer

    def knock(self) -> None:
        self.board.receive(b"\x18\n", self.board_ns)

    def require_sums(self) -> None:
        """Sums are the business of tests/unit/test_trigger_lines.py."""

    def close(self) -> None:
        """Nothing is held."""


@dataclass
class Found:
    link: VirtualLink
    identity: str = "fringed,virtual,1.0,1"


@pytest.fixture
def there() -> Iterator[tuple[VirtualLink, SerialTriggerBoard]]:
    clock = VirtualClock()
    links: list[VirtualLink] = []

    def connect(told: Callable[[Message], None]) -> Found:
        links.append(VirtualLink(clock, told))
        return Found(links[-1])

    board = SerialTriggerBoard(connect, BoardOptions(), clock)  # type: ignore[arg-type]
    yield links[0], board
    board.close()


def armed(board: SerialTriggerBoard) -> None:
    board.program(TABLE, TriggerSource.VSYNC)
    board.arm()


def pulsed(link: VirtualLink, board: SerialTriggerBoard, count: int) -> list[int]:
    """Let so many blanks come; when their pulses truly began."""
    rises = []
    for _ in range(count):
        rises.append(link.clock.now_ns() + 500_000)
        link.edge()
    return rises


@pytest.mark.parametrize("idle_s", [0, 1_000, 2_500, 5_000, 100_000])
def test_a_board_that_was_idle_for_long_is_as_true_as_before(
    idle_s: int, there: tuple[VirtualLink, SerialTriggerBoard], caplog: pytest.LogCaptureFixture
) -> None:
    """Its 32 bits of microseconds may have wrapped meanwhile, more than once: what was known of the clock is void."""
    link, board = there
    armed(board)
    pulsed(link, board, len(TABLE))
    link.clock.sleep_until(link.clock.now_ns() + idle_s * S)
    board.arm()
    rises = pulsed(link, board, 3)
    events = board.events()
    assert len(events) == 3
    for event, true in zip(events, rises, strict=True):
        assert abs(event.t_ns - true) <= event.bound_ns < 2 * MS
        assert event.source is Source.HARDWARE
    assert caplog.text == ""


def test_pulses_from_before_a_reset_keep_their_times(there: tuple[VirtualLink, SerialTriggerBoard]) -> None:
    link, board = there
    link.clock.sleep_until(link.clock.now_ns() + 10 * S)
    armed(board)
    rises = pulsed(link, board, 3)
    link.reset()
    events = board.events()
    assert [fault.kind for fault in board.faults()] == ["reset"]
    assert [abs(event.t_ns - true) <= event.bound_ns for event, true in zip(events, rises, strict=True)] == [True] * 3


@pytest.mark.parametrize("command", ["SEQ:ADD", "ARM"])
def test_a_command_that_never_arrives_is_not_sent_for_ever(
    command: str, there: tuple[VirtualLink, SerialTriggerBoard]
) -> None:
    link, board = there
    link.deaf_to = command
    with pytest.raises(DeviceLost, match=command):
        armed(board)
    link.deaf_to = " "


class Chatter:
    """A port on which another device talks without a pause."""

    name = "chatter"

    def read(self) -> bytes:
        time.sleep(0.002)
        return b"$GPGGA,092750.000\r\n"

    def write(self, data: bytes) -> None:
        """It does not listen."""

    def close(self) -> None:
        """Nothing is held."""


@pytest.mark.timeout(20)
def test_a_device_that_never_falls_silent_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "SerialTransport", lambda path: Chatter())
    monkeypatch.setattr(driver, "BOOT_S", 0.1)
    monkeypatch.setattr(driver, "KNOCK_S", 0.01)
    with pytest.raises(DeviceError, match="lines that are none of its protocol"):
        driver.connect("/dev/ttyACM0", MonotonicClock(), lambda message: None)
