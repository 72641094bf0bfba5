"""Sigmas at changes of brightness: the plain form, what a blurred edge really does, and what stays as it was."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from scanner.contrast import BLUR_VARIANCE_PX2, blur_variance_of, widen_at_edges
from scanner.decode import decoder_for
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize
from scanner.scan import Scan, build_scan


def scan_of(rows, modulation, sigma=0.02):
    nothing = np.isnan(rows)
    maps = {"confidence": np.where(nothing, 0, 1), "albedo": modulation, "modulation": modulation}
    return Scan(
        rows=rows,
        columns=None,
        sigma_rows=np.where(nothing, np.nan, sigma).astype(np.float32),
        sigma_columns=None,
        reason=nothing.astype(np.uint8),
        **{name: values.astype(np.float32) for name, values in maps.items()},
    )


def plain(rows, modulation, sigma):
    """One pixel after the other: central differences, or what is left of them where a neighbour has no value."""
    out = np.full_like(sigma, np.nan)
    height, width = rows.shape
    for y, x in np.argwhere(np.isfinite(rows)):
        pull = 0.0
        for dy, dx in ((0, 1), (1, 0)):
            ends = [(max(y - dy, 0), max(x - dx, 0)), (min(y + dy, height - 1), min(x + dx, width - 1))]
            dark, bright = (modulation[at] for at in ends)
            kept = [at if np.isfinite(rows[at]) else (y, x) for at in ends]
            apart = max(abs(kept[1][0] - kept[0][0]), abs(kept[1][1] - kept[0][1]))
            if apart:
                pull += (bright - dark) / (bright + dark) * (rows[kept[1]] - rows[kept[0]]) / apart
        out[y, x] = np.hypot(sigma[y, x], BLUR_VARIANCE_PX2 * pull)
    return out


def test_sigmas_are_those_of_the_plain_form():
    random = np.random.default_rng(5)
    rows = (np.mgrid[:60, :80][0] * 0.8 + random.normal(0, 0.3, (60, 80))).astype(np.float32)
    rows[random.random(rows.shape) < 0.15] = np.nan
    rows[20:30, 40:] = np.nan
    scan = scan_of(rows, random.uniform(5, 90, rows.shape))
    found = widen_at_edges(scan, "y")
    np.testing.assert_allclose(found.sigma_rows, plain(rows, scan.modulation, scan.sigma_rows), rtol=1e-4)
    assert found.rows is scan.rows
    assert found.report["sigma_rows_px"]["median"] > 0.02


def test_an_even_surface_keeps_its_sigmas():
    rows = np.mgrid[:60, :80][0].astype(np.float32)
    scan = scan_of(rows, np.full(rows.shape, 50.0))
    np.testing.assert_array_equal(widen_at_edges(scan, "y").sigma_rows, scan.sigma_rows)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_points_at_a_printed_edge_lie_within_what_is_stated(axis, rig_of, scene_with):
    """A board with dark squares, seen through a blur of .7 px: depth is off at their edges, and the sigmas say so."""
    scene = scene_with(rig_of(axis), lambda x, y: 700 + 200 * x + 60 * y)
    truth = scene.truth.rows if axis == "y" else scene.truth.columns
    projector, camera = ProjectorSize(*scene.calibration.projector.size), CameraFormat(320, 240)
    y, x = np.mgrid[:240, :320]
    albedo = np.where((x // 17 + y // 13) % 2, 0.9, 0.1)
    sequence = PatternSequence(projector, PmpPattern((axis,), (1.0, 8.0, 24.0), (8, 8, 8)))
    decoder, random = decoder_for(sequence, camera), np.random.default_rng(2)
    for position in range(len(sequence)):
        f, n = sequence.pattern.frequencies[position // 8], position % 8
        phase = 2 * np.pi * f * (truth + 0.5) / projector.along(axis) - 2 * np.pi * n / 8
        light = albedo * np.where(scene.lit, 110 * (1 + 0.96 * np.cos(phase)), 0) + 8
        seen = cv2.GaussianBlur(light, (0, 0), 0.7) + random.normal(0, 0.8, light.shape)
        decoder.add(position, np.rint(np.clip(seen, 0, 255)).astype(np.uint8))
    plain_scan = build_scan(decoder.finish(), scene.calibration)
    found = widen_at_edges(plain_scan, axis)
    error = np.abs(found.xyz[..., 2] - scene.truth.xyz[..., 2])
    known = np.isfinite(error)
    shares = [[np.mean(error[known] < k * s.sigma_z[known]) for k in (1, 2)] for s in (plain_scan, found)]
    assert shares[0][1] < 0.9
    assert 0.60 < shares[1][0] < 0.80
    assert 0.92 < shares[1][1] < 0.985


@pytest.mark.parametrize("blur_px", [0.5, 0.8, 1.3])
def test_a_textured_scene_tells_the_cameras_blur(blur_px):
    """A bent board with print on it: the pull is what a Gaussian's first moment makes of a slope."""
    random = np.random.default_rng(7)
    y, x = np.mgrid[:900, :1200].astype(np.float32)
    rows = (0.8 * y + 12 * np.sin(x / 90)).astype(np.float32)
    print_ = np.where((x // 9 + y // 9) % 2, 0.9, 0.15).astype(np.float32)
    seen = cv2.GaussianBlur(print_, (0, 0), blur_px)
    pulled = cv2.GaussianBlur(print_ * rows, (0, 0), blur_px) / seen
    values = pulled + random.normal(0, 0.03, rows.shape).astype(np.float32)
    sigma = np.full_like(values, 0.03)
    found = blur_variance_of(values, sigma, 80 * seen)
    assert np.sqrt(found) == pytest.approx(blur_px, rel=0.2)
    assert blur_variance_of(rows + random.normal(0, 0.03, rows.shape), sigma, 80 * np.ones_like(seen)) is None
    assert blur_variance_of(values[:200, :200], sigma[:200, :200], seen[:200, :200]) is None
