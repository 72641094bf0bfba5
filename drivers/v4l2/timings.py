"""How often and how large: video timings of HDMI inputs and outputs, and frame periods of everything else."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

from drivers.ioctl import Node, gone
from drivers.v4l2 import videodev2 as v
from drivers.v4l2.node import failure
from scanner.errors import ConfigError

RATE_TOLERANCE = 2e-4
"""Two rates are the same within this: 59.94 and 60 Hz are 1e-3 apart, and the kernel's lists are rounded to 1e-5"""

_REDUCED_FPS = 1 << 3


@dataclass(frozen=True)
class Mode:
    """A size and how often it comes."""

    width: int
    height: int
    hz: float

    def __str__(self) -> str:
        return f"{self.width}x{self.height}@{self.hz:.5g}"


def parse_mode(mode: str, device: str) -> tuple[int, int, float | None]:
    """Width, height and Hz (None: any) of "WIDTHxHEIGHT" or "WIDTHxHEIGHT@HZ".

    Raises:
        ConfigError: it is neither.
    """
    match = re.fullmatch(r"(\d+)x(\d+)(?:@(\d+(?:\.\d+)?))?", mode)
    if not match:
        raise ConfigError(f"mode {mode!r} makes no sense", device=device, hint='write it as "1280x720@60"')
    return int(match[1]), int(match[2]), float(match[3]) if match[3] else None


def set_timings(node: Node, mode: str) -> bool:
    """Set the video timings that `mode` names; False: this node has none (it is no HDMI input or output).

    Raises:
        ConfigError: the device has no such timings; the hint lists them.
        DeviceBusy: somebody else streams.
    """
    if timings(node) is None:
        return False
    width, height, hz = parse_mode(mode, node.name)
    listed = list(_listed(node))
    sized = [(had, entry) for had, entry in listed if (had.width, had.height) == (width, height)]
    fitting = [pair for pair in sized if hz is None or same_rate(pair[0].hz, hz)]
    if not fitting:
        modes = ", ".join(dict.fromkeys(str(had) for had, _ in sized or listed))
        raise ConfigError(f"no timings {mode} on this device", device=node.name, hint=f"it has {modes}")
    _, entry = max(fitting, key=lambda pair: pair[0].hz)
    try:
        node.call(v.S_DV_TIMINGS, entry)
    except OSError as error:
        raise failure(error, f"timings {mode} cannot be set", node) from error
    return True


def follow_signal(node: Node) -> None:
    """Set an HDMI input to the timings of the signal on its cable, if there is one and it can tell."""
    seen = v.DvTimings()
    try:
        node.call(v.QUERY_DV_TIMINGS, seen)
        node.call(v.S_DV_TIMINGS, seen)
    except OSError as error:
        if gone(error):
            raise failure(error, "the signal cannot be measured", node) from error


def timings(node: Node) -> Mode | None:
    """The video timings as they are set; None: this node has none."""
    now = v.DvTimings()
    try:
        node.call(v.G_DV_TIMINGS, now)
    except OSError as error:
        if gone(error):
            raise failure(error, "the timings cannot be read", node) from error
        return None
    return _mode(now)


def set_rate(node: Node, kind: int, fps: float) -> None:
    """Ask for a frame rate.

    Raises:
        ConfigError: the device took another, or has but one.
    """
    parameters = v.StreamParameters(type=kind)
    parameters.parm.frame.timeperframe.numerator = 1000
    parameters.parm.frame.timeperframe.denominator = round(1000 * fps)
    try:
        node.call(v.S_PARM, parameters)
    except OSError as error:
        raise failure(error, f"{fps:g} frames a second cannot be set", node) from error
    taken = 1e9 / period_ns(node, kind)
    if not same_rate(taken, fps):
        raise ConfigError(
            f"asked for {fps:g} frames a second, the device took {taken:.5g}",
            device=node.name,
            hint="leave fps out, or take another size: cameras list rates by size",
        )


def period_ns(node: Node, kind: int) -> int:
    """Time from one frame to the next, ns.

    Raises:
        ConfigError: the device does not say.
    """
    mode = timings(node)
    parameters = v.StreamParameters(type=kind)
    try:
        node.call(v.G_PARM, parameters)
    except OSError as error:
        if gone(error):
            raise failure(error, "the frame rate cannot be read", node) from error
    per_frame = parameters.parm.frame.timeperframe
    if parameters.parm.frame.capability & v.CAP_TIMEPERFRAME and per_frame.numerator and per_frame.denominator:
        return round(1e9 * int(per_frame.numerator) / int(per_frame.denominator))
    if mode is not None and mode.hz > 0:
        return round(1e9 / mode.hz)
    raise ConfigError(
        "the device does not say how often its frames come", device=node.name, hint="give options.fps, measured"
    )


def same_rate(one: float, other: float) -> bool:
    """Whether two rates are the same one, rounded differently."""
    return abs(one - other) <= RATE_TOLERANCE * max(one, other)


def _listed(node: Node) -> Iterator[tuple[Mode, v.DvTimings]]:
    for index in range(512):
        entry = v.EnumDvTimings(index=index)
        try:
            node.call(v.ENUM_DV_TIMINGS, entry)
        except OSError:
            return  # EINVAL is how the kernel says that the list is over
        if (mode := _mode(entry.timings)) is not None and not entry.timings.timings.bt.interlaced:
            yield mode, entry.timings


def _mode(said: v.DvTimings) -> Mode | None:
    bt = said.timings.bt
    width = bt.width + bt.hfrontporch + bt.hsync + bt.hbackporch
    height = bt.height + bt.vfrontporch + bt.vsync + bt.vbackporch
    if not (width and height and bt.pixelclock):
        return None
    hz = bt.pixelclock / (width * height)
    return Mode(bt.width, bt.height, hz * 1000 / 1001 if bt.flags & _REDUCED_FPS else hz)
