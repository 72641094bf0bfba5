"""`fringed daemon`, `fringed worker`: the processes of a rig."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from service.commands.options import AsJson
from service.terminal import print_json


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
    as_json: AsJson = False,
) -> int:
    """Drive a rig and answer clients, until told to stop.

    With --json the document is printed once clients are answered: endpoints, pid and rig.

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

    def ready(endpoints: Mapping[str, str]) -> None:
        if as_json:
            print_json({"endpoints": dict(endpoints), "pid": os.getpid(), "rig": rig.rig.name})

    run_daemon(rig, state_dir=state or state_folder(), endpoint=connect or rig.daemon.endpoint, ready=ready)
    return 0


def worker(
    connect: Annotated[
        str, typer.Option("--connect", metavar="ENDPOINT", help="The daemon's endpoint, as for clients.")
    ],
    as_json: AsJson = False,
) -> int:
    """Decode for a daemon, beside the workers it starts itself, until told to stop.

    The daemon says where its endpoint for workers is. With --json the document is printed once it takes work: endpoint
    and pid.

    \b
    Examples:
      fringed worker --connect ipc:///run/fringed/control.ipc
      fringed worker --connect ipc:///tmp/try.ipc          of fringed daemon simulated --endpoint ipc:///tmp/try.ipc
    """
    from service.logs import start_logging  # noqa: PLC0415
    from service.worker import run_worker  # noqa: PLC0415

    start_logging("worker")

    def ready() -> None:
        if as_json:
            print_json({"endpoint": connect, "pid": os.getpid()})

    run_worker(connect, ready=ready)
    return 0


def state_folder() -> Path:
    """Where systemd says, or the system's place for root, or this user's."""
    if given := os.environ.get("STATE_DIRECTORY"):
        return Path(given.split(":")[0])
    if os.geteuid() == 0:
        return Path("/var/lib/fringed")
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "fringed"
