"""First-generation composite pattern: the image against its formula, each stage against plain forms, refusals."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner.decode import Reason, composite, decoder_for
from scanner.errors import ConfigError, DecodeError
from scanner.patterns import (
    CameraFormat,
    CompositePattern,
    McpPattern,
    PatternSequence,
    ProjectorSize,
    pattern_from_description,
)
from scanner.patterns.sequence import Precorrection
from scanner.scan import load_scan
from service import cli
from service.scan_patterns import pattern_for

SIZE = ProjectorSize(480, 320)
SMALL = CompositePattern(carriers=(20.0, 40.0, 60.0, 80.0))
CAMERA = CameraFormat(480, 320)


def seen(pattern=SMALL, size=SIZE, albedo=1.0, ambient=10.0, level=200.0):
    """What a camera sees that is the projector."""
    return np.rint(ambient + level * albedo * pattern.fringe(0, size)).astype(np.uint8)


def decode(image, pattern=SMALL, size=SIZE):
    decoder = decoder_for(PatternSequence(size, pattern), CameraFormat(image.shape[1], image.shape[0]))
    decoder.add(0, image)
    return decoder.finish()


# --- the pattern --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", ["y", "x"])
@pytest.mark.parametrize("carriers", [(20.0, 40.0, 60.0, 80.0), (75.0, 31.5, 50.0)])
def test_the_image_follows_its_formula(axis, carriers):
    pattern = CompositePattern(axis, carriers)
    size = ProjectorSize(240, 320) if axis == "x" else ProjectorSize(320, 240)
    image = pattern.fringe(0, size)
    count = len(carriers)
    for y, x in ((0, 0), (100, 31), (239, 319), (77, 200)):
        total = 0.5
        for n, f in enumerate(carriers):
            shifted = 0.5 + 0.48 * math.cos(2 * math.pi * (y + 0.5) / 240 - 2 * math.pi * n / count)
            total += shifted * math.cos(2 * math.pi * f * (x + 0.5) / 320) / (2 * count)
        assert (image if axis == "y" else image.T)[y, x] == pytest.approx(total, abs=1e-6)
    assert image.min() >= 0
    assert image.max() <= 1
    with pytest.raises(IndexError):
        pattern.fringe(1, size)


@given(st.sampled_from(["x", "y"]), st.lists(st.integers(1, 8), min_size=3, max_size=6, unique=True), st.booleans())
@settings(max_examples=40, deadline=None)
def test_a_description_says_the_whole_sequence(axis, steps, corrected):
    pattern = CompositePattern(axis, tuple(12.5 * s for s in steps))
    sequence = PatternSequence.bracketed(SIZE, pattern, Precorrection(gamma=2.2) if corrected else None)
    assert len(sequence) == 1
    described = json.loads(json.dumps(sequence.describe()))
    assert PatternSequence.from_description(SIZE, described) == sequence


CP = {"method": "cp", "axis": "y", "carriers": [20, 40, 60, 80]}
BAD = [
    ({**CP, "axis": "z"}, '"axis"'),
    ({**CP, "carriers": []}, '"carriers"'),
    ({**CP, "carriers": [20, 40]}, "3 to 12 carriers, got 2"),
    ({**CP, "carriers": [20, "40", 60]}, '"carriers"'),
    ({**CP, "carriers": [-20, 40, 60]}, "must be positive"),
    ({**CP, "carriers": [20, 40, 45]}, "5 cycles apart"),
    ({**CP, "carriers": [8, 40, 60]}, "8 cycles apart, or that near to zero"),
    ({**CP, "carriers": [40, 80, 170]}, "2.82 projector pixels"),
]


@pytest.mark.parametrize(("description", "says"), BAD, ids=[says for _, says in BAD])
def test_a_bad_description_is_named(description, says):
    with pytest.raises(DecodeError, match=re.escape(says)):
        PatternSequence.from_description(SIZE, description)


def test_the_default_fits_the_projector_and_small_ones_get_carriers_in_proportion():
    assert pattern_for("cp", {}, "x", ProjectorSize(1152, 864)) == CompositePattern("x")
    small = pattern_for("cp", {}, "y", ProjectorSize(320, 240))
    small.validate(ProjectorSize(320, 240))
    assert small.carriers == (20.0, 40.0, 60.0, 80.0)
    assert pattern_for("cp", {"carriers": [30, 60, 90]}, "y", SIZE) == CompositePattern("y", (30.0, 60.0, 90.0))
    with pytest.raises(ConfigError, match="too small for cp"):
        pattern_for("cp", {}, "y", ProjectorSize(64, 48))


# --- stages -------------------------------------------------------------------------------------------------------


def test_envelopes_are_the_filtered_quadratures():
    rng = np.random.default_rng(0)
    x = np.arange(400)
    slow = 30 + 20 * np.cos(2 * np.pi * x / 400 + 1)
    grey = (slow * np.cos(2 * np.pi * 0.1 * x) + rng.normal(0, 1, (40, 400))).astype(np.float32)
    sigma = 0.01
    measured = composite.envelopes(grey, np.array([0.1]), sigma)[0]
    # The same by correlation with a Gaussian-windowed carrier, then a Gaussian along y.
    reach = 1 / (2 * np.pi * sigma)
    t = np.arange(-80, 81)
    kernel = np.exp(-(t**2) / (2 * reach**2)) / (reach * math.sqrt(2 * math.pi)) * np.exp(-2j * np.pi * 0.1 * t)
    lines = np.stack([2 * np.abs(np.convolve(line, kernel[::-1].conj(), mode="same")) for line in grey])
    plain = cv2.GaussianBlur(lines, (1, 2 * int(3 * reach) + 1), reach, borderType=cv2.BORDER_REFLECT)
    np.testing.assert_allclose(measured[:, 90:-90], plain[:, 90:-90], atol=0.05)
    np.testing.assert_allclose(measured[20, 90:-90], slow[90:-90], rtol=0.12)


@pytest.mark.parametrize("scale", [0.7, 1.0, 1.3])
def test_carriers_are_found_at_any_scale(scale):
    x = np.arange(600)
    projected = np.array([80.0, 20.0, 60.0, 40.0])
    waves = sum(np.cos(2 * np.pi * f * scale * x / 600 + f) for f in projected)
    noise = np.random.default_rng(1).normal(0, 0.5, (30, 600))
    found = composite.find_carriers((waves + noise).astype(np.float32), projected)
    np.testing.assert_allclose(found.frequencies * 600, scale * projected, atol=0.3)
    assert found.scale * 600 == pytest.approx(scale, rel=0.02)
    assert found.contrast > 50


# --- from end to end ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", ["y", "x"])
@pytest.mark.parametrize("carriers", [SMALL.carriers, (30.0, 110.0, 70.0)])
def test_rows_come_out_where_optics_are_perfect(axis, carriers):
    pattern = CompositePattern(axis, carriers)
    size = SIZE if axis == "y" else ProjectorSize(320, 480)
    decoded = decode(seen(pattern, size), pattern, size)
    rows = decoded.rows if axis == "y" else decoded.columns.T
    assert (decoded.columns is None) == (axis == "y")
    there = np.isfinite(rows)
    assert there.mean() > 0.8
    error = rows - np.arange(320, dtype=np.float32)[:, None]
    assert np.abs(error[there]).max() < 0.01 * 320
    assert np.nanmedian(np.abs(error)) < 1
    reason = decoded.reason if axis == "y" else decoded.reason.T
    assert ((reason == Reason.VALUE) == there).all()
    # First and last rows have the same phase.
    assert (reason[:15] == Reason.BORDER).mean() > 0.95
    assert (reason[-15:] == Reason.BORDER).mean() > 0.95
    confidence = decoded.confidence if axis == "y" else decoded.confidence.T
    assert (confidence[~there] == 0).all()
    assert (confidence[there] > 0.9).all()
    assert np.nanmedian(decoded.modulation) == pytest.approx(200 * 0.48 / (2 * len(carriers)), rel=0.05)


def test_the_stated_sigma_is_that_of_the_noise():
    rng = np.random.default_rng(3)
    clean = 40 + 120 * SMALL.fringe(0, SIZE)
    quiet = decode(np.rint(clean).astype(np.uint8))
    noise = composite.default_noise(255)
    errors = []
    for _ in range(6):
        noisy = clean + rng.normal(0, 1, clean.shape) * np.sqrt(noise.variance(clean.astype(np.float32)))
        errors.append(decode(np.clip(np.rint(noisy), 0, 255).astype(np.uint8)).rows - quiet.rows)
    measured = np.sqrt(np.nanmean(np.square(errors)))
    stated = np.sqrt(np.nanmean(np.square(quiet.sigma_rows)))
    assert 0.6 < measured / stated < 1.5


def test_shadow_clipping_and_neighbours_have_their_reasons():
    albedo = np.ones((320, 480), np.float32)
    albedo[:, :120] = 0.01
    image = seen(albedo=albedo)
    image[:, 330:] = np.clip(image[:, 330:].astype(int) * 3, 0, 255)
    decoded = decode(image)
    assert (decoded.reason[60:260, :80] == Reason.SHADOW).mean() > 0.95
    assert (decoded.reason[60:260, 400:] == Reason.CLIPPED).mean() > 0.95
    assert np.isfinite(decoded.rows[60:260, 170:280]).mean() > 0.95


def test_what_is_not_the_pattern_described_is_refused():
    image = seen()
    cases = {
        "uniform": (np.zeros_like(image), SMALL),
        "no carriers stand out": (np.random.default_rng(0).integers(0, 255, image.shape).astype(np.uint8), SMALL),
        "coarse for them: 4.0 px": (np.random.default_rng(0).integers(0, 255, (240, 320)).astype(np.uint8), SMALL),
        "in the proportions": (image, CompositePattern(carriers=(20.0, 52.0, 71.0, 97.0))),
        "turned by 90 degrees": (np.ascontiguousarray(seen(SMALL, SIZE).T), SMALL),
    }
    for message, (frame, pattern) in cases.items():
        with pytest.raises(DecodeError, match=message):
            decode(frame, pattern)
    coded = McpPattern(carriers=(20.0, 40.0, 60.0, 80.0), levels="equal")
    with pytest.raises(DecodeError, match="no shifts of one fringe"):
        decode(seen(coded))
    with pytest.raises(DecodeError, match="too few periods"):
        decode(image[:40, :40].copy())
    decoder = decoder_for(PatternSequence(SIZE, SMALL), CAMERA)
    with pytest.raises(DecodeError, match="missing"):
        decoder.finish()
    with pytest.raises(DecodeError, match="480 x 320"):
        decoder.add(0, image.T)
    with pytest.raises(DecodeError, match="given method 'mcp'"):
        composite.CompositeDecoder(PatternSequence(SIZE, replace(coded, bits=4)), CAMERA)
    with pytest.raises(DecodeError, match="no decoder 'casey2011' for method 'cp'"):
        decoder_for(PatternSequence(SIZE, SMALL), CAMERA, "casey2011")


@pytest.mark.parametrize("left_out", SMALL.carriers)
def test_a_carrier_that_the_description_leaves_out_is_named(left_out):
    described = CompositePattern(carriers=tuple(f for f in SMALL.carriers if f != left_out))
    with pytest.raises(DecodeError, match=f"that the description does not have: {left_out:.0f} cycles"):
        decode(seen(), described)


@pytest.mark.parametrize("gamma", [0.7, 1.4])
def test_overtones_of_a_wrong_gamma_are_no_further_carriers(gamma):
    light = SMALL.fringe(0, SIZE)
    image = np.rint(10 + 200 * light**gamma + np.random.default_rng(0).normal(0, 1, light.shape)).astype(np.uint8)
    assert np.isfinite(decode(image).rows).mean() > 0.5


def test_mosaics_become_grey():
    image = seen()
    camera = replace(CAMERA, mosaic="RGGB")
    upright = composite.decode_image(image, SMALL, SIZE, camera)
    assert np.nanmedian(np.abs(upright.rows - np.arange(320)[:, None])) < 4  # the mosaic's own low-pass
    with pytest.raises(DecodeError, match="unknown mosaic"):
        composite.decode_image(image, SMALL, SIZE, replace(CAMERA, mosaic="RGBW"))


def test_the_command_line_writes_and_decodes_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["patterns", "cp", "--size", "480x320", "--carriers", "20,40,60,80", "-o", "seen"]) == 0
    content = json.loads((tmp_path / "seen" / "pattern.json").read_text())
    assert pattern_from_description(content["pattern"]) == SMALL
    capture = {
        "format": "fringed-capture",
        "version": 1,
        "projector": content["projector"],
        "camera": {"width": 480, "height": 320, "bits": 8},
        "pattern": content["pattern"],
        "frames": content["images"],
    }
    (tmp_path / "seen" / "capture.json").write_text(json.dumps(capture))
    assert cli.main(["decode", "seen"]) == 0
    rows = load_scan(tmp_path / "seen" / "scan").rows
    assert np.nanmedian(np.abs(rows - np.arange(320)[:, None])) < 1
    capsys.readouterr()
    assert cli.main(["patterns", "cp", "--bits", "4", "-o", "other"]) == 2
    assert "--bits says nothing to the method cp" in capsys.readouterr().err
