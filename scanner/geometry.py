"""Pinhole cameras and projectors with distortion, and the calibration file that holds a rig's pair of them.

A projector is an inverse camera: the same model, its image being what it shows. Image coordinates are OpenCV's:
the centre of the top-left pixel is (0, 0). Lengths in mm. X_projector = rotation @ X_camera + translation.
Distortion is Brown's (1966) with OpenCV's order k1, k2, p1, p2, k3. Triangulation is in `scanner.triangulation`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.bounded_files import read_small_json
from scanner.calibration_id import content_id, id_warnings
from scanner.covariance import read_covariance, taken_as_exact
from scanner.credible import (
    check_hall,
    check_response,
    check_slope,
    lens_warnings,
    pixel_warnings,
    response_warnings,
    rig_warnings,
)
from scanner.errors import CalibrationError
from scanner.kernel import kernel

Array = NDArray[np.float64]

FORMAT = "fringed-calibration"
VERSION = 1
_MAKE = "take a file as fringed calibrate run or solve writes it"


@dataclass(frozen=True, eq=False)
class Lens:
    """One side of the rig: size (width, height) px, matrix (3, 3), distortion (5,)."""

    size: tuple[int, int]
    matrix: Array
    distortion: Array

    def normalised(self, points: NDArray[Any]) -> Array:
        """Pixel coordinates to undistorted directions.

        Args:
            points: (..., 2) x, y in px.

        Returns:
            (..., 2) float64: x / z, y / z of the ray, distortion removed by Newton's method to 1e-12; NaN where the
            distortion has no inverse (beyond the fold of a strong negative k).
        """
        flat = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        m = self.matrix
        y = (flat[:, 1] - m[1, 2]) / m[1, 1]
        x = (flat[:, 0] - m[0, 2] - m[0, 1] * y) / m[0, 0]
        if self.distortion.any():
            _undistort(x, y, tuple(float(k) for k in self.distortion))
        return np.stack((x, y), axis=-1).reshape(np.shape(points))

    def project(self, points: NDArray[Any]) -> Array:
        """Points in this lens's own frame to its pixels.

        Args:
            points: (..., 3) mm, z > 0.

        Returns:
            (..., 2) float64 px, distortion applied.
        """
        p = np.asarray(points, dtype=np.float64)
        x, y = p[..., 0] / p[..., 2], p[..., 1] / p[..., 2]
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        m = self.matrix
        return np.stack((m[0, 0] * xd + m[0, 1] * yd + m[0, 2], m[1, 1] * yd + m[1, 2]), axis=-1)

    def pixel_grid(self) -> Array:
        """(H, W, 2) float64: x, y of every pixel's centre."""
        width, height = self.size
        x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        return np.stack((x, y), axis=-1)


