"""The simulated GigE camera by the reading of somebody else: a client that shares nothing with Aravis nor with us.

viva-genicam (MIT) is no dependency; where it is not installed this is skipped. How to have it: see
docs/how-to/connect-a-gige-or-usb3-camera.md.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from drivers.simulated.gige_serve import GigeService

pytestmark = pytest.mark.alone

viva = pytest.importorskip(
    "viva_genicam", reason="the second GigE Vision client is not installed: pip install viva-genicam"
)

ADDRESS = "127.0.0.1"
"""It asks no other address of loopback who is there"""

FRAMES = 20
PACKETS = 40
"""at least so many a frame, at packets of 1400 bytes"""

viva.discover(timeout_ms=1)  # before sockets are counted: from its first call on it keeps two of its own


@pytest.fixture
def wire() -> dict[str, Any]:
    return {}


@pytest.fixture
def camera(wire: dict[str, Any]) -> Iterator[Any]:
    with GigeService("quick/board?seed=1", address=ADDRESS, count=1, light=None, wire=wire, options={}):
        found = [info for info in viva.discover(timeout_ms=300, all=True) if info.ip == ADDRESS]
        assert [(info.manufacturer, info.model) for info in found] == [("fringed", "simulated-gige")]
        with viva.connect_gige(found[0]) as opened:
            yield opened


def _frames(camera: Any, count: int) -> list[Any]:
    with camera.stream() as stream:
        return list(itertools.islice(stream, count))


def test_features_are_read_and_set_by_the_description_in_the_camera(camera: Any) -> None:
    assert camera.skipped() == []  # nothing in our XML that it cannot read
    assert (camera.get_integer("Width"), camera.get_integer("Height")) == (320, 240)
    assert camera.set_exposure_time(4000.0)
    assert camera.exposure_time() == 4000.0
    camera.set_float("Gain", 3.0)
    assert camera.get_float("Gain") == 3.0
    with pytest.raises(viva.GenicamError):
        camera.set_float("Gain", 99.0)
    camera.set_enum("PixelFormat", "Mono12")
    assert [frame.to_numpy().dtype for frame in _frames(camera, 1)] == [np.uint16]


def test_one_client_controls_it(camera: Any) -> None:
    with pytest.raises(viva.TransportError, match="ACCESS_DENIED"):
        viva.connect_gige(next(info for info in viva.discover(timeout_ms=300, all=True) if info.ip == ADDRESS))
    assert camera.control_state is viva.ControlState.HELD


def test_frames_follow_one_another_and_their_chunks_tell_of_them(camera: Any) -> None:
    for automatic in ("ExposureAuto", "GainAuto", "BalanceWhiteAuto"):
        camera.set_enum(automatic, "Off")
    camera.set_exposure_time(5000.0)
    camera.configure_chunks(["Timestamp", "ExposureTime"])
    tick_hz = camera.get_integer("GevTimestampTickFrequency")
    frames = _frames(camera, FRAMES)
    assert [frame.block_id for frame in frames] == list(range(1, FRAMES + 1))
    assert all(frame.is_complete and frame.to_numpy().shape == (240, 320) for frame in frames)
    for frame in frames:
        told = camera.chunk_features(frame)
        assert float(told["ChunkExposureTime"]) == 5000.0
        assert int(told["ChunkTimestamp"]) == frame.ts_dev
    for before, after in itertools.pairwise(frames):
        assert (after.ts_dev - before.ts_dev) / tick_hz >= 5e-3


def test_a_software_trigger_gives_one_frame(camera: Any) -> None:
    camera.set_exposure_time(2000.0)
    camera.enable_trigger("FrameStart", "Software")
    with camera.stream() as stream:
        for number in (1, 2, 3):
            camera.trigger_software()
            assert stream.next_frame(timeout_ms=2000).block_id == number
        with pytest.raises(viva.GenicamError):
            stream.next_frame(timeout_ms=200)  # nobody asked for it


@pytest.mark.parametrize("wire", [{"loss": 0.01}])
def test_lost_packets_are_asked_for_and_sent_again(camera: Any) -> None:
    with camera.stream() as stream:
        frames = list(itertools.islice(stream, FRAMES))
        counted = stream.stats()
    assert [frame.block_id for frame in frames] == list(range(1, FRAMES + 1))
    assert counted.resend_recovered > 0
    assert counted.packets_received >= FRAMES * PACKETS
