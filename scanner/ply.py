"""Writing a cloud as PLY (Turk 1994), binary little-endian, as MeshLab, CloudCompare and Open3D read it.

One element, `vertex`: x y z and nx ny nz (float, mm), red green blue (uchar), confidence (float). A point without a
normal has 0 0 0, as readers of PLY take NaN badly.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from scanner.kernel import kernel
from scanner.npz import bytes_of

Map = NDArray[np.float32]

VERTEX = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")),
        *((name, "u1") for name in ("red", "green", "blue")),
        ("confidence", "<f4"),
    ]
)
"""One vertex in the file, 31 bytes, unpadded."""

PART_LINES = 32
"""Of the cloud, packed and written at once: a megabyte or two, still in the cache when it is written"""

_TYPES = {"f": "float", "u": "uchar"}


def write_ply(file: BinaryIO, vertices: NDArray[np.void], comments: tuple[str, ...] = ()) -> None:
    """Write vertices (N,) of dtype `VERTEX`.

    Raises:
        ValueError: no vertices (an empty element is more than some readers bear), or a comment of several lines.
    """
    file.write(_header(len(vertices), comments))
    file.write(bytes_of(np.ascontiguousarray(vertices)))


def write_cloud(
    file: BinaryIO, xyz: Map, normals: Map, albedo: Map, confidence: Map, comments: tuple[str, ...] = ()
) -> None:
    """Write the points of an organised cloud, each part of it as soon as it is packed; see `vertices_of`.

    What is written lies in one buffer, which changes from part to part.

    Raises:
        ValueError: as `write_ply`.
    """
    file.write(_header(_count(xyz), comments))
    for part in _packed(xyz, normals, albedo, confidence):
        file.write(bytes_of(part))


def vertices_of(xyz: Map, normals: Map, albedo: Map, confidence: Map) -> NDArray[np.void]:
    """The points of an organised cloud as vertices, line by line. Grey is albedo, white its 99th percentile.

    Args:
        xyz, normals: (H, W, 3) float32; pixels whose xyz is NaN are left out.
        albedo, confidence: (H, W) float32.
    """
    vertices = np.empty(_count(xyz), VERTEX)
    _pack(xyz, normals, albedo, _scale_of_grey(albedo, xyz), confidence, 0, len(xyz), vertices)
    return vertices


def _count(xyz: Map) -> int:
    return int(np.count_nonzero(~np.isnan(xyz[..., 2])))


def _packed(xyz: Map, normals: Map, albedo: Map, confidence: Map) -> Iterator[NDArray[np.void]]:
    """`PART_LINES` lines of the cloud after another, in the same buffer."""
    scale = _scale_of_grey(albedo, xyz)
    vertices = np.empty(PART_LINES * xyz.shape[1], VERTEX)
    for begin in range(0, xyz.shape[0], PART_LINES):
        end = min(begin + PART_LINES, xyz.shape[0])
        count = _pack(xyz, normals, albedo, scale, confidence, begin, end, vertices)
        yield vertices[:count]


def warm_up() -> None:
    """Compile the kernel."""
    one = np.ones((2, 2), np.float32)
    vertices_of(np.ones((2, 2, 3), np.float32), np.ones((2, 2, 3), np.float32), one, one)


def _header(count: int, comments: tuple[str, ...]) -> bytes:
    if count == 0:
        raise ValueError("a PLY file without vertices is not written")
    if any(not comment.isprintable() for comment in comments):
        raise ValueError("a PLY comment is one printable line")
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {comment}" for comment in comments]
    lines.append(f"element vertex {count}")
    for name in VERTEX.names or ():
        lines.append(f"property {_TYPES[VERTEX[name].kind]} {name}")
    lines.append("end_header\n")
    return "\n".join(lines).encode("ascii", "replace")


def _scale_of_grey(albedo: Map, xyz: Map) -> np.float32:
    """255 / white, 0 where nothing is bright."""
    # A hundred thousand of the points, spread evenly.
    every = max(1, albedo.size // 100_000)
    sample, depth = albedo.reshape(-1)[::every], xyz.reshape(-1, 3)[::every, 2]
    sample = sample[np.isfinite(sample) & ~np.isnan(depth)]
    white = float(np.percentile(sample, 99)) if sample.size else 0.0
    return np.float32(255.0 / white if white > 0 else 0.0)


@kernel
def _pack(
    xyz: Map,
    normals: Map,
    albedo: Map,
    scale: np.float32,
    confidence: Map,
    begin: int,
    end: int,
    vertices: NDArray[np.void],
) -> int:
    """Lines `begin` to `end` as vertices; returns how many."""
    n = 0
    for i in range(begin, end):
        for j in range(xyz.shape[1]):
            if math.isnan(xyz[i, j, 2]):
                continue
            vertex = vertices[n]
            vertex.x, vertex.y, vertex.z = xyz[i, j, 0], xyz[i, j, 1], xyz[i, j, 2]
            known = not math.isnan(normals[i, j, 0])
            vertex.nx = normals[i, j, 0] if known else 0.0
            vertex.ny = normals[i, j, 1] if known else 0.0
            vertex.nz = normals[i, j, 2] if known else 0.0
            light = albedo[i, j] * scale
            vertex.red = vertex.green = vertex.blue = (
                np.uint8(min(light, np.float32(255))) if light > 0 else np.uint8(0)
            )
            vertex.confidence = confidence[i, j]
            n += 1
    return n
