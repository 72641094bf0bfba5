"""The contract suite on the simulated devices, in virtual time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from drivers.registry import open_camera, open_projector
from scanner.clock import VirtualClock
from tests.contract.suite import CameraBench, CameraContract, ProjectorBench, ProjectorContract

PROJECTORS = (
    "quick/board",
    "quick/board?scan=rows",
    "quick/board?modulation=pwm",
    "quick/board?kind=static",
    "quick/board?declare_latency=false",
)

CAMERAS = (
    "quick/board",
    "quick/sphere_board?shutter=rolling&seed=1",
    "quick/bust?bits=12&seed=2",
    "quick/board?modulation=pwm&shutter=rolling",
    "quick/blocks?ring=3",
)


class TestSimulatedProjector(ProjectorContract):
    @pytest.fixture(params=PROJECTORS)
    def bench(self, request: pytest.FixtureRequest) -> Iterator[ProjectorBench]:
        clock = VirtualClock()
        projector = open_projector("simulated", request.param, {}, clock)
        yield ProjectorBench(projector, clock)
        projector.close()


class TestSimulatedCamera(CameraContract):
    @pytest.fixture(params=CAMERAS)
    def bench(self, request: pytest.FixtureRequest) -> Iterator[CameraBench]:
        clock = VirtualClock()
        camera = open_camera("simulated", request.param, {}, clock)
        projector = open_projector("simulated", request.param, {}, clock)

        def set_light(level: int) -> None:
            c = projector.capabilities
            projector.load([np.full((c.height, c.width), level, dtype=np.uint8)])
            clock.sleep_until(projector.show(0).t_ns + 10 * c.refresh_ns)

        yield CameraBench(camera, clock, set_light)
        camera.close()
        projector.close()
