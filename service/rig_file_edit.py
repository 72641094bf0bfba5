"""Values put into a rig file as it stands: comments, order and spelling stay, and a copy of what was is kept.

It changes single `key = value` lines of one table and nothing else; what is written otherwise (inline tables, dotted
keys, values over several lines) is left to its owner, in words.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from scanner.errors import ConfigError
from scanner.storage import replace_file
from service.config import check_rig


def set_values(path: Path, table: str, values: Mapping[str, Sequence[int] | str]) -> Path:
    """Set integer pairs and texts in `[table]`, each on a line of its own; returns the copy of what was before.

    Raises:
        ConfigError: the table has no header of its own, or the file would not be a rig file any more.
        StorageError: it cannot be written.
    """
    before = path.read_text(encoding="utf-8")
    lines = before.splitlines()
    begin = next((i for i, line in enumerate(lines) if re.fullmatch(rf"\s*\[\s*{table}\s*\]\s*(#.*)?", line)), None)
    if begin is None:
        raise ConfigError(
            f"{path} has no header [{table}] of its own",
            hint=f"write into its {table}: {_words(values)}",
        )
    end = next((i for i in range(begin + 1, len(lines)) if lines[i].lstrip().startswith("[")), len(lines))
    for key, value in reversed(list(values.items())):
        new = f"{key} = {_written(value)}"
        place = next((i for i in range(begin + 1, end) if re.match(rf"\s*{key}\s*=", lines[i])), None)
        if place is not None:
            lines[place] = new
        else:
            lines.insert(begin + 1, new)
            end += 1
    kept = path.with_name(path.name + ".before")
    replace_file(kept, before.encode())
    replace_file(path, ("\n".join(lines) + "\n").encode())
    if check_rig(path)[1]:
        replace_file(path, before.encode())
        raise ConfigError(f"{path} could not be changed by line", hint=f"write into its {table}: {_words(values)}")
    return kept


def _words(values: Mapping[str, Sequence[int] | str]) -> str:
    return "; ".join(f"{key} = {_written(value)}" for key, value in values.items())


def _written(value: Sequence[int] | str) -> str:
    # What JSON writes of a text is a basic string of TOML too.
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else f"[{', '.join(map(str, value))}]"
