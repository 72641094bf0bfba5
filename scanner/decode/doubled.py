"""Frames of a fringe set that show what another one shows: a stale buffer, a flip that never came.

Told from a sample of one set's pixels. Whether a capture is in step is asked with more care, and before anything else,
by the sequencer's witnesses, which refuse it; this is for frames that come to a decoder without them. With three shifts
nothing is left to tell a doubled frame by unless it is the same to the last bit.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import pi, sin

import numpy as np
from numpy.typing import NDArray

from scanner.decode.middles import nth_of
from scanner.decode.noise import ROUNDING_VARIANCE, NoiseModel
from scanner.decode.pmp_frames import AxisFrames

LEAST_RESIDUAL = 0.3
"""Of what a doubled neighbour makes of the noise that residuals tell, from where on frames are looked at: more than
half of it may pass for overtones (.38 is left of eight shifts, .48 of sixteen). Of eight shifts that is noise of
B / 30, of sixteen of B / 84; usual scans have B / 60, and need no look by eight."""

ALIKE = 1 / 16
"""Of two frames: mean square of their difference over that which the set's fit has there. In frames that are what they
should be it is 1 and noise on top; noise of B / 10 hides a doubled one of eight."""

ROWS, COLUMNS = 24, 64
"""Samples of a frame: places down the image, pixels side by side at each"""

THINNED = 8
"""Of the scan's sample, what is asked whether frames need a look: a median of five hundred is good to 6 %."""

LEAST_PIXELS = 60
FEWEST_LEFT = 4
"""Frames of a set, without a doubled one, whose residual can still tell which of two is the false one"""


@dataclass(frozen=True)
class Doubled:
    """Two frames of a set that show the same. false, true: their numbers in the set; false is None where nothing tells
    which of them it is, and then `true` are both."""

    false: int | None
    true: tuple[int, ...]


def may_be_doubled(
    noise: NoiseModel, level: NDArray[np.float32], modulation: NDArray[np.float32], frames: AxisFrames
) -> bool:
    """Whether residuals are large enough for a look at the frames. level, modulation: (n,) of the scan's sample."""
    shifts = [n for n in frames.shifts if n > 3]
    if 3 in frames.shifts or not shifts:
        return 3 in frames.shifts
    level, modulation = level[::THINNED], modulation[::THINNED]
    lit = modulation > 0.25 * float(modulation.max(initial=0.0))
    level, b = level[lit], modulation[lit]
    if not b.size:
        return False
    # The difference of two neighbours is 2 B sin(pi / N) times a sine; the fit takes three of N parts of it.
    least = min(2 * sin(pi / n) ** 2 * (1 - 3 / n) for n in shifts) / frames.freedom
    middle = float(nth_of(level, level.size // 2))
    seen = max(noise.read + noise.per_level * middle, ROUNDING_VARIANCE) / float(nth_of(b, b.size // 2)) ** 2
    return bool(seen > LEAST_RESIDUAL**2 * least)


def doubled_frames(frames: AxisFrames, k: int, shape: tuple[int, int], clip: int) -> list[Doubled]:
    """Of one set that has all its frames.

    Args:
        k: the set. shape: (H, W) of a frame. clip: grey level from which a sample counts as saturated.
    """
    alpha = frames.angles[k]
    if len(alpha) < 3:
        return []
    if len(alpha) == 3 and _all_differ(frames, k):
        return []
    samples = _samples(frames, k, shape, clip)
    if samples.shape[1] < LEAST_PIXELS:
        return []
    count = len(alpha)
    # Sums of products of all frames tell the differences of each two, and those of the fringe that fits them best.
    sums = (samples @ samples.T) / samples.shape[1]
    apart = _differences(sums)
    if count == 3:
        meant = np.where(apart == 0, np.diag(sums).mean(), 0.0)
    else:
        fit = _fit(alpha, np.arange(count))
        meant = _differences(fit @ sums @ fit.T)
    pairs = [(n, m) for n, m in combinations(range(count), 2) if apart[n, m] < ALIKE * meant[n, m]]
    return [_which(alpha, samples, pair) for pair in pairs]


def _all_differ(frames: AxisFrames, k: int) -> bool:
    """Whether no two frames of a set are the same picture: a look at a few pixels in the middle, and seldom more."""
    first, count = int(frames.starts[k]), len(frames.angles[k])
    few = [frame.reshape(-1) for frame in frames.frames[first : first + count]]
    middle = few[0].size // 2
    pictures = {frame[middle : middle + COLUMNS].tobytes() for frame in few}
    return len(pictures) == count


def _differences(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, N) mean squares of the differences of each two, from the means of their products."""
    own = np.diag(sums)
    return np.asarray(np.maximum(own[:, None] + own - 2 * sums, 0.0))


def _samples(frames: AxisFrames, k: int, shape: tuple[int, int], clip: int) -> NDArray[np.float64]:
    """(N, p) grey levels of lit pixels that do not saturate."""
    height, width = shape
    first = int(frames.starts[k])
    # Pixels side by side, elsewhere in each row: fringes of either axis show all their phases.
    rows = (np.arange(ROWS) + 0.5) * height / ROWS
    columns = (np.arange(ROWS) * 7 % ROWS) * max(width - COLUMNS, 0) / (ROWS - 1)
    at = (rows.astype(np.intp) * width + columns.astype(np.intp))[:, None] + np.arange(min(COLUMNS, width))
    taken = [frames.frames[first + n].reshape(-1)[at.reshape(-1)] for n in range(len(frames.angles[k]))]
    grey = np.stack(taken)
    most, least = grey.max(axis=0), grey.min(axis=0)
    spread = most - least
    # Whole levels: sums of their products are exact, so that what is the same differs by nothing.
    return np.asarray(grey[:, (spread > 0.25 * spread.max(initial=0)) & (most < clip)].astype(np.float64))


def _which(alpha: NDArray[np.float64], samples: NDArray[np.float64], pair: tuple[int, int]) -> Doubled:
    """The one without which the others fit best, where enough are left."""
    if len(alpha) - 1 < FEWEST_LEFT:
        return Doubled(None, pair)
    left = []
    for n in pair:
        others = np.flatnonzero(np.arange(len(alpha)) != n)
        left.append(float(np.mean((samples[others] - _fit(alpha, others) @ samples[others]) ** 2)))
    false, true = pair if left[0] < left[1] else pair[::-1]
    return Doubled(false, (true,))


def _fit(alpha: NDArray[np.float64], which: NDArray[np.intp]) -> NDArray[np.float64]:
    """(n, n) what takes the samples of some shifts to those of the fringe that fits them best."""
    turns = alpha[which]
    design = np.stack([np.ones_like(turns), np.cos(turns), np.sin(turns)], axis=1)
    return np.asarray(design @ np.linalg.pinv(design))
