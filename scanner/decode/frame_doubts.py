"""Whether the frames of a PMP axis need a look (`doubled`): a few numbers of the scan's sample, asked at every scan.

Nothing is told here but that residuals are larger than one frame out of step would leave them, at the least.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from scanner.decode.agreement import MIN_AGREEMENT, MOST_SYSTEMATIC, Remainder
from scanner.decode.frame_orders import LEAST_SHARE, LIT2, MOST_SHIFTS, least_left
from scanner.decode.middles import nth_of
from scanner.decode.pmp_frames import AxisFrames
from scanner.decode.pmp_sample import Sample
from scanner.decode.sample_kernels import MIN_PIXELS
from scanner.kernel import kernel

MOST_ALIKE = 0.5
"""Mean vector of a set's phases, from where on it shows few of them: of phases within half a turn it is .64"""

THREE_SEEN = 64
"""Pixels side by side that frames of three shifts are compared at"""

THINNED = 8
"""Of the scan's sample, what is asked whether frames need a look: a mean of five hundred is good to 5 %."""


def may_be_doubled(
    frames: AxisFrames,
    sample: Sample,
    residual: NDArray[np.float32],
    steps: Sequence[Remainder],
    good: NDArray[np.bool_],
) -> bool:
    """Whether the sample's residuals are large enough for a look at the frames; of three shifts and of four, what is
    left of steps.

    Args:
        sample: without what overtones are of its residuals. residual: (R, L), with it. good: of `Look`.
    """
    if {3, 4} & set(frames.shifts):
        if any(map(_contradicts, steps)) or not _all_differ(frames):
            return True
        # Noise that frames out of step have made may leave no pixel to be asked.
        if any(step.pixels < MIN_PIXELS for step in steps) and np.count_nonzero(good) >= MIN_PIXELS:
            return True
    least = _least(frames.shifts)
    return least > 0 and _stands_out(
        sample.modulations, sample.usable, residual, sample.residual, sample.phases, least, THINNED
    )


@lru_cache(maxsize=32)
def _least(shifts: tuple[int, ...]) -> float:
    """Of B^2, that is worth a look; 0 where no set's residuals tell."""
    return LEAST_SHARE * min((least_left(n) for n in shifts if 3 < n <= MOST_SHIFTS), default=0.0)


def _contradicts(step: Remainder) -> bool:
    return step.pixels >= MIN_PIXELS and (step.agreement < MIN_AGREEMENT or step.beyond_noise > MOST_SYSTEMATIC / 2)


def _all_differ(frames: AxisFrames) -> bool:
    """Whether no two frames of a set of three are the same at a few pixels in the middle."""
    for first, count in zip(frames.starts.tolist(), frames.shifts, strict=False):
        if count != 3:
            continue
        few = [frame.reshape(-1) for frame in frames.frames[first : first + 3]]
        middle = few[0].size // 2
        if len({frame[middle : middle + THREE_SEEN].tobytes() for frame in few}) < 3:
            return False
    return True


@kernel
def _stands_out(
    modulations: NDArray[np.float32],
    usable: NDArray[np.bool_],
    residual: NDArray[np.float32],
    without: NDArray[np.float32],
    phases: NDArray[np.float32],
    least: float,
    every: int,
) -> bool:
    """Whether residuals are more than `least` of B^2: what overtones explain of them counts where a set shows so few
    phases that one of its frames out of step would look like them."""
    sets, length = modulations.shape[0], modulations.shape[2]
    height2 = np.zeros((modulations.shape[1] + every - 1) // every * length, np.float32)
    for r in range(0, modulations.shape[1], every):
        for i in range(length):
            if usable[r, i]:
                for k in range(sets):
                    b = modulations[k, r, i]
                    height2[r // every * length + i] = max(height2[r // every * length + i], b * b)
    lit = np.float32(LIT2) * nth_of(height2, int(0.99 * (height2.size - 1)))
    total, all_left, left = 0.0, 0.0, 0.0
    for r in range(0, modulations.shape[1], every):
        for i in range(length):
            here = height2[r // every * length + i]
            if here > lit:
                total += here
                all_left += residual[r, i]
                left += without[r, i]
    if all_left <= least * total:
        return False
    return left > least * total or _shows_few_phases(phases, height2, lit, every)


@kernel
def _shows_few_phases(phases: NDArray[np.float32], height2: NDArray[np.float32], lit: np.float32, every: int) -> bool:
    """Whether one of the sets shows most of its lit pixels within a third of a turn or so."""
    length = phases.shape[2]
    for k in range(phases.shape[0]):
        cosine, sine, count = 0.0, 0.0, 0
        for r in range(0, phases.shape[1], every):
            for i in range(length):
                if height2[r // every * length + i] > lit:
                    cosine += np.cos(2 * np.pi * phases[k, r, i])
                    sine += np.sin(2 * np.pi * phases[k, r, i])
                    count += 1
        if cosine * cosine + sine * sine > (MOST_ALIKE * count) ** 2:
            return True
    return False
