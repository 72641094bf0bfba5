"""Repetitions of a sequence: their mean, their scatter, and what is left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scanner.capture import Capture, CaptureHeader, CaptureWriter, FrameRecord
from scanner.decode import Decoded, Reason
from scanner.decode.repeated import Repetitions
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize
from scanner.reconstruct import reconstruct

SHAPE = (60, 80)
SIGMA = 0.1


def decoding(random, *, sigma=SIGMA, offset=0.0, period=None, lost=None, warnings=()):
    """One repetition of a plane, with noise; optionally some pixels a period off, and some lost."""
    rows = np.linspace(100, 160, SHAPE[0] * SHAPE[1]).reshape(SHAPE) + offset + random.normal(0, SIGMA, SHAPE)
    if period is not None:
        rows[:5] += period
    reason = np.zeros(SHAPE, np.uint8)
    if lost is not None:
        rows[lost] = np.nan
        reason[lost] = Reason.LOW_MODULATION
    full = np.full(SHAPE, np.float32(1))
    sigmas = np.where(reason == 0, np.float32(sigma), np.float32(np.nan))
    return Decoded(rows.astype(np.float32), None, sigmas, None, full, full * 90, full * 40, reason, warnings=warnings)


def mean_of(decodings, ambiguity=16.0):
    repetitions = Repetitions(len(decodings), ambiguity)
    for each in decodings:
        repetitions.add(each)
    return repetitions.result()


def test_noise_falls_with_the_root_of_the_count_and_sigma_says_so():
    random = np.random.default_rng(1)
    mean = mean_of([decoding(random) for _ in range(16)])
    truth = np.linspace(100, 160, SHAPE[0] * SHAPE[1]).reshape(SHAPE)
    assert np.std(mean.rows - truth) == pytest.approx(SIGMA / 4, rel=0.05)
    assert mean.sigma_rows == pytest.approx(np.full(SHAPE, SIGMA / 4), rel=1e-3)
    assert mean.columns is None
    assert np.all(mean.albedo == 90)
    assert mean.warnings == ()


def test_the_cells_of_a_code_are_as_wide_in_the_mean_of_sixteen():
    random = np.random.default_rng(1)
    repetitions = Repetitions(16, None, quantised=True)
    for _ in range(16):
        repetitions.add(decoding(random))
    assert repetitions.result().sigma_rows == pytest.approx(np.full(SHAPE, SIGMA), rel=1e-3)


@pytest.mark.parametrize("count", [2, 3, 5, 20])
def test_the_scatter_is_measured_not_believed(count):
    random = np.random.default_rng(2)
    mean = mean_of([decoding(random, sigma=SIGMA / 3) for _ in range(count)])
    found = mean.details["repetitions"]["rows"]
    assert found["measured_px"] == pytest.approx(SIGMA, rel=0.06)
    assert found["stated_px"] == pytest.approx(SIGMA / 3, rel=1e-3)
    assert any("3.0 times" in said or "2.9 times" in said or "3.1 times" in said for said in mean.warnings)


def test_a_scene_that_moved_is_said():
    random = np.random.default_rng(3)
    mean = mean_of([decoding(random, offset=0.5 * n) for n in range(4)])
    assert "moved or the light changed" in mean.warnings[0]
    # Four at 0, .5, 1 and 1.5: their standard deviation over the root of four, and Student's factor for so few.
    common = 1.653 * np.std([0, 0.5, 1, 1.5], ddof=1)
    assert np.median(mean.sigma_rows) == pytest.approx(np.hypot(common, SIGMA) / 2, rel=0.15)
    assert mean.sigma_rows.min() > 3 * SIGMA / 2


@pytest.mark.parametrize("count", [2, 3, 5])
def test_two_sigmas_of_few_repetitions_that_moved_cover_the_truth(count):
    random, covered = np.random.default_rng(7), []
    truth = np.linspace(100, 160, SHAPE[0] * SHAPE[1]).reshape(SHAPE)
    for _ in range(100):
        mean = mean_of([decoding(random, offset=random.normal(0, 2)) for _ in range(count)])
        covered.append(np.abs(np.median(mean.rows - truth)) < 2 * np.median(mean.sigma_rows))
    assert 0.9 <= np.mean(covered) <= 0.99


def test_what_moved_all_pixels_alike_does_not_multiply_their_noise():
    random = np.random.default_rng(8)
    stated = SIGMA / 3 * np.exp(random.normal(0, 0.8, SHAPE))
    for offsets, noise in ((random.normal(0, 0.5, 8), 1.0), (np.zeros(8), 3.0)):
        decodings = []
        for offset in offsets:
            one = decoding(random, sigma=1.0)
            rows = np.linspace(100, 160, stated.size).reshape(SHAPE) + offset + noise * random.normal(0, stated)
            decodings.append(replace(one, rows=rows.astype(np.float32), sigma_rows=stated.astype(np.float32)))
        mean = mean_of(decodings)
        common = 1.215 * np.std(offsets, ddof=1)  # Student's factor for eight
        wanted = np.sqrt((noise * stated) ** 2 + common**2) / np.sqrt(8)
        quiet, noisy = stated < np.median(stated), stated > np.quantile(stated, 0.9)
        for part in (quiet, noisy):
            assert np.median(mean.sigma_rows[part] / wanted[part]) == pytest.approx(1, abs=0.1)


def test_a_part_that_moved_has_sigmas_of_its_own():
    random = np.random.default_rng(3)
    mean = mean_of([decoding(random), decoding(random, period=3.0)])
    assert mean.warnings == ()
    assert mean.sigma_rows[:5] == pytest.approx(np.full((5, SHAPE[1]), 3 / 2), rel=0.35)
    assert mean.sigma_rows[5:] == pytest.approx(np.full((SHAPE[0] - 5, SHAPE[1]), SIGMA / np.sqrt(2)), rel=1e-3)


def test_a_pixel_that_was_once_on_another_fringe_is_undecided():
    random = np.random.default_rng(4)
    mean = mean_of([decoding(random), decoding(random, period=16.0), decoding(random)])
    assert np.all(mean.reason[:5] == Reason.UNWRAP_RISK)
    assert np.isnan(mean.rows[:5]).all()
    assert np.all(mean.reason[5:] == Reason.VALUE)
    assert mean.details["repetitions"]["contradicting"] == 5 * SHAPE[1]


def test_a_value_needs_more_than_half_of_the_repetitions():
    random = np.random.default_rng(5)
    once, twice = np.s_[:, :10], np.s_[:, :20]
    mean = mean_of([decoding(random), decoding(random, lost=twice), decoding(random, lost=once)])
    assert np.all(mean.reason[:, :10] == Reason.LOW_MODULATION)
    assert np.all(mean.reason[:, 10:] == Reason.VALUE)
    assert mean.sigma_rows[0, 15] == pytest.approx(SIGMA / np.sqrt(2))
    assert mean.sigma_rows[0, 30] == pytest.approx(SIGMA / np.sqrt(3))


def test_a_single_repetition_is_what_was_decoded():
    one = decoding(np.random.default_rng(6), warnings=("so",))
    assert mean_of([one]) is one


def test_nothing_is_no_mean():
    with pytest.raises(ValueError, match="no repetition"):
        Repetitions(3, None).result()


PROJECTOR = ProjectorSize(96, 80)
SEQUENCE = PatternSequence.bracketed(PROJECTOR, PmpPattern(frequencies=(1.0, 8.0), shifts=(4, 4)))


def captured(folder, patterns, sequence=SEQUENCE):
    """A folder with these of the frames of three repetitions, seen by a camera that looks through the projector."""
    header = CaptureHeader(sequence, CameraFormat(PROJECTOR.width, PROJECTOR.height, 8), id="test", repeat=3)
    writer = CaptureWriter(folder, header, header.frame_count)
    random = np.random.default_rng(7)
    for pattern in patterns:
        image = 20 + 0.8 * sequence.image(pattern % len(sequence)) + random.normal(0, 1, (80, 96))
        slot, digest = writer.write(np.rint(image).clip(0, 255).astype(np.uint8))
        writer.record(FrameRecord(slot, pattern, xxh3=digest))
    writer.close("complete")
    return Capture.open(folder)


def test_a_captures_repetitions_are_averaged(tmp_path):
    scan = reconstruct(captured(tmp_path / "c", range(3 * len(SEQUENCE))), None)
    found = scan.report["decoder"]["repetitions"]
    assert (found["captured"], found["decoded"]) == (3, 3)
    assert found["rows"]["ratio"] == pytest.approx(1, abs=0.15)
    error = scan.rows - np.arange(80)[:, None]
    once = reconstruct(captured(tmp_path / "once", range(len(SEQUENCE))), None).rows - np.arange(80)[:, None]
    assert np.nanstd(error) < 0.9 * np.nanstd(once)
    assert scan.report["warnings"] == []


def test_one_list_says_what_a_scan_as_a_whole_cannot_reveal(tmp_path):
    bare = PatternSequence(PROJECTOR, SEQUENCE.pattern, sentinels=(0, 1, 2, 11, 12, 13))
    hidden = "frequency 1 shown 1, 2, 3 of its 4 shifts late or early as a whole"
    for name, sequence, blind in (("bars", SEQUENCE, []), ("none", bare, [hidden])):
        scan = reconstruct(captured(tmp_path / name, range(3 * len(sequence)), sequence), None)
        assert "cannot_reveal" not in scan.report["decoder"]
        assert "cannot_reveal" not in scan.report["sync"]
        found = scan.report["cannot_reveal"]
        assert [text for text in found if "order bars" not in text] == blind
        assert ("sets along y that are all rotated or reversed alike (no order bars)" in found) == (name == "none")


def test_a_repetition_that_cannot_be_decoded_is_left_out_and_named(tmp_path):
    count = len(SEQUENCE)
    lost = {count + p for p in range(count) if p in SEQUENCE.fringes}
    scan = reconstruct(captured(tmp_path / "c", [p for p in range(3 * count) if p not in lost]), None)
    assert scan.report["decoder"]["repetitions"]["decoded"] == 2
    assert any("repetition 2 was left out" in said for said in scan.report["warnings"])


def test_repetitions_without_frames_are_told(tmp_path):
    scan = reconstruct(captured(tmp_path / "c", range(len(SEQUENCE))), None)
    assert "2 of 3 repetitions have no frames" in scan.report["warnings"]


def test_none_that_can_be_decoded_is_an_error(tmp_path):
    with pytest.raises(DecodeError):
        reconstruct(captured(tmp_path / "c", range(3)), None)
