"""Which stripe each peak is: emissions, the columns' model and the evidence along the stripes, in rounds.

Not here: whether the pattern is there at all (`locate`), and what becomes of the decided peaks (`maps`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.crossings import Crossings
from scanner.decode.mcp import coherent, description, emissions, hmm, linking, magnification, stripes, subpixel
from scanner.decode.mcp.locate import Array, Found, Stages
from scanner.decode.mcp.model import PatternModel
from scanner.decode.mcp.ranks import median

ROUNDS = 2
"""Passes of columns and stripes over one another; a third changed no figure of the reference scenes by .001."""

VOTE_GAIN = 1.5
"""Worth of the neighbours along a stripe, in votes of the peak itself."""

POSTERIOR_FLOOR = 1e-4
"""No vote against a stripe counts for more than this."""

DECIDED = 0.9
"""Posterior below which a peak stays undecided."""

DECIDED_IF_WEAK = 0.99
WEAK = 0.16
"""The same where a carrier alone in its stripe would stand less than six sigmas out of what the fit left: texture and
ends of chains, of whose nine in ten three in ten are wrong (scenes of textured boards and busts)."""

MIN_CHAIN_PX = 16
"""Shorter pieces of stripe are left undecided: less than one period of a carrier, they have no code of their own."""

SWITCH_COST = 6.0
"""Natural logarithm of the odds against a change of stripe between two columns of one chain."""


MEAN_LIGHT = np.float32(5 / 6)
"""Mean of a triangle within a sixth of a pitch of its peak, as a share of its height: what light is elsewhere."""


@dataclass(frozen=True, eq=False)
class Decision:
    """label (P,) int32, -1 undecided; confidence (P,); light (P,); fine positions; figures() for the report."""

    label: NDArray[np.int32]
    confidence: Array
    light: Array
    fine: subpixel.Fine
    agreement: description.Agreement
    magnification: float
    figures: Callable[[], dict[str, Any]]


def decide(found: Found, model: PatternModel, clock: Stages, crossings: Crossings | None = None) -> Decision:
    """Tell the stripes apart.

    Args:
        found: a search without a fault.
        model: the pattern's tables.
        clock: takes the stages' times.
        crossings: of a calibrated rig.
    """
    _, _, tracks, signals, search = found.parts()
    size = magnification.window_px(model, search.scale)
    shape = (found.reduced.shape[1], found.reduced.shape[0] * stripes.STEP)
    with clock.stage("field"):
        fields = magnification.fit_fields(signals.light, tracks, model, search, size, shape)
    trials = [_decide_by(field, size, found, model, clock, crossings) for field in fields]
    # A field that is not the surface's contradicts itself from peak to peak: fewer are sure of their stripe.
    return max(trials, key=lambda trial: (trial.agreement.holds, np.count_nonzero(trial.label >= 0)))


def _decide_by(
    scale_field: Array, size: int, found: Found, model: PatternModel, clock: Stages, crossings: Crossings | None
) -> Decision:
    """Tell the stripes apart by one field of magnifications, in windows of `size` samples."""
    peaks, chains, tracks, signals, search = found.parts()
    with clock.stage("emissions"):
        seen = emissions.measure(signals.light, tracks, scale_field, model, search.scale, size)
    sites = linking.sites_of(peaks, tracks.links)
    here = seen.at(sites.index)
    modulation = emissions.first_modulation(here, model)
    floor = np.full(model.channels, 0.03, np.float32)
    tables = hmm.transitions(model.stripes)
    gap = hmm.gaps(sites.start, peaks.y[sites.index], peaks.height[sites.index], found.pitch, model.weakest)
    posterior = votes = np.zeros((len(gap), model.stripes), np.float32)
    shift = coherent.NONE
    for again in range(ROUNDS):
        if again and crossings is not None:
            with clock.stage("phases"):
                shift = coherent.align(here, posterior, crossings, model)
        with clock.stage("emissions"):
            plain, stray_log = emissions.log_likelihood(here, model, modulation, floor)
            evidence = plain
        if crossings is not None and shift.holds:
            with clock.stage("phases"):
                phases, channels = (crossings, shift), (model, modulation, floor)
                evidence, stray_log = coherent.settle((plain, stray_log), here, size, posterior, phases, channels)
        with clock.stage("columns' model"):
            known = evidence + votes if again else evidence
            posterior, _stray = hmm.smooth_columns(known, sites.start, gap, tables, stray_log)
        with clock.stage("votes"):
            logs = linking.floored_log(posterior, POSTERIOR_FLOOR)
            votes = linking.votes_along(logs, sites.chains, size / (4 * stripes.STEP), VOTE_GAIN)
            modulation, floor = emissions.refined_modulation(here, model, posterior, modulation)
    with clock.stage("columns' model"):
        path = hmm.best_paths(evidence + votes, sites.start, gap, tables, stray_log)
    with clock.stage("votes"):
        along = linking.path_along(logs, sites.chains, SWITCH_COST)
        sure = np.where(path >= 0, posterior[np.arange(len(path)), np.maximum(path, 0)], 0).astype(np.float32)
        needed = confidence_needed(here, model)
        decided = np.where((path == along) & (sure >= needed), path, -1).astype(np.int32)
        label, confidence = linking.between_sites(decided, sure, sites, tracks.links, tracks.joined)
        long_enough = tracks.chains.lengths * stripes.STEP >= MIN_CHAIN_PX
        label[tracks.links.order[~np.repeat(long_enough, tracks.links.lengths)]] = -1
        label[found.beyond] = -1
    with clock.stage("agreement"):
        agrees = description.agreement(here, plain, model, modulation, path, (sites.start, gap))
    with clock.stage("sub-pixel"):
        fine = subpixel.refine(found.reduced, peaks, chains, label, found.pitch, even=model.even)
    shift_said = None if crossings is None else shift
    figures = partial(_figures, found, size, shift_said, (modulation, floor), agrees, label)
    light = np.where(tracks.broken, MEAN_LIGHT * peaks.height, np.maximum(seen.light, 0))
    return Decision(label, confidence, light, fine, agrees, median(scale_field), figures)


def _figures(
    found: Found,
    size: int,
    shift: coherent.Alignment | None,
    channels: tuple[Array, Array],
    agrees: description.Agreement,
    label: NDArray[np.int32],
) -> dict[str, Any]:
    """For the report; live runs have none, and do without."""
    peaks, _, tracks, _, search = found.parts()
    modulation, floor = channels
    return {
        "pitch_px": round(found.pitch, 3),
        "pitch_match": round(found.match, 3),
        "noise_dn": round(found.noise, 3),
        "carrier_scale": round(search.scale, 5),
        "carrier_drift": [round(search.drift_x, 3), round(search.drift_y, 3)],
        "carrier_contrast": [round(c, 2) for c in search.contrast],
        "modulation": [round(float(m), 3) for m in modulation],
        "noise_floor": [round(float(f), 4) for f in floor],
        "window_px": size,
        **({} if shift is None else {"coherent": shift.as_dict()}),
        "agreement": {key: np.round(value, 4).tolist() for key, value in asdict(agrees).items()},
        "peaks": len(peaks),
        "joined_tracks": int(tracks.joined.sum()),
        "peaks_decided": int((label >= 0).sum()),
        "thresholds": {
            "decided": DECIDED,
            "decided_if_weak": DECIDED_IF_WEAK,
            "min_chain_px": MIN_CHAIN_PX,
            "height_share": stripes.HEIGHT_FLOOR,
        },
    }


def confidence_needed(seen: emissions.Amplitudes, model: PatternModel) -> Array:
    """Posterior below which a peak stays undecided: (P,) float32, more where its own carriers were hardly measured."""
    weakest = float(model.ratio[model.ratio > 0].min())
    mean = np.add.reduce(np.ascontiguousarray(seen.sigma.T)) / np.float32(model.channels)
    weak = mean > WEAK * weakest
    return np.where(weak, np.float32(DECIDED_IF_WEAK), np.float32(DECIDED))
