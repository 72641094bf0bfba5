"""A projector that shows one pattern for ever: a slide, a grating, or a beamer left on with a picture from a stick.

MCP needs no more. The driver moves nothing: it tells the planner what hangs in the light's path, and, where it is
given the slide's picture, refuses to pretend that another pattern is shown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import Field

from drivers.display import check_images, read_mode
from drivers.option_table import Options, option_problems, read_options
from scanner.clock import Clock
from scanner.devices import DeviceInfo, Flip, Image, Interval, ProjectorCapabilities, ProjectorKind, Source
from scanner.errors import ConfigError, DeviceError

DRIVER = "static"

_NO_CHANGE = Interval(0, 0)


class StaticOptions(Options):
    """`projector.options` of a slide."""

    size: tuple[int, int] | None = None
    """width and height of the pattern, as it was made; may be left out where `picture` tells"""
    mode: str | None = None
    """the rig file's `projector.mode`, WIDTHxHEIGHT or WIDTHxHEIGHT@HZ: the same as `size`"""
    picture: Path | None = None
    """the image on the slide (PNG); what is to be projected must be this to the bit"""
    modulation_period_us: float | None = Field(default=None, gt=0, le=1e6)
    """of a digital projector left on, that builds a grey over time"""
    refresh_hz: float = Field(default=60.0, gt=0, le=10_000)
    """how often `show` returns; a slide has no refresh"""


class StaticProjector:
    """See `scanner.devices.Projector`."""

    def __init__(self, device: str, options: StaticOptions, clock: Clock) -> None:
        """Know the slide.

        Raises:
            ConfigError: its size is not told, or told in two ways; its picture cannot be read.
        """
        self._name = f"slide {device}" if device else "slide"
        self._options = options
        self._clock = clock
        self._picture = _read(options.picture, self._name)
        self._width, self._height = _size(options, self._picture, self._name)
        self._refresh_ns = round(1e9 / options.refresh_hz)
        self._first_ns = clock.now_ns()
        self._last = 0
        self._loaded = 0
        self._open = True

    @property
    def name(self) -> str:
        """The device's name in messages."""
        return self._name

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """What it can do: nothing changes, so there is nothing to wait for."""
        period = self._options.modulation_period_us
        return ProjectorCapabilities(
            kind=ProjectorKind.STATIC,
            width=self._width,
            height=self._height,
            refresh_ns=self._refresh_ns,
            modulation_period_ns=None if period is None else round(1e3 * period),
            latency=_NO_CHANGE,
            settle=_NO_CHANGE,
        )

    def load(self, images: Sequence[Image]) -> None:
        """Check that the one image is the slide's; see `scanner.devices.Projector.load`."""
        self._check_open()
        check_images(images, (self._height, self._width), self._name)
        if len(images) > 1:
            raise DeviceError(
                f"a slide holds one image, got {len(images)}",
                device=self._name,
                hint="methods of several frames need a projector that can change",
            )
        if images and self._picture is not None and not np.array_equal(images[0], self._picture):
            raise DeviceError(
                f"the slide bears another pattern: {_difference(images[0], self._picture)}",
                device=self._name,
                hint="ask for the slide's own method and settings, or name its picture in projector.options.picture",
            )
        self._loaded = len(images)

    def show(self, index: int) -> Flip:
        """Nothing moves; returns at the next beat of `refresh_hz`. See `scanner.devices.Projector.show`."""
        self._check_open()
        if not 0 <= index < self._loaded:
            raise DeviceError(f"image {index} is not loaded, there are {self._loaded}", device=self._name)
        self._last = max((self._clock.now_ns() - self._first_ns) // self._refresh_ns, self._last) + 1
        t_ns = self._first_ns + self._last * self._refresh_ns
        self._clock.sleep_until(t_ns)
        return Flip(t_ns, self._last, self._refresh_ns, Source.ESTIMATED)

    def close(self) -> None:
        """Forget it; the light is for a hand to switch off. May be called twice."""
        self._open = False

    def _check_open(self) -> None:
        if not self._open:
            raise DeviceError("the projector is closed", device=self._name)


class StaticProjectorDriver:
    """Entry point of the group `fringed.projectors`. The device string is a name of your own."""

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> StaticProjector:
        """Know a slide; see `scanner.devices.ProjectorDriver.open`."""
        return StaticProjector(device, read_options(StaticOptions, options, device or DRIVER), clock)

    def check(self, device: str, options: Mapping[str, Any]) -> Sequence[tuple[str, ConfigError]]:
        """See `scanner.devices.ChecksOptions.check`."""
        return option_problems(StaticOptions, options, device or DRIVER)

    def discover(self) -> Sequence[DeviceInfo]:
        """None: a slide says nothing of itself."""
        return []


projector_driver = StaticProjectorDriver()


def _read(path: Path | None, device: str) -> Image | None:
    if path is None:
        return None
    read = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if read is None or read.dtype != np.uint8 or read.ndim != 2:
        raise ConfigError(
            f"{path} is no grey picture of 8 bits" if path.is_file() else f"{path} is not there",
            device=device,
            hint="options.picture is the PNG that the slide was made from",
        )
    return np.asarray(read, dtype=np.uint8)


def _size(options: StaticOptions, picture: Image | None, device: str) -> tuple[int, int]:
    told: dict[str, tuple[int, int]] = {}
    if options.size is not None:
        told["size"] = options.size
    if options.mode is not None:
        told["mode"], _ = read_mode(options.mode, device)
    if picture is not None:
        told["picture"] = picture.shape[1], picture.shape[0]
    if len(set(told.values())) > 1:
        said = ", ".join(f"{width}x{height} by {key}" for key, (width, height) in told.items())
        raise ConfigError(f"the slide's size is told in two ways: {said}", device=device, hint="one of them is wrong")
    if not told:
        raise ConfigError(
            "the slide's size is not told",
            device=device,
            hint="give projector.options.picture, or size = [width, height]",
        )
    size = next(iter(told.values()))
    if min(size) < 1:
        raise ConfigError(f"a slide of {size[0]}x{size[1]} pixels cannot be", device=device)
    return size


def _difference(wanted: Image, borne: Image) -> str:
    return f"{np.count_nonzero(wanted != borne) / wanted.size:.0%} of its pixels differ from the one to be shown"
