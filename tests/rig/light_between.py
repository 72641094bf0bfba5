"""The light between a KMS display and a V4L2 camera: what vkms shows comes into vivid's picture a set time later.

A process of its own looks which picture the card scans out, blank by blank, copies that one's memory, and puts it
before the camera `DELAY_NS` after its scan-out began. It asks the kernel alone: what the driver under test says of its
flips is not heard. It needs a guest of one processor that nothing makes late (`setup/rig.sh steady`): from a moment
before each blank until after it, it lets nobody else run, so that no flip can be asked for unseen.

It also tells when vivid takes its pictures, by a clock that the camera sees.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import signal
import struct
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from drivers.ioctl import Node, iow, iowr
from drivers.kms import drm
from drivers.kms.card import find, resources
from drivers.registry import open_projector
from drivers.v4l2.camera import V4l2Camera
from drivers.v4l2.output import V4l2Output
from scanner.clock import MonotonicClock
from scanner.devices import TriggerMode
from tests.rig import vivid

CAMERA_MODE = f"{vivid.WIDTH}x{vivid.HEIGHT}@72.8"
"""Another rate than the display's: the camera then sees every part of a refresh"""

DELAY_NS = 10_000_000
"""From the start of scan-out to the light: a projector's latency. Half of it is spent on reading the picture"""

TICK_NS = 500_000
"""How finely the clock in the picture goes"""

_AHEAD_NS = 150_000
_PRIORITY = 10


class _FrameBuffer(ctypes.Structure):
    """drm_mode_fb_cmd"""

    _fields_ = tuple((name, ctypes.c_uint32) for name in ("fb", "width", "height", "pitch", "bpp", "depth", "handle"))


class _Closed(ctypes.Structure):
    """drm_gem_close"""

    _fields_ = (("handle", ctypes.c_uint32), ("pad", ctypes.c_uint32))


_GET_FRAME_BUFFER = iowr("d", 0xAD, _FrameBuffer)
_CLOSE = iow("d", 0x09, _Closed)


@contextmanager
def light_between(output: str) -> Iterator[None]:
    """What this KMS output shows is what vivid's camera sees, while this lasts."""
    with _process(lambda picture: _bring(output, picture)):
        yield


def measured_delay_us(camera: V4l2Camera, frames: int) -> tuple[float, float]:
    """Stamp minus the time at which vivid took the picture, least and most; stamps as the driver has them, unshifted.

    `camera` has been told that there is no such delay.
    """
    delays = []
    with _process(_show_the_time):
        camera.start(TriggerMode.FREE)
        while len(delays) < 2 * frames:
            frame = camera.pop(2_000_000_000)
            assert frame is not None
            shown = struct.unpack("<q", frame.pixels[0, :8].tobytes())[0]
            if shown:  # black until the clock is there
                # It was taken between this tick and the next.
                delays += [frame.exposure.start_ns - shown - TICK_NS, frame.exposure.start_ns - shown]
        camera.stop()
    return min(delays) / 1000, max(delays) / 1000


@contextmanager
def _process(work: Callable[[NDArray[np.uint8]], None]) -> Iterator[None]:
    """A process that goes before all others, and does `work` on the picture that vivid's camera sees."""
    reader, writer = os.pipe()
    if (child := os.fork()) == 0:
        try:
            projector = open_projector(
                "v4l2", vivid.PROJECTOR, {"mode": CAMERA_MODE, "pixel_format": "GREY"}, MonotonicClock()
            )
            assert isinstance(projector, V4l2Output)
            assert projector._on_show is not None
            picture = projector._require_queue().views[projector._on_show]  # vivid reads it for every frame
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
            os.write(writer, b".")
            work(picture[: vivid.WIDTH * vivid.HEIGHT].reshape(vivid.HEIGHT, vivid.WIDTH))
        except BaseException:
            traceback.print_exc()
            raise
        finally:
            os._exit(1)
    os.close(writer)
    try:
        assert os.read(reader, 1) == b"."
        yield
    finally:
        os.close(reader)
        assert os.waitpid(child, os.WNOHANG) == (0, 0), "the process that brings the light has ended"
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def _bring(output: str, picture: NDArray[np.uint8]) -> None:
    card, _ = find(output)
    card.call(drm.DROP_MASTER, 0)
    crtc, shown = resources(card).crtcs[0], 0
    while True:
        try:
            shown = _follow(card, crtc, picture, shown)
        except OSError:
            shown = 0
            _sleep_until(time.monotonic_ns() + 5_000_000)


def _follow(card: Node, crtc: int, picture: NDArray[np.uint8], shown: int) -> int:
    """Wait for the next blank and bring what is on show from then on, unless it is what was; its number.

    Raises:
        OSError: the display is off.
    """
    blank = _blank(card, crtc)
    due_ns = blank.sequence_ns + _refresh_ns(card, crtc)
    _sleep_until(due_ns - _AHEAD_NS)
    said = drm.Crtc(crtc_id=crtc)
    card.call(drm.GETCRTC, said)
    while (now := _blank(card, crtc)).sequence == blank.sequence:
        if time.monotonic_ns() > due_ns + _AHEAD_NS:
            raise OSError("the blanks have ended")
    if said.fb_id not in {0, shown}:
        seen = _scanned_out(card, said.fb_id)
        if seen.shape == picture.shape:  # not the console's
            _sleep_until(now.sequence_ns + DELAY_NS)
            picture[...] = seen
    return said.fb_id


def _show_the_time(picture: NDArray[np.uint8]) -> None:
    clock = picture[0, :8]
    while True:
        now = time.monotonic_ns()
        clock[...] = np.frombuffer(struct.pack("<q", now), dtype=np.uint8)
        _sleep_until(now + TICK_NS)


def _blank(card: Node, crtc: int) -> drm.CrtcSequence:
    asked = drm.CrtcSequence(crtc_id=crtc)
    card.call(drm.CRTC_GET_SEQUENCE, asked)
    return asked


def _refresh_ns(card: Node, crtc: int) -> int:
    said = drm.Crtc(crtc_id=crtc)
    card.call(drm.GETCRTC, said)
    if not said.mode.clock:
        raise OSError("off")
    return round(1e6 * said.mode.htotal * said.mode.vtotal / said.mode.clock)


def _scanned_out(card: Node, fb: int) -> NDArray[np.uint8]:
    """The green of a picture, from its own memory."""
    told = _FrameBuffer(fb=fb)
    card.call(_GET_FRAME_BUFFER, told)
    where = drm.MapDumb(handle=told.handle)
    card.call(drm.MAP_DUMB, where)
    with mmap.mmap(card.fd, told.pitch * told.height, prot=mmap.PROT_READ, offset=where.offset) as memory:
        lines = np.frombuffer(memory, dtype=np.uint8).reshape(told.height, told.pitch)
        green = lines[:, 1 : 4 * told.width : 4].copy()
        del lines
    card.call(_CLOSE, _Closed(handle=told.handle))
    return green


def _sleep_until(t_ns: int) -> None:
    time.sleep(max(0, t_ns - time.monotonic_ns()) / 1e9)
