"""Do decoded rows or columns run the way the rig's geometry says they must? A check on whole maps, not on pixels.

On a surface that camera and projector see from the same side, walking along the projected lines' direction in the
camera's image walks the same way in the projector's (the ordering constraint: Yuille and Poggio 1984; Hartley and
Zisserman 2004, sec. 9.1). A pattern description with the wrong sign, a mirrored image, swapped or reversed frames and
a calibration of another rig turn nearly all of an image round; depth edges and noise turn a few pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError
from scanner.geometry import Array, Calibration

STEP = 8
"""Pixels between the two ends of a difference, and between samples: noise of a pixel's value turns none round."""

MIN_SAMPLES = 100
"""Fewer say nothing of the whole."""

MOST_REVERSED = 0.35
"""More than a third against the geometry is no noise: noise alone turns round half where it is all there is, and
sound scans stay below a hundredth or two; a code that is read as another one turns round half as well."""

NOTICEABLE = 0.1
"""Five times what silhouettes make of a sound scan"""


def require_orientation(calibration: Calibration, values: NDArray[np.float32], axis: str) -> str | None:
    """Check the direction of one decoded map.

    Args:
        values: (H, W) float32 projector rows (axis "y") or columns (axis "x"), px, NaN where there is none.

    Returns:
        A warning if a noticeable part runs the wrong way, else None.

    Raises:
        DecodeError: most of it does.
    """
    reversed_share = share_reversed(calibration, values, axis)
    if reversed_share is None or reversed_share < NOTICEABLE:
        return None
    name = "rows" if axis == "y" else "columns"
    said = f"{reversed_share:.0%} of the decoded {name} run against the geometry of rig {calibration.id or '(no id)'}"
    if reversed_share <= MOST_REVERSED:
        return f"{said}: wrong fringes or stripes, frames out of step, or a calibration of another rig"
    raise DecodeError(
        f"{said}: the pattern description or the calibration contradicts the frames",
        hint="check the description's sign and the order of its frames, that no image is mirrored or upside down, "
        "and that the calibration is this rig's",
    )


def share_reversed(calibration: Calibration, values: NDArray[np.float32], axis: str) -> float | None:
    """Share of the samples whose value falls where the geometry says it rises; None with too few to say.

    Args:
        values: see `require_orientation`.
    """
    start = values[:-STEP:STEP, :-STEP:STEP]
    along_x = values[:-STEP:STEP, STEP::STEP] - start
    along_y = values[STEP::STEP, :-STEP:STEP] - start
    expected = _expected_steps(calibration, start.shape, axis)
    agreement = along_x * expected[0] + along_y * expected[1]
    agreement = agreement[np.isfinite(agreement)]
    return float(np.mean(agreement < 0)) if agreement.size >= MIN_SAMPLES else None


def _expected_steps(calibration: Calibration, shape: tuple[int, ...], axis: str) -> tuple[Array, Array]:
    """How the projector coordinate changes over STEP pixels to the right and down, on a plane before the camera.

    Its sign is that of any plane that both see from the same side; four baselines away is where rigs work.
    """
    depth = max(4.0 * float(np.linalg.norm(calibration.projector_centre)), 1.0)
    member = 1 if axis == "y" else 0
    y, x = np.mgrid[: shape[0], : shape[1]] * float(STEP)

    def seen(at_x: Array, at_y: Array) -> Array:
        rays = calibration.camera.normalised(np.stack((at_x, at_y), -1))
        points = np.concatenate((rays, np.ones_like(rays[..., :1])), -1) * depth
        found: Array = calibration.projector.project(calibration.to_projector(points))[..., member]
        return found

    here = seen(x, y)
    return seen(x + STEP, y) - here, seen(x, y + STEP) - here
