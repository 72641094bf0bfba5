"""The host's side of the trigger board's conversation without any port: bytes in, messages out, and the clock's wrap.

Nothing here waits or retries; `link` does. The protocol is docs/reference/trigger-protocol.md.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

from scanner.trigger_protocol import CLOCK_BITS, LINE_MAX, unframed


@dataclass(frozen=True)
class Ok:
    """The board did as it was told. value: what it answered, "" where nothing."""

    value: str = ""


@dataclass(frozen=True)
class Refusal:
    """`ERR`: the board did not do it."""

    code: int
    text: str


@dataclass(frozen=True)
class Pulse:
    """`!EVT`: a step's outputs rose."""

    run: int
    """pass through the table since ARM"""
    step: int
    t_us: int
    """the board's clock, 32 bit"""


@dataclass(frozen=True)
class RunEnded:
    """`!FAULT NOEDGE` or `!FAULT OVERRUN`: the run is over, and the named step did not come."""

    name: str
    run: int
    step: int
    t_us: int


@dataclass(frozen=True)
class EventsLost:
    """`!FAULT LOST`: the line was too slow for so many events."""

    count: int


@dataclass(frozen=True)
class Ready:
    """`!EVT READY`: the board has begun anew, its table is empty."""


@dataclass(frozen=True)
class Damaged:
    """A line that is none of the protocol's, or whose check sum is wrong."""

    raw: bytes


Answer = Ok | Refusal
Message = Answer | Pulse | RunEnded | EventsLost | Ready | Damaged

_FORMS: tuple[tuple[re.Pattern[str], Callable[[re.Match[str]], Message]], ...] = (
    (re.compile(r"OK(?: ([!-~][ -~]*))?"), lambda m: Ok(m[1] or "")),
    (re.compile(r"!EVT (\d{1,5}) (\d{1,3}) (\d{1,10})"), lambda m: Pulse(int(m[1]), int(m[2]), int(m[3]))),
    (re.compile(r"ERR (\d{1,3}),([ -~]*)"), lambda m: Refusal(int(m[1]), m[2])),
    (
        re.compile(r"!FAULT (NOEDGE|OVERRUN) (\d{1,5}) (\d{1,3}) (\d{1,10})"),
        lambda m: RunEnded(m[1], int(m[2]), int(m[3]), int(m[4])),
    ),
    (re.compile(r"!FAULT LOST (\d{1,10})"), lambda m: EventsLost(int(m[1]))),
)
_STATE = re.compile(r"(IDLE|ARMED|RUNNING) (\d{1,10}) (NONE|NOEDGE|OVERRUN)")


class LineReader:
    """Messages from bytes as they come.

    With `need_sum` a line without a check sum is damaged. What is longer than a line can be is damaged as a whole.
    """

    def __init__(self, *, need_sum: bool = False) -> None:
        self.need_sum = need_sum
        self._begun = b""
        self._too_long = False

    def feed(self, received: bytes) -> list[Message]:
        """The messages that `received` completes."""
        *lines, rest = (self._begun + received).split(b"\n")
        messages: list[Message] = []
        for line in lines:
            stripped = line.removesuffix(b"\r")
            if self._too_long or len(line) >= LINE_MAX:
                messages.append(Damaged(stripped[:LINE_MAX]))
            elif stripped:
                messages.append(parse(stripped, need_sum=self.need_sum))
            self._too_long = False
        if len(rest) >= LINE_MAX:
            rest, self._too_long = rest[:LINE_MAX], True
        self._begun = rest
        return messages


def parse(line: bytes, *, need_sum: bool) -> Message:
    r"""The message of one line, without its end.

    >>> parse(b"!EVT 0 3 88600", need_sum=False)
    Pulse(run=0, step=3, t_us=88600)
    >>> parse(b"OK 12*00", need_sum=True)
    Damaged(raw=b'OK 12*00')
    """
    text, sum_ = unframed(line)
    if text == "!EVT READY" and sum_ != "wrong":
        return Ready()  # without a sum: the board has forgotten that it was to give them
    if sum_ == "wrong" or (need_sum and sum_ == "none"):
        return Damaged(line)
    for form, made in _FORMS:
        if found := form.fullmatch(text):
            return made(found)
    return Damaged(line)


@dataclass(frozen=True)
class BoardState:
    """The answer to `STAT?`."""

    state: str
    """IDLE, ARMED or RUNNING"""
    pulses: int
    """since ARM"""
    fault: str
    """of the last run: NONE, NOEDGE or OVERRUN"""


def board_state(value: str) -> BoardState | None:
    """The answer to `STAT?`, understood; None if it is none."""
    found = _STATE.fullmatch(value)
    return BoardState(found[1], int(found[2]), found[3]) if found else None


def pulse_from(value: str) -> Pulse | None:
    """The answer to `EVT?`, understood; None if it is none."""
    pulse = parse(b"!EVT " + value.encode("ascii", "replace"), need_sum=False)
    return pulse if isinstance(pulse, Pulse) else None


class Unwrapped:
    """The board's 32-bit clock carried on: it wraps after 71.6 min, and must be read more often than half of that."""

    def __init__(self) -> None:
        self._last: int | None = None

    def __call__(self, t_us: int) -> int:
        """The reading without wraps; readings may be up to 35 min older or newer than the last one."""
        span = 1 << CLOCK_BITS
        if self._last is None:
            self._last = t_us
        else:
            ahead = (t_us - self._last + span // 2) % span - span // 2
            self._last += ahead
        return self._last
