"""From observed views to a rig: start, adjustment, bad views out, a held-out view's error, checks.

`Solution` carries everything a report needs; `calibration_file` writes it. Nothing is written from here, and a result
that cannot be is an error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.calibration.adjustment import Adjusted
from scanner.calibration.agreement import BAD_VIEW, Agreed, agreed
from scanner.calibration.coverage import not_met
from scanner.calibration.drift import epipolar_offsets
from scanner.calibration.held_out import HeldOut
from scanner.calibration.lens_slopes import rotation_of
from scanner.calibration.observe import LeftOut, Observation, warm_up_of, warnings_of
from scanner.calibration.plausibility import (
    Facing,
    check_facing,
    check_motion,
    check_state,
    check_stated,
    oblong_pixels,
)
from scanner.calibration.problem import (
    CAMERA,
    POSES,
    PROJECTOR,
    SHEET,
    SHIFT,
    TURN,
    Priors,
    Problem,
    State,
    View,
)
from scanner.calibration.sheet import contradiction, either_row, stated_length, turned_words
from scanner.calibration.start import FEWEST_VIEWS
from scanner.calibration.targets import Target
from scanner.errors import CalibrationError
from scanner.geometry import Calibration

Array = NDArray[np.float64]

FEW_VIEWS = 6
MOST_ENTRIES = 12_000_000
"""Of the adjustment's Jacobian, 100 MB: 40 views of 280 points. A step on it takes a few seconds."""
SMALL_COVERAGE = 0.4
"""Share of a picture's width or height that all views' points span, below which a warning says so."""

Progress = Callable[[str], None]


@dataclass(frozen=True)
class SolveOptions:
    """What a user may state.

    length: (mm, 1-sigma mm) of the target's longest row of points, first to last; without it the scale is unverified.
    rigid: the target's sheet neither stretches nor bends (glass, metal). baseline_mm, distance_mm: entered to be
    checked against. warm_up_minutes: how long the rig had been on.
    """

    length: tuple[float, float] | None = None
    rigid: bool = False
    baseline_mm: float | None = None
    distance_mm: float | None = None
    warm_up_minutes: float | None = None


@dataclass(frozen=True, eq=False)
class Solution:
    """A calibrated rig and how good it is. adjusted: with the covariance of `held_out`."""

    target: Target
    options: SolveOptions
    problem: Problem
    adjusted: Adjusted
    facing: Facing
    held_out: HeldOut
    epipolar: tuple[Array, ...]
    """per view (N,) px in the projector"""
    left_out: tuple[LeftOut, ...]
    warnings: tuple[str, ...]
    response: dict[str, Any] | None = None
    created: tuple[str, str] = ("", "")
    warm_up: Mapping[str, list[float]] = field(default_factory=dict)
    """see `warm_up_of`, of the captures used"""
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def state(self) -> State:
        """The rig."""
        return self.adjusted.state

    @property
    def geometry(self) -> Calibration:
        """The rig as scans take it."""
        s = self.state
        return Calibration(s.camera, s.projector, s.rotation, s.translation)


def solve(
    target: Target,
    observations: Sequence[Observation],
    options: SolveOptions | None = None,
    left_out: Sequence[LeftOut] = (),
    progress: Progress | None = None,
    *,
    leave_out: bool = True,
) -> Solution:
    """Calibrate. leave_out: leave every view out in turn, which takes as long as the rest, and widen the covariance by
    how much the rig moves.

    Raises:
        CalibrationError: too few usable views, or a result that cannot be; with the likely cause.
    """
    options = options or SolveOptions()
    tell = progress or (lambda _: None)
    out = list(left_out)
    observations = _of_one_rig(observations, out)
    _require_views(target, observations, out)
    views = [o.view for o in observations]
    facing, odd = check_facing(views)
    views = _without(views, odd, out)
    camera_size, projector_size = observations[0].camera_size, observations[0].projector_size
    check_motion(views, camera_size, target)
    tell("adjusting, and leaving views out")
    views = thinned(views)
    problem = Problem(
        target,
        camera_size,
        projector_size,
        tuple(views),
        priors_of(options, target),
        stated_length(options.length, target),
    )
    found = agreed(problem, leave_out=leave_out)
    either = either_row(problem, found.adjusted.state)
    if either is not None:
        found = agreed(replace(problem, length=either), leave_out=leave_out)
    problem, adjusted = found.problem, found.adjusted
    out += found.left_out
    check_state(problem, adjusted)
    warnings = check_stated(problem, adjusted.state, options.baseline_mm, options.distance_mm)
    if found.split is not None:
        warnings.append(_split_words(found, found.split))
    warnings += turned_words(problem, adjusted.state, either=either is not None, left_out=bool(found.left_out))
    held_out = found.held_out or HeldOut.nothing(adjusted)
    adjusted = replace(adjusted, covariance=held_out.covariance)
    used = {view.name for view in problem.views}
    served = [o for o in observations if o.view.name in used]
    taken = sorted(o.created for o in served if o.created)
    solution = Solution(
        target,
        options,
        problem,
        adjusted,
        facing,
        held_out,
        epipolar_errors(problem, adjusted.state),
        tuple(out),
        (),
        observations[0].response,
        (taken[0], taken[-1]) if taken else ("", ""),
        warm_up_of(served),
    )
    return replace(solution, warnings=tuple(warnings + _warnings(solution) + warnings_of(served)))


