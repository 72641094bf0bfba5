"""What a rig file says, as types: devices, calibration, daemon. Every field has a unit and bounds (formats.md, Rig).

Paths are relative to the rig file. Reading files, and saying what is wrong with them, is `service.config`'s.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo, model_validator
from pydantic_core import PydanticCustomError

from scanner.endpoints import DEFAULT_ENDPOINT, ipc_path
from scanner.errors import ScannerError
from service.toml_text import to_toml

SAID = "said"
"""Type of an error whose words are for the reader as they stand"""


def _range(value: Any) -> Any:
    """A number, or [low, high], as (low, high)."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return (float(value), float(value))
    if isinstance(value, list | tuple) and len(value) == 2 and all(type(v) in (int, float) for v in value):
        if value[0] > value[1]:
            raise PydanticCustomError(SAID, "the wrong way round: a range is [low, high], the smaller number first")
        return (float(value[0]), float(value[1]))
    return value


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _path(value: Any, info: ValidationInfo) -> Any:
    """A path, relative to the rig file."""
    if not isinstance(value, str) or not value:
        return value
    if "\0" in value:
        raise ValueError("no file has such a name")
    try:
        return (info.context or {}).get("folder", Path()) / Path(value).expanduser()
    except RuntimeError as error:  # "~name" without such a user, "~" without a home
        raise ValueError(str(error)) from error


def _endpoint(value: str) -> str:
    try:
        ipc_path(value)
    except ScannerError as error:
        raise ValueError(error.message) from error
    return value


RelativePath = Annotated[Path, BeforeValidator(_path)]
Microseconds = Annotated[float, Field(ge=0, le=10_000_000)]
MicrosecondRange = Annotated[tuple[Microseconds, Microseconds], BeforeValidator(_range)]
Pixel = Annotated[int, Field(ge=0, le=65_535)]
PixelCount = Annotated[int, Field(ge=1, le=65_535)]
Region = Annotated[tuple[Pixel, Pixel, PixelCount, PixelCount], BeforeValidator(_tuple)]


class Table(BaseModel):
    """A table of a rig file: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class RigSettings(Table):
    """`[rig]`."""

    name: str = Field(
        default="rig",
        min_length=1,
        max_length=100,
        description="a name for reports, 1 to 100 characters",
        json_schema_extra={"default in words": "the file's name without .toml"},
    )
    calibration: RelativePath | None = Field(default=None, description="path of a calibration file (JSON)")
    marks: RelativePath | None = Field(
        default=None, description="path of a file of witness marks (fringed calibrate marks), measured in each scan"
    )
    phase_axis: Literal["x", "y"] | None = Field(
        default=None, description='"x" (camera beside the projector) or "y" (above or below it)'
    )


class CameraSettingsConfig(Table):
    """`[camera.settings]`: what the camera is told before a run; absent leaves the device's value."""

    exposure_us: Annotated[float, Field(ge=1, le=10_000_000)] | Literal["auto"] | None = Field(
        default=None, description='exposure time in microseconds, 1 .. 10000000, or "auto"'
    )
    gain_db: float | None = Field(default=None, ge=0, le=48, description="gain in dB, 0 .. 48")
    pixel_format: str | None = Field(default=None, min_length=1, description='a pixel format of the camera, as "Mono8"')
    region: Region | None = Field(
        default=None, description="[x, y, width, height] in sensor pixels, width and height 1 or more"
    )
    trigger_mode: Literal["software", "free", "hardware"] | None = Field(
        default=None,
        description='"hardware" (trigger line), "software" or "free" (free run); without it the planner chooses',
    )


class CameraConfig(Table):
    """`[camera]`."""

    driver: str = Field(min_length=1, description="name of a camera driver; `fringed devices` lists them")
    device: str = Field(default="", description="text that says which camera, in the driver's words (empty: the first)")
    settings: CameraSettingsConfig = Field(default=CameraSettingsConfig(), description="a table [camera.settings]")
    options: dict[str, Any] = Field(default={}, description="a table of the driver's own options")


