"""MCP with a frame full on beside the pattern's: what is printed on the scene is divided out."""

from __future__ import annotations

import numpy as np
import pytest
import typer

from scanner.decode import decoder_for
from scanner.decode.mcp import linking, stripes, subpixel, white
from scanner.errors import DecodeError
from scanner.patterns import PatternSequence
from service.commands.options import Method, PatternOptions
from tests.unit.test_decode_mcp import CAMERA, OWN, PROJECTOR, render


def printed():
    """A chequer of 24 px in dark and light grey, 1 : 12."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    return np.where((y // 24 + x // 24) % 2, 0.9, 0.075)


def frames(ambient=0.04):
    """The pattern's frame, the white, the black one, and the truth."""
    albedo = printed()
    pattern, truth = render(OWN, albedo=albedo)
    random = np.random.default_rng(2)
    full, dark = (
        np.rint(np.clip(albedo * light * 255 + random.normal(0, 1.5, albedo.shape), 0, 255)).astype(np.uint8)
        for light in (1 + ambient, ambient)
    )
    return pattern, full, dark, truth


def decode(sequence, given):
    decoder = decoder_for(sequence, CAMERA)
    for position, frame in given.items():
        decoder.add(position, frame)
    return decoder.finish()


def test_print_is_divided_out_and_the_maps_are_in_grey_levels():
    pattern, full, dark, truth = frames()
    plain = decode(PatternSequence(PROJECTOR, OWN), {0: render(OWN, albedo=0.9)[0]})
    two = decode(PatternSequence(PROJECTOR, OWN, white=1), {0: pattern, 1: full})
    three = decode(PatternSequence(PROJECTOR, OWN, white=0, black=1), {2: pattern, 0: full, 1: dark})
    for decoded in (two, three):
        good = np.isfinite(decoded.rows)
        assert good.mean() > 0.9
        assert np.median(np.abs(decoded.rows - truth)[good]) < 0.1
        bright, dim = printed() > 0.5, printed() < 0.5
        ratio = np.median(decoded.albedo[good & bright]) / np.median(decoded.albedo[good & dim])
        assert ratio == pytest.approx(12, rel=0.1)
        assert np.median(decoded.albedo[good & bright]) == pytest.approx(
            np.nanmedian(plain.albedo[good & bright]), rel=0.25
        )


def test_one_frame_names_the_stripes_that_print_breaks_up():
    pattern, _, _, truth = frames()
    decoded = decode(PatternSequence(PROJECTOR, OWN), {0: pattern})
    h = OWN.pitch_px(PROJECTOR)
    x, y, row, stripe, confidence = decoded.peaks.T
    at = np.rint(y).astype(int), np.rint(x).astype(int)
    off = np.abs(row - truth[at])
    assert (off < h / 2).mean() > 0.98
    assert (off < h / 2).sum() > 0.55 * np.ptp(truth[:, 256]) / h * 128
    assert np.median(off) < 0.1 * h
    assert decoded.details["joined_tracks"] > 5
    assert len(np.unique(np.stack([x, stripe]), axis=1).T) > 0.99 * len(x)
    # A name that gives no row is half as sure of its place.
    assert (confidence[np.isnan(decoded.rows[at])] <= 0.5).mean() > 0.85


def test_what_is_dark_in_the_white_frame_is_nothing_and_what_is_clipped_says_so():
    image, full = np.full((64, 64), 60, np.uint8), np.full((64, 64), 120, np.uint8)
    full[:8] = 3
    image[-8:] = 255
    ratio = white.divided(image, full, None, 255)
    assert (ratio[:8] == 0).all()
    assert (ratio[8:-8] == white.ONE // 2).all()
    assert (ratio[-8:] == 4095).all()


def test_a_dark_white_frame_is_refused():
    pattern, *_ = frames()
    sequence = PatternSequence(PROJECTOR, OWN, white=1)
    with pytest.raises(DecodeError, match="white frame is dark"):
        decode(sequence, {0: pattern, 1: np.full(CAMERA.shape, 4, np.uint8)})
    with pytest.raises(DecodeError, match="missing"):
        decode(sequence, {1: np.full(CAMERA.shape, 200, np.uint8)})


def test_the_sequence_with_white_is_bracketed_and_described():
    sequence = PatternSequence.bracketed(PROJECTOR, OWN, white=True)
    assert sequence.white == 3
    assert sequence.black == 4
    assert sequence.fringes == (5,)
    assert len(sequence.sentinels) == 6
    assert PatternSequence.from_description(PROJECTOR, sequence.describe()) == sequence
    assert len(PatternSequence.bracketed(PROJECTOR, OWN)) == 1


def test_the_option_is_for_mcp_alone():
    assert PatternOptions(white=True).members(Method.MCP) == {"white": True}
    with pytest.raises(typer.BadParameter, match="--white"):
        PatternOptions(white=True).members(Method.PMP)


def test_without_a_slope_of_brightness_the_fit_is_steadier():
    line = 20 + 80 * (1 - np.abs(2 * ((np.arange(400) - 7.25) / 40 % 1) - 1))
    noisy = np.float32(line + np.random.default_rng(3).normal(0, 4, (60, 400)))
    peaks = stripes.find_peaks(noisy, 40.0, 16.0, 4.0)
    chains = linking.link(peaks, 40.0)
    label = np.where((peaks.y > 20) & (peaks.y < 390), np.rint((peaks.y - 27.25) / 40), -1).astype(np.int32)
    error = {}
    for even in (False, True):
        fine = subpixel.refine(noisy, peaks, chains, label, 40.0, even=even)
        error[even] = np.std((fine.y - 27.25 - 40 * label)[label >= 0])
    assert error[True] < 0.12
    assert error[True] < 0.85 * error[False]
