"""A camera behind Aravis: GigE Vision or USB3 Vision, as `scanner.devices.Camera`.

    stopped --start--> acquiring --stop--> stopped --close--> closed
    stopped, acquiring --the camera is gone--> lost --it is back, settings applied--> stopped

Calls into the library are made on a thread of the link's; a dead camera is noticed by the link's watch. While lost,
every call raises DeviceLost at once, and another thread opens the camera anew, with growing pauses.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Mapping
from typing import Any

from drivers.aravis import settings as camera_settings
from drivers.aravis import stamps, triggers
from drivers.aravis.frame_ids import FrameIds
from drivers.aravis.link import Link
from drivers.aravis.network import Finding, check_network
from drivers.aravis.options import AravisOptions
from drivers.aravis.pixels import unpacked
from drivers.aravis.reopening import Reopening
from drivers.aravis.stream import Received, Stream
from scanner.clock import Clock
from scanner.devices import CameraCapabilities, CameraFrame, CameraSettings, TriggerMode
from scanner.errors import ConfigError, DeviceBusy, DeviceError, DeviceLost

POP_LOOK_S = 0.05
"""A wait for a frame is interrupted this often to see whether the camera is lost"""

_log = logging.getLogger(__name__)


class AravisCamera:
    """See `scanner.devices.Camera`. `details` tells counters and what was switched off."""

    def __init__(self, device: str, options: AravisOptions, clock: Clock) -> None:
        """Open it; see `CameraDriver.open`."""
        self._options = options
        self._clock = clock
        self._name = f"aravis camera {device}".rstrip()
        self._wanted = CameraSettings()
        self._mode: TriggerMode | None = None
        self._open = True
        self._lent: Received | None = None
        self._ids = FrameIds()
        self._counted = False
        self._ended_counts: Mapping[str, int] = {}
        self._links = Reopening(device, self._ready_link, self._name)
        self._running = self._links.newest
        """the one that the present run, or the last one, began on: a run does not survive a loss"""

    @property
    def name(self) -> str:
        """The device's name in messages."""
        return self._name

    @property
    def capabilities(self) -> CameraCapabilities:
        """What it can do with the settings last applied."""
        return self._capabilities

    @property
    def counts(self) -> Mapping[str, int]:
        """See `scanner.devices.KeepsCounts`; those of the library."""
        stream = self._links.newest.stream
        return dict(stream.counts() if stream is not None else self._ended_counts)

    @property
    def details(self) -> dict[str, Any]:
        """What else there is to know: packet counters, the clock's fit, what was switched off, losses."""
        link = self._links.newest
        clock: dict[str, Any] = {"latched": link.clock.latched}
        if len(link.clock):
            clock |= {"rate": link.clock.rate, "residual_ns": round(link.clock.residual_ns)}
        return {
            "address": link.address,
            "packet_size": self._packet_size,
            "payload_bytes": self._payload,
            "stream": dict(self.counts),
            "clock": clock,
            "switched_off": list(link.switched_off),
            "losses": self._links.losses,
        }

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set and read back; see `scanner.devices.Camera.apply`."""
        self._check_open()
        if self._mode is not None:
            raise DeviceBusy("settings change while the camera is stopped", device=self._name, hint="stop it first")
        link = self._links.present()
        camera_settings.check(settings, self._limits, self._name)
        taken = link.call(lambda: self._put(link, settings))
        self._wanted = _merged(self._wanted, settings)
        return taken

    def start(self, mode: TriggerMode) -> None:
        """Begin to acquire; see `scanner.devices.Camera.start`."""
        self._check_open()
        if self._mode is not None:
            raise DeviceBusy("the camera is acquiring already", device=self._name, hint="stop it first")
        if mode not in self._capabilities.trigger_modes:
            has = ", ".join(sorted(mode.value for mode in self._capabilities.trigger_modes))
            raise ConfigError(f"no trigger mode {mode.value!r} on this camera", device=self._name, hint=f"it has {has}")
        link = self._links.present()
        link.call(lambda: self._begin(link, mode))
        self._stamps = stamps.Stamps(
            self._capabilities, self._present.exposure_ns, self._options, self._name, self._clock.now_ns()
        )
        self._ids, self._running, self._mode = FrameIds(), link, mode

    def trigger(self) -> None:
        """Start one exposure now; see `scanner.devices.Camera.trigger`."""
        self._check_open()
        if self._mode is not TriggerMode.SOFTWARE:
            raise DeviceError("a trigger needs the camera started in mode software", device=self._name)
        link = self._running
        link.call(lambda: link.features.execute("TriggerSoftware"))

    def pop(self, timeout_ns: int) -> CameraFrame | None:
        """The next frame; see `scanner.devices.Camera.pop`."""
        self._check_open()
        if self._mode is None:
            raise DeviceError("the camera is not acquiring", device=self._name, hint="start it first")
        link, stream = self._running, self._running.stream
        if link.lost.is_set() or stream is None:
            raise link.loss()
        self._give_back(stream)
        until = self._clock.now_ns() + max(0, timeout_ns)
        while True:
            left_s = (until - self._clock.now_ns()) / 1e9
            received = stream.pop(min(max(0.0, left_s), POP_LOOK_S))
            if received is not None:
                self._lent = received
                return self._frame(link, received)
            if link.lost.is_set():
                raise link.loss()
            if left_s <= 0:
                return None
            if self._mode is not TriggerMode.SOFTWARE:  # between a trigger and its frame nothing is in the way of it
                self._stamps.keep_clock(link, self._clock.now_ns())

    def execute(self, command: str) -> None:
        """Run a command of the camera's own, by its GenICam name.

        Raises:
            DeviceError: it has no such command, or refuses.
        """
        self._check_open()
        link = self._links.present()
        link.call(lambda: link.features.execute(command))

    def check_setup(self, rate_hz: float | None = None) -> list[Finding]:
        """Whether this machine can receive `rate_hz` frames a second (None: as many as the camera gives).

        Empty for cameras on USB. See `network.check_network`.
        """
        link = self._links.present()
        if not link.is_gige:
            return []
        return check_network(link.address, self._payload, rate_hz or self._fastest_hz, self._packet_size)

    def temperature_c(self) -> float | None:
        """Of the device (SFNC DeviceTemperature), degrees Celsius; None where it has no such feature."""
        self._check_open()
        link = self._links.present()
        return link.call(lambda: link.features.get_or_none("DeviceTemperature", float))

    def triggers_counted(self) -> int | None:
        """Triggers that the camera has counted since `start`, those included that gave no frame; None: it cannot."""
        self._check_open()
        link = self._links.present()
        return link.call(lambda: triggers.read_count(link.features)) if self._counted else None

    def stop(self) -> None:
        """End acquisition; may be called twice."""
        if self._mode is None:
            return
        self._mode = None
        self._lent = None
        link = self._running
        if link.lost.is_set():
            return
        try:
            link.call(lambda: self._finish(link))
        except DeviceLost:  # told to whoever needs the camera next
            _log.info("%s: lost while it was stopped", self._name)

    def close(self) -> None:
        """Give the device back; may be called twice."""
        if not self._open:
            return
        self._open = False
        try:
            self.stop()
        finally:
            self._links.close()

    # --- on the link's thread --------------------------------------------------------------------------------------

    def _ready_link(self, device: str, on_lost: Callable[[str], None]) -> Link:
        """An opened camera with the options and the settings wanted."""
        link = Link(device, self._options, self._name, on_lost)
        try:
            link.call(lambda: self._prepare(link))
        except BaseException:
            link.close()
            raise
        return link

    def _put(self, link: Link, settings: CameraSettings) -> CameraSettings:
        """Set what is given. What the camera did take of settings that it refuses in part is known all the same."""
        try:
            if settings != CameraSettings():
                camera_settings.put(link.camera, link.features, settings, self._name)
        finally:
            present = self._look(link)
        return present.as_settings()

    def _look(self, link: Link) -> camera_settings.Present:
        """Read everything anew, and declare what the camera can now."""
        camera, features, options = link.camera, link.features, self._options
        present = camera_settings.read_present(camera, features, self._name)
        pace = camera_settings.read_pace(camera, features, options, present.exposure_ns)
        self._present = present
        self._payload = int(camera.get_payload())
        self._capabilities = camera_settings.capabilities(
            present, self._limits, pace, self._modes, options, stamps.declared(link, options)
        )
        return present

    def _prepare(self, link: Link) -> None:
        """A camera that was just opened: what never changes, the options, and the settings wanted."""
        camera, features, options = link.camera, link.features, self._options
        features.set_further(options.features)
        if options.binning != 1:
            self._bin(link)
        self._limits = camera_settings.read_limits(camera, features)
        camera_settings.choose_format(camera, self._limits, self._name)
        self._modes = triggers.offered_modes(features)
        triggers.set_mode(features, TriggerMode.FREE, options, self._name)
        features.set_if_there("AcquisitionFrameRateEnable", False)
        self._packet_size = int(camera.gv_get_packet_size()) if link.is_gige else 0
        camera_settings.check(self._wanted, self._limits, self._name)
        self._put(link, self._wanted)

    def _bin(self, link: Link) -> None:
        wanted = self._options.binning
        for feature in ("BinningHorizontal", "BinningVertical"):
            if not link.features.has(feature):
                raise ConfigError("the camera cannot bin pixels", device=self._name, hint="leave binning out")
            low, high, _ = link.features.integer_bounds(feature)
            if not low <= wanted <= high:
                raise ConfigError(f"a binning of {wanted} lies outside {low} .. {high}", device=self._name)
            link.features.set(feature, wanted)

    def _begin(self, link: Link, mode: TriggerMode) -> None:
        features = link.features
        source = triggers.set_mode(features, mode, self._options, self._name)
        counted = self._counted = triggers.count_triggers(features, source, self._options)
        if mode is TriggerMode.FREE:
            self._set_rate(link)
        link.read_clock()
        self._payload = int(link.camera.get_payload())
        link.stream = Stream(link.camera, self._options, counted=counted, heard=link.heard)
        try:
            features.execute("AcquisitionStart")
        except BaseException:
            self._drop_stream(link)
            raise

    @property
    def _fastest_hz(self) -> float:
        """Frames a second, as declared."""
        return 1e9 / self._capabilities.min_period_ns(self._present.exposure_ns)

    def _set_rate(self, link: Link) -> None:
        """As asked, or no faster than declared: some cameras begin the next exposure during readout."""
        wanted, fastest = self._options.frame_rate_hz, self._fastest_hz
        shortest = camera_settings.shortest_period_ns(link.camera)
        if shortest is None and wanted is not None:
            raise ConfigError("the camera has no frame rate to set", device=self._name, hint="leave frame_rate_hz out")
        if wanted is not None and wanted > fastest:
            raise ConfigError(
                f"{wanted:g} frames a second are too many: at this exposure it gives {fastest:.4g}",
                device=self._name,
                hint="lower frame_rate_hz, or expose for less",
            )
        if wanted is None and (shortest is None or 1e9 / shortest <= fastest * (1 + 1e-6)):
            link.features.set_if_there("AcquisitionFrameRateEnable", False)
            return
        link.camera.set_frame_rate(wanted or fastest)

    def _finish(self, link: Link) -> None:
        try:
            link.features.execute("AcquisitionStop")
        finally:
            self._drop_stream(link)

    def _drop_stream(self, link: Link) -> None:
        stream, link.stream = link.stream, None
        if stream is not None:
            self._ended_counts = stream.counts()
            stream.close()

    # --- frames ----------------------------------------------------------------------------------------------------

    def _frame(self, link: Link, received: Received) -> CameraFrame:
        present = self._present
        _, _, width, height = present.region
        pixels = unpacked(received.content, (height, width), present.pixel_format)
        self._stamps.keep_clock(link, self._clock.now_ns())
        exposure = self._stamps.exposure(link, received)
        trigger = None if received.trigger_count is None else received.trigger_count - 1
        return CameraFrame(pixels, self._ids.next(received.frame_id), exposure, received.complete, trigger)

    def _give_back(self, stream: Stream) -> None:
        lent, self._lent = self._lent, None
        if lent is not None:
            stream.give_back(lent)

    def _check_open(self) -> None:
        if not self._open:
            raise DeviceError("the camera is closed", device=self._name)


def _merged(before: CameraSettings, settings: CameraSettings) -> CameraSettings:
    given = {k: v for k, v in dataclasses.asdict(settings).items() if v is not None}
    return dataclasses.replace(before, **given)
