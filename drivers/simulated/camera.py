"""The simulated camera: integrates what shone during its exposures, and delivers as real cameras do.

    stopped --start--> acquiring --stop--> stopped --close--> closed

A frame is rendered when it is asked for and its exposure is over, from the world's timeline; nothing runs in the
background, so virtual and real time give the same frames. In mode HARDWARE the edges of the world's lines start
exposures; an edge that finds the camera busy is counted and dropped (or latched). Frames wait in `buffers` buffers;
when all are full, further frames are lost, as they are where a stream runs out of buffers.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from drivers.simulated.camera_settings import (
    EXPOSURE_MAX_NS,
    EXPOSURE_MIN_NS,
    EXPOSURE_STEP_NS,
    GAIN_MAX_DB,
    Taken,
    checked,
)
from drivers.simulated.faults import Allowance, chance
from drivers.simulated.lines import LineName
from drivers.simulated.options import Settings
from drivers.simulated.sensor import deviates
from drivers.simulated.world import NOMINAL_EXPOSURE_NS, World
from scanner.devices import (
    CameraCapabilities,
    CameraFrame,
    CameraSettings,
    Exposure,
    Interval,
    Pixels,
    Source,
    TriggerMode,
    Truth,
)
from scanner.errors import DeviceBusy, DeviceError, DeviceLost
from scanner.geometry import Calibration

STAMP_BOUND_NS = 1000
"""Stamps are true to this; the error in it is drawn anew for every frame"""

_RANDOM_USE = 2
_FAULT_USE = 3
_LINE_USE = 5
_LENT = 3
"""Frame buffers: the one lent, the one being filled, and one to spare for a reader that is late"""


@dataclass(frozen=True)
class _Window:
    """What a frame's pixels show: when its first row began, and the key of its noise."""

    start_ns: int
    exposure_ns: int
    number: int


@dataclass(frozen=True)
class _Shot:
    """One exposure on its way to the host."""

    window: _Window
    stamp_ns: int
    end_ns: int
    """true end of the last row's exposure"""
    ready_ns: int
    frame_id: int
    trigger: int | None
    lost: bool = False
    incomplete: bool = False
    waits: bool = False
    """its pixels are those of the next shot, which has not come yet"""


