"""The reference MCP decoder from end to end: one board, as the dissertation has it, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.registry import open_camera, open_projector
from scanner.clock import VirtualClock
from scanner.decode import Reason, decoder_for
from scanner.decode.mcp.casey2011 import CaseyDecoder, decode_image
from scanner.devices import CameraSettings, TriggerMode
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, PmpPattern, ProjectorSize
from scanner.patterns.sequence import Precorrection

PUBLISHED = McpPattern(carriers=(90.0, 106.0, 120.0, 132.0), codes=tuple(range(16)), levels="composite")


@pytest.fixture(scope="module")
def board():
    """One frame of the dissertation's board, its sequence and format, truth and calibration."""
    clock = VirtualClock()
    camera = open_camera("simulated", "casey2011/board?seed=0", {}, clock)
    projector = open_projector("simulated", "casey2011/board?seed=0", {}, clock)
    size = ProjectorSize(projector.capabilities.width, projector.capabilities.height)
    sequence = PatternSequence(size, PUBLISHED, precorrection=Precorrection(gamma=2.3))
    camera.apply(CameraSettings(exposure_ns=33_333_333))
    projector.load([sequence.image(0)])
    projector.show(0)
    clock.sleep_until(clock.now_ns() + 200_000_000)
    camera.start(TriggerMode.SOFTWARE)
    camera.trigger()
    frame = camera.pop(1_000_000_000).pixels.copy()
    truth, calibration, cap = camera.truth(), camera.true_calibration(), camera.capabilities
    camera.close()
    projector.close()
    return frame, sequence, CameraFormat(cap.width, cap.height, cap.bits), truth, calibration


@pytest.fixture(scope="module")
def upright(board):
    frame, sequence, camera, _truth, _calibration = board
    return decode_image(frame, PUBLISHED, sequence.projector, camera)


def test_the_board_comes_out_with_the_depth_error_of_whole_pixels(board):
    frame, sequence, camera, truth, calibration = board
    stages = {}
    decoder = decoder_for(sequence, camera, "casey2011", lambda stage: stages.update({stage.name: stage.values}))
    assert isinstance(decoder, CaseyDecoder)
    decoder.add(0, frame)
    decoded = decoder.finish()
    x, y, row, index, confidence = decoded.peaks.T
    at = y.astype(int), x.astype(int)
    h = PUBLISHED.pitch_px(sequence.projector)
    np.testing.assert_allclose(row, (index + 0.5) * h - 0.5, atol=1e-3)
    error = row - truth.rows[at]
    right = truth.lit[at] & (np.abs(error) < h / 2)
    assert right.mean() > 0.99
    assert set(index % 1) == {0, 0.25, 0.5, 0.75}
    xyz = truth.xyz[at].astype(np.float64)
    near, far = (calibration.projector.project(calibration.to_projector(xyz * s))[:, 1] for s in (0.9995, 1.0005))
    depth = np.abs(error * 0.001 * xyz[:, 2] / (far - near))
    peaks = right & (index % 1 == 0)
    assert 0.5 < np.sqrt((depth[peaks] ** 2).mean()) < 0.8
    assert len(np.unique(index[peaks])) >= 24
    assert np.isfinite(decoded.rows).sum() > 0.9 * len(decoded.peaks)
    assert any("yardstick" in said and "confidence" in said for said in decoded.warnings)
    assert (decoded.reason[np.isfinite(decoded.rows)] == Reason.VALUE).all()
    assert ((confidence > 0) & (confidence <= 1)).all()
    assert (decoded.confidence[np.isnan(decoded.rows)] == 0).all()
    named = decoded.stripes >= 0
    assert np.abs(truth.rows[named] - ((decoded.stripes[named] + 0.5) * h - 0.5)).max() < h / 2
    # The stages tell how right the code words were on the way (tables 5.1, 5.2).
    stripe = np.floor((truth.rows + 0.5) / h).astype(int)
    true = np.where(stripe % 2 == 0, stripe // 2, 0)
    shares = []
    for name in ("code", "hmm", "grown"):
        seen = stages[name]
        shares.append((seen == true)[(seen > 0) & truth.lit].mean())
    assert shares[0] > 0.75
    assert shares[0] < shares[1] <= shares[2]


def test_vertical_stripes_come_out_as_horizontal_ones_do(board, upright):
    frame, sequence, camera, _truth, _calibration = board
    size = sequence.projector
    turned = decode_image(
        np.ascontiguousarray(frame.T),
        replace(PUBLISHED, axis="x"),
        ProjectorSize(size.height, size.width),
        CameraFormat(camera.height, camera.width, camera.bits),
    )
    assert turned.rows is None
    np.testing.assert_array_equal(turned.columns, upright.rows.T)
    np.testing.assert_array_equal(turned.peaks[:, :2], upright.peaks[:, 1::-1])


def test_an_image_upside_down_comes_out_as_the_upright_one_does(board, upright):
    frame, sequence, camera, _truth, _calibration = board
    turned = decode_image(np.ascontiguousarray(frame[::-1, ::-1]), PUBLISHED, sequence.projector, camera)
    assert turned.details["upside_down"]
    assert "upside_down" not in upright.details
    back = turned.stripes[::-1, ::-1]
    both = (back >= 0) & (upright.stripes >= 0)
    assert both.sum() > 0.9 * (upright.stripes >= 0).sum()
    assert (back == upright.stripes)[both].all()
    x, y, row, *_ = turned.peaks.T
    np.testing.assert_array_equal(turned.rows[y.astype(int), x.astype(int)], row)


def test_a_pattern_turned_by_90_degrees_is_named(board):
    frame, sequence, camera, _truth, _calibration = board
    other_way = CameraFormat(camera.height, camera.width, camera.bits)
    for turned in (frame.T, frame.T[:, ::-1]):
        with pytest.raises(DecodeError, match="turned by 90 degrees"):
            decode_image(np.ascontiguousarray(turned), PUBLISHED, sequence.projector, other_way)
    described = replace(PUBLISHED, axis="x")
    with pytest.raises(DecodeError, match="turned by 90 degrees") as refused:
        decode_image(frame, described, ProjectorSize(864, 1152), camera)
    assert "axis" in refused.value.hint


def test_what_is_not_the_pattern_described_is_refused(board):
    frame, sequence, camera, _truth, _calibration = board
    noise = np.random.default_rng(0).integers(0, 255, frame.shape).astype(np.uint8)
    cases = {
        "uniform": (np.zeros_like(frame), PUBLISHED),
        "no carriers stand out": (noise, PUBLISHED),
        "no carriers": (frame, McpPattern()),
        "contradict": (frame, replace(PUBLISHED, codes=McpPattern().codes)),
    }
    for message, (image, pattern) in cases.items():
        with pytest.raises(DecodeError, match=message):
            decode_image(image, pattern, sequence.projector, camera)


def test_the_name_goes_with_mcp_alone():
    size, camera = ProjectorSize(128, 96), CameraFormat(160, 120)
    with pytest.raises(DecodeError, match="no decoder 'casey2011' for method 'pmp'") as refused:
        decoder_for(PatternSequence(size, PmpPattern()), camera, "casey2011")
    assert "casey2011 (mcp)" in refused.value.hint
    with pytest.raises(DecodeError, match="no decoder 'best' for method 'mcp'"):
        decoder_for(PatternSequence(ProjectorSize(1152, 864), PUBLISHED), camera, "best")
