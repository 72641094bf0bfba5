"""Maps on the camera's grid from decided peaks: rows, what they are worth, and why there are none elsewhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Decoded, Reason
from scanner.decode.mcp import dense, stripes
from scanner.decode.mcp.decision import Decision
from scanner.decode.mcp.locate import Array, Found, Image, Stages
from scanner.decode.mcp.model import PatternModel
from scanner.decode.mcp.ranks import median

MOST_UNEVEN = 0.4
"""Pitches by which a cut stripe's valleys may lie nearer or further apart: keystone changes the pitch by a fifth to
either side, and an edge takes as much again."""


def maps_of(image: Image, found: Found, decided: Decision, model: PatternModel, clock: Stages) -> Decoded:
    """Maps and the table of peaks.

    Args:
        image: (H, W), stripes horizontal.
        found, decided, model: as elsewhere.
        clock: takes the stages' times, and reports them.
    """
    chains = found.parts()[1]
    label, knots = _knots(found, decided, model)
    keep = label >= 0
    with clock.stage("dense rows"):
        maps = dense.interpolate(knots, (image.shape[0], image.shape[1]), found.pitch, model.pitch)
        marked = dense.stripe_map(decided.fine.y, _named(found, decided), chains, (image.shape[0], image.shape[1]))
    with clock.stage("reasons"):
        reason = _reasons(found, decided, maps.rows)
    x = chains.column[keep] * float(stripes.STEP) + 1.5
    peak_table = np.stack([x, knots.y, knots.row, knots.stripe, knots.confidence], axis=1).astype(np.float32)
    warnings = []
    if not len(peak_table):
        warnings.append("no stripe could be decided: carriers are there, but too weak or too short")
    figures = {
        **decided.figures,
        "peaks_kept": len(peak_table),
        "stages_ms": {k: round(v, 2) for k, v in clock.ms.items()},
    }
    return Decoded(
        rows=maps.rows,
        columns=None,
        sigma_rows=maps.sigma,
        sigma_columns=None,
        confidence=maps.confidence,
        albedo=maps.albedo,
        modulation=maps.modulation,
        reason=reason,
        stripes=marked,
        peaks=peak_table,
        warnings=tuple(warnings),
        details=figures,
    )


def fill_rows(found: Found, decided: Decision, model: PatternModel, rows: Array) -> None:
    """`maps_of`'s rows alone, into `rows`: (H, W) float32, NaN where undecided."""
    _, knots = _knots(found, decided, model)
    dense.rows_alone(knots, found.pitch, model.pitch, rows)


def _knots(found: Found, decided: Decision, model: PatternModel) -> tuple[NDArray[np.int32], dense.Knots]:
    """Stripe of each peak that is kept, -1 of the others (P,) int32, and the kept ones."""
    peaks, chains, _, _ = found.parts()
    keep = (decided.label >= 0) & (decided.fine.whole > 0) & (peaks.clear > 0)
    label = np.where(keep, decided.label, -1).astype(np.int32)
    row = ((label + 0.5) * model.pitch - 0.5).astype(np.float32)
    counts = np.bincount(chains.column[keep], minlength=len(peaks.start) - 1)
    slope = model.pitch / found.pitch
    return label, dense.Knots(
        np.concatenate(([0], np.cumsum(counts))).astype(np.int32),
        decided.fine.y[keep],
        row[keep],
        (decided.fine.sigma[keep] * slope).astype(np.float32),
        decided.confidence[keep],
        decided.light[keep],
        peaks.height[keep],
        label[keep],
    )


def _named(found: Found, decided: Decision) -> NDArray[np.int32]:
    """Stripe of each peak that has a name, -1 of the others: (P,) int32.

    A stripe that an edge cuts on one side has its name all the same; where its middle lies is not known to a fraction
    of a pixel, so that it gives no row. It is about as wide as a stripe is, or it is another one's remainder.
    """
    peaks = found.parts()[0]
    whole, clear = decided.fine.whole > 0, peaks.clear > 0
    width = (peaks.below - peaks.above) / found.pitch
    inside = (peaks.y > 0) & (peaks.y < found.reduced.shape[1] - 1)
    cut = (whole | clear) & inside & (np.abs(width - 1) < MOST_UNEVEN)
    return np.where((whole & clear) | cut, decided.label, -1).astype(np.int32)


def _reasons(found: Found, decided: Decision, rows: Array) -> NDArray[np.uint8]:
    """Why a pixel has no row: decided per column of four pixels by the nearest peak, (H, W) uint8."""
    peaks, chains, signals, _ = found.parts()
    why = np.full(len(peaks), np.uint8(Reason.BORDER))
    why[decided.label < 0] = Reason.UNWRAP_RISK
    why[signals.clipped > 0.5] = Reason.CLIPPED
    # Without a peak: dark is shadow, bright is too little modulation.
    half_lit = median(peaks.valley) + 0.5 * median(peaks.height)
    small = np.where(half_lit < found.reduced, np.uint8(Reason.LOW_MODULATION), np.uint8(Reason.SHADOW))
    dense.spread(chains.column, peaks.y, why, int(0.6 * found.pitch), small)
    reason = np.empty(rows.shape, np.uint8)
    dense.widen_reasons(small, rows, reason)
    return reason
