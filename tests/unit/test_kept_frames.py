"""The frames of a scan that failed: listed by the daemon, brought beside the place of the scan, named in its error."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from scanner.errors import DecodeError, StorageError, Unreachable
from scanner.wire import error_body
from service.commands.scan import Place, _with_frames_kept
from service.series import frames_kept
from service.terminal import progress_lines

LINE = json.dumps({"slot": 0, "pattern": 0}).encode() + b"\n"
LOST = json.dumps({"slot": None, "pattern": 1}).encode() + b"\n"


@pytest.mark.parametrize(
    ("records", "listed"), [(b"", False), (LOST, False), (LINE[:-1], False), (LINE, True), (LOST + LINE, True)]
)
def test_a_capture_with_a_whole_frame_is_listed(records: bytes, listed: bool, tmp_path: Path) -> None:
    for name, content in (("capture.json", b"{}"), ("frames.npy", b"npy"), (".half", b"x"), ("frames.jsonl", records)):
        (tmp_path / name).write_bytes(content)
    names = [entry.name for entry in frames_kept(tmp_path)]
    assert names == (["capture/capture.json", "capture/frames.jsonl", "capture/frames.npy"] if listed else [])
    assert frames_kept(tmp_path / "nowhere") == ()


class Fetching:
    """A client that brings a capture, or fails to."""

    def __init__(self, error: Exception | None = None) -> None:
        self.error = error

    def fetch(self, job: str, folder: Path, told: Callable[[str, int, int], None], *, failed_too: bool) -> Path:
        assert failed_too
        if isinstance(self.error, KeyError):
            return folder  # of a job whose files were deleted meanwhile
        (folder / "capture").mkdir(parents=True)
        if self.error is not None:
            raise self.error
        (folder / "capture" / "capture.json").write_text(job)
        told("capture/capture.json", 1, 1)
        return folder


OUTCOME = {
    "id": "a-job",
    "state": "failed",
    "reason": "decode_failed",
    "error": {"code": 0, "message": "", "data": {}},
}


def kept(client: Any, place: Place, hint: str | None = "look closer") -> str:
    body = error_body(DecodeError("no stripes", hint=hint))
    outcome = {**OUTCOME, "error": {"code": body.code, "message": body.message, "data": body.data}}
    with progress_lines() as lines:
        error = _with_frames_kept(client, outcome, place, lines)
    assert isinstance(error, DecodeError)
    assert str(error) == "no stripes"
    return error.hint or ""


def test_frames_come_beside_the_scans_place_which_stays_free(tmp_path: Path) -> None:
    place = Place(tmp_path / "one", force=False)
    assert kept(Fetching(), place) == f"look closer; its frames are kept: fringed audit {tmp_path / 'one-failed'}"
    assert kept(Fetching(), place, None) == f"its frames are kept: fringed audit {tmp_path / 'one-failed-2'}"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one-failed", "one-failed-2"]
    assert (tmp_path / "one-failed" / "capture" / "capture.json").read_text() == "a-job"
    place.check()


@pytest.mark.parametrize(
    ("problem", "said"),
    [
        (StorageError("no room"), "no room"),
        (OSError(28, "no room"), "no room"),
        (Unreachable("nobody answers"), "nobody answers"),
        (KeyError(), "the daemon has them no more"),
    ],
)
def test_frames_that_do_not_arrive_whole_leave_nothing(problem: Exception, said: str, tmp_path: Path) -> None:
    hint = kept(Fetching(problem), Place(tmp_path / "one", force=False))
    assert hint.startswith("look closer; its frames could not be kept: ")
    assert hint.endswith(said)
    assert not list(tmp_path.iterdir())


def test_a_place_without_a_name_has_one_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here" / "below").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    assert Place(Path(), force=True).failed == tmp_path / "here-failed"
    monkeypatch.chdir(tmp_path / "here" / "below")
    assert Place(Path(".."), force=True).failed == tmp_path / "here-failed"
    assert Place(Path("/"), force=True).failed.name == "scan-failed"
    assert "fringed audit one-failed" in kept(Fetching(), Place(Path("one"), force=False))


def test_what_a_killed_command_left_is_not_mixed_in(tmp_path: Path) -> None:
    (tmp_path / ".one-failed.incoming" / "capture").mkdir(parents=True)
    (tmp_path / ".one-failed.incoming" / "capture" / "old.json").touch()
    kept(Fetching(), Place(tmp_path / "one", force=False))
    assert [path.name for path in (tmp_path / "one-failed" / "capture").iterdir()] == ["capture.json"]


def test_an_interrupt_meanwhile_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        kept(Fetching(KeyboardInterrupt()), Place(tmp_path / "one", force=False))  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())
