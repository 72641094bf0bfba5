"""V4L2 on the kernel's vivid: the closed loop pixel for pixel, gaps, controls, errors, and pulling the device out."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from drivers.ioctl import Node
from drivers.kms.projector import KmsProjector
from drivers.kms.writeback import read_back
from drivers.registry import open_camera, open_projector
from drivers.v4l2 import camera_driver, controls, projector_driver
from drivers.v4l2.camera import V4l2Camera
from drivers.v4l2.node import GROUP
from drivers.v4l2.output import V4l2Output
from scanner.clock import MonotonicClock
from scanner.decode import decoder_for
from scanner.devices import CameraFrame, CameraSettings, Source, TriggerMode
from scanner.errors import ConfigError, DeviceBusy, DeviceError, DeviceLost, DeviceNotFound
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize
from tests.rig import vivid
from tests.rig.punctual import punctual

SECOND_NS = 1_000_000_000
BY_PATH = "platform-vivid.0-video-index0"


@contextmanager
def camera(device: str = vivid.CAMERA, **options: object) -> Iterator[V4l2Camera]:
    opened = open_camera("v4l2", device, {"mode": vivid.MODE, **options}, MonotonicClock())
    assert isinstance(opened, V4l2Camera)
    try:
        yield opened
    finally:
        opened.close()


@contextmanager
def projector(device: str = vivid.PROJECTOR, **options: object) -> Iterator[V4l2Output]:
    opened = open_projector("v4l2", device, {"mode": vivid.MODE, **options}, MonotonicClock())
    assert isinstance(opened, V4l2Output)
    try:
        yield opened
    finally:
        opened.close()


def _popped(opened: V4l2Camera) -> CameraFrame:
    frame = opened.pop(2 * SECOND_NS)
    assert frame is not None
    return frame


def _seen(shown: V4l2Output, seen: V4l2Camera, index: int) -> np.ndarray:
    """The first frame that was begun after the image came on show. vivid has no latency but its own two clocks'."""
    flip = shown.show(index)
    while (frame := _popped(seen)).exposure.start_ns < flip.t_ns:
        assert frame.complete
    _popped(seen)
    return _popped(seen).pixels.copy()


# --- the closed loop --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("code", ["GREY", "YUYV"])
def test_pictures_come_back_pixel_for_pixel(code: str) -> None:
    """vivid's loop takes the format of both ends to be the same; see devices.md."""
    vivid.join()
    rng = np.random.default_rng(3)
    images = [rng.integers(0, 256, (vivid.HEIGHT, vivid.WIDTH), dtype=np.uint8) for _ in range(3)]
    with projector(pixel_format=code) as shown, camera(pixel_format=code) as seen:
        shown.load(images)
        seen.start(TriggerMode.FREE)
        for index in (0, 1, 2, 0):
            assert np.array_equal(_seen(shown, seen, index), images[index])


@pytest.mark.parametrize("through_kms", [False, True])
def test_a_pmp_sequence_goes_round_and_is_decoded(through_kms: bool) -> None:
    """Every frame is its pattern to the bit, so the decoded rows are the pattern's own.

    Through KMS, what goes into the loop is what a KMS display was sent, read back.
    """
    vivid.join()
    pattern = PmpPattern(frequencies=(1.0, 8.0), shifts=(4, 4))
    sequence = PatternSequence.bracketed(ProjectorSize(vivid.WIDTH, vivid.HEIGHT), pattern)
    decoder = decoder_for(sequence, CameraFormat(vivid.WIDTH, vivid.HEIGHT, 8))
    images = [sequence.image(position) for position in range(len(sequence))]
    with projector(pixel_format="GREY") as shown, camera(pixel_format="GREY") as seen:
        shown.load(_sent_by_kms(images) if through_kms else images)
        seen.start(TriggerMode.FREE)
        for position, image in enumerate(images):
            frame = _seen(shown, seen, position)
            assert np.array_equal(frame, image)
            decoder.add(position, frame)
    rows = decoder.finish().rows
    assert rows is not None
    # Greys are rounded to 1/255: 8 bits over eight fringes of 60 rows are good to a tenth of a row.
    assert np.abs(rows - np.arange(vivid.HEIGHT)[:, np.newaxis]).max() < 0.1


def _sent_by_kms(images: list[np.ndarray]) -> list[np.ndarray]:
    """What a KMS display of the same size is sent for these images: its green."""
    display = open_projector("kms", "Virtual-1", {"mode": f"{vivid.WIDTH}x{vivid.HEIGHT}"}, MonotonicClock())
    assert isinstance(display, KmsProjector)
    try:
        display.load(images)
        sent = []
        for index in range(len(images)):
            display.show(index)
            sent.append(np.ascontiguousarray(read_back(display)[..., 1]))
        return sent
    finally:
        display.close()


# --- counts, stamps, controls -----------------------------------------------------------------------------------


@pytest.mark.real_time
def test_frames_that_nobody_fetched_show_as_a_gap() -> None:
    with camera(buffers=3) as seen:
        seen.start(TriggerMode.FREE)
        before = _popped(seen)
        time.sleep(0.5)
        frames = [_popped(seen) for _ in range(6)]
        steps = [b.frame_id - a.frame_id for a, b in itertools.pairwise([before, *frames])]
        assert max(steps) > 5
        assert min(steps) >= 1


def test_measured_stamps_are_the_drivers_and_shifted_by_the_delay() -> None:
    delay = (1000.0, 3000.0)
    with camera(stamp_delay_us=delay, shutter="global", exposure_us=4000) as seen:
        c = seen.capabilities
        assert c.stamp is Source.DRIVER
        assert c.stamp_bound_ns == 1_000_000 + 1000
        seen.start(TriggerMode.FREE)
        frame = _popped(seen)
        assert frame.exposure.source is Source.DRIVER
        assert frame.exposure.end_ns - frame.exposure.start_ns == 4_000_000
        assert abs(time.monotonic_ns() - frame.exposure.start_ns) < SECOND_NS


