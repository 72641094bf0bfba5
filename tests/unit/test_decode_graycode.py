"""Gray and binary decoding against a plain NumPy form, on frames made from the formulas; and what it must leave out."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner.decode import Reason, decoder_for
from scanner.decode.graycode import GrayDecoder
from scanner.decode.graycode_noise import dark_factor
from scanner.decode.noise import default_noise
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, GrayPattern, PatternSequence, PmpPattern, ProjectorSize

PROJECTOR = ProjectorSize(320, 240)
CAMERA = CameraFormat(200, 150)


def surface(camera=CAMERA):
    """Projector columns and rows seen at each pixel: a tilted, slightly bent board that fills most of the projector."""
    y, x = np.mgrid[: camera.height, : camera.width]
    u, v = x / camera.width, y / camera.height
    return 8 + 300 * u + 6 * np.sin(3 * v), 6 + 225 * v + 5 * np.sin(4 * u)


def sequence_of(pattern, levels=True):
    description = pattern.describe() | ({"white": 0, "black": 1} if levels else {})
    return PatternSequence.from_description(PROJECTOR, description)


def take(sequence, camera=CAMERA, albedo=0.8, ambient=0.03, noise=0.004, seed=0):
    """Frames of `surface`: each pixel sees the projector pixel it falls on. Noise is of the range."""
    rng = np.random.default_rng(seed)
    columns, rows = surface(camera)
    at = np.rint(rows).astype(int), np.rint(columns).astype(int)
    for position in range(len(sequence)):
        grey = (ambient + albedo * sequence.light(position)[at]) * camera.max_value
        grey = grey + rng.normal(size=grey.shape) * noise * camera.max_value
        yield position, np.rint(np.clip(grey, 0, camera.max_value)).astype(camera.dtype)


def decode(sequence, frames, camera=CAMERA):
    decoder = decoder_for(sequence, camera)
    assert isinstance(decoder, GrayDecoder)
    for position, frame in frames:
        decoder.add(position, frame)
    return decoder.finish()


def plain_decode(sequence, frames, axis):
    """Positions by thresholds alone, everywhere: bits to words to cells' centres."""
    pattern, frames = sequence.pattern, dict(frames)
    each, words = pattern.frames_per_bit, np.zeros(next(iter(frames.values())).shape, int)
    first = pattern.axes.index(axis) * pattern.bits * each
    previous = np.zeros_like(words)
    for bit in range(pattern.bits):
        images = [frames[sequence.fringes[first + bit * each + n]].astype(float) for n in range(each)]
        dark = images[1] if pattern.inverse else (frames[sequence.white].astype(float) + frames[sequence.black]) / 2
        digit = (images[0] > dark).astype(int)
        if pattern.code == "gray":
            digit = previous = digit ^ previous
        words = 2 * words + digit
    return (words + 0.5) * 2.0 ** (pattern.code_bits - pattern.bits) - 0.5


@pytest.mark.parametrize("code", ["gray", "binary"])
@pytest.mark.parametrize(("inverse", "levels"), [(False, True), (True, True), (True, False)])
@pytest.mark.parametrize("axes", [("x",), ("y",), ("x", "y"), ("y", "x")])
def test_positions_are_those_of_the_plain_form(code, inverse, levels, axes):
    sequence = sequence_of(GrayPattern(axes, bits=7, code_bits=9, code=code, inverse=inverse), levels)
    frames = list(take(sequence))
    found = decode(sequence, frames)
    assert (found.columns is not None, found.rows is not None) == ("x" in axes, "y" in axes)
    columns, rows = surface()
    for axis, values, sigma, truth in (
        ("x", found.columns, found.sigma_columns, columns),
        ("y", found.rows, found.sigma_rows, rows),
    ):
        if axis in axes:
            assert values.dtype == sigma.dtype == np.float32
            assert values.shape == CAMERA.shape
            decided = np.isfinite(values)
            assert decided.mean() > 0.99
            np.testing.assert_allclose(values[decided], plain_decode(sequence, frames, axis)[decided], atol=1e-4)
            assert np.abs(values - truth)[decided].max() <= 2 + 0.5
            np.testing.assert_allclose(sigma[decided], 4 / np.sqrt(12), rtol=1e-6)
    assert ((found.reason == Reason.VALUE) == np.isfinite(found.confidence * sigma_or(found))).all()
    assert found.confidence[found.reason == 0].min() >= 0.999
    np.testing.assert_allclose(np.median(found.albedo), (0.03 + 0.4) * 255, atol=1)
    np.testing.assert_allclose(np.median(found.modulation), 0.4 * 255, atol=1)


