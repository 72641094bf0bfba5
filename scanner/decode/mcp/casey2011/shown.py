"""The stages of the reference decoder that can be looked at: names, titles, figures of the dissertation they repeat.

Without an observer nothing here is called with an image, and none is made for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp.casey2011.code_to_phase import CodeToPhase
from scanner.decode.mcp.casey2011.growth import Marks
from scanner.decode.mcp.casey2011.stripe_detection import Stripes
from scanner.decode.stages import Look, Observer, Stage

Values = NDArray[Any]

STAGES: Mapping[str, tuple[str, str, Look]] = {
    "input": ("image as captured, stripes horizontal", "fig. 5.4", Look.GREY),
    "enhanced": ("image less its hole-filtered self", "sec. 4.1, fig. 5.5", Look.SIGNED),
    "regions": ("stripe regions, enhanced image above zero", "sec. 4.1, fig. 5.6", Look.MASK),
    "stripes": ("stripe peaks", "sec. 4.1, fig. 5.7", Look.MASK),
    "slope": ("slope of the stripes at their peaks", "sec. 4.2, fig. 4.6", Look.SIGNED),
    "spectrum": ("power spectrum, four quadrants averaged", "sec. 4.3, fig. 5.8", Look.SPECTRUM),
    "bands": ("analysis by synthesis: A (captured), B (synthesised), C = A - B", "sec. 4.3, fig. 5.9", Look.CURVES),
    "channel": ("channel isolated by its band-pass, still on its carrier", "sec. 4.4, fig. 4.10", Look.SIGNED),
    "bits": ("channel above two sigma, zero crossings closed", "sec. 4.5, fig. 5.10", Look.MASK),
    "code": ("code words on the peaks", "sec. 4.1, fig. 4.1", Look.LABELS),
    "code-modal": ("code words after the modal filter", "sec. 5.4, fig. 5.11", Look.LABELS),
    "hmm": ("code words of the hidden Markov model's best paths", "sec. 5.2, 5.3, fig. 5.12", Look.LABELS),
    "hmm-modal": ("the same after the modal filter", "sec. 5.4", Look.LABELS),
    "blobs": ("the same without short pieces", "sec. 5.4", Look.LABELS),
    "growth-mask": ("where names may grow", "sec. 5.4", Look.MASK),
    "grown": ("code words after growth in both orders", "sec. 5.4", Look.LABELS),
    "all-stripes": ("stripe index + 1, modulated and unmodulated", "sec. 2.1, fig. 5.13", Look.LABELS),
    "2x-4x": ("4 index + 1 of peaks, minima (2x) and mid-levels (4x)", "sec. 2.1, fig. 5.14", Look.LABELS),
    "column": ("projector rows along the middle column", "sec. 3.7, fig. 5.15", Look.DOTS),
}
"""Title, source (Casey 2011) and look of each stage."""


class Shown:
    """Tells an observer the stages; without an observer its methods return at once."""

    def __init__(self, observer: Observer | None, remark: str = "") -> None:
        """`remark` is added to every title."""
        self._observer = observer
        self._remark = remark

    def __call__(self, name: str, values: Values, part: str = "", which: str = "") -> None:
        """Show stage `name` of STAGES.

        Args:
            name: of STAGES.
            values: as its `Look` says.
            part: name of the segment it belongs to, if there are several (sec. 4.2).
            which: number of the channel it belongs to.
        """
        if self._observer is None:
            return
        title, source, look = STAGES[name]
        full = "-".join(word for word in (name, which, part) if word)
        of = ", ".join(word for word in (which and f"channel {which}", part and f"{part} slope", self._remark) if word)
        self._observer(Stage(full, f"{title} ({of})" if of else title, f"Casey 2011, {source}", look, values))

    def on_peaks(self, name: str, value: Values, found: Stripes, elsewhere: float = 0) -> None:
        """Show values of the peaks (P,) as an image."""
        if self._observer is None:
            return
        image = np.full(found.region.shape, elsewhere, value.dtype)
        image[found.peaks.y, found.peaks.column] = value
        self(name, image)

    def marks(self, marks: Marks, phase: CodeToPhase, shape: tuple[int, ...]) -> None:
        """Show the last two stages: all marks, and their projector rows along the middle column."""
        if self._observer is None:
            return
        image = np.zeros(shape, np.int32)
        image[marks.y, marks.x] = np.rint(4 * marks.index).astype(np.int32) + 1
        self("2x-4x", image)
        middle = marks.x == shape[1] // 2
        self("column", np.stack([marks.y[middle], phase.rows(marks.index[middle])]))
