"""Scenes and devices that drift while frames are taken: fringes that lie farther on from frame to frame.

Sets are captured one after the other, and fringes are counted by what their phases differ by. A drift of a hundredth of
a fringe a frame is no more than noise within a set; between the sets of a long sequence it is what a rung's fringes are
counted by. It is told by sets of five shifts and more, each of which must drift by as much.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.decode.pmp_frames import AxisFrames, design_matrix
from scanner.decode.sample_kernels import MIN_PIXELS
from scanner.decode.unwrapping import Ladder
from scanner.patterns import PmpPattern

FEWEST_SHIFTS = 5
"""Of four, the one residual is a drift of one frame as well as any other change."""

MOST_APART = 0.2
"""Of the drift, by which sets may differ in it"""

MOST_LEFT = 0.25
"""Of a fringe, that a drift may leave of a step: the other half of the way to the next fringe is noise's."""


def drift_of(pattern: PmpPattern, frames: AxisFrames, at: NDArray[np.intp]) -> float | None:
    """Shares of the projector by which the scene lies farther on from frame to frame; None where sets do not agree.

    Args:
        at: (p,) pixels of a sample with light in them.
    """
    if at.size < MIN_PIXELS:
        return None
    found = [
        _radians(pattern, frames, at, k) / (2 * np.pi * frequency)
        for k, frequency in enumerate(pattern.frequencies)
        if frames.shifts[k] >= FEWEST_SHIFTS
    ]
    if len(found) < 2 or np.ptp(found) > MOST_APART * abs(float(np.mean(found))):
        return None
    return float(np.mean(found))


def miscounts(ladder: Ladder, frequencies: Sequence[float], shifts: Sequence[int], drift: float) -> bool:
    """Whether a drift makes a rung count fringes wrong, or nearly so.

    Args:
        drift: shares of the projector a frame.
    """
    middles = np.cumsum(shifts) - np.asarray(shifts) / 2
    left, fringes = ladder.climb(np.asarray(frequencies) * drift * (middles - middles[-1]))
    return bool(np.abs(left).max(initial=0.0) > MOST_LEFT or fringes)


def moved(axis: str, px: float) -> str:
    """What a user should know. px: of the projector, a frame."""
    return (
        f"along {axis} the scene lies {abs(px):.2g} projector px farther on from frame to frame, and its fringes are "
        "counted by frequencies that were captured one after the other: keep scene, camera and projector still, and "
        "scan again"
    )


def _radians(pattern: PmpPattern, frames: AxisFrames, at: NDArray[np.intp], k: int) -> float:
    """By which a set's fringe lies farther on from frame to frame."""
    first, count = int(frames.starts[k]), frames.shifts[k]
    seen = np.stack([frames.frames[first + n].reshape(-1)[at] for n in range(count)]).astype(np.float64)
    design = design_matrix(pattern, count, range(count))
    fit = np.linalg.pinv(design)
    _, cosine, sine = fit @ seen
    # What samples change by with the phase: -B sin(theta + alpha).
    across = -design[:, 1:2] * sine + design[:, 2:] * cosine
    steady = (np.arange(count) - (count - 1) / 2)[:, None] * across
    steady -= design @ (fit @ steady)
    return float(np.vdot(steady, seen)) / max(float(np.vdot(steady, steady)), 1e-9)
