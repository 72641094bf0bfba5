"""Several decodings of one still scene to one: the weighted mean of each pixel, and how well they agreed.

A sequence that was captured R times is decoded R times, and what came out is averaged here: any method can be
repeated, and the scatter between the repetitions is a measurement of the random error that owes nothing to the
decoder's own belief in it. Systematic errors (calibration, gamma) are the same each time and stay. Nothing here
follows motion: a scene that moves comes out blurred, and the report says so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.special import stdtrit

from scanner.decode import Decoded, Map, Reason
from scanner.decode.field_end import keep_pull

Axes = ("rows", "columns")

UNSTEADY = 2.0
"""Scatter between repetitions above twice the stated sigma is no longer that sigma's own uncertainty (half of the
sigma at R = 2, JCGM 100:2008 table E.1, and the median over an image is far better known): something else moved."""

CONTRADICTING = 5.0
"""Scatter of one pixel above so many times its stated sigma is no noise either: of normal noise a pixel of two million
has it at R = 2, and fewer with more repetitions."""

COVERED = 0.97725
"""Of normal errors, those below two sigmas"""

CLASSES, FEWEST_OF_CLASS = 10, 100
"""Of pixels, by stated sigma, that say whether scatter grows with it; and how many each must have, for a median that is
good to a fifth at R = 2."""


class Repetitions:
    """The mean of the decodings given so far. It keeps sums, not the decodings: memory does not grow with R."""

    def __init__(self, expected: int, ambiguity_px: float | None, *, quantised: bool = False) -> None:
        """Begin with none.

        Args:
            expected: how often the sequence was captured.
            ambiguity_px: projector px by which a value of the wrong fringe or stripe is off; None if there is none.
            quantised: the decodings' sigma is that of rounding to the cells of a code, the same in each of them:
                repetition does not make it smaller.
        """
        self._expected = expected
        self._quantised = quantised
        self._half = np.float32(np.inf if ambiguity_px is None else ambiguity_px / 2)
        self._first: Decoded | None = None
        self._count = 0
        self._sums: dict[str, _AxisSums] = {}
        self._confidence: Map
        self._albedo: Map
        self._modulation: Map
        self._valid: NDArray[np.uint16]
        self._reason: NDArray[np.uint8]
        self._warnings: dict[str, None] = {}

    @property
    def count(self) -> int:
        """Decodings added so far."""
        return self._count

    def add(self, decoded: Decoded) -> None:
        """Take one repetition's maps, (H, W); they are kept if they are the first, else not."""
        self._count += 1
        self._warnings.update(dict.fromkeys(decoded.warnings))
        if self._first is None:
            self._first = decoded
            if self._expected == 1:
                return
            self._begin(decoded)
        valid = decoded.reason == Reason.VALUE
        self._valid += valid
        self._reason[~valid] = decoded.reason[~valid]
        self._confidence += np.where(valid, decoded.confidence, np.float32(0))
        self._albedo += decoded.albedo
        self._modulation += decoded.modulation
        for axis, sums in self._sums.items():
            sums.add(getattr(decoded, axis), getattr(decoded, f"sigma_{axis}"), self._half)

    def result(self) -> Decoded:
        """The mean.

        A pixel has a value where more than half of the repetitions gave one, none of them a fringe or stripe away
        from the others; its sigma is that of the weighted mean (of rounding: that of one), widened by what the
        repetitions scatter beyond what they state where that is no noise: of the image, if the ratio is above UNSTEADY,
        by what is alike in all pixels and by what grows with their sigmas (`Scatter`); of the pixel, if its own ratio
        (Birge 1932, Phys. Rev. 40, 207) is above CONTRADICTING. Peaks and stripes are those of the first repetition.

        Raises:
            ValueError: nothing was added.
        """
        if self._first is None:
            raise ValueError("no repetition was added")
        if self._expected == 1:
            return self._first
        n = np.float32(self._count)
        enough = self._valid * 2 > self._count
        torn = np.zeros_like(enough)
        for sums in self._sums.values():
            torn |= sums.conflict
        keep = enough & ~torn
        reason = np.where(keep, np.uint8(Reason.VALUE), np.where(enough, np.uint8(Reason.UNWRAP_RISK), self._reason))
        found = {axis: sums.scatter(keep) for axis, sums in self._sums.items()}
        means = {
            axis: sums.mean(keep, quantised=self._quantised, unsteady=_unsteady(found[axis]))
            for axis, sums in self._sums.items()
        }
        for axis, name in (("y", "rows"), ("x", "columns")):
            if name in means and (end := self._first.details.get("field_end", {}).get(axis)):
                keep_pull(*means[name], self._sums[name].count, end)
        rows, sigma_rows = means.get("rows", (None, None))
        columns, sigma_columns = means.get("columns", (None, None))
        return replace(
            self._first,
            rows=rows,
            columns=columns,
            sigma_rows=sigma_rows,
            sigma_columns=sigma_columns,
            confidence=np.where(keep, self._confidence / np.maximum(self._valid, 1), np.float32(0)).astype(np.float32),
            albedo=self._albedo / n,
            modulation=self._modulation / n,
            reason=reason.astype(np.uint8),
            warnings=(*self._warnings, *_warnings(found)),
            details={**self._first.details, **self._details(found, int(np.count_nonzero(torn & enough)))},
        )

    def _begin(self, first: Decoded) -> None:
        shape = first.reason.shape
        self._confidence, self._albedo, self._modulation = (np.zeros(shape, np.float32) for _ in range(3))
        self._valid = np.zeros(shape, np.uint16)
        self._reason = np.full(shape, Reason.SHADOW, np.uint8)
        self._sums = {axis: _AxisSums(shape) for axis in Axes if getattr(first, axis) is not None}

    def _details(self, found: Mapping[str, Scatter | None], torn: int) -> dict[str, Any]:
        axes = {axis: None if scatter is None else scatter.as_dict() for axis, scatter in found.items()}
        return {"repetitions": {"captured": self._expected, "decoded": self._count, "contradicting": torn, **axes}}


