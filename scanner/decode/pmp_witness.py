"""What the frames of a PMP capture say about their own order: frames out of step, and how noisy phases really are.

Two witnesses, both judged over a sample of the whole image. Within a set of four shifts or more, the residual of the
fit: a projector's response bends every frame of a set in the same way, frame n as frame 0 at a phase alpha_n further
on; what differs from that is a swapped, doubled or foreign frame. Between sets, the remainder of each unwrapping step:
its mean is zero where all sets are in step, and its spread is the true phase noise. A set of three shifts has no
residual, and a rotation of all sets may leave no remainder: sentinels and order bars speak there, not this file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from scanner.decode.unwrapping import Ladder
from scanner.errors import SyncError
from scanner.patterns.pmp import FringeSet

MAX_DISORDER = 0.06
"""Residual that is not the response's, rms over B. Two neighbours of 16 shifts exchanged leave .1; flicker of one
frame by 5 % leaves .03."""

MAX_OFFSET_CYCLES = 0.05
"""Mean remainder over the whole image. One frame of step moves a set of N shifts by 1 / N; response errors average out."""

MIN_NOISE_SCALE, MAX_NOISE_SCALE = 0.3, 4.0
"""How far the remainders may move the noise model: a noise model measured in the same capture is not raised at all,
because what a remainder has beyond it is systematic."""

MIN_PIXELS = 400
"""Fewer bright pixels than this are no witness."""

_MIN_PIXELS_A_BIN = 12
_NOISE_BINS = 8
_SPREAD_LIMIT = 0.15
"""Above this predicted sigma (cycles) the mean of a remainder is not known well enough to accuse a frame."""


@dataclass(frozen=True)
class SetWitness:
    """One set's frames against a sinusoid. disorder: rms over B of what no response explains; None: not to be seen."""

    fringe_set: FringeSet
    positions: tuple[int, ...]
    modulation: float
    residual: float
    """rms over B, response and noise included; 0 for three frames"""
    disorder: float | None
    suspects: tuple[int, ...]
    """positions of the frames that hold most of the disorder"""

    def describe(self) -> dict[str, Any]:
        """Plain data for the report."""
        return {
            "axis": self.fringe_set.axis,
            "frequency": self.fringe_set.frequency,
            "shifts": self.fringe_set.shifts,
            "frames": list(self.positions),
            "modulation": self.modulation,
            "residual": self.residual,
            "disorder": self.disorder,
        }


@dataclass(frozen=True)
class Remainder:
    """One unwrapping step over the whole image."""

    low: float
    high: float
    """frequencies of its two rungs, cycles over the projector"""
    expected_sigma: float
    """by the noise model, cycles, median of the better half of the sample"""
    scale: float
    """random sigma over that of the noise model"""
    systematic: float
    """sigma of what remains where noise is least, cycles of one set's phase: response, interreflection, blur"""
    offset: float
    """circular mean, cycles"""
    agreement: float
    """length of the mean vector, 1 = all pixels alike"""
    pixels: int


def set_witness(
    fringe_set: FringeSet,
    positions: Sequence[int],
    frames: NDArray[Any],
    design: NDArray[np.float64],
    clipped: NDArray[np.bool_],
) -> SetWitness:
    """Fit a sample of one set's pixels again and look at what is left, frame by frame and phase by phase.

    Args:
        positions: of the frames. frames: (N, n) samples. design: (N, 3) of the fit. clipped: (n,) saturated pixels.
    """
    samples = frames[:, ~clipped].astype(np.float32)
    found = (np.linalg.pinv(design).astype(np.float32)) @ samples
    modulation = np.hypot(found[1], found[2])
    bright = modulation > max(0.25 * float(np.quantile(modulation, 0.95)), 2.0) if modulation.size else modulation > 0
    count = len(positions)
    if count < 4 or np.count_nonzero(bright) < MIN_PIXELS:
        middle = float(np.median(modulation)) if modulation.size else 0.0
        return SetWitness(fringe_set, tuple(positions), middle, 0.0, None, ())
    b = modulation[bright]
    left = (samples[:, bright] - design.astype(np.float32) @ found[:, bright]) / b
    residual = float(np.sqrt(np.median((left**2).sum(axis=0)) / (count - 3)))
    power = None
    if count == fringe_set.shifts:
        # The fit's own axes advance by one shift a frame, whatever sign and offset: cos(theta + alpha_n).
        step = float(np.angle((design[1, 1] - 1j * design[1, 2]) / (design[0, 1] - 1j * design[0, 2])))
        theta = np.arctan2(found[2], found[1])[bright]
        power = _disorder_power(left, theta, 1 if step > 0 else -1)
    if power is None:
        return SetWitness(fringe_set, tuple(positions), float(np.median(b)), residual, None, ())
    disorder = float(np.sqrt(power.sum() / (count - 3)))
    suspects = tuple(p for p, share in zip(positions, power, strict=True) if count < 6 or share > 0.5 * power.max())
    return SetWitness(fringe_set, tuple(positions), float(np.median(b)), residual, disorder, suspects)


