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
from scanner.calibration.problem import POSES, SHEET, Problem, State, View, sheet_points

Array = NDArray[np.float64]

MOST_TRIED = 12
"""Views left out in turn; of more, as many evenly chosen."""
FEWEST_LEFT = 3
LEAST_EXPECTED = 1e-9
"""Of the largest variance: what no view has to say, the priors' directions, moves by rounding alone."""
FEWEST_FOR_SPREAD = 5
"""Views from which the jackknife's variance is used: of four, each three make too loose a rig to tell."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """What leaving views out says.

    errors: (V,) px rms in the projector of each view, predicted by the others; NaN where not tried. misses: (V,) the
    same with points weighed by their sigmas (`Problem.typical_rms`). within: (V,) such figures by the rig that all of
    them made. covariance: (29, 29) as the adjustment's, widened to how much the rig moves from view to view. widened:
    by how many times all sigmas were.
    """

    errors: Array
    misses: Array
    within: Array
    covariance: Array
    widened: float = 1.0

    @classmethod
    def nothing(cls, adjusted: Adjusted) -> HeldOut:
        """Of views that are not left out in turn."""
        unknown = np.full(len(adjusted.kept), np.nan)
        return cls(unknown, unknown, unknown, adjusted.covariance)

    @property
    def most(self) -> int | None:
        """The view that the others predict worst; None where none was tried."""
        return int(np.nanargmax(self.misses)) if np.isfinite(self.misses).any() else None

    @property
    def most_px(self) -> float:
        """px by which they miss it, its points weighed; NaN where none was tried."""
        return float("nan") if self.most is None else float(self.misses[self.most])

    @property
    def typical_px(self) -> float:
        """px that the rig of all views leaves of one, points weighed, their median."""
        return float(np.median(self.within))


def hold_out(problem: Problem, adjusted: Adjusted) -> HeldOut:
    """Leave every view out in turn, of flat targets in more than three; only points that took part count.

    Raises:
        numpy.linalg.LinAlgError, ValueError: without one of them the problem is singular.
    """
    views = [view.only(kept) for view, kept in zip(problem.views, adjusted.kept, strict=True)]
    count = len(views)
    if count <= FEWEST_LEFT or not problem.target.flat:
        return HeldOut.nothing(adjusted)
    within = np.array([prediction(problem, adjusted.state, view)[1] for view in views])
    errors, misses = np.full(count, np.nan), np.full(count, np.nan)
    tried = np.unique(np.linspace(0, count - 1, min(count, MOST_TRIED)).round().astype(int))
    moved, looser = [], []
    for k in tried:
        rest = [i for i in range(count) if i != k]
        part = replace(problem, views=tuple(views[i] for i in rest))
        begun = replace(adjusted.state, poses=adjusted.state.poses[rest])
        others, covariance = adjust_again(part, begun, (adjusted.sigma_camera, adjusted.projector_factor))
        if (off := _missed(problem, others, views[k])) is not None:
            errors[k], misses[k] = _rms(off[1]), problem.typical_rms(views[k], off[1])
        moved.append(others.vector()[:POSES] - adjusted.state.vector()[:POSES])
        looser.append(covariance - adjusted.covariance)
    if count < FEWEST_FOR_SPREAD:
        return HeldOut(errors, misses, within, adjusted.covariance)
    return HeldOut(errors, misses, within, *_widened(adjusted.covariance, np.array(moved), np.array(looser), count))


def _widened(formal: Array, moved: Array, looser: Array, count: int) -> tuple[Array, float]:
    """The formal covariance, and what the rig moves beyond it when views are left out (jackknife, Tukey 1958).

    A rig without one view should move by what that view had to say: by the difference of both covariances. What is
    common to a whole view, such as blur or a sheet that bends anew each time, moves it by more and is not seen by
    residuals: the ratio of both variances, median over the rig's parameters, widens all. In a direction in which it
    moves by more than chance makes of so many views (the largest eigenvalue of Marchenko and Pastur 1967), a few
    contradict the others and bend it: what was seen there is added.

    Args:
        formal: (29, 29). moved: (n, 29) parameters without one view, less those of all. looser: (n, 29, 29) covariances
            without it, less that of all. count: of views.

    Returns:
        the covariance, and the common factor of all sigmas.
    """
    known = np.flatnonzero(np.diag(formal) > 0)
    sigmas = np.sqrt(np.diag(formal)[known])
    steps = moved[:, known] / sigmas
    expected = looser[:, known][:, :, known].mean(axis=0) / np.outer(sigmas, sigmas)
    rig = known < SHEET.start
    likely = np.maximum(np.diag(expected)[rig], LEAST_EXPECTED)
    common = max(1.0, float(np.median(np.mean(np.square(steps[:, rig]), axis=0) / likely)))
    values, axes = np.linalg.eigh(expected)
    root = axes * np.sqrt(np.maximum(values, values[-1] * LEAST_EXPECTED))
    white = np.linalg.solve(root, steps.T)
    ratios, directions = np.linalg.eigh(white @ white.T / len(moved))
    bent = ratios > common * (1 + np.sqrt(len(known) / len(moved))) ** 2
    along = root @ directions[:, bent] * np.sqrt((count - 1) * (ratios[bent] - common))
    covariance = common * formal
    covariance[np.ix_(known, known)] += along @ along.T * np.outer(sigmas, sigmas)
    return covariance, float(np.sqrt(common))


def prediction(problem: Problem, state: State, view: View) -> tuple[float, float]:
    """(camera, projector) px rms of a view that the rig has not seen, its pose from its camera points alone.

    The projector's points are weighed by their sigmas: in a view that is overexposed in part some are known to a tenth
    of a pixel only. NaN, NaN where no pose fits.
    """
    missed = _missed(problem, state, view)
    if missed is None:
        return float("nan"), float("nan")
    return _rms(missed[0]), problem.typical_rms(view, missed[1])


def _missed(problem: Problem, state: State, view: View) -> tuple[Array, Array] | None:
    """(N, 2) px in the camera, and in the projector; None where no pose fits."""
    sheet, _ = sheet_points(problem.target, state.sheet)
    points = sheet[view.ids]
    camera = state.camera
    found, turn, shift = cv2.solvePnP(
        points, view.camera, camera.matrix, camera.distortion, flags=cv2.SOLVEPNP_ITERATIVE
    )
    if not found:
        return None
    in_camera = points @ rotation_of(np.ravel(turn)).T + np.ravel(shift)
    seen = state.projector.project(in_camera @ state.rotation.T + state.translation)
    missed: Array = camera.project(in_camera) - view.camera
    # An error of the camera's point moves the projector's reading with it: that part is no error of the rig.
    return missed, seen - view.projector - (view.slope @ missed[..., None])[..., 0]


def _rms(off: Array) -> float:
    return float(np.sqrt((off**2).sum(axis=1).mean()))
