"""`fringed simulate`: simulated devices that stand outside the daemon, on real wires, where any program finds them."""

from __future__ import annotations

import threading
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from service.commands.options import AsJson
from service.terminal import print_facts, print_json

BUFFERS = 64
"""Frames that a GigE camera's memory holds while the wire is busy: 128 MB of small ones"""

group = typer.Typer(
    help="Simulated devices on real wires, for drivers and programs that know nothing of this project.",
    rich_markup_mode=None,
    no_args_is_help=True,
)


@group.callback()
def _group() -> None:
    pass


@group.command("gige")
def gige(
    device: Annotated[
        str, typer.Argument(metavar="RIG/SCENE", help="What it sees, as the simulated camera's device string.")
    ] = "casey2011/bust",
    address: Annotated[str, typer.Option(metavar="IP", help="Address of the first camera, 127.x.x.x.")] = "127.0.0.2",
    count: Annotated[int, typer.Option(metavar="N", min=1, max=64, help="Cameras, at addresses that follow.")] = 1,
    loss: Annotated[
        float, typer.Option(metavar="SHARE", min=0.0, max=0.9, help="Share of packets that never arrive, 0 .. 0.9.")
    ] = 0.0,
    queue: Annotated[
        int, typer.Option(metavar="N", min=0, max=64, help="Triggers remembered while busy; 0: dropped.")
    ] = 0,
    link: Annotated[
        float, typer.Option(metavar="MBIT/S", min=0.0, help="Speed of the wire, Mbit/s; 0: unlimited.")
    ] = 0.0,
    ring: Annotated[
        int, typer.Option(metavar="N", min=0, max=4096, help="Send so many prepared frames in turn: fast.")
    ] = 0,
    readout: Annotated[
        float, typer.Option(metavar="MS", min=0.01, max=1000.0, help="Duration of a readout, ms.")
    ] = 5.0,
    shutter: Annotated[str, typer.Option(metavar="global|rolling", help="How the sensor is read.")] = "global",
    light: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Socket at which a simulated projector finds the camera.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the rig's true calibration there.")
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Put simulated GigE Vision cameras on this machine's loopback network, until interrupted.

    They answer any program that speaks GigE Vision: fringed devices lists them, a rig file names one by its address.

    \b
    Examples:
      fringed simulate gige
      fringed simulate gige quick/board --address 127.0.0.5 --loss 0.001
      fringed simulate gige casey2011/bust --calibration scans/bust.json --light /tmp/bust.light
    And in another terminal, with a copy of docs/examples/gige.toml in scans:
      fringed scan --rig scans/gige.toml
    """
    from drivers.registry import load_simulator  # noqa: PLC0415
    from scanner.storage import try_file  # noqa: PLC0415
    from service.logs import start_logging  # noqa: PLC0415

    if calibration is not None:
        try_file(calibration)
    serve = load_simulator("gige")
    start_logging("simulate")
    wire = {"loss": loss, "queue": queue, "link_mbit_s": link}
    options = {"ring": ring, "shutter": shutter, "readout_us": 1e3 * readout, "buffers": BUFFERS}
    with serve(device, address=address, count=count, light=light, wire=wire, options=options) as service:
        if calibration is not None:
            service.write_calibration(calibration)
        if as_json:
            print_json(dict(service.facts))
        else:
            piece = f'camera = {{ driver = "aravis", device = "{address}" }}'
            print_facts("simulated GigE Vision cameras", [*service.facts, ("in a rig file", piece), ("end", "Ctrl-C")])
        with suppress(KeyboardInterrupt):  # Ctrl-C is how it is ended
            while True:
                threading.Event().wait(3600.0)
    return 0
