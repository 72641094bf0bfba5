"""What a solved rig's poses leave out of what a calibration asks for: tilts, depths, places in both pictures.

The camera's conditions are those of the guide; of the projector's picture counts what the camera sees of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.calibration.guide import FIELDS, Guide, Seen, fields_of
from scanner.calibration.plausibility import depth_and_tilt
from scanner.calibration.problem import Problem, State
from scanner.geometry import Calibration

Array = NDArray[np.float64]

NOT_MET = "not met of what a calibration asks for: "
"""How it is said, here and where poses are guided"""

_FIELD_CENTRES = np.array([(x, y) for y in (1 / 8, 1 / 2, 7 / 8) for x in (1 / 8, 1 / 2, 7 / 8)])
"""(9, 2) of a picture's width and height, as `FIELDS`"""
_GRID = 33


def not_met(problem: Problem, state: State) -> str:
    """Which conditions of the how-to the views do not meet, in words; "" if none. Bodies in space have none."""
    if not problem.target.flat:
        return ""
    poses = tuple(Seen(view.name, view.ids, view.camera) for view in problem.views)
    lacking = Guide(problem.target, problem.camera_size, poses, state.camera.matrix).lacking()
    points = np.concatenate([view.projector for view in problem.views])
    depth, _ = depth_and_tilt(problem, state)
    there = fields_of(points, problem.projector_size)
    seen = _seen_fields(state, problem.camera_size, problem.projector_size, float(depth.mean()))
    missing = [name for name, has, sees in zip(FIELDS, there, seen, strict=True) if sees and not has]
    words = [lacking] if lacking else []
    if missing:
        words.append(f"no points in {len(missing)} of {int(seen.sum())} fields of the projector's picture "
                     f"({', '.join(missing)})")  # fmt: skip
    return NOT_MET + "; ".join(words) if words else ""


def _seen_fields(
    state: State, camera_size: tuple[int, int], projector_size: tuple[int, int], depth_mm: float
) -> NDArray[np.bool_]:
    """(9,) whose centres the camera sees at this depth; the lenses' distortion does not matter for that."""
    width, height = camera_size
    x, y = np.meshgrid(np.linspace(0, width - 1, _GRID), np.linspace(0, height - 1, _GRID))
    pixels = np.column_stack((x.ravel(), y.ravel(), np.ones(x.size)))
    points = pixels @ np.linalg.inv(state.camera.matrix).T * depth_mm
    rig = Calibration(state.camera, state.projector, state.rotation, state.translation)
    shares = state.projector.project(rig.to_projector(points)) / projector_size
    away = np.abs(shares[:, None] - _FIELD_CENTRES).max(axis=2)
    return np.asarray((away < 1 / 16).any(axis=0))
