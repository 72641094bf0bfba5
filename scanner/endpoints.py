"""Endpoints: where a daemon's sockets are, as addresses of ZeroMQ and as files. Nothing is opened here."""

from __future__ import annotations

from scanner.wire import Refused

DEFAULT_ENDPOINT = "ipc:///run/fringed/control.ipc"


def ipc_path(endpoint: str) -> str:
    """The socket file of a local endpoint.

    Raises:
        Refused: not ipc, or longer than the system's socket names.
    """
    if not endpoint.startswith("ipc://"):
        raise Refused(
            f"endpoint {endpoint!r} is not local: only ipc:// is served",
            reason="endpoint",
            hint="connections from other machines need CURVE keys, which this version does not have; "
            "use ipc:// here, or forward the socket through ssh",
        )
    path = endpoint.removeprefix("ipc://")
    if not path.isprintable():
        raise Refused(f"endpoint {endpoint!r:.120} has characters that no socket's name should have", reason="endpoint")
    if not path.startswith("/") or len(path.encode()) > 100:  # sockaddr_un holds 107, siblings add a few
        raise Refused(f"endpoint {endpoint!r} needs an absolute path of at most 100 bytes", reason="endpoint")
    return path


def sibling(endpoint: str, name: str) -> str:
    """The endpoint of another socket of the same daemon: events, preview, live or worker."""
    folder, _, file = ipc_path(endpoint).rpartition("/")
    stem = file.removesuffix(".ipc")
    return f"ipc://{folder}/{name if stem == 'control' else f'{stem}-{name}'}.ipc"