def test_automatic_gain_is_off_and_read_back() -> None:
    node = Node(vivid.CAMERA, "vivid", group=GROUP)
    try:
        known = controls.controls(node)
        controls.write(node, known["gain_automatic"], 1)
        with camera() as seen:
            assert seen.automatics["gain_automatic"] == 0
            assert controls.read(node, known["gain_automatic"]) == 0
        controls.write(node, known["gain_automatic"], 1)
        with camera(keep=["gain_automatic"]):
            assert controls.read(node, known["gain_automatic"]) == 1
    finally:
        node.close()


def test_controls_are_set_by_name_within_their_bounds() -> None:
    with camera(controls={"brightness": 77, "gain": 40}):
        node = Node(vivid.CAMERA, "vivid", group=GROUP)
        try:
            known = controls.controls(node)
            assert controls.read(node, known["brightness"]) == 77
            assert controls.read(node, known["gain"]) == 40
        finally:
            node.close()
    with pytest.raises(ConfigError) as bounds, camera(controls={"brightness": 300}):
        pass
    assert "0 .. 255" in (bounds.value.hint or "")
    with pytest.raises(ConfigError) as name, camera(controls={"brightnes": 3}):
        pass
    assert "did you mean 'brightness'" in (name.value.hint or "")


# --- names and refusals -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("device", ["", "video10", BY_PATH, f"/dev/v4l/by-path/{BY_PATH}", "platform:vivid-000"])
def test_a_camera_answers_to_its_names(device: str) -> None:
    with camera(device) as seen:
        assert "vivid" in seen.name


def test_both_nodes_are_listed_by_stable_names() -> None:
    assert [info.device for info in camera_driver.discover()] == [f"/dev/v4l/by-path/{BY_PATH}"]
    assert [info.details["node"] for info in projector_driver.discover()] == [vivid.PROJECTOR]


def test_what_is_wrong_is_named() -> None:
    with pytest.raises(DeviceNotFound), camera("/dev/video99"):
        pass
    with pytest.raises(DeviceNotFound) as none, camera("no such camera"):
        pass
    assert BY_PATH in (none.value.hint or "")
    with pytest.raises(DeviceError, match="no streaming camera"), camera(vivid.PROJECTOR):
        pass
    with pytest.raises(DeviceError, match="no V4L2 device"), camera("/dev/null"):
        pass
    with pytest.raises(ConfigError) as mode, camera(mode="123x45@60"):
        pass
    assert "640x480@" in (mode.value.hint or "")
    with pytest.raises(ConfigError) as rate, camera(mode="640x480@60"):  # it has 59.94, which is not 60
        pass
    assert "59.9" in (rate.value.hint or "")
    with pytest.raises(ConfigError), camera(pixel_format="Y14"):
        pass
    with pytest.raises(ConfigError), camera(size=[7, 5]):
        pass


def test_a_camera_in_use_is_busy_and_its_user_named() -> None:
    with camera() as first:
        with pytest.raises(DeviceBusy), camera():
            pass
        assert first.apply(CameraSettings()).pixel_format is not None


# --- pulled out -------------------------------------------------------------------------------------------------


@pytest.fixture
def pulled() -> Iterator[None]:
    yield
    vivid.plug_in()


@pytest.mark.usefixtures("pulled")
@pytest.mark.parametrize("state", ["idle", "armed", "mid-sequence"])
def test_a_camera_pulled_out_is_lost_at_once(state: str) -> None:
    def pull() -> float:
        vivid.plug_in()
        with camera() as seen:
            if state != "idle":
                seen.start(TriggerMode.FREE)
            if state == "mid-sequence":
                for _ in range(3):
                    _popped(seen)
            vivid.unplug()
            before = time.monotonic()
            with pytest.raises(DeviceLost):
                _until_lost(seen) if state != "idle" else seen.check_present()
            took = time.monotonic() - before
            seen.stop()
        with pytest.raises(DeviceNotFound), camera():
            pass
        return took

    punctual(1, pull)


@pytest.mark.usefixtures("pulled")
@pytest.mark.parametrize("state", ["idle", "mid-sequence"])
def test_a_projector_pulled_out_is_lost_at_once(state: str) -> None:
    black = np.zeros((vivid.HEIGHT, vivid.WIDTH), dtype=np.uint8)

    def pull() -> float:
        vivid.plug_in()
        with projector() as shown:
            shown.load([black])
            if state == "mid-sequence":
                for _ in range(3):
                    shown.show(0)
            vivid.unplug()
            before = time.monotonic()
            for use in (shown.check_present, lambda: shown.show(0), lambda: shown.load([black])):
                with pytest.raises(DeviceLost):
                    use()
            return time.monotonic() - before

    punctual(1, pull)


def test_devices_put_back_work_within_seconds() -> None:
    def put_back() -> float:
        vivid.unplug()
        before = time.monotonic()
        vivid.plug_in()
        with projector(pixel_format="GREY") as shown, camera(pixel_format="GREY") as seen:
            shown.load([np.full((vivid.HEIGHT, vivid.WIDTH), 77, dtype=np.uint8)])
            seen.start(TriggerMode.FREE)
            assert np.all(_seen(shown, seen, 0) == 77)
        return time.monotonic() - before

    punctual(5, put_back)


def _until_lost(seen: V4l2Camera) -> None:
    """Frames that were done before may still be fetched."""
    while True:
        _popped(seen)
