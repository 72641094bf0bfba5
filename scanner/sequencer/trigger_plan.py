"""The part of a plan that a trigger line needs: what the board's table holds, and how far pulses run behind flips.

The board counts vertical blanks, waits out the light's delay and pulses the camera; the host only flips. Where the
light comes later than the next flip, pulses run whole slots behind the flips. Pure, as `plan` is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from scanner.devices import (
    CameraCapabilities,
    ProjectorCapabilities,
    ProjectorKind,
    TableSlot,
    TriggerCapabilities,
    TriggerSource,
)
from scanner.errors import ConfigError

GUARD_NS = 100_000
"""Between a pattern's certain light and the pulse, and before the next edge, at least; more where the events of a
board's pulses are known less well: a tenth of a millisecond costs nothing at any refresh."""

PULSES_A_PATTERN = 2
"""Pulses that the board has for each pattern, so that every flip may be late by a slot and its frame is there all the
same. The board is stopped once all frames are: those that nobody needed are never given."""


@dataclass(frozen=True)
class TriggerPlan:
    """How the camera's line is driven. Microseconds, as boards and controllers take them; 0 and 0 for `projector`."""

    line: Literal["board", "projector", "table"]
    """a trigger board; a display's own output, once a refresh; a projector that runs a table, once a slot"""
    dark_us: int = 0
    """board: from the vertical blank that begins a slot to the pulse; table: dark time before a slot's light"""
    pulse_us: int = 0
    """board: length of the pulse; table: of a slot's light"""
    lead: int = 0
    """slots by which pulses run behind flips: the first `lead` pulses see what shone before"""

    def as_dict(self) -> dict[str, Any]:
        """Plain data for capture.json."""
        return asdict(self)

    @classmethod
    def from_dict(cls, content: Mapping[str, Any] | None) -> TriggerPlan | None:
        """Read what `as_dict` wrote; None for captures without a trigger line.

        Raises:
            TypeError: it is something else.
        """
        return None if content is None else cls(**content)

    def shown(self, images: Sequence[int]) -> list[TableSlot]:
        """The table of a projector that runs one: these images in turn, each lit once, with an edge."""
        return [TableSlot(image=i, exposure_us=self.pulse_us, dark_us=self.dark_us) for i in images]

    def table(self, patterns: int, dwell: int) -> list[TableSlot]:
        """The board's table for so many patterns, source VSYNC: every `dwell` vertical blanks one pulse."""
        count = PULSES_A_PATTERN * patterns + self.lead
        return [
            TableSlot(image=i, exposure_us=self.pulse_us, dark_us=self.dark_us, wait_trigger=True, edges=dwell)
            for i in range(count)
        ]


def trigger_time(
    projector: ProjectorCapabilities,
    camera: CameraCapabilities,
    board: TriggerCapabilities | None,
    *,
    exposure_ns: int,
    spread_ns: int,
) -> int:
    """Least time of a slot, ns.

    Light changes over `spread_ns` (from the least latency to certain light); within the rest the exposure must lie,
    and the camera must be ready again. A projector's own pulse comes when light begins, so the next one counts.
    """
    if projector.kind is ProjectorKind.SEQUENCER:
        slot = table_slot(camera, exposure_ns)
        return 1000 * (slot.dark_us + slot.pulse_us)
    rolling = camera.readout_ns if camera.shutter == "rolling" else 0
    late = camera.line_latency.high_ns if camera.line_latency is not None else 2 * camera.stamp_bound_ns
    wait = 2 * guard_ns(board) + 1000 * board.dark_min_us if board is not None else projector.refresh_ns
    return max(spread_ns + wait + late + exposure_ns + rolling, camera.min_period_ns(exposure_ns) + GUARD_NS)


def guard_ns(board: TriggerCapabilities | None) -> int:
    """Time kept around light that changes. An event may be early by its bound, and the bound is taken off once more."""
    return GUARD_NS if board is None else max(GUARD_NS, 2 * board.event_bound_ns + board.jitter_ns)


def table_slot(camera: CameraCapabilities, exposure_ns: int) -> TriggerPlan:
    """A slot of a projector's own table: light for as long as any row is exposed, dark until the camera is ready."""
    rolling = camera.readout_ns if camera.shutter == "rolling" else 0
    late = camera.line_latency.high_ns if camera.line_latency is not None else 2 * camera.stamp_bound_ns
    lit = exposure_ns + rolling + late + GUARD_NS
    dark = max(GUARD_NS, camera.min_period_ns(exposure_ns) + GUARD_NS - lit)
    return TriggerPlan("table", -(-dark // 1000), -(-lit // 1000))


def trigger_plan(
    projector: ProjectorCapabilities,
    camera: CameraCapabilities,
    board: TriggerCapabilities | None,
    *,
    delay_ns: int,
    exposure_ns: int,
    period_ns: int,
    why: dict[str, str],
) -> TriggerPlan:
    """The table of a board, or the projector's own output.

    Args:
        board: the rig's board, None without one.
        delay_ns: from a flip to its certain light.
        period_ns: time of a slot, at least what `trigger_time` gave.
        why: gets the reason.

    Raises:
        ConfigError: there is nothing that could pulse the line.
    """
    if projector.kind is ProjectorKind.SEQUENCER:
        why["trigger"] = (
            "the projector runs the table by itself, and each slot's light has an edge on the camera's line"
        )
        return table_slot(camera, exposure_ns)
    if board is None:
        if "frame" not in projector.trigger_outputs:
            raise ConfigError(
                "hardware trigger needs a trigger board, or a projector with a trigger output at every refresh",
                hint="name the board in a table [trigger] of the rig file, or set trigger_mode to software",
            )
        why["trigger"] = "the projector's output pulses at every refresh; the frame that fits its pattern is taken"
        return TriggerPlan("projector")
    if TriggerSource.VSYNC not in board.sources:
        raise ConfigError(
            "the trigger board has no vertical-sync input, and a board that runs by itself drifts out of step",
            hint="wire the display's vertical sync to the board, or set trigger_mode to software",
        )
    wanted = delay_ns + guard_ns(board)
    lead, dark = divmod(wanted, period_ns)
    room = period_ns - GUARD_NS - 1000 * board.exposure_min_us
    if dark > room:
        lead, dark = lead + 1, 0
    dark_us = max(board.dark_min_us, -(-dark // 1000))
    pulse_us = max(board.exposure_min_us, min(exposure_ns, period_ns - GUARD_NS - 1000 * dark_us) // 1000)
    if max(dark_us, pulse_us) > board.time_max_us:
        raise ConfigError(f"a slot of {period_ns / 1e6:.3g} ms is longer than the trigger board can time")
    why["trigger"] = (
        f"the board pulses {dark_us / 1e3:.3g} ms after a vertical blank"
        + (f", {lead} slots behind the flips" if lead else "")
        + f": light is certain {delay_ns / 1e6:.3g} ms after its flip"
    )
    return TriggerPlan("board", int(dark_us), int(pulse_us), int(lead))