def test_coordinates_alone_are_those_of_all_maps_and_threads_change_nothing():
    sequence = sequence_of(GrayPattern(("x", "y"), bits=7, code_bits=9))
    camera = CameraFormat(203, 149)
    frames = [frame for frame in take(sequence, camera, noise=0.05) if frame[0] != 5]
    expected, brief, shared = (GrayDecoder(sequence, camera, threads=threads) for threads in (1, 2, 3))
    for (position, frame), decoder in itertools.product(frames, (expected, brief, shared)):
        decoder.add(position, frame)
    expected, found, shared = expected.finish(), brief.coordinates(), shared.finish()
    assert 0.2 < np.isfinite(found.rows).mean() < 1
    for name in ("rows", "columns", "confidence"):
        assert np.array_equal(getattr(found, name), getattr(expected, name), equal_nan=True)
    assert found.warnings == expected.warnings != ()
    assert (shared.warnings, shared.details) == (expected.warnings, expected.details)
    for name in ("rows", "columns", "sigma_rows", "sigma_columns", "confidence", "albedo", "modulation", "reason"):
        assert np.array_equal(getattr(shared, name), getattr(expected, name), equal_nan=True), name


def sigma_or(found):
    return found.sigma_columns if found.sigma_columns is not None else found.sigma_rows


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_cameras_of_more_bits(bits):
    camera = CameraFormat(200, 150, bits)
    sequence = sequence_of(GrayPattern(("x",), 9, 9, inverse=False))
    found = decode(sequence, take(sequence, camera), camera)
    assert np.isfinite(found.columns).mean() > 0.99
    assert np.nanmax(np.abs(found.columns - surface(camera)[0])) <= 0.5 + 1e-3


def test_frames_may_come_in_any_order():
    sequence = sequence_of(GrayPattern(("x", "y"), 8, 9, inverse=True))
    frames = list(take(sequence))
    forwards, backwards = decode(sequence, frames), decode(sequence, frames[::-1])
    np.testing.assert_array_equal(forwards.columns, backwards.columns)
    np.testing.assert_array_equal(forwards.confidence, backwards.confidence)


def test_sentinels_are_taken_and_ignored():
    pattern = GrayPattern(("y",), 8, 8, inverse=False)
    sequence = PatternSequence.bracketed(PROJECTOR, pattern)
    found = decode(sequence, take(sequence))
    bare = sequence_of(pattern)
    np.testing.assert_allclose(np.nanmedian(found.rows - decode(bare, take(bare)).rows), 0)
    assert np.isfinite(found.rows).mean() > 0.99


def test_the_border_of_two_cells_is_decided_and_nothing_else_is_between():
    # Every camera pixel looks exactly between two projector pixels: one bit, whichever changes there, is grey.
    sequence = sequence_of(GrayPattern(("x",), 8, 9, inverse=False))
    camera = CameraFormat(300, 40)
    at = np.broadcast_to(np.arange(300), (40, 300))
    rng = np.random.default_rng(1)
    frames = []
    for position in range(len(sequence)):
        light = sequence.light(position)[0]
        grey = 10 + 200 * (light[at] + light[at + 1]) / 2 + rng.normal(size=at.shape)
        frames.append((position, np.rint(np.clip(grey, 0, 255)).astype(np.uint8)))
    found = decode(sequence, frames, camera)
    assert np.isfinite(found.columns).mean() > 0.99
    # A cell is two pixels wide: those between two cells see the border, and all others the middle of theirs.
    np.testing.assert_allclose(found.columns, at + 0.5, atol=1e-4)
    # As many pixels lie on borders as in cells: either is half a cell wide, a little ragged.
    np.testing.assert_allclose(found.sigma_columns[:, 2:-2], 1 / np.sqrt(12), rtol=0.15)


