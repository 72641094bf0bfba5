"""Can these numbers be a rig? What no camera and projector can be is refused, what only looks odd is a warning.

A calibration file may be well-formed and mean nothing: lengths in metres, a focal length in millimetres, a rotation
turned round. Points come out of it all the same, and nothing else would say so. Whether a calibration is a good one is
another question: `scanner.calibration.plausibility`, by the pictures it was made from.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scanner.errors import CalibrationError

if TYPE_CHECKING:
    from scanner.geometry import Calibration, Lens

LEAST_BASELINE_MM, ODD_BASELINE_MM = 1.0, 10.0
"""Between two devices: their lenses' own openings are some millimetres wide, and lie no nearer than that."""
MOST_BASELINE_MM, ODD_MOST_BASELINE_MM = 1e6, 1e4
"""A kilometre, and ten metres: no projector lights so far."""
MOST_FIELD_DEG, ODD_FIELD_DEG = 170.0, (1.0, 150.0)
"""Full angle of view across or down the picture. A pinhole image reaches 180 degrees at infinite width; flat lenses end
at 120. A focal length in millimetres in place of pixels makes 175 degrees and more."""
MOST_OFF_AXIS_DEG = 75.0
"""Of the picture's middle, seen from the lens. A lens shift of 130 % puts it at 30 degrees; a region cut from a
sensor's corner at 60 in a lens of 120."""
ODD_SHIFT = 1.5
"""Sizes of the picture by which the principal point may lie off its middle and still be a projector's shift"""
MOST_STRETCH, ODD_STRETCH = 10.0, 2.5
"""Focal length down over across, or the other way: mirrors set on edge make 2."""
PIXEL_SHAPES, ODD_PIXEL = (0.5, 1.0, 2.0), 1.15
"""A sensor's pixels are square, or joined in pairs; those of analogue cameras were up to 12 % longer than wide"""
MOST_DISTORTION = 2.5
"""Factor by which distortion may move the middle of an edge: a lens of 120 degrees moves it by half its radius"""
MOST_PX = 1 << 16
PARTING_DEG = 2.0
"""Between devices that were set up to look the same way, by eye"""
RAYS, DEPTHS = (9, 7), 400
"""Of the camera, asked for a point that the projector could light: over the picture, and from near to far in steps of
three per cent, less than two narrow beams have in common where they cross"""
DEPTH_RANGE = (0.2, 1e4)
"""Baselines"""
MARGIN = 0.25
"""Of the projector's picture: distortion is left out here, and moves edges by less"""

_UNITS = "lengths are in millimetres: if this file's are in {unit}, {mend} the translation{more} by 1000"


def lens_warnings(lens: Lens, name: str) -> list[str]:
    """What is odd about a camera or projector.

    Raises:
        CalibrationError: it can be none.
    """
    said = []
    if max(lens.size) > MOST_PX:
        given = f"{list(lens.size)}"
        raise CalibrationError(f"{name}.size {given:.80} is no picture's", hint="width and height in pixels")
    for n, focal, across in zip(lens.size, (lens.matrix[0, 0], lens.matrix[1, 1]), ("across", "down"), strict=True):
        field = 2 * math.degrees(math.atan(n / 2 / focal))
        words = f"{name}.matrix: a focal length of {focal:g} px is an angle of view of {field:.3g} degrees {across}"
        if field > MOST_FIELD_DEG:
            raise CalibrationError(words, hint="focal lengths are in pixels; one in mm is divided by the pixel's size")
        said += [] if ODD_FIELD_DEG[0] <= field <= ODD_FIELD_DEG[1] else [words]
    ratio = float(lens.matrix[1, 1] / lens.matrix[0, 0])
    stretch, words = (
        max(ratio, 1 / ratio),
        f"{name}.matrix: focal lengths differ {ratio:.3g} times between down and across",
    )
    if stretch > MOST_STRETCH:
        raise CalibrationError(words, hint="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], in pixels")
    said += [words] if stretch > ODD_STRETCH else []
    if abs(lens.matrix[0, 1]) > lens.matrix[0, 0] / 2:
        raise CalibrationError(f"{name}.matrix: a skew of {lens.matrix[0, 1]:g} px leans the picture's columns over")
    return said + _shift_warnings(lens, name) + _fold_warnings(lens, name)


def pixel_warnings(camera: Lens, name: str) -> list[str]:
    """What is odd about the shape of a camera's pixels; a projector's picture may be stretched by any factor."""
    ratio = float(camera.matrix[1, 1] / camera.matrix[0, 0])
    if min(max(ratio / shape, shape / ratio) for shape in PIXEL_SHAPES) <= ODD_PIXEL or ratio > ODD_STRETCH:
        return []
    return [
        f"{name}.matrix: focal lengths of {camera.matrix[0, 0]:g} px across and {camera.matrix[1, 1]:g} px down mean "
        "pixels that are not square, as nearly all cameras' are: was one of them changed, or the picture stretched?"
    ]