class ProjectorConfig(Table):
    """`[projector]`."""

    driver: str = Field(min_length=1, description="name of a projector driver; `fringed devices` lists them")
    device: str = Field(
        default="", description="text that says which projector, in the driver's words (empty: the first)"
    )
    mode: str | None = Field(
        default=None,
        pattern=r"^\d{2,5}x\d{2,5}(@\d{1,3}(\.\d+)?)?$",
        description='WIDTHxHEIGHT or WIDTHxHEIGHT@HZ, as "1920x1080@60"',
    )
    latency_us: MicrosecondRange | None = Field(
        default=None,
        description="measured time from flip to light in microseconds: a number or [low, high], 0 .. 10000000",
    )
    settle_us: MicrosecondRange | None = Field(
        default=None,
        description="measured time until all rows show the image, in microseconds: a number or [low, high]",
    )
    dwell: int | None = Field(default=None, ge=1, le=1000, description="refreshes a pattern stays on, 1 .. 1000")
    mirror: bool = Field(
        default=False, description="true or false (true for rear projection: left and right change places)"
    )
    rotate: Literal[0, 180] = Field(default=0, description="0, or 180 for a projector that hangs upside down")
    options: dict[str, Any] = Field(default={}, description="a table of the driver's own options")


class TriggerConfig(Table):
    """`[trigger]`."""

    driver: str = Field(min_length=1, description="name of a trigger driver; `fringed devices` lists them")
    device: str = Field(default="", description="text that says which board, in the driver's words (empty: the first)")
    options: dict[str, Any] = Field(default={}, description="a table of the driver's own options")


class RetentionConfig(Table):
    """`[daemon.retention]`: when captures leave the spool. One not yet decoded or fetched never does."""

    max_age_days: float | None = Field(default=None, gt=0, le=36_500, description="days, more than 0")
    min_free_gb: float = Field(
        default=1.0, ge=0, le=1_000_000, description="gigabytes to be left free on the disk, 0 or more"
    )


class DaemonConfig(Table):
    """`[daemon]`."""

    endpoint: Annotated[str, AfterValidator(_endpoint)] = Field(
        default=DEFAULT_ENDPOINT,
        description="ipc:// and the absolute path of a socket, 100 bytes at most (no TCP before encryption)",
    )
    spool: RelativePath | None = Field(default=None, description="path of the folder that captures are written to")
    spool_limit_gb: float | None = Field(default=None, gt=0, le=1_000_000, description="gigabytes, more than 0")
    retention: RetentionConfig = Field(default=RetentionConfig(), description="a table [daemon.retention]")
    client_keys: RelativePath | None = Field(
        default=None,
        description="path of the folder of clients' public keys, for encrypted endpoints; not used yet",
    )
    workers: int = Field(
        default=1,
        ge=0,
        le=64,
        description="decode workers to start, 0 .. 64 (0: only those started by `fringed worker`)",
    )


class RigConfig(Table):
    """A rig: devices, their calibration, and the daemon that drives them."""

    rig: RigSettings = Field(default=RigSettings(), description="a table [rig]")
    camera: CameraConfig = Field(description="a table [camera] with a driver")
    projector: ProjectorConfig = Field(description="a table [projector] with a driver")
    trigger: TriggerConfig | None = Field(default=None, description="a table [trigger] with a driver")
    daemon: DaemonConfig = Field(default=DaemonConfig(), description="a table [daemon]")

    @model_validator(mode="before")
    @classmethod
    def _named_after_its_file(cls, content: Any, info: ValidationInfo) -> Any:
        stem = (info.context or {}).get("stem")
        if not stem or not isinstance(content, dict) or not isinstance(content.get("rig", {}), dict):
            return content
        return {**content, "rig": {"name": stem, **content.get("rig", {})}}

    def as_toml(self) -> str:
        """The rig as a file's text, paths absolute: what `load_rig` reads back as the same rig."""
        return to_toml(self.model_dump(mode="json", exclude_none=True))

    def with_exposure(self, exposure: float | Literal["auto"]) -> Self:
        """The same rig with another exposure, microseconds or "auto"."""
        settings = self.camera.settings.model_copy(update={"exposure_us": exposure})
        return self.model_copy(update={"camera": self.camera.model_copy(update={"settings": settings})})
