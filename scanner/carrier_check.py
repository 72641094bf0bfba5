"""Do the carriers along MCP's stripes run as decoded stripes and calibration say? A check on a whole scan.

A stripe's name gives its pixels a depth, the depth a projector coordinate along the stripe, and that coordinate the
phase of every carrier there. A description whose order of codes, first stripe or carriers is not the projected one
fits many images and decodes without a residual; its depths are wrong by whole stripes, and the carriers' frequencies
are not where they put them: by tenths of a per cent where all stripes are wrong alike, anywhere where names are mixed
up. Each stretch of stripe is asked at which frequency, relative to the predicted one, its carriers are strongest.
Nothing here needs the phase itself, so a calibration may be off by pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.crossings import along_stripe
from scanner.errors import DecodeError
from scanner.geometry import Array, Calibration
from scanner.patterns import McpPattern, ProjectorSize

STRETCH_PX = 256
"""Camera pixels of a stretch: 13 to 50 cycles, which resolve 2 to 8 per cent of frequency and a tenth of it in noise"""

SWEEPS = 4
"""Of taking one carrier of a stretch after the other: two that are two cycles apart in it leave each other a fifth"""

LEAST_PX = 96
"""Shorter stretches, at silhouettes, resolve too little."""

OFFSETS = np.arange(-0.12, 0.1201, 0.005)
"""Frequencies tried, relative to the predicted one"""

NEAR = 0.02
"""A right stretch is strongest this near the prediction: half its resolution at most, and what a surface may bend"""

LEAST_CORRELATION = 0.25
"""Of a stretch's light with the best wave: less is no carrier (noise of n pixels reaches 3 / sqrt(n))"""

LEAST_STRETCHES = 16

FEW_IN_ORDER = 0.7
"""Share of neighbouring stripes in order that sound scans have, rods and steps before diagonal rigs included"""

LEAST_PRESENT = 0.5
"""Share of the expected carriers that must be there at all: nine in ten are, on strong texture too"""

MOST_CONTRADICTING = 0.3
NOTICEABLE = 0.1
"""Sound scans stay at a hundredth or two; carriers that change places leave four to five tenths."""

MOST_SPREAD = 0.006
MOST_SPREAD_STRIPES = 3.0
"""1-sigma of single stretches about their median. Sound scans have .0003 to .0026 of frequency, .1 to .9 stripes; where
carriers have changed places and half of the names with them, it is .011 and more, five stripes and more"""

SURELY = 0.2
"""All stripes are this near to a whole number of stripes further on where the description is to blame; sound scans
stay within .05 of none. A calibration that is off (a tenth of a per cent of focal length does as much as half a
stripe) lands anywhere."""

MOST_SIGMA = 0.15
"""1-sigma of that number, in stripes, up to which it is believed: none is then five sigmas away"""

MEDIAN_TO_MEAN = 1.25
"""Sigma of a median relative to that of a mean, of Gaussian values"""

UNSURE = 0.3
"""Further from none than this, it is said"""


@dataclass(frozen=True)
class CarrierFit:
    """What the stretches said."""

    expected: int
    """carriers that stretches should have by their names"""
    stretches: int
    """of these, those that were strong enough to be asked"""
    contradicting: float
    """share of them whose frequency is not the predicted one"""
    offset: float
    """median of their frequencies relative to the predicted ones"""
    per_stripe: float
    """what the offset would be if all stripes were one further on"""
    sigma: float = 0.0
    """1-sigma of the median, relative frequency"""

    @property
    def stripes(self) -> float:
        """By how many stripes all together seem to be wrong."""
        return self.offset / self.per_stripe if self.per_stripe else 0.0

    @property
    def spread(self) -> float:
        """1-sigma of a single stretch, relative frequency."""
        return float(self.sigma * self.stretches**0.5 / MEDIAN_TO_MEAN)

    @property
    def sigma_stripes(self) -> float:
        """1-sigma of `stripes`."""
        return self.sigma / abs(self.per_stripe) if self.per_stripe else 0.0

    def as_dict(self) -> dict[str, float]:
        """For report.json."""
        return {
            "stretches": self.stretches,
            "contradicting": self.contradicting,
            "offset": self.offset,
            "spread": self.spread,
            "stripes": self.stripes,
            "sigma_stripes": self.sigma_stripes,
        }


