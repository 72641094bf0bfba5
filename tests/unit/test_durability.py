"""What is written lasts: bytes are on the disk before their name is, and the name before anybody is told.

No power can be cut here: the order of the calls is what is looked at.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from scanner.capture import CaptureHeader, CaptureWriter, FrameRecord, close_interrupted
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize
from scanner.storage import replace_file

CAMERA = CameraFormat(20, 10, 8)
HEADER = CaptureHeader(
    PatternSequence(ProjectorSize(64, 48), PmpPattern(frequencies=(1.0,), shifts=(3,))), CAMERA, id="t"
)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of what was forced to the disk ("sync NAME") and of what took its place ("name NAME"), in order."""
    made: list[str] = []
    replace = Path.replace

    def sync(descriptor: int) -> None:
        made.append(f"sync {Path(f'/proc/self/fd/{descriptor}').readlink().name}")

    def name(path: Path, target: Path) -> Path:
        made.append(f"name {Path(target).name}")
        return replace(path, target)

    monkeypatch.setattr(os, "fsync", sync)
    monkeypatch.setattr(os, "fdatasync", sync)
    monkeypatch.setattr(Path, "replace", name)
    return made


def in_order(calls: list[str], *wanted: str) -> bool:
    rest = iter(calls)
    return all(any(call == one for call in rest) for one in wanted)


def test_a_file_is_on_the_disk_before_it_has_its_name_and_the_name_after(tmp_path: Path, calls: list[str]) -> None:
    replace_file(tmp_path / "report.json", b"{}")
    assert in_order(calls, "sync .report.json.tmp", "name report.json", f"sync {tmp_path.name}"), calls


def open_capture(folder: Path) -> CaptureWriter:
    writer = CaptureWriter(folder, HEADER, 3)
    slot, xxh3 = writer.write(np.zeros(CAMERA.shape, np.uint8))
    writer.record(FrameRecord(slot, 0, xxh3=xxh3))
    return writer


def test_frames_and_their_lines_are_on_the_disk_before_the_capture_is_complete(
    tmp_path: Path, calls: list[str]
) -> None:
    writer = open_capture(tmp_path / "c")
    calls.clear()
    writer.close("complete")
    for part in ("frames.npy", "frames.jsonl"):
        assert in_order(calls, f"sync {part}", "name capture.json", "sync c"), calls


def test_an_interrupted_capture_is_counted_on_the_disk_before_it_says_so(tmp_path: Path, calls: list[str]) -> None:
    open_capture(tmp_path / "c").abandon()
    calls.clear()
    close_interrupted(tmp_path / "c", "failed", "daemon_restarted")
    assert in_order(calls, "sync frames.npy", "name capture.json", "sync c"), calls
