"""The library's sockets, which it keeps to itself: found among this process's own, widened, and cut.

Two things cannot be asked of Aravis 0.8 through its interface: a receive buffer that is large before the first packet
comes, and an end to its patience with a camera that is known to be dead (five times half a second for every command,
of which letting go of a streaming camera takes several).
"""

from __future__ import annotations

import os
import socket
import stat
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

GVCP_PORT = 3956


def set_receive_buffer(port: int, size: int) -> None:
    """Widen the receive buffer of this process's UDP socket at `port`."""
    for one in _udp_sockets():
        with closing(one):
            if one.getsockname()[1] == port:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size)


def udp_inodes() -> frozenset[int]:
    """This process's UDP sockets."""
    found = set()
    for one in _udp_sockets():
        with closing(one):
            found.add(os.fstat(one.fileno()).st_ino)
    return frozenset(found)


class ControlSocket:
    """The socket over which the library commands one camera."""

    def __init__(self, before: frozenset[int], interface: str) -> None:
        """Find it: a socket on the interface's address that was not there before the camera was opened."""
        self._sockets: list[socket.socket] = []
        for one in _udp_sockets():
            if os.fstat(one.fileno()).st_ino in before or one.getsockname()[0] != interface or _is_connected(one):
                one.close()
            else:
                self._sockets.append(one)

    def cut(self, address: str) -> None:
        """Let every further command to the camera at `address` fail at once."""
        for one in self._sockets:
            with suppress(OSError):  # the library has closed it
                one.connect((address, GVCP_PORT))
                one.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        """Let go of it. May be called twice."""
        while self._sockets:
            self._sockets.pop().close()


def _udp_sockets() -> Iterator[socket.socket]:
    """Duplicates of this process's IPv4 UDP sockets; the caller closes each."""
    for entry in list(Path("/proc/self/fd").iterdir()):
        try:
            duplicate = os.dup(int(entry.name))
        except OSError:  # closed meanwhile; the descriptor of the listing itself
            continue
        if not stat.S_ISSOCK(os.fstat(duplicate).st_mode):
            os.close(duplicate)
            continue
        one = socket.socket(fileno=duplicate)
        if one.family == socket.AF_INET and one.type == socket.SOCK_DGRAM:
            yield one
        else:
            one.close()


def _is_connected(one: socket.socket) -> bool:
    try:
        one.getpeername()
    except OSError:
        return False
    return True