def require_carriers(
    calibration: Calibration,
    pattern: McpPattern,
    projector: ProjectorSize,
    frame: NDArray[np.uint8] | NDArray[np.uint16],
    values: NDArray[np.float32],
    in_order: float = 1.0,
) -> tuple[CarrierFit | None, str | None]:
    """Check one decoded scan.

    Args:
        frame: (H, W) the pattern's frame.
        values: (H, W) float32 decoded rows (axis "y") or columns ("x"), px, NaN where there is none.
        in_order: share of neighbouring stripes that follow one another, as the decoder reports it.

    Returns:
        What was found (None: too few stretches to say), and a warning if a noticeable part contradicts, or if nothing
        can be said and few of the stripes are in order.

    Raises:
        DecodeError: most of it does.
    """
    fit = fit_carriers(calibration, pattern, projector, frame, values)
    if fit is None:
        return None, _unchecked(in_order) if np.isfinite(values).any() else None
    if fit.contradicting > MOST_CONTRADICTING:
        raise DecodeError(
            f"{_said(fit)}: the pattern description or the calibration contradicts the frame",
            hint='check the description\'s "codes" and order of "carriers", and that the calibration is this rig\'s',
        )
    if fit.spread > max(MOST_SPREAD, MOST_SPREAD_STRIPES * abs(fit.per_stripe)):
        raise DecodeError(
            f"the carriers' frequencies scatter by {fit.spread:.1%} about those of the decoded stripes: many stripes "
            "are not those that the pattern description names",
            hint='check the description\'s "codes" and order of "carriers"',
        )
    if fit.contradicting > NOTICEABLE:
        return fit, f"{_said(fit)}: wrong stripes, or a calibration that is not this rig's any more"
    whole = round(fit.stripes)
    if whole and abs(fit.stripes - whole) < SURELY and fit.sigma_stripes < MOST_SIGMA:
        raise DecodeError(
            f"the carriers fit the calibration if every stripe is {abs(whole)} {'further on' if whole > 0 else 'back'} "
            f"({fit.stripes:+.2f}): the pattern description is not what was projected",
            hint='check the description\'s "first" and where its "codes" begin',
        )
    if abs(fit.stripes) > UNSURE + 3 * fit.sigma_stripes:
        return fit, (
            f"all carriers are {fit.offset:+.2%} off, as if every stripe were {fit.stripes:+.1f} from the one decoded: "
            "the calibration is not this rig's any more, or not good to a tenth of a per cent"
        )
    return fit, None


def in_order_of(details: Mapping[str, Any]) -> float:
    """Share of neighbouring stripes in order, of a decoder's details; 1 where it does not say (Casey's says none)."""
    agreement = details.get("agreement")
    return float(agreement["order"]) if isinstance(agreement, Mapping) else 1.0


def _unchecked(in_order: float) -> str | None:
    if in_order >= FEW_IN_ORDER:
        return None
    return (
        f"of neighbouring stripes only {in_order:.0%} are in order, and too few run on for their carriers to be "
        "checked: the values may be of something else than the pattern"
    )


def _said(fit: CarrierFit) -> str:
    return f"along {fit.contradicting:.0%} of the stripes the carriers are not as stripes and calibration put them"


