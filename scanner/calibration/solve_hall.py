"""The dissertation's own calibration: the Hall model of camera and projector from one scan of a target in space.

Points of a wedge (secs. 3.4 and 3.6), or of flat targets in poses that an adjustment has found, give two matrices by
pseudo-inverse. They are written as they are, and as the lenses, rotation and translation that they are made of, so
that every other part of the program can use them: a Hall matrix is a pinhole lens with skew and without distortion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from scanner.calibration.adjustment import Adjusted
from scanner.calibration.discs import eccentricity
from scanner.calibration.hall import decompose, focal_spread, hall_matrix, project_hall
from scanner.calibration.held_out import HeldOut
from scanner.calibration.lens_slopes import rotation_of, vector_of
from scanner.calibration.observe import LeftOut, Observation, warm_up_of, warnings_of
from scanner.calibration.plausibility import MOST_RELATIVE_SIGMA, Facing, check_facing, check_stated
from scanner.calibration.problem import FLAT, POSES, Problem, State, View, sheet_points
from scanner.calibration.sheet import contradiction, stated_length
from scanner.calibration.solve import Progress, Solution, SolveOptions, epipolar_errors, priors_of, solve
from scanner.calibration.targets import FEWEST_DISCS, Target
from scanner.errors import CalibrationError
from scanner.geometry import Lens

Array = NDArray[np.float64]

DISC_ROUNDS = 3
"""Of fit and the discs' eccentricity in turn."""
DISTORTED_PX = 0.1
"""Residual from which distortion is the likely cause: points are measured to some hundredths."""
MOST_RMS_SHARE = 0.002
"""Of the picture's width that residuals may have: beyond, points and model do not belong together."""

LEAST_ORIGIN = 0.01
"""Of the distance: how far before or behind a lens the origin of a target's coordinates must lie for m34 = 1."""

MOST_FOCAL_SPREAD = MOST_RELATIVE_SIGMA
"""1-sigma of a focal length, as a share, that a target in space may leave. What a lens's distortion adds is no noise,
and errs by several times as much. The dissertation's wedge leaves 0.05 % on casey2011, 0.5 % where lenses distort."""


@dataclass(frozen=True, eq=False)
class _Fit:
    """Both matrices and the view they were fitted to, its points corrected for perspective."""

    camera: Array
    projector: Array
    view: View


def solve_hall(
    target: Target,
    observations: Sequence[Observation],
    options: SolveOptions | None = None,
    left_out: Sequence[LeftOut] = (),
    progress: Progress | None = None,
) -> Solution:
    """Calibrate with the Hall model.

    Of a target in space the capture that shows most points is used, and its frame is the world's. A flat target is
    solved by the adjustment first, and the matrices are fitted to all its poses, the camera's frame being the world's.

    Raises:
        CalibrationError: too few points, or a result that cannot be.
    """
    if target.flat:
        return _of_poses(solve(target, observations, options, left_out, progress, leave_out=False))
    if not observations:
        why = left_out[0].reason if left_out else "no capture was given"
        raise CalibrationError(f"no capture shows the target: {why}", hint="capture the target, both axes")
    chosen = max(observations, key=lambda one: len(one.view.ids))
    if len(chosen.view.ids) < FEWEST_DISCS:
        raise CalibrationError(f"{len(chosen.view.ids)} discs are seen, the Hall model is given {FEWEST_DISCS} or more")
    facing, _ = check_facing([chosen.view])
    fit, shifted = _fitted(target, chosen.view), []
    if _origin_beside_a_lens(fit, target.points[fit.view.ids]):
        target = replace(target, points=target.points - target.points.mean(axis=0))
        fit = _fitted(target, chosen.view)
        shifted = [
            "the origin of the target's coordinates is beside a lens, where m34 = 1 of the Hall model cannot be: the "
            "world's origin is the middle of the target's points instead"
        ]
    state, world = _parts(fit, chosen)
    options = options or SolveOptions()
    length = stated_length(options.length, target)
    sizes = chosen.camera_size, chosen.projector_size
    problem = Problem(target, *sizes, (fit.view,), priors_of(options, target), length)
    points = target.points[fit.view.ids]
    adjusted = _as_adjusted(state, problem, (fit.camera, fit.projector), [points])
    _check(adjusted, problem)
    _check_depth(fit, points, float(_in_space(problem, state)[0][:, 2].mean()), chosen.view.ids)
    stated_off = check_stated(problem, state, options.baseline_mm, options.distance_mm)
    warnings = [*shifted, *_warnings(facing, adjusted), *stated_off]
    if (contradicts := contradiction(problem, state)) is not None:
        warnings.append(contradicts.words)
    others = [LeftOut(one.view.name, "one capture is enough") for one in observations if one is not chosen]
    created = (chosen.created, chosen.created)
    hall = {"camera": fit.camera.tolist(), "projector": fit.projector.tolist()}
    return Solution(
        target,
        options,
        problem,
        adjusted,
        facing,
        HeldOut.nothing(adjusted),
        epipolar_errors(problem, state),
        (*left_out, *others),
        (*warnings, *warnings_of([chosen])),
        chosen.response,
        created,
        warm_up_of([chosen]),
        {"hall": hall, "world": world},
    )


