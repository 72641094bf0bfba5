"""Which views agree: the adjustment of those that do, and the others named, with why.

One wrong view among many stands out by its residuals. Among few it bends the whole fit until none does, or until
there is no rig at all, and so do several that are wrong alike: what shows it is by how much the others miss a view that
was not asked. Then rigs of three views are tried, and the one that most views agree with says which do not. These are
always a minority: three views of six that agree with each other are no better than the three others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from scanner.calibration.adjustment import ROUNDS, Adjusted, Array, adjust
from scanner.calibration.discs import eccentricity
from scanner.calibration.held_out import HeldOut, hold_out, prediction
from scanner.calibration.lens_slopes import rotation_of
from scanner.calibration.observe import LeftOut
from scanner.calibration.plausibility import MISMATCH
from scanner.calibration.problem import Problem, State, View, sheet_points
from scanner.calibration.start import FEWEST_VIEWS, start
from scanner.errors import CalibrationError

BAD_VIEW = 4.0
"""A view whose residual is so many times the median of all views' is bad, and"""
BAD_VIEW_PX = 0.15
"""more than this: sharp targets differ from pose to pose by their blur alone, within a tenth of a pixel."""
DOUBTED = 2.5
"""A view that the others miss by so many times what is typically left has all of them asked who agrees with whom: of
sound ones alike, the worst is missed by 1.2 to 2 times that."""
SMOOTH_TIMES, SMOOTH_PX = 5.0, 0.05
"""Where so many times what is rough of it, and so much, px, is left, all views are asked, too: corners are as good as
what they do not share with their neighbours. A rig that views bend leaves smooth remainders, and so do bent prints."""
DISC_ROUNDS = 3
"""Of adjustment and the discs' eccentricity in turn."""
SPLIT = 6.0
"""By how many times less must be left of half of the views: fewer fit a rig better than all do, by half perhaps."""
DRAWS = 24
"""Triples of views that are tried: with three bad ones in eight, a triple of good ones is missed once in a hundred."""
HOPELESS_SHARE = 0.01
"""Of the picture's width that a start may leave: more is no lens and no target, and adjusting it takes long."""
GROWN = 3
"""Triples, the best, from which groups are grown: of few views one with a bad one may fit by chance."""


@dataclass(frozen=True, eq=False)
class Agreed:
    """problem: with the views that agree; adjusted: theirs; left_out: the others; held_out: None if not asked. split: a
    group that agrees far better than all of them do, and is no majority: nobody can say who is right."""

    problem: Problem
    adjusted: Adjusted
    left_out: tuple[LeftOut, ...] = ()
    held_out: HeldOut | None = None
    split: Agreed | None = None

    @property
    def doubtful(self) -> bool:
        """Whether some views may bend the rig."""
        held = self.held_out
        missed = held is not None and held.most_px > DOUBTED * held.typical_px
        return self.worst_px > BAD_VIEW_PX or missed or self.left_px > max(SMOOTH_TIMES * self.rough_px, SMOOTH_PX)

    @property
    def rough_px(self) -> float:
        """Of `left_px` what is no smooth function of a view's points (quadratic), px: the median of the views."""
        found = [
            _rough(self.problem.target.points[view.ids[kept]], residuals[k][kept])
            for residuals in (self.adjusted.camera_residuals, self.adjusted.projector_residuals)
            for k, (view, kept) in enumerate(zip(self.problem.views, self.adjusted.kept, strict=True))
        ]
        return float(np.nanmedian(found)) if np.isfinite(found).any() else float("inf")

    @property
    def left_px(self) -> float:
        """Root mean square of what is left in both pictures, px, of all views."""
        camera, projector = _view_rms(self.problem, self.adjusted, kept=True)
        points = np.array([kept.sum() for kept in self.adjusted.kept])
        return float(np.sqrt(np.average(np.square((camera, projector)).mean(axis=0), weights=points)))

    @property
    def worst_px(self) -> float:
        """That of the view with the largest, in one picture."""
        return float(np.max(_view_rms(self.problem, self.adjusted, kept=True)))


def agreed(problem: Problem, *, leave_out: bool = True) -> Agreed:
    """Adjust the views that agree.

    Args:
        problem: of all views.
        leave_out: leave each out in turn, too; without it some that bend the rig alike may pass.

    Raises:
        CalibrationError: no majority of three or more does.
    """
    found: Agreed | None = None
    failure: CalibrationError | None = None
    try:
        found = _without_bad_views(problem)
        found = _held_out(found) if leave_out else found
    except CalibrationError as error:
        failure = error
    if problem.target.flat and (found is None or found.doubtful):
        found = _searched(problem, found, leave_out=leave_out) or found
    if found is not None:
        return found
    assert failure is not None  # noqa: S101  nothing was found, so something was raised
    raise CalibrationError(f"{failure}; no majority of the {len(problem.views)} views agrees", hint=failure.hint)


