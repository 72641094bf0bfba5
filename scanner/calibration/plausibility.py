"""Results that cannot be, refused with their likely cause, before the adjustment and after it.

A least-squares fit always has an answer. What makes a calibration trusted is that a wrong square size, a mirrored
picture or poses that say nothing are named instead of being fitted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.calibration.adjustment import Adjusted
from scanner.calibration.lens_slopes import rotation_of
from scanner.calibration.problem import Problem, State, View
from scanner.calibration.targets import Target
from scanner.digits import rounded
from scanner.errors import CalibrationError
from scanner.geometry import Lens

Array = NDArray[np.float64]

MOST_RELATIVE_SIGMA = 0.02
"""Of a focal length or of the baseline: what is known no better than that was not measured by these pictures."""
MOST_STATED_OFF = 0.15
"""Between the calibration and a baseline or distance that was entered: a rule laid from lens to lens errs by less."""
WARN_STATED_OFF = 0.05
MOST_RMS_SHARE = 0.002
"""Of the picture's width that residuals may have: 3 px of 1400. Beyond, points and model do not belong together."""
FIELD_DEG = (2.0, 150.0)
"""Full angle of view that a lens may have across its picture."""
SAME_POSE = 0.01
"""Of the picture's width: poses whose points are nearer than this, on average, are one pose."""
SHALLOW = 0.03
"""Range of depth over mean depth below which it is named as the likely cause."""
FLAT_TILT_DEG = 5.0

OBLONG = 0.05
"""By which pixels are not square that are worth a word: industrial cameras are square to .001, casey2011's projector to
.012. More is a picture that was scaled on its way, or whose size is stated wrong."""

MISMATCH = (
    "check that the target's columns and rows are stated right, that it lay still during each capture, and that "
    "nothing on the rig moved between captures"
)
"""What to look for where points and model do not belong together"""


@dataclass(frozen=True)
class Facing:
    """How the projector's picture lies in the camera's: turned by `degrees` (0, 90, 180, 270), mirrored, or with rows
    and columns exchanged."""

    degrees: int
    mirrored: bool
    swapped: bool

    @property
    def words(self) -> str | None:
        """What to tell; None for upright."""
        if self.degrees == 180:
            return "the projector's picture is upside down in the camera's (accepted)"
        if self.degrees in (90, 270):
            return f"the projector's picture is turned by {self.degrees} degrees in the camera's (accepted)"
        return None


def facing(view: View) -> Facing:
    """How the projector's picture lies in the camera's, from one view: the affine part of camera to projector."""
    centred = view.camera - view.camera.mean(axis=0)
    slope = np.linalg.lstsq(centred, view.projector - view.projector.mean(axis=0), rcond=None)[0].T
    # Of the projector's own directions, the camera's right (first column) and down (second).
    turned = bool(abs(slope[0, 1]) + abs(slope[1, 0]) > abs(slope[0, 0]) + abs(slope[1, 1]))
    if np.linalg.det(slope) < 0:
        if turned and slope[0, 1] > 0:
            return Facing(0, mirrored=True, swapped=True)
        return Facing(0 if slope[0, 0] < 0 or turned else 180, mirrored=True, swapped=False)
    quarter = round(float(np.degrees(np.arctan2(slope[1, 0] - slope[0, 1], slope[0, 0] + slope[1, 1]))) / 90)
    return Facing(90 * (quarter % 4), mirrored=False, swapped=False)


def check_facing(views: Sequence[View]) -> tuple[Facing, dict[int, str]]:
    """How most views lie, and the positions of those that contradict them, with why.

    Raises:
        CalibrationError: mirrored, or axes swapped; the hint names the setting that mends it.
    """
    each = [facing(view) for view in views]
    kinds = sorted(set(each), key=each.count)
    common = kinds[-1]
    odd = {
        k: "its picture lies otherwise than the other views'"
        for k, f in enumerate(each)
        if f.mirrored != common.mirrored
    }
    if common.swapped:
        raise CalibrationError(
            "rows and columns are exchanged: the projector's columns run down the camera's picture, its rows across",
            hint='check the order of "axes" in the capture\'s pattern description against the frames; if it is right, '
            "the projector stands on its side and its picture is mirrored: switch the mirroring off",
        )
    if common.mirrored:
        across = common.degrees == 0
        setting = "mirror = true" if across else "mirror = true and rotate = 180"
        raise CalibrationError(
            f"the projector's picture is mirrored {'left to right' if across else 'top to bottom'} in the camera's",
            hint=f"set {setting} under [projector] in the rig file (remove it if it is set), or switch the mirroring "
            "off in the projector's menu or the camera's settings, and capture again",
        )
    return common, odd