@dataclass(frozen=True, eq=False)
class Calibration:
    """What is known of a rig's geometry (formats.md, Calibration). `extra` keeps the optional members as read."""

    camera: Lens
    projector: Lens
    rotation: Array
    """(3, 3)"""
    translation: Array
    """(3,) mm"""
    id: str = ""
    extra: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    """what is odd about its file, in words for reports"""

    def to_projector(self, points: NDArray[Any]) -> Array:
        """(..., 3) mm in the camera's frame to (..., 3) mm in the projector's."""
        return np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation

    @property
    def projector_centre(self) -> Array:
        """(3,) mm: the projector's centre of projection in the camera's frame."""
        centre: Array = -self.rotation.T @ self.translation
        return centre

    @property
    def phase_axis(self) -> str:
        """ "y" where the baseline runs along the projector's rows' direction, else "x": the axis that measures depth.

        The projected coordinate has to change with depth: along a camera ray the projector's image point moves
        along an epipolar line, and the axis it moves along more is the one to project.
        """
        w, h = self.camera.size
        ray = np.append(self.camera.normalised(np.array([(w - 1) / 2, (h - 1) / 2])), 1.0)
        depth = max(float(np.linalg.norm(self.projector_centre)) * 4.0, 1.0)
        near, far = (self.projector.project(self.to_projector(ray * z)) for z in (depth, depth * 1.05))
        moved = np.abs(far - near)
        return "y" if moved[1] >= moved[0] else "x"

    @property
    def camera_scale(self) -> tuple[float, float]:
        """Camera pixels per projector pixel along the projector's x and y, in the image's middle, where axes meet.

        On a plane that faces the camera at the depth where the two optical axes come nearest; parallel or diverging
        axes count as four baselines away.
        """
        middle = np.array([(n - 1) / 2 for n in self.camera.size])
        towards = self.rotation.T @ np.array([0.0, 0.0, 1.0])
        ahead = np.array([0.0, 0.0, 1.0])
        # The point of the camera's axis that is nearest to the projector's: both lines, least squares.
        lines = np.stack((ahead, -towards), axis=1)
        depth = float(np.linalg.lstsq(lines, self.projector_centre, rcond=None)[0][0])
        if not 0 < depth < 1e3 * max(1.0, float(np.linalg.norm(self.projector_centre))):
            depth = max(float(np.linalg.norm(self.projector_centre)) * 4.0, 1.0)
        around = middle + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        rays = self.camera.normalised(around)
        points = np.concatenate((rays, np.ones((3, 1))), axis=1) * depth
        seen = self.projector.project(self.to_projector(points))
        step_x, step_y = seen[1] - seen[0], seen[2] - seen[0]
        return 1 / float(np.hypot(step_x[0], step_y[0])), 1 / float(np.hypot(step_x[1], step_y[1]))

    def as_dict(self) -> dict[str, Any]:
        """The calibration as formats.md writes it."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "id": self.id,
            "units": "mm",
            **self.extra,
            "camera": _lens_dict(self.camera),
            "projector": _lens_dict(self.projector),
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
        }


def load_calibration(path: Path) -> Calibration:
    """Read a calibration file.

    Raises:
        CalibrationError: unreadable, of another format or version, or not a geometry (NaN, singular, mirrored).
    """
    try:
        content = read_small_json(path)
        odd = id_warnings(content, path.name) if isinstance(content, dict) else []
    except OSError as error:
        raise CalibrationError(f"cannot read calibration {path}: {error.strerror}", hint=_MAKE) from error
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path} cannot be read as JSON: {error}", hint=_MAKE) from error
    found = calibration_from_dict(content, name=str(path))
    # Errors say where the file is; warnings go into reports, which are read elsewhere.
    return replace(found, warnings=(*(said.replace(str(path), path.name) for said in found.warnings), *odd))


def calibration_from_dict(content: Any, name: str = "calibration") -> Calibration:
    """Check and take a calibration given as plain data; `name` is used in messages.

    Raises:
        CalibrationError: see `load_calibration`.
    """
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CalibrationError(f"{name}: not a {FORMAT} file", hint='its "format" member says what a file is')
    version = content.get("version")
    if version != VERSION or version is True:
        raise CalibrationError(
            f"{name}: version {version!r} of {FORMAT}, this program reads version {VERSION}",
            hint="update fringed, or write the file again with this one",
        )
    if content.get("units", "mm") != "mm":
        raise CalibrationError(f"{name}: units are {content['units']!r:.80}, lengths must be in mm")
    identity = content.get("id")
    if identity is not None and not isinstance(identity, str):
        raise CalibrationError(f"{name}: id is {identity!r:.80}, it must be text", hint="leave it out, or quote it")
    _check_optional(content, name)
    camera, projector = (_lens(content.get(side), f"{name}: {side}") for side in ("camera", "projector"))
    odd = [*lens_warnings(camera, f"{name}: camera"), *lens_warnings(projector, f"{name}: projector")]
    odd += pixel_warnings(camera, f"{name}: camera")
    rotation = _matrix(content.get("rotation"), (3, 3), f"{name}: rotation")
    translation = _matrix(content.get("translation"), (3,), f"{name}: translation")
    _require_rotation(rotation, f"{name}: rotation")
    if np.linalg.norm(translation) < 1e-9:
        raise CalibrationError(
            f"{name}: translation is zero: projector and camera cannot stand at the same place",
            hint="a file from before the rig was calibrated? fringed calibrate run or solve makes one",
        )
    known = {"format", "version", "id", "camera", "projector", "rotation", "translation"}
    extra = {key: value for key, value in content.items() if key not in known}
    # What has no name is named by what it says: a scan can always tell what it rests on.
    rig = Calibration(camera, projector, rotation, translation, id=identity or content_id(content), extra=extra)
    odd += [*rig_warnings(rig, name), *_covariance_warnings(content, name)]
    odd += response_warnings(content.get("response"), name)
    return replace(rig, warnings=tuple(odd))


def warm_up() -> None:
    """Compile the kernels."""
    _undistort(np.zeros(2), np.zeros(2), (1e-3, 0.0, 0.0, 0.0, 0.0))


@kernel
def _distortion_step(x: float, y: float, xt: float, yt: float, k: tuple[float, ...]) -> tuple[float, float, float]:
    """Newton's step in x and y towards the point that distortion moves to (xt, yt), and the Jacobian's determinant."""
    k1, k2, p1, p2, k3 = k
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    ex = xt - (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x))
    ey = yt - (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y)
    xx = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    yy = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    xy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    determinant = xx * yy - xy * xy
    return (yy * ex - xy * ey) / determinant, (xx * ey - xy * ex) / determinant, determinant


@kernel
def _undistort(x: Array, y: Array, k: tuple[float, ...]) -> None:
    """Remove distortion k1, k2, p1, p2, k3 from normalised coordinates x, y (N,), in place.

    Three steps for all points without a branch, so that they become vector instructions; then the few that need more.
    """
    block = 512
    xs, ys, last = np.empty(block), np.empty(block), np.empty(block)
    for first in range(0, x.size, block):
        n = min(block, x.size - first)
        xt, yt = x[first : first + n], y[first : first + n]
        for i in range(n):
            u, v = xt[i], yt[i]
            for _ in range(3):
                du, dv, determinant = _distortion_step(u, v, xt[i], yt[i], k)
                u, v = u + du, v + dv
            xs[i], ys[i] = u, v
            near_side = determinant > 0.0 and u * xt[i] + v * yt[i] >= 0.0
            last[i] = du * du + dv * dv if near_side else np.inf
        for i in range(n):
            if last[i] < 1e-14:  # quadratic convergence: what is left is the last step's square, at most 1e-14
                xt[i], yt[i] = xs[i], ys[i]
            else:
                xt[i], yt[i] = _distortion_undone(xt[i], yt[i], k)


@kernel
def _distortion_undone(xt: float, yt: float, k: tuple[float, ...]) -> tuple[float, float]:
    """As many of Newton's steps as it takes, 50 at most; NaN if they do not end, or end beyond the fold."""
    x, y = xt, yt
    for _ in range(50):
        dx, dy, determinant = _distortion_step(x, y, xt, yt, k)
        x, y = x + dx, y + dy
        if math.hypot(dx, dy) < 1e-12 and determinant > 0.0 and x * xt + y * yt >= 0.0:
            return x, y  # across the centre lies another solution of a strong negative k: no light comes from there
    return np.nan, np.nan


