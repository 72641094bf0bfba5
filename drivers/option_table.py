"""A rig file's table of driver options, read into a typed model, with errors that name the key and what would fit."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from scanner.errors import ConfigError


class Options(BaseModel):
    """Root of the option models: no unknown keys, never changed."""

    model_config = ConfigDict(extra="forbid", frozen=True)


_M = TypeVar("_M", bound=Options)


def read_options(model: type[_M], options: Mapping[str, Any], device: str) -> _M:
    """`options` as `model`.

    Raises:
        ConfigError: an unknown key (with a suggestion and the list), or a value that does not fit.
    """
    try:
        return model.model_validate(dict(options))
    except ValidationError as error:
        raise _error_of(error.errors(include_url=False)[0], model, device) from error


def option_problems(model: type[Options], options: Mapping[str, Any], device: str) -> list[tuple[str, ConfigError]]:
    """All that `read_options` would refuse, one by one: (option, error)."""
    try:
        model.model_validate(dict(options))
    except ValidationError as error:
        found: dict[str, ConfigError] = {}
        for detail in error.errors(include_url=False):  # of one option the first error: others follow from it
            found.setdefault(_key(detail), _error_of(detail, model, device))
        return list(found.items())
    return []


def _key(detail: ErrorDetails) -> str:
    """The option's own name: what lies deeper within its value is wrong with it as a whole."""
    return str(detail["loc"][0]) if detail["loc"] else ""


def _error_of(detail: ErrorDetails, model: type[Options], device: str) -> ConfigError:
    key = ".".join(part for part in detail["loc"] if isinstance(part, str))
    if detail["type"] == "extra_forbidden":
        known = sorted(model.model_fields)
        near = get_close_matches(key, known, n=1)
        suggestion = f"did you mean {near[0]!r}? " if near else ""
        return ConfigError(f"unknown option {key!r}", device=device, hint=f"{suggestion}known: {', '.join(known)}")
    return ConfigError(
        f"option {key or 'table'}: {_expected(detail)}, got {detail['input']!r}",
        device=device,
        hint="the driver's page in docs/how-to lists its options",
    )


_WORDS = (
    ("Input should be ", "takes "),
    ("Value error, ", ""),
    ("a valid tuple", "a list"),
    ("a valid list", "a list"),
    ("a valid dictionary", "a table"),
    ("Field required", "is missing"),
)


def _expected(detail: ErrorDetails) -> str:
    """What fits, in a rig file's words: it knows lists, and neither tuples nor fields."""
    if detail["type"] == "too_short":
        return f"takes a list of {detail['ctx']['min_length']} or more"
    if detail["type"] == "too_long":
        return f"takes a list of {detail['ctx']['max_length']} at most"
    said = detail["msg"].partition(", unable to parse")[0]
    for theirs, ours in _WORDS:
        said = said.replace(theirs, ours)
    return said
