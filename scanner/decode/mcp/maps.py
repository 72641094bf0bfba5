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

CUT = 0.5
"""Confidence in the middle of a stripe that is cut or broken up, over that in its name: it may lie millimetres off."""

ASTRAY = 0.2
"""Pitches by which the peak of what is left of a cut stripe may lie beside its middle, to be listed: half of what would
take it half way to the next stripe."""


def maps_of(image: Image, found: Found, decided: Decision, model: PatternModel, clock: Stages) -> Decoded:
    """Maps and the table of peaks.

    Args:
        image: (H, W), stripes horizontal.
        found, decided, model: as elsewhere.
        clock: takes the stages' times, and reports them.
    """
    chains = found.parts()[1]
    label, knots = _knots(found, decided, model)
    named, y = _named(found, decided, label)
    with clock.stage("dense rows"):
        maps = dense.interpolate(knots, (image.shape[0], image.shape[1]), found.pitch, model.pitch)
        marked = dense.stripe_map(y, named, chains, (image.shape[0], image.shape[1]))
    with clock.stage("reasons"):
        reason = _reasons(found, decided, maps.rows)
    listed = named.copy()
    cut = np.flatnonzero((named >= 0) & (found.parts()[0].clear == 0))
    listed[cut[~_goes_on(cut, named, decided.fine.y, chains.column, found.pitch)]] = -1
    peak_table = _peak_table(listed, y, np.where(label >= 0, 1, CUT) * decided.confidence, chains.column, model)
    warnings = []
    if not len(peak_table):
        warnings.append("no stripe could be decided: carriers are there, but too weak or too short")
    elif not np.isfinite(maps.rows).any():
        warnings.append(
            f"{len(peak_table)} peaks have a stripe's name, but none has the next stripe beside it: no values, and the "
            "names are not to be trusted"
        )
    figures = {
        **decided.figures(),
        "peaks_kept": int((label >= 0).sum()),
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
    peaks, chains, *_ = found.parts()
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


def _named(found: Found, decided: Decision, kept: NDArray[np.int32]) -> tuple[NDArray[np.int32], Array]:
    """Stripe of each peak that has a name, -1 of the others, (P,) int32, and where its middle is, (P,) float32 px.

    A stripe that an edge cuts on one side, or that print breaks up, has its name all the same; where its middle lies is
    known to a share of a pitch, so that it gives no row. It is about as wide as a stripe is, or it is another one's
    remainder. Where print breaks it up the middle is the track's.

    Args:
        found, decided: as elsewhere.
        kept: (P,) int32, stripe of the peaks that give rows.
    """
    peaks, _, tracks, _, _ = found.parts()
    whole, clear = decided.fine.whole > 0, peaks.clear > 0
    width = (peaks.below - peaks.above) / found.pitch
    inside = (peaks.y > 0) & (peaks.y < found.reduced.shape[1] - 1)
    cut = (whole | clear) & inside & (np.abs(width - 1) < MOST_UNEVEN)
    named = np.where((kept >= 0) | cut, decided.label, -1).astype(np.int32)
    # Two peaks of a broken stripe in one column are one.
    double = tracks.broken & (kept < 0) & (tracks.place != np.arange(len(named))) & (named[tracks.place] == named)
    named[double] = -1
    y = np.where(tracks.broken & (kept < 0), tracks.y[tracks.place], decided.fine.y)
    return named, np.clip(y, 0, found.reduced.shape[1] - 1).astype(np.float32)


def _goes_on(
    cut: NDArray[np.intp], named: NDArray[np.int32], y: Array, column: NDArray[np.int32], pitch: float
) -> NDArray[np.bool_]:
    """Whether those peaks, cut on one side, lie where the three stripes before or after them in their columns lead.

    An object's edge near a stripe's middle takes the middle with it: what is left has its peak elsewhere.
    """
    found = np.zeros(len(cut), np.bool_)
    for way in (1, -1):
        steps = [np.clip(cut + way * n, 0, len(y) - 1) for n in (1, 2, 3)]
        known = np.ones(len(cut), np.bool_)
        for n, k in enumerate(steps, 1):
            known &= (column[k] == column[cut]) & (named[k] == named[cut] + way * n)
        led = 3 * y[steps[0]] - 3 * y[steps[1]] + y[steps[2]]
        found |= known & (np.abs(led - y[cut]) < ASTRAY * pitch)
    return found


def _peak_table(
    named: NDArray[np.int32],
    y: Array,
    confidence: Array,
    column: NDArray[np.int32],
    model: PatternModel,
) -> Array:
    """x, y, row, stripe and confidence of the peaks that have a name: (M, 5) float32."""
    listed = named >= 0
    x = column[listed] * float(stripes.STEP) + 1.5
    row = (named[listed] + 0.5) * model.pitch - 0.5
    return np.stack([x, y[listed], row, named[listed], confidence[listed]], axis=1).astype(np.float32)


def _reasons(found: Found, decided: Decision, rows: Array) -> NDArray[np.uint8]:
    """Why a pixel has no row: decided per column of four pixels by the nearest peak, (H, W) uint8."""
    peaks, chains, _, signals, _ = found.parts()
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
