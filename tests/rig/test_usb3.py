"""A USB3 Vision camera through Aravis over the guest's USB: the udev rule, who may open it, frames, pulling it out."""

from __future__ import annotations

import shutil
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from drivers.aravis import camera_driver
from drivers.aravis.camera import AravisCamera
from drivers.aravis.library import aravis
from drivers.registry import open_camera
from scanner.clock import MonotonicClock
from scanner.devices import CameraSettings, Source, TriggerMode
from scanner.errors import DeviceBusy, DeviceLost
from tests.rig import usb3_camera
from tests.rig.punctual import punctual
from tests.rig.usb3_camera import SERIAL, Usb3Camera

SECOND_NS = 1_000_000_000
RULES = Path(__file__).parents[2] / "udev/70-fringed.rules"
OPTIONS = {"count_triggers": False}

ASK = f"""
from drivers.registry import open_camera
from scanner.clock import MonotonicClock
from scanner.errors import DeviceError
try:
    camera = open_camera("aravis", "{SERIAL}", {{}}, MonotonicClock())
    print("opened", camera.capabilities.width)
    camera.close()
except DeviceError as error:
    print(type(error).__name__, error, error.hint)
"""


@pytest.fixture(scope="module", autouse=True)
def rules() -> Iterator[None]:
    """The rules as they are installed, for what is plugged in from now on; and the library's look at all of USB."""
    shutil.copy(RULES, "/etc/udev/rules.d")
    subprocess.run(["udevadm", "control", "--reload"], check=True)
    aravis().update_device_list()  # it keeps a socket to the kernel from then on
    yield
    aravis().shutdown()


@pytest.fixture
def plugged() -> Iterator[Usb3Camera]:
    with Usb3Camera() as camera:
        usb3_camera.wait_for(lambda: list(Path("/sys/bus/usb/devices").glob("2-1/serial")))
        subprocess.run(["udevadm", "settle", "--timeout=10"], check=True)
        yield camera


@contextmanager
def opened() -> Iterator[AravisCamera]:
    camera = open_camera("aravis", SERIAL, OPTIONS, MonotonicClock())
    assert isinstance(camera, AravisCamera)
    try:
        yield camera
    finally:
        camera.close()


def _asked_as(*groups: str) -> str:
    """What an ordinary user, a member of these groups, is told who opens it."""
    ran = subprocess.run(
        [sys.executable, "-P", "-c", ASK],
        user="nobody",
        group="nogroup",
        extra_groups=groups,
        capture_output=True,
        text=True,
        timeout=100,
        check=True,
        cwd=RULES.parents[1],
        env={"PYTHONPATH": str(RULES.parents[1]), "PATH": "/usr/bin:/bin"},
    )
    return ran.stdout


def test_members_of_its_group_may_open_it_and_others_are_told_which(plugged: Usb3Camera) -> None:
    node = usb3_camera.node()
    assert (node.group(), stat.S_IMODE(node.stat().st_mode)) == ("video", 0o660)
    assert _asked_as("video") == f"opened {usb3_camera.WIDTH}\n"
    refused = _asked_as()
    assert "DeviceNotFound" in refused
    assert "be a member of the group" in refused


def test_it_is_listed(plugged: Usb3Camera) -> None:
    (found,) = [info for info in camera_driver.discover() if info.details.get("serial_number", SERIAL) == SERIAL]
    assert SERIAL in found.device
    assert usb3_camera.MODEL in (found.model or "")


def test_its_frames_come_whole_in_order_and_stamped(plugged: Usb3Camera) -> None:
    with opened() as camera:
        assert camera.details["address"].endswith(SERIAL)
        taken = camera.apply(CameraSettings(exposure_ns=2_000_000))
        assert taken.exposure_ns == 2_000_000
        for _ in range(2):  # a second run begins anew
            camera.start(TriggerMode.FREE)
            for number in range(10):
                frame = camera.pop(5 * SECOND_NS)
                assert frame is not None
                assert frame.complete
                assert np.array_equal(frame.pixels, plugged.picture(number))
                assert frame.exposure.source in {Source.HARDWARE, Source.ESTIMATED}
                assert abs(time.monotonic_ns() - frame.exposure.start_ns) < 2 * SECOND_NS
            camera.stop()
        assert camera.details["clock"]["latched"]


def test_a_trigger_gives_one_frame(plugged: Usb3Camera) -> None:
    with opened() as camera:
        camera.start(TriggerMode.SOFTWARE)
        for number in range(3):
            camera.trigger()
            frame = camera.pop(5 * SECOND_NS)
            assert frame is not None
            assert np.array_equal(frame.pixels, plugged.picture(number))
            assert camera.pop(SECOND_NS // 5) is None


@pytest.mark.filterwarnings("ignore:g_thread_join")  # Aravis 0.8.26 joins a thread that it did not come to start
@pytest.mark.usefixtures("plugged")
def test_one_that_somebody_else_has_is_busy() -> None:
    with opened(), pytest.raises(DeviceBusy), opened():
        pass


@pytest.mark.real_time
@pytest.mark.usefixtures("plugged")
@pytest.mark.parametrize("state", ["idle", "mid-sequence"])
def test_one_pulled_out_is_lost_at_once_and_found_again(state: str) -> None:
    back: list[float] = []

    def pull() -> float:
        usb3_camera.cable(plugged=True)
        with opened() as camera:
            if state == "mid-sequence":
                camera.start(TriggerMode.FREE)
                for _ in range(3):
                    assert camera.pop(5 * SECOND_NS) is not None
            usb3_camera.cable(plugged=False)
            began = time.monotonic()
            with pytest.raises(DeviceLost):
                _use_until_lost(camera)
            took = time.monotonic() - began
            camera.stop()
            usb3_camera.cable(plugged=True)
            began = time.monotonic()
            _use_until_back(camera)
            back.append(time.monotonic() - began)
        return took

    punctual(1, pull)
    print(f"{state}: in use again after {min(back):.1f} s")
    assert min(back) <= 5


def _use_until_lost(camera: AravisCamera) -> None:
    """Frames that were done before may still be fetched."""
    while True:
        if not camera.counts:
            camera.execute("TimestampLatch")
        else:
            camera.pop(SECOND_NS // 10)


def _use_until_back(camera: AravisCamera) -> None:
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        try:
            camera.start(TriggerMode.FREE)
        except DeviceLost:
            time.sleep(0.05)
        else:
            assert camera.pop(5 * SECOND_NS) is not None
            return
    pytest.fail("it was not found again")
