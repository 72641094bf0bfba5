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


def test_figures_say_what_they_are_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    depth = {"rms": 0.07, "p99": 0.2}
    report = {
        "points": 9,
        "cannot_reveal": ["a late set (no order bars)", "small blends"],
        "capture": {
            "frames": 18,
            "shows": {"sentinel": 6, "white": 1, "black": 1, "fringe": 1},
            "repeat": 2,
            "retaken": [3, 4],
        },
        "coverage": {"lit": 0.99, "points_of_lit": 0.2},
        "depth_mm": {"p1": 1.0, "p99": 2.0},
        "uncertainty": {
            "expanded_mm": 0.144,
            "within_mm": 0.163,
            "depth_mm": 700.2,
            "coverage_factor": 2.0,
            "random_mm": 0.07,
            "systematic_mm": 0.0169,
            "dominant": {"name": "noise", "share": 0.95},
            "unknown": ["calibration"],
            "stated_length": {"reference_mm": 240.0, "sigma_mm": 0.05, "share": 0.97},
        },
        "truth": {
            "inside_px": 7,
            "unlit_points": 1234,
            "inside": {"depth_mm": depth, "wrong": 0},
            "lit": {"wrong": 12, "wrong_share": 0.0012, "depth_mm": {"rms": 0.683, "p99": 0.4}},
        },
    }
    (tmp_path / "report.json").write_text(json.dumps(report), encoding="utf-8")
    report_result(tmp_path, 1.0, {}, as_json=False)
    printed, said = capsys.readouterr()
    assert "note: the stated length 240.00 +- 0.10 mm (k = 2) dominates, with 97% of the variance" in said
    assert (
        "1 of the pattern, 1 white, 1 black, 6 black and white around them that prove the timing, 2 times; " in printed
    )
    assert "; 2 taken again\n" in printed
    assert "99.0% of the pixels in which the pattern shows, 20.0% keep a point" in printed
    assert "cannot reveal  a late set (no order bars); small blends\n" in printed
    assert "(7 px and more from edges)" in printed
    assert "0.683 mm rms, 0.400 mm in 99 of 100 points (all that is lit, edges too, 0.12% of them wrong; " in printed
    assert "wrong; not the 1,234 that the truth has no light for)" in printed
    assert (
        "+-0.16 mm holds 95 in 100 points that there are, 20.0% of the pixels in which the pattern shows, at 7"
        in printed
    )
    assert (
        ": quote this figure; a point of median uncertainty has +-0.14 mm (k = 2): +-0.14 mm random, +-0.034 mm "
        in printed
    )
    assert "unknown, and not in it: calibration" in printed
    assert "0 points off by half a fringe or stripe, or by 20 mm; 12 with those at edges" in printed


@pytest.mark.parametrize("known", [False, True])
def test_coverage_says_what_was_too_dark(known: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = {"lit": {"coverage": 0.103, "too_dark_share": 0.896, "undecided_share": 0.001, "wrong": 0}}
    report = {"points": 9, "coverage": {"lit": 0.992, "points_of_lit": 0.992, "too_dark": 0.901}}
    (tmp_path / "report.json").write_text(json.dumps(report | ({"truth": truth} if known else {})), encoding="utf-8")
    report_result(tmp_path, 1.0, {}, as_json=False)
    printed = capsys.readouterr().out
    assert "99.2% of the pixels in which the pattern shows" in printed
    assert ("10.3% of all that the projector lights (truth); 89.6% of it is too dark" in printed) == known
    assert ("90.1% of the image shows no pattern" in printed) != known


def test_what_a_method_adds_unknown_gets_no_figure_of_the_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    budget = {
        "within_mm": 0.2,
        "depth_mm": 700.0,
        "coverage_factor": 2.0,
        "random_mm": 0.07,
        "systematic_mm": 0.0,
        "unknown": ["calibration", "method"],
    }
    report = {"points": 9, "coverage": {"lit": 1.0, "points_of_lit": 1.0}, "uncertainty": budget}
    (tmp_path / "report.json").write_text(json.dumps(report), encoding="utf-8")
    report_result(tmp_path, 1.0, {}, as_json=False)
    printed = capsys.readouterr().out
    assert "at least +-0.20 mm at 700 mm, of 95 in 100 points" in printed
    assert "+-0.14 mm is the random part alone (k = 2, the median point)" in printed
    assert "the method's own error is not known and larger: see docs/explanation/uncertainty.md" in printed
    assert "unknown, and not in it: calibration, method" in printed
    budget["unknown"] = ["calibration", "print"]
    (tmp_path / "report.json").write_text(json.dumps(report), encoding="utf-8")
    report_result(tmp_path, 1.0, {}, as_json=False)
    printed = capsys.readouterr().out
    assert (
        "+-0.20 mm holds 95 in 100 points, at 700 mm: quote this figure; a point of median uncertainty has +-0.14"
        in printed
    )
    assert "(k = 2): +-0.14 mm random; unknown, and not in it: calibration, print" in printed
    budget["systematic_mm"] = 4e-7
    (tmp_path / "report.json").write_text(json.dumps(report), encoding="utf-8")
    report_result(tmp_path, 1.0, {}, as_json=False)
    assert "(k = 2): +-0.14 mm random; unknown" in capsys.readouterr().out, "a nanometre is no part"
    assert "unknown, and not in it: calibration, print" in printed
    assert "systematic" not in printed, "nothing is known of it: that is no 0"


@pytest.mark.parametrize(("share", "said"), [(0.982, "98.2%"), (0.0006, "0.1%"), (0.0004, None), (0.0, None)])
def test_coverage_says_what_was_saturated(
    share: float, said: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    coverage = {"lit": 0.018, "points_of_lit": 0.018, "too_dark": 0.024, "saturated_of_lit": share}
    (tmp_path / "report.json").write_text(json.dumps({"points": 9, "coverage": coverage}), encoding="utf-8")
    report_result(tmp_path, 1.0, {}, as_json=False)
    printed = capsys.readouterr().out
    assert ("saturated" in printed) == (said is not None)
    assert said is None or f"{said} of the pixels in which the pattern shows: too bright" in printed
