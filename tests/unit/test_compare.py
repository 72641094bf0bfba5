"""Comparison with truth: figures that can be worked out by hand."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from scanner.colours import grouped, text_width
from scanner.compare import Errors, captions, compare, inside
from scanner.devices import Truth
from scanner.errors import DecodeError
from scanner.filter_settings import FilterSettings
from scanner.scan import build_scan

KEEP_ALL = FilterSettings(edges=False)


@pytest.fixture(scope="module")
def scan(ball):
    return build_scan(ball.decoded(), ball.calibration, KEEP_ALL)


def test_an_exact_scan_has_no_error(ball, scan):
    found = compare(scan, ball.truth, period_px=10)
    assert found.lit.lit == found.lit.decided == ball.lit.sum()
    assert found.lit.coverage == found.lit.point_coverage == 1
    assert found.lit.wrong == found.outside_lit == 0
    assert found.lit.depth_mm.rms < 1e-3
    assert found.lit.rows_px.rms < 1e-4
    assert found.lit.columns_px is None
    assert 0 < found.inside.lit < found.lit.lit


def test_figures_of_a_known_error(ball, scan):
    xyz, rows = scan.xyz.copy(), scan.rows.copy()
    xyz[..., 2] += np.float32(0.5)
    rows[100, 100] += 6  # wrong period
    xyz[120, 100, 2] += 30  # wrong depth
    reason = scan.reason.copy()
    rows[50, 60:70] = np.nan
    xyz[50, 60:70] = np.nan
    reason[50, 60:67], reason[50, 67:70] = 3, 4
    found = compare(replace(scan, xyz=xyz, rows=rows, reason=reason), ball.truth, period_px=10)
    assert found.lit.decided == ball.lit.sum() - 10
    assert found.lit.wrong == 2
    assert found.undecided.sum() == 10
    assert (found.lit.too_dark, found.lit.undecided) == (7, 3)
    assert found.lit.coverage + found.lit.too_dark_share + found.lit.undecided_share == pytest.approx(1)
    assert found.lit.depth_mm.median == pytest.approx(0.5, abs=1e-3)
    n = found.lit.depth_mm.count
    assert found.lit.depth_mm.rms == pytest.approx(np.sqrt(0.25 + (30.5**2 - 0.25) / n), rel=1e-3)
    assert found.lit.rows_px.rms == pytest.approx(6 / np.sqrt(n), rel=1e-3)
    assert compare(replace(scan, rows=rows), ball.truth).lit.wrong == 0


def test_values_where_no_light_falls_are_counted(ball, scan):
    lit = ball.lit.copy()
    lit[:20] = False
    truth = Truth(ball.truth.rows, ball.truth.columns, ball.truth.xyz, lit)
    found = compare(scan, truth)
    assert found.outside_lit == ball.lit[:20].sum()
    assert found.unlit_points == np.isfinite(scan.xyz[:20, :, 2]).sum() > 0
    assert found.outside_lit_share == pytest.approx(found.outside_lit / ball.lit.sum())
    assert found.lit.lit == lit.sum()


def test_inside_is_seven_pixels_from_edges_and_shadows(ball):
    lit = ball.truth.lit.copy()
    lit[:, :40] = False
    truth = Truth(ball.truth.rows, ball.truth.columns, ball.truth.xyz, lit)
    clear = inside(truth)
    assert not clear[:, :46].any()
    assert clear[5, 50:300].all()  # wall, far from the sphere
    assert clear[120, 160]  # the sphere's middle
    on_ball = ball.truth.xyz[120, :, 2] < 700
    first = np.flatnonzero(on_ball)[0]
    assert not clear[120, first - 7 : first + 7].any()


def test_without_a_calibration_rows_are_compared(ball):
    scan = build_scan(ball.decoded(0.1))
    found = compare(scan, ball.truth, period_px=10)
    assert found.unit == "px"
    assert found.lit.depth_mm is None
    assert found.lit.rows_px.rms == pytest.approx(0.1, rel=0.02)
    assert found.picture().shape[2] == 3


def test_figures_are_plain_data(ball, scan):
    content = json.loads(json.dumps(compare(scan, ball.truth).as_dict(), allow_nan=False))
    assert content["lit"]["depth_mm"]["count"] == ball.lit.sum()
    assert content["inside_px"] == 7


def test_nothing_decided_is_no_error(ball):
    nothing = np.full((240, 320), np.nan, np.float32)
    dark = replace(ball.decoded(), rows=nothing, sigma_rows=nothing, reason=np.ones((240, 320), np.uint8))
    found = compare(build_scan(dark, ball.calibration), ball.truth)
    assert found.lit.depth_mm == Errors(0, None, None, None, None)
    assert found.lit.wrong_share == 0
    json.dumps(found.as_dict(), allow_nan=False)
    assert found.picture().dtype == np.uint8


def test_the_error_map_shows_where_errors_are(ball, scan):
    off = scan.xyz.copy()
    off[120:130, 20:60, 2] += 1
    flat, marked = (compare(s, ball.truth).picture() for s in (scan, replace(scan, xyz=off)))
    assert flat.dtype == np.uint8
    assert (flat != marked).any()


def test_the_error_map_names_the_pixels_of_its_figures(ball, scan):
    found = compare(scan, ball.truth)
    said = captions(found)
    for line, name, region in zip(
        said, ("all that is lit", "7 px and more from edges"), (found.lit, found.inside), strict=True
    ):
        assert line.startswith(f"{name}: rms {region.depth_mm.rms:.3f} mm")
        assert f" wrong of {grouped(region.decided)} decided ({100 * region.coverage:.2f} %)" in line
        assert text_width(line, size=16) < 1140, "beside it stands what the colour of undecided pixels is"


def test_truth_of_another_camera_is_refused(ball, scan):
    part = Truth(*(getattr(ball.truth, name)[:100] for name in ("rows", "columns", "xyz", "lit")))
    with pytest.raises(DecodeError, match="320 x 100"):
        compare(scan, part)
