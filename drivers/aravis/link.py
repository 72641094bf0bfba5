"""One connection to one camera: the opened device, the thread that talks to it, and the watch over it.

    open --lost, or close--> ended

A link is never mended: after a loss a new one is opened. Its features are used on its worker thread alone.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

from drivers.aravis.clock_fit import ClockFit
from drivers.aravis.features import Features
from drivers.aravis.find import open_camera
from drivers.aravis.library import aravis, is_library_error, translated
from drivers.aravis.options import AravisOptions
from drivers.aravis.sockets import ControlSocket, udp_inodes
from drivers.aravis.stream import Received, Stream
from drivers.aravis.watch import CallProbe, GvcpProbe, Watch
from drivers.aravis.worker import Worker
from scanner.errors import DeviceError, DeviceLost

_T = TypeVar("_T")

LATCH, LATCHED_HIGH, LATCHED_LOW = 0x0944, 0x0948, 0x094C
"""GigE Vision 1.2, 28.44 to 28.46"""

LATCHES = 8
"""Readings of the clock at once: the one with the shortest way is kept"""

HEARTBEAT_MS = 3000
"""A camera that lost us is free for the next one after this; some wait for a minute by default"""

CLOSE_S = 6.0

_opening = threading.Lock()
"""One camera is opened at a time: its socket is the one that was not there before"""


class Link:
    """An opened camera."""

    def __init__(self, device: str, options: AravisOptions, name: str, on_lost: Callable[[str], None]) -> None:
        """Open it, and switch off everything automatic.

        Raises:
            DeviceError: see `find.open_camera`; or a feature does not take what it is given.
        """
        self.name = name
        self.lost = threading.Event()
        self.reason = ""
        self.stream: Stream | None = None
        self._options = options
        self._on_lost = on_lost
        self._closed = False
        self._watch: Watch | None = None
        self._worker = Worker(name)
        self._camera: Any = None
        self._tick_hz = 0
        self._control: ControlSocket | None = None
        self.clock = ClockFit(latched=True)
        try:
            self._worker.call(lambda: self._open(device))
        except BaseException:
            self._worker.post(self._let_go)
            self._worker.end(0.0)
            raise
        self._watch = Watch(self._probe(), options.loss_ms / 1e3, self._tell_lost)

    @property
    def camera(self) -> Any:
        """The Aravis.Camera."""
        return self._camera

    def call(self, work: Callable[[], _T]) -> _T:
        """Run on the link's thread.

        Raises:
            DeviceLost: the camera went away before it was done.
        """
        if self.lost.is_set():
            raise self.loss()
        try:
            return self._worker.call(work, self.lost)
        except DeviceLost as error:
            self._tell_lost(error.message)
            raise self.loss() from error
        except Exception as error:
            if is_library_error(error):
                raise translated(error, self.name, "talking to the camera") from error
            raise

    def post(self, work: Callable[[], object]) -> None:
        """Run on the link's thread when its turn comes; nobody waits."""
        self._worker.post(work)

    def loss(self) -> DeviceLost:
        """The error to raise once it is lost."""
        return DeviceLost(
            self.reason or "the camera went away",
            device=self.name,
            hint="check cable and power; it is looked for, and its settings are applied again when it is back",
        )

    def heard(self, received: Received) -> None:
        """A frame came: a sign of life, and without a latch the clock's only witness."""
        if self._watch is not None:
            self._watch.heard()
        if not self.clock.latched and received.complete:
            self.clock.add(received.device_ns, received.arrival_ns, received.arrival_ns)

    def read_clock(self, times: int = LATCHES) -> None:
        """Compare the clocks. On the link's thread."""
        if not self.clock.latched:
            return
        for _ in range(times):
            before = time.monotonic_ns()
            self._latch()
            after = time.monotonic_ns()
            self.clock.add(self._latched_ns(), before, after)

    def close(self) -> None:
        """Give the camera back; a dead one is let go of in the background."""
        if self._closed:
            return
        self._closed = True
        if self._watch is not None:
            self._watch.close()
        if self.stream is not None:
            self.stream.end()
        self._worker.post(self._let_go)
        self._worker.end(CLOSE_S)

    # --- on the link's thread --------------------------------------------------------------------------------------

    def _open(self, device: str) -> None:
        with _opening:
            before = udp_inodes()
            camera, identity = open_camera(device)
            if camera.is_gv_device():
                interface = camera.get_device().get_interface_address().get_address().to_string()
                self._control = ControlSocket(before, interface)
        self.features = Features(camera.get_device(), self.name)
        self._camera = camera
        self.is_gige = bool(camera.is_gv_device())
        self.address = identity
        if self.is_gige:
            self.address = camera.get_device().get_device_address().get_address().to_string()
        self.features.execute_if_there("AcquisitionStop")
        self.switched_off = self.features.switch_off_automatics()
        if self.is_gige:
            self._set_packets()
            self.features.set_at_most("GevHeartbeatTimeout", HEARTBEAT_MS)
        self._choose_clock()

    def _set_packets(self) -> None:
        camera, options = self._camera, self._options
        camera.gv_set_packet_size_adjustment(aravis().GvPacketSizeAdjustment.NEVER)
        if options.packet_size is None:
            camera.gv_auto_packet_size()
        else:
            camera.gv_set_packet_size(options.packet_size)
            taken = int(camera.gv_get_packet_size())
            if taken != options.packet_size:
                raise DeviceError(
                    f"packet_size was set to {options.packet_size} and reads back as {taken}",
                    device=self.name,
                    hint="leave packet_size out, or give one the camera has",
                )
        if options.packet_delay_us or self.features.has("GevSCPD"):
            camera.gv_set_packet_delay(round(1e3 * options.packet_delay_us))

    def _choose_clock(self) -> None:
        wanted = self._options.clock
        slack = round(1e3 * self._options.arrival_bound_us)
        if wanted == "arrival":
            self.clock = ClockFit(latched=False, slack_ns=slack)
            return
        if self.is_gige:
            self._tick_hz = int(self._camera.get_device().get_timestamp_tick_frequency())
        try:
            self.read_clock()
        except Exception as error:
            if wanted == "latch" or not (is_library_error(error) or isinstance(error, DeviceError)):
                raise
            self.clock = ClockFit(latched=False, slack_ns=slack)

    def _latch(self) -> None:
        if self._tick_hz:
            self._camera.get_device().write_register(LATCH, 2)
        else:
            self.features.execute("TimestampLatch")

    def _latched_ns(self) -> int:
        if not self._tick_hz:
            return self.features.get("TimestampLatchValue", int)
        device = self._camera.get_device()
        high, low = device.read_register(LATCHED_HIGH), device.read_register(LATCHED_LOW)
        ticks: int = (high & 0xFFFFFFFF) << 32 | (low & 0xFFFFFFFF)
        return ticks * 1_000_000_000 // self._tick_hz

    def _let_go(self) -> None:
        """In this order: the library crashes where a stream outlives its camera."""
        stream, self.stream = self.stream, None
        if stream is not None:
            stream.close()
        del stream
        try:
            if self._camera is not None and not self.lost.is_set():
                self.features.execute_if_there("AcquisitionStop")
        finally:  # a camera that refuses is given back all the same
            if self._camera is not None:
                self.features.forget()
            self._camera = None
            if self._control is not None:
                self._control.close()

    def _probe(self) -> GvcpProbe | CallProbe:
        if self.is_gige:
            return GvcpProbe(self.address)
        return CallProbe(
            lambda: self._camera.get_device().read_register(0),
            lambda error: is_library_error(error) or isinstance(error, AttributeError),
        )

    def _tell_lost(self, reason: str) -> None:
        if self.lost.is_set():
            return
        self.reason = reason
        self.lost.set()
        if self._control is not None:
            self._control.cut(self.address)
        stream = self.stream
        if stream is not None:
            stream.end()
        self._on_lost(reason)
