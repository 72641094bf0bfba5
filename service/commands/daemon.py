"""`fringed daemon`, `fringed worker`: the processes of a rig."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer


def daemon(
    config: Annotated[str, typer.Argument(metavar="CONFIG", help="A rig file, or simulated[:SCENE].")],
    connect: Annotated[
        str | None,
        typer.Option("--endpoint", metavar="ENDPOINT", help="Listen here instead of the rig file's endpoint."),
    ] = None,
    state: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for jobs and captures that outlive the daemon. Default: $STATE_DIRECTORY, else "
            "/var/lib/fringed for root, ~/.local/state/fringed for others.",
        ),
    ] = None,
) -> int:
    """Drive a rig and answer clients, until told to stop.

    \b
    Examples:
      fringed daemon simulated --endpoint ipc:///tmp/try.ipc --state /tmp/try
      fringed scan --connect ipc:///tmp/try.ipc            in another terminal
      fringed daemon /etc/fringed/rig.toml
    """
    from service.config import load_rig  # noqa: PLC0415
    from service.daemon import run_daemon  # noqa: PLC0415
    from service.logs import start_logging  # noqa: PLC0415

    rig = load_rig(config)
    start_logging("daemon")
    run_daemon(rig, state_dir=state or state_folder(), endpoint=connect or rig.daemon.endpoint, lifeline=False)
    return 0


def worker(
    connect: Annotated[str, typer.Option("--connect", metavar="ENDPOINT", help="The daemon's endpoint for workers.")],
) -> int:
    """Decode for a daemon, beside the workers it starts itself, until told to stop.

    Its endpoint for workers stands beside the one for clients: worker.ipc by control.ipc, NAME-worker.ipc by NAME.ipc.

    \b
    Examples:
      fringed worker --connect ipc:///run/fringed/worker.ipc
      fringed worker --connect ipc:///tmp/try-worker.ipc   of a daemon at ipc:///tmp/try.ipc
    """
    from scanner.errors import Unreachable  # noqa: PLC0415
    from service.logs import start_logging  # noqa: PLC0415
    from service.worker import run_worker  # noqa: PLC0415

    start_logging("worker")
    try:
        run_worker(connect)
    except Unreachable as error:
        error.hint = "of a daemon at ipc:///DIR/NAME.ipc give ipc:///DIR/NAME-worker.ipc; of control.ipc worker.ipc"
        raise
    return 0


def state_folder() -> Path:
    """Where systemd says, or the system's place for root, or this user's."""
    if given := os.environ.get("STATE_DIRECTORY"):
        return Path(given.split(":")[0])
    if os.geteuid() == 0:
        return Path("/var/lib/fringed")
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "fringed"
