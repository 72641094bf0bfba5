"""Taking a response's ripple off decoded coordinates: what overtones that pass for the fringe have put into them.

With three to five shifts a response that is no line moves the finest phase N times a period. By how much, the scan's
own frequencies say (`scanner.decode.harmonics`); here it is taken off as a function of the phase, so that captures that
were projected with a wrong gamma need not be taken again. Blur weakens overtones: what is taken off is what this scan
shows, and not what a response would make of a sharp image. Not on unless it is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Decoded, Map
from scanner.errors import DecodeError
from scanner.kernel import kernel
from scanner.patterns import Axis, PatternSequence, PmpPattern

CERTAIN_SIGMAS = 4.0
"""A ripple lower than this times its own sigma is left alone: taking noise off adds it."""

_TABLE = 1024


def without_ripple(decoded: Decoded, sequence: PatternSequence) -> Decoded:
    """The same maps without the finest set's ripple, where it is told and certain; PMP only.

    In `details`, the set's `ripple_px` becomes what may be left, and `corrected` is true.

    Raises:
        DecodeError: another method.
    """
    pattern = sequence.pattern
    light: Mapping[str, Any] = decoded.details.get("light") or {}
    if not isinstance(pattern, PmpPattern):
        raise DecodeError(
            f"ripple is corrected in PMP scans, and this one is {pattern.method}", hint="leave --correct-ripple out"
        )
    if not light:
        return decoded
    maps: dict[Axis, Map | None] = {"y": decoded.rows, "x": decoded.columns}
    told = dict(light)
    for axis in pattern.axes:
        harmonics = [dict(h) for h in light[axis]["harmonics"]]
        finest = max(range(len(harmonics)), key=lambda k: harmonics[k]["frequency"])
        found, values = harmonics[finest].get("ripple"), maps[axis]
        if found is None or values is None:
            continue
        if np.hypot(found["cosine_px"], found["sine_px"]) < CERTAIN_SIGMAS * found["sigma_px"]:
            continue
        turns = 2 * np.pi * harmonics[finest]["shifts"] * np.arange(_TABLE) / _TABLE
        table = (found["cosine_px"] * np.cos(turns) + found["sine_px"] * np.sin(turns)).astype(np.float32)
        per_px = harmonics[finest]["frequency"] / sequence.projector.along(axis)
        straight = values.copy()
        _take_off(straight.reshape(-1), table, pattern.origin, per_px)
        maps[axis] = straight
        harmonics[finest] |= {"ripple_px": found["sigma_px"], "corrected": True}
        told[axis] = {**light[axis], "harmonics": harmonics}
    return replace(decoded, rows=maps["y"], columns=maps["x"], details={**decoded.details, "light": told})


def warm_up() -> None:
    """Compile the kernel."""
    _take_off(np.zeros(2, np.float32), np.zeros(_TABLE, np.float32), 0.5, 0.1)


@kernel
def _take_off(values: NDArray[np.float32], table: NDArray[np.float32], origin: float, per_px: float) -> None:
    for i in range(values.size):
        if not np.isnan(values[i]):
            cycles = (values[i] + origin) * per_px
            values[i] -= table[int((cycles - np.floor(cycles)) * table.size) % table.size]
