"""The few calls of SDL 2 that a full-screen picture takes, through ctypes; loaded when the first window is opened.

SDL (zlib licence) comes from the distribution, package libsdl2-2.0-0, and finds X11 or Wayland by itself. Without it
everything else of this project works.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from ctypes import c_char_p, c_int, c_uint8, c_uint32, c_void_p
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from scanner.devices import Image
from scanner.errors import DeviceError, DeviceNotFound

LIBRARY = "libSDL2-2.0.so.0"
PACKAGE = "libsdl2-2.0-0"

_VIDEO = 0x20
_BORDERLESS, _FULL_SCREEN, _ON_TOP = 0x10, 0x1001, 0x8000
_VSYNC, _SOFTWARE = 4, 1
_ARGB8888 = 0x16362004
_STATIC = 0
_CENTRED = 0x2FFF0000
_GREY, _OPAQUE = 0x00010101, 0xFF000000

_QUIT, _DISPLAY_EVENT, _WINDOW_EVENT = 0x100, 0x150, 0x200
_GONE = {(_DISPLAY_EVENT, 3): "its display was unplugged"}
_CLOSED = {2: "the window was hidden", 7: "the window was minimised", 14: "the window was closed"}


class _Rect(ctypes.Structure):
    _fields_ = (("x", c_int), ("y", c_int), ("w", c_int), ("h", c_int))


class _DisplayMode(ctypes.Structure):
    _fields_ = (("format", c_uint32), ("w", c_int), ("h", c_int), ("refresh_rate", c_int), ("driverdata", c_void_p))


class _Event(ctypes.Structure):
    """SDL_Event: 56 bytes; of window and display events the kind of event is the byte after three 32-bit words."""

    _fields_ = (("type", c_uint32), ("stamp", c_uint32), ("id", c_uint32), ("event", c_uint8), ("rest", c_uint8 * 43))


@dataclass(frozen=True)
class Display:
    """One display of the desktop."""

    index: int
    name: str
    """of the monitor; empty where the desktop knows none"""
    x: int
    y: int
    width: int
    height: int
    hz: int
    """0: the desktop does not tell"""


_SIGNATURES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "SDL_InitSubSystem": (c_int, (c_uint32,)),
    "SDL_QuitSubSystem": (None, (c_uint32,)),
    "SDL_GetError": (c_char_p, ()),
    "SDL_SetHint": (c_int, (c_char_p, c_char_p)),
    "SDL_DisableScreenSaver": (None, ()),
    "SDL_GetNumVideoDisplays": (c_int, ()),
    "SDL_GetDisplayName": (c_char_p, (c_int,)),
    "SDL_GetDisplayBounds": (c_int, (c_int, ctypes.POINTER(_Rect))),
    "SDL_GetDesktopDisplayMode": (c_int, (c_int, ctypes.POINTER(_DisplayMode))),
    "SDL_CreateWindow": (c_void_p, (c_char_p, c_int, c_int, c_int, c_int, c_uint32)),
    "SDL_DestroyWindow": (None, (c_void_p,)),
    "SDL_ShowCursor": (c_int, (c_int,)),
    "SDL_CreateRenderer": (c_void_p, (c_void_p, c_int, c_uint32)),
    "SDL_DestroyRenderer": (None, (c_void_p,)),
    "SDL_GetRendererOutputSize": (c_int, (c_void_p, ctypes.POINTER(c_int), ctypes.POINTER(c_int))),
    "SDL_CreateTexture": (c_void_p, (c_void_p, c_uint32, c_int, c_int, c_int)),
    "SDL_DestroyTexture": (None, (c_void_p,)),
    "SDL_UpdateTexture": (c_int, (c_void_p, c_void_p, c_void_p, c_int)),
    "SDL_RenderCopy": (c_int, (c_void_p, c_void_p, c_void_p, c_void_p)),
    "SDL_RenderReadPixels": (c_int, (c_void_p, c_void_p, c_uint32, c_void_p, c_int)),
    "SDL_RenderPresent": (None, (c_void_p,)),
    "SDL_PollEvent": (c_int, (ctypes.POINTER(_Event),)),
}


@cache
def library() -> ctypes.CDLL:
    """SDL, with its signatures.

    Raises:
        DeviceNotFound: it is not installed.
    """
    try:
        loaded = ctypes.CDLL(LIBRARY)
    except OSError as error:
        raise DeviceNotFound(
            f"windows take SDL, and {LIBRARY} does not load", device="window", hint=f"apt-get install {PACKAGE}"
        ) from error
    for name, (returns, takes) in _SIGNATURES.items():
        function = getattr(loaded, name)
        function.restype, function.argtypes = returns, takes
    return loaded


def start() -> ctypes.CDLL:
    """SDL with its video part begun; each call wants a `stop`.

    Raises:
        DeviceNotFound: no SDL, or no desktop.
    """
    sdl = library()
    sdl.SDL_SetHint(b"SDL_VIDEO_MINIMIZE_ON_FOCUS_LOSS", b"0")
    sdl.SDL_SetHint(b"SDL_NO_SIGNAL_HANDLERS", b"1")  # signals are the program's
    sdl.SDL_SetHint(b"SDL_RENDER_SCALE_QUALITY", b"0")
    # Without a desktop SDL may find itself a driver that draws into memory, and call that a display.
    desktop = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"))
    if not desktop or sdl.SDL_InitSubSystem(_VIDEO):
        raise DeviceNotFound(
            f"no desktop to open a window on{f': {problem(sdl)}' if desktop else ''}",
            device="window",
            hint="set DISPLAY or WAYLAND_DISPLAY; on a rig without a desktop, use the driver kms",
        )
    return sdl


def stop(sdl: ctypes.CDLL) -> None:
    """End SDL's video part."""
    sdl.SDL_QuitSubSystem(_VIDEO)


