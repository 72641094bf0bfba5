"""The MCP decoder on small rendered frames: what it must find, and what it must refuse."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from scanner.decode import Decoded, PositionsDecoder, Reason, SeriesDecoder, decoder_for
from scanner.decode.mcp import McpDecoder, decode_image
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, PmpPattern, ProjectorSize

PROJECTOR = ProjectorSize(384, 288)
CAMERA = CameraFormat(512, 384)
OWN = McpPattern(bits=3, carriers=(34.0, 47.0, 62.0), codes=(0, 5, 3, 6, 1, 4, 7, 2))
PUBLISHED = replace(OWN, levels="composite", codes=tuple(range(8)))


def smooth_rows(y, x):
    """A gently curved surface: projector rows and columns over camera pixels."""
    rows = 20 + 0.62 * y + 12 * np.exp(-(((x - 250) / 90) ** 2) - ((y - 190) / 70) ** 2)
    return rows, 12 + 0.70 * x + 0.01 * (y - 190)


def stepped_rows(y, x):
    """A block before a board: rows jump by 1.6 stripes over x = 150 .. 350, y = 120 .. 280."""
    rows, columns = 20 + 0.62 * y, 12 + 0.70 * x
    inside = (x > 150) & (x < 350) & (y > 120) & (y < 280)
    return np.where(inside, rows + 29, rows), columns


def render(pattern, surface=smooth_rows, camera=CAMERA, albedo=0.8, noise=True):
    """A frame and the projector coordinate along the pattern's axis at each pixel."""
    height, width = camera.shape if pattern.axis == "y" else camera.shape[::-1]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    rows, columns = surface(y, x)
    size = PROJECTOR if pattern.axis == "y" else ProjectorSize(PROJECTOR.height, PROJECTOR.width)
    light = pattern.fringe(0, size)
    light = light if pattern.axis == "y" else light.T
    big = cv2.GaussianBlur(cv2.resize(light, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST), (0, 0), 1.4)
    seen = cv2.remap(big, np.float32(2 * columns + 0.5), np.float32(2 * rows + 0.5), cv2.INTER_LINEAR)
    grey = albedo * (0.04 + seen) * camera.max_value
    if noise:
        grey = grey + np.random.default_rng(1).normal(size=grey.shape) * camera.max_value * 0.006
    frame = np.rint(np.clip(grey, 0, camera.max_value)).astype(camera.dtype)
    return (frame, rows) if pattern.axis == "y" else (np.ascontiguousarray(frame.T), rows.T)


def sizes(pattern):
    return PROJECTOR if pattern.axis == "y" else ProjectorSize(PROJECTOR.height, PROJECTOR.width)


def decode(pattern, surface=smooth_rows, camera=CAMERA, **more) -> tuple[Decoded, np.ndarray]:
    frame, truth = render(pattern, surface, camera, **more)
    return decode_image(frame, pattern, sizes(pattern), camera), truth


@pytest.mark.parametrize("pattern", [OWN, PUBLISHED], ids=["own", "published"])
@pytest.mark.parametrize("axis", ["y", "x"])
def test_a_smooth_surface_comes_out_right_on_either_axis(pattern, axis):
    pattern = replace(pattern, axis=axis)
    camera = CAMERA if axis == "y" else CameraFormat(CAMERA.height, CAMERA.width)
    decoded, truth = decode(pattern, camera=camera)
    found = decoded.rows if axis == "y" else decoded.columns
    assert (decoded.columns if axis == "y" else decoded.rows) is None
    good = np.isfinite(found)
    assert good.mean() > 0.9
    error = np.abs(found - truth)[good]
    assert np.median(error) < 0.06
    assert np.quantile(error, 0.99) < 0.6
    assert decoded.confidence[good].min() > 0.5
    assert (decoded.confidence[~good] == 0).all()
    assert (decoded.reason[good] == Reason.VALUE).all()
    assert (decoded.reason[~good] != Reason.VALUE).all()


def test_peaks_lie_where_the_stripes_are_brightest():
    decoded, truth = decode(OWN)
    x, y, row, stripe, confidence = decoded.peaks.T
    h = OWN.pitch_px(PROJECTOR)
    np.testing.assert_allclose(row, (stripe + 0.5) * h - 0.5, atol=1e-4)
    assert set(np.unique(x % 4)) == {1.5}
    seen = cv2.remap(np.float32(truth), x[:, None], y[:, None], cv2.INTER_LINEAR)[:, 0]
    assert np.median(np.abs(seen - row)) < 0.05
    assert (np.abs(seen - row) < h / 2).all()
    assert ((confidence > 0.89) & (confidence <= 1)).all()