def _lens_dict(lens: Lens) -> dict[str, Any]:
    return {"size": list(lens.size), "matrix": lens.matrix.tolist(), "distortion": lens.distortion.tolist()}


def _lens(content: Any, name: str) -> Lens:
    if not isinstance(content, dict):
        raise CalibrationError(f"{name} is missing", hint=_MAKE)
    size = content.get("size")
    if not (isinstance(size, list) and len(size) == 2 and all(type(n) is int and n > 0 for n in size)):
        raise CalibrationError(f"{name}.size must be [width, height] in pixels, got {size!r:.80}")
    matrix = _matrix(content.get("matrix"), (3, 3), f"{name}.matrix")
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0 or abs(np.linalg.det(matrix)) < 1e-9:
        raise CalibrationError(
            f"{name}.matrix is singular or has a focal length that is not positive",
            hint=f"[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels; {_MAKE}",
        )
    if np.abs(matrix[1, 0]) > 0 or np.abs(matrix[2] - (0, 0, 1)).max() > 0:
        raise CalibrationError(
            f"{name}.matrix must be upper triangular with last row 0 0 1",
            hint="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels; was it written by columns?",
        )
    distortion = _matrix(content.get("distortion", [0.0] * 5), (5,), f"{name}.distortion")
    return Lens((size[0], size[1]), matrix, distortion)


