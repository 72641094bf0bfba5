"""A scan on a KMS display and a V4L2 camera, both on CLOCK_MONOTONIC: proved by its stamps, and never by false ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.registry import open_camera
from drivers.v4l2.camera import V4l2Camera
from scanner.capture import Capture, CaptureHeader, CaptureWriter
from scanner.clock import MonotonicClock
from scanner.devices import Interval
from scanner.errors import SyncError
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize
from scanner.sequencer import Acquisition, FinishReason, acquire, check_capture, measure_latency
from service.config import RigConfig
from service.scan_setup import OpenRig, open_rig
from tests.rig import light_between, vivid

OUTPUT = "Virtual-1"
CLOCK = MonotonicClock()
SEQUENCE = PatternSequence.bracketed(
    ProjectorSize(vivid.WIDTH, vivid.HEIGHT), PmpPattern(frequencies=(1.0, 8.0), shifts=(3, 3))
)
EXPOSURE_NS = 2_000_000
CAMERA = {
    "mode": light_between.CAMERA_MODE,
    "pixel_format": "GREY",
    "shutter": "global",
    "readout_us": 1000,
    "exposure_us": EXPOSURE_NS / 1000,
}
"""It takes its whole picture in a moment, at the start of this exposure"""

CAMERA_FRAME_US = 1e6 / 72.8
PATTERN_US = 3e6 / 59.94
"""Three refreshes: the plan keeps a pattern on for two or three"""


def _rig(**camera: Any) -> OpenRig:
    config = RigConfig.model_validate(
        {
            "camera": {"driver": "v4l2", "device": vivid.CAMERA, "options": {**CAMERA, **camera}},
            "projector": {"driver": "kms", "device": OUTPUT, "mode": f"{vivid.WIDTH}x{vivid.HEIGHT}@59.94"},
        }
    )
    return open_rig(config.model_dump(mode="json"), CLOCK)


@dataclass(frozen=True)
class Measured:
    """What a rig file would say."""

    delay_us: tuple[float, float]
    latency: Interval
    settle: Interval


@pytest.fixture(scope="module", autouse=True)
def joined() -> None:
    vivid.join()


@pytest.fixture(scope="module")
def delay_us() -> tuple[float, float]:
    """vivid stamps frames by a grid of its own and takes their pictures when its thread comes to it."""
    camera = open_camera("v4l2", vivid.CAMERA, {**CAMERA, "stamp_delay_us": (0, 0)}, CLOCK)
    assert isinstance(camera, V4l2Camera)
    try:
        low, high = light_between.measured_delay_us(camera, 120)
    finally:
        camera.close()
    print(f"stamp minus picture: {low:.0f} .. {high:.0f} us")
    assert high - low < 3_000
    return low, high


@pytest.fixture(scope="module")
def measured(delay_us: tuple[float, float]) -> Measured:
    with light_between.light_between(OUTPUT):
        opened = _rig(stamp_delay_us=delay_us)
        try:
            latency, settle = measure_latency(opened.rig.projector, opened.rig.camera, CLOCK)
        finally:
            opened.close()
    print(f"latency {latency.low_ns / 1e6:.2f} .. {latency.high_ns / 1e6:.2f} ms, settle {settle.high_ns / 1e6:.2f} ms")
    # The picture was taken at the exposure's start: light that came later in it was not seen.
    assert latency.low_ns <= light_between.DELAY_NS + EXPOSURE_NS
    assert latency.high_ns + settle.high_ns >= light_between.DELAY_NS
    return Measured(delay_us, latency, settle)


def _scan(measured: Measured, folder: Path, **camera: Any) -> tuple[Acquisition, Capture]:
    with light_between.light_between(OUTPUT):
        opened = _rig(**camera)
        try:
            rig = replace(opened.rig, latency=measured.latency, settle=measured.settle)
            plan = rig.plan(SEQUENCE, exposure_ns=EXPOSURE_NS)
            header = CaptureHeader(SEQUENCE, CameraFormat(vivid.WIDTH, vivid.HEIGHT, 8), plan=plan.as_dict())
            writer = CaptureWriter(folder / "scan.capture", header, plan.frame_count)
            acquisition = acquire(rig, plan, SEQUENCE, writer, CLOCK)
            whole = acquisition.reason is FinishReason.COMPLETED
            writer.close("complete" if whole else "failed", acquisition.reason.value)
        finally:
            opened.close()
    print(f"dwell {plan.dwell}:", acquisition.report(), acquisition.error)
    return acquisition, Capture.open(folder / "scan.capture")


def _right(capture: Capture) -> list[bool]:
    """Of every frame: whether it is its pattern, to the bit."""
    return [np.array_equal(capture.frame(p), SEQUENCE.image(p)) for p in range(len(SEQUENCE))]


def test_every_frame_is_proved_and_is_its_pattern(measured: Measured, tmp_path: Path) -> None:
    acquisition, capture = _scan(measured, tmp_path, stamp_delay_us=measured.delay_us)
    assert acquisition.reason is FinishReason.COMPLETED
    assert acquisition.retakes == 0
    assert all(_right(capture))
    check = check_capture(capture)
    assert check.passed
    assert check.summary() == {"proved": len(SEQUENCE), "consistent": 0, "unproved": 0}


def test_without_a_measured_delay_nothing_is_proved(measured: Measured, tmp_path: Path) -> None:
    """As of every V4L2 camera, uvcvideo's among them: the kernel's word alone is an estimate."""
    acquisition, capture = _scan(measured, tmp_path)
    assert acquisition.reason is FinishReason.COMPLETED
    assert all(_right(capture))
    assert check_capture(capture).summary()["proved"] == 0


def test_stamps_that_lie_by_a_pattern_s_time_are_found_out_by_the_pictures(measured: Measured, tmp_path: Path) -> None:
    """Every exposure that they put into its pattern's time lay in the one before."""
    acquisition, capture = _scan(measured, tmp_path, stamp_delay_us=_false(measured, PATTERN_US))
    assert not all(_right(capture))
    assert acquisition.reason is FinishReason.SYNC_LOST
    assert isinstance(acquisition.error, SyncError)
    assert acquisition.error.frames
    assert not check_capture(capture).passed


def test_stamps_that_lie_by_a_camera_s_frame_give_no_wrong_capture(measured: Measured, tmp_path: Path) -> None:
    """What was not known of the latency may have room for it: then the frames are right. If not, the pictures tell."""
    acquisition, capture = _scan(measured, tmp_path, stamp_delay_us=_false(measured, CAMERA_FRAME_US))
    assert all(_right(capture)) or acquisition.reason is FinishReason.SYNC_LOST


def _false(measured: Measured, lie_us: float) -> tuple[float, float]:
    """A delay that makes exposures seem later by so much."""
    low, high = measured.delay_us
    return low - lie_us, high - lie_us