def test_the_stripe_map_has_one_pixel_for_each_stripe_and_column():
    decoded, truth = decode(OWN)
    h = OWN.pitch_px(PROJECTOR)
    marked = decoded.stripes
    assert marked.dtype == np.int16
    for stripe in np.unique(marked[marked >= 0]):
        at = marked == stripe
        assert at.sum(axis=0).max() == 1
        assert np.abs(truth[at] - ((stripe + 0.5) * h - 0.5)).max() < 0.8
    inside = marked[:, 40:-40]
    assert (np.unique(inside[inside >= 0], return_counts=True)[1] > 400).sum() >= 10


@pytest.mark.parametrize("pattern", [OWN, PUBLISHED], ids=["own", "published"])
def test_a_step_of_depth_is_not_crossed(pattern):
    decoded, truth = decode(pattern, stepped_rows)
    good = np.isfinite(decoded.rows)
    wrong = np.abs(decoded.rows - truth)[good] > pattern.pitch_px(PROJECTOR) / 2
    assert good.mean() > 0.7
    assert wrong.mean() < 0.03


@pytest.mark.parametrize("left", [100, 231, 333])
def test_an_isolated_strip_narrower_than_two_beats_of_its_carriers_is_read(left):
    frame, truth = render(OWN)
    inside = np.zeros(CAMERA.shape, bool)
    inside[:, left : left + 60] = True
    dark = np.clip(np.random.default_rng(2).normal(3, 1, CAMERA.shape), 0, 255).astype(np.uint8)
    decoded = decode_image(np.where(inside, frame, dark), OWN, PROJECTOR, CAMERA)
    x, y, row, _, _ = decoded.peaks.T
    at = np.rint(y).astype(int), np.rint(x).astype(int)
    assert len(row) > 0.85 * 15 * 13
    assert (np.abs(row - truth[at]) < OWN.pitch_px(PROJECTOR) / 2).mean() > 0.99
    assert inside[at].mean() > 0.95
    narrow = np.where(np.arange(CAMERA.width) < left + 20, np.where(inside, frame, dark), dark)
    with pytest.raises(DecodeError):
        decode_image(narrow, OWN, PROJECTOR, CAMERA)


def test_twelve_bits_give_what_eight_bits_give():
    eight, truth = decode(OWN)
    twelve, _ = decode(OWN, camera=CameraFormat(512, 384, 12))
    assert twelve.rows.dtype == np.float32
    both = np.isfinite(eight.rows) & np.isfinite(twelve.rows)
    assert both.mean() > 0.9
    assert np.median(np.abs(twelve.rows - truth)[both]) < 0.06
    assert np.median(twelve.albedo[both] / eight.albedo[both]) == pytest.approx(4095 / 255, rel=0.02)


def test_the_decoder_takes_one_frame_and_refuses_others():
    sequence = PatternSequence(PROJECTOR, OWN)
    decoder = decoder_for(sequence, CAMERA)
    assert isinstance(decoder, McpDecoder)
    frame, _ = render(OWN)
    with pytest.raises(DecodeError, match="missing"):
        decoder.finish()
    with pytest.raises(DecodeError, match="does not exist"):
        decoder.add(1, frame)
    with pytest.raises(DecodeError, match="512 x 384"):
        decoder.add(0, frame[:-1])
    with pytest.raises(DecodeError, match="camera's format"):
        decoder.add(0, np.dstack([frame] * 3))
    decoder.add(0, frame)
    with pytest.raises(DecodeError, match="given before"):
        decoder.add(0, frame)
    assert np.isfinite(decoder.finish().rows).mean() > 0.9


@pytest.mark.parametrize(("level", "state"), [(0, "black"), (255, "saturated"), (90, "uniform")])
def test_an_image_without_contrast_is_named(level, state):
    with pytest.raises(DecodeError, match=state):
        decode_image(np.full(CAMERA.shape, level, np.uint8), OWN, PROJECTOR, CAMERA)


def test_plain_fringes_are_not_mcp():
    for cycles in (9, 16, 30):
        light = PmpPattern(axes=("y",), frequencies=(float(cycles),), shifts=(4,)).fringe(0, PROJECTOR)
        frame = cv2.resize(np.uint8(255 * light), CAMERA.shape[::-1])
        with pytest.raises(DecodeError):
            decode_image(frame, OWN, PROJECTOR, CAMERA)


def test_a_pattern_turned_by_90_degrees_is_named():
    frame, _ = render(OWN)
    turned = np.ascontiguousarray(frame.T)
    with pytest.raises(DecodeError, match="90 degrees"):
        decode_image(turned, OWN, PROJECTOR, CameraFormat(CAMERA.height, CAMERA.width))


