"""`fringed preview`: what the camera sees, for aiming and focusing, as a picture file and in figures."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.commands.options import AsJson, Connect, require_picture
from service.commands.scan import rig_daemon
from service.terminal import print_facts, print_json, progress_lines, status_line

if TYPE_CHECKING:
    from scanner.camera_picture import CameraPicture
    from scanner.client import Client

LINE_S = 0.5
"""Time from one line, and one picture file, to the next"""


def preview(
    rig: Annotated[str | None, typer.Option(metavar="RIG", help="A rig file, or simulated[:SCENE].")] = None,
    connect: Connect = None,
    picture: Annotated[
        Path, typer.Option("--picture", "-o", metavar="FILE", help="The newest picture, png or jpg, written anew.")
    ] = Path("preview.png"),
    rate: Annotated[float, typer.Option(metavar="HZ", min=0.1, max=60, help="Pictures a second.")] = 10.0,
    width: Annotated[
        int,
        typer.Option(
            metavar="PX",
            min=16,
            max=8192,
            help="Widest picture, pixels; of wider ones every 2nd, 3rd, ... pixel is taken.",
        ),
    ] = 1280,
    seconds: Annotated[
        float | None, typer.Option(metavar="S", min=0, help="End by itself after so many seconds.")
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Look through the camera while the projector shows white. Ctrl-C ends it.

    Twice a second a picture file is written anew (open it in a viewer that follows changes); a line tells how bright
    and how sharp it is, whenever that changes. Aim; open the lens as far as nothing saturates; turn the focus to the
    most sharpness.

    \b
    mean       of all pixels, share of the camera's range
    bright     grey level that one pixel in 200 exceeds, share of the range; scans expose for at most 95% of it
    saturated  share of the pixels at the top of the range, where it is more than 1 in 1000
    sharpness  100 x rms slope of the picture over its mean level, noise taken off; without a unit, and good only for
               comparing one focus with another in the same view. best: the largest so far

    \b
    Examples:
      fringed preview --seconds 5                          the simulated rig
      fringed preview --rig simulated --seconds 2 --json
      fringed preview --rig bench.toml
      fringed preview --connect ipc:///run/fringed/control.ipc -o now.jpg
    """
    if rig is not None and connect is not None:
        raise typer.BadParameter("--rig and --connect exclude each other: a running daemon has a rig of its own")
    require_picture(picture)
    from scanner.client import Client  # noqa: PLC0415
    from scanner.storage import try_file  # noqa: PLC0415

    try_file(picture)
    watching = Watching(picture)
    with progress_lines() as lines, rig_daemon(rig, connect, lines) as endpoint:
        lines.stage("preparing")
        with Client(endpoint, name="fringed preview") as client:
            bits = _bits(client)
            with (
                closing(client.previews(rate_hz=rate, max_width=width)) as pictures,
                suppress(KeyboardInterrupt),  # Ctrl-C is how it is ended
                status_line() as line,
            ):
                lines.end()
                watching.all(_for(seconds, pictures), bits, line)
    facts = {"picture": str(picture) if watching.seen else None, "pictures": watching.seen, **watching.figures}
    if as_json:
        print_json(facts)
    else:
        print_facts("preview", [("picture", facts["picture"] or "none came"), ("pictures", watching.seen)])
    return 0


class Watching:
    """Reads pictures; writes the newest and its figures now and then."""

    def __init__(self, path: Path) -> None:
        self.seen = 0
        self.figures: Mapping[str, float] = {}
        self._path = path
        self._next = 0.0
        self._best = 0.0
        self._said = ""

    def all(self, pictures: Iterator[CameraPicture], bits: int, line: Callable[[str], None]) -> None:
        """Until they end. line: is given each line that differs from the one before."""
        for picture in pictures:
            self.seen += 1
            if time.monotonic() >= self._next:
                self._next = time.monotonic() + LINE_S
                self.figures = picture.figures(bits)
                self._best = max(self._best, self.figures["sharpness"])
                write_picture(self._path, picture, bits)
                said = words(self.figures, self._best)
                if said != self._said:  # a view at rest says so once
                    line(said)
                self._said = said


def words(figures: Mapping[str, float], best: float) -> str:
    """The line: brightness, saturation, sharpness now and at its best."""
    saturated = f"{figures['saturated']:.1%} saturated: close the lens or expose less  " * (
        figures["saturated"] > 0.001
    )
    return (
        f"mean {figures['mean']:.0%} of the range  bright {figures['bright']:.0%}  {saturated}"
        f"sharpness {figures['sharpness']:.2f}, best {best:.2f}"
    )


def write_picture(path: Path, picture: CameraPicture, bits: int) -> None:
    """The picture as 8-bit file, whole or not at all."""
    import cv2  # noqa: PLC0415
    import numpy as np  # noqa: PLC0415

    from scanner.storage import replace_file  # noqa: PLC0415

    shown = np.asarray(picture.pixels >> max(bits - 8, 0), dtype=np.uint8)
    replace_file(path, cv2.imencode(path.suffix, shown)[1].tobytes())


def _for(seconds: float | None, pictures: Iterator[CameraPicture]) -> Iterator[CameraPicture]:
    deadline = None if seconds is None else time.monotonic() + seconds
    for picture in pictures:
        yield picture
        if deadline is not None and time.monotonic() > deadline:
            return


def _bits(client: Client) -> int:
    """Of the camera's pixels. A daemon opens its devices for the first who asks for something of them."""
    client.preview_start()
    devices: dict[str, Any] | None = client.status()["devices"]
    return 8 if devices is None else int(devices["camera"]["bits"])