def check_motion(views: Sequence[View], camera_size: tuple[int, int], target: Target) -> None:
    """Raise where the target did not move, or too few poses differ.

    Raises:
        CalibrationError: with the number of poses that differ.
    """
    if not target.flat:
        return
    distinct: list[View] = []
    for view in views:
        if all(_moved(view, other) > SAME_POSE * camera_size[0] for other in distinct):
            distinct.append(view)
    needed = 3
    if len(distinct) >= needed:
        return
    if len(distinct) < 2 <= len(views):
        raise CalibrationError(
            f"the target did not move: {len(views)} captures show one pose",
            hint="move and tilt the target between captures: 10 to 20 poses, up to 30 degrees about different axes",
        )
    raise CalibrationError(
        f"{len(distinct)} different poses are too few: {needed} are needed, 10 to 20 are good",
        hint="capture the target in more poses, tilted up to 30 degrees about different axes",
    )


def check_state(problem: Problem, adjusted: Adjusted) -> None:
    """Raise where the adjustment's outcome is no rig.

    Raises:
        CalibrationError: with the likely cause.
    """
    state = adjusted.state
    _check_residuals(problem, adjusted)
    depth, tilt = depth_and_tilt(problem, state)
    sigmas = np.sqrt(np.diag(adjusted.covariance))
    for side, lens, at in (("camera", state.camera, 0), ("projector", state.projector, 9)):
        focal = min(lens.matrix[0, 0], lens.matrix[1, 1])
        unsure = max(sigmas[at], sigmas[at + 1]) / focal
        if not unsure <= MOST_RELATIVE_SIGMA:
            raise CalibrationError(
                f"these poses do not fix the {side}'s focal length: it is known to {unsure:.1%} only",
                hint=_poses_hint(depth, tilt),
            )
        _check_field(lens, side, depth, tilt)
    baseline = float(np.linalg.norm(state.translation))
    unsure = float(sigmas[21:24].max()) / max(baseline, 1e-9)
    if not unsure <= MOST_RELATIVE_SIGMA * 2.5:
        raise CalibrationError(
            f"these poses do not fix where the projector stands: its distance, {baseline:.0f} mm, is known to "
            f"{unsure:.1%} only",
            hint=_poses_hint(depth, tilt),
        )


def check_stated(problem: Problem, state: State, baseline_mm: float | None, distance_mm: float | None) -> list[str]:
    """Warnings where the result is a little off what was entered.

    Raises:
        CalibrationError: it is far off: the target's size was probably stated wrongly.
    """
    warnings = []
    depth, _ = depth_and_tilt(problem, state)
    for what, found, stated in (
        ("distance between camera and projector", float(np.linalg.norm(state.translation)), baseline_mm),
        ("working distance", float(np.mean(depth)), distance_mm),
    ):
        if stated is None:
            continue
        ratio = found / stated
        if abs(np.log(ratio)) > np.log1p(MOST_STATED_OFF):
            spacing = problem.target.spacing_mm
            raise CalibrationError(
                f"the {what} comes out as {found:.0f} mm, {stated:.0f} mm were entered: "
                "the target's size is probably stated wrong",
                hint=f"squares (spacing) of about {_two_digits(spacing / ratio)} mm instead of {spacing:g} mm would "
                "fit, as well as a rule is laid: measure them",
            )
        if abs(ratio - 1) > WARN_STATED_OFF:
            warnings.append(f"the {what} comes out as {found:.1f} mm, {stated:.1f} mm were entered ({ratio - 1:+.1%})")
    return warnings


