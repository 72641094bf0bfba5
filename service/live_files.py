"""A live recording in the spool, as the daemon sees it: what of it is listed for fetching, and room for what follows.

No pixel is looked at; digests of whole files are taken once, when the run is over.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scanner.series import SERIES_FILE, series_content
from scanner.storage import replace_json, storage_errors
from scanner.wire import FileEntry
from service.jobs import Job
from service.pipe import Kept
from service.series import recorded_files
from service.spool import Spool


def reserve(spool: Spool, kept: Kept, jobs: Sequence[Job]) -> list[Job]:
    """Room for as much again as one folder of the recording took; returns the jobs whose files went for it.

    Raises:
        StorageError: there is none.
    """
    folders = max(1, kept.frames // 256)
    return spool.make_room(kept.bytes // folders, jobs)


def close_recording(folder: Path, reason: str) -> list[FileEntry]:
    """Tidy up what a crash left: the last folder keeps its whole frames, one without any goes. Returns the files.

    Raises:
        StorageError: the folder cannot be read or written.
    """
    if not folder.is_dir():
        return []
    with storage_errors(folder):
        found = [path for path in sorted(folder.iterdir()) if path.is_dir()]
        segments: list[tuple[int, int, int]] = []
        for path in found:
            header = _header(path)
            lines = _whole_lines(path)
            if header is None or lines == 0:
                shutil.rmtree(path)
                continue
            if header.get("state") == "open":
                _trim(path, header, lines)
            segments.append((int(path.name), int(header.get("live", {}).get("first", 0)), lines))
        if not segments:
            shutil.rmtree(folder)
            return []
    replace_json(folder / SERIES_FILE, series_content(folder.parent.name, segments, "failed", reason))
    return recorded_files(folder)


def _trim(folder: Path, header: dict[str, Any], lines: int) -> None:
    """Cut off what was reserved beyond the frames that have a line; the folder stays `open`: it was interrupted."""
    camera, path = header["camera"], folder / "frames.npy"
    each = camera["width"] * camera["height"] * (1 if camera.get("bits", 8) <= 8 else 2)
    with path.open("rb") as file:
        head = 10 + int.from_bytes(file.read(10)[8:10], "little")
    os.truncate(path, min(path.stat().st_size, head + lines * each))


def _header(folder: Path) -> dict[str, Any] | None:
    try:
        content = json.loads((folder / "capture.json").read_bytes())
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def _whole_lines(folder: Path) -> int:
    try:
        return (folder / "frames.jsonl").read_bytes().count(b"\n")
    except OSError:
        return 0
