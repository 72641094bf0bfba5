"""Rig files, read and checked: devices, calibration and daemon settings in one TOML file (formats.md, Rig).

What may stand in one is `service.rig_model`. An unknown key is an error with a suggestion. Errors name file, line, key,
value and what was expected, all of them at once. Opens no device; `service.rig_check` looks deeper.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from drivers.registry import Kind, check_driver
from scanner.bounded_files import read_small_text
from scanner.errors import ConfigError
from service.rig_model import SAID, CameraConfig, ProjectorConfig, RigConfig, RigSettings, Table
from service.toml_errors import syntax_problems
from service.toml_lines import KeyPath, key_lines
from service.toml_text import to_toml

__all__ = [
    "KINDS",
    "Problem",
    "RigConfig",
    "RigFile",
    "check_rig",
    "is_simulated",
    "load_rig",
    "read_rig",
    "simulated_rig",
]

DEFAULT_SIMULATED = "casey2011/bust"

MAX_FILE_BYTES = 1 << 20

KINDS: tuple[Kind, ...] = ("camera", "projector", "trigger")
"""Tables that name a driver"""


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
    file = read_rig(path)
    return (None if file.problems else file.rig), file.problems


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
    column: int | None = None
    """from 1; of text that is no TOML"""
    excerpt: str = ""
    """the line's text and a caret below the column, of text that is no TOML"""

    def __str__(self) -> str:
        place = ":".join(str(part) for part in (self.file, self.line, self.column) if part)
        if not self.key:
            return f"{place}: {self.expected}" + (f"\n{self.excerpt}" if self.excerpt else "")
        shown = "" if self.value is None else f" = {_short(self.value)}"
        return f"{place}: {self.key}{shown}: {self.expected}"


@dataclass(frozen=True)
class RigFile:
    """A rig file as it stands, and what is wrong with it."""

    path: Path
    rig: RigConfig | None
    """None where it cannot be one; there may be problems all the same"""
    problems: list[Problem]
    """in order of their lines"""
    content: Mapping[str, Any] = field(default_factory=dict)
    """the tables, as far as they can be read"""
    lines: Mapping[KeyPath, int] = field(default_factory=dict)

    def problem(self, path: KeyPath, expected: str) -> Problem:
        """Something wrong with the key at `path`."""
        key = ".".join(str(part) for part in path)
        return Problem(str(self.path), _line_of(path, self.lines), key, _value_at(self.content, path), expected)

    def sound(self, *path: str) -> Any:
        """The value at `path`; None where it is absent, or where it or a table around it has a problem."""
        keys = {".".join(path[: length + 1]) for length in range(len(path))}
        if any(problem.key in keys for problem in self.problems):
            return None
        return _value_at(self.content, path)


def read_rig(path: Path) -> RigFile:
    """Read a rig file, with everything that is wrong with it: of one that is no TOML, what the rest of it says, too.

    Raises:
        ConfigError: the file cannot be read at all.
    """
    text = _read(path)
    try:
        broken, rest = syntax_problems(text)
        content = {} if rest is None else tomllib.loads(rest)
        lines = {} if rest is None else key_lines(rest)
    except RecursionError:
        return RigFile(path, None, [Problem(str(path), None, "", None, "nested too deeply for a rig file")])
    problems = [Problem(str(path), one.line, "", None, f"TOML: {one.said}", one.column, one.excerpt) for one in broken]
    if rest is None:
        return RigFile(path, None, problems)
    rig = None
    try:
        rig = RigConfig.model_validate(content, context={"folder": path.absolute().parent, "stem": path.stem})
    except ValidationError as error:
        problems += _problems(error, content, lines, str(path), whole=not broken)
    file = RigFile(path, None if problems else rig, problems, content, lines)
    return RigFile(path, file.rig, _sorted([*problems, *_unusable(file)]), content, lines)


def _problems(
    error: ValidationError, content: Mapping[str, Any], lines: Mapping[KeyPath, int], file: str, *, whole: bool
) -> Iterator[Problem]:
    """whole: no line was left out, so that what is missing is missing."""
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
            if not whole:
                continue
            expected = f"is missing: expected {_description(path)}"
            value = None
        else:
            expected = detail["msg"] if detail["type"] == SAID else f"expected {_description(path)}"
            value = _value_at(content, path)
        yield Problem(file, _line_of(path, lines), ".".join(str(key) for key in path), value, expected)


def _unusable(file: RigFile) -> Iterator[Problem]:
    """What a rig file names that is not there, of all that is well-formed in it."""
    for kind in KINDS:
        driver = file.sound(kind, "driver")
        if driver is None:
            continue
        try:
            check_driver(kind, driver)
        except ConfigError as error:
            yield file.problem((kind, "driver"), f"{error.message}; {error.hint}")
    for table, key in (("rig", "calibration"), ("rig", "marks"), ("daemon", "spool")):
        named = file.sound(table, key)
        if named is None:
            continue
        path = file.path.absolute().parent / Path(named).expanduser()
        if wrong := _wrong_path(path, folder=key == "spool"):
            yield file.problem((table, key), wrong)


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
    """None where there is none."""
    for key in path:
        if isinstance(content, list) and isinstance(key, int):
            content = content[key]
        elif isinstance(content, Mapping):
            content = content.get(key)
        else:
            return None
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


def _sorted(problems: Iterable[Problem]) -> list[Problem]:
    return sorted(problems, key=lambda problem: problem.line or math.inf)


def _short(value: Any) -> str:
    shown = to_toml({"k": value}).removeprefix("k = ").strip() if not isinstance(value, Mapping) else "{...}"
    return shown if len(shown) <= 60 else shown[:57] + "..."


def _cut(text: str) -> str:
    return text if len(text) <= 120 else text[:117] + "..."


def _read(path: Path) -> str:
    try:
        return read_small_text(
            path, MAX_FILE_BYTES, encoding="utf-8-sig"
        )  # some editors write a byte order mark: it is no text
    except FileNotFoundError as error:
        raise ConfigError(f"there is no rig file {path}", hint="--rig simulated needs no file") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not text in UTF-8, so it is no rig file", hint="save it as UTF-8") from error
    except OSError as error:
        raise ConfigError(f"cannot read {_cut(str(path))}: {error.strerror}", hint="is it another file?") from error
