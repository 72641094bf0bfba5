"""Projector rows, columns or both to points in millimetres: one depth along each camera ray.

A decoded row is a curve in the projector's image once its lens distorts; the point sought lies on the camera's ray,
so one unknown is left, the depth z. It starts from the closed form of the undistorted plane and Newton's method on
the distorted projection makes it exact (Gauss-Newton where both axes were measured, weighted by their sigmas). Without
distortion a row alone is Casey 2011, sec. 3.5; both axes minimise the reprojection error, as in Hartley and Sturm,
"Triangulation", 1997, but in the projector alone: the camera's pixel is where it was asked.
Nothing here filters for taste: only points that cannot be (behind a lens, not measured by what was projected) fall.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from scanner.errors import CalibrationError
from scanner.geometry import Array, Calibration, Lens
from scanner.triangulation_kernels import Map, Numbers, along_both, along_rows

MIN_DEPTH_SHARE = 0.1
"""An axis measures depth if at least this share of the image motion with depth lies along it: below, the epipolar
lines run within 6 degrees of across it and noise in depth is ten times what the other axis would give."""


@dataclass(frozen=True, eq=False)
class Triangulated:
    """Points on the camera's grid.

    xyz: (H, W, 3) float32 mm, camera frame, NaN where there is none. sigma_z: (H, W) float32 mm, expected 1-sigma of
    the random error of z; NaN where xyz is, or where no sigma was given. impossible: number of pixels that had a
    value and got no point.
    """

    xyz: Map
    sigma_z: Map
    impossible: int


def triangulate(
    calibration: Calibration,
    *,
    rows: Map | None = None,
    columns: Map | None = None,
    sigma_rows: Map | None = None,
    sigma_columns: Map | None = None,
    every: int = 1,
) -> Triangulated:
    """Depth along each camera ray at which the projector sees the measured row and/or column.

    Args:
        calibration: the rig.
        rows, columns: (H, W) float32 projector coordinates, px; NaN = not measured. At least one of them.
        sigma_rows, sigma_columns: (H, W) float32 px. Without them both axes weigh alike, and sigma_z is NaN.
        every: triangulate each line's and column's every-th pixel only; the result is as much smaller.

    Raises:
        CalibrationError: maps of another size than the calibration's camera, or an axis that measures no depth here.
    """
    given = [(m, axis) for m, axis in ((rows, "y"), (columns, "x")) if m is not None]
    if not given:
        raise ValueError("triangulate needs rows, columns or both")
    width, height = calibration.camera.size
    shape = given[0][0].shape
    if any(m is not None and m.shape != (height, width) for m in (rows, columns, sigma_rows, sigma_columns)):
        raise CalibrationError(
            f"calibration {calibration.id or '(no id)'} is of a camera of {width} x {height} pixels, "
            f"the frames have {shape[1]} x {shape[0]}",
            hint="use the calibration of this camera at this size and region, or calibrate again",
        )
    if len(given) == 1:
        require_depth_axis(calibration, given[0][1])
    rays = _every(camera_rays(calibration.camera), every)
    xyz = np.empty((*rays[0].shape, 3), np.float32)
    sigma_z = np.empty(rays[0].shape, np.float32)
    sampled = (m if m is None else m[::every, ::every] for m in (rows, columns, sigma_rows, sigma_columns))
    row, column, sigma_row, sigma_column = map(_or_empty, sampled)
    if columns is None:
        impossible = along_rows(*rays, row, sigma_row, _projector_numbers(calibration), xyz, sigma_z)
    elif rows is None and calibration.projector.matrix[0, 1] == 0:
        impossible = along_rows(*rays, column, sigma_column, _transposed(calibration), xyz, sigma_z)
    else:
        row = np.full_like(column, np.nan) if rows is None else row
        numbers = _projector_numbers(calibration)
        impossible = along_both(*rays, row, column, sigma_row, sigma_column, numbers, xyz, sigma_z)
    return Triangulated(xyz, sigma_z, int(impossible))


def require_depth_axis(calibration: Calibration, axis: str) -> None:
    """Check that projecting along `axis` measures depth on this rig.

    Raises:
        CalibrationError: it does not; the message says which axis does.
    """
    share = _known_share(calibration)
    if share[axis] >= MIN_DEPTH_SHARE:
        return
    better = "x" if axis == "y" else "y"
    words = {"y": "rows (axis y)", "x": "columns (axis x)"}
    raise CalibrationError(
        f"projector {words[axis]} measure no depth on rig {calibration.id or '(no id)'}: "
        f"only {share[axis]:.0%} of the image's motion with depth lies along them",
        hint=f"project along axis {better}: the projector stands "
        f"{'beside' if better == 'x' else 'above or below'} the camera",
    )


def depth_share(calibration: Calibration) -> dict[str, float]:
    """Share (0..1) of the projector image's motion with depth that lies along each axis.

    Median over a grid of camera rays and depths of 2 to 16 baselines, the range in which triangulation works. Points
    behind the projector do not count.
    """
    width, height = calibration.camera.size
    x, y = np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 9))
    rays = calibration.camera.normalised(np.stack((x, y), -1)).reshape(-1, 2)
    rays = np.column_stack((rays, np.ones(len(rays))))
    baseline = float(np.linalg.norm(calibration.projector_centre))
    depths = baseline * 2.0 ** np.arange(1, 5)
    near, far = (
        calibration.to_projector(rays[None] * (depths * step)[:, None, None]).reshape(-1, 3) for step in (1.0, 1.001)
    )
    seen = (near[:, 2] > 0) & (far[:, 2] > 0)
    if not seen.any():
        raise CalibrationError(
            f"rig {calibration.id or '(no id)'}: nothing the camera sees lies before the projector",
            hint="check rotation and translation: X_projector = rotation @ X_camera + translation",
        )
    moved = np.abs(calibration.projector.project(far[seen]) - calibration.projector.project(near[seen]))
    share = np.median(moved / np.maximum(np.linalg.norm(moved, axis=-1, keepdims=True), 1e-12), axis=0)
    return {"x": float(share[0]), "y": float(share[1])}


def camera_rays(lens: Lens) -> tuple[Array, Array]:
    """x / z and y / z of every pixel's ray: two (H, W) float64 arrays, read-only, kept for the lens's next use."""
    return _rays(lens.size, tuple(lens.matrix.ravel()), tuple(lens.distortion.ravel()))


def warm_up() -> None:
    """Compile the kernels."""
    empty, one = np.empty((0, 0), np.float32), np.zeros((2, 2), np.float32)
    lens = Lens((2, 2), np.eye(3), np.full(5, 1e-3))
    numbers = _projector_numbers(Calibration(lens, lens, np.eye(3), np.array([1.0, 1.0, 0.0])))
    xyz = np.empty((2, 2, 3), np.float32)
    along_rows(*camera_rays(lens), one, empty, numbers, xyz, one.copy())
    along_both(*camera_rays(lens), one, one, empty, empty, numbers, xyz, one.copy())


@lru_cache(maxsize=4)
def _known_share(calibration: Calibration) -> dict[str, float]:
    """`depth_share`, kept: frames of a series ask again and again."""
    return depth_share(calibration)


@lru_cache(maxsize=4)
def _rays(size: tuple[int, int], matrix: tuple[float, ...], distortion: tuple[float, ...]) -> tuple[Array, Array]:
    lens = Lens(size, np.reshape(matrix, (3, 3)), np.array(distortion))
    rays = lens.normalised(lens.pixel_grid())
    x, y = np.ascontiguousarray(rays[..., 0]), np.ascontiguousarray(rays[..., 1])
    x.flags.writeable = y.flags.writeable = False
    return x, y


def _every(rays: tuple[Array, Array], every: int) -> tuple[Array, Array]:
    if every == 1:
        return rays
    x, y = (np.ascontiguousarray(ray[::every, ::every]) for ray in rays)
    x.flags.writeable = y.flags.writeable = False  # as all rays are: the kernels are compiled for these
    return x, y


def _or_empty(values: Map | None) -> Map:
    return np.empty((0, 0), np.float32) if values is None else np.ascontiguousarray(values, dtype=np.float32)


def _projector_numbers(calibration: Calibration) -> Numbers:
    m = calibration.projector.matrix
    inner = (m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2])
    numbers = (*calibration.rotation.ravel(), *calibration.translation, *inner, *calibration.projector.distortion)
    return tuple(float(n) for n in numbers)


def _transposed(calibration: Calibration) -> Numbers:
    """`_projector_numbers` of the projector with x and y exchanged: its rows are the columns of this one. No skew."""
    r, t, m = calibration.rotation, calibration.translation, calibration.projector.matrix
    k1, k2, p1, p2, k3 = calibration.projector.distortion
    numbers = (*r[[1, 0, 2]].ravel(), t[1], t[0], t[2], m[1, 1], 0.0, m[1, 2], m[0, 0], m[0, 2], k1, k2, p2, p1, k3)
    return tuple(float(n) for n in numbers)
