"""Overtones, ripple and flicker of a PMP scan: found again, told apart from noise, and no cause of false sigmas."""

from __future__ import annotations

import numpy as np
import pytest

from scanner.decode import Reason, decoder_for
from scanner.decode.agreement import remainders_of
from scanner.decode.harmonics import HeightWeights, SpectraSums
from scanner.decode.pmp_frames import axis_frames
from scanner.decode.ripples import ripples
from scanner.decode.spectra import of_response, sum_sets, take_explained_off
from scanner.decode.unwrapping import plan_ladder
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize
from scanner.ripple_correction import widen_by_ripple, without_ripple
from scanner.scan import build_scan

PROJECTOR = ProjectorSize(320, 240)
CAMERA = CameraFormat(240, 160)


def rows_seen():
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] / np.array(CAMERA.shape)[:, None, None]
    return 10 + 215 * y + 9 * np.sin(5 * x)


def shown(pattern, exponent=1.0, noise=0.8, lights=None, camera=CAMERA, seed=3):
    """Frames of a bent board under light ^ exponent; lights: of each frame, over the others'."""
    random, rows, frames = np.random.default_rng(seed), rows_seen(), []
    top = camera.max_value / 255
    for s in pattern.sets():
        for n in range(s.shifts):
            angle = 2 * np.pi * s.frequency * (rows + pattern.origin) / PROJECTOR.height - 2 * np.pi * n / s.shifts
            grey = 8 + 190 * (0.5 + 0.48 * np.cos(angle)) ** exponent
            grey = grey * (1 if lights is None else lights[len(frames)]) + random.normal(0, noise, camera.shape)
            frames.append(np.rint(np.clip(grey, 0, 255) * top).astype(camera.dtype))
    return frames


def decoded(pattern, frames, camera=CAMERA):
    decoder = decoder_for(PatternSequence(PROJECTOR, pattern), camera)
    for position, frame in enumerate(frames):
        decoder.add(position, frame)
    return decoder.finish()


def of_set(found, k=-1):
    return found.details["light"]["y"]["harmonics"][k]


def spectra_of(frames, runs, every, good, level):
    """(spectrum by set, energy of a pixel, HeightWeights, sums) of one run in `every`."""
    heights, found = HeightWeights.of(frames), SpectraSums.empty(len(frames.gains))
    energy = sum_sets(
        frames.addresses, frames.like, frames.starts, heights.weights, heights.kinds, runs, every, good, level,
        found.sums, found.levels, found.ratios,
    )  # fmt: skip
    count = np.count_nonzero(good[::every])
    return found.spectra(heights, count), energy / max(count, 1), heights, found


def shares_of(exponent):
    """Of the overtones 2, 3, 4 in the fringe, by Fourier transform."""
    light = (0.5 + 0.48 * np.cos(2 * np.pi * np.arange(4096) / 4096)) ** exponent
    lines = np.abs(np.fft.rfft(light))
    return lines[2:5] / lines[1]


