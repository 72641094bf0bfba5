"""Rig files: devices, calibration and daemon settings in one TOML file, checked (formats.md, Rig).

Every field has a unit and bounds; an unknown key is an error with a suggestion. Errors name file, line, key, value
and what was expected, all of them at once. Paths are relative to the rig file. Opens no device.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import ErrorDetails

from drivers.registry import Kind, check_driver
from scanner.errors import ConfigError, ScannerError
from scanner.wire import DEFAULT_ENDPOINT, ipc_path
from service.toml_lines import KeyPath, key_lines
from service.toml_text import to_toml

DEFAULT_SIMULATED = "casey2011/bust"

MAX_FILE_BYTES = 1 << 20


def load_rig(name: str | Path) -> RigConfig:
    """A rig by the path of its file, or `simulated[:DEVICE]` for the built-in one without hardware.

    Raises:
        ConfigError: the file cannot be read, or holds errors: all of them, one a line.
    """
    text = str(name)
    if is_simulated(text):
        return simulated_rig(text.removeprefix("simulated").removeprefix(":") or DEFAULT_SIMULATED)
    rig, problems = check_rig(Path(name))
    if rig is None:
        raise ConfigError(
            "\n".join(str(problem) for problem in problems),
            hint="fringed check-config FILE checks a rig file; the documentation lists every key (rig-file)",
        )
    return rig


def is_simulated(name: str) -> bool:
    """Whether a rig's name means the built-in one, and no file."""
    return name == "simulated" or name.startswith("simulated:")


def simulated_rig(device: str = DEFAULT_SIMULATED) -> RigConfig:
    """The built-in rig: simulated camera and projector that share the world `device` (RIG/SCENE?option=value)."""
    return RigConfig(
        rig=RigSettings(name="simulated"),
        camera=CameraConfig(driver="simulated", device=device),
        projector=ProjectorConfig(driver="simulated", device=device),
    )


def check_rig(path: Path) -> tuple[RigConfig | None, list[Problem]]:
    """A rig file's content, or everything that is wrong with it.

    Raises:
        ConfigError: the file cannot be read at all.
    """
    text = _read(path)
    try:
        content = tomllib.loads(text)
        lines = key_lines(text)
    except tomllib.TOMLDecodeError as error:
        return None, [Problem(str(path), _line_in(str(error)), "", None, f"TOML: {error}")]
    except RecursionError:
        return None, [Problem(str(path), None, "", None, "nested too deeply for a rig file")]
    try:
        rig = RigConfig.model_validate(content, context={"folder": path.absolute().parent, "stem": path.stem})
    except ValidationError as error:
        return None, _sorted(_problems(error, content, lines, str(path)))
    problems = _sorted(_unusable(rig, content, lines, str(path)))
    return (None if problems else rig), problems


@dataclass(frozen=True)
class Problem:
    """One thing wrong with a rig file."""

    file: str
    line: int | None
    key: str
    """dotted; empty where the text is no TOML"""
    value: Any
    """as it stands in the file; None for a missing key"""
    expected: str

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else self.file
        if not self.key:
            return f"{place}: {self.expected}"
        shown = "" if self.value is None else f" = {_short(self.value)}"
        return f"{place}: {self.key}{shown}: {self.expected}"


# --- the model ----------------------------------------------------------------------------------------------------


