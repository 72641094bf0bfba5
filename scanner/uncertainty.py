"""The uncertainty of a scan as a budget: what each cause adds to depth, in the manner of the GUM (JCGM 100:2008).

Contributions are standard uncertainties at the scan's median depth, random or systematic. Random ones differ from point
to point and get smaller when a sequence is repeated; systematic ones are common to many points and stay. What cannot be
told is named as unknown, and is in no sum. The sigmas of single points are the decoder's; this file makes no map.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from scanner.calibration_spread import depth_spread
from scanner.decode.pmp_frames import design_matrix
from scanner.geometry import Calibration
from scanner.patterns import (
    Axis,
    CompositePattern,
    GrayPattern,
    GrayPmpPattern,
    McpPattern,
    PatternSequence,
    PmpPattern,
    ProjectorSize,
)
from scanner.patterns.sequence import Precorrection
from scanner.scan import Scan
from scanner.stated_length import StatedLength, stated_length_of

COVERAGE_FACTOR, OF_CELLS = 2.0, 0.95 * math.sqrt(3)
"""Of the expanded uncertainty: 95 % of a normal error, and of one that is anything within a cell alike (JCGM 100:2008,
G.1.3 and 4.3.7)"""

NEARLY_ALL = 0.9
"""Of the variance, from where on the sum of all causes is distributed as the one is"""

MEDIAN_OF = 20_000
"""Points of a scan that are asked"""

QUANTISATION = "quantisation"

Kind = Literal["random", "systematic"]


@dataclass(frozen=True)
class Contribution:
    """One cause. px: projector pixels, where it has any; mm: of depth. None: unknown."""

    name: str
    kind: Kind
    px: float | None
    mm: float | None
    says: str
    """what it rests on, or why it is unknown"""


@dataclass(frozen=True)
class Budget:
    """All causes, at one depth."""

    depth_mm: float
    contributions: tuple[Contribution, ...]
    spread_mm: NDArray[np.float32]
    """(n,) sigmas of points, a sample: in dark and oblique places they are many times their median"""
    stated: StatedLength | None = None
    """what the calibration's scale rests on, where its covariance is one of the contributions"""

    @property
    def within_mm(self) -> float:
        """95 of 100 points are nearer to the truth, as far as all causes are known.

        Where a code's cells measure, errors are as often anything within a cell; else they are normal, point by point.
        """
        cells = any(c.name == QUANTISATION for c in self.contributions)
        alike = [c.mm for c in self.contributions if c.kind == "systematic" and c.name != QUANTISATION]
        sigma = np.hypot(self.spread_mm.astype(np.float64), math.hypot(*(mm for mm in alike if mm is not None)))
        sigma = np.maximum(sigma, 1e-9)
        low, high = 0.0, 4 * float(sigma.max())
        for _ in range(40):
            middle = (low + high) / 2
            inside = np.minimum(middle / (math.sqrt(3) * sigma), 1) if cells else erf(middle / (math.sqrt(2) * sigma))
            low, high = (middle, high) if inside.mean() < 0.95 else (low, middle)
        return high

    @property
    def unknown(self) -> tuple[str, ...]:
        """Names of those that no sum contains."""
        return tuple(c.name for c in self.contributions if c.mm is None)

    def of(self, kind: Kind) -> float:
        """Root sum of squares of the known ones of a kind, mm."""
        return math.sqrt(sum(c.mm**2 for c in self.contributions if c.kind == kind and c.mm is not None))

    @property
    def combined_mm(self) -> float:
        """Of all known ones."""
        return math.hypot(self.of("random"), self.of("systematic"))

    @property
    def coverage_factor(self) -> float:
        """That of 95 % for the median point."""
        name, share = self.dominant or ("", 0.0)
        return OF_CELLS if name == QUANTISATION and share > NEARLY_ALL else COVERAGE_FACTOR

    @property
    def dominant(self) -> tuple[str, float] | None:
        """The largest known one of the median point, and its share of the variance; None where none is known."""
        largest = max(self.contributions, key=lambda c: c.mm or 0.0, default=None)
        if largest is None or not largest.mm:
            return None
        return largest.name, (largest.mm / self.combined_mm) ** 2

    def as_dict(self) -> dict[str, Any]:
        """For report.json."""
        dominant = self.dominant
        return {
            "depth_mm": self.depth_mm,
            "contributions": [asdict(c) for c in self.contributions],
            "random_mm": self.of("random"),
            "systematic_mm": self.of("systematic"),
            "combined_mm": self.combined_mm,
            "expanded_mm": self.coverage_factor * self.combined_mm,
            "coverage_factor": self.coverage_factor,
            "within_mm": self.within_mm,
            "dominant": None if dominant is None else {"name": dominant[0], "share": dominant[1]},
            "unknown": list(self.unknown),
            "stated_length": self._of_stated(),
        }

    def _of_stated(self) -> dict[str, float] | None:
        if self.stated is None:
            return None
        return {**asdict(self.stated), "share": self.stated.share(self.depth_mm, self.combined_mm)}