def check_sets(witnesses: Sequence[SetWitness]) -> None:
    """Raise SyncError naming the frames of sets whose residual no response explains."""
    guilty = [w for w in witnesses if w.disorder is not None and w.disorder > MAX_DISORDER]
    if not guilty:
        return
    frames = sorted({p for w in guilty for p in w.suspects})
    worst = max(guilty, key=lambda w: w.disorder or 0.0)
    raise SyncError(
        f"frames {', '.join(map(str, frames))} do not fit their fringe sets: frequency {worst.fringe_set.frequency:g} "
        f"along {worst.fringe_set.axis} leaves a residual of {worst.disorder:.2f} B that no response explains",
        frames=frames,
        hint="frames are swapped, doubled or late; capture again with a longer dwell or a hardware trigger",
    )


def agreement(
    ladder: Ladder,
    phases: NDArray[np.float32],
    cycles2: NDArray[np.float32],
    centre: float,
    floor_cycles: float,
    measured: bool,
) -> list[Remainder]:
    """How well neighbouring rungs agree, over a sample of usable pixels.

    Args:
        phases: (K, n) cycles. cycles2: (K, n) expected variance of each. centre: the field's centre, fraction of it.
        floor_cycles: least systematic sigma of a set's phase. measured: the noise model is this capture's own.
    """
    m, f = ladder.combinations.astype(np.float64), ladder.frequencies
    absolute = m[0] @ phases
    absolute -= np.rint(absolute - f[0] * centre)
    found = []
    for j in range(len(f) - 1):
        psi = m[j + 1] @ phases
        difference = f[j + 1] / f[j] * absolute - psi
        order = np.rint(difference)
        errors2 = ladder.errors[j] ** 2
        floor = (float(errors2.sum()), floor_cycles)
        found.append(_remainder(f[j], f[j + 1], difference - order, errors2 @ cycles2, floor, measured))
        absolute = psi + order
    return found


def check_agreement(
    ladder: Ladder, remainders: Sequence[Remainder], sets: Sequence[FringeSet], frames: Sequence[tuple[int, ...]]
) -> None:
    """Raise SyncError where a step's remainder is off zero over the whole image.

    sets, frames: the axis's fringe sets and the positions of their frames.
    """
    for remainder, errors in zip(remainders, ladder.errors, strict=True):
        concerned = [k for k, weight in enumerate(errors) if abs(weight) > 1e-9]
        # Sets of few shifts move by much at each step, and have larger response errors: half a step is the line.
        limit = max(MAX_OFFSET_CYCLES, 0.5 / max(sets[k].shifts for k in concerned))
        known = remainder.pixels >= MIN_PIXELS and remainder.expected_sigma < _SPREAD_LIMIT
        if known and remainder.agreement > 0.5 and abs(remainder.offset) > limit:
            named = sorted(p for k in concerned for p in frames[k])
            raise SyncError(
                f"frequencies {remainder.low:g} and {remainder.high:g} along {sets[0].axis} disagree by "
                f"{remainder.offset:+.2f} of a fringe over the whole image: a set of frames is out of step",
                frames=named,
                hint='if the capture comes from another system, check "sign", "offset" and the order of its frames',
            )


