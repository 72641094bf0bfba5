"""The daemon's sockets: bound so that only its group may open them, with a limit on everything, never blocking."""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import cast

import zmq
import zmq.asyncio

from scanner.errors import ConfigError, StorageError
from scanner.storage import storage_errors
from scanner.wire import MAX_MESSAGE_BYTES, WELCOME, ipc_path

HIGH_WATER = 10_000
"""Messages that wait for one peer; more are refused (ROUTER) or dropped (events), never waited for."""


def bound(context: zmq.asyncio.Context, kind: int, endpoint: str) -> zmq.asyncio.Socket:
    """A socket bound to a local endpoint: folder 0750 if it is made here, socket 0660.

    Raises:
        StorageError: the folder cannot be made or written.
    """
    opened = context.socket(kind)
    options = [(zmq.LINGER, 0), (zmq.SNDHWM, HIGH_WATER), (zmq.RCVHWM, HIGH_WATER), (zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)]
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


def refuse_taken(endpoint: str) -> None:
    """Raise ConfigError where somebody serves the endpoint: binding would take it from them without a word."""
    with suppress(FileNotFoundError, ConnectionRefusedError), socket.socket(socket.AF_UNIX) as trial:
        trial.connect(ipc_path(endpoint))
        raise ConfigError(
            f"another daemon serves {endpoint}", hint="end it (fringed status shows it), or give another endpoint"
        )


def send_now(to: zmq.asyncio.Socket, parts: Sequence[bytes]) -> bool:
    """Send without waiting; False where the peer's queue is full or the peer is gone."""
    # With DONTWAIT the future is done when it is returned.
    sent = cast("asyncio.Future[None]", to.send_multipart(parts, zmq.DONTWAIT))
    error = sent.exception()
    if error is None:
        return True
    if isinstance(error, zmq.ZMQError) and error.errno in (zmq.EAGAIN, zmq.EHOSTUNREACH):
        return False
    raise error