def test_a_projector_hung_upside_down_is_decoded():
    frame, truth = render(OWN)
    upright = decode_image(frame, OWN, PROJECTOR, CAMERA)
    turned = decode_image(np.ascontiguousarray(frame[::-1]), OWN, PROJECTOR, CAMERA)
    np.testing.assert_array_equal(turned.rows[::-1], upright.rows)
    np.testing.assert_array_equal(turned.stripes[::-1], upright.stripes)
    x, y, row, _, _ = turned.peaks.T
    seen = cv2.remap(np.float32(truth[::-1]), x[:, None], y[:, None], cv2.INTER_LINEAR)[:, 0]
    assert np.median(np.abs(seen - row)) < 0.05


def test_noise_and_texture_without_a_pattern_are_refused():
    random = np.random.default_rng(0)
    noise = random.integers(0, 256, CAMERA.shape).astype(np.uint8)
    smooth = cv2.GaussianBlur(random.normal(size=CAMERA.shape), (0, 0), 8)
    for frame in (noise, np.uint8(np.clip(128 + 1000 * smooth, 0, 255))):
        with pytest.raises(DecodeError):
            decode_image(frame, OWN, PROJECTOR, CAMERA)


def test_other_carriers_than_described_are_refused():
    frame, _ = render(OWN)
    with pytest.raises(DecodeError):
        decode_image(frame, replace(OWN, carriers=(25.0, 80.0, 95.0)), PROJECTOR, CAMERA)


def test_another_code_order_than_described_is_refused():
    frame, _ = render(OWN)
    with pytest.raises(DecodeError, match="contradict"):
        decode_image(frame, replace(OWN, codes=(7, 0, 2, 6, 1, 5, 3, 4)), PROJECTOR, CAMERA)


def test_a_code_order_that_was_rotated_is_refused_where_it_begins_again():
    frame, _ = render(OWN)
    for shift in (2, 4, 6):
        with pytest.raises(DecodeError, match="contradict"):
            decode_image(frame, replace(OWN, codes=OWN.codes[shift:] + OWN.codes[:shift]), PROJECTOR, CAMERA)


@pytest.mark.parametrize("first", [1, 3, 4])
@pytest.mark.parametrize("pattern", [OWN, PUBLISHED], ids=["own", "published"])
def test_code_words_in_one_another_s_places_are_refused_by_name(pattern, first):
    frame, _ = render(pattern)
    codes = list(pattern.codes)
    codes[first], codes[first + 1] = codes[first + 1], codes[first]
    with pytest.raises(DecodeError, match=f"words {codes[first]} and {codes[first + 1]} stand in one another's places"):
        decode_image(frame, replace(pattern, codes=tuple(codes)), PROJECTOR, CAMERA)


def test_a_dark_stripe_where_another_is_described_is_refused_by_name():
    frame, _ = render(replace(PUBLISHED, codes=(1, 2, 3, 0, 4, 5, 6, 7)))
    with pytest.raises(DecodeError, match="words 0 and 3 stand"):
        decode_image(frame, replace(PUBLISHED, codes=(1, 2, 0, 3, 4, 5, 6, 7)), PROJECTOR, CAMERA)


@pytest.mark.parametrize("bits", [2, 4])
def test_other_bits_than_described_are_refused(bits):
    frame, _ = render(OWN)
    carriers = (34.0, 47.0, 62.0, 76.0)[:bits]
    with pytest.raises(DecodeError):
        decode_image(
            frame, replace(OWN, bits=bits, carriers=carriers, codes=tuple(range(1 << bits))), PROJECTOR, CAMERA
        )


def test_stripes_too_fine_for_the_camera_are_refused():
    frame, _ = render(OWN)
    small = cv2.resize(frame, (96, 72), interpolation=cv2.INTER_AREA)
    with pytest.raises(DecodeError):
        decode_image(small, OWN, PROJECTOR, CameraFormat(96, 72))


def test_a_tiny_image_is_refused():
    with pytest.raises(DecodeError, match="smaller"):
        decode_image(np.zeros((16, 16), np.uint8), OWN, PROJECTOR, CameraFormat(16, 16))


def nearer_rows(y, x):
    """The smooth surface a third nearer: stripes and carriers are larger."""
    return 40 + 0.45 * y + 6 * np.exp(-(((x - 250) / 90) ** 2) - ((y - 190) / 70) ** 2), 40 + 0.52 * x


