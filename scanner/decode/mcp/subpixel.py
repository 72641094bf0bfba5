"""Where a stripe's peak lies, to a fraction of a pixel.

The profile is straightened and averaged along the stripe, not along the image row, then split into its even and odd
part about the first guess. The odd part is a shift (the even part's own derivative, so a triangle, a cosine, a blurred
or a clipped top need no model: where the top is flat only the flanks speak) plus a slope of brightness; the slope is
smoothed along the stripe and taken off only as far as it is significant. What stretch of the surface adds to the odd
part follows from the distances to the neighbouring stripes.
Casey 2011, sec. 4.1, takes the brightest pixel. A shift by least squares on the signal's own derivative is Lucas and
Kanade's (1981), here with the profile's mirror image for the second signal; that edges of brightness and of depth move
such a peak, and which way, is Curless and Levoy's (1995). The slope beside the shift, and how both are kept apart, is
ours.
Such a figure averages some 28 x 0.8 pitch pixels: it is no more accurate than its neighbours are alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp import profiles
from scanner.decode.mcp.linking import Chains
from scanner.decode.mcp.stripes import Peaks
from scanner.kernel import kernel

Array = NDArray[np.float32]
Ints = NDArray[np.int32]

REACH = 0.42
"""Half the fit window in pitches: the flanks without the rounded valley."""

ROUGH = np.float32(0.1)
"""Residual of the odd part, as a share of the stripe's height, above which it is no whole stripe: a triangle cut off at
a third of its flank leaves as much."""

EDGE = 0.01
EDGE_SIGMA = np.float32(0.15)
SHADED = np.float32(0.3)
CLEARLY = np.float32(2.5)
"""A fit that is so many pitches, and so many of its own sigmas, from the peak itself, with a residual that shading does
not leave (its sigma, in the same measure), saw an edge of depth or print in its window: the peak's top, a window of a
twelfth of a pitch, saw less of it. A stripe's last places before an edge err by as much (a bust, two rigs)."""

LIFT = 0.18
"""What smoothing by a twelfth of a pitch lifts a triangle's valleys by, of the height that it leaves (.133 of .734):
the light whose slope is fitted begins below them."""

LEAN = 0.04
"""How far a slope of brightness moves a peak's top, in squared pitches: height over curvature there, of a triangle that
a Gaussian of a twelfth of a pitch has rounded (.038; with a pixel of blur before it .042 at most)."""

FEW = 4
SMOOTH = np.float32(0.01)
"""A fit to fewer samples, at the image's border, leaves no residual worth the name: such a share of the height is taken
for it, what whole stripes leave."""

NEAR_BORDER = 2 / 12
"""Pitches from the image's border up to which smoothing moves a peak: two sigmas of `stripes.find_peaks`."""

MOST_BEND = 0.3
"""Change of the pitch from one stripe to the next, in pitches, above which there is a step of depth between them."""

ALIKE = np.float32(1.7)
"""Neighbouring samples of a profile are alike: lens and projector blur by a pixel (a Gaussian of sigma s leaves one
independent sample in 2 sqrt(pi) s, three for .7 px each), so that there are a third as many."""

SIGMA_FLOOR = np.float32(0.005)
"""Error that no residual shows: the pattern's own 8 bits, px."""


@dataclass(frozen=True, eq=False)
class Fine:
    """y: (P,) float32, sub-pixel peak. sigma: (P,) float32 its 1-sigma, px. whole: (P,) uint8, 0 where the profile is
    no whole stripe: a flank cut off, or not symmetrical once shift and slope are taken away.
    """

    y: Array
    sigma: Array
    whole: NDArray[np.uint8]


def refine(reduced: Array, peaks: Peaks, chains: Chains, label: Ints, pitch: float, *, even: bool = False) -> Fine:
    """Sub-pixel positions of the peaks that have a label.

    Args:
        reduced: (B, H) float32, columns averaged by fours.
        peaks: P peaks.
        chains: their chains.
        label: (P,) int32, decoded stripe, -1 for none; averaging stops where it changes along a chain.
        pitch: mean pitch, px.
        even: brightness has no slope, as after a division by a white frame: none is fitted.
    """
    runs, ends = _runs(chains.order, chains.start, label)
    guess = _smoothed(peaks.y, runs, ends)
    led = np.zeros(len(peaks), np.bool_)
    _lead_on(guess, runs, ends, reduced.shape[1], np.float32(NEAR_BORDER * pitch), led)
    reach = max(3, int(REACH * pitch))
    count = len(peaks)
    y, sigma, whole = peaks.y.copy(), np.full(count, np.float32(0.5)), np.zeros(count, np.uint8)
    bend = _bends(guess, peaks.start, label, np.float32(pitch))
    sides = (peaks.y, peaks.above, peaks.below, peaks.valley, peaks.height)
    _refine(reduced, guess, led, *sides, bend, chains.column, runs, ends, reach, even, y, sigma, whole)
    return Fine(y, sigma, whole)


