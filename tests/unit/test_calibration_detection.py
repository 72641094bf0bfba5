"""Targets in drawn pictures: found, measured to hundredths of a pixel, and named where they are not there."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from scanner.calibration.detection import Detection, NotFound, charuco_board, detect
from scanner.calibration.discs import eccentricity, fit_ellipse
from scanner.calibration.projector_points import plain_pixels, projector_points
from scanner.calibration.target_svg import target_svg
from scanner.calibration.targets import Target, parse_target
from scanner.decode import Decoded
from scanner.errors import ConfigError
from scanner.geometry import Lens

SIZE = (900, 700)
FINE = 4
"""Pictures are drawn so many times as fine and then averaged: the edges are exact to a quarter of a sample."""
CAMERA = Lens(SIZE, np.array([[1500.0, 0, 449.5], [0, 1500.0, 349.5], [0, 0, 1]]), np.zeros(5))
POSE = np.array([0.35, -0.3, 0.1]), np.array([5.0, -4.0, 520.0])


@pytest.mark.parametrize("spec", ["chessboard:9x6:25", "charuco:8x6:28"])
def test_corners_are_measured_to_hundredths_of_a_pixel(spec: str) -> None:
    target = parse_target(spec)
    found = detect(drawn(target), target)
    assert isinstance(found, Detection)
    off = found.points - seen(target)[_matching(target, found)]
    assert len(found.ids) >= 0.9 * len(target.points)
    assert np.sqrt((off**2).mean()) < 0.02
    assert np.abs(off.mean(axis=0)).max() < 0.01


@pytest.mark.parametrize("spec", ["circles:7x5:32:18", "acircles:4x9:20:18"])
@pytest.mark.parametrize("dark", [True, False])
def test_discs_are_where_perspective_puts_their_ellipses(spec: str, dark: bool) -> None:
    target = parse_target(spec)
    found = detect(drawn(target, 60, 220) if dark else drawn(target, 200, 50), target)
    assert isinstance(found, Detection)
    rotation = np.asarray(cv2.Rodrigues(POSE[0])[0])
    centres = target.points @ rotation.T + POSE[1]
    moved = eccentricity(centres, np.tile(rotation[:, 2], (len(centres), 1)), target.diameter_mm / 2, CAMERA.project)
    order = _matching(target, found)
    raw = found.points - seen(target)[order]
    corrected = raw - moved[order]
    assert np.sqrt((corrected**2).mean()) < 0.02
    # The correction is what makes the difference: the ellipses' centres are off to one side.
    assert np.linalg.norm(raw.mean(axis=0)) > 3 * np.linalg.norm(corrected.mean(axis=0))


def test_part_of_a_charuco_board_is_enough() -> None:
    target = parse_target("charuco:8x6:28")
    picture = drawn(target)
    picture[:, 560:] = 128
    found = detect(picture, target)
    assert isinstance(found, Detection)
    assert 10 < len(found.ids) < 28
    off = found.points - seen(target)[found.ids]
    assert np.sqrt((off**2).mean()) < 0.03


def test_what_is_not_there_is_said() -> None:
    empty = np.full(SIZE[::-1], 100.0, np.float32)
    for spec, words in (
        ("chessboard:9x6:25", "no chessboard of 9 x 6"),
        ("charuco:8x6:28", "0 of 35 corners of the ChArUco board in the picture; no marker"),
        ("circles:7x5:32", "no grid of 7 x 5 circles"),
    ):
        found = detect(empty, parse_target(spec))
        assert isinstance(found, NotFound)
        assert words in found.reason
    for spec in ("chessboard:9x6:25", "circles:7x5:32"):
        assert "too small" in str(detect(np.ones((1, 8), np.float32), parse_target(spec)))
    black = detect(np.full((60, 80), np.nan, np.float32), parse_target("chessboard:9x6:25"))
    assert isinstance(black, NotFound)
    assert "black" in black.reason


@pytest.mark.parametrize("stated", ["chessboard:8x6:25", "chessboard:10x7:25"])
def test_a_chessboard_of_other_counts_is_named_with_its_own(stated: str) -> None:
    found = detect(drawn(parse_target("chessboard:9x6:25")), parse_target(stated))
    assert isinstance(found, NotFound)
    assert found.reason.endswith("; one of 9 x 6 is there (inner corners count, not squares)")


def test_a_charuco_board_of_other_counts_is_doubted_by_its_markers() -> None:
    found = detect(drawn(parse_target("charuco:8x6:28")), parse_target("charuco:6x8:28"))
    assert isinstance(found, NotFound)
    assert "24 markers were read" in found.reason
    assert "other counts than 6 x 8" in found.reason


def test_charuco_board_in_a_mirror_is_named() -> None:
    target = parse_target("charuco:8x6:28")
    found = detect(drawn(target)[:, ::-1], target)
    assert isinstance(found, NotFound)
    assert "mirror" in found.reason


def test_wedge_is_found_and_labelled(tmp_path: Path) -> None:
    target = wedge(tmp_path)
    picture = drawn_discs(target)
    found = detect(picture, target)
    assert isinstance(found, Detection)
    assert found.ids.tolist() == list(range(18))
    centres = target.points + np.array([0.0, 0.0, 700.0])
    assert target.normals is not None
    moved = eccentricity(centres, target.normals, target.diameter_mm / 2, CAMERA.project)
    off = found.points - CAMERA.project(centres) - moved
    assert np.sqrt((off**2).mean()) < 0.03


def test_ellipse_through_points_with_outliers() -> None:
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    axes = np.array([[12.0, 3.0], [1.0, 7.0]])
    points = np.column_stack((np.cos(angle), np.sin(angle))) @ axes.T + (100.0, 50.0)
    points[5] += 2.0
    fitted = fit_ellipse(points)
    assert fitted is not None
    assert fitted[0] == pytest.approx([100.0, 50.0], abs=1e-6)
    assert fitted[1] @ fitted[1].T == pytest.approx(axes @ axes.T, rel=1e-6)
    assert fit_ellipse(np.column_stack((np.arange(9.0), np.arange(9.0) ** 2 - 20))) is None


# --- the projector's pixel ------------------------------------------------------------------------------------------


def decoded(dark: bool = True) -> Decoded:
    """A plane's maps, 200 x 160, noisier where it is dark, undecided in one dark quarter, with a wrong fringe."""
    y, x = np.mgrid[:160, :200].astype(np.float64)
    w = 1 + 2e-4 * x - 1e-4 * y
    columns, rows = (300 + 0.8 * x + 0.05 * y) / w, (200 - 0.02 * x + 0.7 * y) / w
    black = (x > 100.3) == (y > 80.2) if dark else np.zeros(x.shape, bool)
    sigma = np.where(black, 0.3, 0.03)
    generator = np.random.default_rng(3)
    columns, rows = (m + sigma * generator.standard_normal(m.shape) for m in (columns, rows))
    columns[40:44, 110:130] += 18.0
    if dark:
        rows[90:, 110:] = np.nan
    maps = [m.astype(np.float32) for m in (rows, columns, sigma, sigma)]
    albedo = np.where(black, 20, 180).astype(np.float32)
    return Decoded(*maps, np.ones_like(albedo), albedo, albedo, np.zeros(albedo.shape, np.uint8))