@dataclass(frozen=True)
class Scatter:
    """How repetitions of one axis agreed: medians over the pixels that all of them gave, px.

    What one repetition scatters has two parts: `common_px`, alike in all pixels, as where the scene moved, and `factor`
    (1 at least) times what each pixel states, as where noise is more than believed. Noisy pixels have no more of the
    former than others. It comes once per repetition: R of them tell it with R - 1 freedoms, however many the pixels.
    """

    measured_px: float
    """standard deviation of one repetition, from the repetitions themselves"""
    stated_px: float
    """the decoder's own sigma of one repetition"""
    common_px: float
    factor: float

    @property
    def ratio(self) -> float:
        """Measured over stated: 1 where the decoder knows its noise."""
        return self.measured_px / self.stated_px if self.stated_px > 0 else float("inf")

    def as_dict(self) -> dict[str, float]:
        """For report.json."""
        return {
            "measured_px": self.measured_px,
            "stated_px": self.stated_px,
            "ratio": self.ratio,
            "common_px": self.common_px,
            "factor": self.factor,
        }


class _AxisSums:
    """Sums of one axis, about the first value each pixel had: differences are small, so float32 holds them."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.origin = np.full(shape, np.nan, np.float32)
        self.weight, self.weighted, self.plain, self.squares = (np.zeros(shape, np.float32) for _ in range(4))
        self.count = np.zeros(shape, np.uint16)
        self.conflict = np.zeros(shape, np.bool_)

    def add(self, values: Map, sigmas: Map | None, half: np.float32) -> None:
        begins = np.isnan(self.origin)
        self.origin[begins] = values[begins]
        apart = values - self.origin
        far = np.abs(apart) > half
        self.conflict |= far
        use = ~np.isnan(apart) & ~far
        apart = np.where(use, apart, np.float32(0))
        weight = use.astype(np.float32)
        if sigmas is not None:
            weight[use] /= np.maximum(sigmas[use], np.finfo(np.float32).tiny ** 0.25) ** 2
        self.weight += weight
        self.weighted += weight * apart
        self.plain += apart
        self.squares += apart * apart
        self.count += use

    def mean(self, keep: NDArray[np.bool_], *, quantised: bool, unsteady: Scatter | None = None) -> tuple[Map, Map]:
        """Weighted mean and its sigma, NaN where not kept; `unsteady`: by what all sigmas are widened at least."""
        here = keep & (self.weight > 0)
        values, sigmas = np.full_like(self.origin, np.nan), np.full_like(self.origin, np.nan)
        values[here] = self.origin[here] + self.weighted[here] / self.weight[here]
        stated = np.sqrt((self.count[here] if quantised else np.float32(1)) / self.weight[here])
        sigmas[here] = stated * self._widening(here)
        if unsteady is not None:
            n = self.count[here]
            common = np.float32(unsteady.common_px) * _for_few(n) / np.sqrt(n.astype(np.float32))
            wide = np.hypot(stated * np.float32(unsteady.factor), common)
            sigmas[here] = np.maximum(sigmas[here], wide)
        return values, sigmas

    def _widening(self, here: NDArray[np.bool_]) -> Map:
        """Each pixel's own scatter over its stated sigma, where it contradicts that; else 1."""
        plain, n = self.plain[here], self.count[here].astype(np.float32)
        variance = np.maximum(self.squares[here] - plain * plain / n, 0) / np.maximum(n - 1, 1)
        ratio = variance * self.weight[here] / n
        widened: Map = np.sqrt(np.where(ratio > np.float32(CONTRADICTING**2), ratio, np.float32(1)))
        return widened

    def scatter(self, keep: NDArray[np.bool_]) -> Scatter | None:
        """Of the pixels that every repetition gave; None where there is none, or one repetition only."""
        most = int(self.count.max(initial=0))
        here = keep & (self.count == most)
        if most < 2 or not here.any():
            return None
        plain, n = self.plain[here], np.float32(most)
        variance = np.maximum(self.squares[here] - plain * plain / n, 0) / (n - 1)
        # The mean of chi-square over its degrees of freedom is 1, its median is not: Wilson and Hilferty (1931).
        of_median = (1 - 2 / (9 * (most - 1))) ** 3
        stated = n / self.weight[here]
        common, factor = _parts(variance / of_median, stated)
        return Scatter(
            float(np.sqrt(np.median(variance) / of_median)), float(np.sqrt(np.median(stated))), common, factor
        )


