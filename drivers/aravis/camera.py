"""A camera behind Aravis: GigE Vision or USB3 Vision, as `scanner.devices.Camera`.

    stopped --start--> acquiring --stop--> stopped --close--> closed
    stopped, acquiring --the camera is gone--> lost --it is back, settings applied--> stopped

Calls into the library are made on a thread of the link's; a dead camera is noticed by the link's watch. While lost,
every call raises DeviceLost at once, and another thread opens the camera anew, with growing pauses.
"""

from __future__ import annotations

import dataclasses
import logging
import threading
from collections.abc import Mapping
from typing import Any

from drivers.aravis import settings as camera_settings
from drivers.aravis import triggers
from drivers.aravis.frame_ids import FrameIds
from drivers.aravis.link import Link
from drivers.aravis.network import Finding, check_network
from drivers.aravis.options import Options
from drivers.aravis.pixels import unpacked
from drivers.aravis.stream import Received, Stream
from scanner.clock import Clock
from scanner.devices import CameraCapabilities, CameraFrame, CameraSettings, Exposure, Source, TriggerMode
from scanner.errors import ConfigError, DeviceBusy, DeviceError, DeviceLost, ScannerError

PAUSE_S, LONGEST_PAUSE_S = 0.25, 2.0
"""Between attempts to open a lost camera: doubled each time"""

LEAST_BOUND_NS = 20_000
"""No stamp of a camera is declared truer than this: its own exposure start jitters, too"""

BOUND_MARGIN = 3
"""Declared is this many times what was measured: the bound must hold while the host is busy"""

CLOCK_EVERY_NS = 500_000_000
STALE_NS = 750_000_000
POP_LOOK_S = 0.05
CLOSED_S = 10.0

_log = logging.getLogger(__name__)


