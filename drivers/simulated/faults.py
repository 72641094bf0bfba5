"""What can go wrong on purpose, each a named setting; the same faults real devices have.

Frames are counted from the camera's last `start`, flips from the projector's last `load`. `times` limits a fault to
its first occurrences, so that a retake can succeed: an occurrence is one frame or one flip that came out wrong.
`unplug_after` counts from opening and is final.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from scanner.errors import ConfigError

FOREVER = 1 << 30


@dataclass(frozen=True)
class CameraFaults:
    """Faults of the simulated camera."""

    phase_frames: float = field(default=0.0, metadata={"low": -1.0, "high": 4.0})
    """exposures begin this share of the shortest frame period later than asked and than their stamps say"""
    stamp_lie_ns: int = field(default=0, metadata={"low": -(10**9), "high": 10**9})
    """stamps are late by this and still claim to be exact"""
    jitter_us: float = field(default=0.0, metadata={"low": 0.0, "high": 1e6})
    """exposures begin up to this much later, at random; their stamps tell"""
    drop: tuple[int, ...] = ()
    """frames exposed and never delivered"""
    drop_probability: float = field(default=0.0, metadata={"low": 0.0, "high": 1.0})
    """of each frame to be exposed and never delivered"""
    drop_hides_id: bool = False
    """the device's count shows no gap where a frame was dropped"""
    double: tuple[int, ...] = ()
    """frames that carry the pixels of the frame before under a count and stamp of their own"""
    swap: tuple[int, ...] = ()
    """frame k carries the pixels of frame k + 1 and the other way round; both come when k + 1 is there"""
    incomplete: tuple[int, ...] = ()
    """frames whose lower half never arrived"""
    unplug_after: int | None = field(default=None, metadata={"low": 0})
    """DeviceLost after so many frames"""
    times: int = field(default=FOREVER, metadata={"low": 0})
    """first occurrences of each fault that happen; later ones do not, so that frames taken again are right"""


@dataclass(frozen=True)
class ProjectorFaults:
    """Faults of the simulated projector."""

    extra_latency_us: float = field(default=0.0, metadata={"low": -1e6, "high": 1e6})
    """light follows a flip later than the declared latency says"""
    extra_latency_after: int = field(default=0, metadata={"low": 0})
    """flips that are still right"""
    permute: tuple[int, ...] = ()
    """flip to image i shows image permute[i]; images beyond the list are right"""
    order: str = ""
    """"swap:5,6" | "reverse" | "rotate:FIRST,COUNT[,BY]": a permutation by name"""
    late_flips: int = field(default=0, metadata={"low": 0, "high": 64})
    """each flip shows the image of so many flips before"""
    skip: tuple[int, ...] = ()
    """flips that are reported and change nothing"""
    double: tuple[int, ...] = ()
    """flips that show the image before again; later ones come one late, until the host goes back to an earlier image"""
    unplug_after: int | None = field(default=None, metadata={"low": 0})
    """DeviceLost after so many flips"""
    times: int = field(default=FOREVER, metadata={"low": 0})
    """first occurrences of each fault that happen"""


@dataclass(frozen=True)
class TriggerFaults:
    """Faults of the simulated trigger board. Slots are positions in the table that was programmed."""

    drop_pulses: tuple[int, ...] = ()
    """slots whose pulse is reported and never reaches the camera"""
    spurious: tuple[int, ...] = ()
    """slots in whose dark time a pulse comes that nobody asked for"""
    lose_events: tuple[int, ...] = ()
    """slots whose event is never reported"""
    source_ends_after: int | None = field(default=None, metadata={"low": 0})
    """the source gives so many edges in a run, then none"""
    unplug_after: int | None = field(default=None, metadata={"low": 0})
    """DeviceLost after so many pulses"""


class Allowance:
    """How often a fault may still occur."""

    def __init__(self, times: int) -> None:
        self._left: dict[str, int] = {}
        self._times = times

    def take(self, fault: str) -> bool:
        """Whether `fault` may occur now; counts it if so."""
        left = self._left.get(fault, self._times)
        self._left[fault] = left - 1
        return left > 0


def displayed_index(faults: ProjectorFaults, index: int, count: int) -> int:
    """The image that a flip to `index` of `count` loaded ones really shows.

    A fault that names images beyond those loaded leaves the flip alone: test shots load fewer than a scan.
    """
    if faults.order:
        shown = _ordered(faults.order, index, count)
    else:
        shown = faults.permute[index] if index < len(faults.permute) else index
    return shown if 0 <= shown < count else index


def check_order(order: str) -> None:
    """Raise ConfigError unless `order` is empty or a permutation by name."""
    _ordered(order, 0, 1) if order else None


def _ordered(order: str, index: int, count: int) -> int:
    name, _, rest = order.partition(":")
    try:
        numbers = [int(part) for part in rest.split(",")] if rest else []
    except ValueError:
        numbers = []
    if name == "reverse" and not rest:
        return count - 1 - index
    if name == "swap" and len(numbers) == 2:
        first, second = numbers
        return {first: second, second: first}.get(index, index)
    if name == "rotate" and len(numbers) in (2, 3) and numbers[1] > 0:
        first, length = numbers[:2]
        by = numbers[2] if len(numbers) == 3 else 1
        return first + (index - first + by) % length if first <= index < first + length else index
    raise ConfigError(
        f"fault order {order!r} is not understood",
        hint='give "swap:5,6", "reverse" or "rotate:FIRST,COUNT[,BY]", or use permute',
    )


def chance(generator: np.random.Generator, probability: float) -> bool:
    """One draw; none is made for probability 0, so that unused faults leave the sequence of draws alone."""
    return probability > 0 and bool(generator.random() < probability)