def add_and_finish(decoder, frame):
    decoder.add(0, frame)
    return decoder.finish()


def searched(decoded):
    return "carriers" in decoded.details["stages_ms"]


@pytest.mark.parametrize("turned", [False, True], ids=["upright", "upside down"])
def test_a_series_searches_once_and_gives_what_single_frames_give(turned):
    frame, _ = render(OWN)
    frame = np.ascontiguousarray(frame[::-1]) if turned else frame
    decoder = decoder_for(PatternSequence(PROJECTOR, OWN), CAMERA)
    assert isinstance(decoder, SeriesDecoder)
    first = add_and_finish(decoder, frame)
    decoder.next_frame()
    with pytest.raises(DecodeError, match="missing"):
        decoder.finish()
    second = add_and_finish(decoder, frame)
    decoder.next_frame()
    third = add_and_finish(decoder, frame)
    assert searched(first)
    assert not searched(third)
    np.testing.assert_array_equal(third.rows, first.rows)
    np.testing.assert_array_equal(third.peaks, second.peaks)


@pytest.mark.parametrize("case", ["rows", "columns", "upside down"])
def test_positions_alone_are_those_of_the_maps(case):
    pattern = replace(OWN, axis="x" if case == "columns" else "y")
    camera = CAMERA if pattern.axis == "y" else CameraFormat(CAMERA.height, CAMERA.width)
    frame, _ = render(pattern, camera=camera)
    frame = np.ascontiguousarray(frame[::-1]) if case == "upside down" else frame
    whole = decode_image(frame, pattern, sizes(pattern), camera)
    decoder = decoder_for(PatternSequence(sizes(pattern), pattern), camera)
    assert isinstance(decoder, PositionsDecoder)
    with pytest.raises(DecodeError, match="missing"):
        decoder.positions()
    decoder.add(0, frame)
    alone = decoder.positions()
    np.testing.assert_array_equal(alone, whole.rows if pattern.axis == "y" else whole.columns)
    assert alone.flags.c_contiguous


def test_a_change_of_scene_or_a_dark_frame_is_searched_anew():
    frame, _ = render(OWN)
    other, _ = render(OWN, nearer_rows)
    alone = decode_image(other, OWN, PROJECTOR, CAMERA)
    decoder = decoder_for(PatternSequence(PROJECTOR, OWN), CAMERA)
    add_and_finish(decoder, frame)
    decoder.next_frame()
    changed = add_and_finish(decoder, other)
    assert searched(changed)
    np.testing.assert_array_equal(changed.rows, alone.rows)
    decoder.next_frame()
    with pytest.raises(DecodeError, match="black"):
        add_and_finish(decoder, np.zeros(CAMERA.shape, np.uint8))
    decoder.next_frame()
    again = add_and_finish(decoder, other)
    assert searched(again)
    np.testing.assert_array_equal(again.rows, alone.rows)


def test_a_surface_that_comes_nearer_is_followed_and_searched_anew_only_where_that_does_not_hold():
    decoder = decoder_for(PatternSequence(PROJECTOR, OWN), CAMERA)
    searches, pitches = [], []
    for near in (1.0, 1.015, 1.03, 1.12):

        def rows(y, x, near=near):
            return tuple(c + (plain - c) / near for c, plain in zip((144, 192), smooth_rows(y, x), strict=True))

        frame, truth = render(OWN, rows)
        decoded = add_and_finish(decoder, frame)
        decoder.next_frame()
        at = np.rint(decoded.peaks[:, 1]).astype(int), np.rint(decoded.peaks[:, 0]).astype(int)
        assert (np.abs(decoded.peaks[:, 2] - truth[at]) < OWN.pitch_px(PROJECTOR) / 2).mean() > 0.995
        searches.append(searched(decoded))
        pitches.append(decoded.details["pitch_px"])
    assert searches == [True, False, False, True]
    assert pitches[0] == pitches[2] < pitches[3]


def test_modulation_is_each_frame_s_own_in_a_series_too():
    frame, _ = render(OWN)
    blurred = cv2.GaussianBlur(frame, (0, 0), 1.5)
    decoder = decoder_for(PatternSequence(PROJECTOR, OWN), CAMERA)
    sharp = add_and_finish(decoder, frame)
    decoder.next_frame()
    after = add_and_finish(decoder, blurred)
    assert not searched(after)
    alone = decode_image(blurred, OWN, PROJECTOR, CAMERA)
    np.testing.assert_allclose(after.details["modulation"], alone.details["modulation"], atol=0.01)
    assert min(np.subtract(sharp.details["modulation"], after.details["modulation"])) > 0.1
