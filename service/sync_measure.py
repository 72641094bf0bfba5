"""How a rig's devices keep time, measured: latency, settling, jitter, pulsed greys, and the plan that follows.

The words are for a person, the numbers for the rig file. Devices are opened here and given back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from scanner.clock import Clock
from scanner.devices import Interval, ProjectorKind
from scanner.errors import ConfigError, ScannerError
from scanner.patterns import PatternSequence
from scanner.sequencer import measure_latency
from scanner.sequencer.light import Light, measure_light
from service.config import RigConfig
from service.scan_patterns import default_pattern
from service.scan_setup import OpenRig, open_rig, timing_values

ROUNDS, MOST_ROUNDS = 3, 6
"""Searches for the light's begin and end, each with flips of its own: their union covers what jitters slowly. More
where none of them caught the light's begin, as on a machine that is busy"""


@dataclass(frozen=True)
class Sync:
    """What was measured; intervals in ns."""

    latency: Interval
    settle: Interval
    refresh_ns: int
    light: Light
    exposure: dict[str, Any] | None
    """of the plan: mode "given" with asked_us, or "auto" with what test shots chose; None where there were none"""
    plan: dict[str, Any] | None
    """of a default PMP scan with these values, as capture.json has it; None where nothing works"""
    refused: str | None
    """why nothing works, in words"""

    def rig_lines(self) -> dict[str, list[int]]:
        """Values for `[projector]`."""
        return timing_values(self.latency, self.settle)

    @property
    def is_poor(self) -> bool:
        """The light's begin was never caught, or the two ends lie a refresh apart: worth measuring again."""
        return self.latency.low_ns == 0 or self.latency.high_ns - self.latency.low_ns > self.refresh_ns // 2

    def as_dict(self) -> dict[str, Any]:
        """Plain data."""
        return {
            **self.rig_lines(),
            "refresh_ns": self.refresh_ns,
            "light": vars(self.light),
            "exposure": self.exposure,
            "plan": self.plan,
            "refused": self.refused,
        }


def measure_sync(config: RigConfig, clock: Clock, stage: Callable[[str], None]) -> Sync:
    """Open a rig's devices and measure.

    Raises:
        ConfigError: the projector cannot flip.
        SyncError: black and white cannot be told apart.
        DeviceError: a device cannot be opened, or failed.
    """
    stage("opening devices")
    opened = open_rig(config.model_dump(mode="json"), clock)
    try:
        capabilities = opened.rig.projector.capabilities
        if capabilities.kind is not ProjectorKind.FRAMEBUFFER:
            raise ConfigError(
                f"a {capabilities.kind.value} projector is not flipped by the host: there is no latency to measure",
                device=opened.rig.projector.name,
            )
        found: list[tuple[Interval, Interval]] = []
        while len(found) < ROUNDS or (len(found) < MOST_ROUNDS and not any(one.low_ns for one, _ in found)):
            stage(f"measuring latency, round {len(found) + 1}")
            rig = opened.rig
            found.append(
                measure_latency(rig.projector, rig.camera, clock, settings=rig.settings, trigger_mode=rig.trigger_mode)
            )
        latency, settle = _union([one for one, _ in found]), _union([two for _, two in found])
        stage("measuring light")
        rig = opened.rig
        light = measure_light(rig.projector, rig.camera, clock, settings=rig.settings, trigger_mode=rig.trigger_mode)
        opened.rig = replace(opened.rig, latency=latency, settle=settle)
        stage("choosing the exposure")
        exposure, plan, refused = _plan(opened, clock)
        return Sync(latency, settle, capabilities.refresh_ns, light, exposure, plan, refused)
    finally:
        opened.close()


def _union(intervals: list[Interval]) -> Interval:
    """What holds all of them; a lower end of 0 only says that no dark exposure was caught, so others go before it."""
    lows = [i.low_ns for i in intervals if i.low_ns > 0] or [0]
    return Interval(min(lows), max(i.high_ns for i in intervals))


def _plan(opened: OpenRig, clock: Clock) -> tuple[dict[str, Any] | None, dict[str, Any] | None, str | None]:
    """The exposure and the plan that a default PMP scan of this rig gets, as it chooses them itself; or why none."""
    known, exposure = opened.known, None
    pattern = default_pattern("pmp", (known.axis,), known.axis, known.projector)
    sequence = PatternSequence.bracketed(known.projector, pattern, known.precorrection)
    try:
        exposure_ns, exposure = opened.exposure_for(clock, sequence)
        return exposure, opened.rig.plan(sequence, exposure_ns=exposure_ns).as_dict(), None
    except ScannerError as error:
        return exposure, None, f"{error}{f' ({error.hint})' if error.hint else ''}"
