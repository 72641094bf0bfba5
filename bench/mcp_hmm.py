"""The hidden Markov model of the MCP decoder: its true rates and its constants, and whether scans should estimate them.

    python bench/mcp_hmm.py rates [--rigs casey2011,bench2026,quick] [--scenes bust,blocks] [--patterns own] [--seeds 1]
    python bench/mcp_hmm.py worth [--only MISS,STRAY,estimated] [--scenes tilt] [--options offset_mm=300] [...]

`rates`, for each scene: what really happens at its peaks (against truth), and the same as the decoded scan has it
(peaks decided with .9 and more, and strays as sure). STRAY is the share of peaks that are no stripe; the others are of
steps from one stripe to the next, on one surface and where an edge shows (EDGE_): MISS, the ratio of one more missing
stripe to none; JUMP and BACK, the probability of any one stripe further on or back; REPEAT, the share of steps to the
same stripe. At the end: all scenes together, the range from scene to scene, and the constant used.

`worth`, over all scenes: wrong peaks, right, recall and the share beyond 20 mm, with each constant at 1/4, 1/2, 2 and 4
times (probabilities: times their odds); with all of them re-estimated from the scan by a first decoding (shrunk to the
constants by a prior of so many steps as one column has, and floored); with the true rates themselves, which no estimate
can better; with the true ones of each kind alone; and with what *is* estimated from each frame, modulation and noise
floor, left as first guessed. Figures are as in mcp_accuracy.py: the change of their means over scenes, with the worst
and the best scene.
"""

from __future__ import annotations

import argparse
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any
from unittest import mock

import mcp_plain
import numpy as np
from mcp_accuracy import PATTERNS, PUBLISHED, depth_per_step, recall, take

from drivers.registry import open_camera
from scanner.clock import VirtualClock
from scanner.decode.mcp import emissions, hmm, linking
from scanner.decode.mcp.decision import DECIDED, decide
from scanner.decode.mcp.door import upright_image
from scanner.decode.mcp.locate import Stages, locate
from scanner.decode.mcp.maps import maps_of
from scanner.decode.mcp.model import PatternModel
from scanner.patterns import ProjectorSize
from scanner.patterns.mcp_choice import choose_mcp

SCENES = "board,tilt_x30,tilt_y45,sphere_board,sphere_dark,blocks,bust,textured,wedge"
MIDDLE = 0.25
"""Pitches from a stripe's middle beyond which a peak is no stripe: nearer to the valley, or where nothing is lit."""
NEAR = {"": 3, "edge ": 6}
"""Stripes too many or too few that the constants' geometric series covers before the bounds JUMP and EDGE_JUMP do."""
FLOOR = 1e-3
"""Least probability that an estimate may say: what has not been seen in one scene happens in the next."""
SPREAD_FLOOR = 0.1
"""Least spread estimated: what the published pattern's amplitudes show on a plain board."""
CONSTANTS = ("MISS", "JUMP", "EDGE_MISS", "EDGE_JUMP", "BACK", "REPEAT", "STRAY", "EDGE_SPACING", "EDGE_HEIGHT")
NO_PROBABILITIES = ("EDGE_SPACING", "EDGE_HEIGHT", "SPREAD")
OF_EMISSIONS = ("SPREAD", "OUTLIER")


@dataclass(frozen=True, eq=False)
class Case:
    """A frame, located, and the truth on its pixels, stripes horizontal."""

    name: str
    image: Any
    model: PatternModel
    found: Any
    true: Any
    lit: Any
    mm_per_row: Any


def case_of(rig, scene, pattern_name, seed, options=""):
    """One scene; None where it is refused."""
    device = f"{rig}/{scene}?seed={seed}" + (f"&{options}" if options else "")
    pattern = pattern_of(device, rig, pattern_name)
    frame, sequence, camera, truth, calibration = take(device, pattern)
    model = PatternModel.of(pattern, sequence.projector)
    image = upright_image(frame, pattern, camera)
    found = locate(image, model, camera, Stages())
    if found.fault is not None or not decide(found, model, Stages()).agreement.holds:
        print(f"{device} {pattern_name} is refused: {found.fault or 'its codes contradict the description'}")
        return None
    per_step = np.abs(depth_per_step(truth, calibration, pattern.axis))
    maps = (truth.rows, truth.lit, per_step) if pattern.axis == "y" else (truth.columns.T, truth.lit.T, per_step.T)
    return Case(f"{rig}/{scene}/{pattern_name}/{seed}", image, model, found, *map(np.ascontiguousarray, maps))