def _range(value: Any) -> Any:
    """A number, or [low, high], as (low, high)."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return (float(value), float(value))
    if isinstance(value, list | tuple) and len(value) == 2 and all(type(v) in (int, float) for v in value):
        if value[0] > value[1]:
            raise ValueError("upside down")
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


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class RigSettings(_Table):
    """`[rig]`."""

    name: str = Field(
        default="rig", min_length=1, max_length=100, description="a name for reports, 1 to 100 characters"
    )
    calibration: RelativePath | None = Field(default=None, description="path of a calibration file (JSON)")
    marks: RelativePath | None = Field(
        default=None, description="path of a file of witness marks (fringed calibrate marks), measured in each scan"
    )
    phase_axis: Literal["x", "y"] | None = Field(
        default=None, description='"x" (camera beside the projector) or "y" (above or below it)'
    )


class CameraSettingsConfig(_Table):
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


class CameraConfig(_Table):
    """`[camera]`."""

    driver: str = Field(min_length=1, description="name of a camera driver; `fringed devices` lists them")
    device: str = Field(default="", description="text that says which camera, in the driver's words (empty: the first)")
    settings: CameraSettingsConfig = Field(default=CameraSettingsConfig(), description="a table [camera.settings]")
    options: dict[str, Any] = Field(default={}, description="a table of the driver's own options")


class ProjectorConfig(_Table):
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


class TriggerConfig(_Table):
    """`[trigger]`."""

    driver: str = Field(min_length=1, description="name of a trigger driver; `fringed devices` lists them")
    device: str = Field(default="", description="text that says which board, in the driver's words (empty: the first)")
    options: dict[str, Any] = Field(default={}, description="a table of the driver's own options")


class RetentionConfig(_Table):
    """`[daemon.retention]`: when captures leave the spool. One not yet decoded or fetched never does."""

    max_age_days: float | None = Field(default=None, gt=0, le=36_500, description="days, more than 0")
    min_free_gb: float = Field(
        default=1.0, ge=0, le=1_000_000, description="gigabytes to be left free on the disk, 0 or more"
    )


class DaemonConfig(_Table):
    """`[daemon]`."""

    endpoint: Annotated[str, AfterValidator(_endpoint)] = Field(
        default=DEFAULT_ENDPOINT,
        description="ipc:// and the absolute path of a socket, 100 bytes at most (no TCP before encryption)",
    )
    spool: RelativePath | None = Field(default=None, description="path of the folder that captures are written to")
    spool_limit_gb: float | None = Field(default=None, gt=0, le=1_000_000, description="gigabytes, more than 0")
    retention: RetentionConfig = Field(default=RetentionConfig(), description="a table [daemon.retention]")
    client_keys: RelativePath | None = Field(default=None, description="path of the folder of clients' public keys")
    workers: int = Field(
        default=1, ge=0, le=64, description="decode workers to start, 0 .. 64 (0: only those of other hosts)"
    )


class RigConfig(_Table):
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


# --- what is wrong, and where -------------------------------------------------------------------------------------


def _problems(
    error: ValidationError, content: Mapping[str, Any], lines: Mapping[KeyPath, int], file: str
) -> Iterator[Problem]:
    seen: set[KeyPath] = set()
    for detail in error.errors(include_url=False):
        path = _in_document(detail, lines)
        if path in seen:  # a union gives one error for each of its members
            continue
        seen.add(path)
        if detail["type"] == "extra_forbidden":
            expected = "unknown key" + _suggestion(path)
            value = None
        elif path not in lines:
            expected = f"is missing: expected {_description(path)}"
            value = None
        else:
            expected = f"expected {_description(path)}"
            value = _value_at(content, path)
        yield Problem(file, _line_of(path, lines), ".".join(str(key) for key in path), value, expected)


def _unusable(rig: RigConfig, content: Mapping[str, Any], lines: Mapping[KeyPath, int], file: str) -> Iterator[Problem]:
    """What a well-formed rig file names that is not there."""
    kinds: tuple[Kind, ...] = ("camera", "projector", "trigger")
    for kind in kinds:
        if kind not in content:
            continue
        path = (kind, "driver")
        try:
            check_driver(kind, _value_at(content, path))
        except ConfigError as error:
            expected = f"{error.message}; {error.hint}"
            yield Problem(file, _line_of(path, lines), ".".join(path), _value_at(content, path), expected)
    places: tuple[tuple[KeyPath, Path | None], ...] = (
        (("rig", "calibration"), rig.rig.calibration),
        (("daemon", "spool"), rig.daemon.spool),
    )
    for place, named in places:
        if named is not None and (wrong := _wrong_path(named, folder=place[-1] == "spool")):
            yield Problem(file, _line_of(place, lines), ".".join(map(str, place)), _value_at(content, place), wrong)


def _wrong_path(path: Path, *, folder: bool) -> str:
    """Why a path does not serve as a file, or as a folder that may yet be made; empty where it does."""
    try:
        if folder:
            return f"{path} is not a folder" if path.exists() and not path.is_dir() else ""
        return "" if path.is_file() else f"there is no file {_cut(str(path))}"
    except OSError as error:
        return f"cannot be looked at: {error.strerror}"


def _in_document(detail: ErrorDetails, lines: Mapping[KeyPath, int]) -> KeyPath:
    """The error's place without the names of union members that pydantic adds at its end."""
    place: KeyPath = tuple(detail["loc"])
    if detail["type"] == "missing" and isinstance(place[-1], str):
        return place
    while place and place not in lines:
        place = place[:-1]
    # A number in an array of a fixed meaning (a region, a range) is wrong as a whole.
    while place and isinstance(place[-1], int):
        place = place[:-1]
    return place


