"""Coherent emissions: carriers compared with the phases that each stripe would give them on a calibrated rig.

A stripe's name and the camera ray are a point, the point has a projector coordinate along the stripe, and that
coordinate the phase of every carrier (`scanner.crossings`). Where `emissions` asks how strong a carrier is, in any
phase, here it must be there in the right one: what print and shading add in quadrature counts against it, and a code
that belongs to another stripe has another phase as well. No phase is believed before the frame's own clear stripes
have shown that calibration and image agree, but for a common offset that changes slowly over the image; where they do
not, the amplitudes alone decide, as without a calibration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.crossings import GRID_PX, Crossings
from scanner.decode.mcp.emissions import OUTLIER, SPREAD, Amplitudes, Waves
from scanner.decode.mcp.exponentials import log_of
from scanner.decode.mcp.model import PatternModel
from scanner.decode.mcp.ranks import median
from scanner.kernel import contracting_kernel, kernel

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

SURE = 0.9
"""Posterior from which on a stripe's phases may tell the offset."""

LEAST_WITNESSES = 24
"""Carriers that must tell the offset: three unknowns, and a spread to be believed."""

MOST_ASKED = 250
"""Carriers that are asked for it."""

FURTHEST_PX = 4.0
"""Offsets tried, projector px: calibrations that are further off are to be made anew, not mended."""

MOST_SPREAD = 0.6
"""Median deviation of the phases from their offset, radians, up to which they are believed. Phases of nothing have
pi / 2; on simulated scenes, strong texture included, it is below .1."""

LEAST_SPREAD = 0.1
"""1-sigma of a phase, radians, at least: what a surface bends within a window, and the pixels of a rounded peak."""


CLEAR = 0.99
"""Posterior by amplitudes alone from which on a peak is not asked for its phases: they would say the same, in twice
the time."""

WHOLE = 0.5
"""Share of a window, which is 1.5 beats of the two nearest carriers, that is long enough for phases. In less carriers
are not parted: one leaks into another's place with a phase of its own (on a bust with the published carriers all of
eleven new wrong names were of shorter pieces)."""


@dataclass(frozen=True)
class Alignment:
    """How far the carriers' phases are from where the calibration puts them: offset + x by_x + y by_y, projector px, of
    pixels x, y. spread: 1-sigma of what is left, radians. witnesses: carriers asked. holds: phases may be believed.
    """

    offset: float
    by_x: float
    by_y: float
    spread: float
    witnesses: int
    holds: bool

    def as_dict(self) -> dict[str, Any]:
        """For the report."""
        return {
            "used": self.holds,
            "offset_px": round(self.offset, 3),
            "change_px_per_1000": [round(1e3 * self.by_x, 3), round(1e3 * self.by_y, 3)],
            "spread_rad": round(self.spread, 3),
            "witnesses": self.witnesses,
        }


NONE = Alignment(0.0, 0.0, 0.0, float(np.pi), 0, False)


