"""Automatic exposure: two or three test shots of full white, before a scan.

As bright as may be, since noise is least there: the 99.5th percentile of the white frame goes to 92 % of the camera's
range where light is constant, and else to the most whole modulation periods (or refreshes) that stay below 95 %,
because a part of one sees a wrong grey. Fewer than one pixel in 200 clips then: glints.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from scanner.clock import Clock
from scanner.devices import Camera, CameraCapabilities, CameraSettings, Interval, Projector, TriggerMode
from scanner.patterns import PatternSequence
from scanner.sequencer.latency import LONGEST_REFRESHES
from scanner.sequencer.plan import light_unit_ns
from scanner.sequencer.shots import BLACK, WHITE, Shots

TARGET = 0.92
"""Share of the camera's range for the 99.5th percentile of full white, where any exposure will do: the ceiling less
what flicker and the scaling of a test shot may add."""

CEILING = 0.95
"""The most for whole periods. The noise of such a level is .0105 of the range on a camera of 10,000 electrons whose
read noise is .4 %: full scale lies 4.7 sigmas away, and fringes reach .98 of white."""

PERCENTILE = 99.5

LONGEST_NS = 250_000_000
"""Longer exposures make a scan of 24 frames last six seconds and more: better open the lens."""

DIM = 0.2
"""Below this share of the range at the longest exposure, a warning."""


@dataclass(frozen=True)
class ExposureChoice:
    """What automatic exposure chose."""

    exposure_ns: int
    level: float
    """expected 99.5th percentile of full white, share of the camera's range"""
    note: str
    """why, in words"""
    warning: str | None = None
    """what is not as it should be, with what to do about it"""


def auto(
    projector: Projector,
    camera: Camera,
    clock: Clock,
    sequence: PatternSequence | None = None,
    *,
    settings: CameraSettings | None = None,
    trigger_mode: TriggerMode | None = None,
    latency: Interval | None = None,
    settle: Interval | None = None,
) -> ExposureChoice:
    """Choose the exposure for a scan by test shots of full white; the images in the projector are replaced.

    Args:
        sequence: what will be projected; its white is full white for every method so far.
        latency, settle: measured on this rig; None = what the projector declares.

    Raises:
        DeviceError: no frame came.
        ConfigError: the camera refuses the settings.
    """
    caps = camera.capabilities
    unit = _unit(projector, caps)
    delay = None if latency is None or settle is None else latency.high_ns + settle.high_ns
    with Shots(projector, camera, clock, trigger_mode=trigger_mode, settings=settings, light_delay_ns=delay) as shots:
        # Light that comes later than declared would be metered as dim: all shots are of white that has long been on.
        flip = shots.show(WHITE)
        clock.sleep_until(flip.t_ns + LONGEST_REFRESHES * projector.capabilities.refresh_ns)
        trial = _in_units(max(unit, 16_000_000), unit, caps)
        level, noise = _white(shots, trial, caps)
        if level >= CEILING:
            constant = projector.capabilities.modulation_period_ns is None
            trial = max(unit // 8, caps.exposure_min_ns) if constant else unit
            level, noise = _white(shots, trial, caps)
        elif level < TARGET / 8:
            trial = _in_units(min(8 * trial, LONGEST_NS), unit, caps)
            level, noise = _white(shots, trial, caps)
        choice = _choose(projector, caps, unit, trial, level)
        if level <= 3 * noise:
            shots.show(BLACK)
            warning = "full white is no brighter than the noise: is the projector on, and the lens cap off?"
            return replace(choice, warning=warning)
        seen, _ = _white(shots, choice.exposure_ns, caps) if choice.exposure_ns != trial else (level, noise)
        if seen > CEILING and choice.exposure_ns >= 2 * unit:
            # The camera is no line up there, or the light swings: from what was seen, once more.
            choice = _choose(projector, caps, unit, choice.exposure_ns, max(seen, CEILING + 0.005))
            seen, _ = _white(shots, choice.exposure_ns, caps)
        shots.show(BLACK)
    return replace(choice, level=seen)


def _white(shots: Shots, exposure_ns: int, caps: CameraCapabilities) -> tuple[float, float]:
    """(99.5th percentile, rounding noise) of a white frame, shares of the range."""
    shots.expose_for(exposure_ns)
    pixels = shots.steady(WHITE).pixels
    return float(np.percentile(pixels, PERCENTILE)) / caps.max_value, 1 / caps.max_value


def _choose(projector: Projector, caps: CameraCapabilities, unit: int, trial: int, level: float) -> ExposureChoice:
    """The exposure for the target, from one that gave `level` without clipping (or clips at the shortest)."""
    name = "modulation period" if projector.capabilities.modulation_period_ns else "refresh"
    longest = min(LONGEST_NS, caps.exposure_max_ns)
    if level >= CEILING and trial < 2 * unit:
        return ExposureChoice(trial, level, f"the shortest sensible exposure, {_ms(trial)}", _too_bright(caps, name))
    wanted = trial * TARGET / max(level, 1e-4)
    constant = projector.capabilities.modulation_period_ns is None
    if constant and wanted < unit:
        exposure = max(round(wanted / caps.exposure_step_ns) * caps.exposure_step_ns, caps.exposure_min_ns)
        note = f"{_ms(exposure)}: the light is constant, so a part of a refresh will do"
        return ExposureChoice(exposure, level * exposure / trial, note)
    brightest = min(trial * CEILING / max(level, 1e-4), longest)
    count = max(1, math.floor(brightest / unit * (1 + 1e-9)))
    exposure = _in_units(count * unit, unit, caps)
    expected = level * exposure / trial
    note = f"{count} x one {name}, {_ms(exposure)}: full white at {expected:.0%} of the range"
    warning = None
    if expected > CEILING:
        warning = _too_bright(caps, name)
    elif expected < DIM:
        warning = (
            f"full white reaches {expected:.0%} of the range at the longest sensible exposure, {_ms(exposure)}: "
            "open the lens, raise the gain, darken the room or move nearer"
        )
    return ExposureChoice(exposure, expected, note, warning)


def _unit(projector: Projector, caps: CameraCapabilities) -> int:
    """The least multiple of the light's unit that the camera can expose for."""
    unit = light_unit_ns(projector.capabilities)
    return unit * max(1, -(-caps.exposure_min_ns // unit))


def _in_units(exposure_ns: int, unit: int, caps: CameraCapabilities) -> int:
    count = max(1, min(round(exposure_ns / unit), caps.exposure_max_ns // unit))
    return count * unit


def _too_bright(caps: CameraCapabilities, name: str) -> str:
    gain = "lower the gain, " if caps.gain_max_db > caps.gain_min_db else ""
    return f"full white saturates within one {name}: {gain}close the lens, or dim the projector"


def _ms(ns: float) -> str:
    return f"{ns / 1e6:.3g} ms"
