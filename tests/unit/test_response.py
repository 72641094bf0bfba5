"""The projector's response from a PMP capture: found again, with its sigma, and refused where nothing tells it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from scanner.calibration.response import response_of_frames
from scanner.decode import decoder_for
from scanner.errors import CalibrationError
from scanner.patterns import CameraFormat, GrayPattern, PatternSequence, PmpPattern, ProjectorSize
from scanner.patterns.sequence import Precorrection
from service.cli import main

PROJECTOR = ProjectorSize(320, 240)
CAMERA = CameraFormat(160, 120)


def rows_seen():
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] / np.array(CAMERA.shape)[:, None, None]
    return 10 + 215 * y + 6 * np.sin(5 * x)


def shown(sequence, exponent, noise=0.7, seed=3, blur=0.0):
    """Frames of a board under light ^ exponent, blurred (1-sigma, projector px)."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(9)
    random = np.random.default_rng(seed)
    pattern, rows, frames = sequence.pattern, rows_seen(), []
    for f, shifts in zip(pattern.frequencies, pattern.shifts, strict=True):
        for n in range(shifts):
            angle = 2 * np.pi * f * (rows + pattern.origin) / PROJECTOR.height - 2 * np.pi * n / shifts
            around = angle[..., None] + 2 * np.pi * f * blur * nodes / PROJECTOR.height
            light = (0.5 + 0.48 * np.cos(around)) ** exponent @ (weights / weights.sum())
            grey = 8 + 190 * light + random.normal(0, noise, CAMERA.shape)
            frames.append(np.rint(np.clip(grey, 0, 255)).astype(np.uint8))
    return frames


@pytest.mark.parametrize("exponent", [0.7, 1.0, 1.3, 2.2])
@pytest.mark.parametrize("shifts", [3, 8])
def test_the_exponent_is_found_again(exponent, shifts):
    sequence = PatternSequence(PROJECTOR, PmpPattern(("y",), (1.0, 8.0, 24.0), (shifts,) * 3))
    found = response_of_frames(sequence, CAMERA, shown(sequence, exponent))
    assert found.exponent == pytest.approx(exponent, abs=max(4 * found.sigma, 0.01))
    assert found.sigma < 0.02
    assert found.gamma == pytest.approx(found.exponent)
    assert found.misfit_after <= found.misfit_before + 1e-6


@pytest.mark.parametrize(("exponent", "shifts"), [(0.4, 3), (0.8, 8), (1.0, 3), (1.3, 4), (2.6, 8)])
def test_blur_draws_no_exponent_towards_1(exponent, shifts):
    """It takes more from overtones than from fringes, and more from fine fringes than from coarse ones."""
    sequence = PatternSequence(PROJECTOR, PmpPattern(("y",), (1.0, 8.0, 24.0), (shifts,) * 3))
    found = response_of_frames(sequence, CAMERA, shown(sequence, exponent, blur=1.4))
    assert found.exponent == pytest.approx(exponent, abs=found.expanded)
    assert found.expanded < 0.03 * exponent
    assert not found.blurred


def test_one_frequency_cannot_tell_blur_and_says_so():
    sequence = PatternSequence(PROJECTOR, PmpPattern(("y",), (1.0,), (8,)))
    found = response_of_frames(sequence, CAMERA, shown(sequence, 1.5))
    assert found.blurred
    assert found.expanded > 0.15
    assert found.exponent == pytest.approx(1.5, abs=found.expanded)


def test_light_that_follows_no_power_is_said_to(tmp_path, capsys):
    sequence = PatternSequence(PROJECTOR, PmpPattern(("y",), (1.0, 8.0, 24.0), (8, 8, 8)))
    frames = shown(sequence, 1.3)
    assert response_of_frames(sequence, CAMERA, frames).warnings == ()
    cut = response_of_frames(sequence, CAMERA, [np.minimum(frame, 150) for frame in frames])
    assert "are 150 of 255 and none is brighter" in cut.warnings[0]
    assert "no exponent explains these fringes" in cut.warnings[1]
    levels = np.arange(256) / 255
    bent = np.rint(255 * (levels + 0.05 * np.sin(2 * np.pi * levels))).astype(np.uint8)
    (said,) = response_of_frames(sequence, CAMERA, [bent[frame] for frame in frames]).warnings
    assert "no exponent explains these fringes" in said


def test_an_exponent_beyond_what_fringes_tell_is_refused():
    sequence = PatternSequence(PROJECTOR, PmpPattern(("y",), (1.0, 8.0), (8, 8)))
    with pytest.raises(CalibrationError, match="lies beyond"):
        response_of_frames(sequence, CAMERA, shown(sequence, 0.15))


def test_the_ripple_is_the_error_that_the_response_has_made():
    sequence = PatternSequence(PROJECTOR, PmpPattern(("y",), (1.0, 8.0, 24.0), (3, 3, 3)))
    frames = shown(sequence, 1.3, noise=0.3)
    found = response_of_frames(sequence, CAMERA, frames)
    decoder = decoder_for(sequence, CAMERA)
    for position, frame in enumerate(frames):
        decoder.add(position, frame)
    error = decoder.finish().rows - rows_seen()
    assert found.ripple_px == pytest.approx(np.sqrt(np.nanmean(error**2)), rel=0.25)


def test_the_precorrection_of_the_capture_is_taken_into_account():
    plain = PatternSequence(PROJECTOR, PmpPattern(("y",), (1.0, 8.0), (6, 6)))
    sequence = PatternSequence(plain.projector, plain.pattern, precorrection=Precorrection(gamma=2.0))
    found = response_of_frames(sequence, CAMERA, shown(plain, 1.15))
    assert found.gamma == pytest.approx(2.3, abs=0.05)


def test_what_cannot_tell_a_response_is_refused():
    one = PatternSequence(PROJECTOR, PmpPattern(("y",), (1.0,), (3,)))
    with pytest.raises(CalibrationError, match="fits any response"):
        response_of_frames(one, CAMERA, shown(one, 1.0))
    gray = PatternSequence(PROJECTOR, GrayPattern(("y",), 8, 8))
    with pytest.raises(CalibrationError, match="method gray"):
        response_of_frames(gray, CAMERA, [])
    two = PatternSequence(PROJECTOR, PmpPattern(("y",), (1.0, 8.0), (4, 4)))
    dark = [np.full(CAMERA.shape, 4, np.uint8)] * 8
    with pytest.raises(CalibrationError, match="0 pixels decided"):
        response_of_frames(two, CAMERA, dark)


def test_the_command_says_what_to_project_with(tmp_path, capsys):
    sequence = PatternSequence(PROJECTOR, PmpPattern(("y",), (1.0, 8.0, 24.0), (4, 4, 4)))
    folder = tmp_path / "capture"
    folder.mkdir()
    np.save(folder / "frames.npy", np.stack(shown(sequence, 1.4)))
    content = {
        "format": "fringed-capture", "version": 1,
        "projector": {"width": PROJECTOR.width, "height": PROJECTOR.height},
        "camera": {"width": CAMERA.width, "height": CAMERA.height, "bits": 8},
        "pattern": sequence.describe(),
    }  # fmt: skip
    (folder / "capture.json").write_text(json.dumps(content))
    assert main(["calibrate", "response", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["exponent"] == pytest.approx(1.4, abs=0.03)
    assert main(["calibrate", "response", str(folder)]) == 0
    assert "gamma to undo" in capsys.readouterr().out
