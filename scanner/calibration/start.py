"""Where the adjustment begins: the camera from its pictures of a flat target, the projector from points in space.

The camera's start is OpenCV's (Zhang 2000) with one term of distortion. Its poses put the target's points of all views
into space, and the projector, whose axis may lie far outside its picture, then follows without any guess from the
Hall model. Views that contradict the others are named here already: one wrong view spoils a start.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.calibration.hall import decompose, hall_matrix, project_hall
from scanner.calibration.lens_slopes import rotation_of
from scanner.calibration.problem import FLAT, State, View
from scanner.calibration.targets import Target
from scanner.errors import CalibrationError
from scanner.geometry import Lens

Array = NDArray[np.float64]

FEWEST_VIEWS = 3
"""Of a flat target: two leave the principal point open, three say everything once."""
BAD_START = 5.0
"""A view whose residual is so many times the median of all, and"""
BAD_START_PX = 1.0
"""more than this, contradicts the others."""


@dataclass(frozen=True, eq=False)
class Start:
    """state: of the views that are used; used: their positions; left_out: position -> why; camera_px: rms that is left
    in the camera's picture of the view with most."""

    state: State
    used: tuple[int, ...]
    left_out: dict[int, str]
    camera_px: float


def start(
    target: Target,
    views: Sequence[View],
    camera_size: tuple[int, int],
    projector_size: tuple[int, int],
    *,
    leave_out: bool = True,
) -> Start:
    """A start for `adjust`. leave_out: without views that contradict the others.

    Raises:
        CalibrationError: too few views that agree, or no start in them.
    """
    used = list(range(len(views)))
    left_out: dict[int, str] = {}
    while True:
        chosen = [views[k] for k in used]
        if target.flat:
            camera, poses, errors = _camera_of_flat(target, chosen, camera_size)
        else:
            camera, poses, errors = _camera_in_space(target, chosen, camera_size)
        space = [target.points[v.ids] @ rotation_of(p[:3]).T + p[3:] for v, p in zip(chosen, poses, strict=True)]
        projector, rotation, translation, projector_errors = _projector(space, chosen, projector_size)
        bad = _worst(np.maximum(errors, 0), "camera") or _worst(projector_errors, "projector")
        if not leave_out or bad is None or len(used) <= (FEWEST_VIEWS if target.flat else 1):
            break
        position, why = bad
        left_out[used.pop(position)] = why
    return Start(
        State(camera, projector, rotation, translation, FLAT.copy(), poses), tuple(used), left_out, float(errors.max())
    )


def _worst(errors: Array, side: str) -> tuple[int, str] | None:
    if len(errors) < FEWEST_VIEWS:
        return None
    k = int(np.argmax(errors))
    others = float(np.median(np.delete(errors, k)))
    if errors[k] > max(BAD_START * others, BAD_START_PX):
        return k, f"contradicts the other views in the {side}: {errors[k]:.1f} px against their {others:.2f} px"
    return None


def _camera_of_flat(target: Target, views: Sequence[View], size: tuple[int, int]) -> tuple[Lens, Array, Array]:
    points = [target.points[view.ids].astype(np.float32) for view in views]
    pixels = [view.camera.astype(np.float32).reshape(-1, 1, 2) for view in views]
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    try:
        # OpenCV makes its own start from None; its annotations do not know that.
        found: Any = cv2.calibrateCameraExtended(points, pixels, size, None, None, flags=flags)  # type: ignore[call-overload]
    except cv2.error as error:
        raise CalibrationError(
            "the camera cannot be calibrated from these views", hint="tilt the target about different axes"
        ) from error
    _, matrix, distortion, turns, shifts, _, _, errors = found
    lens = Lens(size, np.asarray(matrix, dtype=np.float64), np.append(np.ravel(distortion)[:1], np.zeros(4)))
    poses = np.hstack((np.reshape(turns, (-1, 3)), np.reshape(shifts, (-1, 3)))).astype(np.float64)
    return lens, poses, np.ravel(errors).astype(np.float64)


def _camera_in_space(target: Target, views: Sequence[View], size: tuple[int, int]) -> tuple[Lens, Array, Array]:
    """Of a target in space, whose first view says it all; the others follow from it."""
    first = max(views, key=lambda view: len(view.ids))
    parts = decompose(hall_matrix(target.points[first.ids], first.camera))
    matrix = parts.matrix.copy()
    matrix[0, 1] = 0.0
    poses, errors = [], []
    for view in views:
        points, pixels = target.points[view.ids], view.camera
        found, turn, shift = cv2.solvePnP(points, pixels, matrix, None, flags=cv2.SOLVEPNP_SQPNP)
        if not found:
            raise CalibrationError(f"{view.name}: no pose of the target fits its points")
        poses.append(np.concatenate((np.ravel(turn), np.ravel(shift))))
        guess, _ = cv2.projectPoints(points, turn, shift, matrix, None)
        errors.append(float(np.sqrt(((guess.reshape(-1, 2) - pixels) ** 2).sum(axis=1).mean())))
    return Lens(size, matrix, np.zeros(5)), np.array(poses), np.array(errors)


def _projector(
    space: Sequence[Array], views: Sequence[View], size: tuple[int, int]
) -> tuple[Lens, Array, Array, Array]:
    points, pixels = np.concatenate(space), np.concatenate([view.projector for view in views])
    matrix = hall_matrix(points, pixels)
    parts = decompose(matrix)
    errors = [
        float(np.sqrt(((project_hall(matrix, p) - v.projector) ** 2).sum(axis=1).mean()))
        for p, v in zip(space, views, strict=True)
    ]
    inner = parts.matrix.copy()
    inner[0, 1] = 0.0
    return Lens(size, inner, np.zeros(5)), parts.rotation, parts.translation, np.array(errors)
