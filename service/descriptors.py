"""File descriptors: as many as the system lets a process have, and no new connections while many are in use.

libzmq ends its process where it may not open one more for a connection (EMFILE in ipc_listener.cpp). So the sockets'
names are taken away before that, and put back later; those who are connected notice nothing.
"""

from __future__ import annotations

import logging
import os
import resource
import stat
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zmq

from scanner.endpoints import ipc_path

MOST_WANTED = 65_536
"""Descriptors asked for: libraries that close all there might be take seconds where the limit is a thousand million"""

MOST_USED = 8192
"""Descriptors in use at which nobody may connect any more, or a quarter of what there may be, where that is fewer."""

LEAST_SURE = 4096
"""Limit from which on no haste of clients ends this process: each socket's queue of those who connected holds a
thousand, libzmq waits when it is full, and the daemon has three. Below, it has to look before three quarters of the
limit have connected: at 1024 it does where it gets a processor within some 20 ms, as it does not always."""

TURN_S = 0.0005
"""The interpreter's turn there: in the usual 5 ms a hundred may connect."""

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
    if told := Path("/proc/self/fd").stat().st_size:  # since Linux 6.2
        return told
    with os.scandir("/proc/self/fd") as entries:
        return sum(1 for _ in entries)


def aside(path: Path) -> Path:
    """Where a socket's file is while nobody may connect (`service.descriptors`)."""
    return path.with_name(f"{path.name}.full")


class Admission:
    """Who may connect: everybody, or nobody while too many descriptors are in use. From now on until `close`.

    A thread of its own looks whenever somebody connected: what this process is busy with does not keep it from that.
    """

    def __init__(self, listening: Mapping[str, zmq.Socket[Any]]) -> None:
        """Of bound sockets by their local endpoints."""
        self._doors = [_Door(Path(ipc_path(endpoint))) for endpoint in listening]
        self._open = True
        self._closed = False
        self._sockets: list[zmq.Socket[Any]] = list(listening.values())
        self._monitors = [_monitor(each) for each in listening.values()]
        if _most() < LEAST_SURE // 4:
            _log.warning("few file descriptors may be had: a thousand clients at once can end this process (ulimit -n)")
            sys.setswitchinterval(min(sys.getswitchinterval(), TURN_S))
        self._woken, self._wake = os.pipe2(os.O_CLOEXEC)
        self._thread = threading.Thread(target=self._watch, name="admission", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Look no more; whoever was kept out may come. Before the sockets are closed; may be called twice."""
        if self._closed:
            return
        self._closed = True
        os.close(self._wake)
        self._thread.join()
        os.close(self._woken)
        for each, monitor in zip(self._sockets, self._monitors, strict=True):
            each.monitor(None, 0)
            monitor.close(linger=0)

    def _watch(self) -> None:
        poller = zmq.Poller()
        poller.register(self._woken, zmq.POLLIN)
        for monitor in self._monitors:
            poller.register(monitor, zmq.POLLIN)
        ended = False
        while not ended:
            self._decide()
            ended = any(of == self._woken for of, _ in poller.poll(None if self._open else round(1000 * REOPEN_S)))
            self._decide()
            # Emptied at the end too: a queue of events that stays full would hold libzmq's own thread, and the end.
            _drain(self._monitors)
        self._reopen()

    def _decide(self) -> None:
        most = _most()
        try:
            used = open_descriptors()
        except OSError:  # not one is left to look with
            used = most
        if self._open and used >= most:
            self._open = False
            for door in self._doors:
                door.shut()
            _log.warning("%d file descriptors in use: nobody may connect until fewer than %d are", used, 3 * most // 4)
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
        self._aside = aside(path)
        self._mode = stat.S_IMODE(path.stat().st_mode)
        self._aside.unlink(missing_ok=True)  # of a daemon that was killed

    def shut(self) -> None:
        with self._told():
            self._path.rename(self._aside)  # before anything else: every turn of this thread may cost 5 ms
            self._aside.chmod(0)

    def open(self) -> None:
        with self._told():
            self._aside.chmod(self._mode)
            self._aside.rename(self._path)

    @contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:  # somebody took the file away: the daemon serves on without it
            _log.error("the socket %s: %s", self._path, error.strerror)


def _most() -> int:
    """Descriptors in use at which the doors are shut."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return MOST_USED if limit == resource.RLIM_INFINITY else min(limit // 4, MOST_USED)


def _monitor(of: zmq.Socket[Any]) -> zmq.Socket[Any]:
    """What tells whenever somebody connected."""
    address = f"inproc://accepted-{of.underlying:x}"
    of.monitor(address, zmq.EVENT_ACCEPTED)
    monitor: zmq.Socket[Any] = of.context.socket(zmq.PAIR, socket_class=zmq.Socket)
    monitor.setsockopt(zmq.RCVHWM, 1)  # beside the thousand of the side that tells
    monitor.connect(address)
    return monitor


def _drain(monitors: Sequence[zmq.Socket[Any]]) -> None:
    for monitor in monitors:
        try:
            while True:
                monitor.recv_multipart(zmq.DONTWAIT)
        except zmq.Again:
            continue
