"""Why nothing in view changes with the projector's light: no light, too little, or a camera that other light fills.

The words of an error, from the full-on and full-off frames; whether it is dark is decided in `findings`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from scanner.patterns import PatternSequence
from scanner.sequencer.findings import Array, equal_positions, middle

DARK_HINT = "is the lens cap off, the projector on and awake, and the exposure long enough?"

FILLED_HINT = "shorten the exposure, close the lens, lower the gain or darken the room"

BRIGHTEST, NOISE_LIFTS = 0.995, 2.58
"""Quantile of the pixels that stands for the brightest place, since a few may glint; and by how many sigmas noise alone
lifts it (normal distribution)."""

SEEN_SIGMAS = 1.0
"""Of the difference of full-on and full-off medians: what the brightest place has more, noise taken off, is light. Of
two hundred pixels that quantile is known to .4 sigmas, of all of a thumbnail to a tenth of it."""

MOST_FILLED = 0.5
"""Share of the pixels at the top of the range without the projector's light."""


def why_dark(
    sequence: PatternSequence, frames: Mapping[int, Array], max_value: int, noise: float, least: float
) -> tuple[str, str]:
    """What is the matter, and what to do about it.

    Args:
        frames: by position, (P,) grey levels. noise: 1-sigma of one sample. least: grey levels that the projector's
            light has to add somewhere to be told from it.
    """
    nothing = "nothing in the camera's view is lit by the projector"
    levels, sigma = {}, 0.0
    for light, positions in equal_positions(sequence):
        here = [frames[p] for p in positions if p in frames]
        if not here:
            return _always_filled(frames, max_value) or (nothing, DARK_HINT)
        levels[light] = middle(here)
        # A median of n has the variance of a mean of n, times up to pi / 2.
        sigma = float(np.hypot(sigma, noise * np.sqrt(np.pi / 2 / len(here))))
    off, on = levels[0.0], levels[1.0]
    filled = float(np.mean(off >= max_value))
    if filled > MOST_FILLED:
        return (
            f"{filled:.0%} of the camera's pixels are saturated without the projector's light: other light is too "
            "strong, or the exposure too long",
            FILLED_HINT,
        )
    added, other = float(np.quantile(on - off, BRIGHTEST)) - NOISE_LIFTS * sigma, float(np.median(off))
    if added < SEEN_SIGMAS * sigma:
        return nothing, DARK_HINT
    says = (
        f"the projector's light is too weak: it adds {added:.0f} of {max_value} grey levels at the brightest places, "
        f"and {least:.0f} at least are told from noise of {noise:.1f}"
    )
    longer = 2 * max(least / added, 1.0)
    hint = f"expose {longer:.0f} times as long or more (--exposure auto), open the lens or move nearer"
    if other > added:
        says += f"; other light makes {other:.0f}"
        hint += ", and darken the room"
    return says, hint


def _always_filled(frames: Mapping[int, Array], max_value: int) -> tuple[str, str] | None:
    """The same of frames none of which is known to be without light."""
    filled = float(np.mean(np.min(list(frames.values()), axis=0) >= max_value)) if frames else 0.0
    if filled <= MOST_FILLED:
        return None
    says = f"{filled:.0%} of the camera's pixels are saturated in every frame: the exposure is too long"
    return f"{says}, or other light too strong", FILLED_HINT