def pattern_of(device, rig, name):
    """The reference rig's own; on others the one chosen for them, or the published one as far as they show it."""
    if rig == "casey2011":
        return PATTERNS[name]
    camera = open_camera("simulated", device, {}, VirtualClock())
    calibration = camera.true_calibration()
    camera.close()
    axis = "x" if abs(calibration.translation[0]) > abs(calibration.translation[1]) else "y"
    own = choose_mcp(ProjectorSize(*calibration.projector.size), axis, calibration.camera_scale).pattern
    if name == "own":
        return own
    fine = max(own.carriers) < max(PUBLISHED.carriers)
    return replace(PUBLISHED, axis=axis, carriers=own.carriers if fine else PUBLISHED.carriers)


def figures(case):
    """Peaks, wrong ones, recall, and the share beyond 20 mm, as it is decoded now."""
    decoded = maps_of(case.image, case.found, decide(case.found, case.model, Stages()), case.model, Stages())
    at = tuple(np.rint(decoded.peaks[:, k]).astype(int) for k in (1, 0))
    error, lit = np.abs(decoded.peaks[:, 2] - case.true[at]), case.lit[at]
    wrong = ~(lit & (error < case.model.pitch / 2))
    far = (error * case.mm_per_row[at])[lit] > 20
    found = recall(decoded.stripes, case.true, case.lit, case.model.pitch, case.model.level)
    return np.array([len(error), wrong.sum(), found, far.mean() if far.size else 0])


# --- rates ----------------------------------------------------------------------------------------------------------


def true_stripes(case):
    """At each site: its stripe, -1 where the peak is none; and where columns begin and the tables between."""
    peaks, _, tracks, _, _ = case.found.parts()
    sites = linking.sites_of(peaks, tracks.links)
    column = np.repeat(np.arange(len(peaks.start) - 1), np.diff(peaks.start))[sites.index]
    at = np.clip(np.rint(peaks.y[sites.index]).astype(int), 0, case.lit.shape[0] - 1), 4 * column + 2
    place = np.where(case.lit[at], (case.true[at] + 0.5) / case.model.pitch - 0.5, np.nan)
    stripe = np.nan_to_num(np.rint(place), nan=-1).astype(int)
    good = (np.abs(place - stripe) <= MIDDLE) & (stripe >= 0) & (stripe < case.model.stripes)
    good[good] = case.model.level[stripe[good]] > 0
    gap = hmm.gaps(sites.start, peaks.y[sites.index], peaks.height[sites.index], case.found.pitch, case.model.weakest)
    return np.where(good, stripe, -1), sites.start, gap


def recorded(case):
    """Arguments and results of the last calls while a frame is decoded, by name."""
    calls = {}

    def remember(module, name):
        function = getattr(module, name)

        def call(*arguments):
            calls[name] = arguments, function(*arguments)
            return calls[name][1]

        return mock.patch.object(module, name, call)

    with (
        remember(hmm, "smooth_columns"),
        remember(hmm, "best_paths"),
        remember(emissions, "log_likelihood"),
    ):
        decide(case.found, case.model, Stages())
    return calls


def decoded_stripes(case):
    """As the decoder has them: stripe, -1 for a stray peak, -2 where it is not sure."""
    calls = recorded(case)
    (posterior, stray), path = calls["smooth_columns"][1], calls["best_paths"][1]
    sure = np.where(path >= 0, posterior[np.arange(len(path)), np.maximum(path, 0)], stray) >= DECIDED
    return np.where(sure, path, -2)


@dataclass
class Counts:
    """peaks, strays; and of each kind of step: how many, sum of stripes too many or few, jumps, backs, repeats."""

    peaks: int
    strays: int
    steps: dict[str, np.ndarray]
    stripes: int

    def rates(self, prior=0.0):
        """By the names of `hmm`; shrunk to its constants by so many steps."""
        rates = {"STRAY": share(self.strays, self.peaks, prior, hmm.STRAY)}
        for kind, prefix in (("", ""), ("edge ", "EDGE_")):
            count, off, *others = self.steps[kind]
            jumps, near = others[0], count - sum(others)
            miss, jump = getattr(hmm, f"{prefix}MISS"), getattr(hmm, f"{prefix}JUMP")
            # The mean of |d| under m^|d| is 2 m / (1 - m^2).
            mean = (off + prior * 2 * miss / (1 - miss**2)) / max(near + prior, 1)
            rates[f"{prefix}MISS"] = (np.sqrt(1 + mean**2) - 1) / mean if mean > 0 else 0.0
            rates[f"{prefix}JUMP"] = share(2 * jumps / self.stripes, count, prior, jump)
        both = self.steps[""] + self.steps["edge "]
        rates["BACK"] = share(2 * both[3] / self.stripes, both[0], prior, hmm.BACK)
        rates["REPEAT"] = share(both[4], both[0], prior, hmm.REPEAT)
        return rates