def blurred(sequence, sigma_px, pixels=4000):
    """Frames of a board seen through a projector out of focus: columns at 40 rows of `pixels`, and the camera."""
    camera = CameraFormat(pixels, 40)
    at = np.linspace(5, 310, pixels)
    weights = np.exp(-0.5 * ((np.arange(321) - at[:, None]) / sigma_px) ** 2)
    rng, frames = np.random.default_rng(2), []
    for position in range(len(sequence)):
        light = np.append(sequence.light(position)[0], 0)
        grey = 10 + 200 * (weights @ light) / weights.sum(axis=1) + rng.normal(size=camera.shape)
        frames.append((position, np.rint(np.clip(grey, 0, 255)).astype(np.uint8)))
    return np.broadcast_to(at, camera.shape), frames, camera


@pytest.mark.parametrize(
    ("code", "sigma_px", "gone", "share"),
    [
        ("gray", 0.4, 0, 1.0),
        ("gray", 2.0, 1, 0.99),
        ("gray", 4.0, 2, 0.4),
        ("binary", 2.0, 2, 0.6),
        ("gray", 6.0, 3, 0),
    ],
)
def test_what_blur_leaves_of_the_code_is_coarse_undecided_and_said(code, sigma_px, gone, share):
    sequence = sequence_of(GrayPattern(("x",), 9, 9, code=code, inverse=False))
    truth, frames, camera = blurred(sequence, sigma_px)
    found = decode(sequence, frames, camera)
    off = np.abs(found.columns - truth)[np.isfinite(found.columns)] if share else np.zeros(1)
    assert np.isfinite(found.columns).mean() >= share
    # No further than the ends of the cells that are left, whose sigma is an even distribution's; 20 levels decide.
    assert (off <= 0.1 + np.sqrt(3) * found.sigma_columns[np.isfinite(found.columns)]).all() or not share
    assert np.nanmax(off) <= 2.1
    assert len(found.warnings) == (gone > 0)
    if gone:
        finest = "finest bit along x shows" if gone == 1 else f"{gone} finest bits along x show"
        assert found.warnings[0].startswith("out of focus")
        assert finest in found.warnings[0]
        assert f"--bits {9 - gone}" in found.warnings[0]