def _line_of(path: KeyPath, lines: Mapping[KeyPath, int]) -> int | None:
    while path and path not in lines:
        path = path[:-1]
    return lines.get(path)


def _value_at(content: Any, path: KeyPath) -> Any:
    for key in path:
        content = content[key]
    return content


def _table(path: KeyPath) -> type[_Table] | None:
    """The model of the table at `path`; None where there is none or it is free."""
    model: type[_Table] | None = RigConfig
    for key in path:
        field = model.model_fields.get(str(key)) if model is not None else None
        model = next(iter(_models_in(field.annotation)), None) if field is not None else None
    return model


def _models_in(annotation: Any) -> Iterator[type[_Table]]:
    for candidate in (annotation, *getattr(annotation, "__args__", ())):
        if isinstance(candidate, type) and issubclass(candidate, _Table):
            yield candidate


def _description(path: KeyPath) -> str:
    model = _table(path[:-1])
    field = model.model_fields.get(str(path[-1])) if model is not None and path else None
    return (field.description if field is not None else None) or "something else"


def _suggestion(path: KeyPath) -> str:
    model = _table(path[:-1])
    names = list(model.model_fields) if model is not None else []
    near = get_close_matches(str(path[-1]), names, n=1)
    if near:
        return f"; did you mean {near[0]!r}?"
    elsewhere = [place for place in _places_of(str(path[-1])) if place[:-1] != path[:-1]]
    if elsewhere:
        return f"; it belongs into [{'.'.join(elsewhere[0][:-1])}]"
    return f"; known here: {', '.join(names)}" if names else ""


def _places_of(name: str, within: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    model = _table(within)
    for key in model.model_fields if model is not None else ():
        if key == name:
            yield (*within, key)
        if _table((*within, key)) is not None:
            yield from _places_of(name, (*within, key))


def _sorted(problems: Iterator[Problem]) -> list[Problem]:
    return sorted(problems, key=lambda problem: problem.line or math.inf)


def _short(value: Any) -> str:
    shown = to_toml({"k": value}).removeprefix("k = ").strip() if not isinstance(value, Mapping) else "{...}"
    return shown if len(shown) <= 60 else shown[:57] + "..."


def _cut(text: str) -> str:
    return text if len(text) <= 120 else text[:117] + "..."


def _line_in(message: str) -> int | None:
    """The line in a message of tomllib: "... (at line 3, column 7)"."""
    _, found, rest = message.rpartition("(at line ")
    return int(rest.split(",")[0]) if found else None


def _read(path: Path) -> str:
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ConfigError(f"{path} is larger than a rig file can be", hint="is it another file?")
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise ConfigError(f"there is no rig file {path}", hint="--rig simulated needs no file") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not text in UTF-8, so it is no rig file") from error
    except OSError as error:
        raise ConfigError(f"cannot read {_cut(str(path))}: {error.strerror}") from error
