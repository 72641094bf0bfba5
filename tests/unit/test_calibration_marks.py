"""Witness marks, plates and epipolar residuals: what has moved is found, by how much, and what is hidden is said."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from scanner.calibration.drift import drift_of
from scanner.calibration.marks import Marks, load_marks, measured_marks, parse_marks, reference_marks
from scanner.calibration.watch import watched
from scanner.capture import CaptureHeader
from scanner.errors import CalibrationError, DecodeError
from scanner.geometry import Calibration
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize
from scanner.scan import Scan
from tests.unit.calibration_bench import made_up_rig

SIZE = (400, 300)
"""of the picture; 0.5 mm a pixel, at 500 mm"""
PLACES = [(60.0, 60.0), (330.0, 70.0), (200.0, 240.0)]
PLATE = (140, 100, 120, 60)


def field(noise_mm: float = 0.02, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Albedo with three dark discs, 20 px across, and the plane they stand on."""
    fine = np.full((SIZE[1] * 4, SIZE[0] * 4), 200, np.uint8)
    for x, y in PLACES:
        cv2.circle(fine, (round(8 * x + 3), round(8 * y + 3)), 80, 60, -1, cv2.LINE_AA, 1)  # in half pixels
    albedo = cv2.resize(fine, SIZE, interpolation=cv2.INTER_AREA).astype(np.float32)
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float64)
    generator = np.random.default_rng(seed)
    z = 500 + generator.normal(0, noise_mm, x.shape)
    return albedo + generator.normal(0, 0.5, x.shape), np.stack((0.5 * x, 0.5 * y, z), axis=-1).astype(np.float32)


@pytest.fixture(scope="module")
def marks() -> Marks:
    albedo, xyz = field()
    near = [(x + 6, y - 9) for x, y in PLACES]
    return reference_marks(albedo, xyz, near, PLATE, "rig-1")


def test_marks_are_found_beside_where_they_were_pointed_at(marks: Marks) -> None:
    assert np.array([mark.at for mark in marks.points]) == pytest.approx(np.array(PLACES), abs=0.05)
    assert [mark.xyz[2] for mark in marks.points] == pytest.approx([500.0] * 3, abs=0.02)
    assert marks.plate is not None
    assert marks.plate.normal == pytest.approx((0, 0, -1), abs=1e-3)


def test_nothing_moved_is_within_the_noise(marks: Marks) -> None:
    found = measured_marks(marks, *field(seed=1))
    assert found["seen"] == 3
    assert found["largest_mm"] < 0.03
    assert abs(found["plate"]["offset_mm"]) < 0.01
    assert found["warning"] is None
    assert found["reference"] == "rig-1"


def test_a_shift_a_scale_and_a_step_of_the_plate_are_told_apart(marks: Marks) -> None:
    albedo, xyz = field(seed=2)
    shifted = measured_marks(marks, albedo, xyz + np.float32([0.0, 0.0, 0.3]))
    assert shifted["as_a_whole_mm"] == pytest.approx(0.3, abs=0.01)
    assert shifted["shape_mm"] < 0.03
    assert shifted["plate"]["offset_mm"] == pytest.approx(-0.3, abs=0.01)
    assert "0.3" in shifted["warning"]
    grown = measured_marks(marks, albedo, xyz * np.float32(1.001))
    assert grown["scale_ppm"] == pytest.approx(1000, abs=150)
    turned = xyz.copy()
    turned[..., 2] += 0.002 * xyz[..., 0]
    assert measured_marks(marks, albedo, turned)["plate"]["turn_mrad"] == pytest.approx(2.0, abs=0.1)


def test_a_plate_that_turned_about_its_middle_has_moved(marks: Marks) -> None:
    """By so little that its own edges are within what is allowed, and what is scanned beside it is not."""
    assert marks.plate is not None
    alone = replace(marks, points=())
    albedo, xyz = field(seed=2)
    found = {}
    for slope in (0.0, 0.001):
        turned = xyz.copy()
        turned[..., 2] += slope * (xyz[..., 0] - marks.plate.point[0])
        found[slope] = measured_marks(alone, albedo, turned)
    assert found[0.0]["warning"] is None
    assert found[0.0]["plate"]["edge_mm"] < 0.02
    reach = np.ptp(xyz[..., 0]) / 2
    assert abs(found[0.001]["plate"]["offset_mm"]) < 0.01
    assert 0.001 * reach * 0.8 < found[0.001]["plate"]["edge_mm"] < 0.001 * reach * 1.5
    assert "the plate is off by" in found[0.001]["warning"]


