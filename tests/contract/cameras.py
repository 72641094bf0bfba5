"""The contract of cameras, as a test class: see `suite`."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from scanner.clock import Clock
from scanner.devices import (
    Camera,
    CameraFrame,
    CameraSettings,
    KnowsTruth,
    TriggerMode,
)
from scanner.errors import ConfigError, DeviceError

SECOND_NS = 1_000_000_000


@dataclass
class CameraBench:
    """An open, stopped camera."""

    camera: Camera
    clock: Clock
    set_light: Callable[[int], None] | None = None
    """sets the scene's brightness 0..255 and returns when it is steady; None where the bench cannot"""


class CameraContract:
    """What every `Camera` keeps."""

    def test_is_a_camera_with_sane_capabilities(self, bench: CameraBench) -> None:
        c = bench.camera.capabilities
        assert isinstance(bench.camera, Camera)
        assert bench.camera.name
        assert c.width > 0
        assert c.height > 0
        assert 1 <= c.bits <= 16
        assert 0 < c.exposure_min_ns <= c.exposure_max_ns
        assert c.exposure_step_ns > 0
        assert c.readout_ns >= 0
        assert c.min_gap_ns >= 0
        assert c.stamp_bound_ns >= 0
        assert c.trigger_modes
        assert c.gain_min_db <= c.gain_max_db

    def test_settings_are_read_back_within_a_step(self, bench: CameraBench) -> None:
        c = bench.camera.capabilities
        asked = min(max(5_000_000 + 333, c.exposure_min_ns), c.exposure_max_ns)
        taken = bench.camera.apply(CameraSettings(exposure_ns=asked, gain_db=c.gain_min_db))
        assert taken.exposure_ns is not None
        assert abs(taken.exposure_ns - asked) <= c.exposure_step_ns
        assert bench.camera.apply(CameraSettings()) == taken

    def test_settings_outside_the_bounds_are_refused(self, bench: CameraBench) -> None:
        c = bench.camera.capabilities
        before = bench.camera.apply(CameraSettings())
        for settings in (
            CameraSettings(exposure_ns=c.exposure_max_ns + c.exposure_step_ns),
            CameraSettings(exposure_ns=max(c.exposure_min_ns - c.exposure_step_ns, 0) or -1),
            CameraSettings(gain_db=c.gain_max_db + 1.0),
            CameraSettings(gain_db=c.gain_min_db - 1.0),
            CameraSettings(pixel_format="no such format"),
            CameraSettings(region=(0, 0, c.width + 1, c.height)),
        ):
            with pytest.raises(ConfigError):
                bench.camera.apply(settings)
        assert bench.camera.apply(CameraSettings()) == before

    def test_free_running_frames_follow_at_a_period_no_shorter_than_declared(self, bench: CameraBench) -> None:
        exposure = self._mode(bench, TriggerMode.FREE)
        frames = [self._popped(bench) for _ in range(4)]
        starts = [f.exposure.start_ns for f in frames]
        shortest = bench.camera.capabilities.min_period_ns(exposure)
        for before, after in itertools.pairwise(frames):
            bound = before.exposure.bound_ns + after.exposure.bound_ns
            assert after.exposure.start_ns - before.exposure.start_ns >= shortest - bound
        assert starts == sorted(starts)
        assert len({f.frame_id for f in frames}) == 4

    def test_a_frame_is_what_the_capabilities_say(self, bench: CameraBench) -> None:
        exposure = self._mode(bench, TriggerMode.FREE)
        c = bench.camera.capabilities
        frame = self._popped(bench)
        assert frame.pixels.shape == (c.height, c.width)
        assert frame.pixels.dtype == (np.uint8 if c.bits <= 8 else np.uint16)
        assert frame.pixels.flags.c_contiguous
        assert frame.pixels.max() <= c.max_value
        assert frame.complete
        length = frame.exposure.end_ns - frame.exposure.start_ns
        whole = exposure + (c.readout_ns if c.shutter == "rolling" else 0)
        assert abs(length - whole) <= 2 * frame.exposure.bound_ns + c.exposure_step_ns
        assert frame.exposure.bound_ns <= c.stamp_bound_ns
        assert frame.exposure.source is c.stamp

    def test_exposures_end_before_their_frames_come(self, bench: CameraBench) -> None:
        self._mode(bench, TriggerMode.FREE)
        for _ in range(3):
            frame = self._popped(bench)
            assert frame.exposure.end_ns <= bench.clock.now_ns() + frame.exposure.bound_ns

    def test_pixels_are_lent_until_the_next_pop(self, bench: CameraBench) -> None:
        self._mode(bench, TriggerMode.FREE)
        frame = self._popped(bench)
        taken = frame.pixels.copy()
        bench.clock.sleep_until(bench.clock.now_ns() + SECOND_NS // 10)
        assert np.array_equal(frame.pixels, taken)

    def test_pop_gives_up_when_its_time_is_over(self, bench: CameraBench) -> None:
        if TriggerMode.SOFTWARE not in bench.camera.capabilities.trigger_modes:
            return
        self._mode(bench, TriggerMode.SOFTWARE)
        called = bench.clock.now_ns()
        assert bench.camera.pop(50_000_000) is None
        assert bench.clock.now_ns() - called >= 50_000_000
        called = bench.clock.now_ns()
        assert bench.camera.pop(0) is None
        assert bench.clock.now_ns() - called < 50_000_000

    def test_a_software_trigger_gives_one_frame_within_its_latency(self, bench: CameraBench) -> None:
        if TriggerMode.SOFTWARE not in bench.camera.capabilities.trigger_modes:
            return
        exposure = self._mode(bench, TriggerMode.SOFTWARE)
        for _ in range(3):
            bench.clock.sleep_until(bench.clock.now_ns() + bench.camera.capabilities.min_period_ns(exposure))
            before = bench.clock.now_ns()
            bench.camera.trigger()
            after = bench.clock.now_ns()
            frame = self._popped(bench)
            latency = bench.camera.capabilities.trigger_latency
            bound = frame.exposure.bound_ns
            assert frame.exposure.start_ns >= before - bound
            if latency is not None:
                assert before + latency.low_ns - bound <= frame.exposure.start_ns <= after + latency.high_ns + bound
            assert bench.camera.pop(0) is None

    def test_a_busy_camera_drops_the_trigger(self, bench: CameraBench) -> None:
        if TriggerMode.SOFTWARE not in bench.camera.capabilities.trigger_modes:
            return
        self._mode(bench, TriggerMode.SOFTWARE)
        bench.camera.trigger()
        bench.camera.trigger()
        assert self._popped(bench) is not None
        assert bench.camera.pop(SECOND_NS // 5) is None

    def test_a_trigger_after_the_shortest_period_is_taken(self, bench: CameraBench) -> None:
        if TriggerMode.SOFTWARE not in bench.camera.capabilities.trigger_modes:
            return
        exposure = self._mode(bench, TriggerMode.SOFTWARE)
        latency = bench.camera.capabilities.trigger_latency
        spread = 0 if latency is None else latency.high_ns - latency.low_ns
        bench.camera.trigger()
        first = bench.clock.now_ns()
        bench.clock.sleep_until(first + bench.camera.capabilities.min_period_ns(exposure) + spread)
        bench.camera.trigger()
        a = self._popped(bench).exposure
        b = self._popped(bench).exposure
        assert b.start_ns >= a.end_ns - a.bound_ns - b.bound_ns

    def test_a_trigger_needs_its_mode(self, bench: CameraBench) -> None:
        self._mode(bench, TriggerMode.FREE)
        with pytest.raises(DeviceError):
            bench.camera.trigger()

    def test_frames_from_before_a_start_are_gone(self, bench: CameraBench) -> None:
        self._mode(bench, TriggerMode.FREE)
        bench.clock.sleep_until(bench.clock.now_ns() + SECOND_NS // 2)
        bench.camera.stop()
        bench.camera.stop()
        begun = bench.clock.now_ns()
        bench.camera.start(TriggerMode.FREE)
        frame = self._popped(bench)
        assert frame.exposure.start_ns >= begun - frame.exposure.bound_ns

    def test_pop_and_trigger_need_a_start(self, bench: CameraBench) -> None:
        with pytest.raises(DeviceError):
            bench.camera.pop(0)
        with pytest.raises(DeviceError):
            bench.camera.trigger()

    def test_modes_that_are_not_declared_are_refused(self, bench: CameraBench) -> None:
        for mode in set(TriggerMode) - bench.camera.capabilities.trigger_modes:
            with pytest.raises(ConfigError):
                bench.camera.start(mode)

    def test_settings_wait_for_a_stop(self, bench: CameraBench) -> None:
        self._mode(bench, TriggerMode.FREE)
        with pytest.raises(DeviceError):
            bench.camera.apply(CameraSettings(exposure_ns=4_000_000))

    def test_brighter_light_and_longer_exposure_give_larger_values(self, bench: CameraBench) -> None:
        if bench.set_light is None:
            return
        means = []
        for level, share in ((80, 1.0), (200, 1.0), (200, 0.5)):
            bench.set_light(level)
            bench.camera.apply(CameraSettings(exposure_ns=int(16_000_000 * share)))
            bench.camera.start(TriggerMode.FREE)
            means.append(float(self._popped(bench).pixels.mean()))
            bench.camera.stop()
        assert means[1] > 1.5 * means[0]
        assert means[2] == pytest.approx(means[1] / 2, rel=0.1)

    def test_one_who_knows_the_truth_tells_it_on_the_pixel_grid(self, bench: CameraBench) -> None:
        if not isinstance(bench.camera, KnowsTruth):
            return
        c, truth = bench.camera.capabilities, bench.camera.truth()
        assert truth.rows.shape == truth.columns.shape == truth.lit.shape == (c.height, c.width)
        assert truth.xyz.shape == (c.height, c.width, 3)
        assert truth.lit.any()
        calibration = bench.camera.true_calibration()
        assert calibration.camera.size == (c.width, c.height)
        seen = truth.xyz[truth.lit].astype(np.float64)
        y, x = np.nonzero(truth.lit)
        assert np.abs(calibration.camera.project(seen) - np.stack((x, y), axis=-1)).max() < 2e-3
        pixels = calibration.projector.project(calibration.to_projector(seen))
        assert np.abs(pixels - np.stack((truth.columns, truth.rows), axis=-1)[truth.lit]).max() < 2e-3

    def test_closes_twice_and_then_refuses(self, bench: CameraBench) -> None:
        self._mode(bench, TriggerMode.FREE)
        bench.camera.close()
        bench.camera.close()
        with pytest.raises(DeviceError):
            bench.camera.start(TriggerMode.FREE)
        with pytest.raises(DeviceError):
            bench.camera.pop(0)

    @staticmethod
    def _mode(bench: CameraBench, mode: TriggerMode) -> int:
        """Set a short exposure and start; returns the exposure, ns."""
        c = bench.camera.capabilities
        asked = min(max(8_000_000, c.exposure_min_ns), c.exposure_max_ns)
        taken = bench.camera.apply(CameraSettings(exposure_ns=asked))
        assert taken.exposure_ns is not None
        bench.camera.start(mode)
        return taken.exposure_ns

    @staticmethod
    def _popped(bench: CameraBench) -> CameraFrame:
        frame = bench.camera.pop(5 * SECOND_NS)
        assert frame is not None
        return frame
