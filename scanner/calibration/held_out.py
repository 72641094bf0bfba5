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
from scanner.calibration.problem import SHEET, Problem, State, View, sheet_points

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
        errors[k] = prediction(problem, others, problem.views[k].only(adjusted.kept[k]))[1]
        moved.append(others.vector()[: SHEET.start] - adjusted.state.vector()[: SHEET.start])
    if count < FEWEST_FOR_SPREAD:
        return HeldOut(errors)
    formal = np.diag(adjusted.covariance)[: SHEET.start]
    spread = (count - 1) * np.mean(np.square(moved), axis=0)
    known = formal > 0
    return HeldOut(errors, max(1.0, float(np.median(spread[known] / formal[known]))))


def prediction(problem: Problem, state: State, view: View) -> tuple[float, float]:
    """(camera, projector) px rms of a view that the rig has not seen, its pose from its camera points alone.

    NaN, NaN where no pose fits.
    """
    sheet, _ = sheet_points(problem.target, state.sheet)
    points = sheet[view.ids]
    camera = state.camera
    found, turn, shift = cv2.solvePnP(
        points, view.camera, camera.matrix, camera.distortion, flags=cv2.SOLVEPNP_ITERATIVE
    )
    if not found:
        return float("nan"), float("nan")
    in_camera = points @ rotation_of(np.ravel(turn)).T + np.ravel(shift)
    seen = state.projector.project(in_camera @ state.rotation.T + state.translation)
    missed = camera.project(in_camera) - view.camera
    # An error of the camera's point moves the projector's reading with it: that part is no error of the rig.
    off = seen - view.projector - (view.slope @ missed[..., None])[..., 0]
    return _rms(missed), _rms(off)


def _rms(off: Array) -> float:
    return float(np.sqrt((off**2).sum(axis=1).mean()))
