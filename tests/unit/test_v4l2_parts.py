"""What V4L2 devices need no kernel for: pixels in and out of buffers, exposures from stamps, units, names, options."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import ioctl
from drivers.registry import open_camera, open_projector
from drivers.v4l2 import camera_driver, driver, node
from drivers.v4l2 import videodev2 as v
from drivers.v4l2.controls import EXPOSURE_ABSOLUTE, Control, control_name
from drivers.v4l2.exposure import EXPOSURE_UNIT_NS, ExposureControl, Stamping
from drivers.v4l2.formats import CAPTURE_FORMATS, OUTPUT_FORMATS, FrameFormat, pack
from drivers.v4l2.queue import Dequeued, FrameCount
from drivers.v4l2.timings import parse_mode, same_rate
from scanner.clock import VirtualClock
from scanner.devices import Source
from scanner.errors import ConfigError, DeviceError, DeviceNotFound

MS = 1_000_000
RNG = np.random.default_rng(11)


def _frame(code: str, width: int, height: int, per_pixel: int, spare: int) -> FrameFormat:
    line = width * per_pixel + spare
    return FrameFormat(code, width, height, line, line * height, full_range=True)


# --- pixels -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spare", [0, 6])
@pytest.mark.parametrize("code", ["GREY", "Y10", "Y12", "Y16"])
def test_plain_formats_are_read_as_they_are(code: str, spare: int) -> None:
    """Lines may be longer than the picture; the last may end with it."""
    fmt = CAPTURE_FORMATS[code]
    kind = np.uint8 if fmt.bits == 8 else np.uint16
    pixels = RNG.integers(0, 1 << fmt.bits, (5, 8), dtype=kind)
    frame = _frame(code, 8, 5, kind().itemsize, spare)
    raw = np.zeros(frame.size, dtype=np.uint8)
    raw.reshape(5, -1)[:, : 8 * kind().itemsize] = pixels.view(np.uint8)
    read = fmt.unpack(raw[: frame.size - spare], frame)
    assert read is not None
    assert read.dtype == kind
    assert read.flags.c_contiguous
    assert np.array_equal(read, pixels)
    assert fmt.unpack(raw[: frame.size - spare - 1], frame) is None


def test_of_yuyv_the_luma_is_taken_untouched() -> None:
    raw = RNG.integers(0, 256, 2 * 6 * 4, dtype=np.uint8)
    read = CAPTURE_FORMATS["YUYV"].unpack(raw, _frame("YUYV", 6, 4, 2, 0))
    assert read is not None
    assert np.array_equal(read.ravel(), raw[::2])


def test_a_jpeg_is_decoded_and_one_cut_short_is_not_whole() -> None:
    image = np.tile(np.linspace(0, 255, 64).astype(np.uint8), (48, 1))
    written, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 98])
    assert written
    raw = np.asarray(encoded, dtype=np.uint8).ravel()
    fmt, frame = CAPTURE_FORMATS["MJPG"], _frame("MJPG", 64, 48, 0, 64)
    read = fmt.unpack(raw, frame)
    assert read is not None
    assert np.abs(read.astype(int) - image).max() <= 4
    assert fmt.unpack(np.concatenate((raw, np.zeros(9, dtype=np.uint8))), frame) is not None  # drivers pad
    assert fmt.unpack(raw[: raw.size // 2], frame) is None
    assert fmt.unpack(raw[:0], frame) is None
    assert fmt.unpack(raw, _frame("MJPG", 32, 48, 0, 32)) is None
    assert fmt.black(frame).shape == (48, 64)


@pytest.mark.parametrize("code", list(OUTPUT_FORMATS))
def test_a_grey_is_that_grey_in_every_output_format(code: str) -> None:
    per_pixel = {"GREY": 1, "YUYV": 2, "RGB3": 3, "BGR3": 3}.get(code, 4)
    frame = _frame(code, 6, 4, per_pixel, 2)
    image = RNG.integers(0, 256, (4, 6), dtype=np.uint8)
    buffer = np.zeros(frame.size + 5, dtype=np.uint8)
    pack(image, buffer, frame)
    lines = buffer[: frame.size].reshape(4, -1)
    pixels = lines[:, : 6 * per_pixel].reshape(4, 6, per_pixel)
    first = {"BX24": 1, "RGB4": 1}.get(code, 0)
    colours = pixels[..., first : first + (1 if code in {"GREY", "YUYV"} else 3)]
    assert all(np.array_equal(colours[..., i], image) for i in range(colours.shape[-1]))
    assert not lines[:, 6 * per_pixel :].any()
    if code == "YUYV":
        assert np.all(pixels[..., 1] == 128)


# --- time -------------------------------------------------------------------------------------------------------

SHOT = Dequeued(0, 0, 7, 1000 * MS, monotonic=True, start_of_exposure=True, damaged=False)
STAMPING = Stamping(5 * MS, 3 * MS, 20 * MS, rolling=True, delay_us=None)


def test_a_stamp_is_an_estimate_of_the_instant_its_flag_names() -> None:
    begins = STAMPING.exposure(SHOT, 990 * MS, 1010 * MS, "camera")
    assert (begins.start_ns, begins.end_ns) == (1000 * MS, 1008 * MS)
    ends = STAMPING.exposure(replace(SHOT, start_of_exposure=False), 980 * MS, 1010 * MS, "camera")
    assert (ends.start_ns, ends.end_ns) == (992 * MS, 1000 * MS)
    assert {begins.source, ends.source} == {Source.ESTIMATED}
    assert begins.bound_ns == ends.bound_ns == 40 * MS


def test_a_global_shutter_ends_with_its_exposure() -> None:
    exposed = replace(STAMPING, rolling=False).exposure(SHOT, 990 * MS, 1010 * MS, "camera")
    assert exposed.end_ns - exposed.start_ns == 5 * MS


def test_a_measured_delay_is_taken_off_and_halves_its_spread() -> None:
    measured = replace(STAMPING, delay_us=(6000.0, 8000.0))
    exposed = measured.exposure(SHOT, 990 * MS, 1010 * MS, "camera")
    assert exposed.start_ns == 993 * MS
    assert exposed.bound_ns == MS + 1000
    assert exposed.source is Source.DRIVER


@pytest.mark.parametrize("wrong", [{"monotonic": False}, {"t_ns": 10**18}, {"t_ns": 5 * MS}])
def test_a_stamp_of_another_clock_is_not_believed(wrong: dict[str, Any]) -> None:
    shot = replace(SHOT, **wrong)
    exposed = STAMPING.exposure(shot, 990 * MS, 1010 * MS, "camera")
    assert exposed.end_ns == 1010 * MS
    assert exposed.source is Source.ESTIMATED
    with pytest.raises(DeviceError, match="not of CLOCK_MONOTONIC"):
        replace(STAMPING, delay_us=(0.0, 1.0)).exposure(shot, 990 * MS, 1010 * MS, "camera")


@given(
    minimum=st.integers(-3, 50),
    span=st.integers(0, 5000),
    step=st.integers(1, 7),
    period_ms=st.integers(1, 100),
    asked=st.floats(0, 1),
)
def test_exposures_are_rounded_down_to_what_the_control_has(
    minimum: int, span: int, step: int, period_ms: int, asked: float
) -> None:
    means = ExposureControl(_control(minimum, minimum + span, step), EXPOSURE_UNIT_NS)
    low, high, step_ns = means.bounds(period_ms * MS)
    assert 0 < low <= high
    assert step_ns == step * EXPOSURE_UNIT_NS
    wanted = low + round(asked * (high - low))
    units = means.units(wanted)
    assert (units - minimum) % step == 0
    assert 0 <= wanted - units * EXPOSURE_UNIT_NS < step_ns


def test_an_exposure_is_no_longer_than_the_period() -> None:
    means = ExposureControl(_control(1, 5000, 1), EXPOSURE_UNIT_NS)
    assert means.bounds(33_333_333) == (100_000, 33_300_000, 100_000)


@pytest.mark.parametrize(
    ("said", "counted"),
    [
        ([0, 1, 2, 5], [0, 1, 2, 5]),
        ([10, 10, 12, 13], [10, 11, 12, 13]),  # two with one number: the next is its own again, and no frame is missed
        ([10, 10, 11, 14], [10, 11, 12, 14]),
        ([2**32 - 1, 0, 3], [2**32 - 1, 2**32, 2**32 + 3]),
    ],
)
def test_frames_are_counted_on_past_numbers_given_twice_and_the_wrap(said: list[int], counted: list[int]) -> None:
    count = FrameCount()
    assert [count.next(sequence) for sequence in said] == counted
    assert (count.frames, count.missing) == (len(said), counted[-1] - counted[0] + 1 - len(said))


def _control(minimum: int, maximum: int, step: int) -> Control:
    return Control(EXPOSURE_ABSOLUTE, "exposure_time_absolute", 1, minimum, maximum, step, minimum, 0)


# --- names and options ------------------------------------------------------------------------------------------


def test_control_names_are_those_of_v4l2_ctl() -> None:
    assert control_name("Exposure Time, Absolute") == "exposure_time_absolute"
    assert control_name("White Balance, Automatic") == "white_balance_automatic"


def test_modes_are_read_and_near_rates_are_told_apart() -> None:
    assert parse_mode("1280x720@59.94", "out") == (1280, 720, 59.94)
    assert parse_mode("640x480", "out") == (640, 480, None)
    for wrong in ("640", "640x480@", "axb", "640x480@60Hz"):
        with pytest.raises(ConfigError):
            parse_mode(wrong, "out")
    assert same_rate(59.94, 60_000 / 1001)
    assert not same_rate(59.94, 60)


def test_without_devices_a_name_is_not_found_and_the_list_is_empty(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(node, "DEVICES", tmp_path)
    assert node.nodes("camera") == []
    with pytest.raises(DeviceNotFound) as caught:
        open_camera("v4l2", "", {}, VirtualClock())
    assert "group video" in (caught.value.hint or "")
    with pytest.raises(DeviceNotFound):
        open_projector("v4l2", "no such output", {}, VirtualClock())


def test_a_name_of_by_id_is_its_link(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(node, "DEVICES", tmp_path)
    link = tmp_path / "v4l/by-id/usb-Maker_Model_1234-video-index0"
    link.parent.mkdir(parents=True)
    link.symlink_to("../../video0")
    (tmp_path / "video0").touch()
    assert node.find("usb-Maker_Model_1234-video-index0", "camera") == str(link)
    assert node.find("video0", "camera") == str(tmp_path / "video0")
    with pytest.raises(DeviceError, match="no V4L2 device"):
        open_camera("v4l2", "video0", {}, VirtualClock())


def _camera_of(kernel_driver: str) -> Callable[[ioctl.Node, int, Any], int]:
    """What a node answers to who asks what it is."""

    def answer(_: ioctl.Node, request: int, argument: Any) -> int:
        assert request == v.QUERYCAP
        argument.driver, argument.card = kernel_driver.encode(), b"Camera"
        argument.capabilities = v.CAP_VIDEO_CAPTURE | v.CAP_STREAMING
        return 0

    return answer


def test_a_link_that_goes_while_it_is_looked_at_hides_no_other(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Where one of a device's nodes is opened, udev may be at the other."""
    places = tmp_path / "v4l/by-path"
    places.mkdir(parents=True)
    for index in (0, 1):
        (tmp_path / f"video{index}").touch()
        (places / f"port-video-index{index}").symlink_to(f"../../video{index}")
    link_of = Path.resolve

    def resolve(path: Path) -> Path:
        if path.name == "port-video-index1":
            raise FileNotFoundError(path)
        return link_of(path)

    monkeypatch.setattr(node, "DEVICES", tmp_path)
    monkeypatch.setattr(Path, "resolve", resolve)
    monkeypatch.setattr(ioctl.Node, "call", _camera_of("uvcvideo"))
    opened, found = node.open_node(str(tmp_path / "video0"), "camera")
    opened.close()
    assert found.links == (str(places / "port-video-index0"),)


