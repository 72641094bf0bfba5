"""What both clients do with sockets: connect, with a limit on everything, and never wait without an end."""

from __future__ import annotations

import socket
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import zmq

from scanner.session import Call, Procedure, socket_file, unreachable
from scanner.wire import MAX_LIVE_BYTES, MAX_MESSAGE_BYTES

if TYPE_CHECKING:
    from scanner.scan import Scan

_Socket = TypeVar("_Socket", bound="zmq.Socket[Any]")

EVENTS_HWM = 10_000
"""Events that wait for a slow reader; it finds a gap in their numbers when there were more."""

WELCOME_S = 2.0
"""How long a subscription may take until it counts."""


def single(call: Call) -> Procedure[Any]:
    """One call as a procedure."""
    return (yield call)


def loaded(folder: Path) -> Scan:
    """The scan in a folder."""
    from scanner.scan import load_scan  # noqa: PLC0415  (clients that want no arrays do not pay for NumPy's kernels)

    return load_scan(folder)


def send(control: Any, data: bytes) -> None:
    """Send without waiting: where the queue to a daemon that is gone is full, the call is sent again later."""
    with suppress(zmq.Again):
        control.send(data, zmq.DONTWAIT)


def configured(opened: _Socket) -> _Socket:
    """A new socket with its limits set."""
    opened.setsockopt(zmq.LINGER, 0)
    opened.setsockopt(zmq.SNDHWM, 1000)
    opened.setsockopt(zmq.RCVHWM, EVENTS_HWM)
    opened.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
    opened.setsockopt(zmq.RECONNECT_IVL, 50)
    opened.setsockopt(zmq.RECONNECT_IVL_MAX, 1000)
    return opened


def conflated(opened: _Socket, endpoint: str) -> _Socket:
    """A SUB socket on the live endpoint that holds the newest result alone."""
    opened.setsockopt(zmq.LINGER, 0)
    opened.setsockopt(zmq.CONFLATE, 1)
    opened.setsockopt(zmq.MAXMSGSIZE, MAX_LIVE_BYTES)
    opened.setsockopt(zmq.RECONNECT_IVL, 50)  # and no longer with each attempt: a worker may take a second to be there
    opened.setsockopt(zmq.SUBSCRIBE, b"")
    opened.connect(endpoint)
    return opened


def probe(endpoint: str) -> None:
    """Raise Unreachable at once where nobody listens: ZeroMQ itself would wait without a word."""
    path = socket_file(endpoint)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as trial:
        trial.settimeout(1.0)
        try:
            trial.connect(str(path))
        except FileNotFoundError:
            raise unreachable(endpoint, "the socket does not exist") from None
        except ConnectionRefusedError:
            raise unreachable(endpoint, "nobody listens on the socket") from None
        except PermissionError:
            error = unreachable(endpoint, "this user may not open the socket")
            error.hint = "become a member of the daemon's group (log in again afterwards)"
            raise error from None
        except OSError as error:
            raise unreachable(endpoint, str(error.strerror or error)) from None
