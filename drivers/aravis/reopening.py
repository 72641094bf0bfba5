"""The link to a camera that may go away: the present one, and after a loss another one, looked for until it is there.

present --lost--> looked for, with growing pauses --opened and prepared--> present --close--> closed
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from drivers.aravis.link import Link
from scanner.errors import ScannerError

PAUSE_S, LONGEST_PAUSE_S = 0.25, 2.0
"""Between attempts to open a lost camera: doubled each time"""

CLOSED_S = 10.0
"""An attempt to open that is under way ends within this, or gives up what it opened when it does"""

_log = logging.getLogger(__name__)

Opener = Callable[[str, Callable[[str], None]], Link]
"""Opens the camera of that name and makes it ready; the function is told when that link is lost"""


class Reopening:
    """A link, always the newest. Calls come from one thread; the search has its own."""

    def __init__(self, device: str, opener: Opener, name: str) -> None:
        """Open the first link.

        Raises:
            DeviceError: it cannot be opened, or was lost at once.
        """
        self._device, self._opener, self._name = device, opener, name
        self.losses = 0
        self._link: Link | None = None
        self._finder: threading.Thread | None = None
        self._closing = threading.Event()
        self._lock = threading.Lock()
        link = opener(device, self._lost)
        if not self._adopt(link):
            link.close()
            raise link.loss()

    @property
    def newest(self) -> Link:
        """The last link that was open, lost or not."""
        if self._link is None:
            raise AssertionError("a camera without a link was never opened")
        return self._link

    def present(self) -> Link:
        """The link.

        Raises:
            DeviceLost: there is none at present.
        """
        link = self.newest
        if link.lost.is_set():
            raise link.loss()
        return link

    def close(self) -> None:
        """Give the camera back, or stop looking for it."""
        with self._lock:
            self._closing.set()
            finder = self._finder
        if finder is not None:
            finder.join(timeout=CLOSED_S)
        self.newest.close()

    def _adopt(self, link: Link) -> bool:
        """Take a link for the present one, unless it is lost already or nobody needs it any more."""
        with self._lock:
            if link.lost.is_set() or self._closing.is_set():
                return False
            self._link, self._finder = link, None
            return True

    def _lost(self, reason: str) -> None:
        """Told by the watch, or by whoever met the silence first; also of links that were never adopted."""
        with self._lock:
            if self._link is None or not self._link.lost.is_set() or self._finder is not None or self._closing.is_set():
                return
            self.losses += 1
            self._finder = threading.Thread(target=self._find_again, name="aravis finder", daemon=True)
            self._finder.start()
        _log.warning("%s: %s", self._name, reason)

    def _find_again(self) -> None:
        lost, pause_s = self.newest, PAUSE_S
        lost.close()
        while not self._closing.wait(pause_s):
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
            try:
                link = self._opener(lost.address or self._device, self._lost)
            except (ScannerError, OSError) as error:  # OSError: no descriptors, no network
                _log.debug("%s: still lost: %s", self._name, error)
                continue
            if self._adopt(link):
                _log.info("%s: back", self._name)
                return
            link.close()
