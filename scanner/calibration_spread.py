"""What a calibration's covariance means for points: its parameters are moved, pixels and coordinates stay as measured.

dz = -(dc / dp) / (dc / dz) dp, where c is the projector coordinate at which the point of depth z on the camera's ray is
seen (implicit function theorem); with the ray of a moved camera that gives x and y. The variance of what depends on
points is J C J' (JCGM 102:2011, 6.2), which `PointSpread` is the means for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from scanner.covariance import LENS_MEMBERS, Covariance, read_covariance
from scanner.geometry import Array, Calibration, Lens
from scanner.scan import Scan

POINTS = 49
"""Points asked, spread over those that the scan has."""


@dataclass(frozen=True, eq=False)
class PointSpread:
    """What moves some points. slopes: (n, 3, k) mm by each of the k parameters; covariance: (k, k) of these."""

    slopes: Array
    covariance: Array

    @property
    def root(self) -> Array:
        """(k, r): what r numbers of unit variance are multiplied by to be parameters that the covariance allows."""
        sigmas = np.sqrt(np.clip(np.diag(self.covariance), 0, None))
        free = np.flatnonzero(sigmas > 0)
        # Focal lengths and third coefficients lie powers of ten apart: taken as shares of their own sigmas.
        correlation = self.covariance[np.ix_(free, free)] / np.outer(sigmas[free], sigmas[free])
        values, vectors = np.linalg.eigh((correlation + correlation.T) / 2)
        root = np.zeros((len(sigmas), len(free)))
        root[free] = sigmas[free, None] * vectors * np.sqrt(np.clip(values, 0, None))
        return root

    def draws(self, count: int, seed: int) -> Array:
        """(count, n, 3) mm by which the points would be moved by other rigs that the covariance allows.

        Of more rigs than parameters, their own mean and covariance are exactly those meant: fewer of them will do.
        """
        root = self.root
        normal = np.random.default_rng(seed).normal(size=(count, root.shape[1]))
        if count > 2 * normal.shape[1]:
            normal -= normal.mean(axis=0)
            u, _, v = np.linalg.svd(normal, full_matrices=False)
            normal = np.sqrt(count) * u @ v
        steps = normal @ root.T
        return np.asarray(np.einsum("nik,dk->dni", self.slopes, steps), dtype=np.float64)


def depth_spread(calibration: Calibration, scan: Scan, axis: str) -> float | None:
    """1-sigma of depth that the calibration leaves, mm, rms over points of the scan; None where it is not known.

    Args:
        scan: with points. axis: whose coordinates told their depth.
    """
    if scan.xyz is None:
        return None
    valid = np.flatnonzero(scan.valid)
    if valid.size == 0:
        return None
    chosen = valid[np.linspace(0, valid.size - 1, min(POINTS, valid.size)).astype(np.intp)]
    y, x = np.unravel_index(chosen, scan.shape)
    spread = point_spread(
        calibration, np.stack([x, y], axis=-1).astype(np.float64), scan.xyz[y, x].astype(np.float64), axis
    )
    if spread is None:
        return None
    of_depth = spread.slopes[:, 2]
    variance = np.einsum("ni,ij,nj->n", of_depth, spread.covariance, of_depth)
    return float(np.sqrt(np.mean(np.clip(variance, 0, None))))


def point_spread(calibration: Calibration, pixels: Array, xyz: Array, axis: str) -> PointSpread | None:
    """How points depend on the calibration's parameters; None where it has no covariance that can be used.

    Args:
        pixels: (n, 2) px of the camera. xyz: (n, 3) mm, the points seen there. axis: whose coordinates told their
            depth.
    """
    read = _covariance_of(calibration)
    if read is None:
        return None
    depth = xyz[:, 2]
    by_depth = (_seen(calibration, pixels, depth * 1.0005, axis) - _seen(calibration, pixels, depth * 0.9995, axis)) / (
        0.001 * depth
    )
    rays = _rays(calibration, pixels)
    slopes = np.zeros((len(pixels), 3, len(read.names)))
    for k, (name, sigma) in enumerate(zip(read.names, np.sqrt(np.clip(np.diag(read.matrix), 0, None)), strict=True)):
        if sigma <= 0:
            continue
        up, down = (moved(calibration, name, step) for step in (sigma, -sigma))
        of_depth = -(_seen(up, pixels, depth, axis) - _seen(down, pixels, depth, axis)) / (2 * sigma) / by_depth
        slopes[:, :, k] = rays * of_depth[:, None]
        if name.startswith("camera."):
            slopes[:, :, k] += depth[:, None] * (_rays(up, pixels) - _rays(down, pixels)) / (2 * sigma)
    return PointSpread(slopes, read.matrix)


def across_spread(calibration: Calibration, pixels: Array, depth: Array, axis: str) -> Array | None:
    """1-sigma, px, of where along the other axis the projector sees points whose coordinate along `axis` was measured.

    Args:
        pixels: (n, 2) px of the camera. depth: (n,) mm, of the points seen there.

    Returns:
        (n,); None where the calibration has no covariance that can be used.
    """
    read = _covariance_of(calibration)
    if read is None:
        return None
    other = "x" if axis == "y" else "y"

    def slopes(up: Calibration, down: Calibration, higher: Array, lower: Array) -> tuple[Array, Array]:
        along, across = (_seen(up, pixels, higher, a) - _seen(down, pixels, lower, a) for a in (axis, other))
        return along, across

    # The measured coordinate stays, so what moves it moves the depth back, and with that the other coordinate.
    along, across = slopes(calibration, calibration, depth * 1.0005, depth * 0.9995)
    slant = across / along
    moves = np.zeros((len(pixels), len(read.names)))
    for k, (name, sigma) in enumerate(zip(read.names, np.sqrt(np.clip(np.diag(read.matrix), 0, None)), strict=True)):
        if sigma > 0:
            along, across = slopes(moved(calibration, name, sigma), moved(calibration, name, -sigma), depth, depth)
            moves[:, k] = (across - slant * along) / (2 * sigma)
    variance = np.einsum("ni,ij,nj->n", moves, read.matrix, moves)
    return np.asarray(np.sqrt(np.clip(variance, 0, None)), dtype=np.float64)


def _covariance_of(calibration: Calibration) -> Covariance | None:
    try:
        return read_covariance(calibration.extra.get("covariance"))
    except ValueError:  # said when the file was read
        return None


def _rays(rig: Calibration, pixels: Array) -> Array:
    """(n, 3): x / z, y / z, 1 of what is seen at camera pixels."""
    return np.concatenate([rig.camera.normalised(pixels), np.ones((len(pixels), 1))], axis=1)


def _seen(rig: Calibration, pixels: Array, depth: Array, axis: str) -> Array:
    """(n,) projector coordinate at which points of these depths on the pixels' rays are seen."""
    seen: Array = rig.projector.project(rig.to_projector(_rays(rig, pixels) * depth[:, None]))
    return seen[:, 1 if axis == "y" else 0]


def moved(calibration: Calibration, name: str, step: float) -> Calibration:
    """The rig with one parameter changed: "camera.fx", ... "rotation.x" (of the rotation vector), "translation.z"."""
    part, member = name.split(".")
    if part == "camera":
        return replace(calibration, camera=_moved_lens(calibration.camera, member, step))
    if part == "projector":
        return replace(calibration, projector=_moved_lens(calibration.projector, member, step))
    index = "xyz".index(member)
    if part == "translation":
        shift = calibration.translation.copy()
        shift[index] += step
        return replace(calibration, translation=shift)
    vector = np.asarray(cv2.Rodrigues(calibration.rotation)[0], dtype=np.float64).reshape(3)
    vector[index] += step
    return replace(calibration, rotation=np.asarray(cv2.Rodrigues(vector)[0], dtype=np.float64))


def _moved_lens(lens: Lens, member: str, step: float) -> Lens:
    matrix, distortion = lens.matrix.copy(), lens.distortion.copy()
    at = LENS_MEMBERS.index(member)
    if at >= 4:
        distortion[at - 4] += step
    else:
        matrix[(0, 1, 0, 1)[at], (0, 1, 2, 2)[at]] += step
    return Lens(lens.size, matrix, distortion)