def test_projector_point_is_fitted_around_a_corner() -> None:
    found = projector_points(decoded(), np.array([[100.3, 80.2], [np.nan, 5.0]]), np.array([50.0, 50.0]))
    w = 1 + 2e-4 * 100.3 - 1e-4 * 80.2
    true = np.array([(300 + 0.8 * 100.3 + 0.05 * 80.2) / w, (200 - 0.02 * 100.3 + 0.7 * 80.2) / w])
    assert found.points[0] == pytest.approx(true, abs=0.015)
    assert (found.sigma[0] < 0.01).all()
    assert found.slope[0] == pytest.approx(np.array([[0.72, 0.08], [-0.07, 0.71]]), abs=0.02)
    assert np.isnan(found.points[1]).all()


def test_nothing_is_extrapolated() -> None:
    maps = decoded(dark=False)
    assert maps.rows is not None
    maps.rows[:, 100:] = np.nan
    found = projector_points(maps, np.array([[120.0, 80.0]]), np.array([40.0]))
    assert np.isnan(found.points).all()


def test_pixels_beside_edges_are_mixed() -> None:
    plain = plain_pixels(decoded().albedo)
    assert not plain[80, :100].any()
    assert not plain[20, 99:103].any()
    assert plain[20, 20]


# --- targets --------------------------------------------------------------------------------------------------------


