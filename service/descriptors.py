"""File descriptors: as many as the system lets a process have, and no new connections while many are in use.

libzmq ends its process where it may not open one more for a connection (EMFILE in ipc_listener.cpp). So the sockets'
names are taken away before that, and put back later; those who are connected notice nothing.
"""

from __future__ import annotations

import logging
import os
import resource
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import zmq
import zmq.asyncio

from scanner.endpoints import ipc_path

MOST_WANTED = 65_536
"""Descriptors asked for: libraries that close all there might be take seconds where the limit is a thousand million"""

MOST_USED = 8192
"""Descriptors in use at which nobody may connect any more, or a quarter of what there may be, where that is fewer. Each
socket's queue of events holds two thousand, and libzmq waits when it is full: from a limit of 16,384 on no haste of
clients reaches it before this process has looked; below, one would have to keep it from looking for some time."""

REOPEN_S = 0.25
"""Pause between looks whether enough are free again"""

_log = logging.getLogger(__name__)


def raise_limit() -> None:
    """Let this process and its children have as many descriptors as they may."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST_WANTED if hard == resource.RLIM_INFINITY else min(hard, MOST_WANTED)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def open_descriptors() -> int:
    """How many this process has now."""
    with os.scandir("/proc/self/fd") as entries:
        return sum(1 for _ in entries)


class Admission:
    """Who may connect: everybody, or nobody while too many descriptors are in use. `watch` until it is cancelled."""

    def __init__(self, listening: Mapping[str, zmq.asyncio.Socket]) -> None:
        """Of bound sockets by their local endpoints."""
        self._sockets = list(listening.values())
        self._doors = [_Door(Path(ipc_path(endpoint))) for endpoint in listening]
        self._open = True

    async def watch(self) -> None:
        """Look whenever somebody connected, and while nobody may, now and then."""
        monitors: list[zmq.Socket[Any]] = []
        poller = zmq.asyncio.Poller()
        try:
            for each in self._sockets:
                monitor = each.get_monitor_socket(zmq.EVENT_ACCEPTED)
                poller.register(monitor, zmq.POLLIN)
                monitors.append(zmq.Socket.shadow(monitor.underlying))
            while True:
                self._decide()
                await poller.poll(None if self._open else round(1000 * REOPEN_S))
                _drain(monitors)
        finally:
            self._reopen()
            # Emptied first: a queue of events that stays full would hold libzmq's own thread, and the end with it.
            _drain(monitors)
            for each in self._sockets[: len(monitors)]:
                monitor = each.get_monitor_socket()
                each.disable_monitor()
                monitor.close(linger=0)

    def _decide(self) -> None:
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        most = MOST_USED if limit == resource.RLIM_INFINITY else min(limit // 4, MOST_USED)
        used = open_descriptors()
        if self._open and used >= most:
            _log.warning("%d file descriptors in use, of %d: nobody may connect until they are fewer", used, limit)
            self._open = False
            for door in self._doors:
                door.shut()
        elif not self._open and used < 3 * most // 4:
            _log.warning("%d file descriptors in use: clients may connect again", used)
            self._reopen()

    def _reopen(self) -> None:
        if not self._open:
            self._open = True
            for door in self._doors:
                door.open()


class _Door:
    """A listening socket's name. Without it nobody connects; unbound, it would lose those who are connected."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._aside = path.with_name(f"{path.name}.full")
        self._mode = stat.S_IMODE(path.stat().st_mode)
        self._aside.unlink(missing_ok=True)  # of a daemon that was killed

    def shut(self) -> None:
        self._move(self._path, self._aside, 0)

    def open(self) -> None:
        self._move(self._aside, self._path, self._mode)

    def _move(self, here: Path, there: Path, mode: int) -> None:
        try:
            here.chmod(mode)
            here.rename(there)
        except OSError as error:  # somebody took the file away: the daemon serves on without it
            _log.error("the socket %s: %s", self._path, error.strerror)


def _drain(monitors: Sequence[zmq.Socket[Any]]) -> None:
    for monitor in monitors:
        try:
            while True:
                monitor.recv_multipart(zmq.DONTWAIT)
        except zmq.Again:
            continue
