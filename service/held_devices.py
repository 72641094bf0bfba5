"""The devices of one rig, in the process that owns them: opened, looked after while idle, opened again when back.

    closed --open--> held --gone--> lost --opened again--> held

A device that went away takes its whole rig with it: all are closed, and opened anew as soon as they are all there.
Of a device in use its driver says when it goes (`DeviceLost`), of an idle one only a driver that can look
(`KnowsPresence`). Nothing here runs a scan.
"""

from __future__ import annotations

import gc
import logging
import traceback
from collections.abc import Callable, Mapping
from typing import Any

from scanner.clock import Clock
from scanner.devices import KnowsPresence
from scanner.errors import DeviceError, DeviceLost, ScannerError
from scanner.wire import error_body
from service.pipe import DeviceFault, Opened, Report
from service.scan_setup import OpenRig, open_rig

LOOK_NS = 500_000_000
"""An idle device that goes is noticed within a second: two looks, and what the second one takes"""

AGAIN_NS = (250_000_000, 2_000_000_000)
"""First and longest pause between two tries: what is back is in use within five seconds, its own opening included"""

STEADY_NS = 10_000_000_000
"""Devices that fail sooner after they were opened are not opened at once again and again"""

_log = logging.getLogger(__name__)
Say = Callable[[Report], None]


class HeldDevices:
    """One rig's devices. One thread uses them."""

    def __init__(self, clock: Clock, say: Say) -> None:
        self._clock = clock
        self._say = say
        self._settings: Mapping[str, Any] = {}
        self._opened: OpenRig | None = None
        self._due_ns: int | None = None
        self._pause_ns = AGAIN_NS[0]
        self._since_ns = clock.now_ns()

    @property
    def opened(self) -> OpenRig | None:
        """The rig, if its devices are there."""
        return self._opened

    def open(self, settings: Mapping[str, Any]) -> None:
        """Open a rig for the first time, and say so.

        Raises:
            ScannerError: see `service.scan_setup.open_rig`.
        """
        self._settings = settings
        self._hold()

    def ready(self) -> OpenRig:
        """The rig, for a scan that begins now: looked at, and opened again at once where it was lost.

        Raises:
            ScannerError: a device is still away, or cannot be opened.
        """
        self._look()
        if self._opened is None:
            self._hold()
        if self._opened is None:
            raise AssertionError("held, or an error was raised")
        return self._opened

    def lose(self, error: ScannerError) -> None:
        """Give all up because one went away, and say so."""
        _log.warning("devices lost: %s", error)
        self.close()
        _let_go(error)
        self._say(DeviceFault(error_body(error)))
        if self._clock.now_ns() - self._since_ns > STEADY_NS:
            self._pause_ns = AGAIN_NS[0]
        self._put_off()

    def pause_s(self) -> float | None:
        """Time until `mind` has something to do; None: never."""
        if self._due_ns is None:
            return None
        return max(0.0, (self._due_ns - self._clock.now_ns()) / 1e9)

    def mind(self) -> None:
        """Look whether idle devices are still there, or try to open lost ones, where that is due."""
        if self._due_ns is None or self._clock.now_ns() < self._due_ns:
            return
        if self._opened is not None:
            self._look()
            return
        try:
            self._hold()
        except ScannerError as error:
            _log.debug("not yet: %s", error)
            self._put_off()

    def close(self) -> None:
        """Give the devices back. May be called twice."""
        opened, self._opened = self._opened, None
        self._due_ns = None
        if opened is None:
            return
        try:
            opened.close()
        except DeviceError as error:
            _log.info("while devices were given back: %s", error)

    def _hold(self) -> None:
        self._opened = open_rig(self._settings, self._clock)
        self._since_ns = self._clock.now_ns()
        self._rest()
        self._say(described(self._opened))

    def _put_off(self) -> None:
        self._due_ns = self._clock.now_ns() + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, AGAIN_NS[1])

    def _look(self) -> None:
        try:
            for device in self._watched():
                device.check_present()
        except DeviceLost as error:
            self.lose(error)
        else:
            self._rest()

    def _rest(self) -> None:
        """Look again in a while, where a device can say something."""
        if self._opened is not None:
            self._due_ns = self._clock.now_ns() + LOOK_NS if self._watched() else None

    def _watched(self) -> list[KnowsPresence]:
        if self._opened is None:
            return []
        rig = self._opened.rig
        devices: list[object] = [rig.camera, rig.projector, rig.trigger]
        return [device for device in devices if isinstance(device, KnowsPresence)]


def _let_go(error: ScannerError) -> None:
    """Calls that the error ended may hold a frame, and with it the driver's memory and a node that is gone."""
    traceback.clear_frames(error.__traceback__)
    gc.collect()


def described(opened: OpenRig) -> Opened:
    """What the daemon is told of the opened devices."""
    camera, projector = opened.rig.camera, opened.rig.projector
    seen, shown = camera.capabilities, projector.capabilities
    return Opened(
        camera={"name": camera.name, "width": seen.width, "height": seen.height, "bits": seen.bits},
        projector={"name": projector.name, "width": shown.width, "height": shown.height, "kind": shown.kind.value},
    )
