"""What a scan says at its end, where there is little to say."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from scanner.sequencer.findings import listed
from service.commands.summary import report_result


def test_a_report_without_points_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nothing = {"rms": None, "p99": None}
    report = {"points": 0, "depth_mm": {"p1": None, "p99": None}, "truth": {"inside": {"depth_mm": nothing}}}
    (tmp_path / "report.json").write_text(json.dumps(report), encoding="utf-8")
    report_result(tmp_path, 1.0, {}, as_json=False)
    printed = capsys.readouterr().out
    assert "points" in printed
    assert "depth error" not in printed


def test_frame_numbers_are_shortened() -> None:
    assert listed([4, 3, 5, 9, 11, 12]) == "3..5, 9, 11, 12"
    assert listed([]) == ""
