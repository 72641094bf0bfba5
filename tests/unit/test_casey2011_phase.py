"""The reference decoder's code-to-phase fit (Casey 2011, sec. 3.7): used as the calibration has it, and by it alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scanner import reconstruct, reconstruct_live
from scanner.capture.header import CaptureHeader
from scanner.decode import decoder_for
from scanner.decode_options import DecodeOptions
from scanner.geometry import Calibration, Lens
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, ProjectorSize

PATTERN = McpPattern(bits=2, carriers=(20.0, 34.0), codes=(0, 1, 2, 3), levels="composite")
SIZE = ProjectorSize(256, 192)
CAMERA = CameraFormat(256, 192)
PITCH = PATTERN.pitch_px(SIZE)
FIT = {"slope": 1.01 * PITCH, "intercept": PITCH / 2 + 0.7}


def decoded(name, fit, pattern=PATTERN):
    """The pattern itself, as a camera sees it that is the projector."""
    frame = (10 + PATTERN.fringe(0, SIZE) * 200).astype(np.uint8)
    size, camera = SIZE, CAMERA
    if pattern.axis == "x":
        frame = np.ascontiguousarray(frame.T)
        size, camera = ProjectorSize(192, 256), CameraFormat(192, 256)
    decoder = decoder_for(PatternSequence(size, pattern), camera, name, None, fit)
    decoder.add(0, frame)
    return decoder.finish()


@pytest.mark.parametrize("pattern", [PATTERN, replace(PATTERN, axis="x")], ids=["rows", "columns"])
def test_codes_become_rows_by_the_calibration_s_line(pattern):
    own, fitted = decoded("casey2011", None, pattern), decoded("casey2011", FIT, pattern)
    x, y, row, index, _ = fitted.peaks.T
    np.testing.assert_array_equal(index, own.peaks[:, 3])
    assert {0.0, 0.25, 0.5, 0.75} <= set(index % 1)
    np.testing.assert_allclose(own.peaks[:, 2], (index + 0.5) * PITCH - 0.5, atol=1e-4)
    np.testing.assert_allclose(row, FIT["slope"] * index + FIT["intercept"], atol=1e-4)
    values = fitted.rows if pattern.axis == "y" else fitted.columns
    np.testing.assert_array_equal(values[y.astype(int), x.astype(int)], row)
    assert fitted.details["code_to_phase"] == {**FIT, "from": "calibration"}
    assert own.details["code_to_phase"]["from"] == "pattern"


def test_a_fit_of_another_pattern_is_named_and_not_used():
    own, other = decoded("casey2011", None), decoded("casey2011", {"slope": 27.0, "intercept": 13.0})
    np.testing.assert_array_equal(own.rows, other.rows)
    assert other.details["code_to_phase"]["from"] == "pattern"
    assert any("another pattern" in said for said in other.warnings)
    assert not any("another pattern" in said for said in own.warnings)


@pytest.mark.parametrize("fit", [None, FIT])
def test_a_scan_s_decoder_is_told_the_fit_of_its_calibration(fit, monkeypatch):
    asked = []
    monkeypatch.setattr(reconstruct, "decoder_for", lambda *a, **k: asked.append(a[4]) or decoder_for(*a, **k))
    monkeypatch.setattr(reconstruct_live, "decoder_for", lambda *a, mcp_phase, calibration: asked.append(mcp_phase))
    matrix = np.array([[400.0, 0, 128], [0, 400.0, 96], [0, 0, 1]])
    lens = Lens((256, 192), matrix, np.zeros(5))
    rig = Calibration(lens, lens, np.eye(3), np.array([0.0, 100, 0]), extra={"mcp_phase": fit})
    header = CaptureHeader(PatternSequence(SIZE, PATTERN), CAMERA, frames=("0.png",))
    options = DecodeOptions(decoder="casey2011")
    reconstruct.Reconstruction(header, rig, options)
    reconstruct_live.LiveReconstruction(header, rig, options)
    assert asked == [fit, fit]