def _split_words(every: Agreed, group: Agreed) -> str:
    names = ", ".join(view.name for view in group.problem.views)
    return (
        f"views contradict each other, and no majority says which are right: {group.left_px:.3f} px are left of "
        f"{names} alone, {every.left_px:.3f} px of all {len(every.problem.views)}. Was camera, projector or lens moved "
        "between them, or another target shown, one printed anew? Calibrate with those of one time and one target"
    )


def epipolar_errors(problem: Problem, state: State) -> tuple[Array, ...]:
    """Per view (N,) px: how far each projector point lies from the line on which its camera ray is seen."""
    rig = Calibration(state.camera, state.projector, state.rotation, state.translation)
    errors = []
    for view, pose in zip(problem.views, state.poses, strict=True):
        rays = np.column_stack((rig.camera.normalised(view.camera), np.ones(len(view.ids))))
        depth = (problem.target.points[view.ids] @ rotation_of(pose[:3]).T + pose[3:])[:, 2:]
        errors.append(epipolar_offsets(rig, rays * depth, view.projector)[0])
    return tuple(errors)


def thinned(views: Sequence[View]) -> list[View]:
    """Views with every second, third ... point only, where all of them would make too large an adjustment."""
    parameters = POSES + 6 * len(views)
    entries = 4 * sum(len(view.ids) for view in views) * parameters
    step = int(np.ceil(entries / MOST_ENTRIES))
    return [view.only(np.arange(len(view.ids)) % step == 0) if step > 1 else view for view in views]


def _of_one_rig(observations: Sequence[Observation], out: list[LeftOut]) -> list[Observation]:
    """The observations whose pictures have the sizes that most have."""
    sizes = [(o.camera_size, o.projector_size) for o in observations]
    if not sizes:
        return []
    common = max(set(sizes), key=sizes.count)
    kept = []
    for observation, size in zip(observations, sizes, strict=True):
        if size == common:
            kept.append(observation)
        else:
            out.append(
                LeftOut(
                    observation.view.name,
                    "its pictures have another size than most: another camera, region or projector",
                )
            )
    return kept


def _require_views(target: Target, observations: Sequence[Observation], out: Sequence[LeftOut]) -> None:
    needed = FEWEST_VIEWS if target.flat else 1
    if len(observations) >= needed:
        return
    every = len(observations) + len(out)
    names: dict[str, list[str]] = {}
    for one in out:
        names.setdefault(one.reason, []).append(one.name)
    message = f"{len(observations)} of {every} captures can be used, {needed} are needed"
    if out and all(o.out_of_step for o in out):
        raise CalibrationError(
            f"{message}: frames and patterns are out of step ({out[0].name}: {out[0].reason})",
            hint="look at a capture with fringed audit; measure the projector's latency, then capture again",
        )
    if names:
        most = sorted(names.items(), key=lambda item: -len(item[1]))[:4]  # as captured, where as many have them
        message += ". " + "; ".join(f"{len(by)} x {why}" if len(by) > 1 else f"{by[0]}: {why}" for why, by in most)
    if out and all(o.unreadable for o in out):
        raise CalibrationError(message, hint="copy these folders again from where they were taken, or capture again")
    raise CalibrationError(
        message, hint=f"the target looked for is {target.spec}; capture it in 10 to 20 poses, both axes"
    )


