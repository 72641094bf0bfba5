"""The simulated camera: integrates what shone during its exposures, and delivers as real cameras do.

    stopped --start--> acquiring --stop--> stopped --close--> closed

A frame is rendered when it is asked for and its exposure is over, from the world's timeline; nothing runs in the
background, so virtual and real time give the same frames. When it exposes: `exposures`; frames made beforehand: `ring`.
"""

from __future__ import annotations

import numpy as np

from drivers.simulated.camera_settings import (
    EXPOSURE_MAX_NS,
    EXPOSURE_MIN_NS,
    EXPOSURE_STEP_NS,
    GAIN_MAX_DB,
    Taken,
    checked,
)
from drivers.simulated.exposures import STAMP_BOUND_NS, Exposures, Shot, Window
from drivers.simulated.options import Settings
from drivers.simulated.ring import Ring
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

_LENT = 3
"""Frame buffers: the one lent, the one being filled, and one to spare for a reader that is late"""


class SimulatedCamera:
    """A camera that stands in a simulated world; see `scanner.devices.Camera` and `KnowsTruth`."""

    def __init__(self, world: World, settings: Settings, name: str) -> None:
        world.hold("camera", self, name)
        self._world = world
        self._clock = world.clock
        self._name = name
        self._options = settings.camera
        self._faults = settings.camera_faults
        self._exposures = Exposures(world, settings)
        exposure = NOMINAL_EXPOSURE_NS // EXPOSURE_STEP_NS * EXPOSURE_STEP_NS
        self._taken = Taken(exposure, 0.0, world.settings.optics.bits)
        self._mode: TriggerMode | None = None
        self._open = True
        self._delivered = 0
        self._ring = Ring(self._options.ring, world.timeline, lambda window: self._render(window, self._empty_frame()))
        self._buffers: list[Pixels] = []
        self._prepared: tuple[Window, int, Pixels] | None = None
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
            shutter="rolling" if self._options.rolling_ns else "global",
            readout_ns=self._options.readout_ns,
            exposure_min_ns=EXPOSURE_MIN_NS,
            exposure_max_ns=EXPOSURE_MAX_NS,
            exposure_step_ns=EXPOSURE_STEP_NS,
            min_gap_ns=self._options.gap_ns,
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
            self._ring.clear()
        self._taken = taken
        return CameraSettings(taken.exposure_ns, taken.gain_db, taken.pixel_format, (0, 0, width, height))

    def start(self, mode: TriggerMode) -> None:
        """Begin to acquire; see `scanner.devices.Camera.start`."""
        self._check_open()
        self._check_plugged()
        if self._mode is not None:
            raise DeviceBusy("the camera is acquiring already", device=self._name, hint="stop it first")
        self._mode = mode
        self._ring.fill(self._clock.now_ns(), self._taken.exposure_ns)
        self._exposures.start(mode, self._taken.exposure_ns, self._clock.now_ns())

    def trigger(self) -> None:
        """Start one exposure now, unless the camera is busy; see `scanner.devices.Camera.trigger`."""
        self._check_open()
        self._check_plugged()
        if self._mode is not TriggerMode.SOFTWARE:
            raise DeviceError("a trigger needs the camera started in mode software", device=self._name)
        self._exposures.trigger(self._clock.now_ns())

    def pop(self, timeout_ns: int) -> CameraFrame | None:
        """The next frame; see `scanner.devices.Camera.pop`."""
        self._check_open()
        self._check_plugged()
        if self._mode is None:
            raise DeviceError("the camera is not acquiring", device=self._name, hint="start it first")
        if self._as_fast_as_asked:
            self._delivered += 1
            return self._ring.next(self._clock.now_ns(), self._taken.exposure_ns)
        exposures, deadline = self._exposures, self._clock.now_ns() + max(0, timeout_ns)
        while True:
            exposures.collect(self._clock.now_ns())
            if exposures.waiting:
                return self._deliver(exposures.waiting.popleft())
            coming = exposures.coming(deadline)
            edge = exposures.next_edge() if coming is None else None
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
        self._mode = self._prepared = None
        self._exposures.start(None, 0, 0)

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

    # --- frames --------------------------------------------------------------------------------------------------

    def _prepare(self, shot: Shot) -> None:
        """Render while the exposure runs: in real time the frame is then there when it is due.

        What will shine is known, since one thread at a time calls the devices and this one is here; if a flip comes
        from elsewhere all the same, the frame is rendered again.
        """
        changes = self._world.timeline.changes
        self._prepared = (shot.window, changes, self._pixels(shot.window))

    def _deliver(self, shot: Shot) -> CameraFrame:
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
        length = self._taken.exposure_ns + self._options.rolling_ns
        exposure = Exposure(shot.stamp_ns, shot.stamp_ns + length, STAMP_BOUND_NS, Source.HARDWARE)
        return CameraFrame(pixels, shot.frame_id, exposure, not shot.incomplete, shot.trigger)

    def _pixels(self, window: Window) -> Pixels:
        if (made := self._ring.pixels(window.number)) is not None:
            return made
        if not self._buffers:
            self._buffers = [self._empty_frame() for _ in range(_LENT)]
        self._buffers.append(self._buffers.pop(0))
        return self._render(window, self._buffers[-1])

    def _render(self, window: Window, out: Pixels) -> Pixels:
        readout, taken = self._options.rolling_ns, self._taken
        self._world.render(window.start_ns, window.exposure_ns, readout, taken.gain_db, taken.bits, window.number, out)
        return out

    def _empty_frame(self) -> Pixels:
        width, height = self._world.rig.calibration.camera.size
        if self._taken.bits <= 8:
            return np.empty((height, width), dtype=np.uint8)
        return np.empty((height, width), dtype=np.uint16)

    # --- states --------------------------------------------------------------------------------------------------

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
