"""Writing a cloud as PLY (Turk 1994), binary little-endian, as MeshLab, CloudCompare and Open3D read it.

One element, `vertex`: x y z and nx ny nz (float, mm), red green blue (uchar), confidence (float). A point without a
normal has 0 0 0, as readers of PLY take NaN badly.
"""

from __future__ import annotations

import math
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

_TYPES = {"f": "float", "u": "uchar"}


def write_ply(file: BinaryIO, vertices: NDArray[np.void], comments: tuple[str, ...] = ()) -> None:
    """Write vertices (N,) of dtype `VERTEX`.

    Raises:
        ValueError: no vertices (an empty element is more than some readers bear), or a comment of several lines.
    """
    if len(vertices) == 0:
        raise ValueError("a PLY file without vertices is not written")
    if any(not comment.isprintable() for comment in comments):
        raise ValueError("a PLY comment is one printable line")
    file.write(_header(len(vertices), comments))
    file.write(bytes_of(np.ascontiguousarray(vertices)))


def vertices_of(xyz: Map, normals: Map, albedo: Map, confidence: Map) -> NDArray[np.void]:
    """The points of an organised cloud as vertices, line by line. Grey is albedo, white its 99th percentile.

    Args:
        xyz, normals: (H, W, 3) float32; pixels whose xyz is NaN are left out.
        albedo, confidence: (H, W) float32.
    """
    there = ~np.isnan(xyz[..., 2])
    vertices = np.empty(int(np.count_nonzero(there)), VERTEX)
    _pack(xyz, normals, _grey(albedo, there), confidence, vertices)
    return vertices


def warm_up() -> None:
    """Compile the kernel."""
    one = np.ones((2, 2), np.float32)
    vertices_of(np.ones((2, 2, 3), np.float32), np.ones((2, 2, 3), np.float32), one, one)


def _header(count: int, comments: tuple[str, ...]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {comment}" for comment in comments]
    lines.append(f"element vertex {count}")
    for name in VERTEX.names or ():
        lines.append(f"property {_TYPES[VERTEX[name].kind]} {name}")
    lines.append("end_header\n")
    return "\n".join(lines).encode("ascii", "replace")


def _grey(albedo: Map, there: NDArray[np.bool_]) -> NDArray[np.uint8]:
    seen = albedo[there]
    sample = seen[:: max(1, seen.size // 100_000)]
    sample = sample[np.isfinite(sample)]
    white = float(np.percentile(sample, 99)) if sample.size else 0.0
    scaled = np.nan_to_num(albedo * np.float32(255.0 / white if white > 0 else 0.0), nan=0.0, posinf=255.0)
    return np.asarray(np.clip(scaled, 0, 255), dtype=np.uint8)


@kernel
def _pack(xyz: Map, normals: Map, grey: NDArray[np.uint8], confidence: Map, vertices: NDArray[np.void]) -> None:
    n = 0
    for i in range(xyz.shape[0]):
        for j in range(xyz.shape[1]):
            if math.isnan(xyz[i, j, 2]):
                continue
            vertex = vertices[n]
            vertex.x, vertex.y, vertex.z = xyz[i, j, 0], xyz[i, j, 1], xyz[i, j, 2]
            known = not math.isnan(normals[i, j, 0])
            vertex.nx = normals[i, j, 0] if known else 0.0
            vertex.ny = normals[i, j, 1] if known else 0.0
            vertex.nz = normals[i, j, 2] if known else 0.0
            vertex.red = vertex.green = vertex.blue = grey[i, j]
            vertex.confidence = confidence[i, j]
            n += 1