def _without(views: Sequence[View], bad: Mapping[int, str], out: list[LeftOut]) -> list[View]:
    out += [LeftOut(views[k].name, why) for k, why in sorted(bad.items())]
    return [view for k, view in enumerate(views) if k not in bad]


def priors_of(options: SolveOptions, target: Target) -> Priors:
    """How far a target may be from its nominal points: prints a thousandth, others not at all."""
    if not options.rigid and target.flat:
        return Priors()
    return Priors(sheet_scale=1e-7, sheet_bend=1e-7)


def _warnings(solution: Solution) -> list[str]:
    problem, adjusted = solution.problem, solution.adjusted
    warnings = []
    if solution.facing.words is not None:
        warnings.append(solution.facing.words)
    if problem.target.flat and len(problem.views) < FEW_VIEWS:
        warnings.append(f"{len(problem.views)} views: 10 to 20 make a calibration that can be judged")
    for side, size, points in (
        ("camera", problem.camera_size, np.concatenate([v.camera for v in problem.views])),
        ("projector", problem.projector_size, np.concatenate([v.projector for v in problem.views])),
    ):
        span = (points.max(axis=0) - points.min(axis=0)) / size
        if span.min() < SMALL_COVERAGE:
            warnings.append(
                f"the poses cover {span[0]:.0%} x {span[1]:.0%} of the {side}'s picture: "
                "what lies outside is extrapolated"
            )
    warnings += _bending(solution)
    warnings += oblong_pixels(problem, adjusted.state)
    if lacking := not_met(problem, adjusted.state):
        warnings.append(lacking)
    if (left_out := _outliers(problem, adjusted)) is not None:
        warnings.append(left_out)
    if (contradicts := contradiction(problem, adjusted.state)) is not None:
        warnings.append(contradicts.words)
    stretch = adjusted.state.sheet[:2] - 1
    if solution.options.length is None and np.abs(stretch).max() > 2 * problem.priors.sheet_scale:
        warnings.append(
            f"the sheet seems stretched by {stretch[0]:+.2%} along x and {stretch[1]:+.2%} along y: "
            "measure it (--length)"
        )
    return warnings


def _outliers(problem: Problem, adjusted: Adjusted) -> str | None:
    """Points left out of the fit, where they are many, or discs, of which each was measured by itself."""
    total, dropped = sum(len(k) for k in adjusted.kept), sum(int((~k).sum()) for k in adjusted.kept)
    if dropped and not problem.target.flat:
        discs = sorted({int(n) for view, k in zip(problem.views, adjusted.kept, strict=True) for n in view.ids[~k]})
        return (
            f"discs {', '.join(map(str, discs))}, from 0 on, were left out as outliers: they are not where the "
            "target's file has them, or were hidden in part"
        )
    return f"{dropped} of {total} points were left out as outliers" if dropped > 0.1 * total else None


def _bending(solution: Solution) -> list[str]:
    """Of a view that contradicts the others too little, or too many of them, to be left out."""
    held_out = solution.held_out
    if held_out.most is None or held_out.most_px <= BAD_VIEW * held_out.typical_px:
        return []
    name = solution.problem.views[held_out.most].name
    return [
        f"the views contradict each other, view {name} most: the others miss it by "
        f"{held_out.most_px:.3f} px in the projector, where {held_out.typical_px:.3f} px are left of views that were "
        "asked. In some captures the target moved or bent, or the picture was not sharp: uncertainties are widened by "
        "it; capture again those whose held-out error is largest"
    ]


def sigmas(adjusted: Adjusted) -> Mapping[str, Array]:
    """1-sigma of the parameters, by group: camera, projector (9,), rotation, translation (3,), sheet (5,)."""
    spread = np.sqrt(np.clip(np.diag(adjusted.covariance), 0, None))
    groups = {"camera": CAMERA, "projector": PROJECTOR, "rotation": TURN, "translation": SHIFT, "sheet": SHEET}
    return {name: spread[part] for name, part in groups.items()}