def rig_warnings(rig: Calibration, name: str) -> list[str]:
    """What is odd about where camera and projector stand.

    Raises:
        CalibrationError: nobody can measure from there.
    """
    baseline = float(np.linalg.norm(rig.translation))
    apart = f"{name}: camera and projector stand {baseline:g} mm apart"
    metres = _UNITS.format(unit="metres", mend="multiply", more="")
    if baseline < LEAST_BASELINE_MM:
        raise CalibrationError(f"{apart}: nothing can be triangulated from one place", hint=metres)
    micrometres = _UNITS.format(unit="micrometres", mend="divide", more="")
    if baseline > MOST_BASELINE_MM:
        raise CalibrationError(apart, hint=micrometres)
    depths = _common_depths(rig, baseline)
    if not depths.size:
        raise CalibrationError(
            f"{name}: no point before the camera, at any distance, is one that the projector could light",
            hint="X_projector = rotation @ X_camera + translation: is this the way back, or a rotation transposed?",
        )
    odd = metres if baseline < ODD_BASELINE_MM else micrometres if baseline > ODD_MOST_BASELINE_MM else None
    said = [] if odd is None else [f"{apart}, their common view begins at {depths.min():.3g} mm: {odd}"]
    return said + _parting_warnings(rig, name) + _epipole_warnings(rig, name)


def check_hall(side: NDArray[np.float64], where: str) -> None:
    """Raise CalibrationError where a 3 x 4 matrix projects no world: scaled otherwise than m34 = 1, or singular."""
    if abs(side[2, 3] - 1) > 1e-6:
        raise CalibrationError(
            f"{where}: its last number, m34, must be 1, got {side[2, 3]:g}",
            hint="divide all twelve by it; leave hall out, or null, where it is not known",
        )
    # Rows of pixels and of the scale differ by powers of ten.
    rows = side[:, :3] / np.maximum(np.linalg.norm(side[:, :3], axis=1, keepdims=True), 1e-300)
    if abs(np.linalg.det(rows)) < 1e-9:
        raise CalibrationError(
            f"{where} is singular: a whole direction of space would be seen at one pixel",
            hint="leave hall out, or null, where it is not known",
        )


def check_slope(slope: float, where: str) -> None:
    """Raise CalibrationError where MCP's stripes would all be one row, or run backwards."""
    if slope <= 0:
        raise CalibrationError(
            f"{where} must be above 0, projector px from stripe to stripe, got {slope:g}",
            hint="leave mcp_phase out, or null, where it was not fitted",
        )


def check_response(response: Mapping[str, Any], name: str) -> None:
    """Raise CalibrationError where a side's response is neither an exponent nor a rising table of 256."""
    for side, content in response.items():
        if content is None:
            continue
        where = f"{name}: response.{side}"
        gamma, table = content.get("gamma"), content.get("table")
        if gamma is not None and not (_is_number(gamma) and 0.1 <= gamma <= 10):
            raise CalibrationError(f"{where}.gamma must lie in 0.1 .. 10, got {gamma!r:.80}")
        if table is not None and not _is_rising(table):
            raise CalibrationError(f"{where}.table must be 256 rising values of light, 0 .. 1")


def response_warnings(response: Any, name: str) -> list[str]:
    """What of a response nothing is made of."""
    if not isinstance(response, dict) or not any((response.get("camera") or {}).values()):
        return []
    return [
        f"{name}: response.camera is not applied: frames are decoded as they are, and a camera that is not linear "
        "makes ripples. Set the camera's own gamma to 1, or make its images linear before they are decoded"
    ]


def _shift_warnings(lens: Lens, name: str) -> list[str]:
    middle = np.array([(n - 1) / 2 for n in lens.size])
    centre, focal = lens.matrix[:2, 2], np.array([lens.matrix[0, 0], lens.matrix[1, 1]])
    off = math.degrees(math.atan(float(np.linalg.norm((middle - centre) / focal))))
    words = f"{name}.matrix: the principal point ({centre[0]:g}, {centre[1]:g}) lies far outside the picture"
    if off > MOST_OFF_AXIS_DEG:
        raise CalibrationError(f"{words}: its middle would be seen {off:.0f} degrees off the lens's axis")
    return [words] if bool((np.abs(middle - centre) > ODD_SHIFT * np.array(lens.size)).any()) else []


