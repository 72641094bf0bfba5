"""Simulated GigE Vision cameras as a service: what `fringed simulate gige` starts, found through the registry.

Each camera has an address and a world of its own; the first also listens for a simulated projector in another
process. Until one is there the scene is lit evenly, so that a client sees something.
"""

from __future__ import annotations

import ipaddress
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import numpy as np

from drivers.simulated.gige import GigeCamera, WireOptions
from drivers.simulated.gige_light import LightReceiver
from drivers.simulated.timeline import LoadedImage
from scanner.clock import MonotonicClock
from scanner.errors import ConfigError
from scanner.storage import replace_json

EVENLY = 255
"""Grey level of the whole picture while no projector is connected"""


class GigeService:
    """Cameras on the wire, from `__init__` to `close`; a context manager."""

    def __init__(
        self,
        device: str,
        *,
        address: str,
        count: int,
        light: Path | None,
        wire: Mapping[str, Any],
        options: Mapping[str, Any],
    ) -> None:
        """Start.

        Args:
            device: RIG/SCENE[?option=value], as the simulated camera's.
            address: of the first camera; the others have those that follow.
            count: of cameras.
            light: path of the socket for a simulated projector; None: a path in the temporary folder.
            wire: further members of `WireOptions`.
            options: of the simulated camera.

        Raises:
            ConfigError, DeviceBusy: see `GigeCamera`.
        """
        self.device = device
        self._path = light or Path(tempfile.gettempdir()) / f"fringed-gige-{address}.light"
        self._stack = ExitStack()
        self.cameras: list[GigeCamera] = []
        with ExitStack() as started:
            for one in _addresses(address, count):
                camera = GigeCamera(device, WireOptions(one, options=options, **wire), MonotonicClock())
                started.callback(camera.close)
                size = camera.world.rig.calibration.projector.size
                evenly = LoadedImage(np.full((size[1], size[0]), EVENLY, dtype=np.uint8))
                camera.world.timeline.show(time.monotonic_ns(), evenly)
                self.cameras.append(camera)
            started.callback(LightReceiver(self.cameras[0].world, self._path).close)
            self._stack = started.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def facts(self) -> Sequence[tuple[str, str]]:
        """What a user needs to know, by name."""
        rig = self.cameras[0].world.rig.calibration
        width, height = rig.camera.size
        return (
            ("scene", self.device),
            ("cameras", ", ".join(camera.address for camera in self.cameras)),
            ("sensor", f"{width} x {height}"),
            ("socket for a simulated projector", str(self._path)),
        )

    def write_calibration(self, path: Path) -> None:
        """The rig's true geometry, as a calibration file for the rig file of a scan."""
        replace_json(path, self.cameras[0].world.calibration.as_dict())

    def close(self) -> None:
        """Take the cameras off the wire."""
        self._stack.close()


def _addresses(first: str, count: int) -> list[str]:
    try:
        begin = ipaddress.IPv4Address(first)
        return [str(begin + i) for i in range(count)]
    except ValueError as error:
        raise ConfigError(f"{first!r} is no IPv4 address: {error}", hint="take one like 127.0.0.2") from error


serve = GigeService
