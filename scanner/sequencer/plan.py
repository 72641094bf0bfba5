"""The plan of a run: which image when, how long, and why. Pure: it sees capabilities and numbers, no device.

A plan is made before anything moves, refuses in words what cannot work, and is stored with the capture, so that
`verify` can judge the frames by it at any later time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from scanner.devices import (
    CameraCapabilities,
    Interval,
    ProjectorCapabilities,
    ProjectorKind,
    Source,
    TriggerCapabilities,
    TriggerMode,
)
from scanner.errors import ConfigError
from scanner.patterns import PatternSequence
from scanner.sequencer.trigger_plan import TriggerPlan, trigger_plan, trigger_time

DEFAULT_RETAKES = 2
DEFAULT_MAX_SET_MS = 5000
"""The object is taken to stand still, and the lamp to hold its level, for this long unless the caller knows better."""

ASSUMED_REFRESHES = 2
"""Refreshes waited after a flip where latency or settling was never measured: most displays lag by one."""


class Mode(StrEnum):
    """How frames and patterns are brought together."""

    STATIC = "static"
    """one pattern stays on, frames as they come"""
    SOFTWARE = "software"
    """flip, wait for the light, trigger the camera"""
    FREE = "free"
    """the camera runs by itself; the frame that fits into a pattern's time is taken, the others are dropped"""
    HARDWARE = "hardware"
    """a board or the projector pulses the camera's trigger line; the host only flips"""


