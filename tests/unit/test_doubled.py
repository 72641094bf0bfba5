"""Frames that show what another one shows: left out where the others tell which it is, named wherever they can be."""

from __future__ import annotations

import numpy as np
import pytest

from scanner.decode import Reason, decoder_for
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize

SIZE = ProjectorSize(128, 400)
CAMERA = CameraFormat(160, 120, 8)


def captured(shifts, seed=0, noise=1.0, lit=1.0, gain=200.0, frequencies=(1.0, 4.0, 16.0), moves=lambda position: 0.0):
    """A sequence, its frames of a board of which a share is lit, and the rows seen.

    shifts: of each set, or of all. moves: projector px by which the board lies farther on, by position.
    """
    shifts = shifts if isinstance(shifts, tuple) else (shifts,) * len(frequencies)
    sequence = PatternSequence(SIZE, PmpPattern(("y",), frequencies, shifts))
    rows = 20 + 3.0 * np.arange(CAMERA.height)[:, None] + 0.05 * np.arange(CAMERA.width)
    albedo = np.where(np.arange(CAMERA.width) < lit * CAMERA.width, 1.0, 0.02)
    generator = np.random.default_rng(seed)
    frames = []
    for position in range(len(sequence)):
        light = sequence.image(position)[:, 0] / 255.0
        there = np.interp(rows + moves(position), np.arange(SIZE.height), light)
        grey = 10 + gain * albedo * there + generator.normal(0, noise, rows.shape)
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


@pytest.mark.parametrize("late", [1, -1])
@pytest.mark.parametrize("shifts", [5, 8])
def test_a_scan_whose_every_frame_is_late_gives_no_values_where_steps_do_not_tell(shifts, late):
    # A shift of every set is a whole fringe in the step: (ratio - 1) / shifts = 1.
    sequence, frames, _ = captured(shifts, frequencies=(1.0, shifts + 1.0))
    found = decoded(sequence, [frames[(n - late) % len(frames)] for n in range(len(frames))])
    assert not np.isfinite(found.rows).any()
    told = f"every frame shows what the one {'before' if late == 1 else 'after'} it should"
    assert found.warnings == (f"along y {told}: the sequence is out of step; capture again",)


def test_a_set_that_may_be_early_as_a_whole_gives_no_values_where_steps_do_not_tell():
    # A shift of the coarse set is a whole fringe of the finer one: 8 / 8.
    sequence, frames, _ = captured(8, frequencies=(1.0, 8.0))
    found = decoded(sequence, frames[1:9] + frames[8:])
    assert not np.isfinite(found.rows).any()
    assert "frequency 1 along y: frame 7 shows what frame 8 shows: the set is out of step" in found.warnings[0]


def shown(frames, first, faults):
    """The same with frames of a set in place of others of it."""
    taken = list(frames)
    for n, m in faults.items():
        taken[first + n] = frames[first + m]
    return taken


@pytest.mark.parametrize("shifts", [7, 8, 16])
@pytest.mark.parametrize("k", [0, 2])
@pytest.mark.parametrize("apart", [1, 2])
def test_two_frames_that_changed_places_are_named_and_taken_in_each_others_place(shifts, k, apart):
    sequence, frames, _ = captured(shifts)
    one, two = k * shifts + 2, k * shifts + 2 + apart
    found = decoded(sequence, shown(frames, k * shifts, {2: 2 + apart, 2 + apart: 2}))
    told = f"frames {one} and {two} changed places, and were taken in each other's place; capture again"
    assert found.warnings == (f"frequency {(1, 4, 16)[k]} along y: {told}",)
    np.testing.assert_array_equal(found.rows, decoded(sequence, frames).rows)


@pytest.mark.parametrize("k", [0, 1, 2])
@pytest.mark.parametrize(
    ("faults", "told"),
    [
        ({1: 0}, "frames {0} and {1} show the same"),
        ({0: 3}, "frames {0} and {3} show the same"),
        ({3: 1}, "frames {1} and {3} show the same"),
        ({1: 2, 2: 1}, "frames {1} and {2} changed places, or frames {0} and {3} changed places"),
        ({0: 1, 1: 0}, "frames {0} and {1} changed places, or frames {2} and {3} changed places"),
        ({0: -1}, "frame {0} shows what frame {before} shows"),
    ],
    ids=str,
)
def test_of_four_shifts_no_value_is_left_and_the_frames_are_named(k, faults, told):
    """Each fault leaves the same residual as another one: what can be told apart is named, and nothing is guessed."""
    if -1 in faults.values() and k == 0:
        return
    sequence, frames, _ = captured(4)
    first = 4 * k
    found = decoded(sequence, shown(frames, first, faults))
    told = told.format(*range(first, first + 4), before=first - 1)
    assert len(found.warnings) == 1
    words = found.warnings[0]
    assert words.startswith(f"frequency {(1, 4, 16)[k]} along y: ")
    assert words.endswith(": the set is out of step; capture again")
    assert sorted(told.split(", or ")) == sorted(words[: words.index(": the set")].split("along y: ")[1].split(", or "))
    assert not np.isfinite(found.rows).any()
    assert not found.confidence.any()
    assert set(np.unique(found.reason)) <= {Reason.OUT_OF_STEP, Reason.SHADOW, Reason.LOW_MODULATION}
    assert sum(found.details["counts"].values()) == found.reason.size


