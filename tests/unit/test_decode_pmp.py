"""The PMP decoder on rendered frames: against a plain NumPy oracle, on captures of other systems, and in trouble."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import pytest

from scanner.decode import Reason, decoder_for
from scanner.decode.neighbours import CONFIDENCE, settle
from scanner.decode.pmp import PmpDecoder, PmpThresholds
from scanner.decode.pmp_sums import ARCTAN_ERROR_CYCLES, _phase
from scanner.decode.strips import MIN_STRIP, in_strips
from scanner.errors import DecodeError
from scanner.kernel import contracting_kernel
from scanner.lanes import LANES, load, store
from scanner.patterns import CameraFormat, GrayPattern, PatternSequence, PmpPattern, ProjectorSize

PROJECTOR = ProjectorSize(320, 240)
CAMERA = CameraFormat(200, 150)
FRINGES = PmpPattern(("y",), (1.0, 8.0, 40.0), (4, 4, 6))


def surface(camera=CAMERA):
    """(rows, columns) that each camera pixel sees: a bump before a tilted plane."""
    y, x = np.mgrid[: camera.height, : camera.width] / np.array(camera.shape)[:, None, None]
    bump = np.exp(-(((x - 0.5) / 0.25) ** 2) - ((y - 0.5) / 0.2) ** 2)
    return 12 + 205 * y + 9 * bump, 15 + 285 * x - 12 * bump


def render(pattern, camera=CAMERA, noise=0.0, albedo=0.8, ambient=0.04, seed=1, shape=None):
    """Fringe frames of a pattern, without its images: intensities at the exact coordinates of `shape`."""
    rows, columns = shape if shape is not None else surface(camera)
    random = np.random.default_rng(seed)
    frames = []
    for axis in pattern.axes:
        at, size = (rows, PROJECTOR.height) if axis == "y" else (columns, PROJECTOR.width)
        for f, shifts in zip(pattern.frequencies, pattern.shifts, strict=True):
            for n in range(shifts):
                angle = 2 * np.pi * f * (at + pattern.origin) / size + pattern.sign * 2 * np.pi * n / shifts
                light = ambient + 0.5 + 0.48 * np.cos(angle + pattern.offset)
                grey = albedo * light * camera.max_value + random.normal(0, 1, camera.shape) * noise
                frames.append(np.rint(np.clip(grey, 0, camera.max_value)).astype(camera.dtype))
    return frames


def decode(pattern, frames, camera=CAMERA, order=None, thresholds=None):
    """Decode frames, None where one is missing."""
    decoder = PmpDecoder(PatternSequence(PROJECTOR, pattern), camera, thresholds)
    for position in order if order is not None else range(len(frames)):
        if frames[position] is not None:
            decoder.add(position, frames[position])
    return decoder.finish()


def oracle(pattern, frames, axis="y"):
    """Plain NumPy: pixel by pixel least squares, then coarse to fine. For sets whose lowest has one period."""
    size = PROJECTOR.along(axis)
    first = sum(pattern.shifts) * pattern.axes.index(axis)
    absolute = None
    ladder = []
    for f, shifts in zip(pattern.frequencies, pattern.shifts, strict=True):
        alpha = pattern.sign * 2 * np.pi * np.arange(shifts) / shifts + pattern.offset
        samples = np.stack(frames[first : first + shifts]).reshape(shifts, -1).astype(float)
        design = np.stack([np.ones(shifts), np.cos(alpha), -np.sin(alpha)], axis=1)
        _, p, q = np.linalg.lstsq(design, samples, rcond=None)[0]
        ladder.append((f, np.arctan2(q, p) / (2 * np.pi), np.hypot(p, q)))
        first += shifts
    ladder.sort(key=lambda rung: rung[0])
    before = None
    for f, cycles, _ in ladder:
        absolute = cycles % 1.0 if absolute is None else cycles + np.rint(absolute * f / before - cycles)
        before = f
    return (absolute / before * size - pattern.origin).reshape(frames[0].shape), ladder[-1][2].reshape(frames[0].shape)


# --- right values -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frequencies", "shifts"),
    [((1.0, 8.0, 40.0), (4, 4, 6)), ((1.0, 8.0), (3, 3)), ((16.0, 1.0), (3, 5)), ((0.9, 6.3, 31.5), (5, 3, 4))],
)
@pytest.mark.parametrize("bits", [8, 16])
def test_it_finds_what_plain_numpy_finds(frequencies, shifts, bits):
    camera = CameraFormat(CAMERA.width, CAMERA.height, bits)
    pattern = PmpPattern(("y",), frequencies, shifts)
    frames = render(pattern, camera, noise=camera.max_value / 400)
    decoded = decode(pattern, frames, camera)
    rows, modulation = oracle(pattern, frames)
    good = np.isfinite(decoded.rows)
    assert good.mean() > 0.97
    assert np.abs(decoded.rows - rows)[good].max() < 2e-3
    assert np.allclose(decoded.modulation, modulation, rtol=1e-4)
    assert np.allclose(decoded.albedo, np.mean(frames, axis=0), rtol=0.1)
    assert decoded.columns is None
    assert decoded.sigma_columns is None
    assert decoded.rows.dtype == decoded.confidence.dtype == np.float32


def test_a_fit_of_one_set_has_mean_and_residual_of_least_squares():
    pattern = PmpPattern(("y",), (1.0,), (5,), sign=1, offset=0.4)
    frames = render(pattern, noise=3)
    decoded = decode(pattern, frames)
    samples = np.stack(frames).reshape(5, -1).astype(float)
    assert np.allclose(decoded.albedo.ravel(), samples.mean(axis=0), atol=1e-3)


@pytest.mark.parametrize("frequencies", [(59.0, 64.0, 70.0), (70.0, 59.0, 64.0), (20.3, 23.45, 27.5)])
def test_sets_without_a_unit_frequency_are_unwrapped_by_their_beats(frequencies):
    pattern = PmpPattern(("y",), frequencies, (8, 8, 8))
    rows, _ = surface()
    decoded = decode(pattern, render(pattern, noise=0.4))
    good = np.isfinite(decoded.rows)
    assert good.mean() > 0.97
    assert np.abs(decoded.rows - rows)[good].max() < 0.3


def test_ambiguous_sets_are_refused():
    with pytest.raises(DecodeError, match=re.escape("8, 16 do not tell one end")):
        PmpDecoder(PatternSequence(PROJECTOR, PmpPattern(("y",), (8.0, 16.0), (4, 4))), CAMERA)


def test_both_axes_are_decided_together():
    pattern = PmpPattern(("x", "y"), (1.0, 8.0), (4, 4))
    frames = render(pattern, noise=0.5)
    for n in range(3):
        frames[n] = frames[n].copy()
        frames[n][40:60, 50:70] = 255
    decoded = decode(pattern, frames)
    rows, columns = surface()
    good = np.isfinite(decoded.rows)
    assert (good == np.isfinite(decoded.columns)).all()
    assert (decoded.reason[40:60, 50:70] == Reason.CLIPPED).all()
    assert good.mean() > 0.9
    assert np.abs(decoded.rows - rows)[good].max() < 1
    assert np.abs(decoded.columns - columns)[good].max() < 1
    assert np.isfinite(decoded.sigma_rows[good]).all()
    assert np.isfinite(decoded.sigma_columns[good]).all()


@pytest.mark.parametrize(("sign", "offset", "origin"), [(1, 0.0, 0.0), (-1, 1.9, 0.0), (1, -0.7, 3.5)])
def test_captures_of_other_systems_have_their_own_sign_offset_and_origin(sign, offset, origin):
    pattern = PmpPattern(("y",), (1.0, 8.0, 40.0), (4, 3, 6), sign, offset, origin)
    rows, _ = surface()
    decoded = decode(pattern, render(pattern, noise=0.3))
    good = np.isfinite(decoded.rows)
    assert good.mean() > 0.97
    assert np.abs(decoded.rows - rows)[good].max() < 0.15


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_more_bits_are_more_precise(bits):
    camera = CameraFormat(CAMERA.width, CAMERA.height, bits)
    rows, _ = surface(camera)
    decoded = decode(FRINGES, render(FRINGES, camera), camera)
    good = np.isfinite(decoded.rows)
    assert good.mean() > 0.98
    # Rounding leaves sqrt(1/12) levels; of B = .38 of the range and six shifts, in a fringe of six rows.
    sigma = 240 / 40 / (2 * np.pi) * np.sqrt(2 / 6 / 12) / (0.8 * 0.48 * camera.max_value)
    assert 0.7 * sigma < np.std((decoded.rows - rows)[good]) < 1.4 * sigma + 3e-5


# --- frames as they come ------------------------------------------------------------------------------------------


def test_frames_may_come_in_any_order():
    frames = render(FRINGES, noise=0.5)
    straight = decode(FRINGES, frames)
    order = np.random.default_rng(3).permutation(len(frames))
    shuffled = decode(FRINGES, frames, order=order)
    assert np.array_equal(np.isfinite(straight.rows), np.isfinite(shuffled.rows))
    assert np.nanmax(np.abs(straight.rows - shuffled.rows)) < 1e-3


def test_frames_around_the_fringes_are_taken_and_left_out():
    sequence = PatternSequence.bracketed(PROJECTOR, FRINGES)
    decoder = decoder_for(sequence, CAMERA)
    frames = dict(zip(sequence.fringes, render(FRINGES, noise=0.5), strict=True))
    for position in range(len(sequence)):
        decoder.add(position, frames.get(position, np.full(CAMERA.shape, 255, np.uint8)))
    assert np.isfinite(decoder.finish().rows).mean() > 0.97


def test_the_frame_is_not_kept():
    decoder = PmpDecoder(PatternSequence(PROJECTOR, FRINGES), CAMERA)
    buffer = np.empty(CAMERA.shape, np.uint8)
    for position, frame in enumerate(render(FRINGES, noise=0.5)):
        buffer[:] = frame
        decoder.add(position, buffer)
    buffer[:] = 0
    assert np.isfinite(decoder.finish().rows).mean() > 0.97


@pytest.mark.parametrize("lost", [(5,), (0, 9), (8, 13)])
def test_a_set_that_lost_a_frame_is_solved_from_the_rest(lost):
    frames = [frame if n not in lost else None for n, frame in enumerate(render(FRINGES, noise=0.5))]
    rows, _ = surface()
    decoded = decode(FRINGES, frames)
    good = np.isfinite(decoded.rows)
    assert good.mean() > 0.95
    assert np.abs(decoded.rows - rows)[good].max() < 0.3
    warnings = " ".join(decoded.warnings)
    assert all(re.search(rf"missing: [\d, ]*\b{n}\b", warnings) for n in lost)


def test_three_shifts_cannot_lose_one():
    pattern = PmpPattern(("y",), (1.0, 8.0), (4, 3))
    frames = render(pattern)
    frames[5] = None
    with pytest.raises(DecodeError, match="frames 5 are missing"):
        decode(pattern, frames)


def test_a_set_that_never_came_is_named():
    frames = render(FRINGES)
    frames[4:8] = [None] * 4
    with pytest.raises(DecodeError, match="frames 4, 5, 6, 7 are missing"):
        decode(FRINGES, frames)
    with pytest.raises(DecodeError, match="frames 0, 1"):
        decode(FRINGES, [None] * len(frames))


@pytest.mark.parametrize(
    ("position", "frame", "says"),
    [
        (14, np.zeros((150, 200), np.uint8), "frame 14 does not exist: the pattern has 14 frames"),
        (-1, np.zeros((150, 200), np.uint8), "frame -1 does not exist"),
        (2, np.zeros((150, 200), np.uint8), "frame 2 was given before"),
        (3, np.zeros((200, 150), np.uint8), "frame 3 is 150 x 200 px, the camera's format 200 x 150"),
        (3, np.zeros((150, 200, 3), np.uint8), "frame 3 is 3 x 200 x 150 px"),
        (3, np.zeros((150, 200), np.uint16), "frame 3 has dtype uint16; 8 bits come as uint8"),
        (3, np.zeros((150, 200), np.float32), "float32"),
    ],
)
def test_frames_that_cannot_belong_are_refused(position, frame, says):
    decoder = decoder_for(PatternSequence(PROJECTOR, FRINGES), CAMERA)
    frames = render(FRINGES, noise=0.5)
    decoder.add(2, frames[2])
    with pytest.raises(DecodeError, match=re.escape(says)):
        decoder.add(position, frame)
    for n, good in enumerate(frames):
        if n != 2:
            decoder.add(n, good)
    assert np.isfinite(decoder.finish().rows).mean() > 0.97


def test_other_methods_are_refused():
    with pytest.raises(DecodeError, match="cannot decode method 'gray'"):
        PmpDecoder(PatternSequence(PROJECTOR, GrayPattern(("x",), 9, 9)), CAMERA)
    with pytest.raises(DecodeError, match="no decoder 'best'"):
        decoder_for(PatternSequence(PROJECTOR, FRINGES), CAMERA, "best")


# --- undecided rather than wrong ----------------------------------------------------------------------------------


def test_every_pixel_says_why_it_has_no_value():
    frames = [frame.copy() for frame in render(FRINGES, noise=0.7)]
    random = np.random.default_rng(5)
    for n, frame in enumerate(frames):
        frame[:20, :20] = np.clip(np.rint(random.normal(3, 0.7, (20, 20))), 0, 255)  # not lit
        frame[:20, 40:60] = np.clip(np.rint(random.normal(90, 0.7, (20, 20))), 0, 255)  # lit by something else
        frame[:20, 80:100] = np.minimum(frame[:20, 80:100].astype(int) * 2, 255)  # glare
        if n >= 8:
            frame[:20, 120:140] = np.clip(np.rint(random.normal(90, 0.7, (20, 20))), 0, 255)  # blurred away
        if n % 2:
            frame[:20, 160:180] = random.integers(0, 250, (20, 20))  # something moved
    decoded = decode(FRINGES, frames)
    reasons = [decoded.reason[4:16, x + 4 : x + 16] for x in (0, 40, 80, 120, 160)]
    assert (reasons[0] == Reason.SHADOW).all()
    assert (reasons[1] == Reason.SHADOW).all()
    assert (reasons[2] == Reason.CLIPPED).mean() > 0.9
    assert (reasons[3] == Reason.LOW_MODULATION).all()
    assert (reasons[4] == Reason.MOVED).mean() > 0.9
    undecided = decoded.reason != Reason.VALUE
    for values in (decoded.rows, decoded.sigma_rows):
        assert np.array_equal(np.isnan(values), undecided)
    assert np.array_equal(decoded.confidence == 0, undecided)
    assert decoded.details["counts"]["value"] == np.count_nonzero(~undecided)


@pytest.mark.parametrize("frequencies", [(1.0, 8.0, 40.0), (59.0, 64.0, 70.0), (1.0, 16.0)])
@pytest.mark.parametrize("shifts", [3, 8])
@pytest.mark.parametrize("noise", [4.0, 12.0])
def test_noise_costs_pixels_and_not_truth(frequencies, shifts, noise):
    pattern = PmpPattern(("y",), frequencies, (shifts,) * len(frequencies))
    camera = CameraFormat(400, 300)
    shape = surface(camera)
    albedo = 0.08 + 0.7 * (np.mgrid[:300, :400][1] / 400)
    decoded = decode(pattern, render(pattern, camera, noise, albedo, shape=shape), camera)
    good = np.isfinite(decoded.rows)
    wrong = np.abs(decoded.rows - shape[0]) > 0.5 * 240 / max(frequencies)
    assert np.count_nonzero(wrong & good) <= max(1e-4 * np.count_nonzero(good), 1)
    assert decoded.confidence[good].min(initial=1) >= CONFIDENCE - 1e-6


def test_the_ends_of_the_field_are_not_mistaken_for_one_another():
    pattern = PmpPattern(("y",), (1.0, 8.0), (6, 6))
    y = np.linspace(-0.45, 239.45, CAMERA.height)[:, None] + np.zeros(CAMERA.shape)
    decoded = decode(pattern, render(pattern, noise=2.0, shape=(y, y)))
    good = np.isfinite(decoded.rows)
    assert good[2:-2].mean() > 0.99
    assert np.abs(decoded.rows - y)[good].max() < 3
    assert (decoded.reason[[0, -1]] == Reason.BORDER).mean() > 0.5


@pytest.mark.parametrize("noise", [0.6, 1.5, 3.0])
@pytest.mark.parametrize("shifts", [3, 4, 8])
def test_sigma_is_what_the_error_turns_out_to_be(noise, shifts):
    pattern = PmpPattern(("y",), (1.0, 8.0, 40.0), (shifts,) * 3)
    camera = CameraFormat(400, 300)
    rows, columns = surface(camera)
    albedo = 0.4 + 0.4 * (np.sin(columns / 30) > 0)
    decoded = decode(pattern, render(pattern, camera, noise, albedo, shape=(rows, columns)), camera)
    good = np.isfinite(decoded.rows)
    ratio = (decoded.rows - rows)[good] / decoded.sigma_rows[good]
    assert good.mean() > 0.95
    assert 0.8 < np.sqrt(np.mean(ratio**2)) < 1.3
    for bright in (albedo > 0.6, albedo < 0.6):
        here = (decoded.rows - rows)[good & bright] / decoded.sigma_rows[good & bright]
        assert 0.75 < np.sqrt(np.mean(here**2)) < 1.35


def test_a_response_that_is_not_corrected_leaves_no_wrong_fringe():
    pattern = PmpPattern(("y",), (1.0, 8.0, 40.0), (3, 3, 3))
    camera = CameraFormat(400, 300)
    rows, columns = surface(camera)
    frames = [
        np.rint(255 * (frame / 255.0) ** 2.2).astype(np.uint8)
        for frame in render(pattern, camera, 1.0, 0.9, shape=(rows, columns))
    ]
    decoded = decode(pattern, frames, camera)
    good = np.isfinite(decoded.rows)
    assert np.count_nonzero(np.abs(decoded.rows - rows)[good] > 3) == 0


@pytest.mark.parametrize("shifts", [3, 4, 8])
@pytest.mark.parametrize("wrong", [0, 1, 2])
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_frames_in_a_wrong_order_leave_no_wrong_values(shifts, wrong, gamma):
    pattern = PmpPattern(("y",), (1.0, 8.0, 40.0), (shifts,) * 3)
    frames = render(pattern, noise=0.8, albedo=0.9)
    frames = [np.rint(255 * (frame / 255.0) ** gamma).astype(np.uint8) for frame in frames]
    one = shifts * wrong + 1
    frames[one], frames[one + 1] = frames[one + 1], frames[one]
    decoded = decode(pattern, frames)
    good = np.isfinite(decoded.rows)
    assert np.count_nonzero(np.abs(decoded.rows - surface()[0])[good] > 3) <= 1e-4 * good.size
    if shifts == 3 and gamma == 1.0:
        assert good.mean() > 0.95
        assert "changed places, and were taken in each other's place" in decoded.warnings[0]
    elif shifts == 3:
        assert good.mean() < 0.01
        assert any("do not agree anywhere" in warning for warning in decoded.warnings)


def test_exact_frames_and_black_frames_raise_no_warning():
    pattern = PmpPattern(("y",), (1.0, 8.0), (8, 8))
    camera = CameraFormat(CAMERA.width, CAMERA.height, 16)
    assert np.isfinite(decode(pattern, render(pattern, camera), camera).rows).mean() > 0.95
    black = decode(pattern, [np.zeros(CAMERA.shape, np.uint8)] * 16)
    assert (black.reason == Reason.SHADOW).all()
    white = decode(pattern, [np.full(CAMERA.shape, 255, np.uint8)] * 16)
    assert (white.reason == Reason.CLIPPED).all()


def test_wide_steps_are_warned_of():
    pattern = PmpPattern(("y",), (1.0, 40.0), (8, 8))
    assert any("40 is unwrapped by 1" in warning for warning in decode(pattern, render(pattern)).warnings)


def test_neighbours_settle_orders_that_a_pixel_leaves_open():
    pattern = PmpPattern(("y",), (1.0, 16.0), (3, 3))
    frames = render(pattern, noise=0.5)
    random = np.random.default_rng(8)
    for n in range(3):  # a noisy unit frequency leaves orders open here and there
        frames[n] = np.clip(np.rint(frames[n] + random.normal(0, 8, CAMERA.shape)), 0, 255).astype(np.uint8)
    decoded = decode(pattern, frames)
    good = np.isfinite(decoded.rows)
    settled = decoded.confidence == np.float32(CONFIDENCE)
    assert decoded.details["unwrapping"]["y"]["settled_by_neighbours"] == np.count_nonzero(settled) > 500
    assert good.mean() > 0.97
    wrong = np.abs(decoded.rows - surface()[0]) > 7
    assert np.count_nonzero(wrong & settled) == 0
    assert np.count_nonzero(wrong & good) <= 3


def test_neighbours_that_disagree_or_are_few_settle_nothing():
    position = np.full((9, 9), 50, np.float32)
    reason = np.full((9, 9), Reason.VALUE, np.uint8)
    maps = [position, np.full((9, 9), 0.1, np.float32), np.ones((9, 9), np.float32), reason]

    def settled(edit):
        tried = [values.copy() for values in maps]
        tried[3][4, 4] = Reason.UNWRAP_RISK
        edit(tried[0], tried[3])
        count = settle(*(values.reshape(-1) for values in tried), 9, 0.1)
        assert (count == 1) == bool(np.isfinite(tried[0][4, 4])) == (tried[3][4, 4] == Reason.VALUE)
        return float(tried[0][4, 4])

    def put(at, value):
        return lambda position, reason: position.__setitem__(at, value)

    assert settled(put((4, 4), 50.5)) == 50.5
    assert settled(put((4, 4), 60.5)) == pytest.approx(50.5)
    assert settled(put((4, 4), 39.6)) == pytest.approx(49.6)
    assert np.isnan(settled(put((4, 4), 70.0)))  # two fringes off: another surface
    assert np.isnan(settled(put((4, 4), 52.0)))  # its phase does not continue theirs
    assert np.isnan(settled(put((2, 2), 60.0)))  # they are on two fringes
    assert settled(lambda position, reason: reason[:, :3].fill(Reason.SHADOW)) == 50  # 19 are left
    assert np.isnan(settled(lambda position, reason: reason[:, :4].fill(Reason.UNWRAP_RISK)))  # 14


def test_thresholds_can_be_chosen_and_are_reported():
    frames = render(FRINGES, noise=0.5)
    strict = decode(FRINGES, frames, thresholds=PmpThresholds(min_modulation_levels=120))
    assert (strict.reason == Reason.SHADOW).all()
    assert strict.details["thresholds"]["min_modulation_levels"] == 120
    report = decode(FRINGES, frames).details
    assert report["method"] == "pmp"
    assert report["unwrapping"]["y"]["frequencies"] == [1.0, 8.0, 40.0]
    assert report["noise"]["measured"] is True


@pytest.mark.parametrize(("shifts", "exponent", "warned"), [(3, 1.3, True), (3, 1.0, False), (8, 1.3, False)])
def test_a_ripple_has_a_name_and_a_number(shifts, exponent, warned):
    pattern = PmpPattern(("y",), (1.0, 8.0, 32.0), (shifts,) * 3)
    camera = CameraFormat(400, 300)
    shape = surface(camera)
    frames = [
        np.rint(255 * (frame / 255.0) ** exponent).astype(np.uint8)
        for frame in render(pattern, camera, 0.5, 0.9, shape=shape)
    ]
    decoded = decode(pattern, frames, camera)
    ripple = decoded.details["unwrapping"]["y"]["ripple"]
    assert any("ripple along y" in warning for warning in decoded.warnings) == warned
    if warned:
        error = np.sqrt(np.nanmean((decoded.rows - shape[0]) ** 2))
        assert 0.5 * error < ripple["px"] < 2 * error
    else:
        assert ripple["px"] < 0.05


# --- one pass over all frames -------------------------------------------------------------------------------------


@pytest.mark.parametrize("axes", [("y",), ("x", "y")])
@pytest.mark.parametrize("size", [(200, 150), (331, 97), (7, 5), (1, 1)])
def test_threads_and_borrowed_frames_make_no_difference(axes, size):
    camera = CameraFormat(*size)
    pattern = PmpPattern(axes, (1.0, 8.0, 40.0), (3, 5, 8))
    frames = render(pattern, camera, noise=1.0)
    sequence = PatternSequence(PROJECTOR, pattern)
    one, three = PmpDecoder(sequence, camera, threads=1), PmpDecoder(sequence, camera, threads=3)
    for position, frame in enumerate(frames):
        one.add(position, frame)
        three.keep(position, np.asfortranarray(frame) if position % 2 else frame)
    expected, found = one.finish(), three.finish()
    for name in ("rows", "sigma_rows", "columns", "confidence", "albedo", "modulation", "reason"):
        a, b = getattr(expected, name), getattr(found, name)
        assert (a is None and b is None) or np.array_equal(a, b, equal_nan=True)
    assert expected.details == found.details
    assert sum(expected.details["counts"].values()) == camera.width * camera.height


@pytest.mark.parametrize("axes", [("y",), ("x",), ("x", "y")])
@pytest.mark.parametrize("frequencies", [(1.0, 8.0, 40.0), (59.0, 64.0, 70.0)])
def test_coordinates_alone_are_those_of_all_maps(axes, frequencies):
    camera = CameraFormat(203, 97)
    pattern = PmpPattern(axes, frequencies, (8, 4, 3))
    frames = render(pattern, camera, noise=5.0, albedo=0.05 + 0.7 * np.mgrid[: camera.height, : camera.width][1] / 203)
    frames[2] = None
    sequence = PatternSequence(PROJECTOR, pattern)
    brief, full = PmpDecoder(sequence, camera), PmpDecoder(sequence, camera)
    for position, frame in enumerate(frames):
        if frame is not None:
            brief.keep(position, frame)
            full.keep(position, frame)
    found, expected = brief.coordinates(), full.finish()
    assert expected.details["counts"].get("value", 0) > 1000
    for name in ("rows", "columns", "confidence"):
        a, b = getattr(found, name), getattr(expected, name)
        assert (a is None and b is None) or np.array_equal(a, b, equal_nan=True)
    assert set(found.warnings) <= set(expected.warnings)
    left_out = set(expected.warnings) - set(found.warnings)
    assert all(words.startswith(("ripple", "flicker")) for words in left_out)
    assert any("missing: 2" in warning for warning in found.warnings)


def test_a_pattern_of_wide_steps_is_warned_of_with_coordinates_alone():
    camera = CameraFormat(203, 97)
    pattern = PmpPattern(("y",), (1.0, 40.0), (8, 8))
    decoder = PmpDecoder(PatternSequence(PROJECTOR, pattern), camera)
    for position, frame in enumerate(render(pattern, camera)):
        decoder.keep(position, frame)
    assert any("unwrapped by" in warning for warning in decoder.coordinates().warnings)


def test_strips_cover_every_pixel_once():
    for pixels, threads in ((1, 2), (MIN_STRIP + 1, 2), (10 * MIN_STRIP - 3, 3), (100_000, 1)):
        strips = sorted(in_strips(lambda begin, end: (begin, end), pixels, threads))
        assert strips[0][0] == 0
        assert strips[-1][1] == pixels
        assert all(before[1] == after[0] for before, after in pairwise(strips))
        assert all(begin % MIN_STRIP == 0 for begin, _ in strips)


def test_strips_within_strips_wait_for_nobody():
    def work(begin, end):
        return sum(end - begin for begin, end in in_strips(lambda begin, end: (begin, end), end - begin, 4))

    with ThreadPoolExecutor(6) as pool:
        totals = list(pool.map(lambda _: sum(in_strips(work, 60 * MIN_STRIP, 4)), range(6)))
    assert totals == [60 * MIN_STRIP] * 6


def test_the_arctangent_is_as_good_as_it_says():
    angle = np.linspace(-np.pi, np.pi, 1250 * LANES)
    for size in (1e-3, 1.0, 30_000.0):
        frames = [(size * np.cos(angle + 2 * np.pi * n / 3) + 2 * size).astype(np.float32) for n in range(3)]
        p = (2 * frames[0] - frames[1] - frames[2]) / 3
        q = (frames[2] - frames[1]) / np.float32(np.sqrt(3))
        found = turns_of(p, q)
        exact = np.arctan2(q.astype(float), p.astype(float)) / (2 * np.pi)
        error = found - exact
        assert np.abs(error - np.rint(error)).max() <= ARCTAN_ERROR_CYCLES


def turns_of(p, q):
    """The kernel's arctangent at given sums."""
    cycles = np.empty(p.size, np.float32)
    _turns_of(p, q, cycles)
    return cycles