@dataclass(frozen=True)
class Plan:
    """What the runner does and what `verify` holds it to. Times in ns.

    `why` gives, for each value that was decided here, the reason in words.
    """

    mode: Mode
    patterns: int
    """images of the sequence"""
    repeat: int
    """how often the sequence (static: the frame) is taken"""
    exposure_ns: int
    rolling_ns: int
    """start of the first row to start of the last: part of every frame's exposure interval; 0 for a global shutter"""
    dwell: int
    """refreshes a pattern stays on, at least what its frame needs"""
    period_ns: int
    """time of one slot (static: of one frame)"""
    camera_period_ns: int
    trigger_delay_ns: int
    """from the flip's stamp to the moment when the new image certainly shines"""
    refresh_ns: int
    modulation_ns: int | None
    latency: Interval | None
    settle: Interval | None
    step_ns: int
    """the camera's exposure step: how exactly a requested exposure can be met"""
    stamp: Source
    total_ns: int
    pop_timeout_ns: int
    max_set_ms: int
    retakes: int
    trigger: TriggerPlan | None = None
    """mode HARDWARE: how the camera's line is driven"""
    why: Mapping[str, str] = field(default_factory=dict)

    @property
    def frame_count(self) -> int:
        """Frames of a whole run."""
        return self.patterns * self.repeat

    @property
    def window_start_ns(self) -> int:
        """From a flip's stamp to when its image is wholly there, measured or assumed."""
        return self.trigger_delay_ns

    @property
    def window_end_ns(self) -> int:
        """From the next flip's stamp to when its image begins to show: the least latency, 0 where unmeasured."""
        return self.latency.low_ns if self.latency is not None else 0

    @property
    def measured(self) -> bool:
        """Whether latency and settling are known with bounds: without them nothing is proved."""
        return self.mode is Mode.STATIC or (self.latency is not None and self.settle is not None)

    def as_dict(self) -> dict[str, Any]:
        """Plain data for capture.json."""
        return {
            "mode": self.mode.value,
            "patterns": self.patterns,
            "repeat": self.repeat,
            "exposure_ns": self.exposure_ns,
            "rolling_ns": self.rolling_ns,
            "dwell": self.dwell,
            "period_ns": self.period_ns,
            "camera_period_ns": self.camera_period_ns,
            "trigger_delay_ns": self.trigger_delay_ns,
            "refresh_ns": self.refresh_ns,
            "modulation_ns": self.modulation_ns,
            "latency_ns": _pair(self.latency),
            "settle_ns": _pair(self.settle),
            "step_ns": self.step_ns,
            "stamp": self.stamp.value,
            "total_ns": self.total_ns,
            "pop_timeout_ns": self.pop_timeout_ns,
            "max_set_ms": self.max_set_ms,
            "retakes": self.retakes,
            "trigger": None if self.trigger is None else self.trigger.as_dict(),
            "why": dict(self.why),
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Plan:
        """Read what `as_dict` wrote.

        Raises:
            KeyError, TypeError, ValueError: it is not a plan.
        """
        known = {key: content[key] for key in cls.__dataclass_fields__ if key in content}
        return cls(
            **{
                **known,
                "mode": Mode(content["mode"]),
                "stamp": Source(content["stamp"]),
                "latency": _interval(content["latency_ns"]),
                "settle": _interval(content["settle_ns"]),
                "trigger": TriggerPlan.from_dict(content.get("trigger")),
                "why": dict(content.get("why", {})),
            }
        )


def plan(
    projector: ProjectorCapabilities,
    camera: CameraCapabilities,
    sequence: PatternSequence,
    *,
    exposure_ns: int | None = None,
    repeat: int = 1,
    trigger_mode: TriggerMode | None = None,
    board: TriggerCapabilities | None = None,
    latency: Interval | None = None,
    settle: Interval | None = None,
    dwell: int | None = None,
    retakes: int = DEFAULT_RETAKES,
    max_set_ms: int = DEFAULT_MAX_SET_MS,
) -> Plan:
    """Plan a run of `sequence`, `repeat` times over.

    A sequence of one image is `static`: it stays on and `repeat` frames are taken as they come.

    Args:
        exposure_ns: wanted exposure; None = one modulation period (or refresh).
        trigger_mode: None = hardware where there is a board and the camera can, else software, else free run.
        board: what the rig's trigger board can do; None = there is none.
        latency, settle: measured on this rig; None = what the projector declares.
        dwell: refreshes a pattern stays on at least; None = as few as its frame needs.
        retakes: rounds of retakes before the run is given up.
        max_set_ms: a retake later than this after its set repeats the set.

    Raises:
        ConfigError: it cannot work; the message says why and the hint what would.
    """
    if repeat < 1:
        raise ConfigError(f"repeat must be 1 or more, got {repeat}")
    why: dict[str, str] = {}
    mode = _mode(projector, camera, sequence, trigger_mode, board, why)
    _check_size(projector, sequence)
    latency = latency or projector.latency
    settle = settle or projector.settle
    exposure = _exposure(projector, camera, mode, exposure_ns, why)
    delay = _delay(projector, latency, settle, why)
    rolling = camera.readout_ns if camera.shutter == "rolling" else 0
    camera_period = camera.min_period_ns(exposure)
    starts_after = camera.trigger_latency.high_ns if camera.trigger_latency is not None else 0
    if mode is Mode.HARDWARE:
        spread = delay - (latency.low_ns if latency is not None else 0)
        needed = trigger_time(projector, camera, board, exposure_ns=exposure, spread_ns=spread)
    else:
        needed = _slot_time(mode, camera, exposure, delay, latency, starts_after)
    least = max(1, -(-needed // projector.refresh_ns))
    held = _dwell(mode, least, dwell, needed, projector, why)
    period = held * projector.refresh_ns
    if mode is Mode.STATIC:
        period = camera_period
    elif projector.kind is ProjectorKind.SEQUENCER:
        held, period = 1, needed
        why["dwell"] = f"a slot's light and dark take {_ms(needed)}, whatever the refresh"
    line = None
    if mode is Mode.HARDWARE:
        line = trigger_plan(projector, camera, board, delay_ns=delay, exposure_ns=exposure, period_ns=period, why=why)
    total = delay + period * len(sequence) * repeat
    why["total_ns"] = f"{len(sequence) * repeat} frames of {_ms(period)} each, without retakes"
    # A frame is missing only when it is surely not coming: exposure and transfer, a lost camera slot, and half a second
    # for the host, which is not a real-time system.
    timeout = starts_after + 2 * camera_period + exposure + camera.readout_ns + 500_000_000
    return Plan(
        mode=mode,
        patterns=len(sequence),
        repeat=repeat,
        exposure_ns=exposure,
        rolling_ns=rolling,
        dwell=held,
        period_ns=period,
        camera_period_ns=camera_period,
        trigger_delay_ns=delay,
        refresh_ns=projector.refresh_ns,
        modulation_ns=projector.modulation_period_ns,
        latency=latency,
        settle=settle,
        step_ns=camera.exposure_step_ns,
        stamp=camera.stamp,
        total_ns=total,
        pop_timeout_ns=timeout,
        max_set_ms=max_set_ms,
        retakes=retakes,
        trigger=line,
        why=why,
    )


def light_unit_ns(projector: ProjectorCapabilities) -> int:
    """The time that exposures are whole multiples of: the modulation period, or the refresh where there is none."""
    return projector.modulation_period_ns or projector.refresh_ns


def _mode(
    projector: ProjectorCapabilities,
    camera: CameraCapabilities,
    sequence: PatternSequence,
    asked: TriggerMode | None,
    board: TriggerCapabilities | None,
    why: dict[str, str],
) -> Mode:
    if asked is not None and asked not in camera.trigger_modes:
        raise ConfigError(
            f"the camera has no trigger mode {asked.value!r}",
            hint=f"it has: {', '.join(sorted(mode.value for mode in camera.trigger_modes)) or 'none'}",
        )
    if projector.kind is ProjectorKind.SEQUENCER and len(sequence) > 1:
        if TriggerMode.HARDWARE not in camera.trigger_modes or asked not in (None, TriggerMode.HARDWARE):
            raise ConfigError(
                "a projector that runs its own table fires the camera itself: it needs hardware trigger",
                hint="wire the projector's trigger output to the camera's line, and leave trigger_mode out",
            )
        why["mode"] = "the projector runs its own table and fires the camera"
        return Mode.HARDWARE
    if len(sequence) == 1:
        if TriggerMode.FREE in camera.trigger_modes and asked in (None, TriggerMode.FREE):
            why["mode"] = "one pattern: it stays on, and the camera runs by itself"
            return Mode.STATIC
    elif projector.kind is ProjectorKind.STATIC:
        raise ConfigError(
            f"a static projector shows one image, the sequence has {len(sequence)}",
            hint="use a one-frame method (mcp) or a projector that can change its image",
        )
    wired = asked is None and board is not None and TriggerMode.HARDWARE in camera.trigger_modes
    if wired or asked is TriggerMode.HARDWARE:
        why["mode"] = "the camera's trigger line is pulsed in step with the display"
        return Mode.HARDWARE
    if TriggerMode.SOFTWARE in camera.trigger_modes and asked is not TriggerMode.FREE:
        why["mode"] = "the camera takes software triggers: each frame starts when its pattern shines"
        return Mode.SOFTWARE
    if TriggerMode.FREE in camera.trigger_modes:
        why["mode"] = "asked for" if asked else "the camera has no software trigger: frames that fit are picked"
        return Mode.FREE
    raise ConfigError(
        "the camera can neither run free nor be triggered by software",
        hint="wire its trigger line to a trigger board, and name the board in a table [trigger] of the rig file",
    )


def _check_size(projector: ProjectorCapabilities, sequence: PatternSequence) -> None:
    size = sequence.projector
    if (projector.width, projector.height) != (size.width, size.height):
        raise ConfigError(
            f"the patterns are {size.width} x {size.height}, the projector is {projector.width} x {projector.height}",
            hint="make the patterns in the projector's native size: scaling shifts the code",
        )


def _exposure(
    projector: ProjectorCapabilities,
    camera: CameraCapabilities,
    mode: Mode,
    asked: int | None,
    why: dict[str, str],
) -> int:
    unit = light_unit_ns(projector)
    name = "modulation period" if projector.modulation_period_ns else "refresh"
    wanted = unit if asked is None else asked
    if wanted <= 0:
        raise ConfigError(f"the exposure must be positive, got {wanted} ns")
    constant = projector.modulation_period_ns is None
    if constant and (wanted < unit or mode is Mode.STATIC):
        exposure, reason = wanted, "as asked: this projector's light is constant, so a part of a refresh sees the same"
    else:
        count = max(1, round(wanted / unit))
        exposure = count * unit
        reason = f"{count} x one {name} of {_ms(unit)}"
        if asked is not None and abs(exposure - asked) > camera.exposure_step_ns:
            reason += f", rounded from {_ms(asked)}: a grey is whole only over a whole {name}"
    step = max(1, camera.exposure_step_ns)
    exposure = round(exposure / step) * step
    if not camera.exposure_min_ns <= exposure <= camera.exposure_max_ns:
        raise ConfigError(
            f"an exposure of {_ms(exposure)} ({reason}) is outside the camera's "
            f"{_ms(camera.exposure_min_ns)} .. {_ms(camera.exposure_max_ns)}",
            hint=f"exposures are whole multiples of the projector's {name}, {_ms(unit)}",
        )
    why["exposure_ns"] = reason
    return exposure


def _delay(
    projector: ProjectorCapabilities, latency: Interval | None, settle: Interval | None, why: dict[str, str]
) -> int:
    if latency is not None and settle is not None:
        why["trigger_delay_ns"] = (
            f"measured latency up to {_ms(latency.high_ns)} and settling up to {_ms(settle.high_ns)} after the flip"
        )
        return latency.high_ns + settle.high_ns
    unknown = " and ".join(n for n, v in (("latency", latency), ("settling", settle)) if v is None)
    why["trigger_delay_ns"] = (
        f"{unknown} not measured: {ASSUMED_REFRESHES} refreshes assumed, and no frame can be proved"
    )
    known = (latency.high_ns if latency else 0) + (settle.high_ns if settle else 0)
    return known + ASSUMED_REFRESHES * projector.refresh_ns


def _slot_time(
    mode: Mode, camera: CameraCapabilities, exposure: int, delay: int, latency: Interval | None, starts_after: int
) -> int:
    bounds = 2 * camera.stamp_bound_ns
    if mode is Mode.FREE:
        # The next image may already begin to show `latency.low` after its flip: only the spread is lost.
        spread = delay - (latency.low_ns if latency is not None else 0)
        return camera.readout_ns + exposure + camera.min_period_ns(exposure) + bounds + spread
    return delay + starts_after + exposure + camera.readout_ns + bounds


def _dwell(
    mode: Mode, least: int, asked: int | None, needed: int, projector: ProjectorCapabilities, why: dict[str, str]
) -> int:
    if mode is Mode.STATIC:
        why["dwell"] = "the pattern stays on"
        return 1
    what = (
        "readout, exposure, one camera period and bounds"
        if mode is Mode.FREE
        else "the light's change, exposure, the camera's readiness and bounds"
        if mode is Mode.HARDWARE
        else "light's delay, exposure, readout and bounds"
    )
    if asked is not None and asked < least:
        raise ConfigError(
            f"a dwell of {asked} refreshes of {_ms(projector.refresh_ns)} is too short: {what} take {_ms(needed)}",
            hint=f"set dwell to {least} or more, or shorten the exposure",
        )
    dwell = asked or least
    refreshes = "one refresh" if dwell == 1 else f"{dwell} refreshes"
    why["dwell"] = f"{what} take {_ms(needed)}: {refreshes} of {_ms(projector.refresh_ns)}" + (
        ", longer by the rig file" if dwell > least else ""
    )
    return dwell


def _ms(ns: float) -> str:
    return f"{ns / 1e6:.3g} ms"


def _pair(interval: Interval | None) -> list[int] | None:
    return None if interval is None else [interval.low_ns, interval.high_ns]


def _interval(pair: Any) -> Interval | None:
    return None if pair is None else Interval(int(pair[0]), int(pair[1]))
