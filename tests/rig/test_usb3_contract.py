"""The contract suite on the Aravis driver with a USB3 Vision camera, and the count of triggers that frames carry."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from drivers.aravis.library import aravis
from drivers.registry import open_camera
from scanner.clock import MonotonicClock
from scanner.devices import Camera, CameraSettings, TriggerMode
from tests.contract.suite import CameraBench, CameraContract
from tests.rig import usb3_camera
from tests.rig.usb3_camera import SERIAL, Usb3Camera

CLOCK = MonotonicClock()
SECOND_NS = 1_000_000_000

pytestmark = pytest.mark.real_time


@pytest.fixture(scope="module", autouse=True)
def plugged() -> Iterator[Usb3Camera]:
    aravis().update_device_list()  # it keeps a socket to the kernel from then on
    with Usb3Camera() as camera:
        usb3_camera.wait_for(lambda: list(Path("/sys/bus/usb/devices").glob("2-1/serial")))
        subprocess.run(["udevadm", "settle", "--timeout=10"], check=True)
        yield camera
    aravis().shutdown()


@contextmanager
def _opened() -> Iterator[Camera]:
    camera = open_camera("aravis", SERIAL, {}, CLOCK)
    try:
        yield camera
    finally:
        camera.close()


@pytest.fixture(scope="class")
def camera() -> Iterator[Camera]:
    """Opened once: that takes seconds in the guest. The contract's last test closes it."""
    with _opened() as camera:
        yield camera


class TestUsb3Camera(CameraContract):
    @pytest.fixture
    def bench(self, camera: Camera, plugged: Usb3Camera) -> Iterator[CameraBench]:
        yield CameraBench(camera, CLOCK, plugged.set_light)
        camera.stop()
        plugged.set_light(0)


def test_frames_carry_the_count_of_triggers_also_of_those_that_found_it_busy() -> None:
    """In a chunk behind the picture: little-endian tags, unlike on the network."""
    with _opened() as camera:
        camera.apply(CameraSettings(exposure_ns=50_000_000))
        camera.start(TriggerMode.SOFTWARE)
        numbers = []
        for triggers in (1, 1, 3, 1):
            for _ in range(triggers):
                camera.trigger()
            frame = camera.pop(5 * SECOND_NS)
            assert frame is not None
            numbers.append(frame.trigger)
        assert numbers == [0, 1, 2, 5]