def problem(sdl: ctypes.CDLL) -> str:
    """SDL's last error, in its words."""
    return str((sdl.SDL_GetError() or b"").decode(errors="replace"))


def displays(sdl: ctypes.CDLL) -> Iterator[Display]:
    """The desktop's displays, in its order."""
    for index in range(sdl.SDL_GetNumVideoDisplays()):
        bounds, mode = _Rect(), _DisplayMode()
        if sdl.SDL_GetDisplayBounds(index, bounds) or sdl.SDL_GetDesktopDisplayMode(index, mode):
            continue
        name = (sdl.SDL_GetDisplayName(index) or b"").decode(errors="replace")
        if name == str(index):  # SDL's stand-in for a display without a name
            name = ""
        yield Display(index, name, bounds.x, bounds.y, bounds.w, bounds.h, mode.refresh_rate)


class Picture:
    """An image in the renderer's memory. Belongs to a `Window`."""

    def __init__(self, sdl: ctypes.CDLL, renderer: int, image: Image) -> None:
        height, width = image.shape
        self._sdl = sdl
        self.texture = sdl.SDL_CreateTexture(renderer, _ARGB8888, _STATIC, width, height)
        if not self.texture:
            raise DeviceError(f"no room for an image: {problem(sdl)}", device="window")
        words = image.astype(np.uint32) * np.uint32(_GREY) | np.uint32(_OPAQUE)
        if sdl.SDL_UpdateTexture(self.texture, None, words.ctypes.data, 4 * width):
            message = problem(sdl)
            self.free()
            raise DeviceError(f"an image cannot be loaded: {message}", device="window")

    def free(self) -> None:
        """Give the memory back."""
        self._sdl.SDL_DestroyTexture(self.texture)


class Window:
    """A bare window and its renderer, without mouse pointer."""

    def __init__(self, sdl: ctypes.CDLL, display: Display, size: tuple[int, int] | None) -> None:
        """Open. size: (width, height) of a window for trials; None: the whole display.

        Raises:
            DeviceError: SDL cannot.
        """
        self._sdl = sdl
        self._renderer = None
        place = _CENTRED | display.index
        width, height = size or (display.width, display.height)
        flags = _BORDERLESS if size else _BORDERLESS | _ON_TOP | _FULL_SCREEN
        self._window = sdl.SDL_CreateWindow(b"fringed", place, place, width, height, flags)
        if not self._window:
            raise DeviceError(f"no window: {problem(sdl)}", device="window")
        for kind in (_VSYNC, _SOFTWARE):
            self._renderer = self._renderer or sdl.SDL_CreateRenderer(self._window, -1, kind)
        if not self._renderer:
            message = problem(sdl)
            self.close()
            raise DeviceError(f"nothing that can draw: {message}", device="window")
        sdl.SDL_ShowCursor(0)
        sdl.SDL_DisableScreenSaver()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in the display's own pixels."""
        width, height = c_int(), c_int()
        self._sdl.SDL_GetRendererOutputSize(self._renderer, width, height)
        return width.value, height.value

    def picture(self, image: Image) -> Picture:
        """Put an image into the renderer's memory."""
        assert self._renderer is not None  # noqa: S101  # open
        return Picture(self._sdl, self._renderer, image)

    def present(self, picture: Picture) -> None:
        """Show it; returns when the desktop has taken it, which may be at once or at a blank."""
        failed = self._sdl.SDL_RenderCopy(self._renderer, picture.texture, None, None)
        if failed:
            raise DeviceError(f"the image cannot be drawn: {problem(self._sdl)}", device="window")
        self._sdl.SDL_RenderPresent(self._renderer)

    def drawn(self, picture: Picture) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
        """What drawing makes of a picture, (H, W, 3) uint8, read back before it is shown."""
        width, height = self.size
        words = np.zeros((height, width), dtype=np.uint32)
        self._sdl.SDL_RenderCopy(self._renderer, picture.texture, None, None)
        if self._sdl.SDL_RenderReadPixels(self._renderer, None, _ARGB8888, words.ctypes.data, 4 * width):
            raise DeviceError(f"the image cannot be read back: {problem(self._sdl)}", device="window")
        return np.stack([(words >> shift).astype(np.uint8) for shift in (16, 8, 0)], axis=-1)

    def events(self) -> Iterator[str]:
        """What happened to the window since the last call that ends its use, in words."""
        event = _Event()
        while self._sdl.SDL_PollEvent(event):
            if event.type == _QUIT:
                yield "the desktop ends the program"
            elif event.type == _WINDOW_EVENT and event.event in _CLOSED:
                yield _CLOSED[event.event]
            elif (event.type, event.event) in _GONE:
                yield _GONE[event.type, event.event]

    def close(self) -> None:
        """Take it away. May be called twice."""
        if self._renderer:
            self._sdl.SDL_DestroyRenderer(self._renderer)
        if self._window:
            self._sdl.SDL_DestroyWindow(self._window)
        self._renderer = self._window = None