_CROSS_TALK = Contribution(
    "method", "systematic", None, None, "cross-talk of the channels: centimetres (Casey 2011, table 5.6)"
)
_PRINT = Contribution(
    "print", "systematic", None, None,
    "print on the surface pulls stripes aside, and a stripe may have a wrong name: no sigma contains either; relief "
    "between the stripes and edges are in the points' sigmas",
)  # fmt: skip
_METHODS = {CompositePattern: _CROSS_TALK, McpPattern: _PRINT}
"""What no sigma of a point contains"""


def budget_of(
    scan: Scan, calibration: Calibration, sequence: PatternSequence, mixed: float | None, repeat: int = 1
) -> Budget | None:
    """The budget of a scan.

    Args:
        mixed: largest share of a frame's exposure that another pattern may have shone in, as far as time stamps tell;
            None where they tell nothing.
        repeat: how often the sequence was captured.

    Returns:
        None for a scan without points or without sigmas.
    """
    axis: Axis = "y" if scan.columns is None or (scan.rows is not None and calibration.phase_axis == "y") else "x"
    sigma_px = scan.sigma_rows if axis == "y" else scan.sigma_columns
    if scan.xyz is None or scan.sigma_z is None or sigma_px is None:
        return None
    # Medians of some ten thousand points are as good as those of all.
    every = max(1, int(math.sqrt(scan.sigma_z.size / MEDIAN_OF)))
    depth, px, mm = scan.xyz[::every, ::every, 2], sigma_px[::every, ::every], scan.sigma_z[::every, ::every]
    known = np.isfinite(depth) & np.isfinite(mm) & (px > 0)
    if not known.any():
        return None
    noise_px, noise_mm = float(np.median(px[known])), float(np.median(mm[known]))
    per_px = float(np.median(mm[known] / px[known]))
    noise = _of_points(sequence, noise_px, noise_mm, repeat)
    fringes = _fringes(sequence)
    light = [] if fringes is None else [_response(scan, axis), _grey_levels(sequence, axis)]
    method = [says for kind, says in _METHODS.items() if isinstance(sequence.pattern, kind)]
    causes = (noise, *light, *method, _sync(sequence, mixed, axis))
    contributions = [_in_mm(cause, per_px) for cause in causes]
    contributions.insert(1, of_rig := _calibration(scan, calibration, axis))
    stated = None if of_rig.mm is None else stated_length_of(calibration.extra.get("scale"))
    return Budget(float(np.median(depth[known])), tuple(contributions), mm[known], stated)


def _of_points(sequence: PatternSequence, px: float, mm: float, repeat: int) -> Contribution:
    """What the points' own sigmas are: noise of fringes and stripes, or the cells of a code."""
    if isinstance(sequence.pattern, GrayPattern):
        # The place of a point within its cell is not measured: anywhere in it alike, and the same in each repetition.
        says = "a point is told to a cell of the code: rectangular, type B (JCGM 100:2008, 4.3.7); repetition leaves it"
        return Contribution(QUANTISATION, "systematic", px, mm, says)
    of_repeats = f", mean of {repeat} repetitions" if repeat > 1 else ""
    return Contribution("noise", "random", px, mm, f"median of the points' sigmas{of_repeats}")


def _fringes(sequence: PatternSequence) -> PmpPattern | None:
    """What coordinates are measured by, where that is fringes."""
    pattern = sequence.pattern.pmp if isinstance(sequence.pattern, GrayPmpPattern) else sequence.pattern
    return pattern if isinstance(pattern, PmpPattern) else None


def _in_mm(cause: Contribution, per_px: float) -> Contribution:
    if cause.mm is not None or cause.px is None:
        return cause
    return Contribution(cause.name, cause.kind, cause.px, cause.px * per_px, cause.says)


def _calibration(scan: Scan, calibration: Calibration, axis: Axis) -> Contribution:
    spread = depth_spread(calibration, scan, axis)
    if spread is None:
        has = calibration.extra.get("covariance") is not None
        says = f"the calibration {'has no covariance that can be read' if has else 'has no covariance'}"
        return Contribution("calibration", "systematic", None, None, says)
    verified = stated_length_of(calibration.extra.get("scale")) is not None
    unverified = "" if verified else "; its absolute scale is unverified"
    return Contribution("calibration", "systematic", None, spread, f"covariance of the calibration{unverified}")