@pytest.mark.parametrize("bits", [8, 12])
@pytest.mark.parametrize("shifts", [3, 4, 5, 6, 8, 9])
def test_the_kernel_sums_what_the_plain_form_does(shifts, bits):
    camera = CameraFormat(CAMERA.width, CAMERA.height, bits)
    pattern = PmpPattern(("y",), (1.0,), (shifts,), offset=0.4)
    frames = shown(pattern, 1.7, camera=camera)
    of_axis = axis_frames(pattern, "y", dict(enumerate(frames)))
    runs, length = np.arange(0, CAMERA.width * CAMERA.height, 96), 64
    pixels = (runs[::2, None] + np.arange(length)).reshape(-1)
    good = np.random.default_rng(1).random((runs.size, length)) < 0.7
    samples = np.stack([frame.reshape(-1)[pixels] for frame in frames])[:, good[::2].reshape(-1)].astype(float)
    level = np.broadcast_to(np.mean(frames, axis=(0, 1, 2)).astype(np.float32), good.shape).copy()
    (found,), energy, kinds, sums = spectra_of(of_axis, runs, 2, good, level)
    alpha = of_axis.angles[0]
    heights = 2 / shifts * np.exp(-1j * np.arange(1, 5)[:, None] * alpha) @ samples
    assert found.power == pytest.approx(np.mean(np.abs(heights[0]) ** 2), rel=1e-5)
    assert len(found.ratios) == max(min(4, shifts // 2) - 1, 0)
    for order, (ratio, left) in enumerate(zip(found.ratios, found.left, strict=True), start=2):
        meant, seen = heights[0] * np.exp(1j * (order - 1) * np.angle(heights[0])), heights[order - 1]
        if 2 * order == shifts:
            seen = (seen * np.exp(1j * order * alpha[0])).real / 2
            both = np.linalg.lstsq(np.stack([meant.real, -meant.imag], 1), seen, rcond=None)[0]
            expected, rest = complex(*both), np.mean(seen - np.stack([meant.real, -meant.imag], 1) @ both)
        else:
            expected = np.vdot(meant, seen) / np.vdot(meant, meant).real
            rest = np.mean(seen - expected * meant)
        assert ratio == pytest.approx(expected, abs=1e-4)
        assert left == pytest.approx(rest / level[0, 0], abs=1e-4)
    # What is explained of residuals, pixel by pixel; its mean is known from the sums alone.
    samples = np.stack([frame.reshape(-1)[pixels] for frame in frames]).astype(float)
    heights, explained = 2 / shifts * np.exp(-1j * np.arange(1, 5)[:, None] * alpha) @ samples, np.zeros(pixels.size)
    for order, ratio in enumerate(found.ratios, start=2):
        meant, seen = heights[0] * np.exp(1j * (order - 1) * np.angle(heights[0])) * ratio, heights[order - 1]
        if 2 * order == shifts:
            seen, meant = (seen * np.exp(1j * order * alpha[0])).real / 2**0.5, meant.real * 2**0.5
        explained += shifts / 2 * (2 * (np.conj(meant) * seen).real - np.abs(meant) ** 2)
    top = 2 * np.abs(explained).max() + 1
    residual = np.full((runs.size, length), top, np.float32)
    axis = of_axis.addresses, of_axis.like, of_axis.starts, kinds.weights, kinds.kinds, sums.ratios
    take_explained_off(*axis, runs, residual)
    assert np.allclose(top - residual[::2].reshape(-1), explained, atol=1e-4 * top)
    # With four shifts it counts on all phases being there alike: a ninth of a period is not, in these images.
    around = 0.15 if shifts == 4 else 0.02
    assert energy == pytest.approx(explained[good[::2].reshape(-1)].mean(), rel=around, abs=0.01)
    take_explained_off(*axis, runs, residual := np.zeros_like(residual))
    assert residual.min() == 0


@pytest.mark.parametrize("exponent", [0.7, 1.0, 1.15, 2.2])
def test_overtones_are_told_by_their_shares(exponent):
    pattern = PmpPattern(("y",), (1.0, 8.0, 24.0), (8, 8, 8))
    found = decoded(pattern, shown(pattern, exponent))
    for k in range(3):
        told = of_set(found, k)
        assert [told["second"], told["third"], told["fourth"]] == pytest.approx(shares_of(exponent), abs=0.004)
        assert told["sigma"] < 0.002
    assert found.details["light"]["y"]["flicker"]["frames"] < 0.004


@pytest.mark.parametrize(("shifts", "exponent"), [(4, 1.3), (6, 2.2), (8, 1.1), (8, 2.2)])
def test_what_the_response_does_is_not_taken_for_noise(shifts, exponent):
    """A sigma twelve times too large, and coverage lost to it, is what eight shifts of gamma 2.2 once gave."""
    pattern = PmpPattern(("y",), (1.0, 8.0, 24.0), (shifts,) * 3)
    one, two = (decoded(pattern, shown(pattern, exponent, seed=seed)) for seed in (1, 2))
    both = np.isfinite(one.rows) & np.isfinite(two.rows)
    assert both.mean() > 0.99
    apart = (one.rows - two.rows)[both] / np.hypot(one.sigma_rows, two.sigma_rows)[both]
    assert 0.60 < np.mean(np.abs(apart) < 1) < 0.76
    assert 0.92 < np.mean(np.abs(apart) < 2) < 0.98


@pytest.mark.parametrize(("shifts", "named"), [(3, "second"), (4, "third")])
def test_overtones_that_pass_for_the_fringe_are_told_by_the_ripple(shifts, named):
    pattern = PmpPattern(("y",), (1.0, 8.0, 24.0), (shifts,) * 3)
    exponent = 1.3 if shifts == 3 else 2.2
    found = decoded(pattern, shown(pattern, exponent, noise=0.3))
    told = of_set(found)
    assert told[named] == pytest.approx(shares_of(exponent)[1 if named == "third" else 0], rel=0.25)
    rms = np.sqrt(np.nanmean((found.rows - rows_seen()) ** 2))
    assert told["ripple_px"] == pytest.approx(np.sqrt(max(rms**2 - np.nanmedian(found.sigma_rows) ** 2, 0)), rel=0.3)
    assert of_set(decoded(pattern, shown(pattern, 1.0, noise=0.3)))["ripple_px"] < 0.02


@pytest.mark.parametrize("share", [0.0, 0.03])
def test_light_that_changes_from_frame_to_frame_is_flicker(share):
    pattern = PmpPattern(("y",), (1.0, 8.0, 24.0), (8, 8, 8))
    lights = 1 + share * np.random.default_rng(4).normal(size=24)
    found = decoded(pattern, shown(pattern, lights=lights))
    flicker = found.details["light"]["y"]["flicker"]
    if share:
        assert flicker["frames"] == pytest.approx(share, rel=0.35)
        assert flicker["sets"] == pytest.approx(share / np.sqrt(8), rel=0.8)
        assert flicker["px"] == pytest.approx(share / 0.9 * np.sqrt(2 / 8) * 10 / (2 * np.pi), rel=0.4)
        assert any("flicker along y: the light changes by" in warning for warning in found.warnings)
    else:
        assert flicker["frames"] < 0.003
        assert not found.warnings


def test_frames_that_changed_places_are_no_response():
    """Their overtones are too high, or higher than those of the order before: they stay in the residual."""
    pattern = PmpPattern(("y",), (1.0, 8.0, 24.0), (4, 4, 4))
    frames = shown(pattern, 2.2)
    frames[5], frames[6] = frames[6], frames[5]
    of_axis = axis_frames(pattern, "y", dict(enumerate(frames)))
    good = np.ones((100, 64), np.bool_)
    spectra, energy, _, _ = spectra_of(of_axis, np.arange(100) * 300, 1, good, np.full(good.shape, 90, np.float32))
    assert [of_response(np.array(s.ratios)) for s in spectra] == [True, False, True]
    # Of order two, which is N / 2 here, half is seen, and weighs twice.
    assert energy == pytest.approx(sum(2 * abs(s.ratios[0]) ** 2 * s.power for s in (spectra[0], spectra[2])))


def test_sets_that_lost_frames_and_dark_images_tell_nothing():
    pattern = PmpPattern(("y",), (1.0, 8.0), (8, 8))
    frames = dict(enumerate(shown(pattern)))
    del frames[3]
    of_axis = axis_frames(pattern, "y", frames)
    assert of_axis.shifts == (0, 8)
    good = np.ones((100, 64), np.bool_)
    level = np.full(good.shape, 90, np.float32)
    (lost, whole), _, heights, sums = spectra_of(of_axis, np.arange(100) * 300, 1, good, level)
    assert lost is None
    assert whole is not None
    assert sums.spectra(heights, 127) == (None, None)
    dark = decoded(pattern, [np.full(CAMERA.shape, 5, np.uint8)] * 16)
    assert of_set(dark)["second"] is None
    assert dark.details["light"]["y"]["flicker"] is None


@pytest.mark.parametrize("exponent", [1.0, 1.3])
def test_a_ripple_can_be_taken_off(exponent):
    pattern = PmpPattern(("y",), (1.0, 8.0, 24.0), (3, 3, 3))
    found = decoded(pattern, shown(pattern, exponent, noise=0.6))
    straight = without_ripple(found, PatternSequence(PROJECTOR, pattern))
    before, after = (np.sqrt(np.nanmean((maps.rows - rows_seen()) ** 2)) for maps in (found, straight))
    noise = float(np.nanmedian(found.sigma_rows))
    if exponent == 1.0:
        np.testing.assert_array_equal(straight.rows, found.rows)
        assert "took nothing off along y: its ripple of 0.0" in straight.warnings[-1]
        eight = decoded(PmpPattern(("y",), (1.0, 8.0), (8, 8)), shown(PmpPattern(("y",), (1.0, 8.0), (8, 8))))
        idle = without_ripple(eight, PatternSequence(PROJECTOR, PmpPattern(("y",), (1.0, 8.0), (8, 8))))
        assert "with 8 shifts no overtone" in idle.warnings[-1]
        return
    assert before > 1.8 * noise
    assert after < 1.1 * noise
    told = of_set(straight)
    assert told["corrected"]
    (warned,), (corrected,) = found.warnings, straight.warnings
    assert warned.startswith("ripple along y: frequencies differ by")
    assert "measure the response" not in corrected
    assert ": taken off (--correct-ripple)" in corrected
    assert told["ripple_px"] < 0.3 * of_set(found)["ripple_px"]
    np.testing.assert_array_equal(np.isnan(straight.rows), np.isnan(found.rows))


@pytest.mark.parametrize(("exponent", "asked"), [(1.0, False), (1.06, False), (1.06, True)])
def test_sigmas_cover_a_ripple_that_was_not_taken_off(exponent, asked):
    """The finest set's ripple is half its noise and more: told by the coarser set, whose error weighs three times."""
    pattern = PmpPattern(("y",), (1.0, 8.0, 24.0), (3, 3, 3))
    sequence = PatternSequence(PROJECTOR, pattern)
    found = decoded(pattern, shown(pattern, exponent, noise=1.2))
    found = without_ripple(found, sequence) if asked else found
    plain = build_scan(found, None)
    wide = widen_by_ripple(plain, sequence, "y")
    off = np.abs(wide.rows - rows_seen())[10:-10]
    inside = [100 * np.mean(off < k * wide.sigma_rows[10:-10]) for k in (1, 2)]
    assert 64 < inside[0] < 72
    assert 93 < inside[1] < 97
    assert wide.report["sigma_rows_px"]["median"] == pytest.approx(np.nanmedian(wide.sigma_rows), rel=0.01)
    if exponent > 1 and not asked:
        assert np.mean(off < plain.sigma_rows[10:-10]) < 0.62
        assert of_set(found)["ripple"]["sigma_px"] < 0.15 * of_set(found)["ripple_px"]
    else:
        np.testing.assert_allclose(wide.sigma_rows, plain.sigma_rows, rtol=0.03)


def test_one_response_ripples_all_sets_alike_but_for_blur():
    """Phases with a known ripple, blurred in the finest set: the coarse sets tell it, and heights the blur."""
    random, along, ripple = np.random.default_rng(5), 240, 0.004
    ladder = plan_ladder((1.0, 8.0, 24.0), [2 / 3] * 3)
    place, heights = random.random(4000), np.array([60, 60, 54], np.float32)
    left = (heights / 60) ** 3
    clean = place * np.array([[1.0], [8.0], [24.0]])
    seen = clean + ripple * left[:, None] * np.cos(6 * np.pi * clean) + random.normal(0, 0.003, clean.shape)
    seen = (seen % 1).astype(np.float32)
    fits = ripples(ladder, remainders_of(ladder, seen, 0.5), seen, heights, (3, 3, 3), (1, 8, 24), along)
    for frequency, share, fit in zip((1, 8, 24), left, fits, strict=True):
        assert fit.cosine_px * frequency / along == pytest.approx(ripple * share, abs=0.0003)
        assert abs(fit.sine_px) * frequency / along < 0.0003
        assert fit.sigma_px * frequency / along < 0.0003
    many = ripples(ladder, remainders_of(ladder, seen, 0.5), seen, heights, (3, 8, 8), (1, 8, 24), along)
    assert [fit is None for fit in many] == [False, True, True]
    few = seen[:, :50]
    assert ripples(ladder, remainders_of(ladder, few, 0.5), few, heights, (3, 3, 3), (1, 8, 24), along) == [None] * 3


def test_rows_whose_frames_contradict_one_another_from_side_to_side_are_out_of_step():
    """A shutter that rolls into the next flip is wrong in whole rows; what moves has sides."""
    pattern = PmpPattern(("y",), (1.0, 8.0, 24.0), (4, 4, 4))
    frames = shown(pattern)
    for k in (4, 8):
        frames[k][40:60] = frames[k + 2][40:60]
        frames[k][100:130, 60:110] = frames[k + 2][100:130, 60:110]
    found = decoded(pattern, frames)
    band, body = found.reason[40:60], found.reason[100:130, 60:110]
    assert np.all(band == Reason.OUT_OF_STEP)
    assert np.all(found.confidence[40:60] == 0)
    assert np.all(np.isnan(found.sigma_rows[40:60]))
    assert np.mean(body == Reason.MOVED) > 0.8
    assert not np.any(np.delete(found.reason, np.s_[40:60], axis=0) == Reason.OUT_OF_STEP)
    np.testing.assert_array_equal(found.reason == Reason.VALUE, np.isfinite(found.rows))
    assert found.details["counts"]["out_of_step"] == band.size
    assert sum(found.details["counts"].values()) == found.reason.size


def test_what_lies_in_the_dark_contradicts_nothing():
    """Noise cut off at black looks small on the whole: what is left of it at a few pixels is no scene that moves."""
    pattern, random = PmpPattern(("y",), (1.0, 8.0, 24.0), (3, 3, 4)), np.random.default_rng(7)
    frames = shown(pattern)
    for frame in frames:
        faint = 0.008 * frame + random.normal(0, 0.8, frame.shape)
        faint[:, :200] -= 1
        dark = np.rint(np.clip(faint, 0, 255)).astype(np.uint8)
        frame[:, :100], frame[:, 140:] = dark[:, :100], dark[:, 140:]
    found = decoded(pattern, frames)
    dark = np.delete(found.reason, np.s_[100:140], axis=1)
    assert np.all((dark == Reason.SHADOW) | (dark == Reason.LOW_MODULATION))
    assert np.all(found.reason[5:-5, 100:140] == Reason.VALUE)
    assert found.details["counts"]["shadow"] == np.count_nonzero(found.reason == Reason.SHADOW)
    assert "moved" not in found.details["counts"]
