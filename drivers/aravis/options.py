"""The aravis driver's own table in the rig file, `[camera.options]`, read into typed settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field

from drivers.option_table import Options
from scanner.devices import Interval


def _in_order(pair: tuple[float, float]) -> tuple[float, float]:
    if not 0 <= pair[0] <= pair[1]:
        raise ValueError("it takes [low, high], both positive and the low one first")
    return pair


Pair = Annotated[tuple[float, float], Field(strict=False), AfterValidator(_in_order)]


class AravisOptions(Options):
    """Every option has a default that works; `docs/how-to/connect-a-gige-or-usb3-camera.md` says when to change one."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False)

    packet_size: int | None = Field(default=None, ge=576, le=65_000)
    """bytes on the wire, headers included; None: the largest that arrives whole"""
    packet_delay_us: float = Field(default=0.0, ge=0, le=10_000)
    """pause after each packet: several cameras on one link"""
    resend: bool = True
    packet_socket: bool = False
    """Aravis's faster way in, for those who may (CAP_NET_RAW); off, so that all users see the same"""
    socket_buffer_frames: int = Field(default=4, ge=1, le=64)
    buffers: int | None = Field(default=None, ge=2, le=1024)
    """frames that may wait for a host that is slow; None: 8 to 64, as 256 MB allow"""
    frame_rate_hz: float | None = Field(default=None, ge=0.01, le=100_000)
    """free run; None: as fast as the camera can"""
    binning: int = Field(default=1, ge=1, le=16)
    trigger_line: str = ""
    """line of the hardware trigger; empty: the first the camera offers"""
    trigger_activation: str = "RisingEdge"
    trigger_delay_us: float = Field(default=0.0, ge=0, le=1e6)
    count_triggers: bool = True
    """let the camera count trigger edges and put the count into each frame, where it can"""
    overlap: bool = False
    """a trigger during readout is taken (TriggerOverlap), where the camera can"""
    trigger_latency_us: Pair | None = None
    """measured: software trigger to first row's start, [low, high]"""
    line_latency_us: Pair | None = None
    """measured: edge on the line to first row's start, [low, high]"""
    readout_us: float | None = Field(default=None, ge=0, le=1e6)
    """None: what the camera says (SensorReadoutTime), or its shortest frame period"""
    shutter: Literal["auto", "global", "rolling"] = "auto"
    """auto: what the camera says (SensorShutterMode), else global"""
    stamp_at: Literal["start", "end"] = "start"
    """what the camera stamps: the exposure's start or its end"""
    clock: Literal["auto", "latch", "arrival"] = "auto"
    """how the camera's clock is compared: read on command (auto, where it can), or by when frames arrive"""
    arrival_bound_us: float = Field(default=3000.0, ge=1, le=1e6)
    """clock by arrival: what its stamps are believed to be true to"""
    loss_ms: float = Field(default=600.0, ge=100, le=60_000)
    """a camera that is silent for so long is lost"""
    features: Mapping[str, Any] = Field(default_factory=dict)
    """further GenICam features to be set, by name: {"BlackLevel" = 4.0}"""

    @property
    def trigger_latency(self) -> Interval | None:
        """As an interval, ns."""
        return _interval(self.trigger_latency_us)

    @property
    def line_latency(self) -> Interval | None:
        """As an interval, ns."""
        return _interval(self.line_latency_us)


def _interval(pair: tuple[float, float] | None) -> Interval | None:
    return None if pair is None else Interval(round(1e3 * pair[0]), round(1e3 * pair[1]))
