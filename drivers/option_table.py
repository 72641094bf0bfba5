"""A rig file's table of driver options, read into a typed model, with errors that name the key and what would fit."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

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
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            known = sorted(model.model_fields)
            near = get_close_matches(key, known, n=1)
            suggestion = f"did you mean {near[0]!r}? " if near else ""
            raise ConfigError(
                f"unknown option {key!r}", device=device, hint=f"{suggestion}known: {', '.join(known)}"
            ) from error
        raise ConfigError(
            f"option {key or 'table'}: {first['msg']}, got {first['input']!r}",
            device=device,
            hint="the driver's page in docs/how-to lists its options",
        ) from error
