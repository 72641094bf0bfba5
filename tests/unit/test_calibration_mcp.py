"""MCP's code-to-phase check: its line, how sure it is, its verdict, and two scenes that are taken for one."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from scanner.calibration.mcp_phase import mcp_phase
from scanner.capture import CaptureHeader
from scanner.errors import DecodeError
from scanner.geometry import load_calibration
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, ProjectorSize
from service.cli import main
from tests.unit.test_calibration_verification import save


def stripes(slope: float, intercept: float, wrong: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A map of rows over a board, and peaks of 32 stripes in it that lie on a line, some with a wrong index."""
    y, x = np.mgrid[:400, :300].astype(np.float64)
    rows = 20 + 2.0 * y + 0.05 * x
    generator = np.random.default_rng(4)
    peaks = []
    for index in range(32):
        for column in range(0, 300, 10):
            row = slope * index + intercept + generator.normal(0, 0.05)
            at = (row - 20 - 0.05 * column) / 2
            if 0 < at < 399:
                peaks.append((column, at, row, index, 1.0))
    table = np.array(peaks, dtype=np.float32)
    if wrong:
        table[:: len(table) // wrong, 3] += 3
    half = table[:50].copy()
    half[:, 3] += 0.5  # the minimum after a stripe: no stripe of its own
    return rows.astype(np.float32), np.concatenate((table, half))


def test_line_of_the_stripes_is_found() -> None:
    rows, peaks = stripes(27.0, 13.0)
    found = mcp_phase(rows, peaks, 27.0, 32)
    assert (found.slope, found.intercept) == pytest.approx((27.0, 13.0), abs=0.01)
    assert found.deviation_px < 0.03
    assert found.rms_px == pytest.approx(0.05, rel=0.1)
    assert found.outliers < 5
    off = mcp_phase(*stripes(27.02, 12.8), 27.0, 32)
    assert off.deviation_px == pytest.approx(0.42, abs=0.03)
    assert off.member == {"slope": off.slope, "intercept": off.intercept}


def test_wrong_codes_are_left_out() -> None:
    rows, peaks = stripes(27.0, 13.0, wrong=60)
    found = mcp_phase(rows, peaks, 27.0, 32)
    assert (found.slope, found.intercept) == pytest.approx((27.0, 13.0), abs=0.02)
    assert 55 <= found.outliers <= 70
    assert found.wrong_codes >= 55
    assert found.good is False, "7 % are more than a board has"
    assert mcp_phase(*stripes(27.0, 13.0), 27.0, 32).good


def test_the_line_is_as_sure_as_stripes_differ() -> None:
    """Stripes that are off as wholes, as when the code's edges are: their peaks' number makes nothing surer."""
    rows, plain = stripes(27.0, 13.0)
    within: list[bool] = []
    worst: list[bool] = []
    for seed in range(40):
        peaks = plain[plain[:, 3] == np.round(plain[:, 3])].copy()
        off = np.random.default_rng(seed).normal(0, 0.1, 32)
        peaks[:, 1] += off[peaks[:, 3].astype(int)] / 2  # rows are 2 a pixel
        found = mcp_phase(rows, peaks, 27.0, 32)
        assert found.expanded["slope"] is not None
        within.append(abs(found.slope - 27.0) < found.expanded["slope"])
        assert found.expanded["deviation_px"] is not None
        worst.append(found.deviation_px < found.expanded["deviation_px"])
    assert 34 <= sum(within) <= 40, "95 % are expected"
    assert 34 <= sum(worst) <= 40, "95 % of what is the larger one of two"
    two = plain[np.isin(plain[:, 3], (10, 11))]
    assert set(mcp_phase(rows, np.repeat(two, 5, axis=0), 27.0, 32).expanded.values()) == {None}


def test_a_few_neighbouring_stripes_say_nothing_of_the_others() -> None:
    """Wherever the line may be off at a stripe of the pattern by more than is allowed, it is not called good."""
    rows, peaks = stripes(27.0, 13.0)
    few = np.isin(peaks[:, 3], (14, 15, 16))
    found = mcp_phase(rows, np.repeat(peaks[few], 4, axis=0), 27.0, 32)
    assert found.farthest_px is not None
    assert found.deviation_px < 0.05
    assert found.farthest_px > 0.2
    assert (found.good, found.open_questions) == (None, ("deviation_px",))
    assert (found.stripe_range, found.stripe_count) == ((14, 16), 32)
    whole = mcp_phase(rows, peaks, 27.0, 32)
    assert whole.farthest_px is not None
    assert whole.farthest_px < 0.1


def test_a_scatter_that_may_be_too_large_is_not_called_good() -> None:
    """Half of the stripes scatter more than is allowed, half less, all of them together just less."""
    rows, peaks = stripes(27.0, 13.0)
    table = peaks[peaks[:, 3] == np.round(peaks[:, 3])].copy()
    spread = np.where(table[:, 3] % 4 < 2, 0.26, 0.1)
    table[:, 1] += np.random.default_rng(2).normal(0, spread / 2).astype(np.float32)  # rows are 2 a pixel
    found = mcp_phase(rows, table, 27.0, 32)
    assert found.expanded["rms_px"] is not None
    assert found.rms_px < 0.2 < found.rms_px + found.expanded["rms_px"]
    assert (found.good, found.open_questions) == (None, ("rms_px",))


def test_scans_of_two_scenes_are_refused() -> None:
    """A tenth of the peaks anywhere else; all of them off by a stripe and a half, or by two whole ones."""
    rows, peaks = stripes(27.0, 13.0)
    there = rows.copy()
    there[:, :40] += np.linspace(20, 100, 40, dtype=np.float32)
    for other in (there, rows + np.float32(40.5), rows + np.float32(54)):
        with pytest.raises(DecodeError, match=r"are not of one scene: at .* PMP has columns of another stripe"):
            mcp_phase(other, peaks, 27.0, 32, axis="x")


def test_too_few_peaks_are_refused() -> None:
    rows, peaks = stripes(27.0, 13.0)
    for none in (peaks[:0], np.full_like(peaks, np.nan)):
        with pytest.raises(DecodeError, match="0 stripe peaks lie on pixels"):
            mcp_phase(rows, none, 27.0, 32)
    with pytest.raises(DecodeError, match="stripe peaks lie on pixels"):
        mcp_phase(np.full_like(rows, np.nan), peaks, 27.0, 32)


def test_mcp_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows, peaks = stripes(27.0, 13.0)
    dense = str(save(tmp_path / "pmp", None, method="pmp", rows=rows))
    single = save(tmp_path / "mcp", None, method="mcp", rows=rows, peaks=peaks)
    sequence = PatternSequence(ProjectorSize(1152, 864), McpPattern(axis="y"))
    header = CaptureHeader(sequence, CameraFormat(300, 400, 8), frames=("0.png",))
    (single / "capture").mkdir()
    (single / "capture" / "capture.json").write_text(json.dumps(header.as_dict()))
    lens = {"size": [300, 400], "matrix": [[500, 0, 150], [0, 500, 200], [0, 0, 1]], "distortion": [0.0] * 5}
    old, new = tmp_path / "rig.json", tmp_path / "new.json"
    lamp = {"size": [1152, 864], "matrix": [[2000, 0, 576], [0, 2000, 432], [0, 0, 1]], "distortion": [0.0] * 5}
    content = {"format": "fringed-calibration", "version": 1, "camera": lens, "projector": lamp}
    old.write_text(json.dumps({**content, "rotation": np.eye(3).tolist(), "translation": [0, 100, 0]}))
    words = ["calibrate", "mcp", dense, str(single)]
    assert main([*words, "--calibration", str(old), "-o", str(new), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["ideal"] == {"slope": 27.0, "intercept": 13.0}
    assert (document["good"], document["axis"]) == (True, "y")
    assert 0 < document["expanded"]["deviation_px"] < 0.05
    assert document["slope"] == pytest.approx(27.0, abs=0.01)
    written = load_calibration(new)
    assert written.extra["mcp_phase"]["slope"] == document["slope"]
    assert written.id
    assert main([*words, "--calibration", str(old), "-o", str(new)]) == 2
    assert main([*words, "-o", str(new)]) == 2
    assert main(words) == 0
    said = capsys.readouterr()
    assert re.search(r"row = \(2[67]\.\d+ \+- 0\.\d+\) x stripe \+ \(1[23]\.\d+ \+- 0\.\d+\)", said.out)
    assert "verdict    good (at most 0.2 rows of deviation and of scatter, 5% outliers are allowed)" in said.out
    assert "at the stripe, of those seen, where it is largest: to quote" in " ".join(said.out.split())
    assert "differ" not in said.err
    off = str(save(tmp_path / "off", None, method="pmp", rows=rows + np.float32(0.4)))
    assert main(["calibrate", "mcp", off, str(single)]) == 0
    assert "stripes and PMP rows differ by up to 0.40 rows" in capsys.readouterr().err
    bad, other = tmp_path / "bad.json", tmp_path / "other.json"
    assert main(["calibrate", "mcp", off, str(single), "--calibration", str(old), "-o", str(bad)]) == 1
    assert "is not written: the fit is not good" in capsys.readouterr().err
    other.write_text(json.dumps({**json.loads(old.read_text()), "projector": lens}))
    assert main([*words, "--calibration", str(other), "-o", str(bad)]) == 1
    assert "is another rig's: camera 300 x 400, projector 300 x 400, and the scans have" in capsys.readouterr().err
    assert not bad.exists()
    assert main(["calibrate", "mcp", dense, dense]) == 1
    assert "is no MCP scan" in capsys.readouterr().err
    again = save(tmp_path / "again", None, method="mcp", rows=rows, peaks=peaks)
    assert main(["calibrate", "mcp", dense, str(again)]) == 1
    assert "has no capture, which says what was projected" in capsys.readouterr().err
    assert main(["calibrate", "mcp", str(single), str(single)]) == 1
    assert "is no PMP scan" in capsys.readouterr().err
