"""The option tables of V4L2 cameras and outputs, as a rig file has them."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from drivers.display import DisplayOptions
from drivers.option_table import Options

MicrosecondSpan = tuple[float, float]


class CameraOptions(Options):
    """`camera.options` of a V4L2 camera."""

    size: tuple[int, int] | None = None
    """width and height; None: what is set, or the signal's on an HDMI input"""
    mode: str | None = None
    """timings of an HDMI input, as "1280x720@60"; None: those of the signal"""
    fps: float | None = Field(default=None, gt=0, le=10_000)
    pixel_format: str | None = None
    shutter: Literal["global", "rolling"] = "rolling"
    """V4L2 does not tell; rolling is the careful assumption"""
    readout_us: float | None = Field(default=None, ge=0, le=1e7)
    """rolling: first row's start to last row's start; None: a whole frame period, the longest it can be"""
    exposure_us: float | None = Field(default=None, gt=0, le=1e7)
    """of a camera without an exposure control: what it is; None: a whole frame period"""
    exposure_unit_us: float | None = Field(default=None, gt=0, le=1e6)
    """of a camera whose exposure control counts something else than 100 us (lines, mostly): that unit"""
    stamp_delay_us: MicrosecondSpan | None = None
    """measured: the kernel's stamp minus the start of the first row's exposure; without it stamps are estimates"""
    controls: dict[str, int | str] = Field(default_factory=dict)
    """controls by name, as `v4l2-ctl --list-ctrls` has them; set after the automatic functions are off"""
    keep: tuple[str, ...] = ()
    """automatic functions to be left as they are, by control name"""
    buffers: int = Field(default=8, ge=3, le=32)

    @model_validator(mode="after")
    def _span_is_upright(self) -> CameraOptions:
        if self.stamp_delay_us is not None and self.stamp_delay_us[0] > self.stamp_delay_us[1]:
            raise ValueError("stamp_delay_us is [low, high]")
        return self


class OutputOptions(DisplayOptions):
    """`projector.options` of a V4L2 output."""

    pixel_format: str | None = None
    stamp_bound_us: float | None = Field(default=None, gt=0, le=1e6)
    """measured: a flip's stamp is true within this; without it stamps are estimates, true within a refresh"""
