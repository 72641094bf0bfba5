"""What the camera sees, small and a few times a second, on a socket of its own: for focusing and aiming.

Runs in the devices process, between scans; pixels do not pass through the daemon. A subscriber that is late gets the
newest picture (ZMQ_CONFLATE) and counts what it missed by the numbers.
"""

from __future__ import annotations

import itertools
import os
from contextlib import suppress

import numpy as np
import zmq

from scanner.clock import Clock
from scanner.devices import Image, TriggerMode
from scanner.sequencer import Rig
from scanner.wire import MAX_MESSAGE_BYTES
from scanner.wire_images import PreviewHeader, encode_image
from service.pipe import Preview
from service.sockets import remove_sockets

POP_NS = 500_000_000


class Previewer:
    """A running preview; the projector shows white meanwhile, so that there is something to see."""

    def __init__(self, rig: Rig, clock: Clock, wanted: Preview) -> None:
        self._rig = rig
        self._clock = clock
        self._period_ns = round(1e9 / wanted.rate_hz)
        self._max_width = wanted.max_width
        self._numbers = itertools.count(1)
        self._next_ns = clock.now_ns()
        self._running = False
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.PUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDHWM, 2)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        before = os.umask(0o117)
        try:
            self._socket.bind(wanted.endpoint)
        finally:
            os.umask(before)
        self._endpoint = wanted.endpoint

    def pause_s(self) -> float:
        """Time until the next picture is due."""
        return max(0.0, (self._next_ns - self._clock.now_ns()) / 1e9)

    def show(self) -> None:
        """Take a picture and publish it.

        Raises:
            DeviceError: camera or projector failed.
        """
        self._next_ns = max(self._next_ns + self._period_ns, self._clock.now_ns())
        camera = self._rig.camera
        self._begin()
        if self._mode is TriggerMode.SOFTWARE:
            camera.trigger()
        frame = camera.pop(POP_NS)
        if frame is None:
            return
        pixels = frame.pixels
        stride = -(-pixels.shape[1] // self._max_width)
        small = np.ascontiguousarray(pixels[::stride, ::stride])
        header = PreviewHeader(
            number=next(self._numbers),
            width=small.shape[1],
            height=small.shape[0],
            dtype="uint8" if small.dtype == np.uint8 else "uint16",
            t_ns=frame.exposure.start_ns,
            stride=stride,
        )
        with suppress(zmq.Again):
            self._socket.send(encode_image(header, small.data.cast("B")), zmq.DONTWAIT)

    def rest(self) -> bool:
        """Stop the camera for a scan; the next `show` starts it again. Whether it ran."""
        ran, self._running = self._running, False
        if ran:
            self._rig.camera.stop()
        return ran

    def close(self) -> None:
        """End the preview."""
        self.rest()
        self._context.destroy(linger=0)
        remove_sockets([self._endpoint])

    def _begin(self) -> None:
        if self._running:
            return
        projector, camera = self._rig.projector, self._rig.camera
        size = projector.capabilities
        white: Image = np.full((size.height, size.width), 255, np.uint8)
        projector.load([white])
        projector.show(0)
        modes = camera.capabilities.trigger_modes
        self._mode = TriggerMode.SOFTWARE if TriggerMode.SOFTWARE in modes else TriggerMode.FREE
        camera.start(self._mode)
        self._running = True
