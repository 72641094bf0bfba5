"""The target's sheet against what was stated of it: its nominal size, how far prints go, and one measured length.

Pictures alone do not tell how large a target is. Its scale rests on the stated length and on the nominal size, each
with its uncertainty; where these contradict each other one of them is wrong, and no residual will say so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanner.calibration.problem import SHEET, Length, Priors, Problem, State
from scanner.calibration.targets import Target
from scanner.digits import alone, rounded, with_uncertainty
from scanner.errors import CalibrationError

Array = NDArray[np.float64]

MOST_OFF = 0.05
"""Share by which a stated length may differ from the target's. "Fit to page" takes the margins off that printers cannot
print on, 3 to 5 mm a side: 3 to 5 % of an A4 page's width. Beyond, it is another paper size (Letter, 6 %), a length
between other points (one square of a row of 8 is 12 %), or another unit."""
CONTRADICTED = 3.0
"""Combined sigmas of print and length from which they contradict each other: 0.3 % of honest pairs are as far apart"""
_OTHER_GRID = "take one with more columns than rows, or ChArUco"
EXACT = 1e-6
"""Sigma of a sheet's scale below which nothing is fitted: of glass, metal, and bodies in space"""


@dataclass(frozen=True)
class Contradiction:
    """Of a stated length with the target's nominal one. off_mm: stated less nominal; sigma_mm: of that difference, of
    print and statement together; adjusted_mm: what the calibration has for it."""

    stated_mm: float
    stated_sigma_mm: float
    nominal_mm: float
    print_sigma_mm: float
    off_mm: float
    sigma_mm: float
    adjusted_mm: float
    target: Target

    @property
    def sigmas(self) -> float:
        """How many of its own sigmas the difference is."""
        return abs(self.off_mm) / self.sigma_mm

    @property
    def words(self) -> str:
        """What contradicts what, by how much, and what to do."""
        nominal, off = self.nominal_mm, self.off_mm
        stated = with_uncertainty(self.stated_mm, 2 * self.stated_sigma_mm)
        exact = self.print_sigma_mm < EXACT * nominal
        own = "taken as exact" if exact else f"+- {alone(2 * self.print_sigma_mm)} mm as prints go"
        return (
            f"the stated length, {stated} mm, contradicts the target's {nominal:g} mm ({own}; +- is k = 2): it is "
            f"{rounded(abs(off), 2)} mm ({abs(off) / nominal:.2%}) {'longer' if off > 0 else 'shorter'}, "
            f"{self.sigmas:.1f} sigmas of both together; the calibration has {rounded(self.adjusted_mm, 2)} mm there. "
            + self._what_to_do(exact)
        )

    def _what_to_do(self, exact: bool) -> str:
        if not self.target.flat:
            return "Measure again, from the first to the last point of the target's file, or correct the file"
        spacing = self.target.spacing_mm
        fits = _fitting(spacing, self.stated_mm, self.stated_sigma_mm, self.nominal_mm)
        return (
            "Measure again, from the first to the last point of the longest row, not to the edges of squares or paper; "
            f"if the printer scaled the sheet, state its spacing as it is: {fits} instead of {spacing:g}"
            + (" (and leave --rigid out if it is a print)" if exact else "")
        )


def stated_length(given: tuple[float, float] | None, target: Target) -> Length | None:
    """The length that was stated, mm and 1-sigma, checked against the target.

    Raises:
        CalibrationError: it is more than MOST_OFF off.
    """
    if given is None:
        return None
    mm, sigma = given
    nominal = target.longest_mm
    if abs(mm / nominal - 1) > MOST_OFF:
        raise CalibrationError(
            f"the stated length of {mm:g} mm does not fit the target: from the first to the last of its longest row "
            f"are {nominal:g} mm, {mm / nominal - 1:+.0%} is more than printers are off",
            hint="measure between the outermost points of the longest row, or correct the target's spacing: "
            f"{_fitting(target.spacing_mm, mm, sigma, nominal)} instead of {target.spacing_mm:g} would fit",
        )
    return Length(*target.longest, mm, max(sigma, 1e-6))


