"""GigE cameras end to end: the real library, real packets, a simulated camera on the wire, and what goes wrong."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from drivers.aravis import camera_driver
from drivers.aravis.camera import AravisCamera
from drivers.simulated import gige_features as f
from drivers.simulated.gige import GigeCamera, WireOptions
from drivers.simulated.lines import Recorded
from scanner.clock import MonotonicClock
from scanner.devices import CameraFrame, CameraSettings, Source, TriggerMode
from scanner.errors import ConfigError, DeviceBusy, DeviceError, DeviceLost, DeviceNotFound

pytest.importorskip("gi", reason="cameras behind Aravis need python3-gi (setup/packages.txt)")
pytestmark = pytest.mark.alone

SECOND_NS = 1_000_000_000
ADDRESS = "127.0.0.21"
CALM = {"noise": False, "readout_us": 1000.0}
"""No noise: frames of one light are equal"""


@dataclass
class Pair:
    """A camera on the wire, and the driver's hold on it."""

    wire: GigeCamera
    camera: AravisCamera

    def frames(self, count: int) -> list[CameraFrame]:
        """Frames whose pixels may be kept."""
        found = []
        for _ in range(count):
            frame = self.camera.pop(2 * SECOND_NS)
            assert frame is not None
            found.append(CameraFrame(**{**frame.__dict__, "pixels": frame.pixels.copy()}))
        return found

    def rest(self) -> list[CameraFrame]:
        """Frames until none comes any more."""
        found = []
        while (frame := self.camera.pop(SECOND_NS // 4)) is not None:
            found.append(frame)
        return found


@contextmanager
def pair(
    options: dict[str, Any] | None = None, exposure_ms: float = 4.0, device: str = "quick/board", **wire: Any
) -> Iterator[Pair]:
    clock = MonotonicClock()
    wire["options"] = {**CALM, **wire.get("options", {})}
    on_the_wire = GigeCamera(device, WireOptions(ADDRESS, **wire), clock)
    try:
        camera = camera_driver.open(ADDRESS, {"packet_size": 1500, **(options or {})}, clock)
        try:
            camera.apply(CameraSettings(exposure_ns=round(1e6 * exposure_ms)))
            yield Pair(on_the_wire, camera)
        finally:
            camera.close()
    finally:
        on_the_wire.close()


# --- packets ----------------------------------------------------------------------------------------------------------


def test_lost_packets_are_sent_again_and_no_frame_is_lost() -> None:
    with pair(loss=0.01) as it:  # 55 packets a frame: two frames in five lose some
        it.camera.start(TriggerMode.FREE)
        frames = it.frames(60)
        it.camera.stop()
        counts = it.camera.details["stream"]
        assert all(frame.complete for frame in frames)
        assert [frame.frame_id for frame in frames] == list(range(1, 61))
        assert all(np.array_equal(frame.pixels, frames[0].pixels) for frame in frames)
        assert counts["n_resent_packets"] >= 10
        assert it.wire.counts.lost_packets >= 10


def test_without_resend_frames_in_part_say_so() -> None:
    with pair({"resend": False}, loss=0.01) as it:
        it.camera.start(TriggerMode.FREE)
        frames = it.frames(40)
        whole = [frame for frame in frames if frame.complete]
        assert 3 <= len(whole) < len(frames)
        assert all(np.array_equal(frame.pixels, whole[0].pixels) for frame in whole)
        assert it.camera.details["stream"]["n_failures"] >= 1


def test_a_host_that_is_slow_loses_frames_by_count() -> None:
    with pair({"buffers": 3}) as it:
        it.camera.start(TriggerMode.FREE)
        time.sleep(0.15)
        ids = [frame.frame_id for frame in it.frames(6)]
        assert ids[-1] - ids[0] > 5
        assert it.camera.details["stream"]["n_underruns"] > 0


# --- time -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("clock", "source"), [("auto", Source.HARDWARE), ("arrival", Source.ESTIMATED)])
def test_stamps_are_true_within_their_bounds(clock: str, source: Source) -> None:
    options = {"clock": clock, "arrival_bound_us": 15_000.0}
    with pair(options, clock_ppm=-80.0, tick_hz=62_500_000) as it:
        for mode in (TriggerMode.FREE, TriggerMode.SOFTWARE):
            it.camera.start(mode)
            for _ in range(25):
                if mode is TriggerMode.SOFTWARE:
                    it.camera.trigger()
                (frame,) = it.frames(1)
                truth = it.wire.true_start_ns(frame.frame_id)
                assert abs(frame.exposure.start_ns - truth) <= frame.exposure.bound_ns
                assert frame.exposure.source is source
            it.camera.stop()
        assert it.camera.details["clock"]["latched"] is (clock == "auto")


# --- triggers ---------------------------------------------------------------------------------------------------------


def test_every_edge_on_the_line_gives_a_frame() -> None:
    with pair({"features": {"TestLinePeriod": 8_333, "TestLinePulses": 36, "DeviceUserID": "by the door"}}) as it:
        it.camera.start(TriggerMode.HARDWARE)
        it.camera.execute("TestLineStart")
        frames = it.frames(36)
        assert [frame.trigger for frame in frames] == list(range(36))
        spacing = [b.exposure.start_ns - a.exposure.start_ns for a, b in itertools.pairwise(frames)]
        assert min(spacing) > 8_000_000
        assert it.camera.triggers_counted() == 36


@pytest.mark.parametrize("queue", [0, 1])
def test_missed_triggers_are_recognised_with_and_without_a_latch(queue: int) -> None:
    """Frame ids are consecutive whatever was missed: the camera's own count tells."""
    with pair({"features": {"TestLinePeriod": 3_000, "TestLinePulses": 40}}, queue=queue) as it:
        it.camera.start(TriggerMode.HARDWARE)
        it.camera.execute("TestLineStart")
        frames = it.rest()
        numbers = [frame.trigger for frame in frames]
        assert [frame.frame_id for frame in frames] == list(range(1, len(frames) + 1))
        assert None not in numbers
        assert sorted(set(numbers)) == numbers
        missed = set(range(it.camera.triggers_counted() or 0)) - set(numbers)
        assert len(missed) + len(frames) == 40
        assert len(frames) <= 26
        assert len(missed) == it.wire.dropped_triggers + 0


def test_the_world_s_own_line_fires_the_camera() -> None:
    with pair() as it:
        line = it.wire.world.lines["trigger"] = Recorded()
        it.camera.start(TriggerMode.HARDWARE)
        begun = time.monotonic_ns()
        for i in range(5):
            line.add(begun + i * 10_000_000)
        frames = it.frames(5)
        assert [frame.trigger for frame in frames] == list(range(5))
        for i, frame in enumerate(frames):
            late = frame.exposure.start_ns - (begun + i * 10_000_000)
            assert -frame.exposure.bound_ns <= late <= 20_000 + frame.exposure.bound_ns


def test_triggers_sent_to_a_busy_camera_are_counted() -> None:
    with pair(exposure_ms=20.0) as it:
        it.camera.start(TriggerMode.SOFTWARE)
        for _ in range(3):
            it.camera.trigger()
        first = it.frames(1)[0]
        it.camera.trigger()
        assert (first.trigger, it.frames(1)[0].trigger) == (0, 3)


# --- settings ---------------------------------------------------------------------------------------------------------


def test_everything_automatic_is_off_and_stays_off() -> None:
    with pair() as it:
        registers = it.wire._registers
        for address in (f.EXPOSURE_AUTO, f.GAIN_AUTO, f.WHITE_AUTO):
            assert registers.word(address) == f.AUTO["Off"]
        assert registers.number(f.GAMMA) == 1.0
        assert set(it.camera.details["switched_off"]) == {"ExposureAuto", "GainAuto", "BalanceWhiteAuto", "Gamma"}


def test_pixel_formats_agree_with_one_another() -> None:
    with pair() as it:
        means = {}
        for name in ("Mono8", "Mono10p", "Mono10Packed", "Mono12", "Mono12p", "Mono12Packed", "Mono16", "BayerRG8"):
            assert it.camera.apply(CameraSettings(pixel_format=name)).pixel_format == name
            caps = it.camera.capabilities
            it.camera.start(TriggerMode.FREE)
            (frame,) = it.frames(1)
            it.camera.stop()
            assert frame.pixels.shape == (caps.height, caps.width)
            means[name] = frame.pixels.mean() / caps.max_value
            assert caps.mosaic == ("RGGB" if name.startswith("Bayer") else None)
        assert means["Mono8"] > 0
        assert all(mean == pytest.approx(means["Mono8"], abs=0.003) for mean in means.values())


def test_region_and_binning_show_their_part_of_the_picture() -> None:
    with pair() as it:
        it.camera.start(TriggerMode.FREE)
        whole = it.frames(1)[0].pixels
        it.camera.stop()
        assert it.camera.apply(CameraSettings(region=(40, 20, 160, 100))).region == (40, 20, 160, 100)
        it.camera.start(TriggerMode.FREE)
        assert np.array_equal(it.frames(1)[0].pixels, whole[20:120, 40:200])
        it.camera.stop()
        for region, said in (((2, 0, 318, 240), "multiple of 4"), ((200, 0, 160, 100), "leaves the sensor")):
            with pytest.raises(ConfigError, match=said):
                it.camera.apply(CameraSettings(region=region))
        assert it.camera.apply(CameraSettings()).region == (40, 20, 160, 100)
    with pair({"binning": 2}) as it:
        assert (it.camera.capabilities.width, it.camera.capabilities.height) == (160, 120)
        it.camera.start(TriggerMode.FREE)
        halves = whole.reshape(120, 2, 160, 2).mean(axis=(1, 3))
        assert np.abs(it.frames(1)[0].pixels - halves).max() <= 0.5


def test_settings_that_a_camera_takes_in_part_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """The region is set and the gain is not: frames have the region that the camera has."""

    def half(camera: Any, features: Any, settings: CameraSettings, name: str) -> None:
        camera.set_region(*(settings.region or ()))
        raise DeviceError("Gain is locked", device=name)

    with pair() as it:
        monkeypatch.setattr("drivers.aravis.settings.put", half)
        with pytest.raises(DeviceError, match="Gain"):
            it.camera.apply(CameraSettings(gain_db=6.0, region=(0, 0, 160, 100)))
        it.camera.start(TriggerMode.FREE)
        assert it.frames(1)[0].pixels.shape == (100, 160)


def test_the_frame_rate_is_kept_or_refused() -> None:
    with pair({"frame_rate_hz": 40.0}) as it:
        it.camera.start(TriggerMode.FREE)
        starts = [frame.exposure.start_ns for frame in it.frames(5)]
        assert all(b - a == pytest.approx(25e6, abs=5e5) for a, b in itertools.pairwise(starts))
        it.camera.stop()
        it.camera.apply(CameraSettings(exposure_ns=50_000_000))
        with pytest.raises(ConfigError, match="too many"):
            it.camera.start(TriggerMode.FREE)


def test_options_that_the_camera_cannot_follow_are_refused() -> None:
    for options, said in (
        ({"features": {"NoSuchThing": 1}}, "NoSuchThing"),
        ({"features": {"Gain": [1]}}, "features.Gain"),
        ({"features": {"GainAuto": "Sometimes"}}, "features.GainAuto has no 'Sometimes'"),
        ({"features": {"SensorReadoutTime": 3.0}}, "features.SensorReadoutTime cannot be set"),
        ({"binning": 9}, "1 .. 4"),
    ):
        with pytest.raises(ConfigError, match=said), pair(options):
            pass
    for options, said in (({"trigger_line": "Line9"}, "Line9"), ({"overlap": True}, "readout")):
        with pair(options) as it, pytest.raises(ConfigError, match=said):
            it.camera.start(TriggerMode.HARDWARE)


def use(camera: AravisCamera, state: str) -> None:
    """What somebody does with it, for three seconds."""
    until = time.monotonic() + 3.0
    while time.monotonic() < until:
        camera.apply(CameraSettings()) if state == "idle" else camera.pop(5 * SECOND_NS)


# --- loss -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "state"),
    [("unplug", "idle"), ("unplug", "armed"), ("unplug", "mid-sequence"), ("hang", "mid-sequence")],
)
def test_a_camera_that_goes_away_is_noticed_and_taken_up_again(fault: str, state: str) -> None:
    patience = {} if state == "mid-sequence" else {"loss_ms": 300.0}
    with pair({"features": {"GevHeartbeatTimeout": 1300}, **patience}, exposure_ms=3.0) as it:
        camera = it.camera
        wanted = camera.apply(CameraSettings(gain_db=6.0, region=(0, 0, 160, 100)))
        if state != "idle":
            camera.start(TriggerMode.HARDWARE if state == "armed" else TriggerMode.FREE)
        if state == "mid-sequence":
            it.frames(3)
        getattr(it.wire, fault)()
        gone = time.monotonic()
        with pytest.raises(DeviceLost) as raised:
            use(camera, state)
        assert time.monotonic() - gone < 1.0
        assert ADDRESS in str(raised.value)
        assert raised.value.hint
        camera.stop()
        with pytest.raises(DeviceLost):
            camera.start(TriggerMode.FREE)
        assert time.monotonic() - gone < 1.2
        it.wire.plug() if fault == "unplug" else it.wire.resume()
        back = time.monotonic()
        while True:
            try:
                assert camera.apply(CameraSettings()) == wanted
                break
            except DeviceLost:
                assert time.monotonic() - back < 5.0
                time.sleep(0.02)
        camera.start(TriggerMode.FREE)
        assert it.frames(2)[1].pixels.shape == (100, 160)
        assert camera.details["losses"] == 1


def test_the_machine_s_setup_is_looked_at_for_this_camera() -> None:
    with pair() as it:
        findings = {finding.subject: finding for finding in it.camera.check_setup(20_000.0)}
        assert set(findings) == {"receive buffer", "packet size", "link speed"}
        assert "20000 frames a second of 76800 bytes" in findings["link speed"].text


def test_a_trigger_to_a_camera_that_hangs_fails_within_a_second() -> None:
    with pair() as it:
        it.camera.start(TriggerMode.SOFTWARE)
        it.wire.hang()
        begun = time.monotonic()
        with pytest.raises(DeviceLost):
            it.camera.trigger()
        assert time.monotonic() - begun < 1.0


def test_a_camera_that_somebody_else_controls_is_busy() -> None:
    with pair(), pytest.raises(DeviceBusy, match="another program"):
        camera_driver.open(ADDRESS, {}, MonotonicClock())


def test_a_camera_that_refuses_to_stop_is_given_back_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    with pair() as it:
        it.camera.start(TriggerMode.FREE)

        def refuse(command: str) -> None:
            raise DeviceError(f"{command} is refused")

        monkeypatch.setattr(it.camera._running.features, "execute", refuse)
        with pytest.raises(DeviceError, match="AcquisitionStop"):
            it.camera.close()
        camera_driver.open(ADDRESS, {}, MonotonicClock()).close()


def test_an_address_where_nobody_is() -> None:
    with pytest.raises(DeviceNotFound, match=r"127\.0\.0\.99"):
        camera_driver.open("127.0.0.99", {}, MonotonicClock())
