"""Latency and settling, measured on projectors whose own are known."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import pytest

from drivers.registry import open_camera, open_projector
from scanner.clock import VirtualClock
from scanner.devices import CameraCapabilities, Interval, TriggerMode
from scanner.errors import ConfigError, SyncError
from scanner.sequencer import measure_latency
from scanner.sequencer.latency import Disagreement, LateLight, disagreement

DEVICE = "quick/board?seed=1"


def measured(
    projector: dict[str, Any], device: str = DEVICE, mode: TriggerMode = TriggerMode.SOFTWARE
) -> tuple[Interval, Interval, float]:
    """(latency, settle, seconds it took)."""
    clock = VirtualClock()
    screen = open_projector("simulated", device, projector, clock)
    camera = open_camera("simulated", device, {}, clock)
    begin = clock.now_ns()
    try:
        latency, settle = measure_latency(screen, camera, clock, trigger_mode=mode)
    finally:
        camera.close()
        screen.close()
    return latency, settle, (clock.now_ns() - begin) / 1e9


@pytest.mark.parametrize("mode", [TriggerMode.SOFTWARE, TriggerMode.FREE])
@pytest.mark.parametrize(
    ("latency_us", "settle_us"), [(4200.0, 200.0), (300.0, 200.0), (21_000.0, 3000.0), (45_000.0, 500.0)]
)
def test_the_interval_holds_the_true_times(latency_us: float, settle_us: float, mode: TriggerMode) -> None:
    options = {"latency_us": latency_us, "settle_us": settle_us, "declare_latency": False}
    latency, settle, seconds = measured(options, mode=mode)
    # The true latency lies within 200 us of the option; light has wholly changed `settle` later.
    assert latency.low_ns <= 1000 * (latency_us + 200)
    # A camera that runs by itself samples each flip once in its own period of 6 ms.
    assert latency.low_ns >= 1000 * (latency_us - (6500 if mode is TriggerMode.FREE else 1500))
    steady = latency.high_ns + settle.high_ns
    assert 1000 * (latency_us - 200 + settle_us) <= steady <= 1000 * (latency_us + settle_us + 5000)
    assert seconds < 2.5


def test_a_sweep_down_the_rows_is_part_of_settling() -> None:
    latency, settle, _ = measured({"scan": "rows", "latency_us": 9000.0, "settle_us": 2000.0, "declare_latency": False})
    # The camera sees nine tenths of the rows, which take a refresh to sweep.
    assert settle.high_ns > 0.8 * 16_666_667
    assert latency.high_ns + settle.high_ns < 9_200_000 + 16_666_667 + 6_000_000


def test_too_little_contrast_is_refused_in_words() -> None:
    with pytest.raises(SyncError, match="black and white differ") as error:
        measured({}, device="quick/board?seed=1&exposure_scale=0.001&ambient=1.0")
    assert "projector lights" in (error.value.hint or "")


def test_a_camera_that_exposes_shortly_is_not_asked_for_more() -> None:
    clock = VirtualClock()
    screen = open_projector("simulated", DEVICE, {"declare_latency": False}, clock)
    camera = open_camera("simulated", DEVICE, {}, clock)
    short = replace(camera.capabilities, exposure_max_ns=500_000)
    with (
        closing(screen),
        closing(camera),
        patch.object(type(camera), "capabilities", short),
        patch.object(camera, "apply", wraps=camera.apply) as asked,
    ):
        measure_latency(screen, camera, clock)
    assert asked.call_args.args[0].exposure_ns == 500_000


def test_a_static_projector_has_no_latency() -> None:
    with pytest.raises(ConfigError, match="only a display"):
        measured({"kind": "static"})


def against(
    given_ms: tuple[float, float, float, float],
    projector: dict[str, Any],
    of_camera: dict[str, Any] | None = None,
    mode: TriggerMode | None = None,
) -> tuple[Disagreement | None, float]:
    """What is wrong with (latency from, to, settle from, to), and the seconds that it took to say."""
    clock = VirtualClock()
    screen = open_projector("simulated", DEVICE, projector, clock)
    camera = open_camera("simulated", DEVICE, of_camera or {}, clock)
    begin = clock.now_ns()
    latency, settle = (Interval(round(1e6 * low), round(1e6 * high)) for low, high in (given_ms[:2], given_ms[2:]))
    try:
        found = disagreement(screen, camera, clock, (latency, settle), trigger_mode=mode)
    finally:
        camera.close()
        screen.close()
    return found, (clock.now_ns() - begin) / 1e9


@pytest.mark.parametrize(
    ("given_ms", "off_ms"),
    [((100, 100, 0.1, 0.3), 95.5), ((20, 21, 0.1, 0.3), 15.5), ((0, 0, 0, 0), -3.8), ((0, 1, 0, 1), -1.8)],
)
def test_a_latency_that_is_not_the_projectors_is_named_with_what_is(
    given_ms: tuple[float, float, float, float], off_ms: float
) -> None:
    found, _ = against(given_ms, {"latency_us": 4200.0, "settle_us": 200.0})
    assert found is not None
    assert found.off_ns == pytest.approx(1e6 * off_ms, abs=1.2e6)
    assert found.latency.low_ns < 4.4e6 < found.latency.high_ns + 1.2e6


@pytest.mark.parametrize("projector", [{}, {"scan": "rows", "settle_us": 3000.0}, {"modulation": "pwm"}])
@pytest.mark.parametrize("given_ms", [(4.0, 4.4, 0, 20), (2.5, 6.0, 0, 20), (0, 60, 0, 20)])
def test_a_latency_that_may_be_the_projectors_is_believed(
    projector: dict[str, Any], given_ms: tuple[float, float, float, float]
) -> None:
    found, seconds = against(given_ms, projector)
    assert found is None
    assert seconds < 0.6


@pytest.mark.parametrize("given_ms", [(9, 10, 0, 1), (15, 15, 0, 1), (20, 20, 0, 1)])
@pytest.mark.parametrize("modulation", ["none", "pwm"])
def test_one_too_long_by_a_few_milliseconds_is_named_however_seldom_the_camera_looks(
    given_ms: tuple[float, float, float, float], modulation: str
) -> None:
    slow = CameraCapabilities.min_period_ns
    with patch.object(CameraCapabilities, "min_period_ns", lambda caps, exposure: slow(caps, exposure) + 16_000_000):
        found, _ = against(given_ms, {"latency_us": 4200.0, "settle_us": 200.0, "modulation": modulation})
    assert found is not None
    assert found.off_ns == pytest.approx(1e6 * (given_ms[0] - 4.5), abs=1.2e6)


@pytest.mark.parametrize(
    ("readout_us", "mode"),
    [(5000.0, TriggerMode.SOFTWARE), (5000.0, TriggerMode.FREE), (15_000.0, TriggerMode.SOFTWARE)],
)
def test_a_shutter_that_rolls_behind_a_sweep_is_no_latency_of_its_own(readout_us: float, mode: TriggerMode) -> None:
    projector = {"scan": "rows", "latency_us": 9000.0}
    camera = {"shutter": "rolling", "readout_us": readout_us}
    assert against((8.8, 9.2, 16.8, 17.0), projector, camera, mode)[0] is None
    found, _ = against((1, 2, 0, 0), {"latency_us": 30_000.0}, camera, mode)
    assert found is not None
    assert -28.2e6 < found.off_ns < -28.2e6 + 1e3 * readout_us + 8e6


@pytest.mark.parametrize("given_ms", [(4, 5, 0, 1), (119, 121, 0, 1)])
def test_light_that_comes_later_than_any_displays_is_called_late(given_ms: tuple[float, float, float, float]) -> None:
    if given_ms[0] > 100:
        assert against(given_ms, {"latency_us": 120_000.0})[0] is None
    else:
        with pytest.raises(LateLight, match="later than 83 ms") as error:
            against(given_ms, {"latency_us": 120_000.0})
        assert "frame interpolation" in (error.value.hint or "")
