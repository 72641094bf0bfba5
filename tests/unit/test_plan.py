"""The plan is pure: capabilities and numbers in, times and reasons out, refusals in words."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from scanner.devices import (
    CameraCapabilities,
    Interval,
    ProjectorCapabilities,
    ProjectorKind,
    Source,
    TriggerMode,
)
from scanner.errors import ConfigError
from scanner.patterns import McpPattern, PatternSequence, PmpPattern, ProjectorSize
from scanner.sequencer import Mode, Plan, Rig, plan

PROJECTOR = ProjectorCapabilities(
    ProjectorKind.FRAMEBUFFER,
    320,
    240,
    16_666_667,
    modulation_period_ns=4_166_667,
    latency=Interval(4_000_000, 4_400_000),
    settle=Interval(100_000, 300_000),
)
CAMERA = CameraCapabilities(
    640,
    480,
    8,
    "global",
    readout_ns=5_000_000,
    exposure_min_ns=10_000,
    exposure_max_ns=500_000_000,
    exposure_step_ns=1000,
    min_gap_ns=5_100_000,
    trigger_modes=frozenset({TriggerMode.FREE, TriggerMode.SOFTWARE}),
    trigger_latency=Interval(20_000, 60_000),
    stamp=Source.HARDWARE,
    stamp_bound_ns=1000,
)
SIZE = ProjectorSize(320, 240)
PMP = PatternSequence.bracketed(SIZE, PmpPattern(("y",), (1.0, 8.0), (8, 8)))
MCP = PatternSequence.bracketed(SIZE, McpPattern(axis="x", carriers=(20.0, 30.0, 40.0, 50.0)))


def test_exposure_is_whole_modulation_periods_and_says_so() -> None:
    made = plan(PROJECTOR, CAMERA, PMP, exposure_ns=10_000_000)
    assert made.exposure_ns == round(2 * 4_166_667 / 1000) * 1000
    assert "2 x one modulation period" in made.why["exposure_ns"]
    assert "rounded from 10 ms" in made.why["exposure_ns"]
    assert plan(PROJECTOR, CAMERA, PMP).exposure_ns == 4_167_000


def test_constant_light_takes_part_of_a_refresh_as_asked_and_whole_refreshes_above() -> None:
    constant = replace(PROJECTOR, modulation_period_ns=None)
    assert plan(constant, CAMERA, PMP, exposure_ns=3_000_000).exposure_ns == 3_000_000
    assert plan(constant, CAMERA, PMP, exposure_ns=30_000_000).exposure_ns == 33_333_000


def test_software_trigger_waits_for_measured_light_and_dwells_for_the_frame() -> None:
    made = plan(PROJECTOR, CAMERA, PMP, exposure_ns=16_666_668)
    assert made.mode is Mode.SOFTWARE
    assert made.trigger_delay_ns == 4_400_000 + 300_000
    needed = made.trigger_delay_ns + 60_000 + made.exposure_ns + CAMERA.readout_ns + 2000
    assert made.dwell == -(-needed // PROJECTOR.refresh_ns) == 2
    assert made.total_ns == made.trigger_delay_ns + len(PMP) * made.period_ns
    assert made.measured


def test_free_run_dwell_is_readout_exposure_period_and_bounds() -> None:
    made = plan(PROJECTOR, CAMERA, PMP, exposure_ns=4_166_667, trigger_mode=TriggerMode.FREE)
    spread = 4_700_000 - 4_000_000
    needed = CAMERA.readout_ns + made.exposure_ns + CAMERA.min_period_ns(made.exposure_ns) + 2000 + spread
    assert made.mode is Mode.FREE
    assert made.dwell == -(-needed // PROJECTOR.refresh_ns)


def test_the_rigs_measured_values_come_before_the_projectors() -> None:
    made = plan(PROJECTOR, CAMERA, PMP, latency=Interval(20_000_000, 21_000_000), settle=Interval(0, 1_000_000))
    assert made.trigger_delay_ns == 22_000_000
    assert made.window_end_ns == 20_000_000


def test_unmeasured_latency_is_assumed_and_nothing_can_be_proved() -> None:
    made = plan(replace(PROJECTOR, latency=None), CAMERA, PMP)
    assert not made.measured
    assert made.trigger_delay_ns == 300_000 + 2 * PROJECTOR.refresh_ns
    assert "latency not measured" in made.why["trigger_delay_ns"]


def test_one_image_stays_on() -> None:
    made = plan(PROJECTOR, CAMERA, MCP, repeat=240)
    assert made.mode is Mode.STATIC
    assert made.frame_count == 240
    assert made.period_ns == CAMERA.min_period_ns(made.exposure_ns)
    static = replace(PROJECTOR, kind=ProjectorKind.STATIC)
    assert plan(static, CAMERA, MCP).mode is Mode.STATIC


def test_a_rolling_shutters_readout_is_part_of_every_exposure() -> None:
    rolling = replace(CAMERA, shutter="rolling", readout_ns=9_000_000)
    assert plan(PROJECTOR, rolling, PMP).rolling_ns == 9_000_000


@pytest.mark.parametrize(
    ("changes", "options", "says"),
    [
        ({}, {"trigger_mode": TriggerMode.HARDWARE}, "no trigger mode"),
        ({}, {"exposure_ns": 900_000_000}, "outside the camera's"),
        ({}, {"exposure_ns": -5}, "positive"),
        ({}, {"exposure_ns": 16_666_667, "dwell": 1}, "too short"),
        ({}, {"repeat": 0}, "repeat"),
        ({"kind": ProjectorKind.STATIC}, {}, "shows one image"),
        ({"kind": ProjectorKind.SEQUENCER}, {}, "needs hardware trigger"),
        ({"width": 640}, {}, "the projector is 640 x 240"),
    ],
)
def test_what_cannot_work_is_refused_in_words(
    changes: dict[str, object], options: dict[str, object], says: str
) -> None:
    with pytest.raises(ConfigError, match=says) as error:
        plan(replace(PROJECTOR, **changes), CAMERA, PMP, **options)  # type: ignore[arg-type]
    assert error.value.hint or "repeat" in says or "positive" in says


def test_a_trigger_mode_the_camera_lacks_is_refused() -> None:
    free = replace(CAMERA, trigger_modes=frozenset({TriggerMode.FREE}))
    assert plan(PROJECTOR, free, PMP).mode is Mode.FREE
    with pytest.raises(ConfigError, match="no trigger mode 'software'"):
        plan(PROJECTOR, free, PMP, trigger_mode=TriggerMode.SOFTWARE)
    none = replace(CAMERA, trigger_modes=frozenset({TriggerMode.HARDWARE}))
    with pytest.raises(ConfigError, match="neither run free"):
        plan(PROJECTOR, none, PMP)


def test_a_plan_survives_capture_json() -> None:
    made = plan(PROJECTOR, CAMERA, PMP, exposure_ns=8_000_000)
    assert Plan.from_dict(json.loads(json.dumps(made.as_dict()))) == made
    assert {"mode", "exposure_ns", "trigger_delay_ns", "dwell", "total_ns"} <= set(made.why)


def test_images_are_turned_as_the_projector_hangs() -> None:
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    rig = Rig(projector=None, camera=None, mirror=True, rotate=180)  # type: ignore[arg-type]
    np.testing.assert_array_equal(rig.oriented(image), image[::-1])
