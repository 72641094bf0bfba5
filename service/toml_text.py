"""Plain values as TOML text: the writing half that `tomllib` lacks, for rig files handed from process to process."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def to_toml(content: Mapping[str, Any], table: tuple[str, ...] = ()) -> str:
    """A table as text: its values, then its tables under headers of their own.

    Raises:
        TypeError: a value that TOML cannot hold (None, or no plain value at all).
    """
    lines = [f"[{'.'.join(map(_key, table))}]"] if table else []
    tables = {key: value for key, value in content.items() if isinstance(value, Mapping)}
    lines += [f"{_key(key)} = {_value(value)}" for key, value in content.items() if key not in tables]
    text = "\n".join(lines) + "\n" if lines else ""
    return text + "".join("\n" + to_toml(value, (*table, key)) for key, value in tables.items())


def _key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _string(key)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(_value, value)) + "]"
    if hasattr(value, "isoformat"):  # TOML's own dates and times
        return str(value.isoformat())
    raise TypeError(f"TOML has no {type(value).__name__}")


def _string(text: str) -> str:
    # A JSON string is a TOML basic string, but for one control character that JSON leaves as it is.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007F")
