"""A scan without a single value is a failure, and says which reason has them all and what to do about it."""

from __future__ import annotations

import numpy as np

from scanner.decode import Decoded, Reason
from scanner.errors import DecodeError
from scanner.saturation import OVEREXPOSED

_IN_WORDS = {
    Reason.SHADOW: "in shadow",
    Reason.CLIPPED: "clipped",
    Reason.LOW_MODULATION: "of too little modulation",
    Reason.UNWRAP_RISK: "of no certain fringe or stripe",
    Reason.BORDER: "on borders of cells or stripes",
    Reason.OUT_OF_STEP: "out of step",
    Reason.MOVED: "moved",
    Reason.FILTERED: "filtered",
}
_REMEDIES = {
    Reason.SHADOW: "raise the exposure, open the lens or move nearer",
    Reason.CLIPPED: "lower the exposure or the gain, or close the lens",
    Reason.LOW_MODULATION: "raise the exposure, focus projector and camera, or take lower frequencies",
    Reason.UNWRAP_RISK: "look at the order of the frames (fringed audit), correct the projector's gamma "
    "(precorrection), or take fewer or denser frequencies",
    Reason.BORDER: "focus projector and camera, or take fewer bits",
}


def raise_if_empty(decoded: Decoded) -> None:
    """Raise where no pixel at all has a value: an empty cloud is no success.

    Raises:
        DecodeError: with the reasons that dominate, what the decoder warned of, and what to do about the first of them.
    """
    if decoded.reason.size == 0 or (decoded.reason == Reason.VALUE).any():
        return
    counts = np.bincount(decoded.reason.reshape(-1), minlength=len(Reason))
    lit = counts.copy()
    lit[Reason.SHADOW] = 0
    order = [Reason(int(i)) for i in np.argsort(-lit if lit.any() else -counts, kind="stable")]
    first = order[0]
    named = ", ".join(f"{counts[r]:,} {_IN_WORDS[r]}" for r in sorted(_IN_WORDS, key=lambda r: -counts[r]) if counts[r])
    remedy = _REMEDIES.get(first, "look at the order of the frames with fringed audit, and capture again")
    if any(said.startswith(OVEREXPOSED) for said in decoded.warnings):
        remedy = ""  # it says what to do, and how much
    raise DecodeError(
        f"no pixel could be decoded although the scene is lit: of {int(counts.sum()):,} pixels {named}",
        hint="; ".join(filter(None, [*decoded.warnings, remedy])),
    )
