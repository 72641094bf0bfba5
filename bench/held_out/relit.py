"""Real scenes relit: what a capture by PMP tells of a scene (where each pixel is lit from, how bright and how dark it
is) shines once more under an MCP pattern, and is decoded beside the PMP rows it was made of.

Truth is what our PMP made of the capture, so that only its pixels count; shading, print, gloss, translucency and the
camera's own noise come from the capture. Nothing of it is kept: the folder is somebody else's, and read where it lies.
"""

from __future__ import annotations

import cv2
import numpy as np

from scanner.capture import Capture
from scanner.decode import decoder_for
from scanner.devices import Truth
from scanner.geometry import load_calibration
from scanner.patterns import PatternSequence
from scanner.triangulation import triangulate

BLUR_PX = 0.7
"""Projector's, px: the fringes that coordinates come from were too coarse to tell it"""
FULL = 0.9
"""Of the range: what the 99.5th percentile of the scene under full light is set to"""
NOISE_DN = 1.2
SMOOTH_PX = 2.0
"""Of the coordinates, camera px: noise of coarse fringes (a pixel of the projector) would scramble carriers"""


def scene_of(folder):
    """Truth, calibration, brightness under full light and under none of a PMP capture, grey levels."""
    capture = Capture.open(folder)
    header = capture.header
    decoder = decoder_for(header.sequence, header.camera)
    for position in capture.records:
        decoder.add(position, capture.frame(position))
    found = decoder.finish()
    calibration = load_calibration(folder / "calibration.json")
    values = {"rows": found.rows, "columns": found.columns}
    smooth = {name: _smoothed(v) for name, v in values.items() if v is not None}
    xyz = triangulate(calibration, **smooth).xyz
    seen = calibration.projector.project(calibration.to_projector(xyz))
    rows, columns = (smooth.get(name, seen[..., k].astype(np.float32)) for name, k in (("rows", 1), ("columns", 0)))
    lit = np.isfinite(rows) & np.isfinite(columns)
    # Fringes are 1/2 + 1/2 cos: full light is A + B, none is A - B.
    return Truth(rows, columns, xyz, lit), calibration, found.albedo + found.modulation, found.albedo - found.modulation


def _smoothed(values):
    """Gaussian mean of what is there, where all of the neighbourhood is on one surface."""
    there = np.isfinite(values)
    known = np.where(there, values, 0).astype(np.float32)
    weight = cv2.GaussianBlur(there.astype(np.float32), (0, 0), SMOOTH_PX)
    mean = cv2.GaussianBlur(known, (0, 0), SMOOTH_PX) / np.maximum(weight, 1e-6)
    square = cv2.GaussianBlur(known * known, (0, 0), SMOOTH_PX) / np.maximum(weight, 1e-6)
    one = (square - mean * mean < 6.0**2) & (np.abs(values - mean) < 6)
    return np.where(there & one & (weight > 0.9), mean, np.nan).astype(np.float32)


def relit(scene, pattern, projector, seed=0):
    """(H, W) uint8: the scene under a pattern."""
    truth, _, white, black = scene
    light = cv2.GaussianBlur(PatternSequence(projector, pattern).light(0).astype(np.float32), (0, 0), BLUR_PX)
    columns, rows = (np.nan_to_num(v, nan=-1e4).astype(np.float32) for v in (truth.columns, truth.rows))
    shown = cv2.remap(light, columns, rows, cv2.INTER_LINEAR, borderValue=0)
    full, none = np.nan_to_num(white), np.nan_to_num(black)
    gain = FULL * 255 / float(np.percentile(full[truth.lit], 99.5))
    level = gain * (none + (full - none) * shown * truth.lit)
    noise = np.random.default_rng(seed).standard_normal(level.shape, np.float32) * NOISE_DN
    return np.clip(np.rint(level + noise), 0, 255).astype(np.uint8)
