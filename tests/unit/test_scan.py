"""Building scans, and their folder: round trips, crashes, damage."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from scanner import scan_files
from scanner.decode import Reason
from scanner.errors import CalibrationError, StorageError
from scanner.filter_settings import FilterSettings
from scanner.npz import NpzWriter, read_npz, write_npz
from scanner.scan import build_scan, load_scan
from scanner.scan_files import ScanWriter
from scanner.storage import Digests, temporary_of


@pytest.fixture(scope="module")
def scan(ball):
    return build_scan(ball.decoded(0.02), ball.calibration)


def test_points_lie_on_the_surface_and_rows_stay(ball, scan):
    error = scan.xyz[..., 2] - ball.truth.xyz[..., 2]
    assert np.sqrt(np.nanmean(error**2)) < 0.2
    decoded = ball.decoded(0.02)
    np.testing.assert_array_equal(scan.rows, decoded.rows)
    taken = decoded.reason != scan.reason
    assert (scan.reason[taken] == Reason.FILTERED).all()
    assert taken.sum() == sum(scan.report["removed"].values()) > 0
    np.testing.assert_array_equal(np.isnan(scan.xyz[..., 2]), scan.reason != Reason.VALUE)
    np.testing.assert_array_equal(np.isnan(scan.sigma_z), np.isnan(scan.xyz[..., 2]))


def test_counts_of_the_report_add_up(ball, scan):
    report = scan.report
    assert report["points"] == len(scan.points) == len(scan.intensity) == scan.valid.sum()
    assert report["counts"]["pixels"] == 240 * 320 == sum(report["counts"]["reasons"].values())
    assert report["counts"]["lit"] == ball.lit.sum()
    assert report["coverage"]["lit"] == scan.coverage == 1.0
    assert report["coverage"]["undecided_of_lit"] == 0
    assert report["coverage"]["too_dark"] == pytest.approx(1 - ball.lit.mean())
    assert report["coverage"]["points_of_lit"] == pytest.approx(report["points"] / ball.lit.sum())
    assert {"triangulate", "filter"} <= report["timings"].keys()
    assert report["versions"]["numpy"] == np.__version__
    assert report["depth_mm"]["p1"] < report["depth_mm"]["median"] < 761


def test_what_is_saturated_is_a_share_of_what_shows_the_pattern(ball):
    decoded = ball.decoded()
    reason = decoded.reason.copy()
    reason.reshape(-1)[np.flatnonzero(ball.lit)[::4]] = Reason.CLIPPED
    coverage = build_scan(replace(decoded, reason=reason)).report["coverage"]
    assert coverage["saturated_of_lit"] == pytest.approx(0.25, abs=1e-3)
    assert coverage["too_dark"] == pytest.approx(1 - ball.lit.mean())


def test_stages_before_are_kept_in_the_timings(ball):
    timings = {"decode": 1.5}
    report = build_scan(ball.decoded(), ball.calibration, timings=timings).report
    assert report["timings"]["decode"] == 1.5
    assert timings.keys() == report["timings"].keys()


def test_without_a_calibration_there_are_rows_and_no_points(ball, tmp_path):
    scan = build_scan(ball.decoded())
    assert scan.xyz is None
    assert scan.normals is None
    assert scan.points.shape == (0, 3)
    assert scan.valid.sum() == ball.lit.sum()
    assert scan.save(tmp_path / "scan") == ("scan.npz", "preview.png", "report.json")
    with np.load(tmp_path / "scan" / "scan.npz", allow_pickle=False) as content:
        assert "xyz" not in content
        assert "columns" not in content
        assert "rows" in content


def test_a_calibration_of_another_camera_is_refused(ball):
    decoded = ball.decoded()
    small = replace(decoded, **{k: getattr(decoded, k)[:100] for k in ("rows", "sigma_rows", "confidence", "reason")})
    with pytest.raises(CalibrationError, match="320 x 240"):
        build_scan(small, ball.calibration)


def test_columns_make_a_scan_too(rig_of, scene_with, tmp_path):
    scene = scene_with(rig_of("x"), lambda x, y: np.full(x.shape, 700.0))
    scan = build_scan(scene.decoded(axis="x"), scene.calibration)
    assert np.nanmax(np.abs(scan.xyz[..., 2] - 700)) < 0.05
    scan.save(tmp_path / "scan")
    assert load_scan(tmp_path / "scan").rows is None


def test_the_folder_has_what_formats_say(scan, tmp_path):
    folder = tmp_path / "new" / "scan"
    told = []
    with Digests() as digests:
        names = scan.save(folder, told.append, digests)
        assert all(digests.of(name) == hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names)
    assert names == tuple(told) == ("scan.npz", "cloud.ply", "preview.png", "report.json")
    assert sorted(path.name for path in folder.iterdir()) == sorted(names)
    with np.load(folder / "scan.npz", allow_pickle=False) as content:
        found = {name: (content[name].dtype.str, content[name].shape) for name in content.files}
    floats = dict.fromkeys(("rows", "sigma_rows", "sigma_z", "confidence", "albedo", "modulation"), ("<f4", (240, 320)))
    assert found == {**floats, "xyz": ("<f4", (240, 320, 3)), "reason": ("|u1", (240, 320))}
    cloud = trimesh.load(folder / "cloud.ply")
    np.testing.assert_array_equal(cloud.vertices, scan.points)
    assert (folder / "preview.png").read_bytes().startswith(b"\x89PNG")
    report = json.loads((folder / "report.json").read_text(), parse_constant=pytest.fail)
    assert report["format"] == "fringed-report"
    assert "write cloud.ply" in report["timings"]


def test_a_scan_survives_its_folder(scan, tmp_path):
    scan.save(tmp_path)
    back = load_scan(tmp_path)
    for name, array in scan.arrays().items():
        np.testing.assert_array_equal(getattr(back, name), array)
    np.testing.assert_array_equal(back.normals, scan.normals)
    assert back.report["points"] == scan.report["points"]
    assert back.report["rig"]["calibration"] == "small-y"
    assert back.with_report(more=1).report["more"] == 1


def test_stripes_peaks_and_the_error_map_are_kept(scan, tmp_path):
    stripes = np.full(scan.shape, -1, np.int16)
    peaks = np.arange(10, dtype=np.float32).reshape(2, 5)
    picture = np.zeros((4, 4, 3), np.uint8)
    more = replace(scan, stripes=stripes, peaks=peaks, error_map=picture)
    assert more.save(tmp_path)[3:] == ("error_map.png", "report.json")
    back = load_scan(tmp_path)
    np.testing.assert_array_equal(back.stripes, stripes)
    np.testing.assert_array_equal(back.peaks, peaks)


def test_a_cloud_without_points_gets_no_ply_and_a_warning(ball, tmp_path):
    scan = build_scan(ball.decoded(), ball.calibration, FilterSettings(depth=(1.0, 2.0)))
    assert scan.report["removed"]["depth"] > 0
    scan.save(tmp_path)
    assert not (tmp_path / "cloud.ply").exists()
    assert "no points" in json.loads((tmp_path / "report.json").read_text())["warnings"][-1]


def test_a_crash_leaves_no_half_file_and_no_report(scan, tmp_path, monkeypatch):
    scan.save(tmp_path)

    def fail(file, *_):
        file.write(b"half a file")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(scan_files, "write_cloud", fail)
    with pytest.raises(StorageError, match="No space left") as error:
        scan.save(tmp_path)
    assert "disk is full" in error.value.hint
    assert [path.name for path in tmp_path.iterdir()] == ["scan.npz"]
    assert load_scan(tmp_path).report == {}


def test_points_come_first_and_nothing_of_a_scan_that_is_given_up_stays(scan, tmp_path, monkeypatch):
    with ScanWriter(tmp_path) as writer:
        places = writer.points(scan.xyz, scan.confidence)
        content = temporary_of(tmp_path / "scan.npz").read_bytes()
        for place in places:
            values = np.frombuffer(content, place.dtype, int(np.prod(place.shape)), place.offset)
            assert place.offset % 64 == 0
            np.testing.assert_array_equal(values.reshape(place.shape), getattr(scan, place.name))
        writer.write(scan)
    with Digests() as digests:
        scan.save(tmp_path / "other", digests=digests)
        assert digests.of("scan.npz") == hashlib.sha256((tmp_path / "scan.npz").read_bytes()).hexdigest()
    with zipfile.ZipFile(tmp_path / "scan.npz") as archive:
        assert archive.testzip() is None
        assert archive.namelist()[:2] == ["xyz.npy", "confidence.npy"]
    monkeypatch.setattr(NpzWriter, "close", raise_full)
    with pytest.raises(StorageError, match="No space left"):
        scan.save(tmp_path / "full")
    with ScanWriter(tmp_path / "left") as writer:
        writer.points(scan.xyz, scan.confidence)
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["cloud.ply"]
    assert not any((tmp_path / "left").iterdir())


def raise_full(*_):
    raise OSError(28, "No space left on device")


def test_a_folder_that_cannot_be_written_is_named(scan, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="file"):
        scan.save(tmp_path / "file" / "scan")


@settings(max_examples=40, deadline=None)
@given(
    st.dictionaries(
        st.sampled_from(["rows", "xyz", "reason", "stripes"]),
        st.sampled_from(["<f4", "u1", "<i2"]).flatmap(
            lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=6))
        ),
        min_size=1,
    )
)
def test_any_arrays_survive_npz_and_numpy_reads_them(tmp_path_factory, arrays):
    path = tmp_path_factory.mktemp("npz") / "a.npz"
    file = io.BytesIO()
    write_npz(file, arrays)
    path.write_bytes(file.getvalue())
    own = read_npz(path, {name: array.dtype for name, array in arrays.items()})
    with np.load(path, allow_pickle=False) as theirs:
        assert set(theirs.files) == own.keys() == arrays.keys()
        for name, array in arrays.items():
            np.testing.assert_array_equal(theirs[name], array)
            np.testing.assert_array_equal(own[name], array)


def npz_of(folder, **arrays):
    with (folder / "scan.npz").open("wb") as file:
        write_npz(file, arrays)


def test_damaged_scans_are_refused_and_named(scan, tmp_path):
    with pytest.raises(StorageError, match="not there"):
        load_scan(tmp_path)
    arrays = scan.arrays()
    npz_of(tmp_path, **{name: array for name, array in arrays.items() if name != "albedo"})
    with pytest.raises(StorageError, match="lacks albedo"):
        load_scan(tmp_path)
    npz_of(tmp_path, **{**arrays, "albedo": arrays["albedo"][:5]})
    with pytest.raises(StorageError, match="albedo has shape"):
        load_scan(tmp_path)
    npz_of(tmp_path, **{**arrays, "rows": arrays["rows"].astype(np.float64)})
    with pytest.raises(StorageError, match="rows holds float64"):
        load_scan(tmp_path)
    scan.save(tmp_path)
    whole = (tmp_path / "scan.npz").read_bytes()
    (tmp_path / "scan.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(StorageError, match="damaged"):
        load_scan(tmp_path)
    flipped = bytearray(whole)
    flipped[len(whole) // 3] ^= 1
    (tmp_path / "scan.npz").write_bytes(flipped)
    with pytest.raises(StorageError, match="damaged"):
        load_scan(tmp_path)


def test_a_header_that_promises_more_than_there_is_is_refused(tmp_path):
    header = io.BytesIO()
    description = {"descr": "<f4", "fortran_order": False, "shape": (10**9, 10**9)}
    np.lib.format.write_array_header_1_0(header, description)
    with zipfile.ZipFile(tmp_path / "scan.npz", "w") as archive:
        archive.writestr("rows.npy", header.getvalue() + b"1234")
    with pytest.raises(StorageError, match="its header says"):
        load_scan(tmp_path)


def test_a_report_of_another_version_is_refused(scan, tmp_path):
    scan.save(tmp_path)
    report = json.loads((tmp_path / "report.json").read_text())
    (tmp_path / "report.json").write_text(json.dumps({**report, "version": 2}))
    with pytest.raises(StorageError, match="version"):
        load_scan(tmp_path)