def _of_poses(solution: Solution) -> Solution:
    """The Hall matrices of a solution from flat targets."""
    problem, state = solution.problem, solution.state
    space = _in_space(problem, state)
    every = np.concatenate(space)
    camera = hall_matrix(every, np.concatenate([view.camera for view in problem.views]))
    projector = hall_matrix(every, np.concatenate([view.projector for view in problem.views]))
    parts = [decompose(matrix) for matrix in (camera, projector)]
    rotation, translation = _between(*((part.rotation, part.translation) for part in parts))
    lenses = [
        Lens(size, part.matrix, np.zeros(5))
        for size, part in zip((problem.camera_size, problem.projector_size), parts, strict=True)
    ]
    # Poses stand in the Hall camera's frame, which need not be the adjusted one's.
    first = parts[0]
    poses = np.array(
        [
            [*vector_of(first.rotation @ rotation_of(pose[:3])), *(first.rotation @ pose[3:] + first.translation)]
            for pose in state.poses
        ]
    )
    moved = State(lenses[0], lenses[1], rotation, translation, state.sheet, poses)
    adjusted = _as_adjusted(moved, problem, (camera, projector), space)
    _check(adjusted, problem)
    world = {"rotation": first.rotation.T.tolist(), "translation": (-first.rotation.T @ first.translation).tolist()}
    hall = {"camera": camera.tolist(), "projector": projector.tolist()}
    return replace(
        solution,
        adjusted=adjusted,
        epipolar=epipolar_errors(problem, moved),
        extra={"hall": hall, "world": world},
        warnings=(*solution.warnings, *_warnings(None, adjusted)),
    )


def _fitted(target: Target, seen: View) -> _Fit:
    points, view = target.points[seen.ids], seen
    rounds = DISC_ROUNDS if target.normals is not None else 0
    camera = hall_matrix(points, view.camera)
    for _ in range(rounds):
        assert target.normals is not None  # noqa: S101  else there are no rounds
        project = partial(project_hall, camera)
        moved = eccentricity(points, target.normals[seen.ids], target.diameter_mm / 2, project)
        shifted = (seen.slope @ moved[..., None])[..., 0]
        view = replace(seen, camera=seen.camera - moved, projector=seen.projector - shifted)
        camera = hall_matrix(points, view.camera)
    return _Fit(camera, hall_matrix(points, view.projector), view)


def _parts(fit: _Fit, observation: Observation) -> tuple[State, dict[str, list[float]]]:
    """Both matrices as lenses and poses, and where the world is: X_world = rotation @ X_camera + translation."""
    camera, projector = decompose(fit.camera), decompose(fit.projector)
    rotation, translation = _between((camera.rotation, camera.translation), (projector.rotation, projector.translation))
    pose = np.concatenate((vector_of(camera.rotation), camera.translation))
    state = State(
        Lens(observation.camera_size, camera.matrix, np.zeros(5)),
        Lens(observation.projector_size, projector.matrix, np.zeros(5)),
        rotation,
        translation,
        FLAT.copy(),
        pose[None],
    )
    back = camera.rotation.T
    return state, {"rotation": back.tolist(), "translation": (-back @ camera.translation).tolist()}


def _between(camera: tuple[Array, Array], projector: tuple[Array, Array]) -> tuple[Array, Array]:
    """Rotation and translation from camera to projector, from both of the world's."""
    rotation = projector[0] @ camera[0].T
    return rotation, projector[1] - rotation @ camera[1]


def _as_adjusted(state: State, problem: Problem, matrices: tuple[Array, Array], space: Sequence[Array]) -> Adjusted:
    camera = tuple(v.camera - project_hall(matrices[0], p) for v, p in zip(problem.views, space, strict=True))
    projector = tuple(v.projector - project_hall(matrices[1], p) for v, p in zip(problem.views, space, strict=True))
    kept = tuple(np.ones(len(view.ids), dtype=bool) for view in problem.views)
    unknown = np.full((POSES, POSES), np.nan)
    spread = float(np.sqrt((np.concatenate(camera) ** 2).mean()))
    return Adjusted(state, unknown, camera, projector, kept, spread, float("nan"), float("nan"))