def _without_bad_views(problem: Problem) -> Agreed:
    """Start and adjust; leave out the worst view while one stands out, and adjust again."""
    begun = start(problem.target, problem.views, problem.camera_size, problem.projector_size)
    out = [LeftOut(problem.views[k].name, why) for k, why in sorted(begun.left_out.items())]
    seen = _of(problem, begun.used)
    state = begun.state
    while True:
        corrected, adjusted = _adjusted(seen, state)
        worst = _worst_view(corrected, adjusted) if problem.target.flat else None
        if worst is None or len(seen.views) <= FEWEST_VIEWS:
            return Agreed(corrected, adjusted, tuple(out))
        k, why = worst
        out.append(LeftOut(seen.views[k].name, why))
        keep = [i for i in range(len(seen.views)) if i != k]
        seen = _of(seen, keep)
        state = replace(adjusted.state, poses=adjusted.state.poses[keep])


def _searched(problem: Problem, whole: Agreed | None, *, leave_out: bool) -> Agreed | None:
    """The largest group that agrees, grown from triples; None where the rest does not contradict it clearly."""
    count = len(problem.views)
    if count <= FEWEST_VIEWS:
        return None
    every = whole if whole is not None and not whole.left_out else _fitted(problem)
    every = _held_out(every) if every is not None and leave_out else every
    tried = [(_missed_by(problem, triple), triple) for triple in _triples(count)]
    # Least median of squares (Rousseeuw 1984): what a majority of the views misses the triple's rig by, at most.
    ranked = sorted(((_of_majority(missed), triple) for missed, triple in tried), key=lambda trial: trial[0])
    grown = [_grown(problem, triple) for score, triple in ranked[:GROWN] if np.isfinite(score)]
    groups = {tuple(used): fit for used, fit in grown if fit is not None and count // 2 < len(used) < count}
    found = [(used, _held_out(fit) if leave_out else fit) for used, fit in groups.items()]
    found = [group for group in found if every is None or _clearer(group[1], every)]
    if not found:
        return None if every is None else _split(problem, every, [missed for missed, _ in tried])
    # A large group that a bad view bends is no better than the small one that it was grown from.
    least = min(fit.left_px for _, fit in found)
    clean = [group for group in found if group[1].worst_px <= max(BAD_VIEW * least, BAD_VIEW_PX)]
    used, best = max(clean or found, key=lambda group: (len(group[0]), -group[1].left_px))
    return replace(best, left_out=tuple(_contradicting(problem, best, k) for k in range(count) if k not in used))


def _split(problem: Problem, every: Agreed, tried: Sequence[Array]) -> Agreed | None:
    """Every view, with the half of them that agrees far better; None where none does. tried: (V,) px by which views
    miss rigs of three."""
    half = len(problem.views) // 2
    if half < FEWEST_VIEWS:
        return None
    missed = min(tried, key=lambda one: float(np.sort(one)[half - 1]))
    fit = _fitted(_of(problem, sorted(int(k) for k in np.argsort(missed)[:half])))
    if fit is None or SPLIT * fit.left_px > every.left_px:
        return None
    return replace(every, split=fit)


def _rough(points: Array, residuals: Array) -> float:
    """Rms distance, px, of residuals (n, 2) from a quadratic function of their points (n, 3); NaN of few."""
    x, y = ((points[:, :2] - points[:, :2].mean(axis=0)) / max(float(np.ptp(points[:, :2])), 1e-9)).T
    terms = np.column_stack((np.ones_like(x), x, y, x * x, x * y, y * y))
    free = len(points) - terms.shape[1]
    if free < terms.shape[1]:
        return float("nan")
    left = residuals - terms @ np.linalg.lstsq(terms, residuals, rcond=None)[0]
    return float(np.sqrt((left**2).sum() / free))


def _clearer(group: Agreed, every: Agreed) -> bool:
    """Whether the group has a quarter of what is left of every view, or misses its own by a quarter or less."""
    pairs = [(group.left_px, every.left_px)]
    if group.held_out is not None and every.held_out is not None:
        pairs.append((group.held_out.most_px, every.held_out.most_px))
    return any(BAD_VIEW * less <= more for less, more in pairs)


def _held_out(fit: Agreed) -> Agreed:
    if fit.held_out is not None:
        return fit
    try:
        return replace(fit, held_out=hold_out(fit.problem, fit.adjusted))
    except (np.linalg.LinAlgError, ValueError):
        # A rig that one view alone holds together: what it is worth, `check_state` says.
        return replace(fit, held_out=HeldOut.nothing(fit.adjusted))


def _triples(count: int) -> list[tuple[int, ...]]:
    """All triples of views where they are few, else as many random ones."""
    every = list(combinations(range(count), FEWEST_VIEWS))
    if len(every) <= DRAWS:
        return every
    drawn = np.random.default_rng(1984).choice(len(every), DRAWS, replace=False)
    return [every[k] for k in drawn]


def _missed_by(problem: Problem, triple: Sequence[int]) -> Array:
    """(V,) px by which views miss the triple's rig; infinite where there is none."""
    fit = _fitted(_of(problem, triple), rounds=2)
    return np.full(len(problem.views), np.inf) if fit is None else _misses(problem, fit)


def _of_majority(misses: Array) -> float:
    """What more than half of the views are missed by, at most."""
    return float(np.sort(misses)[len(misses) // 2])


def _misses(problem: Problem, fit: Agreed) -> Array:
    """(V,) px: by how much each view misses a rig; infinite where no pose fits it."""
    state = fit.adjusted.state
    missed = [max(prediction(problem, state, view)) for view in problem.views]
    found: Array = np.nan_to_num(np.array(missed), nan=np.inf)
    return found


def _grown(problem: Problem, triple: Sequence[int]) -> tuple[list[int], Agreed | None]:
    """The views that agree with a triple's rig, the nearest half of them first, and with the rig found so, and so on;
    and the last rig."""
    used = list(triple)
    best = _fitted(_of(problem, used))
    while best is not None and len(used) < len(problem.views):
        misses = _misses(problem, best)
        allowed = max(BAD_VIEW * _of_majority(misses), BAD_VIEW_PX)
        near = [int(k) for k in np.argsort(misses) if k not in used and misses[k] <= allowed]
        if not near:
            return used, best
        used = sorted([*used, *near[: (len(near) + 1) // 2]])
        best = _fitted(_of(problem, used))
    return used, best


def _contradicting(problem: Problem, best: Agreed, k: int) -> LeftOut:
    view = problem.views[k]
    camera, projector = prediction(problem, best.adjusted.state, view)
    side, missed = ("projector", projector) if projector > camera else ("camera", camera)
    words = f"{missed:.2f} px in the {side} against their {best.left_px:.2f} px" if np.isfinite(missed) else "no pose"
    return LeftOut(view.name, f"contradicts the other views: {words}")


def _fitted(problem: Problem, rounds: int = ROUNDS) -> Agreed | None:
    """All views of a problem, with a start of their own; None where there is none."""
    try:
        begun = start(problem.target, problem.views, problem.camera_size, problem.projector_size, leave_out=False)
        if begun.camera_px > HOPELESS_SHARE * problem.camera_size[0]:
            return None
        return Agreed(*_adjusted(problem, begun.state, rounds))
    except CalibrationError:
        return None


def _of(problem: Problem, used: Sequence[int]) -> Problem:
    return replace(problem, views=tuple(problem.views[k] for k in used))


def _adjusted(problem: Problem, state: State, rounds: int = ROUNDS) -> tuple[Problem, Adjusted]:
    """The adjustment; discs' centres are corrected for perspective and it is done again."""
    try:
        adjusted = adjust(problem, state, rounds)
        seen = problem
        for _ in range(DISC_ROUNDS if problem.target.discs else 0):
            problem = replace(seen, views=tuple(_centred(seen, adjusted.state, k) for k in range(len(seen.views))))
            adjusted = adjust(problem, adjusted.state, rounds)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise CalibrationError(
            f"no rig fits these points: the adjustment ends in nothing ({error})", hint=MISMATCH
        ) from error
    return problem, adjusted


def _centred(problem: Problem, state: State, k: int) -> View:
    """A view of discs with each point moved from its ellipse's centre to where the disc's centre is seen."""
    view, target = problem.views[k], problem.target
    sheet, _ = sheet_points(target, state.sheet)
    rotation = rotation_of(state.poses[k, :3])
    centres = sheet[view.ids] @ rotation.T + state.poses[k, 3:]
    normals = np.tile((0.0, 0.0, 1.0), (len(centres), 1)) if target.flat else target.normals
    if normals is None:
        return view
    turned = (normals if target.flat else normals[view.ids]) @ rotation.T
    moved = eccentricity(centres, turned, target.diameter_mm / 2, state.camera.project)
    return replace(view, camera=view.camera - moved, projector=view.projector - (view.slope @ moved[..., None])[..., 0])


def _worst_view(problem: Problem, adjusted: Adjusted) -> tuple[int, str] | None:
    found = None
    for side, rms in zip(("camera", "projector"), _view_rms(problem, adjusted, kept=False), strict=True):
        k = int(np.argmax(rms))
        others = float(np.median(np.delete(rms, k))) if len(rms) > 1 else rms[k]
        over = rms[k] / max(BAD_VIEW * others, BAD_VIEW_PX)
        if over > 1 and (found is None or over > found[2]):
            found = (
                k,
                f"contradicts the other views: {rms[k]:.2f} px in the {side} against their {others:.2f} px",
                over,
            )
    return found and found[:2]


def _view_rms(problem: Problem, adjusted: Adjusted, *, kept: bool) -> tuple[Array, Array]:
    """(V,) px left in the camera and (V,) in the projector, whose points are weighed by their sigmas
    (`Problem.typical_rms`). kept: of the points that took part alone."""
    camera, projector = [], []
    sides = adjusted.camera_residuals, adjusted.projector_residuals
    for view, seen, predicted, took_part in zip(problem.views, *sides, adjusted.kept, strict=True):
        part = took_part if kept else np.ones_like(took_part)
        camera.append(np.sqrt(np.square(seen[part]).sum(axis=1).mean()))
        projector.append(problem.typical_rms(view.only(part), predicted[part]))
    return np.array(camera), np.array(projector)
