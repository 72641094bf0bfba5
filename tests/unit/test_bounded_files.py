"""Small files from anywhere: what has no end, no writer or no bound is refused before it is read."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from scanner.bounded_files import MAX_SMALL_BYTES, read_small, read_small_text
from scanner.calibration.marks import load_marks
from scanner.calibration.targets import load_discs
from scanner.capture import Capture, CaptureHeader
from scanner.errors import ScannerError
from scanner.geometry import load_calibration
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize
from scanner.scan_report import read_report
from service.config import load_rig


def fifo(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def sparse(path: Path) -> None:
    path.touch()
    os.truncate(path, 30 << 30)


def capture_of(path: Path) -> None:
    Capture.open(path.parent)


def records_of(path: Path) -> None:
    """capture.json beside it is sound."""
    sequence = PatternSequence.bracketed(ProjectorSize(64, 48), PmpPattern(frequencies=(1.0, 4.0), shifts=(3, 4)))
    header = CaptureHeader(sequence, CameraFormat(20, 10), state="open")
    (path.parent / "capture.json").write_text(json.dumps(header.as_dict()))
    Capture.open(path.parent)


SPOILT = pytest.mark.parametrize(
    ("spoil", "says"),
    [(fifo, "regular file"), (device, "regular file"), (sparse, "larger than such a file may be")],
)


@SPOILT
@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("capture.json", capture_of),
        ("frames.jsonl", records_of),
        ("frames.npy", records_of),
        ("calibration.json", load_calibration),
        ("report.json", read_report),
        ("marks.json", load_marks),
        ("target.json", load_discs),
        ("rig.toml", load_rig),
    ],
)
def test_what_has_no_end_is_refused_by_name(
    name: str, read: Callable[[Path], Any], spoil: Callable[[Path], None], says: str, tmp_path: Path
) -> None:
    if (name, spoil) == ("frames.npy", sparse):
        says = "not a NumPy array file"
    path = tmp_path / name
    spoil(path)
    with pytest.raises(ScannerError, match=says) as refused:
        read(path)
    assert name in str(refused.value)


def test_a_regular_file_is_read_through_a_link_and_up_to_the_limit(tmp_path: Path) -> None:
    path, link = tmp_path / "a", tmp_path / "b"
    path.write_bytes(b"\xef\xbb\xbf1\r\n2")
    link.symlink_to(path)
    assert read_small(link, 7) == b"\xef\xbb\xbf1\r\n2"
    assert read_small_text(link, 7, "utf-8-sig") == "1\n2"
    with pytest.raises(OSError, match="larger"):
        read_small(link, 6)
    with pytest.raises(IsADirectoryError):
        read_small(tmp_path)
    assert read_small(Path("/proc/self/stat"), MAX_SMALL_BYTES)  # its size is said to be 0
