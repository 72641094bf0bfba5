"""What witnesses look at and what they say: thumbnails as samples, and single findings. No judgement here."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.devices import Pixels
from scanner.patterns import PatternSequence
from scanner.patterns.sequence import SENTINELS_AFTER, SENTINELS_BEFORE

NOISE_SIGMAS = 5.0
"""What is called lit, or different, stands this far above the noise."""

LIT_SHARE = 0.15
"""Of the contrast that the brightest half percent reaches: what is darker is scattered light more than pattern."""

LEAST_NOISE = 12**-0.5
"""Grey levels: rounding to whole levels."""

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Witness:
    """One finding. `value` is held against `limit`; `frames` are the positions it speaks against."""

    name: str
    passed: bool
    value: float
    limit: float
    frames: tuple[int, ...] = ()
    says: str = ""
    whole: bool = False
    """the order of the whole sequence is in doubt: single retakes cannot mend it"""

    def as_dict(self) -> dict[str, Any]:
        """Plain data for capture.json."""
        return {
            "name": self.name,
            "passed": self.passed,
            "value": float(self.value),
            "limit": float(self.limit),
            "frames": list(self.frames),
            "says": self.says,
        }


@dataclass(frozen=True)
class Witnesses:
    """All findings of a capture, and what they could not have revealed."""

    items: tuple[Witness, ...] = ()
    cannot_reveal: tuple[str, ...] = ()
    dark: bool = False
    """nothing in view is lit by the projector: there is nothing to judge, nor to decode"""
    why_dark: tuple[str, str] = ("", "")
    """then: what is the matter, and what to do about it"""

    @property
    def suspects(self) -> tuple[int, ...]:
        """Positions of frames that content speaks against."""
        return tuple(sorted({frame for item in self.items if not item.passed for frame in item.frames}))

    @property
    def whole(self) -> bool:
        """Whether the order of the whole sequence is in doubt."""
        return any(item.whole and not item.passed for item in self.items)

    @property
    def passed(self) -> bool:
        """Whether nothing speaks against the plan."""
        return not self.dark and all(item.passed for item in self.items)

    def joined(self, other: Witnesses) -> Witnesses:
        """The findings of two repetitions together."""
        cannot = tuple(dict.fromkeys((*self.cannot_reveal, *other.cannot_reveal)))
        why = self.why_dark if self.dark else other.why_dark
        return Witnesses((*self.items, *other.items), cannot, self.dark or other.dark, why)

    def as_list(self) -> list[dict[str, Any]]:
        """Plain data for capture.json's `witnesses`."""
        return [item.as_dict() for item in self.items]


@dataclass(frozen=True, eq=False)
class Scene:
    """The thumbnails of one repetition as samples, and what all witnesses need to know of them."""

    sequence: PatternSequence
    frames: Mapping[int, Array]
    """by position: (P,) float32 grey levels"""
    shape: tuple[int, int]
    max_value: int
    noise: float
    """1-sigma of one sample, grey levels"""
    lit: NDArray[np.bool_]
    """(P,) pixels that the projector's light reaches"""
    contrast: float
    """what that light adds to the brightest half percent of pixels, grey levels"""

    def mean(self, position: int) -> float:
        """Mean level of a frame over the lit pixels."""
        return float(self.frames[position][self.lit].mean())

    def with_frames(self, thumbnails: Mapping[int, Pixels]) -> Scene:
        """The same scene, seen by these frames, of which it has some already."""
        return replace(self, frames=_samples(thumbnails, self.frames))


def look(sequence: PatternSequence, thumbnails: Mapping[int, Pixels], max_value: int) -> Scene | None:
    """Take the thumbnails as samples: noise, lit pixels. None if no pixel changes beyond the noise."""
    frames = _samples(thumbnails)
    shape = next(iter(thumbnails.values())).shape
    noise = _noise(sequence, frames, (int(shape[0]), int(shape[1])))
    spread = _spread(list(frames.values()))
    contrast = float(np.quantile(spread, 0.995))
    range_of_noise = _range(noise, len(frames))
    if contrast < range_of_noise + NOISE_SIGMAS * noise:
        return None
    lit = spread > max(LIT_SHARE * contrast, range_of_noise + NOISE_SIGMAS * noise / 2)
    return Scene(sequence, frames, (int(shape[0]), int(shape[1])), max_value, noise, lit, contrast)


def samples_in_noise(
    sequence: PatternSequence, thumbnails: Mapping[int, Pixels]
) -> tuple[dict[int, Array], float, float]:
    """Where `look` finds nothing: the samples by position, their noise, and the change that it would have seen."""
    frames = _samples(thumbnails)
    height, width = next(iter(thumbnails.values())).shape
    noise = _noise(sequence, frames, (int(height), int(width)))
    return frames, noise, _range(noise, len(frames)) + NOISE_SIGMAS * noise


def _range(noise: float, count: int) -> float:
    """Of some samples of noise: n normal ones range over about 2 sqrt(2 ln n) sigma."""
    return 2 * float(np.sqrt(2 * np.log(count))) * noise


