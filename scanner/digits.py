"""Digits of a figure as it is printed: its uncertainty has two significant ones, and it ends at the same place.

After JCGM 100:2008, 7.2.6. What is printed behind +- is expanded, k = 2; documents keep all digits, and say sigma where
they mean it.
"""

from __future__ import annotations

import math

UNKNOWN_PLACES = 4
"""Decimal places of a figure whose uncertainty is not known: a tenth of a micrometre, of a percent of a pixel"""
MOST_PLACES = 6


def places_of(expanded: float) -> int:
    """The decimal place at which an uncertainty's second significant digit stands; negative: left of the point."""
    if not (math.isfinite(expanded) and expanded > 0):
        return UNKNOWN_PLACES
    return min(1 - int(f"{expanded:.1e}".partition("e")[2]), MOST_PLACES)


def rounded(value: float, places: int = UNKNOWN_PLACES) -> str:
    """A number to a decimal place, never "-0.00"."""
    return f"{round(value, places) if places < 0 else value:z.{max(places, 0)}f}"


def with_uncertainty(value: float, expanded: float | None, known: float | None = None) -> str:
    """`1345.98 +- 0.53`. expanded: U, k = 2, in the value's unit; None: unknown.

    known: of an unknown U the part that is known, k = 2: the value has no digits that this alone makes worthless.
    """
    if expanded is None or not math.isfinite(expanded):
        places = UNKNOWN_PLACES if known is None else min(places_of(known), UNKNOWN_PLACES)
        return f"{rounded(value, places)} +- unknown"
    return f"{rounded(value, places_of(expanded))} +- {alone(expanded)}"


def alone(expanded: float) -> str:
    """An uncertainty on its own, two significant digits."""
    return rounded(max(expanded, 10.0**-MOST_PLACES), places_of(expanded)) if expanded > 0 else "0"