def oblong_pixels(problem: Problem, state: State) -> list[str]:
    """Warnings of sides whose pixels come out far from square."""
    warnings = []
    for side, lens, size in (
        ("camera", state.camera, problem.camera_size),
        ("projector", state.projector, problem.projector_size),
    ):
        aspect = float(lens.matrix[0, 0] / lens.matrix[1, 1])
        if abs(np.log(aspect)) > np.log1p(OBLONG):
            warnings.append(
                f"the {side}'s pixels come out {aspect:.2f} times as high as wide: unless it is made so, as diamond "
                f"arrays are, its picture is not {size[0]} x {size[1]} px, or is scaled on its way"
            )
    return warnings


def _two_digits(mm: float) -> str:
    """As a length that rests on a rule is known."""
    return rounded(mm, 1 - math.floor(math.log10(mm)))


def depth_and_tilt(problem: Problem, state: State) -> tuple[Array, Array]:
    """Depths (min, max over all points), mm, and tilts of the target against the camera's axis, degrees, per view."""
    depths, tilts = [], []
    for view, pose in zip(problem.views, state.poses, strict=True):
        rotation = rotation_of(pose[:3])
        depths.append((problem.target.points[view.ids] @ rotation.T + pose[3:])[:, 2])
        tilts.append(float(np.degrees(np.arccos(np.clip(abs(rotation[2, 2]), 0, 1)))))
    every = np.concatenate(depths)
    return np.array([every.min(), every.max()]), np.array(tilts)


def _moved(view: View, other: View) -> float:
    common, here, there = np.intersect1d(view.ids, other.ids, return_indices=True)
    if not len(common):
        return np.inf
    return float(np.linalg.norm(view.camera[here] - other.camera[there], axis=1).mean())


def _check_residuals(problem: Problem, adjusted: Adjusted) -> None:
    for side, size, residuals in (
        ("camera", problem.camera_size, adjusted.camera_residuals),
        ("projector", problem.projector_size, adjusted.projector_residuals),
    ):
        rms = float(np.sqrt((np.concatenate(residuals) ** 2).sum(axis=1).mean()))
        if not rms <= MOST_RMS_SHARE * size[0]:
            raise CalibrationError(
                f"no rig fits these points: {rms:.1f} px are left in the {side}{_most_in(problem, residuals)}",
                hint=MISMATCH,
            )


def _most_in(problem: Problem, residuals: Sequence[Array]) -> str:
    """Words for the views that hold most of the residuals; none where there is only one view."""
    if len(problem.views) < 2:
        return ""
    each = [float(np.sqrt((part**2).sum(axis=1).mean())) for part in residuals]
    worst = sorted(range(len(each)), key=lambda k: -each[k])[:3]
    return ", most in " + ", ".join(f"{problem.views[k].name} ({each[k]:.1f} px)" for k in worst)


def _check_field(lens: Lens, side: str, depth: Array, tilt: Array) -> None:
    width = lens.size[0]
    field = 2 * np.degrees(np.arctan(width / 2 / max(lens.matrix[0, 0], 1e-9)))
    if not FIELD_DEG[0] <= field <= FIELD_DEG[1]:
        raise CalibrationError(
            f"the {side} comes out with an angle of view of {field:.1f} degrees", hint=_poses_hint(depth, tilt)
        )


def _poses_hint(depth: Array, tilt: Array) -> str:
    share = (depth[1] - depth[0]) / max(abs(float(depth.mean())), 1e-9)
    causes = []
    if share < SHALLOW:
        causes.append(
            f"the target's points cover {share:.1%} of depth only: move it nearer and farther, by 15 % of the distance"
        )
    if tilt.max() < FLAT_TILT_DEG:
        causes.append(
            f"no pose is tilted by more than {tilt.max():.0f} degrees: tilt up to 30 degrees about different axes"
        )
    if not causes:
        causes.append("capture more poses, tilted up to 30 degrees about different axes, over the whole picture")
    return "; ".join(causes)