def _fold_warnings(lens: Lens, name: str) -> list[str]:
    """A distortion may fold the picture and unfold it farther out: the whole way to its edges is looked at."""
    w, h = lens.size
    middles = np.array([(0, h / 2), (w - 1, h / 2), (w / 2, 0), (w / 2, h - 1)])
    corners = np.array([(0, 0), (w - 1, 0), (0, h - 1), (w - 1, h - 1)])
    # Compared with the same lens without distortion.
    seen, true = (middles - lens.matrix[:2, 2]) / (lens.matrix[0, 0], lens.matrix[1, 1]), lens.normalised(middles)
    moved = np.linalg.norm(true, axis=1) / np.maximum(np.linalg.norm(seen, axis=1), 1e-9)
    # Written so that NaN, beyond the fold, fails too.
    if not np.all((moved > 1 / MOST_DISTORTION) & (moved < MOST_DISTORTION)) or _folds(lens, middles):
        raise CalibrationError(
            f"{name}.distortion {lens.distortion.tolist()} folds the image before its edges, or moves them too far",
            hint="calibrate again with fewer radial terms, or with targets out to the image's edges",
        )
    if _folds(lens, corners):
        return [f"{name}.distortion folds the image in its corners: nothing is measured there"]
    return []


def _folds(lens: Lens, pixels: NDArray[Any]) -> bool:
    true = lens.normalised(pixels)
    if np.isnan(true).any():
        return True
    x, y = np.moveaxis(true[:, None] * np.linspace(0, 1, 65)[:, None], -1, 0)
    k1, k2, p1, p2, k3 = lens.distortion
    r2 = x * x + y * y
    radial, slope = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
    return bool((xx * yy - xy * xy <= 0).any())


def _common_depths(rig: Calibration, baseline: float) -> NDArray[np.float64]:
    """Depths of points on the camera's rays that lie before the projector and inside its picture, undistorted."""
    w, h = rig.camera.size
    x, y = np.meshgrid(np.linspace(0, w - 1, RAYS[0]), np.linspace(0, h - 1, RAYS[1]))
    m = rig.camera.matrix
    rays = np.stack(((x - m[0, 2]) / m[0, 0], (y - m[1, 2]) / m[1, 1], np.ones_like(x)), axis=-1).reshape(-1, 1, 3)
    depth = baseline * np.geomspace(*DEPTH_RANGE, DEPTHS)
    seen = rig.to_projector(rays * depth[:, None])
    m, size = rig.projector.matrix, np.array(rig.projector.size)
    before = seen[..., 2] > 1e-9 * baseline
    z = np.where(before, seen[..., 2], 1.0)[..., None]
    at = seen[..., :2] / z * (m[0, 0], m[1, 1]) + m[:2, 2]
    inside = ((at > -MARGIN * size) & (at < (1 + MARGIN) * size)).all(axis=-1)
    found: NDArray[np.float64] = np.broadcast_to(depth, before.shape)[before & inside]
    return found


def _parting_warnings(rig: Calibration, name: str) -> list[str]:
    """The rays through the middles of both pictures come nearest before camera and projector, or they part."""
    ahead, lit = (
        np.append(lens.normalised((np.array(lens.size) - 1) / 2), 1.0) for lens in (rig.camera, rig.projector)
    )
    ahead, lit = ahead / np.linalg.norm(ahead), rig.rotation.T @ lit / np.linalg.norm(lit)
    angle = math.degrees(math.acos(np.clip(ahead @ lit, -1, 1)))
    meet = np.linalg.lstsq(np.stack((ahead, -lit), axis=1), rig.projector_centre, rcond=None)[0]
    if angle < PARTING_DEG or (meet > 0).all():
        return []
    return [
        f"{name}: camera and projector look away from one another, by {angle:.1f} degrees: if they do not, rotation or "
        "translation is the way back (X_projector = rotation @ X_camera + translation)"
    ]


def _epipole_warnings(rig: Calibration, name: str) -> list[str]:
    centre = rig.projector_centre
    if abs(centre[2]) < 1e-6 * float(np.linalg.norm(centre)):
        return []
    at = rig.camera.matrix[:2] @ (centre / centre[2])
    if not bool(((at >= 0) & (at < np.array(rig.camera.size))).all()):
        return []
    stands = "in the camera's picture" if centre[2] > 0 else "straight behind the camera"
    return [f"{name}: the projector stands {stands}: around pixel ({at[0]:.0f}, {at[1]:.0f}) no depth can be measured"]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_rising(table: Any) -> bool:
    if not isinstance(table, Sequence) or len(table) != 256 or not all(_is_number(value) for value in table):
        return False
    # Written so that NaN fails.
    return all(low <= high for low, high in pairwise(table)) and 0 <= table[0] < table[-1] <= 1
