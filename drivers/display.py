"""What drivers of displays share: the options every display has, what it can do, and images of its size.

A display here is a projector that shows one image after another from a frame buffer (KMS, V4L2 output, window).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from pydantic import Field

from drivers.option_table import Options
from scanner.devices import Image, ProjectorCapabilities, ProjectorKind
from scanner.errors import ConfigError, DeviceError


class DisplayOptions(Options):
    """`projector.options` of a display."""

    mode: str | None = None
    """the rig file's `projector.mode`; None: the display's own"""
    modulation_period_us: float | None = Field(default=None, gt=0, le=1e6)
    """of a display that builds a grey over time (colour wheel, bit planes)"""
    scan: Literal["global", "rows"] = "global"
    """rows: a new image sweeps down over one refresh, as on LCD and LCoS"""

    def capabilities(self, width: int, height: int, refresh_ns: int) -> ProjectorCapabilities:
        """What a display of that size (px) and refresh can do."""
        period = self.modulation_period_us
        return ProjectorCapabilities(
            kind=ProjectorKind.FRAMEBUFFER,
            width=width,
            height=height,
            refresh_ns=refresh_ns,
            modulation_period_ns=None if period is None else round(1e3 * period),
            scan=self.scan,
        )


def read_mode(mode: str, device: str) -> tuple[tuple[int, int], float | None]:
    """The size (width, height) and refresh rate, Hz, that a rig file's `projector.mode` asks for; None: any rate.

    >>> read_mode("1920x1080@59.94", "display")
    ((1920, 1080), 59.94)

    Raises:
        ConfigError: it is none.
    """
    size, _, rate = mode.partition("@")
    try:
        width, height = (int(part) for part in size.split("x"))
        return (width, height), float(rate) if rate else None
    except ValueError as error:
        raise ConfigError(
            f"mode {mode!r} makes no sense", device=device, hint='write "1920x1080" or "1920x1080@60"'
        ) from error


def check_images(images: Sequence[Image], shape: tuple[int, int], device: str) -> None:
    """Raise DeviceError unless every image is uint8 of that shape (height, width)."""
    for place, image in enumerate(images):
        if image.shape != shape or image.dtype != np.uint8:
            raise DeviceError(
                f"image {place} is {image.dtype} of shape {image.shape}, expected uint8 of shape {shape}",
                device=device,
                hint="images are (height, width) uint8 in the projector's own size",
            )