def test_a_set_of_three_that_begins_with_the_last_frame_of_the_one_before_is_named():
    sequence, frames, _ = captured(3)
    frames[3] = frames[2]
    found = decoded(sequence, frames)
    told = "frame 3 shows what frame 2 shows: the set is out of step; capture again"
    assert found.warnings == (f"frequency 4 along y: {told}",)
    assert not np.isfinite(found.rows).any()


@pytest.mark.parametrize("shifts", [5, 8])
def test_a_set_that_begins_with_the_last_frame_of_the_one_before_is_decoded_without_it(shifts):
    sequence, frames, rows = captured(shifts)
    frames[shifts] = frames[shifts - 1]
    found = decoded(sequence, frames)
    told = f"frame {shifts} shows what frame {shifts - 1} shows, and was left out; capture again"
    assert found.warnings == (f"frequency 4 along y: {told}",)
    assert np.nanmean(np.abs(found.rows - rows)[:, 2:-2] < 2 * found.sigma_rows[:, 2:-2]) > 0.92


def test_two_doubled_frames_of_one_set_are_both_left_out():
    sequence, frames, rows = captured(8)
    found = decoded(sequence, shown(frames, 16, {2: 1, 6: 5}))
    told = "frame 18 shows what frame 17 shows, frame 22 shows what frame 21 shows, and were left out"
    assert found.warnings[0] == f"frequency 16 along y: {told}; capture again"
    assert np.nanmedian(np.abs(found.rows - rows)) < 0.2


@pytest.mark.parametrize("kind", ["flicker", "response", "moves"])
def test_what_else_leaves_residuals_is_not_taken_for_frames_out_of_step(kind):
    generator = np.random.default_rng(5)
    for shifts in (4, 5, 8):
        sequence, frames, _ = captured(shifts)
        if kind == "flicker":
            frames = [np.rint(np.minimum(frame * (1 + generator.normal(0, 0.05)), 255)) for frame in frames]
        elif kind == "response":
            frames = [np.rint(255 * (frame / 255) ** 2.2) for frame in frames]
        else:
            frames = [np.where(np.arange(CAMERA.width) < n, 200 - frame, frame) for n, frame in enumerate(frames)]
        found = decoded(sequence, [frame.astype(np.uint8) for frame in frames])
        assert not [words for words in found.warnings if "capture again" in words]


@pytest.mark.parametrize("shifts", [4, 5, 8, 16])
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["flickers", "trembles", "drifts"])
def test_light_that_flickers_and_boards_that_tremble_or_drift_are_in_step(shifts, seed, kind):
    generator = np.random.default_rng(seed)
    places = generator.normal(0, 0.4, 3 * shifts) if kind == "trembles" else 0.04 * np.arange(3 * shifts)
    moves = (lambda position: 0.0) if kind == "flickers" else places.__getitem__
    sequence, frames, _ = captured(shifts, gain=130.0, moves=moves)
    if kind == "flickers":
        frames = [
            np.rint(np.clip(frame * (1 + generator.normal(0, 0.15)), 0, 255)).astype(np.uint8) for frame in frames
        ]
    assert not [words for words in decoded(sequence, frames).warnings if "capture again" in words]


@pytest.mark.parametrize("k", [0, 1, 2])
@pytest.mark.parametrize("fresh", [False, True])
def test_of_three_shifts_the_mean_light_tells_a_doubled_frame(k, fresh):
    sequence, frames, _ = captured(3)
    frames[3 * k + 1] = captured(3, seed=1)[1][3 * k] if fresh else frames[3 * k]
    found = decoded(sequence, frames)
    told = f"frames {3 * k} and {3 * k + 1} show the same: the set is out of step; capture again"
    assert found.warnings == (f"frequency {(1, 4, 16)[k]} along y: {told}",)
    assert not np.isfinite(found.rows).any()


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
