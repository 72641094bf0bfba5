"""A series: capture folders of one endless recording, one after the other, and the list of them in series.json.

    {"format": "fringed-series", "version": 1, "id": "...", "state": "open | complete | failed", "reason": "...",
     "frames": 700, "captures": [{"folder": "000000", "first": 0, "frames": 256}, ...]}

`first` is the number of a folder's first frame in the run. While a recording is open its last folder counts 0 frames.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scanner.bounded_files import read_small_text
from scanner.errors import DecodeError

FORMAT = "fringed-series"
VERSION = 1
SERIES_FILE = "series.json"
HEADER_FILE = "capture.json"


@dataclass(frozen=True)
class SeriesFolder:
    """One capture folder of a series, and the number of its first frame."""

    path: Path
    first: int


def segment_name(index: int) -> str:
    """Name of a series' folder by its number, so that names sort as the numbers do."""
    return f"{index:06d}"


def series_content(
    series_id: str, captures: Sequence[tuple[int, int, int]], state: str, reason: str | None
) -> dict[str, Any]:
    """series.json as plain data; captures: (number of the folder, first frame, frames)."""
    listed = [{"folder": segment_name(index), "first": first, "frames": frames} for index, first, frames in captures]
    return {
        "format": FORMAT,
        "version": VERSION,
        "id": series_id,
        "state": state,
        "reason": reason,
        "frames": sum(frames for _, _, frames in captures),
        "captures": listed,
    }


def recording_at(path: Path) -> list[SeriesFolder] | None:
    """The capture folders of a live recording: of its series, or the one folder given. None: a capture of a scan.

    Raises:
        DecodeError: series.json is damaged.
    """
    if (path / SERIES_FILE).is_file():
        return read_series(path)
    file = path / HEADER_FILE if path.is_dir() else path
    try:
        content = json.loads(read_small_text(file))
        return [SeriesFolder(file.parent, int(content["live"]["first"]))]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None  # whatever is wrong with it, the reader of captures says it better


def read_series(folder: Path) -> list[SeriesFolder]:
    """The capture folders of a series, in order. An interrupted series has those that are there.

    Raises:
        DecodeError: no series.json, or it is damaged or names what lies outside of the folder.
    """
    path = folder / SERIES_FILE
    try:
        content = json.loads(read_small_text(path))
        if not isinstance(content, dict) or content.get("format") != FORMAT or content.get("version") != VERSION:
            raise DecodeError(f"{path} is no version {VERSION} of {FORMAT}", hint="update fringed")
        found = [SeriesFolder(folder / str(c["folder"]), int(c["first"])) for c in content["captures"]]
    except OSError as error:
        raise DecodeError(f"cannot read {path}: {error.strerror}", hint="give the folder of a recording") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise DecodeError(f"{path} is damaged: {error}") from error
    for each in found:
        if each.path.parent != folder or each.path.name in ("", ".", ".."):
            raise DecodeError(f"{path} names {each.path.name!r}, which is no folder beside it")
    return found