@kernel
def _runs(order: Ints, start: Ints, label: Ints) -> tuple[Ints, Ints]:
    """Peaks in chain order without unlabelled ones, and where runs of one label begin."""
    kept = np.empty(len(order), np.int32)
    ends = np.empty(len(order) + 1, np.int32)
    n, runs = 0, 0
    for c in range(len(start) - 1):
        previous = -2
        for p in range(start[c], start[c + 1]):
            k = order[p]
            if label[k] < 0:
                previous = -2
                continue
            if label[k] != previous:
                ends[runs] = n
                runs += 1
                previous = label[k]
            kept[n] = k
            n += 1
    ends[runs] = n
    return kept[:n].copy(), ends[: runs + 1].copy()


@kernel
def _smoothed(y: Array, runs: Ints, ends: Ints) -> Array:
    """Local mean of y after a local line, +- HALF_COLUMNS, shrinking at the ends so that it stays symmetrical."""
    out = y.copy()
    for r in range(len(ends) - 1):
        first, last = ends[r], ends[r + 1]
        for p in range(first, last):
            half = min(profiles.HALF_COLUMNS, p - first, last - 1 - p)
            total = np.float32(0)
            for q in range(p - half, p + half + 1):
                total += y[runs[q]]
            out[runs[p]] = total / np.float32(2 * half + 1)
    return out


@kernel
def _lead_on(guess: Array, runs: Ints, ends: Ints, size: int, side: np.float32, led: NDArray[np.bool_]) -> None:
    """Where a run nears the image's border its line further in leads on: peaks themselves are drawn to the border."""
    support = 6
    for r in range(len(ends) - 1):
        for way in range(2):
            # From the end inwards: how many are near the border, and the line through the six after them.
            begin, step = (ends[r], 1) if way == 0 else (ends[r + 1] - 1, -1)
            near, count = 0, ends[r + 1] - ends[r]
            while near < count and not side <= guess[runs[begin + step * near]] <= size - 1 - side:
                near += 1
            if near == 0 or near + support > count:
                continue
            first, second = np.float32(0), np.float32(0)
            for q in range(3):
                first += guess[runs[begin + step * (near + q)]]
                second += guess[runs[begin + step * (near + 3 + q)]]
            slope = (first - second) / np.float32(9)
            for q in range(near):
                k = runs[begin + step * q]
                guess[k] = first / np.float32(3) + slope * np.float32(near + 1 - q)
                led[k] = True


@kernel
def _room(size: int, g: np.float32, above: np.float32, below: np.float32, reach: int) -> int:
    """Samples to either side of a peak: within the image, and short of the neighbours' flanks where foreshortened."""
    near = np.float32(0.9) * min(g - above, below - g)
    return int(min(np.float32(reach), g, size - 1 - g, near))


@kernel
def _longest_run(ends: Ints) -> int:
    longest = 1
    for r in range(len(ends) - 1):
        longest = max(longest, ends[r + 1] - ends[r])
    return longest


@kernel
def _at_free_end(p: int, count: int, column: int, columns: int) -> bool:
    """Place p of a run has less than a whole window, for another cause than the image's border: an edge is near, whose
    blur and light are in the fit."""
    window = profiles.HALF_COLUMNS
    cut = p < window or p >= count - window
    return bool(cut and window <= column < columns - window)


