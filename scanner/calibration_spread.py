"""What a calibration's covariance means for depth: its parameters are moved, pixels and coordinates stay as measured.

At a few of a scan's points: dz = -(dc / dp) / (dc / dz) dp, where c is the projector coordinate at which the point of
depth z on the camera's ray is seen (implicit function theorem), and the variance of z is J C J' (JCGM 102:2011, 6.2).
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from scanner.covariance import LENS_MEMBERS, read_covariance
from scanner.geometry import Array, Calibration, Lens
from scanner.scan import Scan

POINTS = 49
"""Points asked, spread over those that the scan has."""


def depth_spread(calibration: Calibration, scan: Scan, axis: str) -> float | None:
    """1-sigma of depth that the calibration leaves, mm, rms over points of the scan; None where it is not known.

    Args:
        scan: with points. axis: whose coordinates told their depth.
    """
    try:
        read = read_covariance(calibration.extra.get("covariance"))
    except ValueError:  # said when the file was read
        return None
    if read is None or scan.xyz is None:
        return None
    names, matrix = read.names, read.matrix
    valid = np.flatnonzero(scan.valid)
    if valid.size == 0:
        return None
    chosen = valid[np.linspace(0, valid.size - 1, min(POINTS, valid.size)).astype(np.intp)]
    y, x = np.unravel_index(chosen, scan.shape)
    pixels, depth = np.stack([x, y], axis=-1).astype(np.float64), scan.xyz[y, x, 2].astype(np.float64)
    member = 1 if axis == "y" else 0

    def coordinate(rig: Calibration, z: Array) -> Array:
        rays = np.concatenate([rig.camera.normalised(pixels), np.ones((len(pixels), 1))], axis=1)
        found: Array = rig.projector.project(rig.to_projector(rays * z[:, None]))[:, member]
        return found

    by_depth = (coordinate(calibration, depth * 1.0005) - coordinate(calibration, depth * 0.9995)) / (0.001 * depth)
    sigmas = np.sqrt(np.clip(np.diag(matrix), 0, None))
    slopes = np.zeros((len(chosen), len(names)))
    for k, (name, sigma) in enumerate(zip(names, sigmas, strict=True)):
        if sigma > 0:
            up, down = (coordinate(moved(calibration, name, step), depth) for step in (sigma, -sigma))
            slopes[:, k] = -(up - down) / (2 * sigma) / by_depth
    variance = np.einsum("ni,ij,nj->n", slopes, matrix, slopes)
    return float(np.sqrt(np.mean(np.clip(variance, 0, None))))


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