def either_row(problem: Problem, state: State) -> Length | None:
    """The stated length as it is known of a sheet that looks the same turned by a quarter: it was measured along a row
    or along a column, nobody knows which, and the sheet is not stretched alike. None where that makes no difference."""
    length = problem.length
    if length is None or not problem.target.same_when_turned or is_exact(problem.priors):
        return None
    apart = float(abs(state.sheet[0] - state.sheet[1])) * problem.target.longest_mm
    return replace(length, sigma_mm=float(np.hypot(length.sigma_mm, apart))) if apart > length.sigma_mm else None


def turned_words(problem: Problem, state: State, *, either: bool, left_out: bool) -> list[str]:
    """What to say of such a sheet. either: see `either_row`. left_out: some views contradict the others."""
    if not problem.target.same_when_turned or is_exact(problem.priors):
        return []
    grid, advice = f"{_square(problem.target)} looks the same turned by a quarter", _OTHER_GRID
    if either:
        return [
            f"{grid}, and this sheet is stretched by {abs(state.sheet[0] - state.sheet[1]):.2%} more one way than the "
            "other: along which of them the length was measured no picture tells, and the scale is as unsure as that: "
            f"{advice}"
        ]
    if left_out:
        held = "views in which it was held another way up than in the others contradict these"
        return [f"{grid}: {held}. Hold it one way, or {advice}"]
    return []


def measured_words(target: Target) -> list[str]:
    """The same of a length that is measured between its ends."""
    if not target.same_when_turned:
        return []
    return [
        f"{_square(target)} looks the same turned by a quarter: whether the row that was measured is the one whose "
        f"length was stated no picture tells. Hold it as it was measured, or {_OTHER_GRID}"
    ]


def _square(target: Target) -> str:
    return f"a target of {target.columns} x {target.rows}"


def contradiction(problem: Problem, state: State) -> Contradiction | None:
    """Where stated length and nominal size are farther apart than their uncertainties explain; None where not.

    Scale x and y of the sheet are independent, each with the prior's sigma p, so that a row (a, b) has
    p sqrt(a^4 + b^4) / |(a, b)|: p times its length along an axis.
    """
    length = problem.length
    if length is None:
        return None
    across = problem.target.points[length.last] - problem.target.points[length.first]
    nominal = float(np.linalg.norm(across))
    of_print = _print_sigma(problem.priors, across)
    sigma = float(np.hypot(of_print, length.sigma_mm))
    if abs(length.mm - nominal) < CONTRADICTED * sigma:
        return None
    return Contradiction(
        length.mm,
        length.sigma_mm,
        nominal,
        of_print,
        length.mm - nominal,
        sigma,
        float(np.linalg.norm(across * (state.sheet[0], state.sheet[1], 1.0))),
        problem.target,
    )


def adjusted_length(problem: Problem, state: State, covariance: Array) -> tuple[float, float] | None:
    """The stated row's length on the adjusted sheet, mm, and its 1-sigma (NaN: unknown); None without a statement."""
    length = problem.length
    if length is None:
        return None
    across = problem.target.points[length.last] - problem.target.points[length.first]
    scaled = across * (state.sheet[0], state.sheet[1], 1.0)
    mm = float(np.linalg.norm(scaled))
    slopes = scaled[:2] * across[:2] / mm
    part = covariance[SHEET, SHEET][:2, :2]
    variance = float(slopes @ part @ slopes)
    return mm, float(np.sqrt(max(variance, 0.0))) if np.isfinite(variance) else float("nan")


def is_exact(priors: Priors) -> bool:
    """Whether no stretch and no bend are fitted."""
    return priors.sheet_scale < EXACT


def _fitting(spacing: float, stated: float, sigma: float, nominal: float) -> str:
    """The spacing that a stated length makes, mm, with what that length is unsure by."""
    return f"{with_uncertainty(spacing * stated / nominal, 2 * spacing * sigma / nominal)} mm (k = 2)"


def _print_sigma(priors: Priors, across: Array) -> float:
    return float(priors.sheet_scale * np.sqrt(np.sum(across[:2] ** 4)) / np.linalg.norm(across))
