"""Runs whose camera is fired through its trigger line: at the display's full rate, in step, whatever goes wrong."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from drivers.registry import open_camera, open_projector, open_trigger
from drivers.simulated.projector import SimulatedProjector
from drivers.simulated.sequenced import pack
from scanner.clock import VirtualClock
from scanner.devices import (
    Flip,
    ProjectorKind,
    SequencedProjector,
    TableSlot,
    TriggerMode,
)
from scanner.errors import ConfigError, DeviceError, DeviceLost, SyncError
from scanner.patterns import CameraFormat, PatternSequence
from scanner.sequencer import Rig, acquire
from scanner.sequencer.plan import plan
from tests.unit.sequencer_bench import MemorySink, Taken, pmp
from tests.unit.triggered_bench import CAMERA, MS, PROJECTOR, REFRESH

SEQUENCE = pmp()


# --- runs ---------------------------------------------------------------------------------------------------------


def take(
    faults: str = "",
    sequence: PatternSequence = SEQUENCE,
    board: bool = True,
    late: Mapping[int, float] = MappingProxyType({}),
    **options: Any,
) -> Taken:
    """late: by slot, the refreshes that the host was kept from flipping."""
    device = "quick/board?seed=1&min_gap_us=1000" + (f"&{faults}" if faults else "")
    clock = VirtualClock()
    projector, camera = open_projector("simulated", device, {}, clock), open_camera("simulated", device, {}, clock)
    trigger = open_trigger("simulated", device, {}, clock) if board else None
    try:
        rig = Rig(projector, camera, trigger, trigger_mode=TriggerMode.HARDWARE)
        sink = MemorySink()
        made = rig.plan(sequence, **{"exposure_ns": 12_500_001, **options})
        slots = itertools.count()

        def busy() -> bool:
            clock.sleep_until(clock.now_ns() + round(late.get(next(slots), 0) * REFRESH))
            return False

        acquisition = acquire(rig, made, sequence, sink, clock, cancelled=busy)
        seen = camera.capabilities
        truth = camera.truth()  # type: ignore[attr-defined]
        return Taken(acquisition, sequence, sink, truth, CameraFormat(seen.width, seen.height, seen.bits))
    finally:
        camera.close()
        projector.close()
        if trigger is not None:
            trigger.close()


def test_a_sequence_takes_as_many_refreshes_as_it_has_images() -> None:
    """12.5 ms exposures at 60 Hz: nothing but the light's latency is added."""
    taken = take()
    first, last = taken.acquisition.records[0], taken.acquisition.records[-1]
    assert taken.acquisition.error is None
    assert taken.acquisition.retakes == 0
    assert first.flip is not None
    assert last.exposure is not None
    assert last.exposure.end_ns - first.flip.t_ns <= len(SEQUENCE) * REFRESH + 4 * MS
    assert {verdict.verdict for verdict in taken.acquisition.verdicts} == {"proved"}
    assert taken.error_px().max() < 1


@pytest.mark.parametrize(("refreshes", "dwell"), [(0.75, 1), (1.75, 2), (2.5, 3)])
def test_a_host_that_flips_late_costs_no_retakes(refreshes: float, dwell: int) -> None:
    """The board pulses on: late flips take some more of its pulses, and those after them are in step again."""
    taken = take(late={0: 0.7, 3: 0.7, 4: 0.7, 9: 2.2, 15: 1.3, 22: 0.7}, exposure_ns=round(refreshes * REFRESH))
    assert taken.acquisition.plan.dwell == dwell
    assert taken.acquisition.error is None
    assert taken.acquisition.retakes == 0
    assert {verdict.verdict for verdict in taken.acquisition.verdicts} == {"proved"}
    assert taken.error_px().max() < 1


