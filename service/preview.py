"""What the camera sees, small and a few times a second, on a socket of its own: for focusing and aiming.

Runs in the devices process, between scans; pixels do not pass through the daemon. A subscriber that is late gets the
newest picture (ZMQ_CONFLATE) and counts what it missed by the numbers.
"""

from __future__ import annotations

import itertools
import os
from contextlib import suppress
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from scanner.clock import Clock
from scanner.devices import CameraCapabilities, CameraSettings, Image, TriggerMode
from scanner.sequencer import Rig
from scanner.wire_images import PreviewHeader, encode_image
from service.descriptors import Admission
from service.pipe import Preview
from service.sockets import MAX_SUBSCRIPTION_BYTES, remove_sockets

POP_NS = 500_000_000
BRIGHT, DARK, GOOD = 0.97, 0.3, 0.7
"""Of full scale, the 99th percentile of a picture: from where it is clipped, to where it is dark, and what is aimed at.
What lies between is left alone, so that the picture does not pump."""
FASTER, SLOWER = 0.4, 4.0
"""Factors on the exposure from one picture to the next: what is clipped does not say by how much."""
LIT_NS = 300_000_000
"""After the projector was told to show white (slow ones take 0.1 s): pictures from before say nothing of its light."""
UNWATCHED_NS = 10_000_000_000
"""Without a subscriber for so long the projector goes black and the camera rests, until there is one again: who asked
for the preview may have been killed, and lamps do not last for ever."""
MOST_TRIES = 6
"""Pictures that may pass until the exposure suits the scene, or cannot: three at 4 times more cover a factor of 64"""

SAID_MOST = 1000
"""Subscriptions heard before a picture: somebody may make them without end"""

LONGEST_NS = 200_000_000
"""Exposure that a preview goes to by itself: five pictures a second, also of a dark view."""


class Previewer:
    """A running preview; the projector shows white meanwhile, so that there is something to see."""

    def __init__(self, rig: Rig, clock: Clock, wanted: Preview, exposure_us: float | str | None = None) -> None:
        """exposure_us: of the rig file; where it gives none, or "auto", pictures find their own."""
        self._adapts = not isinstance(exposure_us, int | float)
        self._exposure_ns = round(1000 * exposure_us) if isinstance(exposure_us, int | float) else None
        self._rig = rig
        self._clock = clock
        self._wanted = wanted
        self._period_ns = round(1e9 / wanted.rate_hz)
        self._max_width = wanted.max_width
        self._numbers = itertools.count(1)
        self._next_ns = clock.now_ns()
        self._running = False
        self._lit = False
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.XPUB)
        self._topics: set[bytes] = set()
        self._watched_ns = clock.now_ns()
        self.resting = False
        """nobody watches"""
        self._tried = 0
        """pictures of the light, of which none is shown before the exposure suits it or MOST_TRIES are over"""
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDHWM, 2)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_SUBSCRIPTION_BYTES)
        before = os.umask(0o117)
        try:
            self._socket.bind(wanted.endpoint)
        finally:
            os.umask(before)
        self._admission = Admission({wanted.endpoint: self._socket})

    def is_of(self, wanted: Preview, rig: Rig) -> bool:
        """Whether this is the preview that is wanted; of devices that were opened anew it is none."""
        return self._wanted == wanted and self._rig is rig

    def pause_s(self) -> float:
        """Time until the next picture is due."""
        return max(0.0, (self._next_ns - self._clock.now_ns()) / 1e9)

    def show(self) -> None:
        """Take a picture and publish it, unless nobody watches.

        Raises:
            DeviceError: camera or projector failed.
        """
        self._next_ns = max(self._next_ns + self._period_ns, self._clock.now_ns())
        if not self._is_watched():
            return
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
        if frame.exposure.start_ns <= self._lit_ns:
            return  # of light that is on its way: as good as any in brightness, and no measure of sharpness
        better = None
        if self._adapts:
            taken_ns = frame.exposure.end_ns - frame.exposure.start_ns
            better = better_exposure(small, taken_ns, camera.capabilities)
        self._tried += 1
        if better is None or self._tried > MOST_TRIES:
            self._tried = MOST_TRIES
            self._publish(small, frame.exposure.start_ns, stride)
        if better is not None:
            self._exposure_ns = better
            camera.stop()  # the pixels were the camera's until here
            self._start()

    def _publish(self, small: NDArray[Any], t_ns: int, stride: int) -> None:
        header = PreviewHeader(
            number=next(self._numbers),
            width=small.shape[1],
            height=small.shape[0],
            dtype="uint8" if small.dtype == np.uint8 else "uint16",
            t_ns=t_ns,
            stride=stride,
        )
        with suppress(zmq.Again):
            self._socket.send(encode_image(header, small.data.cast("B")), zmq.DONTWAIT)

    def _is_watched(self) -> bool:
        """Whether somebody has subscribed, or had of late; when they are gone the light is put out."""
        with suppress(zmq.Again):
            for _ in range(SAID_MOST):  # XPUB: 1 or 0, and what was subscribed to first or is not any more by the last
                said = self._socket.recv(zmq.DONTWAIT)
                (self._topics.add if said[:1] == b"\x01" else self._topics.discard)(said[1:])
        now = self._clock.now_ns()
        if self._topics:
            self._watched_ns = now
        watched = now - self._watched_ns <= UNWATCHED_NS
        if self._running and not watched:
            self._rig.camera.stop()
            self._running = False
            self._light(0)
        self.resting = not watched
        return watched

    def _light(self, grey: int) -> None:
        size = self._rig.projector.capabilities
        image: Image = np.full((size.height, size.width), grey, np.uint8)
        self._lit = True
        self._rig.projector.load([image])
        self._rig.projector.show(0)

    def rest(self) -> bool:
        """Stop the camera for a scan; the next `show` starts it again. Whether the projector was given an image."""
        ran, self._running = self._running, False
        if ran:
            self._rig.camera.stop()
        lit, self._lit = self._lit, False
        return lit

    def close(self) -> None:
        """End the preview."""
        self.rest()
        self._admission.close()
        self._context.destroy(linger=0)
        remove_sockets([self._wanted.endpoint])

    def _begin(self) -> None:
        if self._running:
            return
        camera = self._rig.camera
        self._light(255)
        modes = camera.capabilities.trigger_modes
        self._mode = TriggerMode.SOFTWARE if TriggerMode.SOFTWARE in modes else TriggerMode.FREE
        self._lit_ns = self._clock.now_ns() + LIT_NS
        self._tried = 0
        self._start()
        self._running = True

    def _start(self) -> None:
        camera = self._rig.camera
        if self._exposure_ns is not None:
            camera.apply(CameraSettings(exposure_ns=self._exposure_ns))
        camera.start(self._mode)


def better_exposure(pixels: NDArray[Any], taken_ns: int, capabilities: CameraCapabilities) -> int | None:
    """The exposure for the next picture, ns; None where this one's will do, or none is better.

    Args:
        pixels: (H, W) grey levels.
        taken_ns: how long they were exposed.
        capabilities: of the camera.
    """
    level = float(np.percentile(pixels, 99)) / capabilities.max_value
    if DARK <= level <= BRIGHT:
        return None
    factor = FASTER if level > BRIGHT else min(GOOD / max(level, 1e-3), SLOWER)
    longest = max(capabilities.exposure_min_ns, min(LONGEST_NS, capabilities.exposure_max_ns))
    better = round(min(max(taken_ns * factor, capabilities.exposure_min_ns), longest))
    return better if abs(better - taken_ns) > 0.05 * taken_ns else None
