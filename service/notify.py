"""What the daemon tells systemd: ready, ending, and that it lives (sd_notify(3), written here: one datagram a word).

Without systemd nothing is told. The watchdog is fed from the event loop itself, and only while the devices answer: a
daemon that is stuck, or that waits for a device which will never answer, is started anew.
"""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Callable, Mapping
from contextlib import suppress

FEEDS = 3
"""The watchdog is fed so often in its time: two late turns of a busy machine do no harm"""


class Notifier:
    """The service manager's socket, if there is one."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        """Read NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID, as systemd sets them."""
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        mine = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        every = environment.get("WATCHDOG_USEC", "") if mine else ""
        self._watchdog_s = int(every) / 1e6 if every.isdigit() and int(every) > 0 else None

    @property
    def watched(self) -> bool:
        """Whether a watchdog waits to be fed."""
        return bool(self._address) and self._watchdog_s is not None

    def ready(self, status: str) -> None:
        """The daemon serves."""
        self._tell("READY=1", f"STATUS={status}")

    def ending(self) -> None:
        """The daemon ends by its own will."""
        self._tell("STOPPING=1")

    async def feed(self, alive: Callable[[], bool]) -> None:
        """Feed the watchdog while `alive` says so, for ever; returns at once where there is none."""
        if self._watchdog_s is None:
            return
        while True:
            if alive():
                self._tell("WATCHDOG=1")
            await asyncio.sleep(self._watchdog_s / FEEDS)

    def _tell(self, *lines: str) -> None:
        if not self._address:
            return
        # A manager that does not listen is no reason to end.
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as told:
            told.connect(self._address)
            told.send("\n".join(lines).encode())
