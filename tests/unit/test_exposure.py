"""Automatic exposure: the white frame as bright as fits, in whole periods, with warnings where that cannot be."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.registry import open_camera, open_projector
from scanner.clock import VirtualClock
from scanner.devices import TriggerMode
from scanner.errors import DeviceError
from scanner.sequencer import ExposureChoice, auto_exposure, exposure
from scanner.sequencer.exposure import CEILING, LONGEST_NS


def chosen(
    world: str = "", projector: dict[str, Any] | None = None, mode: TriggerMode = TriggerMode.SOFTWARE
) -> ExposureChoice:
    device = "quick/board?seed=1" + world
    clock = VirtualClock()
    screen = open_projector("simulated", device, projector or {}, clock)
    camera = open_camera("simulated", device, {}, clock)
    try:
        return auto_exposure(screen, camera, clock, trigger_mode=mode)
    finally:
        camera.close()
        screen.close()


@pytest.mark.parametrize("mode", [TriggerMode.SOFTWARE, TriggerMode.FREE])
def test_white_comes_near_the_target_in_whole_modulation_periods(mode: TriggerMode) -> None:
    choice = chosen(mode=mode)
    assert choice.exposure_ns % 4_166_667 == 0
    assert 0.9 < choice.level <= CEILING
    assert "modulation period" in choice.note
    assert choice.warning is None


@pytest.mark.parametrize("fault", ["drop", "incomplete"])
def test_a_test_shot_that_is_lost_is_taken_again(fault: str) -> None:
    assert chosen(f"&{fault}=0&times=1").exposure_ns == chosen().exposure_ns


def test_a_camera_that_sends_nothing_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.simulated.camera.SimulatedCamera.pop", lambda camera, timeout_ns: None)
    with pytest.raises(DeviceError, match="no frame came"):
        chosen()


def test_whole_refreshes_where_no_modulation_is_known() -> None:
    choice = chosen(projector={"modulation": "none"})
    assert choice.exposure_ns % 16_666_667 == 0
    assert choice.level <= CEILING


def test_constant_bright_light_takes_part_of_a_refresh() -> None:
    choice = chosen("&exposure_scale=6", {"modulation": "none"})
    assert choice.exposure_ns < 16_666_667
    assert 0.89 < choice.level < CEILING


def test_too_bright_for_one_period_is_a_warning_with_a_way_out() -> None:
    choice = chosen("&exposure_scale=20")
    assert choice.exposure_ns == 4_166_667
    assert choice.warning is not None
    assert "gain" in choice.warning
    assert "close the lens" in choice.warning


def test_too_dark_takes_the_longest_sensible_exposure_and_warns() -> None:
    choice = chosen("&exposure_scale=0.01")
    assert 0.9 * LONGEST_NS < choice.exposure_ns <= LONGEST_NS
    assert choice.warning is not None
    assert "open the lens" in choice.warning


def test_no_light_at_all_is_said() -> None:
    choice = chosen("&exposure_scale=0.0001&noise=false")
    assert choice.warning is not None
    assert "lens cap" in choice.warning


@pytest.mark.parametrize(("bright", "level"), [(2, 60), (4, 60), (6, 200), (50, 200)])
def test_what_a_two_hundredth_of_the_picture_reaches_is_metered(bright: int, level: int) -> None:
    """A few glints may clip; half a per cent of the view may not."""
    pixels = np.full(1000, 60, np.uint8)
    pixels[:bright] = 200
    shots = SimpleNamespace(expose_for=lambda exposure_ns: None, steady=lambda image: SimpleNamespace(pixels=pixels))
    seen, _ = exposure._white(shots, 1, SimpleNamespace(max_value=255))  # type: ignore[arg-type]
    assert seen == pytest.approx(level / 255)


@pytest.mark.parametrize(
    ("level", "trial", "count", "expected"),
    [(0.47, 4, 8, 0.94), (0.48, 4, 7, 0.84), (0.2, 2, 9, 0.9), (0.96, 8, 7, 0.84), (0.955, 1, 1, 0.955)],
)
def test_the_most_whole_periods_that_do_not_clip(level: float, trial: int, count: int, expected: float) -> None:
    screen = SimpleNamespace(capabilities=SimpleNamespace(modulation_period_ns=4_000_000))
    caps = SimpleNamespace(
        exposure_min_ns=10_000, exposure_max_ns=10**9, exposure_step_ns=1000, gain_min_db=0, gain_max_db=0
    )
    choice = exposure._choose(screen, caps, 4_000_000, trial * 4_000_000, level)  # type: ignore[arg-type]
    assert choice.exposure_ns == count * 4_000_000
    assert choice.level == pytest.approx(expected)
    assert (choice.warning is None) == (expected <= CEILING)


def test_a_level_that_comes_out_higher_than_expected_costs_a_period(monkeypatch: pytest.MonkeyPatch) -> None:
    """Light that swings, or a camera that is no line: what was chosen is looked at, and clips nothing."""
    plain = chosen()
    seen, white = iter([0.46, 0.97, 0.85]), exposure._white
    monkeypatch.setattr(exposure, "_white", lambda *told: (next(seen), white(*told)[1]))
    choice = chosen()
    assert (choice.exposure_ns, choice.level) == (7 * 4_166_667, 0.85)
    assert plain.level <= CEILING