def _warnings(facing: Facing | None, adjusted: Adjusted) -> list[str]:
    found = [] if facing is None or facing.words is None else [facing.words]
    left = float(np.sqrt((np.concatenate(adjusted.camera_residuals) ** 2).sum(axis=1).mean()))
    if left > DISTORTED_PX:
        found.append(f"{left:.2f} px are left in the camera: the Hall model knows no distortion (--model pinhole does)")
    return found


def _origin_beside_a_lens(fit: _Fit, points: Array) -> bool:
    """Whether the origin of the target's coordinates is about as deep as a lens: m34 = 1 is no scale for a matrix that
    has 0 there (Casey 2011, eq. 3.8)."""
    for matrix in (fit.camera, fit.projector):
        if not np.isfinite(matrix).all():
            return True
        parts = decompose(matrix)
        depth = float(np.median((points @ parts.rotation.T + parts.translation)[:, 2]))
        if abs(parts.translation[2]) < LEAST_ORIGIN * abs(depth):
            return True
    return False


def _in_space(problem: Problem, state: State) -> list[Array]:
    """By view, (n, 3) mm: the points of the target's sheet, as it came out, in the camera's frame."""
    points = sheet_points(problem.target, state.sheet)[0]
    return [
        points[view.ids] @ rotation_of(pose[:3]).T + pose[3:]
        for view, pose in zip(problem.views, state.poses, strict=True)
    ]


def _check_depth(fit: _Fit, points: Array, distance_mm: float, names: NDArray[np.int64]) -> None:
    """Raise where the target is too flat to tell focal length from distance, or its points are not where they are
    said to be. names: (n,) of the points."""
    for side, matrix, pixels in (
        ("camera", fit.camera, fit.view.camera),
        ("projector", fit.projector, fit.view.projector),
    ):
        unsure = focal_spread(matrix, points, pixels)
        if unsure <= MOST_FOCAL_SPREAD:
            continue
        left = _left(matrix, points, pixels)
        known = f"the {side}'s focal length is known to {min(unsure, 9.99):.1%} only"
        if (odd := _odd_one(points, pixels, left)) is not None:
            raise CalibrationError(
                f"disc {names[odd]}, from 0 on, is not where the target's file has it: with it {left:.2f} px are left "
                f"in the {side}, and {known}",
                hint="measure it again, and see that discs and points have the same order",
            )
        if left > DISTORTED_PX:
            raise CalibrationError(
                f"the Hall model does not fit these points: {left:.2f} px are left in the {side}, and {known}",
                hint="measure the discs' places again; a lens with distortion needs several poses of a flat target",
            )
        deep = float(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[2]) / np.sqrt(len(points))
        raise CalibrationError(
            f"the target's depth is too small for the Hall model: its points lie within {deep:.1f} mm (rms) of a "
            f"plane, {deep / distance_mm:.2%} of the distance, and {known}",
            hint="use a deeper body, or several poses of a flat target",
        )


def _left(matrix: Array, points: Array, pixels: Array) -> float:
    """Rms distance, px."""
    return float(np.sqrt(((project_hall(matrix, points) - pixels) ** 2).sum(axis=1).mean()))


def _odd_one(points: Array, pixels: Array, left: float) -> int | None:
    """Which point alone makes most of what is left: without it there is less than a third; None where none does."""
    if len(points) < FEWEST_DISCS:
        return None
    others = ~np.eye(len(points), dtype=bool)
    without = [_left(hall_matrix(points[kept], pixels[kept]), points[kept], pixels[kept]) for kept in others]
    odd = int(np.argmin(without))
    return odd if without[odd] < left / 3 else None


def _check(adjusted: Adjusted, problem: Problem) -> None:
    for side, size, residuals in (
        ("camera", problem.camera_size, adjusted.camera_residuals),
        ("projector", problem.projector_size, adjusted.projector_residuals),
    ):
        rms = float(np.sqrt((np.concatenate(residuals) ** 2).sum(axis=1).mean()))
        if not rms <= MOST_RMS_SHARE * size[0]:
            raise CalibrationError(
                f"the Hall model does not fit these points: {rms:.1f} px are left in the {side}",
                hint="check the target's file against the target; a lens with strong distortion needs --model pinhole",
            )
    if any(float(np.median(points[:, 2])) <= 0 for points in _in_space(problem, adjusted.state)):
        raise CalibrationError(
            "the target comes out behind the camera: its picture is mirrored against its coordinates",
            hint="check the handedness of the target's file: x right, y down, z away from the viewer, or a turn of it",
        )
