"""A full-screen window as projector, for a desktop that cannot be done without.

A compositor stands between: it shows an image when it likes, usually within two refreshes, and does not say when.
Flips are therefore paced by this driver at the display's nominal rate, and their times are `estimated`. A rig that is
to prove its pairing uses the driver `kms`.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from drivers.display import DisplayOptions, check_images, read_mode
from drivers.option_table import option_problems, read_options
from drivers.window import sdl
from scanner.clock import Clock
from scanner.devices import DeviceInfo, Flip, Image, ProjectorCapabilities, Source
from scanner.errors import ConfigError, DeviceError, DeviceLost, DeviceNotFound

DRIVER = "window"
USUAL_HZ = 60
"""Assumed where the desktop does not tell"""
COMPOSITOR_REFRESHES = 2
"""Between the call and scan-out there may lie one refresh for the compositor's drawing and one for its flip"""


class WindowOptions(DisplayOptions):
    """`projector.options` of a window; `mode` is checked against the desktop's, which this driver does not change."""

    windowed: tuple[int, int] | None = None
    """width and height of a window that leaves the rest of the desktop free, for trials"""


class WindowProjector:
    """See `scanner.devices.Projector`."""

    def __init__(self, device: str, options: WindowOptions, clock: Clock) -> None:
        """Open on the display that `device` names.

        Raises:
            DeviceNotFound: no SDL, no desktop, or no such display.
            ConfigError: the desktop's mode is another.
            DeviceError: the desktop scales.
        """
        self._clock = clock
        self._options = options
        self._name = f"window on {device or 'the last display'}"
        self._window: sdl.Window | None = None
        self._pictures: list[sdl.Picture] = []
        self._lost: str | None = None
        self._last = 0
        """the beat of the last flip"""
        self._library: ctypes.CDLL | None = None
        library = self._library = sdl.start()
        try:
            self._open(_find(list(sdl.displays(library)), device), library)
        except BaseException:
            self.close()
            raise

    @property
    def name(self) -> str:
        """The device's name in messages."""
        return self._name

    @property
    def window(self) -> sdl.Window:
        """The open window.

        Raises:
            DeviceError: it is closed.
        """
        if self._window is None:
            raise DeviceError("the projector is closed", device=self._name)
        return self._window

    @property
    def pictures(self) -> Sequence[sdl.Picture]:
        """The loaded images, in the renderer's memory."""
        return tuple(self._pictures)

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """What it can do."""
        return self._options.capabilities(*self._size, self._refresh_ns)

    def load(self, images: Sequence[Image]) -> None:
        """Replace the images; see `scanner.devices.Projector.load`."""
        window, shape = self.window, self._size[::-1]
        check_images(images, shape, self._name)
        before, self._pictures = self._pictures, []
        for picture in before:
            picture.free()
        self._pictures.extend(window.picture(image) for image in images)

    def show(self, index: int) -> Flip:
        """Flip at the next beat of the nominal refresh; see `scanner.devices.Projector.show`."""
        window = self.window
        if not 0 <= index < len(self._pictures):
            raise DeviceError(f"image {index} is not loaded, there are {len(self._pictures)}", device=self._name)
        for event in window.events():
            self._lost = self._lost or event
        if self._lost:
            raise DeviceLost(self._lost, device=self._name, hint="leave the window alone, and repeat the scan")
        beat = max((self._clock.now_ns() - self._first_ns) // self._refresh_ns, self._last) + 1
        self._clock.sleep_until(self._first_ns + beat * self._refresh_ns)
        window.present(self._pictures[index])
        t_ns = self._clock.now_ns()
        # Presenting may itself wait for a blank: the beat is the one nearest to its return.
        self._last = max(round((t_ns - self._first_ns) / self._refresh_ns), self._last + 1)
        return Flip(t_ns, self._last, COMPOSITOR_REFRESHES * self._refresh_ns, Source.ESTIMATED)

    def close(self) -> None:
        """Take the window away; the desktop is what shows then. May be called twice."""
        if self._library is None:
            return
        if self._window is not None:
            self._window.close()  # textures go with their renderer
            self._window = None
        self._pictures = []
        sdl.stop(self._library)
        self._library = None

    def _open(self, display: sdl.Display, library: ctypes.CDLL) -> None:
        self._name = f"window on {display.name or display.index}"
        hz = display.hz or USUAL_HZ
        wanted = self._options.windowed or (display.width, display.height)
        _check_mode(self._options, wanted, hz, self._name)
        window = self._window = sdl.Window(library, display, self._options.windowed)
        self._size = window.size
        if self._size != wanted:
            raise DeviceError(
                f"the desktop makes {self._size[0]}x{self._size[1]} pixels of {wanted[0]}x{wanted[1]}",
                device=self._name,
                hint="set its scaling to 100 % on the projector: no pattern survives scaling",
            )
        self._refresh_ns = round(1e9 / hz)
        self._first_ns = self._clock.now_ns()
        window.present(window.picture(np.zeros(self._size[::-1], dtype=np.uint8)))
        list(window.events())  # of the opening itself


class WindowProjectorDriver:
    """Entry point of the group `fringed.projectors`.

    Device strings: a display's number or name in the desktop's settings; "" is the last one.
    """

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> WindowProjector:
        """Open a window; see `scanner.devices.ProjectorDriver.open`."""
        return WindowProjector(device, read_options(WindowOptions, options, device or DRIVER), clock)

    def check(self, device: str, options: Mapping[str, Any]) -> Sequence[tuple[str, ConfigError]]:
        """See `scanner.devices.ChecksOptions.check`."""
        return option_problems(WindowOptions, options, device or DRIVER)

    def discover(self) -> Sequence[DeviceInfo]:
        """The desktop's displays; none without SDL or without a desktop."""
        return list(_displays())


def _displays() -> Iterator[DeviceInfo]:
    try:
        library = sdl.start()
    except DeviceNotFound:
        return
    try:
        for display in sdl.displays(library):
            details = {"size": f"{display.width}x{display.height}", "hz": display.hz or "unknown"}
            model = display.name or "display of the desktop"
            yield DeviceInfo(DRIVER, str(display.index), "projector", model, details)
    finally:
        sdl.stop(library)


def _find(seen: list[sdl.Display], device: str) -> sdl.Display:
    fitting = [display for display in seen if device in {"", str(display.index), display.name}]
    if not fitting:
        names = ", ".join(f"{display.index} ({display.name})" for display in seen)
        raise DeviceNotFound(f"no display {device!r}", device=DRIVER, hint=f"the desktop has: {names or 'none'}")
    return fitting[-1]


def _check_mode(options: WindowOptions, size: tuple[int, int], hz: int, device: str) -> None:
    if options.mode is None:
        return
    wanted, rate = read_mode(options.mode, device)
    # Desktops round rates to whole Hz: 59.94 is told as 60 or 59.
    if wanted != size or (rate is not None and abs(rate - hz) > 1):
        raise ConfigError(
            f"the desktop shows {size[0]}x{size[1]}@{hz} there, and not {options.mode}",
            device=device,
            hint="set the mode in the desktop's settings, or leave projector.mode out",
        )
