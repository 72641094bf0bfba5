"""The contract suite on the aravis driver: the real library, and a simulated camera on a real wire."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import numpy as np
import pytest

from drivers.aravis import camera_driver
from drivers.registry import open_projector
from drivers.simulated.gige import GigeCamera, WireOptions
from scanner.clock import MonotonicClock
from tests.contract.suite import CameraBench, CameraContract

pytest.importorskip("gi", reason="cameras behind Aravis need python3-gi (setup/packages.txt)")
pytestmark = pytest.mark.alone

ADDRESS = "127.0.0.11"
CAMERAS = (
    (
        "quick/board",
        {"shutter": "rolling"},
        {"packet_size": 1500, "shutter": "rolling", "features": {"PixelFormat": "Mono12p"}},
    ),
)


class TestAravisCamera(CameraContract):
    @pytest.fixture(params=CAMERAS, ids=("rolling-packed",))
    def bench(self, request: pytest.FixtureRequest) -> Iterator[CameraBench]:
        device, wire, options = request.param
        clock = MonotonicClock()
        with ExitStack() as stack:
            stack.callback(GigeCamera(device, WireOptions(ADDRESS, options=wire), clock).close)
            projector = open_projector("simulated", device, {}, clock)
            stack.callback(projector.close)
            camera = camera_driver.open(ADDRESS, options, clock)
            stack.callback(camera.close)

            def set_light(level: int) -> None:
                c = projector.capabilities
                projector.load([np.full((c.height, c.width), level, dtype=np.uint8)])
                clock.sleep_until(projector.show(0).t_ns + 3 * c.refresh_ns)

            yield CameraBench(camera, clock, set_light)
