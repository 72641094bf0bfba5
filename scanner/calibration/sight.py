"""One look at a target, in a plain picture of it lit white: where it stands, and why it should not be captured so.

For guiding a hand: quick, and to a degree and a per cent. What is measured comes from captures (`observe`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.calibration.corners import LEAST_RADIUS_PX
from scanner.calibration.detection import NotFound, detect, window_radius
from scanner.calibration.targets import Target

Array = NDArray[np.float64]

GUESSED_FOCAL = 1.5
"""Focal length over the picture's width, before anything is known: 37 degrees across. Tilts are told to a few degrees
with one that is off by a half, and depths in shares not at all otherwise."""
FOCALS = (0.4, 8.0)
"""Focal lengths over the picture's width that a pose is believed to tell: 103 to 7 degrees across"""
TELLING_TILT_DEG = 12.0
"""From here, with a guessed focal length, a pose tells the true one; below, its perspective is the noise's"""
MOST_TILT_DEG = 45.0
"""Beyond, squares are seen at less than .7 of their width, and fringes as coarse again are laid over each pixel."""
DARK_SHARE = 0.25
"""Of the brightest squares' light, below which a square is not lit. Falloff, a tilt of 45 degrees and a fifth more of
distance leave .35 together."""
DARK = 0.04
"""99.5th percentile of the picture over its range, below which it is too dark to see anything: ten of 255"""
BRIGHT_SHARE = 0.3
"""Share of the picture at the top of its range, from which a target that is not found is probably overexposed."""
WIDE_EDGE_PX = 4.0
"""1-sigma of the sharpest edges of a picture without a target, from which blur is the likely reason"""

SIDES = ("left", "right", "top", "bottom")


@dataclass(frozen=True)
class Standing:
    """How a target stands: tilt against the camera's axis, which of its sides (in the picture) is nearer, and its
    depth in mm (in shares only, while the focal length is guessed)."""

    tilt_deg: float
    nearer: str
    depth: float


@dataclass(frozen=True, eq=False)
class Sight:
    """A target that is seen. ids: (N,), points: (N, 2) camera px. trouble: why it should not be captured like this."""

    ids: NDArray[np.int64]
    points: Array
    standing: Standing
    trouble: str | None = None


def guessed_matrix(size: tuple[int, int]) -> Array:
    """(3, 3): a camera of which only the picture's size (width, height) is known."""
    focal = GUESSED_FOCAL * size[0]
    return np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])


def matrix_of_poses(target: Target, poses: Sequence[tuple[NDArray[np.int64], Array]], size: tuple[int, int]) -> Array:
    """(3, 3): the camera as far as tilted poses tell its focal length, before a rig can be solved.

    By the two conditions that a plane's homography sets each view (Z. Zhang, *IEEE Transactions on Pattern Analysis
    and Machine Intelligence* 22, 2000, sec. 3.1), principal point in the middle, pixels square.

    Args:
        poses: ids (N,) and points (N, 2) camera px of each.
        size: (width, height) px of the picture.

    Returns:
        `guessed_matrix` where no pose is tilted enough.
    """
    guess = guessed_matrix(size)
    telling = [one for one in poses if standing_of(target, *one, guess).tilt_deg >= TELLING_TILT_DEG]
    if not telling:
        return guess
    middle = guess[:2, 2]
    known, unknown = np.concatenate([_conditions(target.points[ids, :2], at - middle) for ids, at in telling], axis=1)
    # Least squares for 1 / focal^2.
    inverse = -float(unknown @ known) / float(unknown @ unknown)
    focal = inverse**-0.5 if inverse > 0 else 0.0
    if not FOCALS[0] * size[0] < focal < FOCALS[1] * size[0]:
        return guess
    return np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]])


def _conditions(on_target: Array, seen: Array) -> tuple[Array, Array]:
    """known, unknown: (2,) each, with known + unknown / focal^2 = 0: columns of a rotation are orthogonal, and as long
    as one another. on_target: (N, 2) mm; seen: (N, 2) px from the principal point.
    """
    h = np.asarray(cv2.findHomography(on_target, seen)[0], dtype=np.float64)
    h /= np.linalg.norm(h[:2, :2])
    known = np.array([h[2, 0] * h[2, 1], h[2, 0] ** 2 - h[2, 1] ** 2])
    unknown = np.array([h[:2, 0] @ h[:2, 1], h[:2, 0] @ h[:2, 0] - h[:2, 1] @ h[:2, 1]])
    return known, unknown


