"""The daemon's sockets: bound so that only its group may open them, with a limit on everything, never blocking."""

from __future__ import annotations

import asyncio
import os
import socket
import stat
from collections.abc import Iterable, Sequence
from contextlib import suppress
from enum import Enum
from pathlib import Path
from typing import cast

import zmq
import zmq.asyncio

from scanner.endpoints import ipc_path
from scanner.errors import ConfigError, StorageError
from scanner.storage import storage_errors
from scanner.wire import LARGE_BYTES, MAX_MESSAGE_BYTES, WELCOME
from service.descriptors import aside

HIGH_WATER = 10_000
"""Messages that wait for one peer; more are refused (ROUTER) or dropped (events), never waited for."""


MAX_SUBSCRIPTION_BYTES = 256
"""What a subscriber sends: its greeting, and which messages it wants. ZeroMQ keeps 40 bytes for each of these bytes."""


class Sent(Enum):
    """What became of a message."""

    DONE = "done"
    FULL = "full"
    """the peer's queue has no room"""
    GONE = "gone"
    """the peer is not there any more"""


def bound(
    context: zmq.asyncio.Context,
    kind: int,
    endpoint: str,
    *,
    high_water: int = HIGH_WATER,
    received: int = HIGH_WATER,
    longest: int = MAX_MESSAGE_BYTES,
) -> zmq.asyncio.Socket:
    """A socket bound to a local endpoint: folder 0750 if it is made here, socket 0660.

    Args:
        high_water: messages to one peer that wait in ZeroMQ.
        received: the same of messages from one peer; beyond, ZeroMQ reads no more of it, and the peer has to wait.
        longest: bytes of a message from a peer; ZeroMQ ends the connection of one that sends more.

    Raises:
        StorageError: the folder cannot be made or written.
    """
    opened = context.socket(kind)
    options = [(zmq.LINGER, 0), (zmq.SNDHWM, high_water), (zmq.RCVHWM, received), (zmq.MAXMSGSIZE, longest)]
    if kind == zmq.ROUTER:
        options.append((zmq.ROUTER_MANDATORY, 1))
    for option, value in options:
        opened.setsockopt(option, value)
    if kind == zmq.XPUB:
        opened.setsockopt(zmq.XPUB_WELCOME_MSG, WELCOME)
    path = Path(ipc_path(endpoint))
    with storage_errors(path.parent):
        path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
    # libzmq leaves sockets at 0777 minus umask, and there is no moment between bind and chmod when that would do.
    before = os.umask(0o117)
    try:
        opened.bind(endpoint)
    except zmq.ZMQError as error:
        hint = "is the folder writable?"
        raise StorageError(f"cannot open the socket {path}: {error.strerror}", hint=hint) from error
    finally:
        os.umask(before)
    return opened


def keep_from_clients(endpoint: str) -> None:
    """Give a socket to the daemon's own group, where the folder hands on the clients' (setgid, see systemd/).

    Raises:
        StorageError: it cannot be done.
    """
    path = Path(ipc_path(endpoint))
    with storage_errors(path):
        os.chown(path, -1, os.getegid())


def refuse_files(endpoints: Iterable[str]) -> None:
    """Raise ConfigError where an endpoint names what is no socket: libzmq would delete it to bind there.

    Links are not followed: what they point at is not ours to replace.
    """
    for endpoint in endpoints:
        path = Path(ipc_path(endpoint))
        try:
            mode = path.lstat().st_mode
        except FileNotFoundError:
            continue
        except OSError as error:
            raise ConfigError(f"the endpoint {endpoint} cannot be used: {error.strerror}") from error
        if not stat.S_ISSOCK(mode):
            raise ConfigError(
                f"{path} is no socket, and the daemon needs that name for one", hint="give another endpoint"
            )


def refuse_taken(endpoints: Iterable[str]) -> None:
    """Raise ConfigError where somebody serves an endpoint: binding would take it from them without a word."""
    for endpoint in endpoints:
        path = ipc_path(endpoint)
        try:
            with socket.socket(socket.AF_UNIX) as trial:
                trial.connect(path)
        except (FileNotFoundError, ConnectionRefusedError):  # nobody, or one who died
            continue
        except OSError as error:
            raise ConfigError(
                f"{path} belongs to somebody else: {error.strerror}", hint="give another endpoint"
            ) from error
        raise ConfigError(
            f"another daemon serves {endpoint}", hint="end it (fringed status shows it), or give another endpoint"
        )


def remove_sockets(endpoints: Iterable[str]) -> None:
    """Delete the sockets that libzmq leaves, also set aside; what is no socket is not ours."""
    for endpoint in endpoints:
        path = Path(ipc_path(endpoint))
        for there in (path, aside(path)):
            with suppress(FileNotFoundError):
                if stat.S_ISSOCK(there.lstat().st_mode):
                    there.unlink()


def send_now(to: zmq.asyncio.Socket, parts: Sequence[bytes]) -> bool:
    """Send without waiting; False where the peer's queue is full or the peer is gone."""
    return try_send(to, parts) is Sent.DONE


def try_send(to: zmq.asyncio.Socket, parts: Sequence[bytes]) -> Sent:
    """Send without waiting."""
    # With DONTWAIT the future is done when it is returned.
    copy = len(parts[-1]) < LARGE_BYTES
    sent = cast("asyncio.Future[None]", to.send_multipart(parts, zmq.DONTWAIT, copy=copy))
    error = sent.exception()
    if error is None:
        return Sent.DONE
    if isinstance(error, zmq.ZMQError) and error.errno in (zmq.EAGAIN, zmq.EHOSTUNREACH):
        return Sent.FULL if error.errno == zmq.EAGAIN else Sent.GONE
    raise error
