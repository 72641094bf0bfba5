"""What a calibration is worth for a pose it has not seen: every view is left out in turn and then predicted.

The left-out view's pose comes from its camera points alone; what its projector points then miss is the error that a
scan of that pose would have along and across the epipolar lines, in projector pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.calibration.adjustment import Adjusted, adjust_again
from scanner.calibration.lens_slopes import rotation_of
from scanner.calibration.problem import SHEET, Problem, State, sheet_points

Array = NDArray[np.float64]

MOST_TRIED = 12
"""Views left out in turn; of more, as many evenly chosen."""
FEWEST_LEFT = 3
FEWEST_FOR_SPREAD = 8
"""Views from which the jackknife's variance is worth using: it is known to the root of two over their number."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """errors: (V,) px rms in the projector of each view, predicted by the others; NaN where not tried. inflation: by
    which the formal covariance must be multiplied for the rig to move as much as it does from view to view; 1 or more.
    """

    errors: Array
    inflation: float = 1.0


def hold_out(problem: Problem, adjusted: Adjusted) -> HeldOut:
    """Leave every view out in turn, of flat targets in more than three.

    The inflation is the jackknife's variance (Tukey 1958) over the formal one, median over the rig's parameters: what
    is common to a whole view, such as blur or a sheet that bends anew each time, is seen by it and not by residuals.
    """
    count = len(problem.views)
    errors = np.full(count, np.nan)
    if count <= FEWEST_LEFT or not problem.target.flat:
        return HeldOut(errors)
    tried = np.unique(np.linspace(0, count - 1, min(count, MOST_TRIED)).round().astype(int))
    moved = []
    for k in tried:
        rest = [i for i in range(count) if i != k]
        part = replace(problem, views=tuple(problem.views[i].only(adjusted.kept[i]) for i in rest))
        begun = replace(adjusted.state, poses=adjusted.state.poses[rest])
        others = adjust_again(part, begun, (adjusted.sigma_camera, adjusted.projector_factor))
        errors[k] = _predicted(problem, others, k, adjusted.kept[k])
        moved.append(others.vector()[: SHEET.start] - adjusted.state.vector()[: SHEET.start])
    if count < FEWEST_FOR_SPREAD:
        return HeldOut(errors)
    formal = np.diag(adjusted.covariance)[: SHEET.start]
    spread = (count - 1) * np.mean(np.square(moved), axis=0)
    known = formal > 0
    return HeldOut(errors, max(1.0, float(np.median(spread[known] / formal[known]))))


def _predicted(problem: Problem, state: State, k: int, kept: NDArray[np.bool_]) -> float:
    view = problem.views[k].only(kept)
    sheet, _ = sheet_points(problem.target, state.sheet)
    points = sheet[view.ids]
    camera = state.camera
    found, turn, shift = cv2.solvePnP(
        points, view.camera, camera.matrix, camera.distortion, flags=cv2.SOLVEPNP_ITERATIVE
    )
    if not found:
        return float("nan")
    in_camera = points @ rotation_of(np.ravel(turn)).T + np.ravel(shift)
    seen = state.projector.project(in_camera @ state.rotation.T + state.translation)
    # An error of the camera's point moves the projector's reading with it: that part is no error of the rig.
    common = (view.slope @ (camera.project(in_camera) - view.camera)[..., None])[..., 0]
    off = seen - view.projector - common
    return float(np.sqrt((off**2).sum(axis=1).mean()))
