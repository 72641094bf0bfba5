"""What the fringes of a printed target say of a projector's response: a check, and what is to be said of it.

Grey levels decide (`response_measure`). Only where nobody could show them, and the rig claims no response, is the
fringes' exponent better than none. Nothing is measured here.
"""

from __future__ import annotations

from typing import Any

from scanner.calibration.grey_levels import LevelResponse
from scanner.calibration.response import Response
from scanner.digits import with_uncertainty


def checked(found: Response, levels: LevelResponse | None) -> tuple[dict[str, Any] | None, tuple[str, ...]]:
    """Compare the fringes' exponent with what is known better.

    Args:
        found: of the first pose.
        levels: the response by grey levels; None where they were not measured.

    Returns:
        `response.projector` of a calibration file where only fringes tell it, else None; and the lines to say.
    """
    if found.warnings:
        return None, tuple(f"response by the target's fringes, a check: {said}" for said in found.warnings)
    unsure = found.expanded
    seen = (
        f"response by the target's fringes, a check: light follows what is projected to the power of "
        f"{with_uncertainty(found.exponent, unsure)} (k = 2)"
    )
    if levels is not None:
        return None, (f"{seen}; the file has what grey levels told", *_against_levels(found, levels, unsure))
    off = abs(found.exponent - 1) > unsure
    if found.gamma is None or found.gamma != found.exponent:
        claim = "a table" if found.gamma is None else f"gamma {found.gamma / found.exponent:.3f}"
        kept = f"{seen}; the poses were projected with {claim}, which stays"
        if not off:
            return None, (kept,)
        return None, (
            kept,
            f"fringes contradict {claim} by {abs(found.exponent - 1):.3f}: measure grey levels, which decide "
            "(fringed calibrate response)",
        )
    if not off:
        return None, (f"{seen}; nothing to correct",)
    return {"gamma": found.gamma, "table": None}, (
        f"{seen}; ripple {found.ripple_px:.3f} px; scans will project with gamma {found.gamma:.3f}, as nothing tells "
        "it better: measure grey levels (fringed calibrate response)",
    )


def _against_levels(found: Response, levels: LevelResponse, unsure: float) -> tuple[str, ...]:
    """What to say where both differ by more than both are unsure of."""
    # What is left to see under a capture's own precorrection; under a table, which is right, nothing.
    given = None if found.gamma is None else found.gamma / found.exponent
    expected = 1.0 if given is None else levels.gamma / given
    apart = abs(found.exponent - expected)
    allowed = unsure + 2 * levels.sigma * expected / levels.gamma
    if apart <= allowed:
        return ()
    return (
        f"fringes contradict grey levels: they should have told {expected:.3f}, and {apart:.3f} is more than the "
        f"{allowed:.3f} that both are unsure of: fringes are blurred, the response is no exponent, or it has changed",
    )
