"""Output folders: looked at before the work, made after it, and nothing of a work that failed is left or kept."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from scanner.errors import StorageError
from scanner.storage import replace_file, try_file, try_output
from service import cli, private
from service.commands.scan import INCOMING, Place


def test_looking_leaves_nothing_and_finds_what_making_would(tmp_path: Path) -> None:
    try_output(tmp_path / "deep" / "er")
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    for refused in (tmp_path, tmp_path / "file", tmp_path / "file" / "in"):
        with pytest.raises(StorageError):
            try_output(refused)
    try_output(tmp_path, force=True)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_files_of_a_killed_command_are_no_part_of_the_next_scan(tmp_path: Path) -> None:
    stale = tmp_path / INCOMING / "cloud.ply"
    stale.parent.mkdir()
    stale.write_text("another scan's")
    with Place(tmp_path, force=True).made() as folder:
        assert folder == tmp_path
        assert not stale.exists()


def test_a_folder_whose_files_do_not_arrive_goes_again(tmp_path: Path) -> None:
    def fail() -> None:
        with Place(tmp_path / "a" / "b", force=False).made() as folder:
            (folder / INCOMING).mkdir()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert not list(tmp_path.iterdir())


def test_without_a_name_a_folder_that_is_free_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    place = Place(None, force=False)
    with place.made() as first, place.made() as second:
        assert first != second


def test_a_file_is_tried_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "there.json").write_text("old")
    try_file(tmp_path / "there.json")
    try_file(tmp_path / "new.png")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"there.json": "old"}
    for refused, says in (
        (tmp_path, "is a folder"),
        (tmp_path / "none" / "x.png", "there is no folder"),
        (tmp_path / "there.json" / "x.png", "there is no folder"),
        (tmp_path / ("x" * 300), "too long"),
        (Path("/proc/x.png"), "/proc/x.png"),
    ):
        with pytest.raises(StorageError, match=says):
            try_file(refused)


SCAN = ("nowhere",)


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (("preview", "--rig", "simulated:quick/board", "--seconds", "0"), "-o"),
        (("live", "--rig", "simulated:quick/board", "--seconds", "1"), "--picture"),
        (("calibrate", "solve", *SCAN, "--target", "chessboard:9x6:30"), "-o"),
        (("calibrate", "marks", *SCAN, "--plate", "1,1,9,9"), "-o"),
        (("calibrate", "mcp", *SCAN, *SCAN, "--calibration", "none.json"), "-o"),
    ],
)
def test_an_unwritable_output_is_told_before_anything_is_opened(
    words: tuple[str, ...],
    option: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(private, "private_daemon", lambda _: pytest.fail("a daemon was started"))
    assert cli.main([*words, option, str(tmp_path / "none" / "x.png")]) == 1
    assert "there is no folder" in capsys.readouterr().err


@pytest.mark.parametrize("begin", [lambda path: replace_file(path, b"{}"), try_file])
def test_a_device_is_not_replaced(begin: Callable[[Path], None], tmp_path: Path) -> None:
    """A rename does so, as root /dev/null's too."""
    os.mkfifo(tmp_path / "null")
    with pytest.raises(StorageError, match="null is a device"):
        begin(tmp_path / "null")
    assert stat.S_ISFIFO((tmp_path / "null").stat().st_mode)
    assert [path.name for path in tmp_path.iterdir()] == ["null"]
