"""A trigger board's table made of slots: checked against what the board can do, and folded into its few steps.

A board's memory is small and a run may be long; runs are nearly always repetitions of a few steps. Pure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from scanner.devices import TableSlot, TriggerCapabilities, TriggerSource
from scanner.errors import ConfigError


@dataclass(frozen=True)
class BoardStep:
    """One step in a board's memory. edges 0: it follows the step before."""

    dark_us: int
    exposure_us: int
    emit: bool
    edges: int


@dataclass(frozen=True)
class BoardTable:
    """`steps`, run `repeats` times over: slot i of the run is step i % len(steps) of pass i // len(steps)."""

    steps: tuple[BoardStep, ...]
    repeats: int

    def __len__(self) -> int:
        """Slots of the whole run."""
        return len(self.steps) * self.repeats


EDGES_MAX = 255
"""Edges that a step can count"""


def board_table(
    slots: Sequence[TableSlot], source: TriggerSource, capabilities: TriggerCapabilities, device: str
) -> BoardTable:
    """The table that a board holds for `slots`.

    >>> capabilities = TriggerCapabilities(frozenset({TriggerSource.VSYNC}), 64, 1000, 50, 50, 10**6, 1000)
    >>> slots = [TableSlot(image=i, exposure_us=8000, dark_us=4500, wait_trigger=True) for i in range(120)]
    >>> table = board_table(slots, TriggerSource.VSYNC, capabilities, "board")
    >>> len(table.steps), table.repeats
    (1, 120)

    Raises:
        ConfigError: no slots, a slot outside the capabilities, or a table that does not fit.
    """
    if source not in capabilities.sources:
        known = ", ".join(sorted(one.value for one in capabilities.sources))
        raise ConfigError(f"the board has no source {source.value}", device=device, hint=f"it has: {known}")
    if not slots:
        raise ConfigError("the table has no slots", device=device)
    steps = [_step(i, slot, source, capabilities, device) for i, slot in enumerate(slots)]
    if source is not TriggerSource.INTERNAL and steps[0].edges == 0:
        raise ConfigError(
            f"source {source.value}: the first slot must wait for an edge", device=device, hint="set its wait_trigger"
        )
    length = _period(steps)
    repeats = len(steps) // length
    if length > capabilities.max_steps or repeats > capabilities.max_repeats:
        raise ConfigError(
            f"a table of {len(steps)} slots does not fit: {length} different steps, {repeats} times",
            device=device,
            hint=f"it holds {capabilities.max_steps} steps and repeats them up to {capabilities.max_repeats} times; "
            "give all slots the same times",
        )
    return BoardTable(tuple(steps[:length]), repeats)


def _step(i: int, slot: TableSlot, source: TriggerSource, c: TriggerCapabilities, device: str) -> BoardStep:
    for what, value, low in (
        ("dark_us", slot.dark_us, c.dark_min_us),
        ("exposure_us", slot.exposure_us, c.exposure_min_us),
    ):
        if not low <= value <= c.time_max_us:
            raise ConfigError(f"slot {i}: {what} is {value}, it must lie in {low} .. {c.time_max_us}", device=device)
    if not slot.wait_trigger:
        return BoardStep(slot.dark_us, slot.exposure_us, slot.emit_trigger, 0)
    if source is TriggerSource.INTERNAL:
        raise ConfigError(
            f"slot {i} waits for a trigger, and source INT gives none",
            device=device,
            hint="leave wait_trigger out, or use source VSYNC or EXT",
        )
    if not 1 <= slot.edges <= EDGES_MAX:
        raise ConfigError(f"slot {i}: edges is {slot.edges}, it must lie in 1 .. {EDGES_MAX}", device=device)
    return BoardStep(slot.dark_us, slot.exposure_us, slot.emit_trigger, slot.edges)


def _period(steps: Sequence[BoardStep]) -> int:
    """Length of the shortest beginning whose repetition is the whole (Knuth, Morris and Pratt 1977: its border)."""
    border = [0] * len(steps)
    k = 0
    for i in range(1, len(steps)):
        while k and steps[i] != steps[k]:
            k = border[k - 1]
        k += steps[i] == steps[k]
        border[i] = k
    length = len(steps) - border[-1]
    return length if len(steps) % length == 0 else len(steps)