@contracting_kernel
def _turns_of(p, q, cycles):
    for i in range(0, p.size, LANES):
        store(cycles, i, _phase(load(p, i), load(q, i)))


@pytest.mark.parametrize("brief", [False, True])
def test_noise_is_no_fringe_where_nothing_contradicts_it(brief):
    sequence = PatternSequence(PROJECTOR, PmpPattern(("y",), (1.0,), (3,)))
    random = np.random.default_rng(0)
    decoder = PmpDecoder(sequence, CAMERA)
    for position in range(3):
        decoder.add(position, random.integers(0, 256, CAMERA.shape).astype(CAMERA.dtype))
    with pytest.raises(DecodeError, match="no fringes along y"):
        decoder.coordinates() if brief else decoder.finish()
    # Noise of a fiftieth of a cycle, and the seam of the period, are fringes all the same.
    noisy = decode(sequence.pattern, render(sequence.pattern, noise=12.0))
    assert np.isfinite(noisy.rows).mean() > 0.5


@pytest.mark.parametrize(("most", "warned"), [(0.09, True), (0.01, False)])
def test_wide_fringes_that_light_from_elsewhere_has_moved_are_told(most, warned):
    # A hollow throws light at itself: the one-cycle set's phase moves by up to `most` cycles, finer ones stay.
    rows, columns = surface()
    hollow = most * np.exp(-(np.linspace(-3, 3, CAMERA.width) ** 2))[None, :] * PROJECTOR.height
    frames = render(FRINGES, noise=1)
    frames[:4] = render(FRINGES, noise=1, shape=(rows + hollow, columns))[:4]
    decoded = decode(FRINGES, frames)
    told = [said for said in decoded.warnings if "the next one is counted" in said]
    assert len(told) == warned
    if warned:
        assert "frequencies 1 and 8 along y" in told[0]
        # Half a fringe of eight is a sixteenth of a cycle. What lies beyond is told by the surface around it, but for
        # where the pattern ends: there the one-cycle set runs out of its cycle, and cuts a corner off.
        wrong = np.abs(decoded.rows - rows) > 15
        assert 0.001 < wrong.mean() < 0.01
        assert not wrong[:-5].any()
        assert decoded.details["unwrapping"]["y"]["left_out_by_surface"] > 0.1 * rows.size