def _parts(variance: Map, stated: Map) -> tuple[float, float]:
    """common_px and factor of `Scatter`, by the medians of classes of pixels with like stated variance.

    Args:
        variance, stated: (n,) px^2 of one repetition.
    """
    edges = np.quantile(stated, np.linspace(0, 1, max(min(CLASSES, len(stated) // FEWEST_OF_CLASS), 1) + 1))
    of = np.clip(np.searchsorted(edges, stated, side="right") - 1, 0, len(edges) - 2)
    classes = [of == k for k in range(len(edges) - 1)]
    medians = [(np.median(stated[one]), np.median(variance[one])) for one in classes if one.any()]
    believed, seen = np.array(medians, dtype=np.float64).T
    scale = np.maximum(seen, np.finfo(np.float64).tiny ** 0.5)
    # The noise that is stated is there in any case: what is fitted is what comes on top of it.
    terms = np.column_stack((believed, np.ones_like(believed))) / scale[:, None]
    (more, alike), _ = nnls(terms, (seen - believed) / scale)
    return float(np.sqrt(alike)), float(np.sqrt(1 + more))


def _for_few(repetitions: NDArray[np.uint16]) -> Map:
    """Student's factor over that of a normal error, for 95.45 of 100 (JCGM 100:2008, G.3): what is common to a
    repetition is told by R - 1 freedoms, and twice its sigma is to cover it. 7.0, 2.3, 1.7 for R = 2, 3, 4."""
    known = np.arange(int(repetitions.max(initial=2)) + 1)
    factors = stdtrit(np.maximum(known - 1, 1), COVERED) / stdtrit(np.inf, COVERED)
    found: Map = factors.astype(np.float32)[repetitions]
    return found


def _unsteady(scatter: Scatter | None) -> Scatter | None:
    """A scatter that is no noise as stated."""
    return scatter if scatter is not None and UNSTEADY < scatter.ratio < float("inf") else None


def _warnings(found: Mapping[str, Scatter | None]) -> list[str]:
    return [
        f"{axis}: the repetitions scatter by {scatter.measured_px:.3f} px, {scatter.ratio:.1f} times what one of them "
        "states: the scene moved or the light changed in between; sigmas and uncertainty are widened by it"
        for axis, scatter in found.items()
        if scatter is not None and scatter.ratio > UNSTEADY
    ]
