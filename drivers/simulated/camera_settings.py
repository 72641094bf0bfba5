"""What the simulated camera can be set to, and the check of what it is told. Exposure moves in whole steps, down."""

from __future__ import annotations

from dataclasses import dataclass

from scanner.devices import CameraSettings
from scanner.errors import ConfigError

EXPOSURE_MIN_NS, EXPOSURE_MAX_NS, EXPOSURE_STEP_NS = 10_000, 1_000_000_000, 1_000
GAIN_MAX_DB = 24.0


@dataclass(frozen=True)
class Taken:
    """The settings as the camera has them."""

    exposure_ns: int
    gain_db: float
    bits: int

    @property
    def pixel_format(self) -> str:
        """The format's name, as GenICam has them."""
        return f"Mono{self.bits}"


def checked(settings: CameraSettings, present: Taken, size: tuple[int, int], device: str) -> Taken:
    """The settings after `settings` were applied to `present`; size: (width, height) of the sensor.

    Raises:
        ConfigError: a value outside the bounds, named with them.
    """
    width, height = size
    if settings.region is not None and tuple(settings.region) != (0, 0, width, height):
        raise ConfigError(
            f"region {list(settings.region)} is not offered",
            device=device,
            hint=f"the simulated camera gives its whole sensor, [0, 0, {width}, {height}]",
        )
    return Taken(
        present.exposure_ns if settings.exposure_ns is None else _exposure(settings.exposure_ns, device),
        present.gain_db if settings.gain_db is None else _gain(settings.gain_db, device),
        present.bits if settings.pixel_format is None else _bits(settings.pixel_format, device),
    )


_PIXEL_FORMATS = {f"Mono{bits}": bits for bits in (8, 10, 12, 14, 16)}


def _exposure(exposure_ns: int, device: str) -> int:
    if not EXPOSURE_MIN_NS <= exposure_ns <= EXPOSURE_MAX_NS:
        raise ConfigError(
            f"exposure {exposure_ns / 1e3:g} us lies outside {EXPOSURE_MIN_NS / 1e3:g} .. {EXPOSURE_MAX_NS / 1e3:g} us",
            device=device,
        )
    return exposure_ns // EXPOSURE_STEP_NS * EXPOSURE_STEP_NS


def _gain(gain_db: float, device: str) -> float:
    if not 0.0 <= gain_db <= GAIN_MAX_DB:
        raise ConfigError(f"gain {gain_db:g} dB lies outside 0 .. {GAIN_MAX_DB:g} dB", device=device)
    return float(gain_db)


def _bits(pixel_format: str, device: str) -> int:
    if pixel_format not in _PIXEL_FORMATS:
        raise ConfigError(
            f"no pixel format {pixel_format!r}", device=device, hint=f"it has {', '.join(_PIXEL_FORMATS)}"
        )
    return _PIXEL_FORMATS[pixel_format]