def test_noise_turns_no_plate(marks: Marks) -> None:
    """A small one, whose normal is known to a milliradian."""
    found = []
    for seed in range(30):
        small = reference_marks(*field(0.1, seed=seed), PLACES, (190, 120, 24, 24), "rig-1")
        seen = measured_marks(replace(small, points=()), *field(0.1, seed=100 + seed))
        found.append(seen["warning"])
    assert sum(said is not None for said in found) <= 1


def test_what_is_hidden_and_what_does_not_show_then_is_told(marks: Marks) -> None:
    albedo, xyz = field(seed=3)
    blank, bare = np.full_like(albedo, 200), np.full_like(xyz, np.nan)
    only = replace(marks, plate=None)
    assert "the plate cannot be measured" in _warned(marks, albedo, _without_plate(marks, xyz))
    assert "nothing is seen of the plate" in _warned(replace(marks, points=()), albedo, bare)
    assert "nothing is seen of the witness marks and the plate" in _warned(marks, blank, bare)
    assert _warned(marks, blank, xyz) == ""
    one = albedo.copy()
    one[:120, :150] = 200
    assert "2 of 3 witness marks are seen: a turn about their line does not show" in _warned(only, one, xyz)


def test_a_mark_that_is_hidden_by_a_third_is_hidden(marks: Marks) -> None:
    albedo, xyz = field(seed=3)
    first = marks.points[0]
    (x, y), r = first.at, first.radius_px
    albedo[round(y - 2 * r) : round(y + 2 * r), round(x - 2 * r) : round(x - 0.3 * r)] = 200
    found = measured_marks(marks, albedo, xyz)
    assert found["points"][0]["moved_mm"] is None
    assert found["seen"] == 2


def _warned(marks: Marks, albedo: np.ndarray, xyz: np.ndarray) -> str:
    return measured_marks(marks, albedo, xyz)["warning"] or ""


def _without_plate(marks: Marks, xyz: np.ndarray) -> np.ndarray:
    assert marks.plate is not None
    x, y, width, height = marks.plate.region
    hidden = xyz.copy()
    hidden[y : y + height, x : x + width] = np.nan
    return hidden


def test_a_hidden_mark_is_said_and_all_hidden_is_a_warning(marks: Marks) -> None:
    albedo, xyz = field(seed=3)
    albedo[:120, :150] = 200
    xyz[200:] = np.nan
    found = measured_marks(marks, albedo, xyz)
    assert [one["moved_mm"] is None for one in found["points"]] == [True, False, True]
    nothing = measured_marks(replace(marks, plate=None), np.full_like(albedo, 200), xyz)
    assert nothing["seen"] == 0
    assert "nothing is seen of the witness marks" in nothing["warning"]
    bare = xyz.copy()
    bare[:] = np.nan
    assert measured_marks(marks, albedo, bare)["plate"]["offset_mm"] is None


def test_what_is_no_mark_is_refused() -> None:
    albedo, xyz = field()
    with pytest.raises(DecodeError, match="2 marks are too few"):
        reference_marks(albedo, xyz, PLACES[:2])
    with pytest.raises(DecodeError, match="no disc within"):
        reference_marks(np.full_like(albedo, 90), xyz, PLACES)
    with pytest.raises(DecodeError, match="no scanned surface"):
        reference_marks(albedo, np.full_like(xyz, np.nan), PLACES)
    with pytest.raises(DecodeError, match="outside the picture"):
        reference_marks(albedo, xyz, PLACES, (900, 900, 10, 10))
    with pytest.raises(DecodeError, match=r"the disc at \(60\.0, 60\.0\) is given twice"):
        reference_marks(albedo, xyz, [*PLACES, (70.0, 60.0)])


def test_marks_on_a_line_are_told_and_a_plate_mends_it(marks: Marks) -> None:
    first, second, third = marks.points
    between = tuple((np.array(first.xyz) + second.xyz) / 2 + (0, 3, 0))
    line = Marks((first, second, replace(third, xyz=between)))
    assert line.in_line
    assert not replace(line, plate=marks.plate).in_line
    assert not Marks(marks.points).in_line


