"""A V4L2 camera: memory-mapped streaming with the kernel's stamps and sequence numbers.

    stopped --start--> streaming --stop--> stopped --close--> closed

It runs freely; V4L2 has no software trigger. Buffers that the program holds or has not fetched are the driver's loss:
it counts on and drops, which the gap in `frame_id` shows. A stamp is the kernel's, on CLOCK_MONOTONIC where the flags
say so; whether it is the exposure's is another matter: uvcvideo by default stamps the first packet that reached the
host and calls it the start of exposure. So stamps are `estimated` until the rig file gives the measured delay.
"""

from __future__ import annotations

from drivers.v4l2 import controls, exposure, formats, timings
from drivers.v4l2.exposure import Stamping
from drivers.v4l2.node import VideoNode, open_node
from drivers.v4l2.options import CameraOptions
from drivers.v4l2.queue import SLICE_MS, BufferQueue, Dequeued, FrameCount
from scanner.clock import Clock
from scanner.devices import (
    CameraCapabilities,
    CameraFrame,
    CameraSettings,
    TriggerMode,
)
from scanner.errors import ConfigError, DeviceBusy, DeviceError


class V4l2Camera:
    """See `scanner.devices.Camera`."""

    def __init__(self, path: str, options: CameraOptions, clock: Clock) -> None:
        """Open, switch the automatic functions off, set format, rate and controls, and take the buffers.

        Raises:
            ConfigError: an option that this device does not have or take.
            DeviceError: see `open_node`; DeviceBusy also when somebody else streams.
        """
        self._node, self._found = open_node(path, "camera")
        self._name = f"{self._found.card} ({path})"
        self._node.name = self._name
        self._options = options
        self._clock = clock
        self._queue: BufferQueue | None = None
        self._streaming = False
        self._lent: int | None = None
        self._begun_ns = 0
        self._count, self._damaged = FrameCount(), 0
        try:
            kind = self._found.buffer_type("camera")
            assert kind is not None  # noqa: S101  # open_node made sure
            self._kind = kind
            self._set_up()
        except BaseException:
            self.close()
            raise

    @property
    def name(self) -> str:
        """The device's name in messages."""
        return self._name

    @property
    def node(self) -> VideoNode:
        """What the node says of itself."""
        return self._found

    @property
    def frame_format(self) -> formats.FrameFormat:
        """The format agreed with the driver."""
        return self._format

    @property
    def automatics(self) -> dict[str, int]:
        """Automatic functions that were switched off at opening, and the value that was read back."""
        return dict(self._automatics)

    @property
    def capabilities(self) -> CameraCapabilities:
        """What it can do with the settings last applied."""
        low, high, step = self._exposure_bounds()
        stamping = self._stamping
        return CameraCapabilities(
            width=self._format.width,
            height=self._format.height,
            bits=self._capture.bits,
            shutter=self._options.shutter,
            readout_ns=stamping.readout_ns,
            exposure_min_ns=low,
            exposure_max_ns=high,
            exposure_step_ns=step,
            min_gap_ns=max(0, self._period_ns - self._exposure_ns),
            trigger_modes=frozenset({TriggerMode.FREE}),
            stamp=stamping.source,
            stamp_bound_ns=stamping.bound_ns,
        )

    @property
    def counts(self) -> dict[str, int]:
        """See `scanner.devices.KeepsCounts`; missing: numbers that no frame had."""
        return {"frames": self._count.frames, "missing": self._count.missing, "damaged": self._damaged}

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set and read back; see `scanner.devices.Camera.apply`."""
        self._check_open()
        if self._streaming:
            raise DeviceBusy("settings change while the camera is stopped", device=self._name, hint="stop it first")
        self._check(settings)
        self._require_queue().check_alive()
        if settings.pixel_format is not None:
            self._set_format(settings.pixel_format)
        if settings.exposure_ns is not None:
            self._exposure_ns = self._set_exposure(settings.exposure_ns)
        whole = (0, 0, self._format.width, self._format.height)
        return CameraSettings(self._exposure_ns, 0.0, self._capture.code, whole)

    def check_present(self) -> None:
        """See `scanner.devices.KnowsPresence`."""
        self._check_open()
        self._require_queue().check_alive()

    def start(self, mode: TriggerMode) -> None:
        """Begin to stream; see `scanner.devices.Camera.start`."""
        self._check_open()
        if mode is not TriggerMode.FREE:
            raise ConfigError(f"no trigger mode {mode.value!r} on this camera", device=self._name, hint="free")
        if self._streaming:
            raise DeviceBusy("the camera is streaming already", device=self._name, hint="stop it first")
        queue = self._require_queue()
        for index in range(len(queue)):
            queue.put(index)
        self._begun_ns = self._clock.now_ns()
        self._count, self._damaged = FrameCount(), 0
        queue.on()
        self._streaming = True

    def trigger(self) -> None:
        """Refused: V4L2 knows no software trigger."""
        self._check_open()
        raise DeviceError("this camera has no software trigger", device=self._name, hint="it runs freely")

    def pop(self, timeout_ns: int) -> CameraFrame | None:
        """The next frame; see `scanner.devices.Camera.pop`."""
        self._check_open()
        if not self._streaming:
            raise DeviceError("the camera is not streaming", device=self._name, hint="start it first")
        queue = self._require_queue()
        if self._lent is not None:
            queue.put(self._lent)
            self._lent = None
        deadline = self._clock.now_ns() + max(0, timeout_ns)
        while True:
            left_ms = -(-(deadline - self._clock.now_ns()) // 1_000_000)
            if (taken := queue.take(min(left_ms, SLICE_MS))) is not None:
                self._lent = taken.index
                return self._frame(taken, queue)
            if left_ms <= 0:
                return None

    def stop(self) -> None:
        """End streaming. May be called twice."""
        if self._streaming and self._queue is not None:
            self._queue.off()
        self._streaming = False
        self._lent = None

    def close(self) -> None:
        """Give the device back. May be called twice."""
        self.stop()
        if self._queue is not None:
            self._queue.release()
            self._queue = None
        self._node.close()

    def _set_up(self) -> None:
        options = self._options
        if options.mode is not None:
            if not timings.set_timings(self._node, options.mode):
                raise ConfigError("this camera has no video timings", device=self._name, hint="use size and fps")
        else:
            timings.follow_signal(self._node)
        self._automatics = controls.switch_automatics_off(self._node, frozenset(options.keep))
        self._set_format(options.pixel_format)
        for name, value in options.controls.items():
            controls.write_named(self._node, name, value)
        self._exposure_control = exposure.find(self._node, options.exposure_unit_us)
        self._exposure_ns = self._read_exposure()

    def _set_format(self, wanted: str | None) -> None:
        code = formats.choose(self._node, self._kind, wanted, formats.CAPTURE_FORMATS)
        if self._queue is not None:
            self._queue.release()  # a driver refuses another format while buffers of the old one are held
            self._queue = None
        size, signal = self._options.size, timings.timings(self._node)
        if size is None and signal is not None:
            size = (signal.width, signal.height)  # another program may have left a scaled one
        self._format = formats.agree(self._node, self._kind, code, size)
        self._capture = formats.CAPTURE_FORMATS[code]
        if self._options.fps is not None:
            timings.set_rate(self._node, self._kind, self._options.fps)
        self._period_ns = timings.period_ns(self._node, self._kind)
        self._queue = BufferQueue(self._node, self._kind, self._options.buffers)

    def _check(self, settings: CameraSettings) -> None:
        """Raise ConfigError before anything is set."""
        whole = (0, 0, self._format.width, self._format.height)
        if settings.region is not None and tuple(settings.region) != whole:
            raise ConfigError(
                f"region {list(settings.region)} is not offered",
                device=self._name,
                hint=f"this driver takes the whole frame, {list(whole)}; options.size asks for another",
            )
        if settings.gain_db:
            raise ConfigError(
                f"gain {settings.gain_db:g} dB lies outside 0 .. 0 dB",
                device=self._name,
                hint="V4L2 gains are not in dB: set options.controls.gain, in the camera's own units",
            )
        if settings.pixel_format is not None:
            formats.choose(self._node, self._kind, settings.pixel_format, formats.CAPTURE_FORMATS)
        low, high, _ = self._exposure_bounds()
        if settings.exposure_ns is not None and not low <= settings.exposure_ns <= high:
            raise ConfigError(
                f"exposure {settings.exposure_ns / 1e3:g} us lies outside {low / 1e3:g} .. {high / 1e3:g} us",
                device=self._name,
                hint="the longest exposure is the frame period: a lower fps allows more"
                if self._exposure_control
                else "this camera has no exposure control",
            )

    def _exposure_bounds(self) -> tuple[int, int, int]:
        """Shortest, longest and step, ns."""
        if self._exposure_control is None:
            return self._exposure_ns, self._exposure_ns, 1000
        return self._exposure_control.bounds(self._period_ns)

    def _set_exposure(self, exposure_ns: int) -> int:
        means = self._exposure_control
        if means is None:
            return self._exposure_ns
        return controls.write(self._node, means.control, means.units(exposure_ns)) * means.unit_ns

    def _read_exposure(self) -> int:
        means = self._exposure_control
        if means is None:
            given = self._options.exposure_us
            return self._period_ns if given is None else round(1e3 * given)
        now = controls.read(self._node, means.control) * means.unit_ns
        low, high, _ = means.bounds(self._period_ns)
        return now if low <= now <= high else self._set_exposure(min(max(now, low), high))

    @property
    def _stamping(self) -> Stamping:
        readout_us = self._options.readout_us
        return Stamping(
            exposure_ns=self._exposure_ns,
            readout_ns=self._period_ns if readout_us is None else round(1e3 * readout_us),
            period_ns=self._period_ns,
            rolling=self._options.shutter == "rolling",
            delay_us=self._options.stamp_delay_us,
        )

    def _frame(self, taken: Dequeued, queue: BufferQueue) -> CameraFrame:
        pixels = self._capture.unpack(queue.views[taken.index][: taken.bytes_used], self._format)
        complete = pixels is not None and not taken.damaged
        self._damaged += not complete
        if pixels is None:
            pixels = self._capture.black(self._format)
        exposed = self._stamping.exposure(taken, self._begun_ns, self._clock.now_ns(), self._name)
        return CameraFrame(pixels, self._count.next(taken.sequence), exposed, complete)

    def _require_queue(self) -> BufferQueue:
        if self._queue is None:
            raise DeviceError("the camera has no buffers", device=self._name, hint="open it again")
        return self._queue

    def _check_open(self) -> None:
        if not self._node.open:
            raise DeviceError("the camera is closed", device=self._name)
