"""Stripe index to projector row (Casey 2011, sec. 3.7): the calibration's least-squares line, or the pattern's own.

The fit itself is `scanner.calibration.mcp_phase`, written by `fringed calibrate mcp`. Not used by the default decoder.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp.model import PatternModel


@dataclass(frozen=True)
class CodeToPhase:
    """row = slope index + intercept, px. source: "calibration" or "pattern". warning: why a fit given is not used."""

    slope: float
    intercept: float
    source: str
    warning: str = ""

    def rows(self, index: NDArray[np.float32]) -> NDArray[np.float32]:
        """Projector rows (sec. 3.7) of stripe indices, minima (k + 0.5) and mid-levels (k +- 0.25) too, same shape."""
        return (np.float64(self.slope) * index + self.intercept).astype(np.float32)


def code_to_phase(model: PatternModel, fit: Mapping[str, Any] | None) -> CodeToPhase:
    """The line to use (sec. 3.7).

    Args:
        model: the pattern's tables, whose own line has slope h and intercept h / 2 - 0.5.
        fit: `mcp_phase` of a calibration, slope and intercept; None: it has none.

    Returns:
        the fit, unless it is off the pattern's own line by half a stripe or more somewhere on the pattern: a stripe
        would then lie where its neighbour is, so the fit was made with another pattern (the file does not say which).
    """
    own = CodeToPhase(model.pitch, model.pitch / 2 - 0.5, "pattern")
    if fit is None:
        return own
    slope, intercept = float(fit["slope"]), float(fit["intercept"])
    ends = np.array([0, model.stripes - 1])
    off = float(np.abs((slope - own.slope) * ends + intercept - own.intercept).max())
    if off < model.pitch / 2:
        return CodeToPhase(slope, intercept, "calibration")
    said = (
        f"the calibration's code-to-phase fit is {off:.0f} px off this pattern's stripes at worst: it was made with "
        "another pattern and is not used (fringed calibrate mcp makes one for this)"
    )
    return CodeToPhase(own.slope, own.intercept, own.source, said)
