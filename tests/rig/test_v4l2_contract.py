"""The contract suite on V4L2 cameras and outputs: the kernel's own vivid."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drivers.registry import open_camera, open_projector
from scanner.clock import MonotonicClock
from tests.contract.suite import CameraBench, CameraContract, ProjectorBench, ProjectorContract
from tests.rig import vivid


@pytest.mark.real_time
class TestV4l2Camera(CameraContract):
    @pytest.fixture(params=("GREY", "Y16", "YUYV"))
    def bench(self, request: pytest.FixtureRequest) -> Iterator[CameraBench]:
        vivid.join()
        clock = MonotonicClock()
        options = {"mode": vivid.MODE, "pixel_format": request.param}
        camera = open_camera("v4l2", vivid.CAMERA, options, clock)
        yield CameraBench(camera, clock)
        camera.close()


@pytest.mark.real_time
class TestV4l2Output(ProjectorContract):
    @pytest.fixture(params=("XR24", "GREY"))
    def bench(self, request: pytest.FixtureRequest) -> Iterator[ProjectorBench]:
        clock = MonotonicClock()
        options = {"mode": vivid.MODE, "pixel_format": request.param}
        projector = open_projector("v4l2", vivid.PROJECTOR, options, clock)
        yield ProjectorBench(projector, clock)
        projector.close()