@kernel
def _refine(
    reduced: Array,
    guess: Array,
    led: NDArray[np.bool_],
    top: Array,
    above: Array,
    below: Array,
    valley: Array,
    height: Array,
    bend: Array,
    column: Ints,
    runs: Ints,
    ends: Ints,
    reach: int,
    even: bool,
    y: Array,
    sigma: Array,
    whole: NDArray[np.uint8],
) -> None:
    longest = _longest_run(ends)
    samples, stride = 2 * reach + 1, profiles.stride_of(longest)
    profile, sums = np.empty(samples * stride, np.float32), np.empty(profiles.SUMS * stride, np.float32)
    usable, bends, used = np.empty(stride, np.float32), np.empty(stride, np.float32), np.empty(stride, np.float32)
    kappa, worth, slopes = np.empty(stride, np.float32), np.empty(stride, np.float32), np.empty(stride, np.float32)
    edge = np.float32(EDGE / REACH) * np.float32(reach)
    lean = np.float32(LEAN / REACH / REACH) * np.float32(reach * reach)
    for r in range(len(ends) - 1):
        first, count = ends[r], ends[r + 1] - ends[r]
        for p in range(count):
            k = runs[first + p]
            at = profiles.PAD + p
            usable[at] = _room(reduced.shape[1], guess[k], above[k], below[k], reach)
            bends[at] = bend[k]
            base = valley[k] - np.float32(LIFT) * height[k]
            profiles.straighten(reduced, column[k], guess[k], base, p, stride, samples, profile)
        profiles.add_up(profile, usable, bends, count, stride, reach, used, sums)
        profiles.slopes(sums, used, count, stride, kappa, worth, slopes)
        for p in range(count):
            at = profiles.PAD + p
            ss, sv, vv = sums[at], sums[at + stride], sums[at + 2 * stride]
            os, ov, oo = sums[at + 3 * stride], sums[at + 4 * stride], sums[at + 5 * stride]
            k = runs[first + p]
            if used[at] < 2 or ss <= 0:
                if led[k] and 0 <= guess[k] <= reduced.shape[1] - 1:
                    y[k], whole[k] = guess[k], 1  # its sigma stays
                continue
            slope = np.float32(0) if even else slopes[at]
            shift = (os - slope * sv) / ss
            left = (
                oo - 2 * shift * os - 2 * slope * ov + shift * shift * ss + 2 * shift * slope * sv + slope * slope * vv
            )
            rough = np.sqrt(max(left, np.float32(0)) / np.float32(max(used[at] - 2, 1)))
            if used[at] < FEW:
                rough = max(rough, SMOOTH * height[k])
            sigma[k] = ALIKE * rough / np.sqrt(ss) + SIGMA_FLOOR
            y[k] = guess[k] + shift
            # Shading moves the top, and leaves little else.
            explained = slope * lean if sigma[k] < edge * SHADED else np.float32(0)
            apart = abs(y[k] + explained - top[k])
            if used[at] >= FEW and sigma[k] > edge * EDGE_SIGMA and apart > max(edge, CLEARLY * sigma[k]):
                y[k], sigma[k] = top[k], max(sigma[k], np.float32(0.25) * apart)
            if _at_free_end(p, count, column[k], len(reduced)):
                sigma[k] = np.sqrt(sigma[k] * sigma[k] + edge * edge)
            far = abs(shift) > np.float32(0.35) * np.float32(reach)
            whole[k] = 0 if far or rough > ROUGH * height[k] else 1


@kernel
def _bends(y: Array, start: Ints, label: Ints, pitch: np.float32) -> Array:
    """How the local pitch changes at each peak, from the neighbouring stripes of its column: (P,) float32, 1 / px.

    With rows t in pitches, y = y0 + a t + c t^2 about a peak; the figure is c / a^2, so that a flank u px away lies
    (c / a^2) u^2 further than on a surface of even pitch. A stripe with one neighbour takes the neighbour's figure.
    A step of depth bends one stripe one way and the next the other: what no neighbour shows alike is no bend.
    """
    raw, bend = np.zeros(len(y), np.float32), np.zeros(len(y), np.float32)
    known = np.zeros(len(y), np.bool_)
    slight = np.float32(0.03) / pitch
    for b in range(len(start) - 1):
        for k in range(start[b] + 1, start[b + 1] - 1):
            s = label[k]
            if s < 1 or label[k - 1] != s - 1 or label[k + 1] != s + 1:
                continue
            before, after = y[k] - y[k - 1], y[k + 1] - y[k]
            if abs(after - before) < np.float32(MOST_BEND) * pitch:
                half = np.float32(0.5) * (before + after)
                raw[k] = np.float32(0.5) * (after - before) / (half * half)
                known[k] = True
        for k in range(start[b], start[b + 1]):
            above = k - 1 if k > start[b] and known[k - 1] and label[k - 1] == label[k] - 1 else -1
            below = k + 1 if k + 1 < start[b + 1] and known[k + 1] and label[k + 1] == label[k] + 1 else -1
            if known[k]:
                alike = (above >= 0 and _alike(raw[above], raw[k])) or (below >= 0 and _alike(raw[below], raw[k]))
                bend[k] = raw[k] if alike or abs(raw[k]) < slight else np.float32(0)
        for k in range(start[b], start[b + 1]):
            if label[k] < 0 or known[k]:
                continue
            if k + 1 < start[b + 1] and known[k + 1] and label[k + 1] == label[k] + 1:
                bend[k] = bend[k + 1]
            elif k > start[b] and known[k - 1] and label[k - 1] == label[k] - 1:
                bend[k] = bend[k - 1]
    return bend


@kernel
def _alike(one: np.float32, other: np.float32) -> bool:
    """Of one sign, and within a factor of three."""
    a, b = abs(one), abs(other)
    return bool(one * other > 0 and 3 * min(a, b) > max(a, b))
