"""One bundle adjustment over everything: camera, projector, their relation, the target's sheet, and every pose.

Minimised are pixels in both pictures, in units of their sigmas, by SciPy's `least_squares` with a robust loss and the
exact Jacobian (dense: SciPy's way with sparse ones stops a hundred sigmas short on lenses' correlated numbers). A
projector pixel is read at the camera pixel where the point was found, so an error of the camera's
point moves both: the projector's residual is taken after that common part (`View.slope`), which makes the two
independent and the relation of both lenses as sharp as the phase is. What the pictures leave open (aspect, high terms
of distortion, the sheet's stretch and bend) rests on priors that say how far such things go in practice. The sigmas of
both kinds of pixels come from the residuals themselves (variance components, Helmert 1907), and so does the covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from scanner.calibration.lens_slopes import left_jacobian, rotation_of, seen, turned_slopes
from scanner.calibration.problem import (
    CAMERA,
    POSES,
    PROJECTOR,
    SHEET,
    SHIFT,
    TURN,
    Length,
    Problem,
    State,
    sheet_points,
)

Array = NDArray[np.float64]

Prior = tuple[float, tuple[int, ...], tuple[float, ...]]
"""Residual, the parameters it depends on, and its slopes by them"""

HUBER = 2.5
"""Residuals beyond so many sigmas count linearly: 1.2 % of a Gaussian's do."""
OUTLIER = 6.0
"""Sigmas beyond which a point is left out of the last round: no Gaussian residual of a million lies there."""
LEAST_KEPT = 0.5
"""Share of a view's points that outliers must leave: with fewer it is the view that is wrong, not its points."""
ROUNDS = 4
"""Of sigmas and adjustment in turn; the sigmas then change by less than a per cent."""
FIRST_TOLERANCE, LAST_TOLERANCE = 1e-5, 1e-9
"""Relative change of the cost at which a round ends: the first ones only serve the sigmas."""
START_CAMERA_PX, START_PROJECTOR = 0.05, 3.0
"""Camera 1-sigma, and factor on the projector's own, before the residuals have said theirs."""
MOST_PROJECTOR_FACTOR = 1e4


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The outcome.

    camera_residuals, projector_residuals: per view (N, 2) px, seen minus predicted, the projector's plain ones;
    kept: per view (N,) points that took part in the last round; covariance: (29, 29) of the parameters that are no
    pose, in the order of NAMES, zero for those held fixed; sigma_camera: px; projector_factor: on the views' sigmas.
    """

    state: State
    covariance: Array
    camera_residuals: tuple[Array, ...]
    projector_residuals: tuple[Array, ...]
    kept: tuple[NDArray[np.bool_], ...]
    sigma_camera: float
    projector_factor: float
    cost: float


def adjust(problem: Problem, start: State, rounds: int = ROUNDS) -> Adjusted:
    """Minimise over everything, estimate the sigmas from what is left, and again.

    Raises:
        numpy.linalg.LinAlgError, ValueError: the problem is singular, or its start no geometry.
    """
    sigmas = (START_CAMERA_PX, START_PROJECTOR)
    kept = tuple(np.ones(len(view.ids), dtype=bool) for view in problem.views)
    solved = start.vector()
    for turn in range(rounds):
        equations = Equations(_only(problem, kept), sigmas)
        solved = equations.minimise(solved, FIRST_TOLERANCE if turn < rounds - 1 else LAST_TOLERANCE)
        sigmas = equations.components(solved)
        if 1 <= turn < rounds - 1:
            kept = Equations(problem, sigmas).within(solved)
    covariance, cost = Equations(_only(problem, kept), sigmas).covariance(solved)
    everything = Equations(problem, sigmas)
    camera, projector = everything.plain_residuals(solved)
    state = State.from_vector(solved, problem)
    return Adjusted(state, covariance, camera, projector, kept, *sigmas, cost)


def adjust_again(problem: Problem, start: State, sigmas: tuple[float, float]) -> tuple[State, Array]:
    """Once more from a start that is nearly right, with sigmas that are known; and its covariance as in `Adjusted`.

    Raises:
        numpy.linalg.LinAlgError, ValueError: the problem is singular.
    """
    equations = Equations(problem, sigmas)
    solved = equations.minimise(start.vector(), FIRST_TOLERANCE)
    return State.from_vector(solved, problem), equations.covariance(solved)[0]


class Equations:
    """The weighted residuals of one problem with given sigmas, and their Jacobian, at any parameters.

    All views' points stand in one row of arrays, view after view. Residuals: the camera's of all points (x, y), then
    the projector's, then the priors.
    """

    def __init__(self, problem: Problem, sigmas: tuple[float, float]) -> None:
        views = problem.views
        self._problem = problem
        self._sigmas = sigmas
        self._counts = [len(view.ids) for view in views]
        self._of = np.repeat(np.arange(len(views)), self._counts)
        self._ids = np.concatenate([view.ids for view in views])
        self._camera = np.concatenate([view.camera for view in views])
        self._projector = np.concatenate([view.projector for view in views])
        self._slope = np.concatenate([view.slope for view in views])
        weight = 1 / (np.concatenate([view.sigma for view in views]) * sigmas[1])
        self._weights = np.stack((np.full_like(weight, 1 / sigmas[0]), weight))
        free = np.setdiff1d(np.arange(POSES + 6 * len(views)), problem.fixed)
        self._free: NDArray[np.intp] = free
        self._at: Array | None = None
        self._evaluated: tuple[Array, Array] = (np.empty(0), np.empty(0))

    def minimise(self, x: Array, tolerance: float) -> Array:
        """The parameters, from x, at which the robust sum of squares is least."""

        def whole(part: Array) -> Array:
            full = x.copy()
            full[self._free] = part
            return full

        def residuals(part: Array) -> Array:
            return self.evaluate(whole(part))[0]

        def jacobian(part: Array) -> Array:
            return self.evaluate(whole(part))[1][:, self._free]

        solution = least_squares(
            residuals,
            x[self._free],
            jacobian,
            method="trf",
            x_scale="jac",
            loss="huber",
            f_scale=HUBER,
            ftol=tolerance,
            xtol=1e-12,
            gtol=1e-10,
            max_nfev=60,
        )
        return whole(solution.x)

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Weighted residuals, (M,), and their Jacobian (M, P); kept for the same x."""
        if self._at is not None and np.array_equal(x, self._at):
            return self._evaluated
        with np.errstate(all="ignore"):  # a step too far meets infinities; the solver takes it back
            residual, block = self._points(x)
        scaled = residual * self._weights
        block *= self._weights[..., None]
        priors = _prior_residuals(self._problem, x)
        values = np.concatenate((scaled.ravel(), [prior for prior, _, _ in priors]))
        self._at, self._evaluated = x.copy(), (values, self._jacobian(block, priors, len(x)))
        return self._evaluated

    def components(self, x: Array) -> tuple[float, float]:
        """The sigmas that the residuals of both kinds speak for, with the freedom that each has left.

        Clipped at 2.5 sigma, so that points that are out do not widen them.
        """
        residuals, jacobian = self.evaluate(x)
        jacobian = jacobian[:, self._free]
        inverse = _inverse(jacobian.T @ jacobian)
        new, count = [], 2 * len(self._ids)
        for kind, sigma in enumerate(self._sigmas):
            rows = slice(kind * count, (kind + 1) * count)
            part, own = jacobian[rows], residuals[rows]
            used = float(np.sum(part.T @ part * inverse))
            freedom = max(count - used, 0.02 * count)
            spread = max(1.4826 * float(np.median(np.abs(own))), 1e-12)
            # Clipped at 2.5 sigma a Gaussian's mean square is 0.960 of what it was.
            squares = np.minimum(own**2, (HUBER * spread) ** 2).sum() / 0.960
            new.append(sigma * float(np.sqrt(squares / freedom)))
        return max(new[0], 1e-4), float(np.clip(new[1], 1e-3, MOST_PROJECTOR_FACTOR))

    def within(self, x: Array) -> tuple[NDArray[np.bool_], ...]:
        """Per view (N,): points whose residuals are no outliers; all where most of a view's are: then the view as a
        whole contradicts the others, and its residuals must stay to say so."""
        residual, _ = self._points(x)
        good = np.abs(residual * self._weights).max(axis=(0, 2)) < OUTLIER
        each = np.split(good, np.cumsum(self._counts)[:-1])
        return tuple(one if one.mean() > LEAST_KEPT else np.ones_like(one) for one in each)

    def covariance(self, x: Array) -> tuple[Array, float]:
        """Of the parameters that are no pose, (29, 29), zero where fixed; and the weighted square per freedom."""
        residuals, jacobian = self.evaluate(x)
        part = jacobian[:, self._free]
        whole = np.zeros((len(x), len(x)))
        whole[np.ix_(self._free, self._free)] = _inverse(part.T @ part)
        return whole[:POSES, :POSES], float(residuals @ residuals) / max(len(residuals) - len(self._free), 1)

    def plain_residuals(self, x: Array) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Per view (N, 2) px, seen minus predicted: in the camera, and in the projector with the camera's part."""
        residual, _ = self._points(x)
        camera = -residual[0]
        projector = -residual[1] + (self._slope @ camera[..., None])[..., 0]
        cuts = np.cumsum(self._counts)[:-1]
        return tuple(np.split(camera, cuts)), tuple(np.split(projector, cuts))

    def _points(self, x: Array) -> tuple[Array, Array]:
        """Residuals (2, N, 2) px of camera and projector; their slopes (2, N, 2, 35): the rig's 29, the pose's 6."""
        sheet, by_sheet = sheet_points(self._problem.target, x[SHEET])
        poses = x[POSES:].reshape(-1, 6)
        turns = np.stack([rotation_of(pose[:3]) for pose in poses])
        lefts = np.stack([left_jacobian(pose[:3]) for pose in poses])
        turn, n = rotation_of(x[TURN]), len(self._ids)
        rotation = turns[self._of]
        turned = (rotation @ sheet[self._ids][..., None])[..., 0]
        in_camera = turned + poses[self._of, 3:]
        # Slopes of the point in the camera's frame: sheet, pose's turn, pose's shift.
        by = np.empty((n, 3, POSES + 6 - SHEET.start))
        by[:, :, :-6] = rotation @ by_sheet[self._ids]
        by[:, :, -6:-3] = turned_slopes(lefts[self._of], turned)
        by[:, :, -3:] = np.eye(3)
        seen_camera, camera_lens, camera_point = seen(x[CAMERA], in_camera)
        in_turned = in_camera @ turn.T
        seen_projector, projector_lens, projector_point = seen(x[PROJECTOR], in_turned + x[SHIFT])
        block = np.zeros((2, n, 2, POSES + 6))
        block[0, :, :, CAMERA] = camera_lens
        block[0, :, :, SHEET.start :] = camera_point @ by
        block[1, :, :, PROJECTOR] = projector_lens
        block[1, :, :, TURN] = projector_point @ turned_slopes(left_jacobian(x[TURN]), in_turned)
        block[1, :, :, SHIFT] = projector_point
        block[1, :, :, SHEET.start :] = projector_point @ (turn @ by)
        block[1] -= self._slope @ block[0]
        residual = np.empty((2, n, 2))
        residual[0] = seen_camera - self._camera
        residual[1] = seen_projector - self._projector - (self._slope @ residual[0][..., None])[..., 0]
        return residual, block

    def _jacobian(self, block: Array, priors: Sequence[Prior], count: int) -> Array:
        rows, n = block.shape[0] * block.shape[1] * 2, block.shape[1]
        whole = np.zeros((rows + len(priors), count))
        parts = whole[:rows].reshape(2, n, 2, count)
        parts[..., :POSES] = block[..., :POSES]
        first = 0
        for k, points in enumerate(self._counts):
            at = POSES + 6 * k
            parts[:, first : first + points, :, at : at + 6] = block[:, first : first + points, :, POSES:]
            first += points
        for k, (_, where, slopes) in enumerate(priors):
            whole[rows + k, list(where)] = slopes
        return whole