def standing_of(target: Target, ids: NDArray[np.int64], points: Array, matrix: Array) -> Standing:
    """How the target stands whose points (N, 2) px are seen; distortion is left out."""
    _, turn, shift = cv2.solvePnP(target.points[ids], points, matrix, np.zeros(5), flags=cv2.SOLVEPNP_ITERATIVE)
    rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
    middle = rotation @ target.points[ids].mean(axis=0) + np.ravel(shift)
    normal = rotation[:, 2] * np.sign(rotation[2, 2] or 1.0)
    # On the plane dz/dx = -normal x / normal z: a normal that points right has its right side nearer.
    across = abs(normal[0]) > abs(normal[1])
    side = SIDES[int(normal[0] > 0)] if across else SIDES[2 + int(normal[1] > 0)]
    tilt = float(np.degrees(np.arccos(np.clip(normal[2], 0, 1))))
    return Standing(tilt, side, float(middle[2]))


def look(picture: NDArray[Any], target: Target, matrix: Array, stride: int = 1) -> Sight | str:
    """Look for a target.

    Args:
        picture: (H, W) uint8 or uint16, the target lit by a white picture.
        target: a flat one.
        matrix: (3, 3) of the camera's whole picture, true or `guessed_matrix`.
        stride: camera pixels per pixel of `picture`.

    Returns:
        What is seen, or in words why nothing is.
    """
    top = float(np.iinfo(picture.dtype).max)
    if np.percentile(picture, 99.5) < DARK * top:
        return "the picture is dark: switch the projector on, or expose longer"
    found = detect(picture, target)
    if isinstance(found, NotFound):
        return _why_not(picture, top, found.reason)
    points = found.points * stride + (stride - 1) / 2 if stride > 1 else found.points
    standing = standing_of(target, found.ids, points, matrix)
    return Sight(found.ids, points, standing, _trouble(picture, target, found.points, found.spacing, stride, standing))


def _why_not(picture: NDArray[Any], top: float, reason: str) -> str:
    if np.mean(picture >= 0.99 * top) > BRIGHT_SHARE:
        return f"too bright: expose shorter ({reason})"
    if edge_width(picture) > WIDE_EDGE_PX:
        return f"blurred: focus the camera, or hold the target still ({reason})"
    return reason


def _trouble(
    picture: NDArray[Any], target: Target, points: Array, spacing: Array, stride: int, standing: Standing
) -> str | None:
    middle = np.median(spacing, keepdims=True)
    radius = float(window_radius(target, stride * middle)[0])
    if not target.discs and radius < LEAST_RADIUS_PX:
        return f"too far: {stride * middle[0]:.0f} px from point to point leave too little around each"
    if standing.tilt_deg > MOST_TILT_DEG:
        return f"too tilted: {standing.tilt_deg:.0f} degrees, up to 30 are good"
    x, y, width, height = cv2.boundingRect(points.astype(np.float32))
    part = picture[max(y, 0) : y + height, max(x, 0) : x + width]
    if 2 * stride * edge_width(part) > max(radius, 0.3 * stride * float(middle[0])):
        return "blurred: focus the camera, or hold the target still"
    dark = _unlit(picture, points, float(middle[0]))
    if dark:
        return f"{dark} of {len(points)} points are not lit: outside the projector's field, or in a shadow"
    return None


def edge_width(picture: NDArray[Any]) -> float:
    """1-sigma of the sharpest edges in px, as if each were a step of the picture's whole contrast: a step of height h
    blurred by sigma rises by h / (sigma sqrt(2 pi)) a pixel where it is steepest."""
    plain = np.asarray(picture, dtype=np.float32)
    low, high = np.percentile(plain, (2, 98))
    across, down = cv2.Scharr(plain, cv2.CV_32F, 1, 0), cv2.Scharr(plain, cv2.CV_32F, 0, 1)
    steepest = float(np.percentile(cv2.magnitude(across, down), 99.5)) / 32
    return float(high - low) / max(steepest * float(np.sqrt(2 * np.pi)), 1e-9)


def _unlit(picture: NDArray[Any], points: Array, spacing: float) -> int:
    """Points whose brightest square is darker than DARK_SHARE of what the bright ones have."""
    reach = 2 * max(1, round(0.6 * spacing)) + 1
    brightest: NDArray[Any] = cv2.dilate(picture, np.ones((reach, reach), np.uint8))
    at = points.round().astype(int)
    at = np.clip(at, 0, np.array(picture.shape[::-1]) - 1)
    light = brightest[at[:, 1], at[:, 0]].astype(np.float64)
    return int((light < DARK_SHARE * np.percentile(light, 90)).sum())
