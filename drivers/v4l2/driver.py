"""What the registry opens: V4L2 cameras and V4L2 outputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from drivers.option_table import option_problems, read_options
from drivers.v4l2.camera import V4l2Camera
from drivers.v4l2.node import VideoNode, find, nodes
from drivers.v4l2.options import CameraOptions, OutputOptions
from drivers.v4l2.output import V4l2Output
from scanner.clock import Clock
from scanner.devices import DeviceInfo
from scanner.errors import ConfigError

DRIVER = "v4l2"

UVC_STAMPS = Path("/sys/module/uvcvideo/parameters/hwtimestamps")


class V4l2CameraDriver:
    """Entry point of the group `fringed.cameras`. Device strings: see `node`; options: `CameraOptions`."""

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> V4l2Camera:
        """Open one camera; see `scanner.devices.CameraDriver.open`."""
        understood = read_options(CameraOptions, options, device or DRIVER)
        return V4l2Camera(find(device, "camera"), understood, clock)

    def check(self, device: str, options: Mapping[str, Any]) -> Sequence[tuple[str, ConfigError]]:
        """See `scanner.devices.ChecksOptions.check`."""
        return option_problems(CameraOptions, options, device or DRIVER)

    def discover(self) -> Sequence[DeviceInfo]:
        """Cameras that this user may open."""
        return [_info(node, "camera") for node in nodes("camera")]


class V4l2ProjectorDriver:
    """Entry point of the group `fringed.projectors`. Options: `OutputOptions`."""

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> V4l2Output:
        """Open one output; see `scanner.devices.ProjectorDriver.open`."""
        understood = read_options(OutputOptions, options, device or DRIVER)
        return V4l2Output(find(device, "projector"), understood, clock)

    def check(self, device: str, options: Mapping[str, Any]) -> Sequence[tuple[str, ConfigError]]:
        """See `scanner.devices.ChecksOptions.check`."""
        return option_problems(OutputOptions, options, device or DRIVER)

    def discover(self) -> Sequence[DeviceInfo]:
        """Outputs that this user may open."""
        return [_info(node, "projector") for node in nodes("projector")]


def _info(node: VideoNode, kind: Any) -> DeviceInfo:
    details: dict[str, Any] = {"node": node.path, "bus": node.bus, "kernel driver": node.driver}
    if (said := _stamps(node)) is not None:
        details["stamps"] = said
    return DeviceInfo(driver=DRIVER, device=node.stable, kind=kind, model=node.card, details=details)


def _stamps(node: VideoNode) -> str | None:
    """What uvcvideo's stamps are, for who reads the list; None: another driver."""
    if node.driver != "uvcvideo":
        return None
    try:
        device_clock = UVC_STAMPS.read_text().strip() not in {"0", "N"}
    except OSError:
        return None
    if device_clock:
        return "of the camera's clock, by uvcvideo"
    return "of arrival, by uvcvideo; modprobe option: options uvcvideo hwtimestamps=1"