def test_files_are_read_back_and_bad_ones_refused(marks: Marks, tmp_path: Path) -> None:
    file = tmp_path / "marks.json"
    file.write_text(json.dumps(marks.as_dict()))
    assert load_marks(file) == marks
    plain = json.loads(file.read_text())
    for change, words in (
        ({"format": "other"}, "is no fringed-marks"),
        ({"points": plain["points"][:2], "plate": None}, "2 marks and no plate"),
        ({"points": [{"name": "1"}] * 3}, "not as they should be"),
        ({"points": [{**plain["points"][0], "radius_px": -1}] * 3}, "their radii 0"),
        ({"points": [{**plain["points"][0], "radius_px": 1e308}] * 3}, "their radii 0"),
        ({"points": [{**plain["points"][0], "radius_px": 10**400}] * 3}, "not as they should be"),
        ({"points": [{**plain["points"][0], "xyz": "123"}] * 3}, "not as they should be"),
        ({"points": [plain["points"][0]] * 3}, "two marks are at one place"),
        ({"plate": {**plain["plate"], "region": [10, 10, -50, 50]}}, "some width and height"),
        ({"plate": {**plain["plate"], "region": [10, 10, math.inf, 50]}}, "not as they should be"),
        ({"plate": {**plain["plate"], "normal": [0, 0, 0]}}, "a normal of length 1"),
        ({"units": "m"}, "in mm"),
    ):
        with pytest.raises(CalibrationError, match=words):
            parse_marks({**plain, **change}, "marks")
    with pytest.raises(CalibrationError, match="cannot read"):
        load_marks(tmp_path / "none.json")
    file.write_text("{")
    with pytest.raises(CalibrationError, match="as JSON"):
        load_marks(file)


# --- drift ----------------------------------------------------------------------------------------------------------


def scanned(rig: Calibration) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns and points of a board before a rig, every fourth pixel."""
    camera = replace(rig.camera, size=(320, 256), matrix=np.diag([0.25, 0.25, 1.0]) @ rig.camera.matrix)
    grid = camera.normalised(camera.pixel_grid())
    points = np.concatenate((grid, np.ones((256, 320, 1))), axis=-1) * 700.0
    seen = rig.projector.project(rig.to_projector(points)) + np.random.default_rng(0).normal(0, 0.05, (256, 320, 2))
    return seen[..., 1].astype(np.float32), seen[..., 0].astype(np.float32), points.astype(np.float32)


def test_a_knock_shows_across_the_epipolar_lines_and_a_pitch_does_not() -> None:
    rig = made_up_rig()
    rows, columns, points = scanned(rig)
    still = drift_of(rig, rows, columns, points)
    assert still is not None
    assert abs(still.median_px) < 0.01
    assert still.rms_px == pytest.approx(0.05, rel=0.1)
    assert still.warning is None
    # The projector stands beside the camera: columns lie along the lines, rows across.
    knocked = drift_of(rig, rows + np.float32(0.4), columns, points)
    assert knocked is not None
    assert abs(knocked.median_px) == pytest.approx(0.4, rel=0.1)
    assert "0.4" in str(knocked.warning)
    assert "or the calibration is another rig's" in str(knocked.warning), "one scan does not tell which"
    assert knocked.depth_mm == pytest.approx(0.4 * 700**2 / 220 / 1500, rel=0.3)
    along = drift_of(rig, rows, columns + np.float32(0.4), points)
    assert along is not None
    assert abs(along.median_px) < 0.12
    assert "look like depth" in along.as_dict()["cannot_see"]
    assert drift_of(rig, rows * np.nan, columns, points) is None
    calibrated_so = replace(rig, extra={"residuals": {"epipolar_px": 0.2}})
    assert drift_of(calibrated_so, rows + np.float32(0.4), columns, points).warning is None  # type: ignore[union-attr]


def test_a_scans_report_has_drift_marks_and_warm_up(marks: Marks) -> None:
    rig = made_up_rig()
    rows, columns, points = scanned(rig)
    shape = rows.shape
    scan = Scan(
        rows=rows + np.float32(0.5),
        columns=columns,
        sigma_rows=None,
        sigma_columns=None,
        confidence=np.ones(shape, np.float32),
        albedo=np.full(shape, 100, np.float32),
        modulation=np.ones(shape, np.float32),
        reason=np.zeros(shape, np.uint8),
        xyz=points,
        report={"warnings": ["earlier"]},
    )
    sequence = PatternSequence(ProjectorSize(1024, 768), PmpPattern(axes=("x", "y")))
    extra = {"marks": marks.as_dict(), "warm_up": {"devices_open_s": 1800.0, "camera_c": 41.5}}
    report = watched(scan, rig, CaptureHeader(sequence, CameraFormat(320, 256, 8), extra=extra)).report
    assert report["warm_up"]["camera_c"] == 41.5
    assert report["drift"]["median_px"] != 0
    assert report["marks"]["seen"] == 0
    assert [words.split(" ")[0] for words in report["warnings"]] == ["earlier", "rows", "the"]
    plain = CaptureHeader(sequence, CameraFormat(320, 256, 8))
    assert watched(replace(scan, columns=None), rig, plain).report == scan.report
    assert watched(scan, None, plain).report == scan.report
