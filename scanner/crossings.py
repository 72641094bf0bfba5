"""Where a projected row crosses the stripes: the other projector coordinate of each camera ray on a calibrated rig.

A row (or column) and a camera ray are a point; the projector sees that point at one coordinate along the row, too, and
there every carrier of a Modified Composite Pattern has one phase. Nothing here looks at an image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from scanner.geometry import Array, Calibration
from scanner.patterns import Axis, McpPattern, ProjectorSize
from scanner.triangulation import MIN_DEPTH_SHARE, depth_share, triangulate

GRID_PX = 32
"""Distance of the camera pixels at which crossings are computed. Between them they are taken for straight: they are
images of planes, which bend by some thousandths of a projector pixel over that distance."""


@dataclass(frozen=True, eq=False)
class Crossings:
    """Where the middle of each of S stripes would be crossed, if it were seen at a pixel of the upright image.

    along: (J, I, S) float32, projector px along the stripes, at pixels GRID_PX apart; NaN where ray and stripe meet
    nowhere before both lenses. across: what is projected has coordinates of -0.5 .. across - 0.5. sense: 1 where they
    grow along the image's rows, else -1.
    """

    along: NDArray[np.float32]
    across: int
    sense: int


def along_stripe(calibration: Calibration, axis: Axis, values: NDArray[np.float32]) -> Array:
    """Projector coordinate across the measured one, by way of each pixel's depth.

    Args:
        calibration: the rig.
        axis: "y": `values` are projector rows, the result columns; "x" the other way round.
        values: (H, W) float32 px, NaN where there is none.

    Returns:
        (H, W) float64 px; NaN where there is no value or no point.
    """
    xyz = triangulate(calibration, rows=values if axis == "y" else None, columns=None if axis == "y" else values).xyz
    seen = calibration.projector.project(calibration.to_projector(xyz))
    found: Array = seen[..., 0 if axis == "y" else 1]
    return found


@lru_cache(maxsize=4)
def crossings_of(calibration: Calibration, pattern: McpPattern, projector: ProjectorSize) -> Crossings | None:
    """The table of one rig and pattern, kept: frames of a series ask for it again and again.

    None where the rig measures no depth along the pattern's axis.
    """
    if depth_share(calibration)[pattern.axis] < MIN_DEPTH_SHARE:
        return None
    camera = calibration.camera
    width, height = (-(-side // GRID_PX) + 1 for side in camera.size)
    # A camera of few pixels, each GRID_PX apart in the one of the rig.
    matrix = np.diag((1 / GRID_PX, 1 / GRID_PX, 1.0)) @ camera.matrix
    coarse = replace(calibration, camera=replace(camera, size=(width, height), matrix=matrix))
    pitch = pattern.pitch_px(projector)
    middles = (np.arange(pattern.stripe_count) + 0.5) * pitch - 0.5
    maps = [along_stripe(coarse, pattern.axis, np.full((height, width), row, np.float32)) for row in middles]
    along = np.stack(maps, axis=-1).astype(np.float32)
    across = projector.along("x" if pattern.axis == "y" else "y")
    along = along if pattern.axis == "y" else np.ascontiguousarray(along.transpose(1, 0, 2))
    grows = np.diff(along, axis=1)
    sense = 1 if not np.isfinite(grows).any() or np.nanmedian(grows) > 0 else -1
    return Crossings(along, across, sense)


def turned_over(crossings: Crossings, height: int) -> Crossings:
    """The same for an image of `height` rows upside down."""
    rows = (height - 1) / GRID_PX - np.arange(len(crossings.along))
    low = np.clip(np.floor(rows), 0, len(rows) - 2).astype(int)
    t = (rows - low).astype(np.float32)[:, None, None]
    turned = crossings.along[low] * (1 - t) + crossings.along[low + 1] * t
    return replace(crossings, along=np.ascontiguousarray(turned))
