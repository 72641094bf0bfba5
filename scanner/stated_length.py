"""The length that a calibration's scale rests on, and how much of an uncertainty is its own.

All lengths of a rig are proportional to it: what it is off, as a share, every depth, diameter and baseline is off.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from scanner.digits import with_uncertainty

DOMINANT = 0.5
"""Share of a variance beyond which all other causes together weigh less: nothing else is worth mending first."""

MOST_MM = 1e9
"""A thousand kilometres: what is longer is no length of a target"""


@dataclass(frozen=True)
class StatedLength:
    """As it was given: mm, and its 1-sigma, mm."""

    reference_mm: float
    sigma_mm: float

    def of(self, length_mm: float) -> float:
        """1-sigma, mm, that it leaves in another length, mm."""
        return abs(length_mm) * self.sigma_mm / self.reference_mm

    def share(self, length_mm: float, sigma_mm: float) -> float:
        """Of the variance of a length whose whole 1-sigma is given, 0 .. 1."""
        return min((self.of(length_mm) / sigma_mm) ** 2, 1.0) if sigma_mm > 0 else 0.0


def stated_length_of(scale: Any) -> StatedLength | None:
    """Of a calibration's `scale`; None where it is unverified, or not told."""
    if not isinstance(scale, Mapping):
        return None
    reference, sigma = scale.get("reference_mm"), scale.get("sigma_mm")
    if not (isinstance(reference, int | float) and isinstance(sigma, int | float)):
        return None
    if not (0 < reference < MOST_MM and 0 < sigma < MOST_MM):
        return None
    return StatedLength(float(reference), float(sigma))


def dominates(found: Mapping[str, Any] | None) -> str | None:
    """A hint where a document's `stated_length` {reference_mm, sigma_mm, share, of} is most of a variance.

    `of`: whose it is, in words; without, that of the depth of a scan's median point.
    """
    if found is None or not found["share"] > DOMINANT:
        return None
    length = with_uncertainty(found["reference_mm"], 2 * found["sigma_mm"])
    of = found.get("of", "the median point's depth")
    return (
        f"the stated length {length} mm (k = 2) dominates, with {found['share']:.0%} of the variance of {of}: "
        "measure it better"
    )
