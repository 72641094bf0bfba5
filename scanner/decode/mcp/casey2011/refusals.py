"""What is no pattern, another one, or the pattern in another order: each refused with a reason.

Asked after each stage of the reference decoder that can tell; none of it is in the dissertation, whose captures were
known to hold the pattern.
"""

from __future__ import annotations

import bisect
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp.casey2011 import carrier_search, hidden_markov, stripe_detection
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat

Labels = NDArray[np.int32]
Rates = tuple[NDArray[np.float64], NDArray[np.float64]]
"""False positive and miss rates of the channels, (N,) each."""

LEAST_CONTRAST = 0.01
"""Share of the camera's range below which an image holds no pattern."""

FINEST_PX = 6.0
"""Stripes nearer than this have no region and peak of their own."""

LEAST_LIT = 0.005
"""Share of all columns' stripes that must have a peak; fewer is no pattern."""

MATCH = 0.15
"""Largest spread of the carriers found over the projected ones: slant and keystone change all by about one factor,
which another set of carriers does not show. As much may part a segment's carriers from those of the whole image."""

BAND_CONTRAST = 4.0
"""Least ratio of the weakest carrier's band to what lies between bands: noise and other patterns stay below 2, the
reference scenes lie above 15."""

MARGIN = 0.2
"""By how much more of the filtered code words on the peaks fit the described order than the best of shuffled ones. Of
wrong descriptions, whose order is one among the shuffled ones, the luckiest fitted .16 more (a small object that shows
five code words only); the reference scenes' own fit .34 and more, a rig of strong keystone's .21."""

SHUFFLES = 8
EVERY = 8
TRIES = 300
"""Orders tried against the described one, on every so many columns (a hundred and more of them); and
random orders looked at to find them."""


def refuse_flat(image: NDArray[Any], camera: CameraFormat) -> None:
    """Raise DecodeError for an image without contrast."""
    low, high = (float(v) for v in np.percentile(image[::4, ::4], (1, 99)))
    if high - low < LEAST_CONTRAST * camera.max_value:
        raise DecodeError(
            f"no pattern: the image is uniform (grey levels {low:.0f} to {high:.0f})",
            hint="check that the projector shows the pattern, its focus, and the exposure",
        )


def refuse_few(found: stripe_detection.Stripes, image: NDArray[Any]) -> None:
    """Raise DecodeError for stripes that are too fine, or too few."""
    if found.wavelength < FINEST_PX:
        raise DecodeError(
            f"stripes are {found.wavelength:.1f} px apart, too fine for this camera",
            hint="project fewer bits, or move the camera closer",
        )
    if len(found.peaks.y) < LEAST_LIT * image.size / found.wavelength:
        raise DecodeError("no stripes stand out", hint="check focus, exposure and what is projected")


def carriers_match(search: carrier_search.Search, expected: NDArray[np.float64]) -> bool:
    """Whether the carriers found stand out, and are the expected ones times one factor."""
    factor = search.frequency / expected
    clear = search.complete and search.contrast >= BAND_CONTRAST
    return clear and bool(np.ptp(factor) <= MATCH * factor.mean())


def refuse_carriers(search: carrier_search.Search, expected: NDArray[np.float64], width: int) -> None:
    """Raise DecodeError unless the carriers found (W = width px) are the expected ones, cycles per px."""
    if carriers_match(search, expected):
        return
    wanted = ", ".join(f"{f * width:.0f}" for f in expected)
    hint = "check carriers and axis of the description, and focus"
    if not search.complete or search.contrast < BAND_CONTRAST:
        raise DecodeError(f"stripes, but no carriers stand out near {wanted} cycles per image", hint=hint)
    shown = ", ".join(f"{f * width:.0f}" for f in search.frequency)
    raise DecodeError(f"other carriers than described: {shown} cycles per image, not near {wanted}", hint=hint)


def refuse_order(agreement: float, word: Labels, peaks: stripe_detection.Peaks, symbols: Labels, rates: Rates) -> float:
    """Raise DecodeError unless the code words fit the described order much better than any shuffled one.

    Args:
        agreement: share of the code words that fit the described order.
        word: (P,) code words on the peaks.
        peaks: where they are.
        symbols: (n,) nonzero code words in the described order.
        rates: of the model.

    Returns:
        the largest share of the code words that fits a shuffled order.
    """
    chance = _best_shuffled(word, peaks, symbols, rates)
    if agreement < chance + MARGIN:
        raise DecodeError(
            f"stripes and carriers are there, but the codes contradict the description ({agreement:.0%} of them fit, "
            f"of a shuffled order {chance:.0%})",
            hint="check bits, carriers, codes and axis of the description against what is projected",
        )
    return chance


def shuffled_orders(symbols: Labels) -> list[Labels]:
    """The reversed order and up to SHUFFLES - 1 random ones that leave no more than a third of the symbols in order.

    A column that shows only symbols in order fits any order that leaves them so; of few symbols most orders do.
    """
    generator = np.random.default_rng(2011)
    orders = [symbols[::-1].copy()]
    for _ in range(TRIES):
        places = generator.permutation(len(symbols))
        little = longest_rise(places) <= max(1, len(symbols) // 3)
        if little and not any((symbols[places] == order).all() for order in orders):
            orders.append(symbols[places])
        if len(orders) == SHUFFLES:
            break
    return orders


def longest_rise(places: NDArray[Any]) -> int:
    """Length of the longest rising subsequence (Schensted 1961)."""
    ends: list[int] = []
    for place in places.tolist():
        at = bisect.bisect_left(ends, place)
        ends[at : at + 1] = [place]
    return len(ends)


def _best_shuffled(word: Labels, peaks: stripe_detection.Peaks, symbols: Labels, rates: Rates) -> float:
    """The largest share of code words that fit any of some shuffled orders, the reversed one among them."""
    chosen = peaks.column % EVERY == 0
    some = word[chosen]
    columns = (len(peaks.start) - 2) // EVERY + 1
    counts = np.bincount(peaks.column[chosen] // EVERY, minlength=columns)
    start = np.concatenate(([0], np.cumsum(counts))).astype(np.int32)
    best = 0.0
    for order in shuffled_orders(symbols):
        path = hidden_markov.best_paths(some, start, hidden_markov.model(order, *rates))
        best = max(best, hidden_markov.fitting(some, path, order))
    return best
