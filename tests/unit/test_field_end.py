"""The end of the projected field: what blur pulls there is covered by sigmas or left out. Fields of a known end."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from scanner.decode import Reason, decoder_for, pmp
from scanner.decode.field_end import REACH, WIDER, FieldEnd, Heights, blur_of, margin_px, mind_ends, pulls, rooms_of
from scanner.decode.graycode import GrayDecoder, GrayThresholds
from scanner.decode.pmp import PmpDecoder
from scanner.decode.reasons import REASONS
from scanner.decode.repeated import Repetitions
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, GrayPattern, PatternSequence, PmpPattern, ProjectorSize
from scanner.patterns.graypmp import default_gray_pmp

ALONG = 300
PROJECTOR = {"x": ProjectorSize(ALONG, 8), "y": ProjectorSize(8, ALONG)}


def take(sequence, blur_px, bits=8, axis="x", seed=1, ends=(-9, ALONG + 8)):
    """(places seen, frames): a field with nothing beyond it, through a normal blur, seen past both of its ends."""
    camera = CameraFormat(420, 24, bits) if axis == "x" else CameraFormat(24, 420, bits)
    at, random = np.linspace(*ends, 420), np.random.default_rng(seed)
    edges = (np.arange(ALONG + 1) - 0.5 - at[:, None]) / blur_px
    spread = np.diff(ndtr(edges), axis=1)
    seen = at[None, :] if axis == "x" else at[:, None]
    frames = []
    for position in range(len(sequence)):
        image = sequence.light(position)
        line = spread @ (image[0] if axis == "x" else image[:, 0])
        grey = camera.max_value * (0.04 + 0.75 * (line[None, :] if axis == "x" else line[:, None]))
        grey = grey + random.normal(0, camera.max_value / 150, camera.shape)
        frames.append(np.rint(np.clip(grey, 0, camera.max_value)).astype(camera.dtype))
    return camera, np.broadcast_to(seen, camera.shape), frames


def decode(sequence, camera, frames):
    decoder = decoder_for(sequence, camera)
    for position, frame in enumerate(frames):
        decoder.add(position, frame)
    return decoder.finish()


def found_of(decoded, axis):
    return (decoded.columns, decoded.sigma_columns) if axis == "x" else (decoded.rows, decoded.sigma_rows)


CASES = [
    (PmpPattern(("x",), (1.0, 6.0, 20.0), (4, 4, 4)), 2.0, 8, "x"),
    (PmpPattern(("y",), (1.0, 9.0), (3, 8)), 4.0, 10, "y"),
    (PmpPattern(("x",), (11.0, 12.0, 14.0), (4, 4, 4), sign=1, offset=0.7, origin=0.0), 2.0, 10, "x"),
    (PmpPattern(("y",), (0.9, 7.2, 18.0), (5, 4, 6)), 0.7, 8, "y"),
    (default_gray_pmp(("x",), PROJECTOR["x"], 12.0), 5.0, 8, "x"),
]


@pytest.mark.parametrize(("pattern", "blur_px", "bits", "axis"), CASES)
def test_near_the_end_errors_are_within_sigmas_and_beyond_it_nothing_is_said(pattern, blur_px, bits, axis):
    sequence = PatternSequence(PROJECTOR[axis], pattern)
    camera, truth, frames = take(sequence, blur_px, bits, axis)
    decoded = decode(sequence, camera, frames)
    values, sigma = found_of(decoded, axis)
    inside = np.minimum(truth + 0.5, ALONG - 0.5 - truth) / blur_px
    there, off = np.isfinite(values), np.abs(values - truth)
    assert (there == np.isfinite(sigma)).all()
    assert (there == (decoded.reason == Reason.VALUE)).all()
    for near, far in ((-0.2, 0.6), (0.6, 1.2), (1.2, 2), (2, 3), (3, 6)):
        of_bin = there & (inside >= near) & (inside < far)
        # A field's end one wide: a hundredth is a point or two there.
        assert np.count_nonzero(of_bin & (off > 2 * sigma)) <= 0.08 * np.count_nonzero(of_bin) + 1, (near, far)
    assert there[inside > 1.6].mean() > 0.95
    assert there[inside < 0].mean() < 0.01
    told = decoded.details["field_end"][axis]
    # One frequency is held against the code, whose contrast ends before its noise does.
    assert told["blur_px"] == pytest.approx([WIDER * blur_px] * 2, rel=0.12, abs=0.6)
    assert told["left_out"] > 0
    assert told["widened"] > 0


@pytest.mark.parametrize(
    ("pattern", "blur_px", "levels", "bits"),
    [
        (GrayPattern(("x",), 9, 9), 0.7, True, 8),
        (GrayPattern(("x",), 7, 9), 2.0, False, 10),
        (GrayPattern(("y",), 7, 9, inverse=False), 4.0, True, 10),
        (GrayPattern(("y",), 8, 9, code="binary"), 2.0, False, 8),
    ],
)
def test_a_code_says_nothing_beyond_the_end(pattern, blur_px, levels, bits):
    (axis,) = pattern.axes
    sequence = (
        PatternSequence.bracketed(PROJECTOR[axis], pattern) if levels else PatternSequence(PROJECTOR[axis], pattern)
    )
    camera, truth, frames = take(sequence, blur_px, bits, axis)
    every = GrayDecoder(sequence, camera, GrayThresholds(least_end_share=0))
    whole, brief = GrayDecoder(sequence, camera), GrayDecoder(sequence, camera)
    for position, frame in enumerate(frames):
        for decoder in (every, whole, brief):
            decoder.keep(position, frame)
    every, whole, brief = every.finish(), whole.finish(), brief.coordinates()
    (values, sigma), before = found_of(whole, axis), found_of(every, axis)[0]
    inside = np.minimum(truth + 0.5, ALONG - 0.5 - truth) / blur_px
    assert np.isfinite(before)[(inside > -1) & (inside < 0)].mean() > 0.5
    assert np.isfinite(values)[inside < 0].mean() < 0.01
    np.testing.assert_array_equal(values[inside > 0.6], before[inside > 0.6])
    assert (np.isnan(values) == np.isnan(sigma)).all()
    assert (np.isfinite(values) == (whole.reason == Reason.VALUE)).all()
    assert whole.details["counts"]["border"] == np.count_nonzero(whole.reason == Reason.BORDER)
    np.testing.assert_array_equal(brief.columns if axis == "x" else brief.rows, values)
    np.testing.assert_array_equal(brief.confidence, whole.confidence)


@pytest.mark.parametrize("ends", [(-9, ALONG + 8), (40, 260), (100, 400)])
@pytest.mark.parametrize("threads", [1, 2])
def test_decoding_tells_how_near_an_end_each_stretch_of_pixels_comes(ends, threads, monkeypatch):
    sequence = PatternSequence(PROJECTOR["x"], CASES[0][0])
    camera, _, frames = take(sequence, 2.0, ends=ends)
    told = []
    monkeypatch.setattr(pmp, "mind_ends", lambda position, *others: told.append((position.copy(), others[3])))
    decoder = PmpDecoder(sequence, camera, threads=threads)
    for position, frame in enumerate(frames):
        decoder.keep(position, frame)
    decoder.finish()
    (position, rooms), margin = told[0], margin_px(ALONG)
    true = rooms_of(position, ALONG)
    near = np.minimum(true, rooms) < margin
    assert near.any() == (ends != (40, 260))
    # Of a pixel whose neighbours moved it by a fringe at the most its tentative place is told.
    np.testing.assert_allclose(rooms[near], true[near], atol=ALONG / 20)
    assert (rooms <= true + 1e-3)[near].all()


def test_coordinates_alone_end_where_those_with_sigmas_do():
    pattern, blur_px, bits, axis = CASES[0]
    sequence = PatternSequence(PROJECTOR[axis], pattern)
    camera, _, frames = take(sequence, blur_px, bits, axis)
    whole, brief = decode(sequence, camera, frames), PmpDecoder(sequence, camera)
    for position, frame in enumerate(frames):
        brief.keep(position, frame)
    found = brief.coordinates()
    np.testing.assert_array_equal(found.columns, whole.columns)
    np.testing.assert_array_equal(found.confidence, whole.confidence)


def test_a_field_whose_end_is_out_of_view_is_left_as_it_is():
    sequence = PatternSequence(PROJECTOR["x"], CASES[0][0])
    camera, truth, frames = take(sequence, 2.0, ends=(40, 260))
    decoded = decode(sequence, camera, frames)
    assert decoded.details["field_end"] == {}
    assert (decoded.reason == Reason.VALUE).all()
    assert np.mean(np.abs(decoded.columns - truth) < decoded.sigma_columns) == pytest.approx(0.68, abs=0.03)


def test_many_points_at_the_end_are_worth_a_warning():
    sequence = PatternSequence(PROJECTOR["x"], CASES[0][0])
    camera, _, frames = take(sequence, 2.5, ends=(-9, 70))
    (said,) = decode(sequence, camera, frames).warnings
    assert "% of the points along x lie at the end of the projected field" in said
    assert "blur of 2.5 projector px" in said
    assert "focus the projector, or let its field end beyond what is scanned" in said
    assert FieldEnd(ALONG, (3.0, 0.0), 10, 10, 980).warning("x") is None


def test_the_pull_is_that_of_a_normal_distribution_cut_off():
    for u in (0.0, 0.5, 1.7, 3.0):
        x = np.linspace(0, u + 9, 200_001)
        density = np.exp(-((x - u) ** 2) / 2)
        apparent = (x * density).sum() / density.sum()
        assert np.interp(apparent, np.arange(pulls().size) / 64, pulls()) == pytest.approx(apparent - u, abs=1e-3)
    # What REACH leaves out.
    assert np.interp(REACH, np.arange(pulls().size) / 64, pulls()) < 2e-4


def test_its_kernels_do_what_plain_numpy_does():
    random, along, blur = np.random.default_rng(3), 90, 2.0
    position = random.uniform(-1, along, 4000).astype(np.float32)
    position[::17] = np.nan
    sigma = random.uniform(0.01, 0.5, 4000).astype(np.float32)
    reason = np.where(np.isnan(position), Reason.UNWRAP_RISK, Reason.VALUE).astype(np.uint8)
    confidence, counts = np.ones(4000, np.float32), np.bincount(reason, minlength=REASONS)
    heights = Heights(np.arange(4000), np.full(4000, np.exp(-(blur**2) / 50), np.float32), 50.0)
    room = np.minimum(position + 0.5, along - 0.5 - position) / (WIDER * blur)
    pull = np.where(room < REACH, WIDER * blur * np.interp(room, np.arange(pulls().size) / 64, pulls()), 0)
    out = room < np.sqrt(2 / np.pi)
    widened = np.where(out, np.nan, np.hypot(sigma, pull))
    drawn = int(np.count_nonzero(~out & (pull > sigma)))
    told = mind_ends(position, sigma, confidence, reason, rooms_of(position, along), along, lambda: heights, counts)
    assert told.blur_px == pytest.approx([WIDER * blur] * 2)
    assert (told.left_out, told.widened) == (out.sum(), drawn)
    assert (reason == np.where(out, Reason.BORDER, np.where(np.isnan(room), Reason.UNWRAP_RISK, 0))).all()
    np.testing.assert_allclose(sigma[~np.isnan(room)], widened[~np.isnan(room)], rtol=1e-4)
    assert np.isnan(position[out]).all()
    assert not confidence[out].any()
    assert (counts == np.bincount(reason, minlength=REASONS)).all()


def test_a_blur_that_nothing_tells_is_that_of_lenses_in_focus():
    assert blur_of(None, np.zeros(4, np.float32), 100, last=False) == (False, 1)
    few = Heights(np.arange(4), np.ones(4, np.float32), 50.0)
    assert blur_of(few, np.full(4, 50, np.float32), 100, last=False) == (False, 1)


def test_repetitions_take_noise_away_and_leave_the_pull():
    pattern, blur_px, bits, axis = CASES[0]
    sequence = PatternSequence(PROJECTOR[axis], pattern)
    together = Repetitions(6, None)
    for seed in range(6):
        camera, truth, frames = take(sequence, blur_px, bits, axis, seed)
        together.add(decode(sequence, camera, frames))
    mean = together.result()
    inside = np.minimum(truth + 0.5, ALONG - 0.5 - truth) / blur_px
    drawn = np.isfinite(mean.columns) & (inside < 1.5)
    # What is stated is the pull of a blur a quarter wider, however many repetitions there are.
    assert np.mean(np.abs(mean.columns - truth)[drawn] < mean.sigma_columns[drawn]) > 0.95


def test_a_code_with_fewer_words_than_columns_is_refused():
    size = ProjectorSize(1920, 16)
    with pytest.raises(DecodeError, match="10 code bits name 1024 positions, the projector has 1920 along x"):
        decoder_for(PatternSequence(size, GrayPattern(("x",), 10, 10)), CameraFormat(8, 8))
    short = default_gray_pmp(("x",), ProjectorSize(1024, 16))
    with pytest.raises(DecodeError, match="name 1024 positions"):
        decoder_for(PatternSequence(size, short), CameraFormat(8, 8))


@pytest.mark.parametrize("frequencies", [(1.0, 8.0), (1.0, 8.0, 64.0)])
def test_frames_without_any_blur_are_decoded_to_the_last_pixel(frequencies):
    size = ProjectorSize(640, 480)
    sequence = PatternSequence(size, PmpPattern(("y",), frequencies, (4,) * len(frequencies)))
    decoder = PmpDecoder(sequence, CameraFormat(640, 480, 8))
    for position in range(len(sequence)):
        decoder.add(position, sequence.image(position))
    rows = decoder.finish().rows
    assert np.abs(rows - np.arange(480)[:, None]).max() < 0.1
