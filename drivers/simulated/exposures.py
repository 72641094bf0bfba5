"""When the simulated camera exposes, and when each frame is with the host: free run, triggers, edges, faults of timing.

An exposure is known from the moment it begins; its frame is ready after the readout and then waits in one of the
camera's buffers. When all are full, further frames are lost, as they are where a stream runs out of buffers.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import cast

from drivers.simulated.faults import Allowance, chance
from drivers.simulated.lines import LineName
from drivers.simulated.options import Settings
from drivers.simulated.world import World
from scanner.devices import TriggerMode

STAMP_BOUND_NS = 1000
"""Stamps are true to this; the error in it is drawn anew for every frame"""

_RANDOM_USE = 2
_FAULT_USE = 3
_LINE_USE = 5


@dataclass(frozen=True)
class Window:
    """What a frame's pixels show: when its first row began, and the key of its noise."""

    start_ns: int
    exposure_ns: int
    number: int


@dataclass(frozen=True)
class Shot:
    """One exposure on its way to the host."""

    window: Window
    stamp_ns: int
    ready_ns: int
    frame_id: int
    trigger: int | None
    lost: bool = False
    incomplete: bool = False
    waits: bool = False
    """its pixels are those of the next shot, which has not come yet"""


class Exposures:
    """The exposures of one camera, counted anew by each `start`."""

    def __init__(self, world: World, settings: Settings) -> None:
        self._lines = world.lines
        self._options = settings.camera
        self._faults = settings.camera_faults
        self._random = world.random(_RANDOM_USE)
        self._fault_random = world.random(_FAULT_USE)
        self._allowance = Allowance(self._faults.times)
        self._trigger_latency_ns = 1e3 * self._options.trigger_latency_us * self._random.uniform(0.9, 1.1)
        self._free_phase = self._random.uniform()
        self._line_latency_ns = 1e3 * self._options.line_latency_us * world.random(_LINE_USE).uniform(0.8, 1.2)
        self._numbers = 0
        """exposures since the camera was opened"""
        self._mode: TriggerMode | None = None
        self.waiting: deque[Shot] = deque()
        """in the device's buffers, oldest first"""
        self.start(None, 0, 0)

    def start(self, mode: TriggerMode | None, exposure_ns: int, now_ns: int) -> None:
        """Begin to expose (None: end it); shots from before are gone."""
        self._mode, self._exposure_ns = mode, exposure_ns
        self._exposed: deque[Shot] = deque()
        """begun, not yet ready"""
        self.waiting.clear()
        self._last_window: Window | None = None
        self._ordinal = self._frame_id = self._triggers = 0
        self._idle_ns = 0
        """when the next exposure may begin"""
        self._free_start_ns = now_ns + int(self._free_phase * self._options.period_ns(exposure_ns))
        self._line_ns = now_ns
        """the last edge of the line that was seen"""
        self._latched_ns = 0
        """until then a latched edge waits, and another one is dropped"""

    def trigger(self, now_ns: int) -> None:
        """A software trigger; one that finds the camera busy is counted and dropped."""
        self._triggers += 1
        start = now_ns + round(self._trigger_latency_ns * self._random.uniform(0.95, 1.05))
        if start >= self._idle_ns:
            self._expose(start, self._number_of_trigger)

    def collect(self, now_ns: int) -> None:
        """Begin what begins by now, and move shots that are ready to the buffers."""
        while True:
            self._begin_free(now_ns)
            self._begin_line(now_ns)
            if not self._exposed or self._exposed[0].waits or self._exposed[0].ready_ns > now_ns:
                return
            shot = self._exposed.popleft()
            if not shot.lost and len(self.waiting) < self._options.buffers:
                self.waiting.append(shot)

    def coming(self, deadline_ns: int) -> Shot | None:
        """The shot that will be ready next, if it began before the deadline; FREE: begins those it looks at."""
        while True:
            for shot in self._exposed:
                if not shot.waits and not shot.lost:
                    return shot
            if self._mode is not TriggerMode.FREE or self._next_free_ns > deadline_ns:
                return None
            self._expose(self._next_free_ns, None)

    def next_edge(self) -> int | None:
        """HARDWARE: the next edge of the line, as things stand."""
        line = self._lines.get(cast("LineName", self._options.line)) if self._mode is TriggerMode.HARDWARE else None
        return None if line is None else line.next_edge(self._line_ns)

    def _expose(self, start_ns: int, trigger: int | None) -> None:
        """Begin one exposure, with the faults that befall it."""
        faults, options, ordinal = self._faults, self._options, self._ordinal
        self._ordinal += 1
        if faults.jitter_us and self._allowance.take("jitter_us"):
            start_ns += round(1e3 * self._fault_random.uniform(0.0, faults.jitter_us))
        stamp = start_ns + round(self._random.uniform(-0.5, 0.5) * STAMP_BOUND_NS)
        if faults.phase_frames and self._allowance.take("phase_frames"):
            start_ns += round(faults.phase_frames * options.period_ns(self._exposure_ns))
        if faults.stamp_lie_ns and self._allowance.take("stamp_lie_ns"):
            stamp += faults.stamp_lie_ns
        lost = ordinal in faults.drop or chance(self._fault_random, faults.drop_probability)
        lost = lost and self._allowance.take("drop")
        window = Window(start_ns, self._exposure_ns, self._numbers)
        self._numbers += 1
        shot = Shot(
            window,
            stamp,
            ready_ns=start_ns + self._exposure_ns + options.readout_ns,
            frame_id=self._frame_id,
            trigger=trigger,
            lost=lost,
            incomplete=ordinal in faults.incomplete and self._allowance.take("incomplete"),
            waits=ordinal in faults.swap and self._allowance.take("swap"),
        )
        if ordinal in faults.double and self._last_window is not None and self._allowance.take("double"):
            shot = replace(shot, window=self._last_window)
        self._last_window = window
        self._idle_ns = start_ns + self._exposure_ns + options.gap_ns
        self._frame_id += 0 if lost and faults.drop_hides_id else 1
        self._exposed.append(self._swapped(shot))

    def _swapped(self, shot: Shot) -> Shot:
        """Exchange pixels with the shot before where that one waits for them."""
        if not self._exposed or not self._exposed[-1].waits:
            return shot
        before = self._exposed.pop()
        self._exposed.append(replace(before, window=shot.window, ready_ns=shot.ready_ns, waits=False))
        return replace(shot, window=before.window)

    @property
    def _next_free_ns(self) -> int:
        return self._free_start_ns + self._ordinal * self._options.period_ns(self._exposure_ns)

    def _begin_free(self, now_ns: int) -> None:
        while self._mode is TriggerMode.FREE and self._next_free_ns <= now_ns:
            self._expose(self._next_free_ns, None)

    def _begin_line(self, now_ns: int) -> None:
        """Take the edges up to now, each with the exposure it starts, if any."""
        while (edge := self.next_edge()) is not None and edge <= now_ns:
            self._line_ns = edge
            self._triggers += 1
            start = edge + round(self._line_latency_ns)
            if start < self._idle_ns:
                if not self._options.latch or start < self._latched_ns:
                    continue
                start = self._latched_ns = self._idle_ns
            self._expose(start, self._number_of_trigger)

    @property
    def _number_of_trigger(self) -> int | None:
        """Of the last one, from 0, where the camera counts."""
        return self._triggers - 1 if self._options.counts_triggers else None