class SimulatedCamera:
    """A camera that stands in a simulated world; see `scanner.devices.Camera` and `KnowsTruth`."""

    _exposed: deque[_Shot]
    """begun, not yet ready"""
    _waiting: deque[_Shot]
    """in the device's buffers"""
    _prepared: tuple[_Window, int, Pixels] | None
    _last_window: _Window | None
    _ordinal: int
    """frames exposed since start"""
    _frame_id: int
    _triggers: int
    _idle_ns: int
    """when the next exposure may begin"""
    _free_start_ns: int
    _line_ns: int
    """the last edge of the line that was seen"""
    _latched_ns: int
    """until then a latched edge waits, and another one is dropped"""

    def __init__(self, world: World, settings: Settings, name: str) -> None:
        world.hold("camera", self, name)
        self._world = world
        self._clock = world.clock
        self._name = name
        self._options = settings.camera
        self._faults = settings.camera_faults
        self._random = world.random(_RANDOM_USE)
        self._fault_random = world.random(_FAULT_USE)
        self._allowance = Allowance(self._faults.times)
        self._trigger_latency_ns = 1e3 * self._options.trigger_latency_us * self._random.uniform(0.9, 1.1)
        self._free_phase = self._random.uniform()
        self._line_latency_ns = 1e3 * self._options.line_latency_us * world.random(_LINE_USE).uniform(0.8, 1.2)
        exposure = NOMINAL_EXPOSURE_NS // EXPOSURE_STEP_NS * EXPOSURE_STEP_NS
        self._taken = Taken(exposure, 0.0, world.settings.optics.bits)
        self._mode: TriggerMode | None = None
        self._open = True
        self._numbers = 0
        self._delivered = 0
        self._ring: list[Pixels] = []
        self._ring_shows: list[object] = []
        self._buffers: list[Pixels] = []
        self._forget_shots()
        _ = world.view, world.electrons_per_light, deviates()  # now: opening may take a second, a first frame may not

    @property
    def name(self) -> str:
        """The device's name in messages."""
        return self._name

    @property
    def capabilities(self) -> CameraCapabilities:
        """What it can do with the settings last applied."""
        width, height = self._world.rig.calibration.camera.size
        latency, line_latency = 1e3 * self._options.trigger_latency_us, 1e3 * self._options.line_latency_us
        return CameraCapabilities(
            width=width,
            height=height,
            bits=self._taken.bits,
            shutter="rolling" if self._rolling else "global",
            readout_ns=self._readout_ns,
            exposure_min_ns=EXPOSURE_MIN_NS,
            exposure_max_ns=EXPOSURE_MAX_NS,
            exposure_step_ns=EXPOSURE_STEP_NS,
            min_gap_ns=self._gap_ns,
            trigger_modes=frozenset(TriggerMode),
            trigger_latency=Interval(round(0.75 * latency), round(1.25 * latency)),
            line_latency=Interval(round(0.75 * line_latency), round(1.25 * line_latency)),
            stamp=Source.HARDWARE,
            stamp_bound_ns=STAMP_BOUND_NS,
            gain_max_db=GAIN_MAX_DB,
        )

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set and read back; see `scanner.devices.Camera.apply`."""
        self._check_open()
        if self._mode is not None:
            raise DeviceBusy("settings change while the camera is stopped", device=self._name, hint="stop it first")
        width, height = self._world.rig.calibration.camera.size
        taken = checked(settings, self._taken, (width, height), self._name)
        if taken.bits != self._taken.bits:
            self._buffers = []
        if taken != self._taken:
            self._ring = []
        self._taken = taken
        return CameraSettings(taken.exposure_ns, taken.gain_db, taken.pixel_format, (0, 0, width, height))

    def start(self, mode: TriggerMode) -> None:
        """Begin to acquire; see `scanner.devices.Camera.start`."""
        self._check_open()
        self._check_plugged()
        if self._mode is not None:
            raise DeviceBusy("the camera is acquiring already", device=self._name, hint="stop it first")
        self._forget_shots()
        self._mode = mode
        self._fill_ring()
        now = self._clock.now_ns()
        self._free_start_ns = now + int(self._free_phase * self._period_ns)
        self._line_ns = now

    def trigger(self) -> None:
        """Start one exposure now, unless the camera is busy; see `scanner.devices.Camera.trigger`."""
        self._check_open()
        self._check_plugged()
        if self._mode is not TriggerMode.SOFTWARE:
            raise DeviceError("a trigger needs the camera started in mode software", device=self._name)
        self._triggers += 1
        start = self._clock.now_ns() + round(self._trigger_latency_ns * self._random.uniform(0.95, 1.05))
        if start < self._idle_ns:
            return
        self._expose(start, self._triggers - 1 if self._options.counts_triggers else None)

    def pop(self, timeout_ns: int) -> CameraFrame | None:
        """The next frame; see `scanner.devices.Camera.pop`."""
        self._check_open()
        self._check_plugged()
        if self._mode is None:
            raise DeviceError("the camera is not acquiring", device=self._name, hint="start it first")
        if self._as_fast_as_asked:
            return self._next_of_ring()
        deadline = self._clock.now_ns() + max(0, timeout_ns)
        while True:
            self._collect(self._clock.now_ns())
            if self._waiting:
                return self._deliver(self._waiting.popleft())
            coming = self._coming(deadline)
            edge = self._next_edge() if coming is None else None
            if edge is not None and edge <= deadline:
                self._clock.sleep_until(edge)
                continue
            if coming is None or coming.ready_ns > deadline:
                self._clock.sleep_until(deadline)
                return None
            self._prepare(coming)
            self._clock.sleep_until(coming.ready_ns)

    def stop(self) -> None:
        """End acquisition; may be called twice."""
        self._mode = None
        self._forget_shots()

    def close(self) -> None:
        """Give the device back; may be called twice."""
        if self._open:
            self.stop()
            self._open = False
            self._world.release("camera")

    def truth(self) -> Truth:
        """The scene's truth; see `scanner.devices.KnowsTruth`."""
        return self._world.view.truth

    def true_calibration(self) -> Calibration:
        """The rig's geometry, exact, and the projector's response as far as the optics let one know it."""
        return self._world.calibration

    # --- exposures -----------------------------------------------------------------------------------------------

    def _expose(self, start_ns: int, trigger: int | None) -> None:
        """Begin one exposure, with the faults that befall it."""
        faults, ordinal = self._faults, self._ordinal
        self._ordinal += 1
        if faults.jitter_us and self._allowance.take("jitter_us"):
            start_ns += round(1e3 * self._fault_random.uniform(0.0, faults.jitter_us))
        stamp = start_ns + round(self._random.uniform(-0.5, 0.5) * STAMP_BOUND_NS)
        if faults.phase_frames and self._allowance.take("phase_frames"):
            start_ns += round(faults.phase_frames * self._period_ns)
        if faults.stamp_lie_ns and self._allowance.take("stamp_lie_ns"):
            stamp += faults.stamp_lie_ns
        lost = ordinal in faults.drop or chance(self._fault_random, faults.drop_probability)
        lost = lost and self._allowance.take("drop")
        window = _Window(start_ns, self._taken.exposure_ns, self._numbers)
        self._numbers += 1
        end = start_ns + self._taken.exposure_ns + (self._readout_ns if self._rolling else 0)
        shot = _Shot(
            window,
            stamp,
            end,
            ready_ns=end + (0 if self._rolling else self._readout_ns),
            frame_id=self._frame_id,
            trigger=trigger,
            lost=lost,
            incomplete=ordinal in faults.incomplete and self._allowance.take("incomplete"),
            waits=ordinal in faults.swap and self._allowance.take("swap"),
        )
        if ordinal in faults.double and self._last_window is not None and self._allowance.take("double"):
            shot = replace(shot, window=self._last_window)
        self._last_window = window
        self._idle_ns = start_ns + self._taken.exposure_ns + self._gap_ns
        self._frame_id += 0 if lost and faults.drop_hides_id else 1
        self._exposed.append(self._swapped(shot))

    def _swapped(self, shot: _Shot) -> _Shot:
        """Exchange pixels with the shot before where that one waits for them."""
        if not self._exposed or not self._exposed[-1].waits:
            return shot
        before = self._exposed.pop()
        self._exposed.append(replace(before, window=shot.window, ready_ns=shot.ready_ns, waits=False))
        return replace(shot, window=before.window)

    def _coming(self, deadline_ns: int) -> _Shot | None:
        """The shot that will be ready next, if it began before the deadline; FREE: begins those it looks at."""
        while True:
            for shot in self._exposed:
                if not shot.waits and not shot.lost:
                    return shot
            begins = self._free_start_ns + self._ordinal * self._period_ns
            if self._mode is not TriggerMode.FREE or begins > deadline_ns:
                return None
            self._expose(begins, None)

    def _collect(self, now_ns: int) -> None:
        """Move shots that are ready to the buffers; where those are full, frames are lost."""
        while True:
            self._begin_free(now_ns)
            self._begin_line(now_ns)
            if not self._exposed or self._exposed[0].waits or self._exposed[0].ready_ns > now_ns:
                return
            shot = self._exposed.popleft()
            if not shot.lost and len(self._waiting) < self._options.buffers:
                self._waiting.append(shot)

    def _begin_free(self, now_ns: int) -> None:
        if self._mode is TriggerMode.FREE:
            while self._free_start_ns + self._ordinal * self._period_ns <= now_ns:
                self._expose(self._free_start_ns + self._ordinal * self._period_ns, None)

    def _next_edge(self) -> int | None:
        """HARDWARE: the next edge of the line, as things stand."""
        line = self._world.lines.get(self._line) if self._mode is TriggerMode.HARDWARE else None
        return None if line is None else line.next_edge(self._line_ns)

    def _begin_line(self, now_ns: int) -> None:
        """Take the edges up to now, each with the exposure it starts, if any."""
        while (edge := self._next_edge()) is not None and edge <= now_ns:
            self._line_ns = edge
            self._triggers += 1
            start = edge + round(self._line_latency_ns)
            if start < self._idle_ns:
                if not self._options.latch or start < self._latched_ns:
                    continue
                start = self._latched_ns = self._idle_ns
            self._expose(start, self._triggers - 1 if self._options.counts_triggers else None)

    def _forget_shots(self) -> None:
        self._exposed = deque()
        self._waiting = deque()
        self._prepared = None
        self._last_window = None
        self._ordinal = 0
        self._frame_id = 0
        self._triggers = 0
        self._idle_ns = 0
        self._free_start_ns = 0
        self._line_ns = 0
        self._latched_ns = 0

    # --- frames --------------------------------------------------------------------------------------------------

    def _prepare(self, shot: _Shot) -> None:
        """Render while the exposure runs: in real time the frame is then there when it is due.

        What will shine is known, since one thread at a time calls the devices and this one is here; if a flip comes
        from elsewhere all the same, the frame is rendered again.
        """
        changes = self._world.timeline.changes
        self._prepared = (shot.window, changes, self._pixels(shot.window))

    def _deliver(self, shot: _Shot) -> CameraFrame:
        self._delivered += 1
        prepared, changes = self._prepared, self._world.timeline.changes
        if prepared is not None and prepared[0] is shot.window and prepared[1] == changes:
            pixels = prepared[2]
        else:
            pixels = self._pixels(shot.window)
        self._prepared = None
        if shot.incomplete:
            pixels = pixels.copy()
            pixels[pixels.shape[0] // 2 :] = 0
        length = self._taken.exposure_ns + (self._readout_ns if self._rolling else 0)
        exposure = Exposure(shot.stamp_ns, shot.stamp_ns + length, STAMP_BOUND_NS, Source.HARDWARE)
        return CameraFrame(pixels, shot.frame_id, exposure, not shot.incomplete, shot.trigger)

    def _pixels(self, window: _Window) -> Pixels:
        if self._ring:
            return self._ring[window.number % len(self._ring)]
        if not self._buffers:
            self._buffers = [self._empty_frame() for _ in range(_LENT)]
        out = self._buffers.pop(0)
        self._buffers.append(out)
        self._render(window, out)
        return out

    def _render(self, window: _Window, out: Pixels) -> None:
        readout = self._readout_ns if self._rolling else 0
        self._world.render(
            window.start_ns, window.exposure_ns, readout, self._taken.gain_db, self._taken.bits, window.number, out
        )

    def _empty_frame(self) -> Pixels:
        width, height = self._world.rig.calibration.camera.size
        if self._taken.bits <= 8:
            return np.empty((height, width), dtype=np.uint8)
        return np.empty((height, width), dtype=np.uint16)

    def _fill_ring(self) -> None:
        """Render the ring's frames, of what shone during the last exposure's time, unless that is what they show."""
        start = self._clock.now_ns() - self._taken.exposure_ns
        segments = self._world.timeline.between(start, start + self._taken.exposure_ns)
        # One image all through looks the same whenever it was flipped to; a change within the exposure never does.
        images = [segment.image for segment in segments]
        one = all(image is images[0] for image in images)
        shows: list[object] = [images[0]] if one else [segment.on_ns for segment in segments]
        if len(self._ring) == self._options.ring and shows == self._ring_shows:
            return
        self._ring, self._ring_shows = [], shows
        for number in range(self._options.ring):
            frame = self._empty_frame()
            self._render(_Window(start, self._taken.exposure_ns, number), frame)
            self._ring.append(frame)

    def _next_of_ring(self) -> CameraFrame:
        """A frame of the ring at once; its stamps follow one another without overlap, however fast it is asked."""
        now = self._clock.now_ns()
        start = max(now - self._taken.exposure_ns, self._idle_ns)
        end = max(now, start)
        self._idle_ns = end
        pixels = self._ring[self._ordinal % len(self._ring)]
        frame = CameraFrame(pixels, self._ordinal, Exposure(start, end, STAMP_BOUND_NS, Source.HARDWARE))
        self._ordinal += 1
        self._delivered += 1
        return frame

    # --- settings ------------------------------------------------------------------------------------------------

    @property
    def _line(self) -> LineName:
        return cast("LineName", self._options.line)

    @property
    def _rolling(self) -> bool:
        return self._options.shutter == "rolling"

    @property
    def _readout_ns(self) -> int:
        return round(1e3 * self._options.readout_us)

    @property
    def _gap_ns(self) -> int:
        gap = self._options.min_gap_us
        return self._readout_ns if gap is None else round(1e3 * gap)

    @property
    def _period_ns(self) -> int:
        """Between the starts of two free-running exposures."""
        shortest = self._taken.exposure_ns + self._gap_ns
        asked = self._options.period_us
        return shortest if asked is None else max(round(1e3 * asked), 1 if self._options.ring else shortest)

    @property
    def _as_fast_as_asked(self) -> bool:
        return self._options.ring > 0 and self._options.period_us == 0 and self._mode is TriggerMode.FREE

    def _check_open(self) -> None:
        if not self._open:
            raise DeviceError("the camera is closed", device=self._name)

    def _check_plugged(self) -> None:
        if self._faults.unplug_after is not None and self._delivered >= self._faults.unplug_after:
            self._mode = None
            raise DeviceLost("the camera went away", device=self._name, hint="plug it in again and repeat the scan")
