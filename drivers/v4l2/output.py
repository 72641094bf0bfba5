"""A V4L2 output as projector: HDMI transmitters and loopbacks that present themselves as video outputs.

The driver shows the oldest queued buffer over and over until a newer one waits; at the next frame it takes the newer
one and gives the old one back, with its stamp and frame count. So a flip to an image is the return of the one before:
two buffers at most are with the driver at any time, the one on show and the one to follow.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import numpy as np

from drivers.display import check_images
from drivers.v4l2 import formats, timings
from drivers.v4l2.node import VideoNode, open_node
from drivers.v4l2.options import OutputOptions
from drivers.v4l2.queue import SLICE_MS, BufferQueue, Dequeued, FrameCount
from scanner.clock import Clock
from scanner.devices import Flip, Image, ProjectorCapabilities, Source
from scanner.errors import ConfigError, DeviceError

BUFFERS = 4
"""On show, next, being written, and one to spare for drivers that keep one"""

FLIP_TIMEOUT_NS = 2_000_000_000


class V4l2Output:
    """See `scanner.devices.Projector`."""

    def __init__(self, path: str, options: OutputOptions, clock: Clock) -> None:
        """Open, set mode and format, and show black.

        Raises:
            ConfigError: a mode or format that this device does not have.
            DeviceError: see `open_node`; the device scales in silence.
        """
        self._node, self._found = open_node(path, "projector")
        self._name = f"{self._found.card} ({path})"
        self._node.name = self._name
        self._options = options
        self._clock = clock
        self._images: list[Image] = []
        self._queue: BufferQueue | None = None
        self._on_show: int | None = None
        self._count = FrameCount()
        try:
            kind = self._found.buffer_type("projector")
            assert kind is not None  # noqa: S101  # open_node made sure
            self._kind = kind
            self._set_up()
            self._begin()
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
    def capabilities(self) -> ProjectorCapabilities:
        """What it can do."""
        return self._options.capabilities(self._format.width, self._format.height, self._period_ns)

    def load(self, images: Sequence[Image]) -> None:
        """Replace the images; see `scanner.devices.Projector.load`."""
        self._require_queue().check_alive()
        shape = (self._format.height, self._format.width)
        check_images(images, shape, self._name)
        self._images = [image.copy() for image in images]

    def check_present(self) -> None:
        """See `scanner.devices.KnowsPresence`."""
        self._require_queue().check_alive()

    def show(self, index: int) -> Flip:
        """Flip at the next frame; see `scanner.devices.Projector.show`."""
        self._require_queue()
        if not 0 <= index < len(self._images):
            raise DeviceError(f"image {index} is not loaded, there are {len(self._images)}", device=self._name)
        return self._flip(self._images[index])

    def close(self) -> None:
        """Leave a black screen, as far as the driver keeps one, and give the device back. May be called twice."""
        if self._queue is not None:
            with contextlib.suppress(DeviceError):  # it went away: what it shows is out of our hands
                if self._on_show is not None:
                    self._flip(np.zeros((self._format.height, self._format.width), dtype=np.uint8))
            self._queue.off()
            self._queue.release()
            self._queue = None
        self._images = []
        self._node.close()

    def _set_up(self) -> None:
        mode, size = self._options.mode, None
        if mode is not None and not timings.set_timings(self._node, mode):
            width, height, hz = timings.parse_mode(mode, self._name)
            size = (width, height)
            if hz is not None:
                timings.set_rate(self._node, self._kind, hz)
        signal = timings.timings(self._node)
        if signal is not None:
            size = (signal.width, signal.height)
        code = formats.choose(self._node, self._kind, self._options.pixel_format, formats.OUTPUT_FORMATS)
        try:
            self._format = formats.agree(self._node, self._kind, code, size)
        except ConfigError as error:
            if signal is None:
                raise
            raise DeviceError(
                f"the device takes images of another size than it sends, {signal}: {error.message}",
                device=self._name,
                hint="it would scale them in silence, and no pattern survives that",
            ) from error
        self._period_ns = timings.period_ns(self._node, self._kind)

    def _begin(self) -> None:
        """Stream black. Two buffers are given, since drivers start and hold with no fewer."""
        self._queue = BufferQueue(self._node, self._kind, BUFFERS)
        black = np.zeros((self._format.height, self._format.width), dtype=np.uint8)
        for index in range(2):
            formats.pack(black, self._queue.views[index], self._format)
            self._queue.put(index, self._format.size)
        self._free = list(range(2, len(self._queue)))
        self._queue.on()
        self._on_show = 0
        self._await_return(0)
        self._on_show = 1

    def _flip(self, image: Image) -> Flip:
        queue = self._require_queue()
        if self._on_show is None or not self._free:
            raise DeviceError("the driver keeps all buffers", device=self._name, hint="close it and open it again")
        index = self._free.pop()
        formats.pack(image, queue.views[index], self._format)
        queue.put(index, self._format.size)
        returned = self._await_return(self._on_show)
        self._on_show = index
        return self._stamped(returned)

    def _await_return(self, index: int) -> Dequeued:
        """Wait until the driver has no more use for buffer `index`: the next one is on show."""
        queue = self._require_queue()
        deadline = self._clock.now_ns() + FLIP_TIMEOUT_NS
        while self._clock.now_ns() < deadline:
            taken = queue.take(SLICE_MS)
            if taken is None:
                continue
            self._free.append(taken.index)
            if taken.index == index:
                return taken
        raise DeviceError(
            f"the device showed nothing new for {FLIP_TIMEOUT_NS // 10**9} s",
            device=self._name,
            hint="is a display connected, and awake?",
        )

    def _stamped(self, returned: Dequeued) -> Flip:
        now = self._clock.now_ns()
        bound = self._options.stamp_bound_us
        believable = returned.monotonic and now - FLIP_TIMEOUT_NS <= returned.t_ns <= now
        if bound is not None and not believable:
            raise DeviceError(
                "the driver's time stamps are not of CLOCK_MONOTONIC",
                device=self._name,
                hint="take stamp_bound_us out of the rig file: without good stamps it means nothing",
            )
        return Flip(
            t_ns=returned.t_ns if believable else now,
            vblank=self._count.next(returned.sequence),
            bound_ns=self._period_ns if bound is None else round(1e3 * bound),
            source=Source.ESTIMATED if bound is None else Source.DRIVER,
        )

    def _require_queue(self) -> BufferQueue:
        if self._queue is None or not self._node.open:
            raise DeviceError("the projector is closed", device=self._name)
        return self._queue
