"""The board's clock as it is read over the line: requests timed, the wrap undone, the fit kept fresh, or begun anew."""

from __future__ import annotations

import logging

from drivers.serial_trigger.clock_fit import SPAN_US, ClockFit, HostTime, Reading
from drivers.serial_trigger.link import Link
from drivers.serial_trigger.protocol import Unwrapped
from scanner.errors import DeviceError

_log = logging.getLogger(__name__)

BYTE_NS = 84_000
"""A byte takes at least this on the wire: 10 bits at the fastest that a UART may be to be understood at 115200"""

FIRST_READINGS = 4
READ_AGAIN_NS = (50_000_000, 5_000_000_000)
"""The clock is read again after a quarter of the time it has been known for, within these: its rate is then known ever
better, and a reading, which takes 3 ms of the line, is rare"""

STALE_NS = 1000 * SPAN_US
"""A clock not read for so long has no fit left, and may have wrapped"""

EVENT_NS = 1_000
"""An event's time is cut to microseconds, of a clock of half microseconds"""


class BoardClock:
    """One connection's clock. Board times are microseconds, 32 bit, as the board tells them, or unwrapped."""

    def __init__(self) -> None:
        self.fit = ClockFit()
        self.unwrapped = Unwrapped()
        self._read_ns = 0

    def begin(self, link: Link) -> None:
        """Forget what was known, and read the clock a few times."""
        self.fit.forget()
        self.unwrapped = Unwrapped()
        for _ in range(FIRST_READINGS):
            self.read(link)

    def is_stale(self, now_ns: int) -> bool:
        """Whether it was not read for so long that it has to `begin` anew."""
        return now_ns - self._read_ns > STALE_NS

    def is_due(self, now_ns: int) -> bool:
        """Whether it is time to read it again."""
        least, most = READ_AGAIN_NS
        return now_ns - self._read_ns > min(max(least, self.fit.span_us * 250), most)

    def read(self, link: Link) -> None:
        """One reading, taken by the board when the request's last byte had arrived."""
        answer = link.ask_timed("TIME?")
        if not answer.value.isdigit():
            raise DeviceError(f"TIME? was answered with {answer.value!r}", device=link.name)
        low = answer.sent_ns + answer.sent_bytes * BYTE_NS
        high = answer.heard_ns - answer.heard_bytes * BYTE_NS
        if low > high:  # a line faster than any UART: a pty without one
            low, high = answer.sent_ns, answer.heard_ns
        breaks = self.fit.breaks
        self.fit.add(Reading(self.unwrapped(int(answer.value)), low, high + EVENT_NS))
        self._read_ns = answer.heard_ns
        if self.fit.breaks != breaks:
            _log.warning("%s: its clock does not run evenly with this machine's: event times are estimates", link.name)

    def at(self, t_us: int) -> HostTime:
        """A time of the board on the host's clock. t_us: 32 bit, not far from the last one."""
        return self.fit.at(self.unwrapped(t_us))