def test_targets_by_name() -> None:
    board = parse_target("chessboard:9x6:30")
    assert board.points.shape == (54, 3)
    assert board.points.mean(axis=0) == pytest.approx(0)
    assert board.longest_mm == pytest.approx(240)
    assert parse_target("charuco:10x7:30").dictionary == "DICT_4X4_50"
    assert parse_target("charuco:20x14:10").dictionary == "DICT_4X4_250"
    dots = parse_target("acircles:4x11:20")
    assert dots.points[4] - dots.points[0] == pytest.approx([20, 20, 0])
    assert dots.longest_mm == pytest.approx(200)


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("chess:9x6:30", "no known form"),
        ("chessboard:9x6", "no known form"),
        ("chessboard:9x6:x", "a length in mm"),
        ("chessboard:9x6:-3", "no length of a target"),
        ("chessboard:9x2:30", "3 x 3 inner corners"),
        ("chessboard:9,6:30", "COLUMNSxROWS"),
        ("chessboard:999x6:30", "more than 200"),
        ("charuco:10x7:30:40", "do not fit"),
        ("charuco:10x7:30:20:NONE", "no dictionary"),
        ("charuco:20x14:30:20:DICT_4X4_50", "needs 140 markers"),
        ("circles:7x5:20:25", "overlap"),
        ("acircles:1x5:20", "2 columns"),
        ("wedge:", "no known form"),
        ("wedge:missing.json", "cannot read"),
    ],
)
def test_targets_that_are_none(spec: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        parse_target(spec)


DISCS = {"format": "fringed-target", "version": 1, "diameter_mm": 14}


@pytest.mark.parametrize("depth", [0.0, 1.0])
def test_discs_on_a_line_are_refused(depth: float, tmp_path: Path) -> None:
    """In space, or as seen from the front: of a plane that is seen edge on."""
    points = [[20 * k, 0, depth * k * k] for k in range(12)]
    (tmp_path / "line.json").write_text(json.dumps({**DISCS, "points": points}))
    found = detect(drawn_discs(wedge(tmp_path)), parse_target(f"wedge:{tmp_path / 'line.json'}"))
    assert isinstance(found, NotFound)
    assert "lie on one line" in found.reason


@pytest.mark.parametrize("spec", ["circles:7x5:32:{}", "acircles:4x9:20:{}"])
def test_circles_of_another_size_than_stated_are_told(spec: str) -> None:
    """The correction for perspective goes with the square of it."""
    picture = drawn(parse_target(spec.format(18)))
    assert isinstance(detect(picture, parse_target(spec.format(19))), Detection)
    for stated in (14, 24):
        found = detect(picture, parse_target(spec.format(stated)))
        assert isinstance(found, NotFound)
        assert re.search(rf"discs are (17\.\d|18|18\.\d) mm across .* and {stated} mm by its", found.reason)


def test_target_files_that_are_none(tmp_path: Path) -> None:
    file = tmp_path / "wedge.json"
    on_a_curve = [[20 * k, k * k, 0] for k in range(12)]
    for content, words in (
        ("{", "as JSON"),
        ('{"format": "x"}', "no fringed-target"),
        ('{"format": "fringed-target", "version": 1, "points": [[1, 2, 3]], "diameter_mm": 5}', "needs 12"),
        ('{"format": "fringed-target", "version": 1, "points": [[1, 2]]}', "list of"),
        (json.dumps({**DISCS, "points": [[10**400, 2, 3]] * 12}), "list of"),
        (json.dumps({**DISCS, "points": on_a_curve, "normals": [[0, 0, 0]] * 12}), "normal 0, from 0 on, has no"),
        (json.dumps({**DISCS, "points": [*on_a_curve, [42, 4, 0]]}), "points 2 and 12"),
    ):
        file.write_text(content)
        with pytest.raises(ConfigError, match=words) as refused:
            parse_target(f"wedge:{file}")
        assert "Raises" not in str(refused.value.hint)


@pytest.mark.parametrize("spec", ["chessboard:4x3:20", "charuco:5x4:20", "chessboard:4x3:5"])
def test_printed_target_is_what_is_looked_for(spec: str) -> None:
    target = parse_target(spec)
    drawing = target_svg(target, 0.2)
    picture = _rasterised(drawing.text, drawing.width_mm, drawing.height_mm)
    found = detect(picture, target)
    assert isinstance(found, Detection)
    assert len(found.ids) == len(target.points)
    # 8 px a mm: the squares have the size that was asked for.
    step = np.linalg.norm(found.points[found.ids == 1] - found.points[found.ids == 0])
    assert step == pytest.approx(target.spacing_mm * 8, abs=0.1)
    assert f'width="{drawing.width_mm:g}mm"' in drawing.text
    assert drawing.ruler_mm <= drawing.width_mm


def test_the_ruler_of_a_small_target_is_on_the_sheet() -> None:
    for spec in ("chessboard:3x3:1", "chessboard:4x3:20", "acircles:4x11:20"):
        drawing = target_svg(parse_target(spec))
        left, length = (float(v) for v in re.search(r"M([\d.]+) [\d.]+h([\d.]+)", drawing.text).groups())  # type: ignore[union-attr]
        assert length == drawing.ruler_mm
        assert 0 < left < left + length < drawing.width_mm


def test_printed_circles_and_what_cannot_be_printed(tmp_path: Path) -> None:
    dots = parse_target("acircles:4x11:20")
    text = target_svg(dots).text
    assert text.count("<circle") == 44
    assert 'r="8"' in text
    with pytest.raises(ConfigError, match="in space"):
        target_svg(wedge(tmp_path))


# --- drawing --------------------------------------------------------------------------------------------------------


def seen(target: Target) -> np.ndarray:
    """(N, 2) px of the target's points in the standard pose."""
    return CAMERA.project(target.points @ np.asarray(cv2.Rodrigues(POSE[0])[0]).T + POSE[1])


def drawn(target: Target, ink: int = 60, paper: int = 220) -> np.ndarray:
    """A picture of the target in the standard pose: ink on paper, shaded, blurred by lens and pixel."""
    scale = 8.0  # px a mm
    half = np.array(target.half_extent) + target.spacing_mm * 1.5
    flat = np.full((2 * half[::-1] * scale).astype(int), paper, np.uint8)
    if target.discs:
        for x, y, _ in target.points:
            centre = ((np.array([x, y]) + half) * scale * 16 - 8).round().astype(int)
            cv2.circle(flat, centre.tolist(), round(target.diameter_mm / 2 * scale * 16), ink, -1, cv2.LINE_AA, 4)
    else:
        squares = (target.columns, target.rows) if target.kind == "charuco" else (target.columns + 1, target.rows + 1)
        side = round(target.spacing_mm * scale)
        if target.kind == "charuco":
            board = charuco_board(target).generateImage((squares[0] * side, squares[1] * side))
            board = np.where(board < 128, ink, paper).astype(np.uint8)
        else:
            y, x = np.indices((squares[1] * side, squares[0] * side)) // side
            board = np.where((x + y) % 2 == 0, ink, paper).astype(np.uint8)
        top, left = (np.array(flat.shape) - board.shape) // 2
        flat[top : top + board.shape[0], left : left + board.shape[1]] = board
    rotation = np.asarray(cv2.Rodrigues(POSE[0])[0])
    to_mm = np.array(
        [
            [1 / scale, 0, 0.5 / scale - flat.shape[1] / 2 / scale],
            [0, 1 / scale, 0.5 / scale - flat.shape[0] / 2 / scale],
            [0, 0, 1],
        ]
    )
    plane = CAMERA.matrix @ np.column_stack((rotation[:, :2], POSE[1])) @ to_mm
    fine = np.array([[FINE, 0, (FINE - 1) / 2], [0, FINE, (FINE - 1) / 2], [0, 0, 1.0]])
    large = cv2.warpPerspective(
        flat, fine @ plane, (SIZE[0] * FINE, SIZE[1] * FINE), flags=cv2.INTER_AREA, borderValue=120
    )
    return _sampled(large)


def drawn_discs(target: Target) -> np.ndarray:
    """A picture of discs in space, 700 mm away, as filled polygons."""
    large = np.full((SIZE[1] * FINE, SIZE[0] * FINE), 200, np.uint8)
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    assert target.normals is not None
    for centre, normal in zip(target.points + np.array([0.0, 0.0, 700.0]), target.normals, strict=True):
        u = np.cross(normal, (0.0, 1.0, 0.0))
        u /= np.linalg.norm(u)
        v = np.cross(normal, u)
        rim = centre + target.diameter_mm / 2 * (np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v)
        pixels = ((CAMERA.project(rim) + 0.5) * FINE - 0.5) * 16
        cv2.fillPoly(large, [pixels.round().astype(np.int32)], 70, cv2.LINE_AA, 4)
    return _sampled(large)


def wedge(folder: Path) -> Target:
    """The dissertation's wedge, smaller: two planes, nine discs on each, ridge towards the camera."""
    points, normals = [], []
    for side in (-1.0, 1.0):
        u = np.array([110.0, 0.0, side * 42.0]) / np.hypot(110, 42)
        normal = np.cross((0.0, 1.0, 0.0), u)
        for k in range(9):
            points.append(
                np.array([side * 55.0, 0, 0]) + (k % 3 - 1) * 34.0 * u + np.array([0, (k // 3 - 1) * 45.0, 0])
            )
            normals.append(normal if normal[2] < 0 else -normal)
    content = {"format": "fringed-target", "version": 1, "diameter_mm": 14, "points": np.array(points).tolist()}
    file = folder / "wedge.json"
    file.write_text(json.dumps({**content, "normals": np.array(normals).tolist()}))
    return parse_target(f"wedge:{file}")


def _sampled(large: np.ndarray) -> np.ndarray:
    blurred = cv2.GaussianBlur(large.astype(np.float32), (0, 0), 0.7 * FINE)
    small = blurred.reshape(SIZE[1], FINE, SIZE[0], FINE).mean(axis=(1, 3))
    # Light that falls off to the right by a half: a disc of 40 px is 3 % darker on one side.
    shade = np.linspace(1.0, 0.5, SIZE[0])[None]
    noise = np.random.default_rng(0).normal(0, 0.4, small.shape)
    return (small * shade + noise).astype(np.float32)


def _matching(target: Target, found: Detection) -> np.ndarray:
    """Numbers of the target's points in the order found: a board that looks the same upside down may be labelled so."""
    true = seen(target)
    ids = found.ids
    turned = len(target.points) - 1 - ids
    straight = np.abs(found.points - true[ids]).sum()
    return ids if straight <= np.abs(found.points - true[turned]).sum() else turned


def _rasterised(text: str, width_mm: float, height_mm: float) -> np.ndarray:
    """The SVG's rectangles, drawn at 8 px a mm."""
    import re  # noqa: PLC0415

    scale = 8
    picture = np.full((round(height_mm * scale), round(width_mm * scale)), 255, np.uint8)
    group = re.search(r'<g fill="rgb\((\d+).*?translate\(([\d.]+) ([\d.]+)\)">(.*?)</g>', text, re.DOTALL)
    assert group is not None
    level, x0, y0 = int(group[1]), float(group[2]), float(group[3])
    for x, y, w, h in re.findall(r'<rect x="([\d.]+)" y="([\d.]+)" width="([\d.]+)" height="([\d.]+)"/>', group[4]):
        left, top = (float(x) + x0) * scale, (float(y) + y0) * scale
        right, low = left + float(w) * scale, top + float(h) * scale
        picture[round(top) : round(low), round(left) : round(right)] = level
    return picture.astype(np.float32)