def share(part, whole, prior, usual):
    return (part + prior * usual) / max(whole + prior, 1)


def count(stripe, start, gap, stripes):
    """Count what happens from peak to peak; what is not sure (-2) ends a run of them."""
    steps = {kind: np.zeros(5) for kind in NEAR}
    for first, end in pairwise(start):
        before = -2
        for k in range(first, end):
            if stripe[k] < 0:
                before = -2 if stripe[k] == -2 else before
                continue
            if before >= 0:
                kind = "edge " if gap[k] >= hmm.MAX_GAP else ""
                step = stripe[k] - before
                off = abs(step - (gap[k] % hmm.MAX_GAP + 1))
                near = step > 0 and off <= NEAR[kind]
                steps[kind] += (1, off if near else 0, step > 0 and not near, step < 0, step == 0)
            before = stripe[k]
    return Counts(int((stripe > -2).sum()), int((stripe == -1).sum()), steps, stripes)


def print_rates(cases):
    names = ("STRAY", "MISS", "JUMP", "EDGE_MISS", "EDGE_JUMP", "BACK", "REPEAT")
    print(f"{'scene':38s}{'':8s}{'steps':>7s}{'at edges':>9s}" + "".join(f"{n:>11s}" for n in names))
    known = []
    for case in cases:
        truth, start, gap = true_stripes(case)
        for what, stripe in (("true", truth), ("decoded", decoded_stripes(case))):
            counts = count(stripe, start, gap, case.model.stripes)
            if what == "true":
                known.append(counts)
            line(case.name if what == "true" else "", what, counts, names)
    for name in names:
        rates = [counts.rates()[name] for counts in known]
        whole = Counts(
            sum(c.peaks for c in known),
            sum(c.strays for c in known),
            {kind: sum(c.steps[kind] for c in known) for kind in NEAR},
            np.mean([c.stripes for c in known]),
        ).rates()[name]
        used = getattr(hmm, name)
        print(f"{name:10s} all scenes {whole:.2g}, of scenes {min(rates):.2g} to {max(rates):.2g}; used {used:g}")


def line(name, what, counts, names):
    rates = counts.rates()
    cells = "".join(f"{rates[n]:11.2g}" for n in names)
    print(f"{name:38s}{what:8s}{counts.steps[''][0]:7.0f}{counts.steps['edge '][0]:9.0f}{cells}", flush=True)


# --- worth ----------------------------------------------------------------------------------------------------------


@contextmanager
def constants(**values):
    """Decode with other values of the model's constants, or of the emissions'."""
    stray = values.pop("STRAY", hmm.STRAY)
    shift = np.float32(np.log(stray / (1 - stray)) - np.log(hmm.STRAY / (1 - hmm.STRAY)))
    plain = any(name in OF_EMISSIONS for name in values)
    likelihoods = mcp_plain.likelihoods if plain else emissions.log_likelihood

    def shifted(*arguments):
        """STRAY stands in kernels: what is no stripe is more or less likely by as much instead."""
        evidence, none = likelihoods(*arguments)
        return np.ascontiguousarray(evidence, np.float32), np.asarray(none + shift, np.float32)

    modules = {name: emissions if name in OF_EMISSIONS else hmm for name in values}
    patches = [mock.patch.object(modules[name], name, value) for name, value in values.items()]
    hmm.transitions.cache_clear()
    try:
        for patch in patches:
            patch.start()
        with mock.patch.object(emissions, "log_likelihood", shifted):
            yield
    finally:
        for patch in patches:
            patch.stop()
        hmm.transitions.cache_clear()


def odds(probability, factor):
    """The probability whose odds are so many times as high."""
    scaled = probability / (1 - probability) * factor
    return scaled / (1 + scaled)


def floored(rates, only=()):
    least = {name: min(FLOOR, getattr(hmm, name)) for name in rates}
    return {name: max(rate, least[name]) for name, rate in rates.items() if not only or name in only}


def estimated(case):
    """From the scan itself: a first decoding, counted."""
    _, start, gap = true_stripes(case)
    counts = count(decoded_stripes(case), start, gap, case.model.stripes)
    return floored(counts.rates(prior=case.model.stripes - 1))


