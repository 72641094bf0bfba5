"""PMP's wrapped and absolute phase against what scikit-image makes of the same frames (oracles/, where it says how)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scanner.decode.pmp import PmpDecoder
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize

PATTERN = PmpPattern(("y",), (1.0, 8.0, 32.0), (4, 4, 4))
PROJECTOR = ProjectorSize(320, 240)


@pytest.fixture(scope="module")
def golden():
    with np.load(Path(__file__).with_name("oracles") / "skimage_unwrapped.npz") as file:
        return dict(file)


@pytest.fixture(scope="module")
def phase(golden):
    """(H, W) rad: absolute phase of the finest set, from the decoder's rows."""
    frames = golden["frames"]
    camera = CameraFormat(frames.shape[2], frames.shape[1])
    decoder = PmpDecoder(PatternSequence(PROJECTOR, PATTERN), camera, threads=1)
    for position, frame in enumerate(frames):
        decoder.add(position, frame)
    rows = decoder.finish().rows.astype(np.float64)
    assert np.isfinite(rows).all()
    return 2 * np.pi * PATTERN.frequencies[-1] * (rows + PATTERN.origin) / PROJECTOR.height


def test_wrapped_phase_is_that_of_four_steps(golden, phase):
    off = np.angle(np.exp(1j * (phase - golden["wrapped"])))
    assert np.abs(off).max() < 2e-3


def test_absolute_phase_is_scikit_image_s_but_for_whole_turns_of_all(golden, phase):
    """Unwrapped from coarser sets here, from neighbours there: one wrong period anywhere would show."""
    apart = (phase - golden["unwrapped"]) / (2 * np.pi)
    turns = np.rint(apart[0, 0])
    np.testing.assert_allclose(apart, turns, atol=5e-4)
    assert np.ptp(golden["unwrapped"]) > 20 * 2 * np.pi
