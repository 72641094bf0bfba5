"""Rig files, read and checked: devices, calibration and daemon settings in one TOML file (formats.md, Rig).

What may stand in one is `service.rig_model`. An unknown key is an error with a suggestion. Errors name file, line, key,
value and what was expected, all of them at once. Opens no device.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from drivers.registry import Kind, check_driver
from scanner.errors import ConfigError
from service.rig_model import CameraConfig, ProjectorConfig, RigConfig, RigSettings, Table
from service.toml_lines import KeyPath, key_lines
from service.toml_text import to_toml

__all__ = ["Problem", "RigConfig", "check_rig", "is_simulated", "load_rig", "simulated_rig"]

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


def _table(path: KeyPath) -> type[Table] | None:
    """The model of the table at `path`; None where there is none or it is free."""
    model: type[Table] | None = RigConfig
    for key in path:
        field = model.model_fields.get(str(key)) if model is not None else None
        model = next(iter(_models_in(field.annotation)), None) if field is not None else None
    return model


def _models_in(annotation: Any) -> Iterator[type[Table]]:
    for candidate in (annotation, *getattr(annotation, "__args__", ())):
        if isinstance(candidate, type) and issubclass(candidate, Table):
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
