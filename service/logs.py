"""Logging of the processes: standard logging, one JSON object a line on standard error."""

from __future__ import annotations

import json
import logging
import sys
from datetime import UTC, datetime
from unicodedata import category

_MOVING = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
"""Controls, formats (directions, what has no width), halves of pairs, separators of lines and paragraphs"""


def visible(text: str) -> str:
    """What others wrote, for a terminal or a log: characters that move, hide or turn what stands beside them escaped.

    Control characters, directions of writing (U+202E) and lone surrogates become \\uXXXX, as in JSON, which so stays
    what it was; ends of lines and tabs stay, letters of every script do.
    """
    if text.isprintable():
        return text
    return "".join(_escaped(c) if category(c) in _MOVING and c not in "\n\t" else c for c in text)


def _escaped(character: str) -> str:
    units = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[i : i + 2].hex()}" for i in range(0, len(units), 2))


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time, level, process, logger, message, and the exception where there is one."""

    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        """The record as a line."""
        content = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "process": self._process,
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            content["exception"] = self.formatException(record.exc_info)
        return visible(json.dumps(content, ensure_ascii=False))


def start_logging(process: str, level: int = logging.INFO) -> None:
    """Send everything to standard error; called once by a process's main function."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter(process))
    logging.basicConfig(level=level, handlers=[handler], force=True)
    logging.captureWarnings(True)
