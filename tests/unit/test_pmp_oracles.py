"""PMP's wrapped and absolute phase against what others make of the same frames.

scikit-image's result is kept in oracles/, where it says how it was made; where it is installed, it is asked again.
So is `fringes` (GPL), which is a benchmark's optional tool (bench/pmp.py) and never a dependency.
"""

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


def test_scikit_image_says_so_today(golden, phase):
    restoration = pytest.importorskip(
        "skimage.restoration", reason="scikit-image is too large to install for one test: oracles/ holds its result"
    )
    apart = (phase - restoration.unwrap_phase(np.angle(np.exp(1j * phase)))) / (2 * np.pi)
    np.testing.assert_allclose(apart, np.rint(apart[0, 0]), atol=1e-9)
    np.testing.assert_allclose(restoration.unwrap_phase(golden["wrapped"]), golden["unwrapped"], atol=1e-4)


def test_fringes_finds_the_same_rows(golden, phase):
    fringes = pytest.importorskip("fringes", reason="fringes is GPL: an optional tool of a benchmark, no dependency")
    theirs = fringes.Fringes(Y=PROJECTOR.height, X=PROJECTOR.width)
    theirs.axes = (0,)
    theirs.K = len(PATTERN.frequencies)
    theirs.lmin = PROJECTOR.height / PATTERN.frequencies[-1]  # it would cut finer fringes off at 8 px a period
    theirs.N, theirs.v = list(PATTERN.shifts), list(PATTERN.frequencies)
    theirs.p0 = 0.0  # its phase starts at the projector's edge, as ours does
    theirs.mode = "fast"
    rows = np.asarray(theirs.decode(golden["frames"]).x, np.float64).squeeze()
    off = 2 * np.pi * PATTERN.frequencies[-1] * rows / PROJECTOR.height - phase
    assert np.median(np.abs(off)) < 2e-3
    # It weighs all sets, we the finest alone: what it has at stake there differs, whole periods do not.
    assert np.mean(np.abs(off) < 0.5) > 0.99