def plain_noise_factor(sequence, frames, white, black, model):
    """What the first axis's coarse images say of noise, of all pixels of a small capture: squares within 3 sigmas.

    Levels that are lower than 2.5 sigmas, as found in a first round, are left out.
    """
    bits, each = sequence.pattern.bits, sequence.pattern.frames_per_bit
    ratios, seen, expected = [], [], []
    for bit in range((bits + 1) // 2):
        images = [frames[sequence.fringes[bit * each + n]].astype(float) for n in range(each)]
        if each == 2:
            terms = 3 if sequence.white is None else 4
            off, level = sum(images) - white - black, (np.minimum(*images) + black) / 2
            expected.append(model.variance(((white + black) / 2).astype(np.float32)))
        else:
            nearest = np.where(np.abs(images[0] - white) < np.abs(images[0] - black), white, black)
            terms, off, level = 2, images[0] - nearest, (images[0] + nearest) / 2
            expected.append(model.variance(level.astype(np.float32)))
        ratios.append(off**2 / (terms * expected[-1]))
        seen.append(level**2 / model.variance(level.astype(np.float32)))
    ratios, seen, expected = np.array(ratios), np.array(seen), np.array(expected)
    factor = 1.0
    for _ in range(2):
        whole = seen >= 2.5**2 * max(factor, 1.0)
        kept = ratios[whole]
        within = kept <= 9 * max(np.median(kept) / 0.455, np.median(1 / 12 / expected[whole]))
        factor = kept[within].mean() / 0.973
    return factor


@pytest.mark.parametrize(("inverse", "levels"), [(True, False), (True, True), (False, True)])
def test_noise_is_that_of_the_plain_form(inverse, levels):
    camera = CameraFormat(64, 60)
    sequence = sequence_of(GrayPattern(("x", "y"), 8, 9, inverse=inverse), levels)
    frames = dict(take(sequence, camera, noise=0.01))
    if levels:
        white, black = frames[sequence.white].astype(float), frames[sequence.black].astype(float)
    else:
        pairs = np.array([frames[p] for p in sequence.fringes[:8]], float).reshape(4, 2, *camera.shape)
        white, black = pairs.max(axis=1).mean(axis=0), pairs.min(axis=1).mean(axis=0)
    expected = plain_noise_factor(sequence, frames, white, black, default_noise(255))
    assert decode(sequence, frames.items(), camera).details["noise_factor"] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("noise", [1.5, 2.0, 8.0])
def test_noise_that_black_cuts_off_is_told_by_what_is_left(noise):
    rng, model = np.random.default_rng(3), default_noise(255)
    for level in (0, noise):
        white, black = (np.rint(np.maximum(rng.normal(level, noise, 8192), 0)).astype(np.float32) for _ in range(2))
        of_model = np.array([model.read, model.per_level, 1 / 12, 3, 255, 8], np.float32)
        expected = (noise**2 + 1 / 12) / model.variance(np.float32(level))
        assert dark_factor(white, black, of_model) == pytest.approx(expected, rel=0.3)


@pytest.mark.parametrize("inverse", [False, True])
def test_where_there_is_no_light_there_are_no_values(inverse):
    # Noise of twice the model's sigma, of which black leaves half: what is left of it passed for bits.
    camera = CameraFormat(320, 240)
    sequence = sequence_of(GrayPattern(("y",), 6, 8, inverse=inverse), True)
    for albedo in (0.0, 0.01):
        found = decode(sequence, take(sequence, camera, albedo=albedo, ambient=0, noise=0.008), camera)
        assert found.details["noise_factor"] > 1
        assert not np.isfinite(found.rows).any()
        if albedo == 0:
            assert (found.reason == Reason.SHADOW).all()


def test_noise_is_never_below_the_model_where_black_cuts_all_of_it():
    camera = CameraFormat(64, 60)
    sequence = sequence_of(GrayPattern(("x",), 8, 9, inverse=True), False)
    found = decode(sequence, take(sequence, camera, ambient=0, noise=0.001), camera)
    assert found.details["noise_factor"] == 1


def test_pixels_too_dim_to_tell_accuse_no_blur():
    sequence = sequence_of(GrayPattern(("x",), 9, 9, inverse=False))
    assert decode(sequence, take(sequence, albedo=0.1)).warnings == ()


def test_shadow_clipped_and_beyond_the_projector_have_their_reasons():
    sequence = sequence_of(GrayPattern(("x",), 9, 9, inverse=True))
    frames = []
    for position, frame in take(sequence):
        frame[:20] = 4
        frame[20:40] = 255
        frames.append((position, frame))
    found = decode(sequence, frames)
    assert (found.reason[:20] == Reason.SHADOW).all()
    assert (found.reason[20:40] == Reason.CLIPPED).all()
    assert np.isfinite(found.columns[40:]).all()
    assert (found.confidence[:40] == 0).all()
    # The same frames on a projector of 200 columns: the codes beyond name no pixel of it.
    narrow = PatternSequence.from_description(ProjectorSize(200, 240), sequence.describe())
    beyond = decode(narrow, frames)
    assert set(np.unique(beyond.reason[40:])) == {Reason.VALUE, Reason.BORDER}
    assert np.nanmax(beyond.columns) < 200


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("noise", [0.02, 0.05, 0.1])
def test_noise_leaves_pixels_out_rather_than_wrong(inverse, noise):
    camera = CameraFormat(400, 300)
    sequence = sequence_of(GrayPattern(("x",), 9, 9, inverse=inverse))
    found = decode(sequence, take(sequence, camera, albedo=0.5, noise=noise, ambient=0.2), camera)
    decided = np.isfinite(found.columns)
    wrong = np.abs(found.columns - surface(camera)[0])[decided] > 4.5
    assert wrong.sum() <= 2e-3 * max(decided.sum(), 1)
    assert np.mean(wrong) <= 3 * np.mean(1 - found.confidence[decided]) + 1e-4 if decided.any() else True
    if noise <= 0.02:
        assert decided.mean() > 0.9


def test_a_pixel_whose_black_and_white_are_swapped_is_not_decided():
    sequence = sequence_of(GrayPattern(("x",), 9, 9, inverse=False))
    frames = dict(take(sequence))
    frames[0], frames[1] = frames[1], frames[0]
    assert (decode(sequence, frames.items()).reason == Reason.SHADOW).all()


def test_one_image_of_a_pair_is_enough_where_white_and_black_are_there():
    sequence = sequence_of(GrayPattern(("x",), 9, 9, inverse=True))
    frames = dict(take(sequence))
    del frames[sequence.fringes[4]], frames[sequence.fringes[9]]
    found = decode(sequence, frames.items())
    assert len(found.warnings) == 2
    assert np.isfinite(found.columns).mean() > 0.99
    assert np.nanmax(np.abs(found.columns - surface()[0])) <= 0.5 + 1e-3


@pytest.mark.parametrize(
    ("inverse", "levels", "lost", "named"),
    [
        (False, True, (2,), "2"),
        (False, True, (0, 5), "0, 5"),
        (True, True, (2, 3), "2, 3"),
        (True, False, (7,), "7"),
    ],
)
def test_missing_frames_are_named(inverse, levels, lost, named):
    sequence = sequence_of(GrayPattern(("y",), 8, 8, inverse=inverse), levels)
    frames = {p: f for p, f in take(sequence) if p not in lost}
    with pytest.raises(DecodeError, match=f"frames {named} are missing"):
        decode(sequence, frames.items())


def test_white_and_black_are_needed_without_inverses():
    with pytest.raises(DecodeError, match="white and a black"):
        decoder_for(sequence_of(GrayPattern(("x",), 9, 9, inverse=False), levels=False), CAMERA)


def test_frames_that_cannot_belong_are_refused():
    sequence = sequence_of(GrayPattern(("x",), 9, 9, inverse=False))
    decoder = decoder_for(sequence, CAMERA)
    good = np.zeros(CAMERA.shape, np.uint8)
    decoder.add(3, good)
    with pytest.raises(DecodeError, match="given before"):
        decoder.add(3, good)
    with pytest.raises(DecodeError, match="199 x 150"):
        decoder.add(4, good[:, 1:])
    with pytest.raises(DecodeError, match="uint16"):
        decoder.add(4, good.astype(np.uint16))
    with pytest.raises(DecodeError, match="does not exist"):
        decoder.add(len(sequence), good)
    with pytest.raises(DecodeError, match="pmp"):
        GrayDecoder(PatternSequence(PROJECTOR, PmpPattern(("x",), (1.0,), (3,))), CAMERA)


@settings(max_examples=25, deadline=None)
@given(
    st.integers(1, 9),
    st.sampled_from(["gray", "binary"]),
    st.sampled_from(["x", "y"]),
    st.booleans(),
    st.integers(0, 2**31),
)
def test_any_number_of_bits(bits, code, axis, inverse, seed):
    sequence = sequence_of(GrayPattern((axis,), bits, 9, code, inverse))
    camera = CameraFormat(64, 48)
    frames = list(take(sequence, camera, seed=seed))
    found = decode(sequence, frames, camera)
    values = found.columns if axis == "x" else found.rows
    decided = np.isfinite(values)
    np.testing.assert_allclose(values[decided], plain_decode(sequence, frames, axis)[decided], atol=1e-4)
    assert decided.mean() > 0.95
