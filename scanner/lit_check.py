"""Do points lie where the projector of this rig can light? A check on a whole scan, not on points.

One coordinate and the camera's pixel give a point, and the point the coordinate along the projector's other axis, which
nobody measured: what the projector lit lies within its picture there too. An image upside down, or shifted across the
lines, is of another surface that may run the right way and at an ordinary pace (`scanner.orientation`,
`scanner.scale_check`): on a rig whose baseline runs diagonally nothing else tells. It is found where the projector's
light ends within the scene; where it lights more than the camera sees, or less than half of it, nothing is.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.calibration_spread import across_spread
from scanner.errors import DecodeError
from scanner.geometry import Array, Calibration
from scanner.patterns.description import Axis
from scanner.triangulation import triangulate

MOST_SAMPLES = 4000

LEAST_OUTSIDE = 12
"""Samples: what stray light makes lies in patches, of four samples at most so far."""

MOST_OUTSIDE = 0.01
"""Share of the samples. Sound scans have none, of all fringes and codes; those of one MCP frame .02 %, and .2 % once,
of a strongly textured scene."""

EDGE_PX = 5.0
"""Blur, a coordinate's noise on a slanting epipolar line and a lens model's own misfit at the picture's edge: sound
scans of fringes stay within 2 px, those of one frame's stripes within 4 but for strays."""

SIGMAS = 3.0
"""Of what the calibration's covariance leaves; added to EDGE_PX"""

TURNED_DEG = 0.5
"""A rig knocked by as much has its points outside too: up to there it is a warning: its scan is bent, not another."""

POINTS = 49
"""Of those outside, asked for what the calibration leaves"""


@dataclass(frozen=True)
class Outside:
    """Samples that the projector cannot have lit."""

    share: float
    """of all samples, beyond `bound_px`"""
    bound_px: float
    """projector px outside its picture"""
    far_share: float
    """those beyond what a knock of TURNED_DEG could do"""
    samples: int

    def as_dict(self) -> dict[str, float]:
        """For report.json."""
        return asdict(self)


def require_lit(
    calibration: Calibration, values: NDArray[np.float32], sigma: NDArray[np.float32] | None, axis: Axis
) -> tuple[Outside, str | None]:
    """Check one decoded map, of the axis that measures depth.

    Args:
        values: (H, W) float32 projector rows (axis "y") or columns (axis "x"), px, NaN where there is none.
        sigma: (H, W) float32 px, or None.

    Returns:
        What was found, and a warning if too much lies outside for a sound rig.

    Raises:
        DecodeError: too much lies farther outside than a knocked rig would put it.
    """
    found = outside(calibration, values, sigma, axis)
    if not _too_many(found.share, found.samples):
        return found, None
    said = (
        f"{found.share:.1%} of the points lie where the projector of rig {calibration.id or '(no id)'} cannot light, "
        f"more than {found.bound_px:.0f} px outside its picture"
    )
    if not _too_many(found.far_share, found.samples):
        return found, f"{said}: an image that is shifted or upside down, or a calibration of another rig, or a knock"
    raise DecodeError(
        f"{said}: the calibration contradicts the frames",
        hint="check that no image is upside down, mirrored or shifted, that the projector's size and the pattern's "
        "order are the description's, and that the calibration is this rig's and nobody has moved it since",
    )


def outside(
    calibration: Calibration, values: NDArray[np.float32], sigma: NDArray[np.float32] | None, axis: Axis
) -> Outside:
    """See `require_lit`; raises nothing."""
    every = max(1, math.ceil(math.sqrt(values.size / MOST_SAMPLES)))
    if axis == "y":
        xyz = triangulate(calibration, rows=values, sigma_rows=sigma, every=every).xyz
    else:
        xyz = triangulate(calibration, columns=values, sigma_columns=sigma, every=every).xyz
    at = np.argwhere(np.isfinite(xyz[..., 2]))
    points = xyz[at[:, 0], at[:, 1]].astype(np.float64)
    beyond = _px_outside(calibration, points)
    bound = EDGE_PX
    far = np.flatnonzero(beyond > bound)
    if _too_many(far.size / max(len(at), 1), len(at)):
        some = far[np.linspace(0, far.size - 1, min(POINTS, far.size)).astype(np.intp)]
        left = across_spread(calibration, at[some, ::-1].astype(np.float64) * every, points[some, 2], axis)
        bound += 0.0 if left is None else SIGMAS * float(np.median(left))
    lens = calibration.projector.matrix
    knock = bound + math.radians(TURNED_DEG) * float(max(lens[0, 0], lens[1, 1]))
    share, far_share = (float(np.count_nonzero(beyond > px)) / max(len(at), 1) for px in (bound, knock))
    return Outside(share, bound, far_share, len(at))


def _too_many(share: float, samples: int) -> bool:
    return share > MOST_OUTSIDE and share * samples >= LEAST_OUTSIDE


def _px_outside(calibration: Calibration, points: Array) -> Array:
    """(n,) px by which the projector would see points outside its picture; negative within."""
    seen = calibration.projector.project(calibration.to_projector(points))
    last = np.array(calibration.projector.size) - 0.5
    found: Array = np.maximum(-0.5 - seen, seen - last).max(axis=-1)
    return found