class AravisCamera:
    """See `scanner.devices.Camera`. `details` tells counters and what was switched off."""

    def __init__(self, device: str, options: Options, clock: Clock) -> None:
        """Open it; see `CameraDriver.open`."""
        self._device = device
        self._options = options
        self._clock = clock
        self._name = f"aravis camera {device}".rstrip()
        self._wanted = CameraSettings()
        self._mode: TriggerMode | None = None
        self._open = True
        self._lent: Received | None = None
        self._ids = FrameIds()
        self._next_clock_ns = 0
        self._losses = 0
        self._counted = False
        self._doubted = False
        self._ended_counts: Mapping[str, int] = {}
        self._finder: threading.Thread | None = None
        self._closing = threading.Event()
        self._lock = threading.Lock()
        self._link = self._new_link(device)
        self._running = self._link
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
    def details(self) -> dict[str, Any]:
        """What else there is to know: packet counters, the clock's fit, what was switched off, losses."""
        link = self._link
        stream = link.stream
        clock: dict[str, Any] = {"latched": link.clock.latched}
        if len(link.clock):
            clock |= {"rate": link.clock.rate, "residual_ns": round(link.clock.residual_ns)}
        return {
            "address": link.address,
            "packet_size": self._packet_size,
            "payload_bytes": self._payload,
            "stream": dict(stream.counts() if stream is not None else self._ended_counts),
            "clock": clock,
            "switched_off": list(link.switched_off),
            "losses": self._losses,
        }

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set and read back; see `scanner.devices.Camera.apply`."""
        self._check_open()
        if self._mode is not None:
            raise DeviceBusy("settings change while the camera is stopped", device=self._name, hint="stop it first")
        link = self._present_link()
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
        link = self._present_link()
        link.call(lambda: self._begin(link, mode))
        self._ids, self._doubted, self._running = FrameIds(), False, link
        self._mode = mode

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
            if self._mode is not TriggerMode.SOFTWARE:
                self._keep_clock(link)

    def execute(self, command: str) -> None:
        """Run a command of the camera's own, by its GenICam name.

        Raises:
            DeviceError: it has no such command, or refuses.
        """
        self._check_open()
        link = self._present_link()
        link.call(lambda: link.features.execute(command))

    def check_setup(self, rate_hz: float | None = None) -> list[Finding]:
        """Whether this machine can receive `rate_hz` frames a second (None: as many as the camera gives).

        Empty for cameras on USB. See `network.check_network`.
        """
        link = self._present_link()
        fastest = 1e9 / self._capabilities.min_period_ns(self._present.exposure_ns)
        if not link.is_gige:
            return []
        return check_network(link.address, self._payload, rate_hz or fastest, self._packet_size)

    def temperature_c(self) -> float | None:
        """Of the device (SFNC DeviceTemperature), degrees Celsius; None where it has no such feature."""
        self._check_open()
        link = self._present_link()
        return link.call(lambda: link.features.get_or_none("DeviceTemperature", float))

    def triggers_counted(self) -> int | None:
        """Triggers that the camera has counted since `start`, those included that gave no frame; None: it cannot."""
        self._check_open()
        link = self._present_link()
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
        self.stop()
        self._open = False
        self._closing.set()
        with self._lock:
            finder = self._finder
        if finder is not None:
            finder.join(timeout=CLOSED_S)
        self._link.close()

    # --- on the link's thread --------------------------------------------------------------------------------------

    def _put(self, link: Link, settings: CameraSettings) -> CameraSettings:
        camera, features = link.camera, link.features
        if settings != CameraSettings():
            camera_settings.put(camera, features, settings, self._name)
        return self._look(link).as_settings()

    def _look(self, link: Link) -> camera_settings.Present:
        """Read everything anew, and declare what the camera can now."""
        camera, features, options = link.camera, link.features, self._options
        present = camera_settings.read_present(camera, features, self._name)
        pace = camera_settings.read_pace(camera, features, options, present.exposure_ns)
        self._present = present
        self._payload = int(camera.get_payload())
        self._capabilities = camera_settings.capabilities(
            present, self._limits, pace, self._modes, options, self._stamp(link)
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
        if features.has("AcquisitionFrameRateEnable"):
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

    def _set_rate(self, link: Link) -> None:
        """As asked, or no faster than declared: some cameras begin the next exposure during readout."""
        features, wanted = link.features, self._options.frame_rate_hz
        fastest = 1e9 / self._capabilities.min_period_ns(self._present.exposure_ns)
        shortest = camera_settings.shortest_period_ns(link.camera)
        if wanted is not None and (shortest is None or wanted > fastest):
            raise ConfigError(
                f"{wanted:g} frames a second are too many: at this exposure it gives {fastest:.4g}"
                if shortest is not None
                else "the camera has no frame rate to set",
                device=self._name,
                hint="lower frame_rate_hz, or expose for less",
            )
        if wanted is None and (shortest is None or 1e9 / shortest <= fastest * (1 + 1e-6)):
            if features.has("AcquisitionFrameRateEnable"):
                features.set_if_there("AcquisitionFrameRateEnable", False)
            return
        link.camera.set_frame_rate(wanted or fastest)

    def _finish(self, link: Link) -> None:
        link.features.execute("AcquisitionStop")
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
        self._keep_clock(link)
        trigger = None if received.trigger_count is None else received.trigger_count - 1
        return CameraFrame(
            pixels, self._ids.next(received.frame_id), self._exposure(link, received), received.complete, trigger
        )

    def _exposure(self, link: Link, received: Received) -> Exposure:
        """The camera's stamp in our time. One that cannot be, or is worse than declared, is an estimate."""
        caps = self._capabilities
        length = self._present.exposure_ns + (caps.readout_ns if caps.shutter == "rolling" else 0)
        at, bound = link.clock.host(received.device_ns)
        start = at if self._options.stamp_at == "start" else at - length
        source = caps.stamp
        if bound > caps.stamp_bound_ns or start + length - bound > received.arrival_ns:
            self._doubt(bound, start + length - received.arrival_ns)
            source = Source.ESTIMATED
            bound = max(bound, start + length - received.arrival_ns)
        else:
            bound = max(bound, min(LEAST_BOUND_NS, caps.stamp_bound_ns))
        return Exposure(start, start + length, bound, source)

    def _doubt(self, bound_ns: int, late_ns: int) -> None:
        """Say once a run that stamps are not what was declared."""
        if self._doubted or self._capabilities.stamp is Source.ESTIMATED:
            return
        self._doubted = True
        why = f"is true to {bound_ns / 1e3:.0f} us only"
        if late_ns > bound_ns:
            why = f"says the exposure ended {late_ns / 1e3:.0f} us after its frame had come: try stamp_at"
        _log.warning("%s: a stamp %s; such stamps are passed on as estimates", self._name, why)

    def _keep_clock(self, link: Link) -> None:
        """Compare the clocks now and then; between a software trigger and its frame nothing is in the way of it."""
        now = self._clock.now_ns()
        if now >= self._next_clock_ns:
            self._next_clock_ns = now + CLOCK_EVERY_NS
            link.post(lambda: link.read_clock(2))

    def _stamp(self, link: Link) -> tuple[Source, int]:
        if not link.clock.latched:
            return Source.ESTIMATED, round(1e3 * self._options.arrival_bound_us)
        link.read_clock()
        # A stamp may be a second old when it is mapped, and no reading came meanwhile.
        _, bound = link.clock.host(link.clock.newest_ns + STALE_NS)
        return Source.HARDWARE, max(LEAST_BOUND_NS, BOUND_MARGIN * bound)

    def _give_back(self, stream: Stream) -> None:
        lent, self._lent = self._lent, None
        if lent is not None:
            stream.give_back(lent)

    # --- loss ------------------------------------------------------------------------------------------------------

    def _new_link(self, device: str) -> Link:
        link = Link(device, self._options, self._name, self._lost)
        try:
            link.call(lambda: self._prepare(link))
        except BaseException:
            link.close()
            raise
        return link

    def _present_link(self) -> Link:
        link = self._link
        if link.lost.is_set():
            raise link.loss()
        return link

    def _lost(self, reason: str) -> None:
        """Told by the watch, or by whoever met the silence first. The next link is another thread's work."""
        _log.warning("%s: %s", self._name, reason)
        with self._lock:
            if self._closing.is_set() or self._finder is not None:
                return
            self._losses += 1
            self._finder = threading.Thread(target=self._find_again, name="aravis finder", daemon=True)
            self._finder.start()

    def _find_again(self) -> None:
        lost, pause_s = self._link, PAUSE_S
        lost.close()
        where = lost.address or self._device
        while not self._closing.wait(pause_s):
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
            try:
                link = self._new_link(where)
            except ScannerError as error:
                _log.debug("%s: still lost: %s", self._name, error)
                continue
            with self._lock:
                self._finder = None
                self._link = link
            _log.info("%s: back", self._name)
            return

    def _check_open(self) -> None:
        if not self._open:
            raise DeviceError("the camera is closed", device=self._name)


def _merged(before: CameraSettings, settings: CameraSettings) -> CameraSettings:
    given = {k: v for k, v in dataclasses.asdict(settings).items() if v is not None}
    return dataclasses.replace(before, **given)