def _response(scan: Scan, axis: Axis) -> Contribution:
    """What the frequencies of the scan contradict one another by, beyond noise."""
    decoder = scan.report.get("decoder") or {}
    ripple = ((decoder.get("unwrapping") or {}).get(axis) or {}).get("ripple")
    harmonics: Sequence[Mapping[str, Any]] = ((decoder.get("light") or {}).get(axis) or {}).get("harmonics") or ()
    finest = max(harmonics, key=lambda h: float(h["frequency"]), default=None)
    found = [float(ripple["px"])] if ripple else []
    if finest is not None and finest.get("ripple_px") is not None:
        # Where the ripple was taken off, that of the other sets says nothing any more.
        found = [*([] if finest.get("corrected") else found), float(finest["ripple_px"])]
    if not found:
        return Contribution("response", "systematic", None, None, "one frequency has nothing to contradict it")
    says = "rms by which frequencies differ beyond noise: harmonics that pass for the fringe, light among surfaces"
    return Contribution("response", "systematic", max(found), None, says)


def _grey_levels(sequence: PatternSequence, axis: Axis) -> Contribution:
    """What whole grey levels of the projected images shift the finest phase by: its own images, decoded."""
    px = grey_level_px(sequence, axis)
    return Contribution("grey levels", "systematic", px, None, "rounding of the projected images to 8 bits, unblurred")


def grey_level_px(sequence: PatternSequence, axis: Axis) -> float:
    """Rms error of the coordinate that a perfect camera would read of the finest set's images, projector px."""
    pattern = _fringes(sequence)
    if pattern is None:
        raise TypeError("grey levels of fringes")
    return _grey_level_px(pattern, sequence.projector, sequence.precorrection, axis)


@lru_cache(maxsize=8)
def _grey_level_px(
    pattern: PmpPattern, projector: ProjectorSize, correction: Precorrection | None, axis: Axis
) -> float:
    # A rig projects the same images again and again.
    finest = max((s for s in pattern.sets() if s.axis == axis), key=lambda s: s.frequency)
    along = projector.along(axis)
    lines = [_line(pattern.fringe(finest.first + n, projector), axis) for n in range(finest.shifts)]
    meant: NDArray[np.float32] = np.stack(lines).astype(np.float32)
    if correction is None:
        shown = np.rint(meant * 255) / 255
    else:
        # The light of each input value, where the correction is right: its inverse, by interpolation.
        light = np.linspace(0, 1, 1024, dtype=np.float32)
        values = correction.apply(light)
        inverse = np.array([light[values == v].mean() if (values == v).any() else np.nan for v in range(256)])
        known = np.isfinite(inverse)
        inverse = np.interp(np.arange(256), np.flatnonzero(known), inverse[known])
        shown = inverse[correction.apply(meant)]
    design = design_matrix(pattern, finest.shifts, range(finest.shifts))
    parts = [np.linalg.lstsq(design, light, rcond=None)[0] for light in (meant.astype(np.float64), shown)]
    angles = [np.arctan2(q, p) for _, p, q in parts]
    apart = np.angle(np.exp(1j * (angles[1] - angles[0])))
    return float(np.sqrt(np.mean(apart**2)) * along / finest.frequency / (2 * np.pi))


def _line(image: Any, axis: Axis) -> Any:
    return image[:, 0] if axis == "y" else image[0]


def _sync(sequence: PatternSequence, mixed: float | None, axis: Axis) -> Contribution:
    """Light of a neighbouring pattern that time stamps cannot exclude."""
    if mixed is None:
        return Contribution("sync", "systematic", None, None, "no time stamps: the frames' content alone was judged")
    if mixed == 0:
        return Contribution("sync", "systematic", 0.0, 0.0, "every frame proved to have seen its pattern alone")
    pattern = _fringes(sequence)
    if pattern is None or mixed >= 1:
        says = f"up to {mixed:.1%} of an exposure may have seen the next pattern, as far as stamps tell"
        return Contribution("sync", "systematic", None, None, says)
    # The next shift's light, in every frame alike, turns all phases by its share of a shift; anywhere up to that.
    finest = max((s for s in pattern.sets() if s.axis == axis), key=lambda s: s.frequency)
    bound = mixed / finest.shifts * sequence.projector.along(axis) / finest.frequency
    says = f"up to {mixed:.1%} of an exposure may have seen the next pattern (bound {bound:.3f} px, rectangular)"
    return Contribution("sync", "systematic", bound / math.sqrt(3), None, says)
