"""The contract every driver must keep, as test classes; a driver's test module only says how to make the device.

A module derives from `ProjectorContract`, `CameraContract` or `TriggerContract` and gives the fixture `bench`: an open
device, its clock, for a camera what makes light, and for a trigger board what beats on its input VSYNC. Nothing here
knows a driver. Times are taken from the bench's clock, so the suite runs in virtual time on simulated devices and in
real time on others.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from scanner.clock import Clock
from scanner.devices import (
    Camera,
    CameraFrame,
    CameraSettings,
    KnowsTruth,
    Projector,
    ProjectorKind,
    TableSlot,
    TriggerBoard,
    TriggerEvent,
    TriggerFault,
    TriggerMode,
    TriggerSource,
)
from scanner.errors import ConfigError, DeviceBusy, DeviceError, DeviceLost

SECOND_NS = 1_000_000_000


@dataclass
class ProjectorBench:
    """An open projector that nobody looks at."""

    projector: Projector
    clock: Clock

    def images(self, count: int) -> list[np.ndarray]:
        """Plain images of different greys, as many as its kind holds of `count`."""
        c = self.projector.capabilities
        count = 1 if c.kind is ProjectorKind.STATIC else count
        return [np.full((c.height, c.width), 40 * (i + 1), dtype=np.uint8) for i in range(count)]


@dataclass
class CameraBench:
    """An open, stopped camera."""

    camera: Camera
    clock: Clock
    set_light: Callable[[int], None] | None = None
    """sets the scene's brightness 0..255 and returns when it is steady; None where the bench cannot"""


class ProjectorContract:
    """What every `Projector` keeps."""

    def test_is_a_projector_with_sane_capabilities(self, bench: ProjectorBench) -> None:
        c = bench.projector.capabilities
        assert isinstance(bench.projector, Projector)
        assert bench.projector.name
        assert c.width > 0
        assert c.height > 0
        assert c.refresh_ns > 0
        assert c.modulation_period_ns is None or 0 < c.modulation_period_ns <= c.refresh_ns
        for interval in (c.latency, c.settle):
            assert interval is None or 0 <= interval.low_ns <= interval.high_ns

    def test_flips_lie_on_the_vertical_blanks_it_declares(self, bench: ProjectorBench) -> None:
        projector = bench.projector
        images = bench.images(3)
        projector.load(images)
        flips = [projector.show(i % len(images)) for i in range(6)]
        refresh = projector.capabilities.refresh_ns
        for before, after in itertools.pairwise(flips):
            blanks = after.vblank - before.vblank
            assert blanks >= 1
            slack = before.bound_ns + after.bound_ns + refresh // 1000
            assert abs(after.t_ns - before.t_ns - blanks * refresh) <= slack

    def test_show_returns_once_the_flip_has_happened(self, bench: ProjectorBench) -> None:
        bench.projector.load(bench.images(2))
        called = bench.clock.now_ns()
        flip = bench.projector.show(0)
        assert called - flip.bound_ns <= flip.t_ns <= bench.clock.now_ns() + flip.bound_ns

    def test_a_flip_waits_for_the_next_blank_only(self, bench: ProjectorBench) -> None:
        """A machine may be late now and then; a driver that waits for a later blank always is."""
        images = bench.images(2)
        bench.projector.load(images)
        waits = []
        for attempt in range(5):
            called = bench.clock.now_ns()
            flip = bench.projector.show(attempt % len(images))
            waits.append(flip.t_ns - called - flip.bound_ns)
            if waits[-1] <= 2 * bench.projector.capabilities.refresh_ns:
                return
        pytest.fail(f"every flip was late: {waits} ns")

    def test_load_takes_its_own_size_only(self, bench: ProjectorBench) -> None:
        c = bench.projector.capabilities
        with pytest.raises(DeviceError):
            bench.projector.load([np.zeros((c.height, c.width + 1), dtype=np.uint8)])

    def test_load_copies_or_keeps_what_it_was_given(self, bench: ProjectorBench) -> None:
        """Loading again replaces what was there, and images are the caller's own afterwards."""
        images = bench.images(2)
        bench.projector.load(images)
        images[0][:] = 0
        bench.projector.load(bench.images(1))
        bench.projector.show(0)
        with pytest.raises(DeviceError):
            bench.projector.show(1)

    def test_an_image_that_is_not_loaded_is_an_error(self, bench: ProjectorBench) -> None:
        bench.projector.load(bench.images(1))
        for index in (1, -1):
            with pytest.raises(DeviceError):
                bench.projector.show(index)

    def test_closes_twice_and_then_refuses(self, bench: ProjectorBench) -> None:
        bench.projector.load(bench.images(1))
        bench.projector.close()
        bench.projector.close()
        with pytest.raises(DeviceError):
            bench.projector.show(0)


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


