"""How noisy the phases of a scan really are: how well neighbouring rungs of the ladder agree over the image.

What is left of each unwrapping step, the remainder, would be zero everywhere but for phase errors. How much it differs
between pixels side by side is noise, and gives a noise model to captures whose fits leave no residual (three shifts).
What its spread has beyond that is systematic: response, interreflection, blur. Whether frames stand in their right
order is not judged here: `scanner.sequencer` does that, before anything is decoded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from scanner.decode.noise import NoiseModel, default_noise, fit_noise
from scanner.decode.sample_kernels import MIN_PIXELS
from scanner.decode.unwrapping import Ladder

MIN_AGREEMENT = 0.3
"""Mean cosine of remainders: chance gives 0, noise of a fifth of a fringe .45."""

PAIR_DISTANCE = 2
"""Camera pixels between the two of a pair: near enough to share what is systematic, too far to share a blur's noise."""

MOST_SYSTEMATIC = 0.1
"""Of a fringe, sigma over the image, by which neighbouring rungs may differ beyond noise before it is said: half a
fringe, from which on the next one is counted, is then five sigmas away, and such errors have longer tails than noise"""

_UNFOLDED_SIGMA = 0.15
"""Predicted sigma of a pair's difference, cycles, up to which it stays within half a cycle (3.3 sigma)."""
_ROUNDS = 3
"""Of choosing such pairs by the noise model and fitting it to them; the first choice is by the default model."""


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
        if r.pixels >= MIN_PIXELS and r.expected_sigma < _UNFOLDED_SIGMA and r.agreement < MIN_AGREEMENT
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


def noise_of_pairs(
    ladder: Ladder,
    phases: NDArray[np.float32],
    per_variance: NDArray[np.float32],
    level: NDArray[np.float32],
    centre: float,
    max_value: int,
) -> NoiseModel:
    """The noise model under which remainders differ between pixels side by side as much as they do.

    Args:
        phases: (2, K, n) cycles, of pairs of usable pixels. per_variance: (2, K, n) variance of each over the variance
            of one sample. level: (n,) mean grey level of a pair. centre: the field's centre, fraction of it.
        max_value: largest grey level of the camera.

    Returns:
        The camera's default where there are too few pairs, or only one rung.
    """
    model = default_noise(max_value)
    if len(ladder.errors) == 0:
        return model
    both = [np.stack(remainders_of(ladder, of_one, centre)) for of_one in phases]
    difference = both[0] - both[1]
    difference -= np.rint(difference)
    per_sample = (ladder.errors**2) @ (per_variance[0] + per_variance[1])
    levels = np.broadcast_to(level, difference.shape)
    for _ in range(_ROUNDS):
        use = per_sample * model.variance(level) < _UNFOLDED_SIGMA**2
        if np.count_nonzero(use) < MIN_PIXELS:
            return model
        squares = (difference[use] ** 2 / per_sample[use]).astype(np.float32)
        model = fit_noise(levels[use], squares, 1, max_value)
    return model


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
