"""What a camera behind Aravis can be set to, and is: bounds read from it, settings checked before anything is set.

Functions over an opened link's camera and features; run on the link's thread.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from drivers.aravis.features import Features
from drivers.aravis.options import AravisOptions
from drivers.aravis.pixels import FORMATS, PixelFormat
from scanner.devices import CameraCapabilities, CameraSettings, Source, TriggerMode
from scanner.errors import ConfigError, DeviceError

STEP_NS = 1_000
"""Step of exposures where the camera tells none"""


@dataclass(frozen=True)
class Present:
    """What the camera is set to, as it reads back."""

    exposure_ns: int
    gain_db: float
    pixel_format: PixelFormat
    region: tuple[int, int, int, int]

    def as_settings(self) -> CameraSettings:
        """For who applied them."""
        return CameraSettings(self.exposure_ns, self.gain_db, self.pixel_format.name, self.region)


@dataclass(frozen=True)
class Limits:
    """Bounds of the settings, ns and dB."""

    exposure: tuple[int, int]
    step_ns: int
    gain: tuple[float, float]
    formats: tuple[str, ...]
    sensor: tuple[int, int]
    """width and height that a region lies in, binned"""
    grid: tuple[int, int, int, int]
    """steps of x, y, width, height"""


def read_present(camera: Any, features: Features, name: str) -> Present:
    """Read everything back."""
    x, y, width, height = camera.get_region()
    text = camera.get_pixel_format_as_string()
    if text not in FORMATS:
        raise DeviceError(
            f"pixel format {text!r} is none this driver knows", device=name, hint=f"set one of: {', '.join(FORMATS)}"
        )
    gain = float(camera.get_gain()) if camera.is_gain_available() else 0.0
    return Present(round(1e3 * camera.get_exposure_time()), gain, FORMATS[text], (x, y, width, height))


def read_limits(camera: Any, features: Features) -> Limits:
    """Read the bounds."""
    low, high = camera.get_exposure_time_bounds()
    gain = tuple(map(float, camera.get_gain_bounds())) if camera.is_gain_available() else (0.0, 0.0)
    formats = tuple(name for name in camera.dup_available_pixel_formats_as_strings() if name in FORMATS)
    width, height = camera.get_sensor_size()
    width = features.get_or_none("WidthMax", int) or width
    height = features.get_or_none("HeightMax", int) or height
    step_us = features.float_step("ExposureTime") if features.has("ExposureTime") else None
    return Limits(
        exposure=(-int(-1e3 * low // 1), int(1e3 * high)),
        step_ns=STEP_NS if step_us is None else max(1, round(1e3 * step_us)),
        gain=(gain[0], gain[1]),
        formats=formats,
        sensor=(int(width), int(height)),
        grid=tuple(_step(features, each) for each in ("OffsetX", "OffsetY", "Width", "Height")),  # type: ignore[arg-type]
    )


def choose_format(camera: Any, limits: Limits, name: str) -> None:
    """A format of ours, where the camera came up in another: Mono8, or the first it has.

    Raises:
        ConfigError: the camera has none.
    """
    if camera.get_pixel_format_as_string() in FORMATS:
        return
    if not limits.formats:
        raise ConfigError(
            "the camera has no grey or raw Bayer format",
            device=name,
            hint="its greys would be mixtures of colours: use another camera",
        )
    first = "Mono8" if "Mono8" in limits.formats else limits.formats[0]
    camera.set_pixel_format_from_string(first)


def check(settings: CameraSettings, limits: Limits, name: str) -> None:
    """Refuse what the camera cannot, before anything is set.

    Raises:
        ConfigError: names the setting, its bounds and what would do.
    """
    low, high = limits.exposure
    if settings.exposure_ns is not None and not low <= settings.exposure_ns <= high:
        raise ConfigError(
            f"exposure {settings.exposure_ns / 1e3:g} us lies outside {low / 1e3:g} .. {high / 1e3:g} us", device=name
        )
    if settings.gain_db is not None and not limits.gain[0] <= settings.gain_db <= limits.gain[1]:
        raise ConfigError(
            f"gain {settings.gain_db:g} dB lies outside {limits.gain[0]:g} .. {limits.gain[1]:g} dB", device=name
        )
    if settings.pixel_format is not None and settings.pixel_format not in limits.formats:
        raise ConfigError(
            f"no pixel format {settings.pixel_format!r}", device=name, hint=f"it has {', '.join(limits.formats)}"
        )
    if settings.region is not None:
        _check_region(settings.region, limits, name)


def put(camera: Any, features: Features, settings: CameraSettings, name: str) -> None:
    """Set what is given; `check` has passed."""
    if settings.pixel_format is not None:
        camera.set_pixel_format_from_string(settings.pixel_format)
    if settings.region is not None:
        # A size may not fit behind the present offset, nor an offset behind the present size: offsets go first to 0.
        for offset in ("OffsetX", "OffsetY"):
            features.set_if_there(offset, 0)
        camera.set_region(*settings.region)
        taken = tuple(camera.get_region())
        if taken != tuple(settings.region):
            raise DeviceError(f"region {list(settings.region)} reads back as {list(taken)}", device=name)
    if settings.gain_db is not None and camera.is_gain_available():
        camera.set_gain(settings.gain_db)
    if settings.exposure_ns is not None:
        camera.set_exposure_time(settings.exposure_ns / 1e3)


@dataclass(frozen=True)
class Pace:
    """How fast the camera is, ns. It depends on the exposure only in cameras that say so."""

    readout_ns: int
    gap_ns: int
    shutter: Literal["global", "rolling"]


def read_pace(camera: Any, features: Features, options: AravisOptions, exposure_ns: int) -> Pace:
    """From what the camera says of its readout and its frame rate at the present exposure."""
    shutter = options.shutter
    if shutter == "auto":
        told = features.get_or_none("SensorShutterMode", str) or ""
        shutter = "rolling" if "rolling" in told.lower() else "global"
    shortest = shortest_period_ns(camera)
    readout = options.readout_us
    if readout is None:
        readout = features.get_or_none("SensorReadoutTime", float)
    # Without a word of it: what a frame takes beyond its exposure, or a whole period where exposure overlaps readout.
    guess = 0 if shortest is None else (shortest - exposure_ns if shortest > exposure_ns else shortest)
    readout_ns = guess if readout is None else round(1e3 * readout)
    beyond = 0 if shortest is None else max(0, shortest - exposure_ns)
    gap = max(beyond, 0 if options.overlap else readout_ns)
    return Pace(readout_ns, gap, "rolling" if shutter == "rolling" else "global")


def shortest_period_ns(camera: Any) -> int | None:
    """At the present settings; None where the camera has no frame rate."""
    if not camera.is_frame_rate_available():
        return None
    _, highest = camera.get_frame_rate_bounds()
    return -int(-1e9 / highest // 1) if highest > 0 else None


def capabilities(
    present: Present,
    limits: Limits,
    pace: Pace,
    modes: Sequence[TriggerMode],
    options: AravisOptions,
    stamp: tuple[Source, int],
) -> CameraCapabilities:
    """What the camera can do, as the planner takes it."""
    _, _, width, height = present.region
    return CameraCapabilities(
        width=width,
        height=height,
        bits=present.pixel_format.bits,
        shutter=pace.shutter,
        readout_ns=pace.readout_ns,
        exposure_min_ns=limits.exposure[0],
        exposure_max_ns=limits.exposure[1],
        exposure_step_ns=limits.step_ns,
        min_gap_ns=pace.gap_ns,
        trigger_modes=frozenset(modes),
        trigger_latency=options.trigger_latency,
        line_latency=options.line_latency,
        stamp=stamp[0],
        stamp_bound_ns=stamp[1],
        gain_min_db=limits.gain[0],
        gain_max_db=limits.gain[1],
        mosaic=present.pixel_format.mosaic,
    )


def _check_region(region: tuple[int, int, int, int], limits: Limits, name: str) -> None:
    x, y, width, height = region
    if min(x, y) < 0 or min(width, height) < 1 or x + width > limits.sensor[0] or y + height > limits.sensor[1]:
        raise ConfigError(
            f"region {list(region)} leaves the sensor", device=name, hint=f"it lies in {list(limits.sensor)} px"
        )
    for value, step, what in zip(region, limits.grid, ("x", "y", "width", "height"), strict=True):
        if value % step:
            raise ConfigError(
                f"region {list(region)}: {what} {value} is no multiple of {step}",
                device=name,
                hint=f"give {value // step * step} or {value // step * step + step}",
            )


def _step(features: Features, feature: str) -> int:
    return features.integer_bounds(feature)[2] if features.has(feature) else 1