def listed(frames: Iterable[int]) -> str:
    """Frame numbers in words, runs of three and more shortened: 3, 5..26."""
    runs: list[list[int]] = []
    for frame in sorted(set(frames)):
        if runs and frame == runs[-1][-1] + 1:
            runs[-1].append(frame)
        else:
            runs.append([frame])
    return ", ".join(f"{run[0]}..{run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs)


def sigma_between(a: Array, b: Array) -> float:
    """1-sigma of one sample from two frames of one picture (or how far two pictures differ, on the same scale).

    The largest twentieth of the differences, where something moved or a pixel is hot, is left out; a normal
    distribution keeps 0.871 of its rms without them. (A median would count whole grey levels.)
    """
    return float(sigmas_between(a[None], b[None])[0])


def sigmas_between(a: Array, b: Array) -> NDArray[np.float64]:
    """(K,) `sigma_between` of K pairs of frames, (K, P) each."""
    squares = np.sort((a - b) ** 2, axis=1)[:, : max(1, int(0.95 * a.shape[1]))]
    return np.asarray(np.sqrt(squares.mean(axis=1) / 2).astype(np.float64) / 0.871)


def middle(frames: Sequence[Array]) -> Array:
    """(P,) median of frames, sample by sample."""
    if len(frames) == 3:  # the middle one by comparison: a tenth of the time
        a, b, c = frames
        return np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))
    return np.asarray(np.median(np.stack(frames), axis=0), dtype=np.float32)


def equal_positions(sequence: PatternSequence) -> Iterable[tuple[float, tuple[int, ...]]]:
    """(light, positions) of the full-off and the full-on frames."""
    levels: dict[float, list[int]] = {0.0: [], 1.0: []}
    for position, level in zip(sequence.sentinels, SENTINELS_BEFORE + SENTINELS_AFTER, strict=False):
        levels[level].append(position)
    if sequence.black is not None:
        levels[0.0].append(sequence.black)
    if sequence.white is not None:
        levels[1.0].append(sequence.white)
    return [(level, tuple(sorted(positions))) for level, positions in levels.items()]


def _samples(thumbnails: Mapping[int, Pixels], known: Mapping[int, Array] | None = None) -> dict[int, Array]:
    known = known or {}
    return {p: known[p] if p in known else thumbnails[p].reshape(-1).astype(np.float32) for p in sorted(thumbnails)}


def _spread(frames: Sequence[Array]) -> Array:
    """(P,) largest minus smallest level of each sample.

    Of more than four frames the second largest minus the second smallest: one frame's outliers (a cosmic ray, a torn
    frame) light nothing.
    """
    least, most = frames[0].copy(), frames[0].copy()
    second_least, second_most = np.full_like(least, np.inf), np.full_like(most, -np.inf)
    for frame in frames[1:]:
        np.minimum(second_least, np.maximum(least, frame), out=second_least)
        np.maximum(second_most, np.minimum(most, frame), out=second_most)
        np.minimum(least, frame, out=least)
        np.maximum(most, frame, out=most)
    return second_most - second_least if len(frames) > 4 else most - least


def _noise(sequence: PatternSequence, frames: Mapping[int, Array], shape: tuple[int, int]) -> float:
    """Of the pairs of equal frames, full-on ones if there are any since they are noisier, the pair that differs least.

    A pair without any difference is one frame twice and says nothing. Planned equals may all be false, so no more is
    believed than the grain of differences between any frames shows. Never below rounding.
    """
    pairs = list(pairwise(sorted(frames)))
    pairs = pairs[:: -(-len(pairs) // 8)]
    grain = float(np.quantile([_grain(frames[a] - frames[b], shape) for a, b in pairs], 0.25))
    for _, positions in sorted(equal_positions(sequence), reverse=True):
        here = [p for p in positions if p in frames]
        found = [sigma_between(*_equally_lit(*_brighter(frames[a], frames[b]))) for a, b in combinations(here, 2)]
        if found := [sigma for sigma in found if sigma > 0]:
            return max(min([*found, max(3 * grain, LEAST_NOISE)]), LEAST_NOISE)
    return max(grain, LEAST_NOISE)


def _grain(difference: Array, shape: tuple[int, int]) -> float:
    """1-sigma of one sample of two frames, from the roughness of their difference image.

    Second differences along rows and along columns, whichever is smoother: projected stripes are smooth along one of
    them, and a texture scales with the light, which varies slowly. Median absolute value of a normal / 0.6745; a
    second difference of the difference of two frames has 12 variances.
    """
    image = difference.reshape(shape)
    rough = [_median_of_levels(np.abs(np.diff(image, 2, axis=axis))) for axis in (0, 1) if image.shape[axis] > 2]
    return min(rough, default=0.0) / 0.6745 / 12**0.5


def _median_of_levels(values: Array) -> float:
    """Median of whole grey levels, 0 or more, by counting them: so many equal values keep np.median busy."""
    upto = np.cumsum(np.bincount(values.reshape(-1).astype(np.intp)))
    middle_two = np.searchsorted(upto, ((values.size - 1) // 2, values.size // 2), side="right")
    return float(middle_two.mean())


def _brighter(a: Array, b: Array) -> tuple[Array, Array]:
    """The half of the pixels that is brighter, where there is noise to see."""
    both = a + b
    use = both >= np.median(both)
    return a[use], b[use]


def _equally_lit(a: Array, b: Array) -> tuple[Array, Array]:
    """Two frames with the lamp's drift between them taken out: 1-3 % in seconds would be more than the noise."""
    of_a, of_b = float(a.mean()), float(b.mean())
    return (a, b * np.float32(of_a / of_b)) if of_b > 0 else (a, b)