def _covariance_warnings(content: Mapping[str, Any], name: str) -> list[str]:
    """A calibration without its covariance measures as well: what is missing is what it says of its own error."""
    try:
        found = read_covariance(content.get("covariance"))
    except ValueError as error:
        return [
            f"{name}: covariance cannot be read: {error}. What the calibration adds to the uncertainty of scans is "
            "not known and missing from their budgets"
        ]
    missing = [] if found is None else taken_as_exact(found)
    if missing:
        return [f"{name}: covariance says nothing of {', '.join(missing)}: scans' budgets take these as exact"]
    return []


def _check_optional(content: Mapping[str, Any], name: str) -> None:
    """Raise CalibrationError where an optional member that this program may use is there and malformed."""
    _check_parts(content, "hall", {"camera": (3, 4), "projector": (3, 4)}, check_hall, name)
    _check_parts(content, "world", {"rotation": (3, 3)}, _require_rotation, name)
    _check_parts(content, "world", {"translation": (3,)}, None, name)
    phase = content.get("mcp_phase")
    if phase is not None:
        if not isinstance(phase, dict):
            raise CalibrationError(f"{name}: mcp_phase must be null or an object, got {phase!r:.80}")
        for part in ("slope", "intercept"):
            _matrix(phase.get(part), (), f"{name}: mcp_phase.{part}")
        check_slope(float(phase["slope"]), f"{name}: mcp_phase.slope")
    response = content.get("response")
    if response is not None and not (
        isinstance(response, dict) and all(side is None or isinstance(side, dict) for side in response.values())
    ):
        raise CalibrationError(f"{name}: response must be null or an object of sides, got {response!r:.80}")
    if response is not None:
        check_response(response, name)
    residuals = content.get("residuals")
    if residuals is not None and not isinstance(residuals, dict):
        raise CalibrationError(f"{name}: residuals must be null or an object, got {residuals!r:.80}")
    if residuals is not None and residuals.get("epipolar_px") is not None:
        _matrix(residuals["epipolar_px"], (), f"{name}: residuals.epipolar_px")


def _check_parts(
    content: Mapping[str, Any],
    key: str,
    shapes: Mapping[str, tuple[int, ...]],
    check: Callable[[Array, str], None] | None,
    name: str,
) -> None:
    """The same of one member that is null or an object of arrays."""
    member = content.get(key)
    if member is None:
        return
    if not isinstance(member, dict):
        raise CalibrationError(f"{name}: {key} must be null or an object, got {member!r:.80}")
    for part, shape in shapes.items():
        numbers = _matrix(member.get(part), shape, f"{name}: {key}.{part}")
        if check is not None:
            check(numbers, f"{name}: {key}.{part}")


def _all_numbers(content: Any) -> bool:
    """Whether nothing in nested lists is text or true, which NumPy would take for numbers."""
    if isinstance(content, list | tuple):
        return all(_all_numbers(part) for part in content)
    return not isinstance(content, bool | str)


def _require_rotation(matrix: Array, name: str) -> None:
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-4 or np.linalg.det(matrix) < 0:
        raise CalibrationError(
            f"{name} is not a rotation (orthonormal, determinant +1): its determinant is {np.linalg.det(matrix):.4g}",
            hint="nine numbers, unrounded; where a picture is mirrored, mirror it in the rig file",
        )


def _matrix(content: Any, shape: tuple[int, ...], name: str) -> Array:
    if content is None:
        raise CalibrationError(f"{name} is missing", hint=_MAKE)
    if not _all_numbers(content):
        raise CalibrationError(f"{name} is not an array of numbers", hint="numbers without quotes")
    try:
        array = np.asarray(content, dtype=np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise CalibrationError(f"{name} is not an array of numbers", hint=_MAKE) from error
    if array.shape != shape:
        raise CalibrationError(f"{name} has shape {array.shape}, expected {shape}", hint=_MAKE)
    if not np.isfinite(array).all():
        raise CalibrationError(f"{name} contains NaN or infinity", hint=f"a calibration that failed: {_MAKE}")
    return array
