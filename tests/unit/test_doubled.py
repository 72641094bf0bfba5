"""Frames that show what another one shows: left out where the others tell which it is, named wherever they can be."""

from __future__ import annotations

import numpy as np
import pytest

from scanner.decode import decoder_for
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize

SIZE = ProjectorSize(128, 400)
CAMERA = CameraFormat(160, 120, 8)


def captured(shifts, seed=0, noise=1.0, lit=1.0, gain=200.0):
    """A sequence, its frames of a board of which a share is lit, and the rows seen."""
    sequence = PatternSequence(SIZE, PmpPattern(("y",), (1.0, 4.0, 16.0), (shifts,) * 3))
    rows = 20 + 3.0 * np.arange(CAMERA.height)[:, None] + 0.05 * np.arange(CAMERA.width)
    albedo = np.where(np.arange(CAMERA.width) < lit * CAMERA.width, 1.0, 0.02)
    generator = np.random.default_rng(seed)
    frames = []
    for position in range(len(sequence)):
        light = sequence.image(position)[:, 0] / 255.0
        grey = (
            10 + gain * albedo * np.interp(rows, np.arange(SIZE.height), light) + generator.normal(0, noise, rows.shape)
        )
        frames.append(np.clip(np.rint(grey), 0, 255).astype(np.uint8))
    return sequence, frames, rows


def decoded(sequence, frames, without=(), brief=False):
    decoder = decoder_for(sequence, CAMERA)
    for position, frame in enumerate(frames):
        if position not in without:
            decoder.add(position, frame)
    return decoder.coordinates() if brief else decoder.finish()


@pytest.mark.parametrize("shifts", [5, 8, 16])
@pytest.mark.parametrize("fresh", [False, True])
def test_a_doubled_frame_is_named_and_left_out(shifts, fresh):
    sequence, frames, rows = captured(shifts)
    false, true = 2 * shifts + 3, 2 * shifts + 2
    frames[false] = captured(shifts, seed=1)[1][true] if fresh else frames[true]
    found = decoded(sequence, frames)
    assert found.warnings[0].startswith(
        f"frequency 16 along y: frame {false} shows what frame {true} shows, and was left out"
    )
    off = np.abs(found.rows - rows)[:, 2:-2] / found.sigma_rows[:, 2:-2]
    assert 0.92 < np.nanmean(off < 2) < 0.98
    assert np.isfinite(off).mean() > 0.99


@pytest.mark.parametrize("shifts", [3, 4, 5])
def test_coordinates_alone_are_those_of_the_whole_answer(shifts):
    sequence, frames, _ = captured(shifts)
    frames[shifts + 1] = frames[shifts]
    whole, brief = decoded(sequence, frames), decoded(sequence, frames, brief=True)
    assert "capture again" in whole.warnings[0]
    assert brief.warnings[0] == whole.warnings[0]
    np.testing.assert_array_equal(brief.rows, whole.rows)
    np.testing.assert_array_equal(brief.confidence, whole.confidence)


def test_of_four_shifts_both_are_named_and_of_three_those_that_are_one_picture():
    for shifts in (3, 4):
        sequence, frames, _ = captured(shifts)
        frames[shifts + 1] = frames[shifts]
        told = f"frequency 4 along y: frames {shifts} and {shifts + 1} show the same: the set is out of step"
        assert decoded(sequence, frames).warnings[0].startswith(told)


@pytest.mark.parametrize(
    "options", [{}, {"noise": 20.0}, {"lit": 0.1}, {"gain": 600.0}, {"gain": 8.0}, {"lit": 0.0}], ids=str
)
def test_frames_that_differ_are_no_doubles(options):
    for shifts in (3, 4, 16):
        sequence, frames, _ = captured(shifts, **options)
        assert not [words for words in decoded(sequence, frames).warnings if "capture again" in words]


def test_a_lost_frame_among_sets_of_many_shifts_is_no_matter():
    sequence, frames, rows = captured(8)
    found = decoded(sequence, frames, without=(19,))
    assert "decoded from 7 of 8 frames" in found.warnings[0]
    assert np.nanmedian(np.abs(found.rows - rows)) < 0.1