def _remainder(
    low: float,
    high: float,
    remainder: NDArray[np.float64],
    variance: NDArray[np.float64],
    floor: tuple[float, float],
    measured: bool,
) -> Remainder:
    weight, least = floor
    if remainder.size < MIN_PIXELS:
        return Remainder(float(low), float(high), 0.0, 1.0, least, 0.0, 0.0, int(remainder.size))
    bins = np.array_split(np.argsort(variance), _NOISE_BINS)
    x = np.array([np.median(variance[b]) for b in bins])
    y = np.array([_sigma_of_median(float(np.median(np.abs(remainder[b])))) ** 2 for b in bins])
    scale2, rest = _line(x, y, upper=1.0 if measured else MAX_NOISE_SCALE**2)
    better = np.concatenate(bins[: _NOISE_BINS // 2])
    vector = np.exp(2j * np.pi * remainder[better]).mean()
    return Remainder(
        float(low),
        float(high),
        float(np.sqrt(np.median(variance[better]))),
        float(np.sqrt(scale2)),
        max(float(np.sqrt(rest / weight)), least),
        float(np.angle(vector) / (2 * np.pi)),
        float(np.abs(vector)),
        int(remainder.size),
    )


def _line(x: NDArray[np.float64], y: NDArray[np.float64], upper: float) -> tuple[float, float]:
    # y = slope x + rest, slope within bounds, rest not negative, weights 1 / y: a variance's error grows with it.
    w = 1 / np.maximum(y, 1e-12)
    slope = float(np.polyfit(x, y, 1, w=w)[0]) if np.ptp(x) > 1e-3 * x.mean() else upper
    through_zero = float(np.sum(w**2 * x * y) / np.sum(w**2 * x * x))
    slope = float(np.clip(min(slope, through_zero), MIN_NOISE_SCALE**2, upper))
    return slope, max(float(np.average(y - slope * x, weights=w)), 0.0)


def _sigma_of_median(median: float) -> float:
    # Sigma of a normal error folded into +-1/2 whose absolute value has this median; an even spread has 1/4.
    sigmas, medians = _folded_medians()
    return median / 0.6745 if median < medians[0] else float(np.interp(median, medians, sigmas))


@cache
def _folded_medians() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    sigmas = np.linspace(0.05, 0.5, 46)
    x = np.linspace(0, 0.5, 2001)
    folds = np.arange(-3, 4)[:, None]
    medians = []
    for sigma in sigmas:
        inside = (ndtr((x + folds) / sigma) - ndtr((-x + folds) / sigma)).sum(axis=0)
        medians.append(float(np.interp(0.5, inside, x)))
    return sigmas, np.maximum.accumulate(np.array(medians))


def _disorder_power(
    left: NDArray[np.float32], theta: NDArray[np.float32], direction: int
) -> NDArray[np.float64] | None:
    # Mean residual by frame and phase bin; bins a whole number to a shift, so that frame n at bin k shows the same
    # part of the response as frame 0 at bin k + n * bins / N. What is left after the mean over such is disorder.
    count = len(left)
    per_shift = max(1, -(-8 // count))
    bins = count * per_shift
    index = np.minimum((theta / (2 * np.pi) % 1.0 * bins).astype(np.intp), bins - 1)
    members = np.bincount(index, minlength=bins)
    if members.min() < _MIN_PIXELS_A_BIN:
        return None
    means = np.stack([np.bincount(index, weights=row, minlength=bins) for row in left]) / members
    spread = np.stack([np.bincount(index, weights=row * row, minlength=bins) for row in left]) / members - means**2
    aligned = np.stack([np.roll(row, direction * n * per_shift) for n, row in enumerate(means)])
    differing = aligned - aligned.mean(axis=0)
    # The means carry the noise of their members: its expectation is taken off, so that only what all share accuses.
    noise = (spread / members).mean(axis=1)
    return np.asarray(np.maximum((differing**2).mean(axis=1) - 2 * noise, 0))
