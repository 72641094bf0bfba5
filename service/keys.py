"""Single keys from a terminal, without Enter and without waiting; nothing where standard input is no terminal."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager


class Keys:
    """The keys that were pressed. `there`: whether somebody can press any."""

    def __init__(self, descriptor: int | None) -> None:
        self._descriptor = descriptor

    @property
    def there(self) -> bool:
        """Whether there is a terminal."""
        return self._descriptor is not None

    def pressed(self) -> str:
        """The next key, "" where none was pressed; Enter is a line feed."""
        if self._descriptor is None or not select.select([self._descriptor], [], [], 0)[0]:
            return ""
        return os.read(self._descriptor, 1).decode("ascii", "replace").lower()


@contextmanager
def keys() -> Iterator[Keys]:
    """Read single keys while the block runs; Ctrl-C stays what it is."""
    if not sys.stdin.isatty():
        yield Keys(None)
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        yield Keys(descriptor)
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
