"""When a frame was exposed, in our time: the camera's stamp, mapped, with a bound that holds, or called an estimate."""

from __future__ import annotations

import logging

from drivers.aravis.link import Link
from drivers.aravis.options import AravisOptions
from drivers.aravis.stream import Received
from scanner.devices import CameraCapabilities, Exposure, Source

LEAST_BOUND_NS = 20_000
"""No stamp of a camera is declared truer than this: its own exposure start jitters, too"""

BOUND_MARGIN = 3
"""Declared is this many times what was measured: the bound must hold while the host is busy"""

CLOCK_EVERY_NS = 500_000_000
"""Between two comparisons of the clocks in the course of a run"""

STALE_NS = 750_000_000
"""So long may a comparison be past when a stamp is mapped: one is made every half second, and may wait its turn"""

_log = logging.getLogger(__name__)


def declared(link: Link, options: AravisOptions) -> tuple[Source, int]:
    """What stamps are worth: their source, and the bound that is declared, ns. On the link's thread."""
    if not link.clock.latched:
        return Source.ESTIMATED, round(1e3 * options.arrival_bound_us)
    link.read_clock()
    _, bound = link.clock.host(link.clock.newest_ns + STALE_NS)
    return Source.HARDWARE, max(LEAST_BOUND_NS, BOUND_MARGIN * bound)


class Stamps:
    """The stamps of one run."""

    def __init__(
        self, caps: CameraCapabilities, exposure_ns: int, options: AravisOptions, name: str, now_ns: int
    ) -> None:
        """caps, exposure_ns: as the run begins; now_ns: when, and the clocks were compared."""
        self._caps = caps
        self._length = exposure_ns + (caps.readout_ns if caps.shutter == "rolling" else 0)
        self._at_start = options.stamp_at == "start"
        self._name = name
        self._doubted = False
        self._next_clock_ns = now_ns + CLOCK_EVERY_NS

    def exposure(self, link: Link, received: Received) -> Exposure:
        """When the frame was exposed. A stamp that cannot be, or is worse than declared, is an estimate."""
        at, bound = link.clock.host(received.device_ns)
        start = at if self._at_start else at - self._length
        end = start + self._length
        late = end - received.arrival_ns
        if bound > self._caps.stamp_bound_ns or late > bound:
            self._doubt(bound, late)
            return Exposure(start, end, max(bound, late), Source.ESTIMATED)
        return Exposure(start, end, max(bound, min(LEAST_BOUND_NS, self._caps.stamp_bound_ns)), self._caps.stamp)

    def keep_clock(self, link: Link, now_ns: int) -> None:
        """Compare the clocks now and then."""
        if now_ns >= self._next_clock_ns:
            self._next_clock_ns = now_ns + CLOCK_EVERY_NS
            link.post(lambda: link.read_clock(2))

    def _doubt(self, bound_ns: int, late_ns: int) -> None:
        """Say once a run that stamps are not what was declared."""
        if self._doubted or self._caps.stamp is Source.ESTIMATED:
            return
        self._doubted = True
        why = f"is true to {bound_ns / 1e3:.0f} us only"
        if late_ns > bound_ns:
            why = f"says the exposure ended {late_ns / 1e3:.0f} us after its frame had come: try stamp_at"
        _log.warning("%s: a stamp %s; such stamps are passed on as estimates", self._name, why)