def estimated_spread(case):
    """SPREAD from the scan itself: of what is switched on at sure peaks, less the noise; shrunk and floored."""
    seen, model, modulation, floor = recorded(case)["log_likelihood"][0]
    stripe = decoded_stripes(case)
    own = model.ratio[np.maximum(stripe, 0)] * modulation * (stripe >= 0)[:, None]
    noise = np.hypot(seen.sigma, floor)
    # Beyond once its own size an amplitude is no spread but an outlier.
    off = (
        np.clip((seen.ratio - np.hypot(own, noise)) / np.maximum(own, 1e-6), -1, 1) ** 2 - (noise / own.clip(1e-6)) ** 2
    )
    prior, on = model.stripes - 1, own > 0
    square = (off[on].sum() + prior * emissions.SPREAD**2) / (on.sum() + prior)
    return {"SPREAD": float(np.sqrt(max(square, SPREAD_FLOOR**2)))}


def true_rates(only=()):
    return lambda case: floored(count(*true_stripes(case), case.model.stripes).rates(), only)


def print_worth(cases, only):
    base = np.array([figures(case) for case in cases])
    print(f"{len(cases)} frames as they are: {base[:, 0].sum():.0f} peaks, {base[:, 1].sum():.0f} wrong")
    print(f"{'':30s}{'wrong':>7s}   {'right, mean and range':34s}{'recall, mean and range':34s}beyond 20 mm, mean")

    def compare(what, values_of):
        runs = []
        for case in cases:
            with constants(**values_of(case)):
                runs.append(figures(case))
        report(what, np.array(runs), base)

    for name in (n for n in CONSTANTS + OF_EMISSIONS if not only or n in only):
        used = getattr(emissions if name in OF_EMISSIONS else hmm, name)
        for factor in (0.25, 0.5, 2, 4):
            value = used * factor if name in NO_PROBABILITIES else odds(used, factor)
            compare(f"{name} x {factor:g}", lambda _, name=name, value=value: {name: value})
    if only and "estimated" not in only:
        return
    compare("re-estimated from the scan", estimated)
    compare("spread re-estimated", estimated_spread)
    compare("true rates", true_rates())
    for names in (("MISS", "EDGE_MISS"), ("JUMP", "EDGE_JUMP", "BACK"), ("REPEAT",), ("STRAY",)):
        compare(f"true {', '.join(names)}", true_rates(names))
    full = mock.patch.object(emissions, "first_modulation", lambda _, model: np.ones(model.channels, np.float32))
    for what, kept, guess in (
        ("modulation as first guessed", 0, nullcontext()),
        ("modulation taken for 1", 0, full),
        ("noise floor as first guessed", 1, nullcontext()),
    ):
        with guess, mock.patch.object(emissions, "refined_modulation", first_guess(kept)):
            report(what, np.array([figures(case) for case in cases]), base)


def first_guess(kept):
    """`emissions.refined_modulation` that leaves modulation (0) or noise floor (1) at the first guess."""
    refined = emissions.refined_modulation

    def leave(seen, model, posterior, previous):
        found = list(refined(seen, model, posterior, previous))
        found[kept] = (previous, np.full(model.channels, 0.03, np.float32))[kept]
        return tuple(found)

    return leave


def report(what, runs, base):
    cells = [f"{what:30s}{runs[:, 1].sum() - base[:, 1].sum():+7.0f}"]
    for now, then in ((1 - runs[:, 1] / runs[:, 0], 1 - base[:, 1] / base[:, 0]), (runs[:, 2], base[:, 2])):
        change = now - then
        cells.append(f"{change.mean():+.5f} ({change.min():+.4f} .. {change.max():+.4f})")
    print("   ".join(cells) + f"   {(runs[:, 3] - base[:, 3]).mean():+.5f}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("rates", "worth"))
    parser.add_argument("--rigs", default="casey2011,bench2026,quick")
    parser.add_argument("--scenes", default=SCENES)
    parser.add_argument("--patterns", default="own,published")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--options", default="", help="of the simulated world, key=value&key=value")
    parser.add_argument("--only", default="", help="worth: these constants alone, or `estimated`")
    chosen = parser.parse_args()
    cases = [
        case
        for rig in chosen.rigs.split(",")
        for scene in chosen.scenes.split(",")
        for name in chosen.patterns.split(",")
        for seed in range(chosen.seeds)
        if (case := case_of(rig, scene, name, seed, chosen.options)) is not None
    ]
    if chosen.part == "rates":
        print_rates(cases)
    else:
        print_worth(cases, tuple(filter(None, chosen.only.split(","))))


if __name__ == "__main__":
    main()