def align(seen: Amplitudes, posterior: Array, crossings: Crossings, model: PatternModel) -> Alignment:
    """The phases' offset from the calibration, by the stripes that their amplitudes have named for sure.

    Args:
        seen: the amplitudes of M peaks, with their waves.
        posterior: (M, S) of the columns' model.
        crossings: of the rig.
        model: the pattern's tables.
    """
    waves = _waves_of(seen)
    few = np.arange(0, len(posterior), max(1, len(posterior) // (4 * MOST_ASKED)))
    best = posterior[few].argmax(axis=1)
    sure = (posterior[few, best] >= SURE) & (model.ratio[best] > 0).any(axis=1)
    few, best = few[sure], best[sure]
    thin = max(1, len(few) * 2 // MOST_ASKED)  # a stripe has two carriers in the mean
    sure, stripe = few[::thin], best[::thin]
    x, y = waves.x[sure], waves.y[sure]
    along = _along(crossings.along, x, y, stripe)
    peak, channel = np.nonzero((model.ratio[stripe] > 0) & (seen.ratio[sure] > 4 * seen.sigma[sure]))
    known = np.isfinite(along[peak])
    peak, channel = peak[known], channel[known]
    if len(peak) < LEAST_WITNESSES:
        return NONE
    omega = 2 * np.pi * model.carriers[channel].astype(np.float64)
    wave = waves.parts[sure[peak]].reshape(len(peak), -1, 2)[np.arange(len(peak)), channel]
    phase = np.arctan2(-crossings.sense * wave[:, 1], wave[:, 0]) - omega * (along[peak] + 0.5)
    x, y = x[peak].astype(np.float64), y[peak].astype(np.float64)
    tries = np.linspace(-FURTHEST_PX, FURTHEST_PX, 33)
    # Of one carrier all phases turn alike: their sum does.
    sums = np.bincount(channel, np.cos(phase), model.channels) + 1j * np.bincount(
        channel, np.sin(phase), model.channels
    )
    turns = np.exp(-2j * np.pi * tries[:, None] * model.carriers[None, :])
    fits = (turns @ sums).real
    solution = np.array([tries[fits.argmax()], 0.0, 0.0])
    design = np.stack([np.ones(len(x)), x, y], axis=1)
    for _ in range(3):
        left = phase - omega * (design @ solution)
        left -= 2 * np.pi * np.rint(left / (2 * np.pi))
        spread = max(1.48 * median(np.abs(left)), LEAST_SPREAD / 2)
        weight = omega * omega / (1 + (left / spread) ** 2)
        ridge = 1e-9 * weight.sum() * np.eye(3)
        solution += np.linalg.solve(design.T @ (weight[:, None] * design) + ridge, design.T @ (weight * left / omega))
    left = phase - omega * (design @ solution)
    deviation = median(np.abs(left - 2 * np.pi * np.rint(left / (2 * np.pi))))
    offset, by_x, by_y = (float(v) for v in solution)
    return Alignment(offset, by_x, by_y, 1.48 * deviation, len(peak), deviation < MOST_SPREAD)


def _waves_of(seen: Amplitudes) -> Waves:
    assert seen.waves is not None  # noqa: S101  (`emissions.measure` gives them)
    return seen.waves


def _along(table: Array, x: Array, y: Array, stripe: NDArray[np.intp]) -> Array:
    """Crossings of those stripes at those pixels: (M,)."""
    i, j = (np.clip(np.floor(v / GRID_PX), 0, n - 2).astype(int) for v, n in ((x, table.shape[1]), (y, table.shape[0])))
    s, t = x / GRID_PX - i, y / GRID_PX - j
    top = table[j, i, stripe] * (1 - s) + table[j, i + 1, stripe] * s
    low = table[j + 1, i, stripe] * (1 - s) + table[j + 1, i + 1, stripe] * s
    return np.asarray(top * (1 - t) + low * t)


def settle(
    evidence: tuple[Array, Array],
    seen: Amplitudes,
    size: int,
    posterior: Array,
    phases: tuple[Crossings, Alignment],
    channels: tuple[PatternModel, Array, Array],
) -> tuple[Array, Array]:
    """Evidence in which open peaks count by their phases, others by their amplitudes.

    Args:
        evidence: (M, S) and (M,) of `emissions.log_likelihood`; left as it is.
        seen: the amplitudes of M peaks, with their waves.
        size: a whole window, px.
        posterior: (M, S) of the columns' model.
        phases: crossings of the rig, and an alignment that holds.
        channels: pattern, modulation and floor as for `log_likelihood`.
    """
    index = np.flatnonzero(_open(posterior, _waves_of(seen).length, np.float32(WHOLE * size))).astype(np.int32)
    stripes, stray = (part.copy() for part in evidence)
    (crossings, shift), (model, modulation, floor) = phases, channels
    here = log_likelihood(seen.at(index), crossings, shift, model, modulation, floor)
    stripes[index], stray[index] = here
    return stripes, stray


def log_likelihood(
    seen: Amplitudes, crossings: Crossings, shift: Alignment, model: PatternModel, modulation: Array, floor: Array
) -> tuple[Array, Array]:
    """Log-likelihood of every stripe at every peak, (M, S) float32, and of no stripe at all, (M,) float32.

    As `emissions.log_likelihood`, of the carriers' complex amplitudes: each is Student distributed about what is
    expected (6 degrees of freedom: exponent 4), more widely along the expected phase than across it, and mixed with a
    flat density over the disc of all that a carrier can be.

    Args:
        seen: the amplitudes of M peaks, with their waves.
        crossings: of the rig.
        shift: one that holds.
        model: the pattern's tables.
        modulation, floor: (N,) of each channel.
    """
    result = np.empty((len(seen.light), model.stripes), np.float32)
    stray = np.empty(len(seen.light), np.float32)
    expected = np.ascontiguousarray(model.ratio * modulation[None, :], np.float32)
    widest = np.maximum(1.5 * model.ratio.max(axis=0), 1e-3).astype(np.float32)
    plane = np.array((shift.offset + 0.5, shift.by_x, shift.by_y), np.float32)
    across = np.float32(max(shift.spread, LEAST_SPREAD))
    waves = _waves_of(seen)
    places = (waves.parts, seen.sigma, waves.x, waves.y)
    rig = (crossings.along, np.float32(crossings.across), np.float32(crossings.sense), plane)
    coded: NDArray[np.bool_] = np.asarray((expected > 0).any(axis=1))
    _evidence(*places, *rig, model.carriers, expected, coded, floor, widest, across, result, stray)
    dark = model.level == 0
    if dark.any():
        result[:, dark] += np.float32(np.log(1e-4))
    return result, stray


@kernel
def _open(posterior: Array, length: Array, least: np.float32) -> NDArray[np.bool_]:
    """Peaks whose window has that length, px, and of which no stripe is clear."""
    found = length >= least
    for k in range(len(found)):
        for s in range(posterior.shape[1]):
            if posterior[k, s] >= np.float32(CLEAR):
                found[k] = False
                break
    return found


@contracting_kernel
def _cosine(turns: np.float32) -> np.float32:
    """cos(2 pi turns), 2e-4 off at most."""
    t = turns - np.floor(turns + np.float32(0.5))
    # A quarter turn at most from a zero: sine of what is left.
    r = np.float32(0.25) - abs(t)
    a = r * r
    p = np.float32(-76.5497822935)
    p = p * a + np.float32(81.6052492761)
    p = p * a + np.float32(-41.3417022404)
    p = p * a + np.float32(6.28318530718)
    value: np.float32 = p * r
    return value


@contracting_kernel
def _evidence(
    wave: Array,
    sigma: Array,
    at_x: Array,
    at_y: Array,
    table: Array,
    width: np.float32,
    sense: np.float32,
    plane: Array,
    carriers: Array,
    expected: Array,
    coded: NDArray[np.bool_],
    floor: Array,
    widest: Array,
    across: np.float32,
    result: Array,
    stray: Array,
) -> None:
    count, channels = sigma.shape
    states = expected.shape[0]
    high, wide, _ = table.shape
    off, flat, square = np.empty(channels, np.float32), np.empty(channels, np.float32), np.empty(channels, np.float32)
    pi, one, sixth = np.float32(np.pi), np.float32(1), np.float32(1 / 6)
    for k in range(count):
        blank, nothing = one, one
        for i in range(channels):
            square[i] = sigma[k, i] * sigma[k, i] + floor[i] * floor[i]
            reach = widest[i] + np.float32(2.5) * np.sqrt(square[i])
            flat[i] = one / (pi * reach * reach)
            a, b = wave[k, 2 * i], wave[k, 2 * i + 1]
            q = one + sixth * (a * a + b * b) / square[i]
            q = q * q
            off[i] = np.float32(1 - OUTLIER) / (2 * pi * square[i] * q * q) + np.float32(OUTLIER) * flat[i]
            blank *= off[i]
            nothing *= flat[i]
        stray[k] = log_of(nothing)
        blank = log_of(blank)
        least = stray[k] + np.float32(channels) * log_of(np.float32(OUTLIER))
        gx, gy = at_x[k] / np.float32(GRID_PX), at_y[k] / np.float32(GRID_PX)
        ix, iy = min(max(int(gx), 0), wide - 2), min(max(int(gy), 0), high - 2)
        fx, fy = gx - np.float32(ix), gy - np.float32(iy)
        c00, c01, c10, c11 = (one - fx) * (one - fy), fx * (one - fy), (one - fx) * fy, fx * fy
        offset = plane[0] + plane[1] * at_x[k] + plane[2] * at_y[k]
        for s in range(states):
            if not coded[s]:
                result[k, s] = blank
                continue
            u = c00 * table[iy, ix, s] + c01 * table[iy, ix + 1, s]
            u += c10 * table[iy + 1, ix, s] + c11 * table[iy + 1, ix + 1, s]
            # Where there is no point, or a stripe's light is not projected, no stripe is.
            if not -one < u < width:
                result[k, s] = least
                continue
            u += offset
            product = one
            for i in range(channels):
                mean = expected[s, i]
                if mean == 0:
                    product *= off[i]
                    continue
                turns = carriers[i] * u
                c, d = _cosine(turns), -sense * _cosine(turns - np.float32(0.25))
                a, b = wave[k, 2 * i], wave[k, 2 * i + 1]
                along, beside = a * c + b * d - mean, b * c - a * d
                v = square[i] + np.float32(SPREAD * SPREAD) * mean * mean
                w = square[i] + across * across * mean * mean
                q = one + sixth * (along * along / v + beside * beside / w)
                q = q * q
                product *= np.float32(1 - OUTLIER) / (2 * pi * np.sqrt(v * w) * q * q) + np.float32(OUTLIER) * flat[i]
            result[k, s] = log_of(product)


def warm_up() -> None:
    """Compile what only a calibrated rig comes to."""
    one, two = np.ones(1, np.float32), np.ones((1, 2), np.float32)
    model = PatternModel(np.array([[0, 0], [0.25, 0]], np.float32), np.ones(2, np.float32), two[0], 1.0, "triangle")
    seen = Amplitudes(two, two, one, Waves(np.ones((1, 4), np.float32), one, one, one))
    rig = Crossings(np.ones((2, 2, 2), np.float32), 2, 1)
    evidence = (two.copy(), one.copy())
    settle(evidence, seen, 1, np.zeros((1, 2), np.float32), (rig, NONE), (model, two[0], two[0]))
