"""How noisy the phases of a scan really are: how well neighbouring rungs of the ladder agree over the image.

What is left of each unwrapping step, the remainder, would be zero everywhere but for phase errors. How much it differs
between pixels side by side is noise (`pair_noise`). What its spread has beyond noise is systematic: response,
interreflection, blur. Whether frames stand in their right order is not judged here: `scanner.sequencer` does that,
before anything is decoded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from scanner.decode.pair_noise import UNFOLDED_SIGMA
from scanner.decode.sample_kernels import MIN_PIXELS
from scanner.decode.unwrapping import Ladder

MIN_AGREEMENT = 0.3
"""Mean cosine of remainders: chance gives 0, noise of a fifth of a fringe .45."""

MOST_SYSTEMATIC = 0.1
"""Of a fringe, sigma over the image, by which neighbouring rungs may differ beyond noise before it is said: half a
fringe, from which on the next one is counted, is then five sigmas away, and such errors have longer tails than noise"""


@dataclass(frozen=True)
class Remainder:
    """One unwrapping step over the whole image."""

    low: float
    high: float
    """frequencies of its two rungs, cycles over the projector"""
    expected_sigma: float
    """by the noise model, cycles, median of the better half of the sample"""
    systematic: float
    """sigma of what the noise model does not explain, cycles of one set's phase: response, interreflection, blur"""
    offset: float
    """circular mean, cycles"""
    agreement: float
    """length of the mean vector, 1 = all pixels alike"""
    pixels: int

    @property
    def beyond_noise(self) -> float:
        """Sigma over the whole image, cycles, from the mean vector's length (Mardia 1972, sec. 3.4), without noise's;
        0 where too few pixels tell."""
        if self.pixels < MIN_PIXELS:
            return 0.0
        spread2 = -2 * np.log(max(self.agreement, 1e-6)) / (2 * np.pi) ** 2
        return float(np.sqrt(max(spread2 - self.expected_sigma**2, 0.0)))


def remainders(ladder: Ladder, found: NDArray[np.float64], pixels: int) -> list[Remainder]:
    """How well neighbouring rungs agree, from what `judge_steps` found over a sample of usable pixels.

    Args:
        found: (J - 1, 4). pixels: of the sample.
    """
    steps = zip(pairwise(ladder.frequencies.tolist()), found.tolist(), strict=True)
    return [
        Remainder(low, high, expected, systematic, offset, agreement, pixels)
        for (low, high), (expected, systematic, offset, agreement) in steps
    ]


def remainders_of(ladder: Ladder, phases: NDArray[np.float32], centre: float) -> list[NDArray[np.float64]]:
    """What is left of each unwrapping step, (n,) cycles within +-.5, of (K, n) phases; centre: see `agreement`."""
    m, f = ladder.combinations.astype(np.float64), ladder.frequencies
    absolute = m[0] @ phases
    absolute -= np.rint(absolute - f[0] * centre)
    found = []
    for j in range(len(f) - 1):
        psi = m[j + 1] @ phases
        difference = f[j + 1] / f[j] * absolute - psi
        order = np.rint(difference)
        found.append(difference - order)
        absolute = psi + order
    return found


def disagreements(axis: str, remainders: Sequence[Remainder]) -> tuple[str, ...]:
    """What a user should know about steps whose two rungs have nothing to do with one another: nothing is decided."""
    return tuple(
        f"frequencies {r.low:g} and {r.high:g} along {axis} do not agree anywhere: are the frames in their order, and "
        f'"sign" and "shifts" of the pattern right?'
        for r in remainders
        if r.pixels >= MIN_PIXELS and r.expected_sigma < UNFOLDED_SIGMA and r.agreement < MIN_AGREEMENT
    )


def doubtful_counts(axis: str, remainders: Sequence[Remainder]) -> tuple[str, ...]:
    """What a user should know about steps that count fringes of the finer rung by a coarser one that is out of true.

    Pixels near half a fringe are undecided; those beyond it look as sound as those on their fringe.
    """
    return tuple(
        f"frequencies {r.low:g} and {r.high:g} along {axis} differ by {beyond:.2f} fringes of the finer one more than "
        "noise explains: where that reaches half a fringe the next one is counted. Light that surfaces throw at one "
        "another, in hollows, does this to wide fringes first: take frequencies without a low one (59, 64, 70), or "
        "gray+pmp"
        for r, beyond in ((r, r.beyond_noise) for r in remainders)
        if beyond > MOST_SYSTEMATIC and r.agreement >= MIN_AGREEMENT
    )


@cache
def folded_medians() -> NDArray[np.float64]:
    """(2, m) sigmas of normal errors folded into +-1/2, and the medians of their absolute values; not to be written."""
    sigmas = np.linspace(0.05, 0.5, 46)
    x = np.linspace(0, 0.5, 2001)
    folds = np.arange(-3, 4)[:, None]
    medians = []
    for sigma in sigmas:
        inside = (ndtr((x + folds) / sigma) - ndtr((-x + folds) / sigma)).sum(axis=0)
        medians.append(float(np.interp(0.5, inside, x)))
    return np.stack([sigmas, np.maximum.accumulate(np.array(medians))])
