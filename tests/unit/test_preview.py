"""Pictures: that they show what they should, whatever the scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scanner.colours import PANEL, Scale, fit, grouped, scale_of, text, text_width, ticks
from scanner.filter_settings import FilterSettings
from scanner.preview import figures, left_out, preview_picture
from scanner.render import View, render
from scanner.scan import build_scan


@pytest.fixture(scope="module")
def scan(ball):
    return build_scan(ball.decoded(0.02), ball.calibration)


def differs(a, b, box):
    x, y, w, h = box
    return (a[y : y + h, x : x + w] != b[y : y + h, x : x + w]).any()


def test_four_panels_show_the_scan(scan):
    picture = preview_picture(scan)
    assert picture.shape == (1200, 1920, 3)
    assert picture.dtype == np.uint8
    other = replace(scan, albedo=scan.albedo[:, ::-1].copy())
    other.albedo[:, :100] *= np.float32(0.3)
    changed = preview_picture(other)
    assert differs(picture, changed, (1292, 450, 600, 360))
    assert not differs(picture, changed, (1292, 84, 600, 350))


def test_the_title_says_what_its_figures_are(scan):
    with_budget = scan.with_report(uncertainty={"within_mm": 0.1514, "unknown": ["calibration"]})
    told = {caption: words for words, caption in figures(with_budget)}
    assert "mm depth (1st to 99th percentile)" in told
    assert told["mm for 95 % of points"] == "± 0.15"
    assert float(told["mm random (k = 2)"].removeprefix("± ")) == pytest.approx(
        2 * np.nanmedian(scan.sigma_z), rel=0.05
    )
    assert left_out(with_budget) == "unknown, and not in it: calibration"
    below = np.s_[58:80, 140:]
    assert preview_picture(with_budget)[below].std() > 2 * preview_picture(scan)[below].std()
    of_code = scan.with_report(uncertainty={"within_mm": 0.1514, "random_mm": 0.0, "unknown": []})
    assert "mm random (k = 2)" not in {caption for _, caption in figures(of_code)}
    of_mcp = scan.with_report(uncertainty={"within_mm": 0.1514, "unknown": ["method"]})
    assert ("at least ± 0.15", "mm for 95 % of points") in figures(of_mcp)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_without_a_calibration_the_rows_or_columns_are_shown(rig_of, scene_with, axis):
    scene = scene_with(rig_of(axis), lambda x, y: np.full(x.shape, 700.0))
    picture = preview_picture(build_scan(scene.decoded(axis=axis)))
    middle = picture[600, 200:1000].astype(int)
    changes = np.abs(np.diff(middle, axis=0)).sum()
    assert (changes > 200) == (axis == "x")


def test_a_scan_without_points_and_one_without_anything_still_have_a_picture(ball):
    nothing = build_scan(ball.decoded(), ball.calibration, FilterSettings(depth=(1.0, 2.0)))
    assert preview_picture(nothing).shape == (1200, 1920, 3)
    dark = replace(
        ball.decoded(),
        rows=np.full((240, 320), np.nan, np.float32),
        sigma_rows=np.full((240, 320), np.nan, np.float32),
        albedo=np.full((240, 320), np.nan, np.float32),
        reason=np.ones((240, 320), np.uint8),
    )
    assert preview_picture(build_scan(dark, ball.calibration)).shape == (1200, 1920, 3)
    assert preview_picture(build_scan(dark)).shape == (1200, 1920, 3)


def test_the_view_frames_the_cloud_and_ignores_a_far_point(ball):
    albedo = np.full((240, 320), 100.0, np.float32)
    xyz = np.where(ball.truth.xyz[..., 2:] < 700, ball.truth.xyz, np.nan).astype(np.float32)
    empty = render(np.full_like(xyz, np.nan), albedo, (400, 300)).astype(int)
    for far in (False, True):
        if far:
            xyz[5, 5] = (-4000, -4000, 9000)
        drawn = np.abs(render(xyz, albedo, (400, 300)).astype(int) - empty).sum(axis=-1) > 30
        assert 0.2 < drawn.mean() < 0.8
        assert abs(np.argwhere(drawn).mean(axis=0) - (150, 200)).max() < 30


def test_no_sheet_closes_a_depth_edge(ball):
    """From the side, nothing is drawn between sphere and wall."""
    albedo = np.full((240, 320), 100.0, np.float32)
    side = View(azimuth_deg=80, elevation_deg=0)
    whole = render(ball.truth.xyz, albedo, (400, 300), side).astype(int)
    empty = render(np.full_like(ball.truth.xyz, np.nan), albedo, (400, 300)).astype(int)
    drawn = (np.abs(whole - empty).sum(axis=-1) > 30)[150]
    assert drawn.any()
    first, last = np.flatnonzero(drawn)[[0, -1]]
    assert (~drawn[first:last]).sum() > 20


def test_a_picture_is_the_same_every_time(scan):
    np.testing.assert_array_equal(preview_picture(scan), preview_picture(scan))


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0, 1, [0, 0.2, 0.4, 0.6, 0.8, 1.0]),
        (1150, 1346, [1150, 1200, 1250, 1300]),
        (-0.2, 0.2, [-0.2, -0.1, 0.0, 0.1, 0.2]),
        (3, 3, [3]),
    ],
)
def test_ticks_are_round_numbers(low, high, expected):
    assert ticks(low, high) == pytest.approx(expected)


def test_missing_values_are_neutral_and_limits_hold():
    values = np.array([[np.nan, 0.0, 5.0, 10.0, 99.0, np.inf]])
    colours = Scale(0, 10, "viridis").apply(values)
    assert tuple(colours[0, 0]) == PANEL
    np.testing.assert_array_equal(colours[0, 3], colours[0, 4])
    assert scale_of(np.full((3, 3), 7.0), "grey").low < 7
    reverse = Scale(0, 10, "viridis", reverse=True).apply(values)
    np.testing.assert_array_equal(reverse[0, 1], colours[0, 3])


def test_a_reduced_map_is_the_mean_of_what_is_there():
    values = np.full((40, 60), 3.0, np.float32)
    values[:, :30] = np.nan
    values[0, 40] = np.nan
    small = fit(values, 20, 20)
    assert small.shape == (13, 20)
    assert np.isnan(small[:, :9]).all()
    np.testing.assert_allclose(small[:, 11:], 3.0, rtol=1e-6)
    assert fit(values[:10, :10], 200, 300).shape == (200, 200)


def test_a_map_of_lines_is_missing_only_between_them():
    values = np.full((90, 120), np.nan, np.float32)
    values[::9, :60] = 5  # the peaks of stripes, on half of the picture
    small = fit(values, 40, 30)
    lines = small[::3]
    np.testing.assert_allclose(lines[:, :20], 5, rtol=1e-6)
    assert np.isnan(lines[:, 20:]).all()


def test_points_without_neighbours_are_drawn(ball):
    lines, albedo = ball.truth.xyz.copy(), np.full((240, 320), 100.0, np.float32)
    lines[np.arange(len(lines)) % 9 != 0] = np.nan
    drawn = render(lines, albedo, (300, 200))
    empty = render(np.full_like(lines, np.nan), albedo, (300, 200))
    bright = drawn.max(axis=-1) > empty.max() + 20
    assert bright.sum() > 300


def test_lettering():
    picture = np.zeros((40, 300, 3), np.uint8)
    width = text(picture, "1 234.5 mm ±σ", (290, 30), align="right")
    assert width == text_width("1 234.5 mm ±σ") > 60
    columns = np.flatnonzero(picture.any(axis=(0, 2)))
    assert abs(columns[-1] - 290) < 6
    assert abs(columns[0] - (290 - width)) < 6
    assert grouped(1234567) == "1 234 567"
    assert grouped(-0.25, 2) == "−0.25"
