"""How sure a repeatability is: the uncertainty of a standard deviation that many pixels were asked for.

Noise of its own in every pixel is known by all of them: a million pixels of three scans leave nothing to doubt. What
moves whole pictures (light, warmth, a knock) happens once per scan, and is known no better than n - 1 numbers tell it,
however many pixels show it. The scans say themselves how much of either there is. Nothing here measures features.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2

from scanner.geometry import Array

COVERAGE = 0.9545
"""What two sigmas of a normal error hold"""
CHANCE = 0.1
"""Of scans that have nothing in common but the scene: share that is taken for scans that have, and said to be less
sure than they are. Common parts that are missed would make scans surer than they are."""
FEWEST = 3
"""Two scans have one difference: whether noise or a change made it, nothing tells"""
AT_ONCE = 100_000
"""Pixels: twenty scans of a large camera are a gigabyte"""


def half_width(values: Array) -> float | None:
    """Half-width about sqrt(mean variance) that holds COVERAGE of what it may be in truth, in the values' unit.

    The spread of the scans is split by the trace of the squared covariance, which noise of P pixels keeps P times
    smaller than the squared trace (estimator: Srivastava 2005, J. Japan Statist. Soc. 35, 251), and each part has the
    chi-square interval of its own number of freedoms.

    Args:
        values: (n, P) of n scans at P pixels.

    Returns:
        None for fewer than FEWEST scans.
    """
    scans, pixels = values.shape
    if scans < FEWEST:
        return None
    freedom = scans - 1
    products, fourth = np.zeros((scans, scans)), 0.0
    for first in range(0, pixels, AT_ONCE):
        part = values[:, first : first + AT_ONCE]
        off = part - part.mean(axis=0)
        products += off @ off.T
        fourth += float(np.sum((np.einsum("np,np->p", off, off) / freedom) ** 2))
    total = float(np.trace(products)) / freedom
    if total <= 0:
        return 0.0
    squared = freedom * float(np.sum(products**2)) - (freedom * total) ** 2
    squared = max(squared / (freedom * (freedom - 1) * (freedom + 2)), 0.0)
    # Pixels' variances differ: noise alone has the sum of their squares, which chi-square makes larger by 2 / (n - 1).
    of_noise = fourth / (1 + 2 / freedom)
    # A symmetric matrix of this size has so many numbers beside its trace.
    numbers = (freedom - 1) * (freedom + 2) / 2
    told = squared > of_noise * float(chi2.ppf(1 - CHANCE, numbers)) / numbers
    common = min(np.sqrt(max(squared - of_noise, 0.0)), total) if told else 0.0
    noise = total - common
    freedom_of_noise = freedom * max(noise**2 / of_noise, 1.0) if of_noise > 0 else 1.0
    deviation = np.sqrt(total / pixels)
    return float(deviation * np.hypot(_factor(freedom, common / total), _factor(freedom_of_noise, noise / total)))


def _factor(freedom: float, share: float) -> float:
    """The half-width as a share of s, where so much of s^2 has this number of freedoms and the rest is known.

    Not symmetric about s, so the least c is sought that holds COVERAGE on both sides together.
    """
    if share <= 0:
        return 0.0
    if freedom > 1000:
        return float(share * 2 / np.sqrt(2 * freedom))

    def missing(c: float) -> float:
        # s^2 = sigma^2 (share' x + 1 - share'), x chi-square over its freedoms, at the share that was found.
        low, high = ((1 + c) ** 2 - 1) / share + 1, (max(1 - c, 0.0) ** 2 - 1) / share + 1
        above = float(chi2.cdf(freedom / high, freedom)) if high > 0 else 1.0
        return above - float(chi2.cdf(freedom / low, freedom)) - COVERAGE

    return float(brentq(missing, 1e-9, 1e3))
