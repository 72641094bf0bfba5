"""The aravis driver's own table in the rig file, `[camera.options]`, read into typed settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

from scanner.devices import Interval
from scanner.errors import ConfigError

Pair = tuple[float, float]


@dataclass(frozen=True)
class Options:
    """Every option has a default that works; `docs/how-to/connect-a-gige-or-usb3-camera.md` says when to change one."""

    packet_size: int | None = field(default=None, metadata={"low": 576, "high": 65_000})
    """bytes on the wire, headers included; None: the largest that arrives whole"""
    packet_delay_us: float = field(default=0.0, metadata={"low": 0.0, "high": 10_000.0})
    """pause after each packet: several cameras on one link"""
    resend: bool = True
    packet_socket: bool = False
    """Aravis's faster way in, for those who may (CAP_NET_RAW); off, so that all users see the same"""
    socket_buffer_frames: int = field(default=4, metadata={"low": 1, "high": 64})
    buffers: int | None = field(default=None, metadata={"low": 2, "high": 1024})
    """frames that may wait for a host that is slow; None: 8 to 64, as 256 MB allow"""
    frame_rate_hz: float | None = field(default=None, metadata={"low": 0.01, "high": 100_000.0})
    """free run; None: as fast as the camera can"""
    binning: int = field(default=1, metadata={"low": 1, "high": 16})
    trigger_line: str = ""
    """line of the hardware trigger; empty: the first the camera offers"""
    trigger_activation: str = "RisingEdge"
    trigger_delay_us: float = field(default=0.0, metadata={"low": 0.0, "high": 1e6})
    count_triggers: bool = True
    """let the camera count trigger edges and put the count into each frame, where it can"""
    overlap: bool = False
    """a trigger during readout is taken (TriggerOverlap), where the camera can"""
    trigger_latency_us: Pair | None = None
    """measured: software trigger to first row's start, [low, high]"""
    line_latency_us: Pair | None = None
    """measured: edge on the line to first row's start, [low, high]"""
    readout_us: float | None = field(default=None, metadata={"low": 0.0, "high": 1e6})
    """None: what the camera says (SensorReadoutTime), or its shortest frame period"""
    shutter: str = field(default="auto", metadata={"choices": ("auto", "global", "rolling")})
    """auto: what the camera says (SensorShutterMode), else global"""
    stamp_at: str = field(default="start", metadata={"choices": ("start", "end")})
    """what the camera stamps: the exposure's start or its end"""
    clock: str = field(default="auto", metadata={"choices": ("auto", "latch", "arrival")})
    """how the camera's clock is compared: read on command (auto, where it can), or by when frames arrive"""
    arrival_bound_us: float = field(default=3000.0, metadata={"low": 1.0, "high": 1e6})
    """clock by arrival: what its stamps are believed to be true to"""
    loss_ms: float = field(default=600.0, metadata={"low": 100.0, "high": 60_000.0})
    """a camera that is silent for so long is lost"""
    features: Mapping[str, Any] = field(default_factory=dict)
    """further GenICam features to be set, by name: {"BlackLevel" = 4.0}"""

    @property
    def trigger_latency(self) -> Interval | None:
        """As an interval, ns."""
        return _interval(self.trigger_latency_us)

    @property
    def line_latency(self) -> Interval | None:
        """As an interval, ns."""
        return _interval(self.line_latency_us)


def read_options(given: Mapping[str, Any], device: str) -> Options:
    """Check a rig file's table.

    Raises:
        ConfigError: an unknown option, or a value that does not fit it.
    """
    fields = {f.name: f for f in dataclasses.fields(Options)}
    values: dict[str, Any] = {}
    for name, value in given.items():
        if name not in fields:
            near = get_close_matches(name, fields, n=1)
            raise ConfigError(
                f"unknown option {name!r} of the driver aravis",
                device=device,
                hint=(f"did you mean {near[0]!r}? " if near else "") + f"known: {', '.join(sorted(fields))}",
            )
        values[name] = _checked(name, value, str(fields[name].type), fields[name].metadata, device)
    return Options(**values)


def _checked(name: str, value: Any, kind: str, bounds: Mapping[str, Any], device: str) -> Any:
    wanted = _wanted(kind)
    if "None" in kind and value is None:
        return None
    fits = {
        "true or false": isinstance(value, bool),
        "a whole number": isinstance(value, int) and not isinstance(value, bool),
        "a number": isinstance(value, int | float) and not isinstance(value, bool),
        "a string": isinstance(value, str),
        "a table": isinstance(value, Mapping),
        "two numbers, [low, high]": _is_pair(value),
    }[wanted]
    if not fits:
        raise ConfigError(f"option {name} takes {wanted}, got {value!r}", device=device)
    choices = bounds.get("choices")
    if choices is not None and value not in choices:
        raise ConfigError(f"option {name} is {value!r}", device=device, hint=f"one of {', '.join(choices)}")
    low, high = bounds.get("low"), bounds.get("high")
    if low is not None and not low <= value <= high:
        raise ConfigError(f"option {name} is {value!r}, it must lie in {low:g} .. {high:g}", device=device)
    return (float(value[0]), float(value[1])) if wanted.startswith("two") else value


def _wanted(kind: str) -> str:
    for part, words in (
        ("Pair", "two numbers, [low, high]"),
        ("Mapping", "a table"),
        ("bool", "true or false"),
        ("int", "a whole number"),
        ("float", "a number"),
    ):
        if part in kind:
            return words
    return "a string"


def _is_pair(value: Any) -> bool:
    numbers = isinstance(value, list | tuple) and len(value) == 2 and all(type(v) in (int, float) for v in value)
    return numbers and 0 <= value[0] <= value[1]


def _interval(pair: Pair | None) -> Interval | None:
    return None if pair is None else Interval(round(1e3 * pair[0]), round(1e3 * pair[1]))
