"""PLY files as an independent reader sees them, and normals."""

from __future__ import annotations

import io

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from scanner.normals import normals_of
from scanner.ply import VERTEX, vertices_of, write_ply


def written(vertices, comments=()):
    file = io.BytesIO()
    write_ply(file, vertices, comments)
    return file.getvalue()


def test_trimesh_reads_points_normals_and_colours(ball):
    xyz = ball.truth.xyz.copy()
    xyz[:50] = np.nan
    albedo = np.tile(np.linspace(0, 100, 320, dtype=np.float32), (240, 1))
    confidence = np.full((240, 320), 0.75, np.float32)
    normals = normals_of(xyz)
    content = written(vertices_of(xyz, normals, albedo, confidence), ("fringed; mm",))
    cloud = trimesh.load(io.BytesIO(content), file_type="ply")
    there = ~np.isnan(xyz[..., 2])
    np.testing.assert_array_equal(cloud.vertices, xyz[there])
    raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(raw["nz"], np.nan_to_num(normals[there][:, 2]))
    assert (raw["confidence"] == 0.75).all()
    assert cloud.colors[0, :3].tolist() == [0, 0, 0]
    assert cloud.colors[319, :3].tolist() == [255, 255, 255]


def test_header_says_what_follows():
    content = written(np.zeros(3, VERTEX), ("one line",))
    header, _, body = content.partition(b"end_header\n")
    assert header.decode().splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        "comment one line",
        "element vertex 3",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "property float confidence",
    ]
    assert len(body) == 3 * 31


@settings(max_examples=30, deadline=None)
@given(hnp.arrays(VERTEX, st.integers(1, 20)))
def test_any_vertices_come_back(vertices):
    body = written(vertices).partition(b"end_header\n")[2]
    assert body == vertices.tobytes()


def test_an_empty_cloud_and_a_comment_of_two_lines_are_refused():
    with pytest.raises(ValueError, match="without vertices"):
        written(np.zeros(0, VERTEX))
    with pytest.raises(ValueError, match="one printable line"):
        written(np.zeros(1, VERTEX), ("a\nend_header",))


def test_a_point_without_a_normal_has_zeros():
    xyz = np.full((3, 3, 3), np.nan, np.float32)
    xyz[1, 1] = (0, 0, 700)
    one = np.ones((3, 3), np.float32)
    vertex = vertices_of(xyz, normals_of(xyz), one, one)[0]
    assert (vertex["nx"], vertex["ny"], vertex["nz"]) == (0, 0, 0)


def plain_normals(xyz):
    """Central differences, one-sided where a neighbour is missing, in NumPy."""

    def difference(axis):
        pad = [(1, 1) if a == axis else (0, 0) for a in range(3)]
        p = np.pad(xyz, pad, constant_values=np.nan).astype(np.float64)
        before, after = (np.take(p, np.arange(n, n + xyz.shape[axis]), axis) for n in (0, 2))
        before, after = np.where(np.isnan(before), xyz, before), np.where(np.isnan(after), xyz, after)
        return after - before

    n = -np.cross(difference(1), difference(0))
    with np.errstate(invalid="ignore", divide="ignore"):
        n /= np.linalg.norm(n, axis=-1, keepdims=True)
    n[np.isnan(xyz)] = np.nan
    return n * np.where((n * xyz).sum(-1, keepdims=True) > 0, -1, 1)


def test_normals_agree_with_the_plain_form(ball):
    xyz = ball.truth.xyz.copy()
    xyz[np.random.default_rng(2).random(xyz.shape[:2]) < 0.2] = np.nan
    expected = plain_normals(xyz)
    np.testing.assert_allclose(normals_of(xyz), expected, atol=2e-3)


def test_normals_of_a_sphere_point_away_from_its_centre(ball):
    z = ball.truth.xyz[..., 2]
    outward = (ball.truth.xyz - np.float32((0, 0, 640))) / 50
    facing = (z < 620) & ball.lit
    assert ((normals_of(ball.truth.xyz) * outward).sum(-1)[facing] > 0.995).all()
