"""What a scan costs after decoding, stage by stage, at 1392 x 1040 with distortion on both lenses, one thread.

A ball before a wall, projector above the camera. Each line is the best and the median of the rounds, ms. The last lines
set the scan's files against writing the same number of bytes raw, with the same fsync.

    python bench/scan.py [--rounds 7] [--folder DIR]
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scanner.compare import compare
from scanner.decode import Decoded
from scanner.devices import Truth
from scanner.filter_settings import FilterSettings
from scanner.filters import apply_filters
from scanner.geometry import Calibration, Lens
from scanner.normals import normals_of
from scanner.npz import write_npz
from scanner.ply import vertices_of, write_ply
from scanner.preview import preview_picture
from scanner.scan import build_scan, load_scan
from scanner.storage import replacing
from scanner.triangulation import triangulate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--folder", type=Path, help="where files are written; default: the temporary directory")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        measure(arguments.rounds, Path(folder))


def measure(rounds: int, folder: Path) -> None:
    calibration, truth, decoded = scene()
    points = triangulate(calibration, rows=decoded.rows, sigma_rows=decoded.sigma_rows)
    scan = build_scan(decoded, calibration)
    albedo, confidence = decoded.albedo, decoded.confidence
    vertices = vertices_of(scan.xyz, scan.normals, albedo, confidence)

    def both() -> None:
        triangulate(
            calibration,
            rows=decoded.rows,
            sigma_rows=decoded.sigma_rows,
            columns=truth.columns,
            sigma_columns=decoded.sigma_rows,
        )

    def lens_rays() -> None:
        calibration.camera.normalised(calibration.camera.pixel_grid())

    stages: dict[str, Callable[[], Any]] = {
        "camera rays (once per calibration)": lens_rays,
        "triangulate rows": lambda: triangulate(calibration, rows=decoded.rows, sigma_rows=decoded.sigma_rows),
        "triangulate rows and columns": both,
        "filters": lambda: apply_filters(points.xyz, points.sigma_z, confidence, FilterSettings()),
        "normals": lambda: normals_of(points.xyz),
        "build_scan, all of it": lambda: build_scan(decoded, calibration),
        "vertices": lambda: vertices_of(scan.xyz, scan.normals, albedo, confidence),
        "preview": lambda: preview_picture(scan),
        "compare with truth": lambda: compare(scan, truth, 13.5),
    }
    for name, stage in stages.items():
        report(name, rounds, stage)

    def npz() -> None:
        with replacing(folder / "scan.npz") as file:
            write_npz(file, scan.arrays())

    def ply() -> None:
        with replacing(folder / "cloud.ply") as file:
            write_ply(file, vertices)

    npz()
    ply()
    for name, write in (("scan.npz", npz), ("cloud.ply", ply)):
        content = (folder / name).read_bytes()
        report(f"write {name}, {len(content) / 1e6:.0f} MB", rounds, write)
        report("  the same bytes raw", rounds, lambda content=content: raw(folder / "raw", content))
    report("  numpy.savez", rounds, lambda: np.savez(folder / "savez.npz", **scan.arrays()))
    report("save, all files", rounds, lambda: scan.save(folder / "scan"))
    report("load_scan", rounds, lambda: load_scan(folder / "scan"))


def raw(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def report(name: str, rounds: int, stage: Callable[[], Any]) -> None:
    stage()
    times = []
    for _ in range(rounds):
        begin = time.perf_counter()
        stage()
        times.append((time.perf_counter() - begin) * 1e3)
    print(f"{name:<40} {min(times):8.1f} {float(np.median(times)):8.1f} ms")


def scene() -> tuple[Calibration, Truth, Decoded]:
    camera = Lens(
        (1392, 1040),
        np.array([[3376.0, 0, 695.5], [0, 3390.0, 519.5], [0, 0, 1]]),
        np.array([-0.09, 0.05, 0.0005, -0.0003, 0]),
    )
    projector = Lens(
        (1152, 864),
        np.array([[2430.0, 0, 575.5], [0, 2458.0, 431.5], [0, 0, 1]]),
        np.array([-0.03, 0.01, 0, 0, 0]),
    )
    rotation = np.asarray(cv2.Rodrigues(np.array([np.arctan2(239.0, 1346.0), 0, 0]))[0])
    calibration = Calibration(camera, projector, rotation, -rotation @ np.array([0, -239.0, 0]), id="bench")
    x, y = np.moveaxis(camera.normalised(camera.pixel_grid()), -1, 0)
    a, inside = x * x + y * y + 1, 1226.0**2 - (x * x + y * y + 1) * (1226.0**2 - 80.0**2)
    z = np.where(inside > 0, (1226.0 - np.sqrt(np.maximum(inside, 0))) / a, 1346.0)
    xyz = np.stack((x * z, y * z, z), axis=-1)
    seen = projector.project(calibration.to_projector(xyz)).astype(np.float32)
    lit = (seen[..., 0] > 0) & (seen[..., 0] < 1151) & (seen[..., 1] > 0) & (seen[..., 1] < 863)
    noise = np.random.default_rng(0).normal(0, 0.02, z.shape).astype(np.float32)
    rows = np.where(lit, seen[..., 1] + noise, np.nan).astype(np.float32)
    sigma = np.where(lit, np.float32(0.02), np.nan).astype(np.float32)
    shade = np.where(lit, np.float32(110), np.float32(5)).astype(np.float32)
    decoded = Decoded(
        rows=rows,
        columns=None,
        sigma_rows=sigma,
        sigma_columns=None,
        confidence=lit.astype(np.float32),
        albedo=shade,
        modulation=shade,
        reason=(~lit).astype(np.uint8),
    )
    return calibration, Truth(seen[..., 1].copy(), seen[..., 0].copy(), xyz.astype(np.float32), lit), decoded


if __name__ == "__main__":
    main()