def test_a_host_that_is_always_late_takes_its_frames_before_the_camera_has_no_room(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    on_time = SimulatedProjector.show

    def late(projector: SimulatedProjector, index: int) -> Flip:
        flip = on_time(projector, index)
        projector._clock.sleep_until(flip.t_ns + round(0.6 * REFRESH))
        return flip

    monkeypatch.setattr(SimulatedProjector, "show", late)
    taken = take("buffers=2")
    assert taken.acquisition.error is None
    assert taken.acquisition.retakes == 0


@pytest.mark.parametrize("latency_us", [0, 9_000, 16_000, 40_000])
def test_any_latency_is_followed(latency_us: int) -> None:
    taken = take(f"latency_us={latency_us}&latency_spread_us=100")
    assert taken.acquisition.error is None
    assert taken.acquisition.retakes == 0
    assert taken.acquisition.plan.dwell == 1
    assert {verdict.verdict for verdict in taken.acquisition.verdicts} == {"proved"}


def test_an_unmeasured_latency_is_waited_for_and_proves_nothing() -> None:
    taken = take("declare_latency=false")
    assert taken.acquisition.error is None
    assert {verdict.verdict for verdict in taken.acquisition.verdicts} == {"consistent"}
    assert taken.error_px().max() < 1


def test_a_projectors_own_output_fires_the_camera() -> None:
    taken = take("trigger_outputs=frame&line=frame", board=False)
    assert taken.acquisition.error is None
    assert taken.acquisition.plan.trigger is not None
    assert taken.acquisition.plan.trigger.line == "projector"
    assert taken.error_px().max() < 1


@pytest.mark.parametrize(
    "faults",
    [
        "drop_pulses=4",
        "spurious=4",
        "spurious=4&drop_pulses=9",
        "counts_triggers=false&drop_pulses=4",
        "latch=true&spurious=4",
        "drop=6&times=1",
        "double=6&times=1",
        "skip=5&times=1",
        "late_flips=1&times=1",
        "lose_events=3",
        "source_ends_after=12",
        "stamp_lie_ns=-9000000",
        "stamp_lie_ns=-9000000&counts_triggers=false",
        "swap=5",
        "order=rotate:3,8",
        "order=reverse",
        "late_flips=1",
    ],
)
def test_faults_end_in_a_right_cloud_or_in_an_error_that_names_frames(faults: str) -> None:
    taken = take(faults)
    if taken.acquisition.error is None:
        assert taken.error_px().max() < 1
    else:
        assert isinstance(taken.acquisition.error, SyncError)
        assert taken.acquisition.error.frames


@pytest.mark.parametrize("bound_us", [5, 100, 300, 450])
def test_events_that_are_known_badly_still_prove_frames(bound_us: int) -> None:
    taken = take(f"trigger.stamp_bound_us={bound_us}", exposure_ns=8_333_334)
    assert taken.acquisition.error is None
    assert {verdict.verdict for verdict in taken.acquisition.verdicts} == {"proved"}


@pytest.mark.parametrize("faults", ["drop_pulses=4", "spurious=4", "drop=6&times=1", "source_ends_after=12"])
def test_single_faults_of_the_line_cost_retakes_not_the_scan(faults: str) -> None:
    taken = take(faults)
    assert taken.acquisition.error is None
    assert 0 < taken.acquisition.retakes < len(SEQUENCE)


def test_a_board_that_hears_no_vertical_blank_is_named() -> None:
    taken = take("source_ends_after=0")
    assert isinstance(taken.acquisition.error, SyncError)
    assert "no VSYNC edge" in str(taken.acquisition.error)


def test_a_board_that_goes_away_is_a_lost_device() -> None:
    taken = take("trigger.unplug_after=4")
    assert isinstance(taken.acquisition.error, DeviceLost)
    assert taken.acquisition.reason.value == "device_lost"


# --- a projector that runs its own table ----------------------------------------------------------------------------


def test_three_patterns_share_a_video_frame_where_they_fit() -> None:
    """2 ms exposures: 23 patterns in the time of 8 refreshes, each proved by the edge of its own light."""
    taken = take("kind=sequencer&line=exposure", board=False, exposure_ns=2_000_000)
    first, last = taken.acquisition.records[0], taken.acquisition.records[-1]
    assert taken.acquisition.error is None
    assert taken.acquisition.plan.trigger is not None
    assert taken.acquisition.plan.trigger.line == "table"
    assert first.flip is not None
    assert last.exposure is not None
    assert last.exposure.end_ns - first.flip.t_ns <= 8 * REFRESH
    assert {verdict.verdict for verdict in taken.acquisition.verdicts} == {"proved"}
    assert taken.error_px().max() < 4


@pytest.mark.parametrize("exposure_ns", [12_500_001, 40_000_000])
def test_long_slots_keep_their_video_frame(exposure_ns: int) -> None:
    taken = take("kind=sequencer&line=exposure", board=False, exposure_ns=exposure_ns)
    assert taken.acquisition.error is None
    assert taken.acquisition.retakes == 0
    assert taken.error_px().max() < 1


@pytest.mark.parametrize(
    "faults", ["skip=5&times=1", "drop=5&times=1", "swap=5", "counts_triggers=false&drop=6&times=1"]
)
def test_slots_without_a_frame_are_shown_again(faults: str) -> None:
    taken = take(f"kind=sequencer&line=exposure&{faults}", board=False)
    assert taken.acquisition.error is None
    assert 0 < taken.acquisition.retakes < len(SEQUENCE)
    assert taken.error_px().max() < 1


def test_a_table_needs_the_cameras_line() -> None:
    sequenced = replace(PROJECTOR, kind=ProjectorKind.SEQUENCER)
    with pytest.raises(ConfigError, match="hardware trigger"):
        plan(sequenced, replace(CAMERA, trigger_modes=frozenset({TriggerMode.SOFTWARE})), SEQUENCE)
    with pytest.raises(ConfigError, match="hardware trigger"):
        plan(sequenced, CAMERA, SEQUENCE, trigger_mode=TriggerMode.SOFTWARE)


@pytest.mark.parametrize(
    ("slot", "says"),
    [
        (TableSlot(image=9, exposure_us=1000, dark_us=0), "2 are loaded"),
        (TableSlot(image=0, exposure_us=1, dark_us=0), "cannot be set"),
        (TableSlot(image=0, exposure_us=1000, dark_us=-1), "cannot be set"),
    ],
)
def test_a_table_that_cannot_be_run_is_refused(slot: TableSlot, says: str) -> None:
    projector = open_projector("simulated", "quick/board?kind=sequencer", {}, VirtualClock())
    assert isinstance(projector, SequencedProjector)
    try:
        with pytest.raises(DeviceError, match="nothing is programmed"):
            projector.start()
        projector.load([np.zeros((240, 320), np.uint8)] * 2)
        with pytest.raises(ConfigError, match=says):
            projector.program([slot])
    finally:
        projector.close()


def test_patterns_are_packed_bit_exact() -> None:
    random = np.random.default_rng(3)
    images = [random.integers(0, 256, (6, 8), np.uint8) for _ in range(7)]
    frames = pack(images)
    assert [frame.shape for frame in frames] == [(6, 8, 3)] * 3
    for i, image in enumerate(images):
        np.testing.assert_array_equal(frames[i // 3][..., i % 3], image)