def fit_carriers(
    calibration: Calibration,
    pattern: McpPattern,
    projector: ProjectorSize,
    frame: NDArray[np.uint8] | NDArray[np.uint16],
    values: NDArray[np.float32],
) -> CarrierFit | None:
    """See `require_carriers`; raises nothing."""
    along_rows = pattern.axis == "y"
    lines = values if along_rows else values.T
    light = (frame if along_rows else frame.T).astype(np.float32)
    stripe, y, x = _stripe_pixels(pattern, projector, lines)
    if stripe.size < LEAST_PX * LEAST_STRETCHES:
        return None
    crossing = _along_stripe(calibration, pattern, values, y, x)
    pitch = np.float32(pattern.pitch_px(projector))
    further = _along_stripe(calibration, pattern, values + pitch, y, x)
    use = np.isfinite(crossing) & np.isfinite(further)
    stripe, y, x, crossing, further = stripe[use], y[use], x[use], crossing[use], further[use]
    stretch = stripe * (1 + lines.shape[1] // STRETCH_PX) + x // STRETCH_PX
    _, stretch, length = np.unique(stretch, return_inverse=True, return_counts=True)
    cycles = crossing / projector.along("x" if along_rows else "y")
    # Shading and print along a stripe are slower than its carriers, and would outweigh them.
    period_px = 1 / max(min(pattern.carriers) * _cycles_per_px(cycles, x, stretch), 1 / STRETCH_PX)
    even = light - cv2.blur(light, (2 * round(period_px / 2) + 1, 1))
    alternating = _alternating(even[y, x], stretch, length)
    has = [_has_carrier(pattern, stripe, bit) for bit in range(pattern.bits)]
    alone = _one_by_one(alternating, [cycles * carrier for carrier in pattern.carriers], has, stretch, length)
    found = [
        _best_offsets(alone[bit], cycles * carrier, stretch, length, has[bit])
        for bit, carrier in enumerate(pattern.carriers)
    ]
    offsets = np.concatenate([offsets for offsets, _ in found])
    expected = sum(count for _, count in found)
    if expected < LEAST_STRETCHES:
        return None
    if offsets.size < LEAST_PRESENT * expected:
        return CarrierFit(expected, int(offsets.size), 1.0, 0.0, 0.0)
    per_stripe = -_relative_slope(further, crossing, stretch, length)
    middle = float(np.median(offsets))
    # A Gaussian's sigma is 1.48 times its median deviation.
    sigma = MEDIAN_TO_MEAN * 1.48 * float(np.median(np.abs(offsets - middle))) / np.sqrt(offsets.size)
    contradicting = float(np.mean(np.abs(offsets) > NEAR))
    return CarrierFit(expected, int(offsets.size), contradicting, middle, per_stripe, float(sigma))


def _relative_slope(other: Array, crossing: Array, stretch: NDArray[np.intp], length: NDArray[np.intp]) -> float:
    """Median over stretches of how much faster `other` runs than `crossing`, relative."""
    count = len(length)
    centred = crossing - (np.bincount(stretch, crossing) / length)[stretch]
    square = np.bincount(stretch, centred * centred, count)
    slope = np.bincount(stretch, other * centred, count) / np.maximum(square, 1e-9)
    return float(np.median(slope[length >= LEAST_PX]) - 1) if (length >= LEAST_PX).any() else 0.0


def _stripe_pixels(
    pattern: McpPattern, projector: ProjectorSize, lines: NDArray[np.float32]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Pixels nearest to the middle of a modulated stripe with carriers: stripe, y, x, stripes running along x."""
    pitch = pattern.pitch_px(projector)
    steps = np.abs(np.diff(lines, axis=0, prepend=np.nan))
    half = np.nanmedian(steps) / 2 if np.isfinite(steps).any() else 0.5
    position = (lines + 0.5) / pitch
    number = np.floor(position)
    middle = np.abs(position - number - 0.5) * pitch <= half
    y, x = np.nonzero(middle)
    stripe = number[y, x].astype(np.intp)
    coded = np.array([bool(pattern.code_of(s)) for s in range(pattern.stripe_count)])
    use = (stripe >= 0) & (stripe < pattern.stripe_count)
    use[use] = coded[stripe[use]]
    return stripe[use], y[use], x[use]


def _along_stripe(
    calibration: Calibration, pattern: McpPattern, values: NDArray[np.float32], y: NDArray[np.intp], x: NDArray[np.intp]
) -> Array:
    """Projector coordinate along the stripe, px, at these pixels, by way of their depth."""
    sparse = np.full_like(values, np.nan)
    at = (y, x) if pattern.axis == "y" else (x, y)
    sparse[at] = values[at]
    found: Array = along_stripe(calibration, pattern.axis, sparse)[at]
    return found


def _cycles_per_px(cycles: Array, x: NDArray[np.intp], stretch: NDArray[np.intp]) -> float:
    """Median step of `cycles` from one camera px to the next of a stretch; 0 if there is none."""
    follow = (np.diff(x) == 1) & (np.diff(stretch) == 0)
    return float(np.median(np.abs(np.diff(cycles)[follow]))) if follow.any() else 0.0


def _alternating(light: NDArray[np.float32], stretch: NDArray[np.intp], length: NDArray[np.intp]) -> Array:
    """Light without its mean over the stretch, of unit power; 0 in stretches without any."""
    centred: Array = light - (np.bincount(stretch, light) / length)[stretch]
    power = np.sqrt(np.bincount(stretch, centred * centred))
    return centred / np.maximum(power, 1e-6)[stretch]


def _has_carrier(pattern: McpPattern, stripe: NDArray[np.intp], bit: int) -> NDArray[np.bool_]:
    has = np.array([bool((pattern.code_of(s) or 0) >> bit & 1) for s in range(pattern.stripe_count)])
    return has[stripe]


def _one_by_one(
    alternating: Array,
    cycles: list[Array],
    has: list[NDArray[np.bool_]],
    stretch: NDArray[np.intp],
    length: NDArray[np.intp],
) -> list[Array]:
    """For each carrier the light without the others that a stretch has by its name, each as it fits best.

    Of two carriers a tenth apart, as the published ones are, blur leaves the lower one stronger: in a short stretch
    both would be found where it is.
    """
    waves = [np.zeros_like(alternating) for _ in cycles]
    rest = alternating.copy()
    for _ in range(SWEEPS):
        for bit, phase in enumerate(cycles):
            turning = np.exp(2j * np.pi * phase)
            whole = rest + waves[bit]
            product = whole * turning.conj()
            real, imag = (np.bincount(stretch, part) * 2 / length for part in (product.real, product.imag))
            waves[bit] = np.where(has[bit], real[stretch] * turning.real - imag[stretch] * turning.imag, 0.0)
            rest = whole - waves[bit]
    return [rest + wave for wave in waves]


def _best_offsets(
    alternating: Array, cycles: Array, stretch: NDArray[np.intp], length: NDArray[np.intp], use: NDArray[np.bool_]
) -> tuple[Array, int]:
    """Relative frequency at which each stretch is strongest, of those strong enough; how many are long enough."""
    count = len(length)
    light, phase, where = alternating[use], cycles[use], stretch[use]
    # About the stretch's own middle: there the phase does not turn with the offset.
    middle = np.bincount(where, phase, count) / np.maximum(np.bincount(where, minlength=count), 1)
    centred = phase - middle[where]
    strength = np.empty((len(OFFSETS), count))
    for i, offset in enumerate(OFFSETS):
        wave = light * np.exp(-2j * np.pi * (phase + offset * centred))
        strength[i] = np.hypot(np.bincount(where, wave.real, count), np.bincount(where, wave.imag, count))
    # A wave of unit power over n pixels has amplitude sqrt(2 / n): correlation is strength over sqrt(n / 2).
    n = np.bincount(where, minlength=count)
    correlation = strength.max(axis=0) / np.sqrt(np.maximum(n, 1) / 2)
    asked = (n >= LEAST_PX) & (correlation > LEAST_CORRELATION)
    # The maximum of a parabola through the three strongest: a tenth of the grid's step.
    best = np.clip(strength.argmax(axis=0), 1, len(OFFSETS) - 2)
    below, at, above = (strength[best + step, np.arange(count)] for step in (-1, 0, 1))
    curvature = below - 2 * at + above
    shift = np.where(curvature < 0, (below - above) / (2 * np.where(curvature < 0, curvature, -1)), 0.0)
    strongest: Array = (OFFSETS[best] + np.clip(shift, -1, 1) * (OFFSETS[1] - OFFSETS[0]))[asked]
    return strongest, int(np.count_nonzero(n >= LEAST_PX))
