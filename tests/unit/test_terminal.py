"""What is drawn on a terminal, and what stands there instead in a log."""

import json
import logging
import re
import sys
from pathlib import Path

import pytest

from service.logs import JsonFormatter
from service.terminal import print_error, print_facts, print_json, print_table, progress_lines

COLOURS = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def test_a_log_gets_plain_lines(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_lines() as lines:
        lines.stage("capturing", 3)
        lines.stage("capturing", 3)
        lines.advance(2, 3, "2 of 3 frames")
        lines.note("a frame was taken again")
        lines.stage("decoding")
    assert capsys.readouterr().err.splitlines() == [
        "a frame was taken again",
        "capturing (2 of 3 frames)",
        "decoding",
    ]
    assert list(lines.spent) == ["capturing", "decoding"]
    print_table("t", ("kind", "name"), [("camera", 1), ("x", "")])
    print_facts("f", [("points", 12), ("a", "b")])
    assert capsys.readouterr().out == "kind    name\ncamera  1\nx\npoints  12\na       b\n"
    print_error("bad", "mend it")
    assert capsys.readouterr().err == "error: bad\nhint: mend it\n"


def test_a_terminal_gets_bars_and_tables(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with progress_lines() as lines:
        lines.stage("capturing", 3)
        lines.advance(2, 3, "2 of 3 frames")
        lines.note("[red]no markup")
        lines.stage("decoding")
    drawn = COLOURS.sub("", capsys.readouterr().err)
    assert "capturing" in drawn
    assert "2 of 3 frames" in drawn
    assert "[red]no markup" in drawn
    print_table("devices", ("kind", "name"), [("camera", "[0]")])
    print_facts("scan", [("points", "[bold]12")])
    drawn = COLOURS.sub("", capsys.readouterr().out)
    assert "│ camera │ [0]" in drawn
    assert "[bold]12" in drawn


def test_json_holds_no_word_that_json_does_not_know(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({"a": [float("nan"), float("inf"), 1.5], "p": Path("x"), 3: None})
    assert json.loads(capsys.readouterr().out) == {"a": [None, None, 1.5], "p": "x", "3": None}


def test_what_others_wrote_moves_nothing_on_a_terminal_or_in_a_log(capsys: pytest.CaptureFixture[str]) -> None:
    nasty = "caf\u00e9 \u202egnp.exe \x1b[2J\x9b1A \U000e0041\udc80"
    seen = "caf\u00e9 \\u202egnp.exe \\u001b[2J\\u009b1A \\udb40\\udc41\\udc80"
    print_error(nasty, nasty)
    print_facts("title", [("name", nasty)])
    said = capsys.readouterr()
    assert said.err == f"error: {seen}\nhint: {seen}\n"
    assert said.out == f"name  {seen}\n"
    print_json({"name": nasty})
    printed = capsys.readouterr().out
    assert "\u202e" not in printed
    assert json.loads(printed) == {"name": nasty}
    record = logging.LogRecord("a", logging.INFO, "", 1, "%s", (nasty,), None)
    line = JsonFormatter("daemon").format(record)
    assert line.isprintable()
    assert json.loads(line)["message"] == nasty