@dataclass
class TriggerBench:
    """An open, idle trigger board, a vertical blank beating on its input VSYNC."""

    board: TriggerBoard
    clock: Clock
    refresh_ns: int
    stop_vsync: Callable[[], None]
    """no further vertical blank comes"""
    unplug: Callable[[], None] | None
    """the board is gone at once; None where the bench cannot"""
    uneven_ns: int = 0
    """by which the board's own time may be off: a chip simulated in real time stands still while others compute"""

    def wait(self, ns: int) -> None:
        """Let time pass."""
        self.clock.sleep_until(self.clock.now_ns() + ns)

    def events(self, count: int, timeout_ns: int = 3 * SECOND_NS) -> list[TriggerEvent]:
        """The run's events, once there are `count`, or when they should have come."""
        deadline = self.clock.now_ns() + timeout_ns
        while len(events := list(self.board.events())) < count and self.clock.now_ns() < deadline:
            self.wait(SECOND_NS // 100)
        return events

    def run(self, slots: list[TableSlot], source: TriggerSource, pulses: int) -> list[TriggerEvent]:
        """Program, arm, fire where that is needed, and the events."""
        self.board.program(slots, source)
        self.board.arm()
        if source is TriggerSource.INTERNAL:
            self.board.fire()
        return self.events(pulses)


class TriggerContract:
    """What every `TriggerBoard` keeps."""

    def test_is_a_board_with_sane_capabilities(self, bench: TriggerBench) -> None:
        c = bench.board.capabilities
        assert isinstance(bench.board, TriggerBoard)
        assert bench.board.name
        assert c.sources
        assert c.max_steps > 0
        assert c.max_repeats > 0
        assert 0 < c.dark_min_us < c.time_max_us
        assert 0 < c.exposure_min_us < c.time_max_us
        assert c.jitter_ns >= 0
        assert list(bench.board.events()) == []
        assert list(bench.board.faults()) == []

    def test_its_own_timer_runs_the_table_from_fire_on(self, bench: TriggerBench) -> None:
        slots = self._slots(6, dark_us=7_000, exposure_us=3_000, wait_trigger=False)
        bench.board.program(slots, TriggerSource.INTERNAL)
        bench.board.arm()
        bench.wait(SECOND_NS // 50)
        assert list(bench.board.events()) == []
        called = bench.clock.now_ns()
        bench.board.fire()
        returned = bench.clock.now_ns()
        events = bench.events(6)
        first = events[0]
        slack = first.bound_ns + bench.board.capabilities.jitter_ns + bench.uneven_ns
        assert called + 7_000_000 - slack <= first.t_ns <= returned + 7_000_000 + slack + SECOND_NS // 100
        self._spaced(bench, events, [10_000_000] * 5)
        assert list(bench.board.faults()) == []

    def test_each_slot_follows_its_vertical_blank(self, bench: TriggerBench) -> None:
        events = bench.run(self._slots(8), TriggerSource.VSYNC, 8)
        assert [event.step for event in events] == list(range(8))
        self._spaced(bench, events, [bench.refresh_ns] * 7)
        bench.wait(3 * bench.refresh_ns)
        assert len(bench.board.events()) == 8
        assert list(bench.board.faults()) == []

    def test_edges_are_counted_from_the_one_that_began_the_slot_before(self, bench: TriggerBench) -> None:
        slots = self._slots(3, edges=2, exposure_us=bench.refresh_ns // 1000)
        self._spaced(bench, bench.run(slots, TriggerSource.VSYNC, 3), [2 * bench.refresh_ns] * 2)

    def test_slots_that_do_not_wait_follow_the_one_before(self, bench: TriggerBench) -> None:
        slots = [*self._slots(1, exposure_us=500), *self._slots(2, exposure_us=500, wait_trigger=False)]
        self._spaced(bench, bench.run(slots, TriggerSource.VSYNC, 3), [2_500_000] * 2)

    def test_a_slot_that_emits_nothing_has_no_event(self, bench: TriggerBench) -> None:
        slots = self._slots(4, exposure_us=500)
        slots[1] = self._slots(1, exposure_us=500, emit_trigger=False)[0]
        events = bench.run(slots, TriggerSource.VSYNC, 3)
        assert [event.step for event in events] == [0, 2, 3]
        self._spaced(bench, events, [2 * bench.refresh_ns, bench.refresh_ns])

    def test_a_table_longer_than_its_memory_runs_if_it_repeats(self, bench: TriggerBench) -> None:
        count = 2 * bench.board.capabilities.max_steps + 2
        slots = self._slots(count, wait_trigger=False, dark_us=1_500, exposure_us=1_000)
        events = bench.run(slots, TriggerSource.INTERNAL, count)
        assert [event.step for event in events] == list(range(count))
        self._spaced(bench, events, [2_500_000] * (count - 1))

    def test_event_times_are_known_with_a_bound(self, bench: TriggerBench) -> None:
        for event in bench.run(self._slots(3), TriggerSource.VSYNC, 3):
            assert 0 < event.bound_ns < SECOND_NS // 50
            assert event.t_ns - event.bound_ns <= bench.clock.now_ns() + bench.uneven_ns

    def test_runs_are_numbered_and_forget_the_one_before(self, bench: TriggerBench) -> None:
        assert [event.sequence for event in bench.run(self._slots(2), TriggerSource.VSYNC, 2)] == [0, 0]
        bench.wait(bench.refresh_ns)
        bench.board.arm()
        events = bench.events(2)
        assert [(event.sequence, event.step) for event in events] == [(1, 0), (1, 1)]

    def test_tables_it_cannot_run_are_refused(self, bench: TriggerBench) -> None:
        c = bench.board.capabilities
        for slots, source in (
            ([], TriggerSource.VSYNC),
            (self._slots(1, dark_us=c.dark_min_us - 1), TriggerSource.VSYNC),
            (self._slots(1, exposure_us=c.exposure_min_us - 1), TriggerSource.VSYNC),
            (self._slots(1, exposure_us=c.time_max_us + 1), TriggerSource.VSYNC),
            (self._slots(1, edges=0), TriggerSource.VSYNC),
            (self._slots(1, wait_trigger=False), TriggerSource.VSYNC),
            (self._slots(1), TriggerSource.INTERNAL),
            ([*self._slots(c.max_steps), *self._slots(1, exposure_us=60)], TriggerSource.VSYNC),
        ):
            with pytest.raises(ConfigError):
                bench.board.program(slots, source)

    def test_arm_and_fire_need_what_comes_before_them(self, bench: TriggerBench) -> None:
        with pytest.raises(DeviceError):
            bench.board.arm()
        bench.board.program(self._slots(2, wait_trigger=False), TriggerSource.INTERNAL)
        with pytest.raises(DeviceError):
            bench.board.fire()
        bench.board.program(self._slots(2), TriggerSource.VSYNC)
        with pytest.raises(DeviceError):
            bench.board.fire()

    def test_a_run_under_way_is_not_disturbed(self, bench: TriggerBench) -> None:
        bench.board.program(self._slots(500), TriggerSource.VSYNC)
        bench.board.arm()
        bench.events(2)
        with pytest.raises(DeviceBusy):
            bench.board.arm()
        with pytest.raises(DeviceBusy):
            bench.board.program(self._slots(1), TriggerSource.VSYNC)
        assert len(bench.events(6)) >= 6

    def test_abort_stops_the_run_and_keeps_the_table(self, bench: TriggerBench) -> None:
        bench.board.abort()
        bench.board.program(self._slots(500), TriggerSource.VSYNC)
        bench.board.arm()
        bench.events(3)
        bench.board.abort()
        given = len(bench.board.events())
        bench.wait(3 * bench.refresh_ns)
        assert len(bench.board.events()) == given
        bench.board.arm()
        assert len(bench.events(2)) >= 2
        bench.board.abort()

    def test_a_slot_longer_than_its_refresh_ends_the_run_as_an_overrun(self, bench: TriggerBench) -> None:
        bench.board.program(self._slots(5, exposure_us=bench.refresh_ns // 1000), TriggerSource.VSYNC)
        bench.board.arm()
        faults = self._faults(bench)
        assert [(fault.kind, fault.step) for fault in faults] == [("overrun", 1)]
        assert len(bench.board.events()) == 1
        bench.board.arm()
        assert list(bench.board.faults()) == []
        bench.board.abort()

    def test_a_missing_vertical_blank_ends_the_run(self, bench: TriggerBench) -> None:
        bench.board.program(self._slots(500), TriggerSource.VSYNC)
        bench.board.arm()
        bench.events(2)
        bench.stop_vsync()
        faults = self._faults(bench)
        given = len(bench.board.events())
        assert [(fault.kind, fault.step) for fault in faults] == [("missing_edge", given)]
        bench.board.program(self._slots(1), TriggerSource.VSYNC)

    def test_an_unplugged_board_is_lost_within_a_second(self, bench: TriggerBench) -> None:
        if bench.unplug is None:
            return
        bench.board.program(self._slots(500), TriggerSource.VSYNC)
        bench.board.arm()
        bench.events(2)
        bench.unplug()
        gone = bench.clock.now_ns()
        lost: DeviceLost | None = None
        while lost is None and bench.clock.now_ns() < gone + 2 * SECOND_NS:
            try:
                bench.board.events()
            except DeviceLost as error:
                lost = error
            bench.wait(SECOND_NS // 100)
        assert lost is not None
        assert lost.hint
        assert bench.clock.now_ns() - gone < SECOND_NS
        with pytest.raises(DeviceLost):
            bench.board.faults()

    def test_closes_twice_and_then_refuses(self, bench: TriggerBench) -> None:
        bench.board.program(self._slots(500), TriggerSource.VSYNC)
        bench.board.arm()
        bench.board.close()
        bench.board.close()
        for call in (bench.board.arm, bench.board.fire, bench.board.abort, bench.board.events, bench.board.faults):
            with pytest.raises(DeviceError):
                call()

    @staticmethod
    def _slots(count: int, **changes: Any) -> list[TableSlot]:
        given: dict[str, Any] = {"exposure_us": 3_000, "dark_us": 2_000, "wait_trigger": True, **changes}
        return [TableSlot(image=i, **given) for i in range(count)]

    @staticmethod
    def _spaced(bench: TriggerBench, events: list[TriggerEvent], wanted_ns: list[int]) -> None:
        """Events follow one another at these distances, to their bounds, the board's jitter and 100 ppm."""
        assert len(events) == len(wanted_ns) + 1
        for wanted, (before, after) in zip(wanted_ns, itertools.pairwise(events), strict=True):
            slack = before.bound_ns + after.bound_ns + 2 * bench.board.capabilities.jitter_ns + wanted // 10_000
            slack += bench.uneven_ns
            assert abs(after.t_ns - before.t_ns - wanted) <= slack

    @staticmethod
    def _faults(bench: TriggerBench) -> list[TriggerFault]:
        """The faults, once there are any."""
        deadline = bench.clock.now_ns() + 2 * SECOND_NS
        while not (faults := list(bench.board.faults())) and bench.clock.now_ns() < deadline:
            bench.wait(SECOND_NS // 100)
        return faults
