"""Values put into a rig file as it stands: comments, order and spelling stay, and a copy of what was is kept.

It changes single `key = value` lines of one table and nothing else; what is written otherwise (inline tables, dotted
keys, values over several lines) is left to its owner, in words. What comes out is read back before it is believed.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

from scanner.errors import ConfigError, StorageError
from scanner.storage import replace_file, storage_errors
from service.toml_text import to_toml

Value = Sequence[int] | str


def set_values(path: Path, table: str, values: Mapping[str, Value]) -> Path:
    """Set values in `[table]`, each on a line of its own; returns the copy of what was before.

    A link is followed: what it points at is changed.

    Raises:
        ConfigError: the table has no header of its own, or the file cannot be changed by line.
        StorageError: it cannot be read or written, or is read-only.
    """
    path = path.resolve()
    with storage_errors(path):
        before = path.read_bytes()
        if not os.access(path, os.W_OK) or not path.stat().st_mode & 0o200:
            raise StorageError(f"{path} is read-only", hint=f"write into its [{table}]: {_words(values)}")
    text = before.decode("utf-8-sig")
    after = _changed(text, table, values)
    if after is None or not _is(text, after, table, values):
        raise ConfigError(f"{path} cannot be changed by line", hint=f"write into its [{table}]: {_words(values)}")
    kept = path.with_name(path.name + ".before")
    replace_file(kept, before)
    replace_file(path, after.encode())
    return kept


def _changed(text: str, table: str, values: Mapping[str, Value]) -> str | None:
    """The text with the values, its line ends kept; None where the table has no header."""
    end_of_line = "\r\n" if "\r\n" in text else "\n"
    lines = text.split(end_of_line)
    begin = next((i for i, line in enumerate(lines) if re.fullmatch(rf"\s*\[\s*{table}\s*\]\s*(#.*)?", line)), None)
    if begin is None:
        return None
    end = next((i for i in range(begin + 1, len(lines)) if lines[i].lstrip().startswith("[")), len(lines))
    for key, value in reversed(list(values.items())):
        new = to_toml({key: value}).rstrip("\n")
        place = next((i for i in range(begin + 1, end) if re.match(rf"\s*{key}\s*=", lines[i])), None)
        if place is not None:
            _, hash_sign, comment = lines[place].partition("#")
            lines[place] = f"{new}  #{comment}" if hash_sign else new
        else:
            lines.insert(begin + 1, new)
            end += 1
    return end_of_line.join(lines)


def _is(before: str, after: str, table: str, values: Mapping[str, Value]) -> bool:
    """Whether the new text says these values, and else what the old one says."""
    try:
        wanted, found = tomllib.loads(before), tomllib.loads(after)
    except tomllib.TOMLDecodeError:
        return False
    plain = {key: value if isinstance(value, str) else list(value) for key, value in values.items()}
    wanted[table] = {**wanted.get(table, {}), **plain}
    return bool(wanted == found)


def _words(values: Mapping[str, Value]) -> str:
    return to_toml(dict(values)).strip().replace("\n", "; ")