@pytest.mark.parametrize(
    ("kernel_driver", "parameter", "said"),
    [
        ("uvcvideo", "0", "of arrival, by uvcvideo; modprobe option: options uvcvideo hwtimestamps=1"),
        ("uvcvideo", "1", "of the camera's clock, by uvcvideo"),
        ("uvcvideo", None, None),
        ("vivid", "0", None),
    ],
)
def test_of_a_uvc_camera_it_is_told_what_its_stamps_are(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, kernel_driver: str, parameter: str | None, said: str | None
) -> None:
    """By what the node calls itself. Whatever that is, stamps are estimates until their delay was measured: above."""
    (tmp_path / "video0").touch()
    monkeypatch.setattr(node, "DEVICES", tmp_path)
    monkeypatch.setattr(ioctl.Node, "call", _camera_of(kernel_driver))
    monkeypatch.setattr(driver, "UVC_STAMPS", tmp_path / "hwtimestamps")
    if parameter is not None:
        (tmp_path / "hwtimestamps").write_text(f"{parameter}\n")
    (found,) = camera_driver.discover()
    assert found.details["kernel driver"] == kernel_driver
    assert found.details.get("stamps") == said


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"stamp_delay_us": [3, 1]}, "low, high"),
        ({"bufers": 4}, "did you mean 'buffers'"),
        ({"buffers": 1}, "buffers"),
        ({"shutter": "fast"}, "shutter"),
    ],
)
def test_options_that_make_no_sense_are_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        open_camera("v4l2", "", options, VirtualClock())
    assert said in f"{caught.value} {caught.value.hint}"