def _only(problem: Problem, kept: Sequence[NDArray[np.bool_]]) -> Problem:
    return replace(problem, views=tuple(view.only(k) for view, k in zip(problem.views, kept, strict=True)))


def _prior_residuals(problem: Problem, x: Array) -> list[Prior]:
    """(residual, columns, slopes) of each prior."""
    priors = problem.priors
    found: list[Prior] = []
    for side, size in ((CAMERA, problem.camera_size), (PROJECTOR, problem.projector_size)):
        b = side.start
        fx, fy, cx, cy = x[b : b + 4]
        found.append(
            (np.log(abs(fx / fy)) / priors.aspect, (b, b + 1), (1 / fx / priors.aspect, -1 / fy / priors.aspect))
        )
        for i, centre, extent in ((b + 2, cx, size[0]), (b + 3, cy, size[1])):
            sigma = priors.centre * extent
            found.append(((centre - (extent - 1) / 2) / sigma, (i,), (1 / sigma,)))
        radius = np.hypot(*size) / 2 / np.sqrt(abs(fx * fy))
        widths = (
            *(share / radius ** (2 * n) for share, n in zip(priors.radial[:2], (1, 2), strict=True)),
            priors.tangential / radius,
            priors.tangential / radius,
            priors.radial[2] / radius**6,
        )
        # The radius is taken as it stands: its own slope would bend the prior, not the answer.
        found += [(x[b + 4 + i] / w, (b + 4 + i,), (1 / w,)) for i, w in enumerate(widths)]
    s = SHEET.start
    for i, mean, sigma in ((s, 1.0, priors.sheet_scale), (s + 1, 1.0, priors.sheet_scale)):
        found.append(((x[i] - mean) / sigma, (i,), (1 / sigma,)))
    bend = priors.sheet_bend * max(float(np.hypot(*problem.target.half_extent)), 1e-9)
    found += [(x[i] / bend, (i,), (1 / bend,)) for i in range(s + 2, SHEET.stop)]
    if problem.length is not None:
        found.append(_length_residual(problem, problem.length, x))
    return found


def _length_residual(problem: Problem, length: Length, x: Array) -> Prior:
    s = SHEET.start
    across = problem.target.points[length.last] - problem.target.points[length.first]
    scaled = across * (x[s], x[s + 1], 1.0)
    measured = float(np.linalg.norm(scaled))
    slopes = scaled[:2] * across[:2] / measured / length.sigma_mm
    return (measured - length.mm) / length.sigma_mm, (s, s + 1), (float(slopes[0]), float(slopes[1]))


def _inverse(normal: Array) -> Array:
    """The inverse of a positive definite matrix whose units differ by many orders."""
    own = np.diag(normal)
    if not (np.isfinite(normal).all() and (own > 0).all()):
        raise np.linalg.LinAlgError("some parameter moves nothing")
    scale = 1 / np.sqrt(own)
    return np.asarray(np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale), dtype=np.float64)
