"""The projector's response from a PMP scan: how far its light is from the fringes that were meant.

Light that follows a power of what was meant gives fringes harmonics. With three shifts they cannot be told from a shift
of the fringe, and the surface gets ripples of that fringe's period; frames of several frequencies contradict one
another all the same. The exponent sought is the one under which all frames of a pixel agree best on one projector
coordinate (after Guo, He, Zhang 2004, with the coordinate common to all sets in place of a histogram), through a blur
that takes more from overtones than from fringes and is sought with it. What it finds is to be applied at projection. No
part of decoding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, minimize, minimize_scalar

from scanner.decode import decoder_for
from scanner.errors import CalibrationError
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern
from scanner.patterns.pmp import AMPLITUDE, MEAN, FringeSet
from scanner.saturation import cut_off

PIXELS = 1000
"""Decided pixels that are looked at: an exponent is good to .01 with 8-bit frames."""

LOWEST, HIGHEST = 0.3, 3.5
"""Exponents between which one is sought."""

KEPT = 0.8
"""Share of the pixels that have a say, those that fit best: edges and mixed pixels fit no response."""

BIAS = 0.01
"""Bound on the share by which fringes tell an exponent wrong where several frequencies tell blur from it: on the
simulated rigs 0.3 to 1.13 come out right to .4 %, .435 by three shifts to .8 %, on plain boards as on prints."""

PULL = 1 / 3
"""The same, of its distance from 1, where one frequency cannot tell blur, which takes more from overtones than from
fringes and draws exponents towards 1: where a fringe is seven pixels, .911 came out for .870 and 2.66 for 3."""

EDGE = 0.02
"""From either end of the search: the exponent lies beyond."""

OVERTONES = 9
"""Of a fringe, its mean among them, that light through a blur is made of; more have nothing left"""

MOST_BLUR2 = 4.0
"""Squared 1-sigma of blur, in radians of the finest fringe: of that fringe itself an eighth is left then"""

PHASES = 32
"""Of a fringe, at which residuals of all pixels are compared"""

NO_POWER = 0.0015
"""Share of the fringes' height that all pixels may leave alike: sound captures of the simulated rigs left .1 % at the
most, plain boards .05 %; eight shifts cut off at four fifths of the range .2 to .7 %, a bent table .7 to 1.5 %. Three
shifts show a third of that: the fringe itself takes the rest."""

_STEPS = 3
_TINY = 1e-9


@dataclass(frozen=True)
class Response:
    """What a projector does to light that was meant to be linear."""

    exponent: float
    """light shown = light meant ^ exponent; 1 is right"""
    sigma: float
    """1-sigma of the exponent, by the frames' noise"""
    gamma: float | None
    """precorrection to project with from now on: that of the capture times the exponent; None where it was a table"""
    ripple_px: float
    """rms of the error that this exponent has put into the capture's coordinates, projector px"""
    misfit_before: float
    misfit_after: float
    """rms of what the frames leave, share of the fringes' height: with exponent 1, and with the one found"""
    pixels: int
    blurred: bool = False
    """blur may have drawn the exponent towards 1: one frequency cannot tell"""
    unexplained: float = 0.0
    """what all pixels leave alike at the same phase, rms, share of the fringes' height"""
    cut_off: tuple[str, ...] = ()
    """that the camera cuts fringes off, in words"""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why this exponent may not be the light's."""
        if self.unexplained <= NO_POWER:
            return self.cut_off
        return (
            *self.cut_off,
            f"no exponent explains these fringes: {self.unexplained:.2%} of their height are left alike at all pixels "
            "(noise leaves less than 0.1 %), as where light follows a table, or bright light is cut off. The exponent "
            "may be off by more than is said: measure grey levels (fringed calibrate response RIG.toml), which tell "
            "any response",
        )

    @property
    def expanded(self) -> float:
        """U of the exponent, k = 2: noise, and the bound on the bias added to it (JCGM 100:2008, F.2.4.5)."""
        pull = PULL * abs(self.exponent - 1) if self.blurred else 0.0
        return 2 * self.sigma + BIAS * self.exponent + pull

    def as_dict(self) -> dict[str, Any]:
        """Plain data."""
        plain = {name: value for name, value in asdict(self).items() if name != "cut_off"}
        return {**plain, "expanded": self.expanded, "warnings": list(self.warnings)}


def response_of_frames(
    sequence: PatternSequence, camera: CameraFormat, frames: Sequence[NDArray[Any]], seed: int = 0
) -> Response:
    """The response that a PMP capture's own frames tell.

    Args:
        frames: all of the sequence, in order.
        seed: of the choice of pixels.

    Raises:
        CalibrationError: not PMP, one set of three shifts, or too few pixels decided.
        DecodeError: the frames cannot be decoded.
    """
    pattern = sequence.pattern
    if not isinstance(pattern, PmpPattern):
        raise CalibrationError(
            f"the response is told by fringes, and this is a capture of method {pattern.method}",
            hint="capture any PMP sequence: fringed scan --method pmp",
        )
    axis = pattern.axes[0]
    sets = [s for s in pattern.sets() if s.axis == axis]
    samples_each = sum(s.shifts for s in sets)
    if samples_each <= len(sets) + 2:
        raise CalibrationError(
            "one set of three shifts fits any response", hint="use two frequencies or more, or four shifts or more"
        )
    decoder = decoder_for(sequence, camera)
    for position, frame in enumerate(frames):
        decoder.add(position, frame)
    found = decoder.finish()
    coordinate = found.rows if axis == "y" else found.columns
    if coordinate is None:
        raise AssertionError("a decoder gives what its pattern has")
    decided = np.flatnonzero(np.isfinite(coordinate))
    if decided.size < 200:
        raise CalibrationError(
            f"{decided.size} pixels decided: too few to tell a response", hint="capture a plain, bright surface"
        )
    chosen = np.random.default_rng(seed).choice(decided, min(PIXELS, decided.size), replace=False)
    grey = np.stack(
        [frames[sequence.fringes[s.first + n]].reshape(-1)[chosen] for s in sets for n in range(s.shifts)], axis=1
    ).astype(np.float64)
    problem = _Problem(grey, coordinate.reshape(-1)[chosen].astype(np.float64), _angles(pattern, sets, sequence), sets)
    return replace(_solve(problem, sequence), cut_off=cut_off(frames, camera.max_value))


def _solve(problem: _Problem, sequence: PatternSequence) -> Response:
    exponent, blur2 = problem.solved()
    if not LOWEST + EDGE < exponent < HIGHEST - EDGE:
        raise CalibrationError(
            f"the exponent lies beyond {LOWEST:g} .. {HIGHEST:g}, where fringes tell it",
            hint="measure grey levels, which tell any response: fringed calibrate response RIG.toml",
        )
    here, shifted = problem.misfit(exponent, blur2)
    before, plain = problem.misfit(1.0, blur2)
    count = problem.kept * problem.freedom
    sigma = problem.spread(exponent, blur2) * float(np.sqrt(here / count)) if count else float("inf")
    away = shifted - plain
    ripple = float(np.sqrt(np.mean(np.sort(away**2)[: problem.kept])))
    share = 1 / problem.grey.shape[1] / problem.kept
    given = sequence.precorrection
    prior = 1.0 if given is None else given.gamma
    return Response(
        exponent, sigma, None if prior is None else prior * exponent, ripple,
        float(np.sqrt(before * share)), float(np.sqrt(here * share)), len(problem.grey), not problem.tells_blur,
        problem.unexplained(exponent, blur2),
    )  # fmt: skip


def _angles(
    pattern: PmpPattern, sets: Sequence[FringeSet], sequence: PatternSequence
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(F,) radians a projector pixel, and radians at coordinate 0, of every frame."""
    along = sequence.projector.along(sets[0].axis)
    rate, start = [], []
    for s in sets:
        for n in range(s.shifts):
            rate.append(2 * np.pi * s.frequency / along)
            start.append(rate[-1] * pattern.origin + pattern.sign * 2 * np.pi * n / s.shifts + pattern.offset)
    return np.array(rate), np.array(start)


class _Problem:
    """Grey levels of some pixels, to be explained by I = a + b_k light(y)^e through a blur: a, b_k and y are each
    pixel's own, e and the blur are the same for all.

    grey: (n, F). start: (n,) coordinates. angles: see `_angles`. sets: of the frames.
    """

    def __init__(
        self,
        grey: NDArray[np.float64],
        start: NDArray[np.float64],
        angles: tuple[NDArray[np.float64], NDArray[np.float64]],
        sets: Sequence[FringeSet],
    ) -> None:
        self.grey = grey
        self._start = start
        self._rate, self._offset = angles
        self._member = np.repeat(np.eye(len(sets)), [s.shifts for s in sets], axis=0)
        self.freedom = grey.shape[1] - len(sets) - 2
        self.tells_blur = len(sets) > 1
        self.kept = int(KEPT * len(grey))
        # Of light ^ 1, for every exponent: heights grow with the exponent's distance from where light varies most, and
        # shares of them would shrink with it wherever noise is most of a residual, as on the dark squares of prints.
        self._squared = np.maximum(self._heights(self._linear(start, 1.0)).mean(axis=1), 1.0) ** 2

    def solved(self) -> tuple[float, float]:
        """The exponent, and the blur's square, radians of the finest fringe."""
        first = minimize_scalar(lambda e: self.misfit(e)[0], bounds=(LOWEST, HIGHEST), method="bounded")
        if not self.tells_blur:
            return float(first.x), 0.0

        def both(given: NDArray[np.float64]) -> float:
            return self.misfit(float(given[0]), float(given[1]))[0]

        limits = Bounds([LOWEST, 0.0], [HIGHEST, MOST_BLUR2])
        best = minimize(both, [float(first.x), 0.25], method="Nelder-Mead", bounds=limits, tol=1e-4)
        return float(best.x[0]), float(best.x[1])

    def spread(self, exponent: float, blur2: float) -> float:
        """1-sigma of the exponent for a misfit of 1 each: of the misfit's curvature, by the blur, too."""
        steps = np.array([0.02, 0.02]) if self.tells_blur else np.array([0.02])
        middle, size = np.array([exponent, blur2]), len(steps)

        def at(*moves: int) -> float:
            moved = middle.copy()
            moved[:size] += np.array(moves) * steps
            return self.misfit(float(moved[0]), float(moved[1]))[0]

        units, bend = np.eye(size, dtype=int), np.empty((size, size))
        for i, j in product(range(size), repeat=2):
            alike = at(*(units[i] + units[j])) + at(*(-units[i] - units[j]))
            opposite = at(*(units[i] - units[j])) + at(*(units[j] - units[i]))
            bend[i, j] = (alike - opposite) / (4 * steps[i] * steps[j])
        variance = 2 * float(np.linalg.pinv(bend)[0, 0])
        return float(np.sqrt(variance)) if variance > 0 else float("inf")

    def misfit(self, exponent: float, blur2: float = 0.0) -> tuple[float, NDArray[np.float64]]:
        """(sum of squared residuals over squared fringe height, of the pixels that fit best; coordinates (n,))."""
        left, y = self._left(exponent, blur2)
        return float(np.sort((left**2).sum(axis=1))[: self.kept].sum()), y

    def unexplained(self, exponent: float, blur2: float) -> float:
        """Share of the fringes' height that all pixels leave alike at the same phase, rms over the phases: what light
        does that is no power. Noise, which they do not share, is taken off."""
        left, y = self._left(exponent, blur2)
        best = np.argsort((left**2).sum(axis=1))[: self.kept]
        turns = ((y[best, None] * self._rate + self._offset) / (2 * np.pi)) % 1
        phase = np.minimum((turns * PHASES).astype(np.intp), PHASES - 1).ravel()
        each = np.maximum(np.bincount(phase, minlength=PHASES), 1)
        mean = np.bincount(phase, left[best].ravel(), PHASES) / each
        noise = np.maximum(np.bincount(phase, left[best].ravel() ** 2, PHASES) / each - mean**2, 0) / each
        return float(np.sqrt(max(float(np.mean(mean**2 - noise)), 0.0)))

    def _left(self, exponent: float, blur2: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(n, F) residuals, share of the fringes' height, and (n,) coordinates that make them least."""
        y = self._start
        parameters = self._linear(y, exponent, blur2)
        for _ in range(_STEPS):
            light, slope = self._light(y, exponent, blur2)
            heights = self._heights(parameters)
            jacobian = np.concatenate([self._columns(light), (heights * slope)[:, :, None]], axis=2)
            change = _least_squares(jacobian, self.grey - parameters[:, :1] - heights * light)
            parameters = parameters + change[:, :-1]
            y = y + np.clip(change[:, -1], -5, 5)
        light, _ = self._light(y, exponent, blur2)
        left = self.grey - parameters[:, :1] - self._heights(parameters) * light
        return left / np.sqrt(self._squared)[:, None], y

    def _heights(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, F) b of each frame's set."""
        return np.asarray(parameters[:, 1:] @ self._member.T)

    def _linear(self, y: NDArray[np.float64], exponent: float, blur2: float = 0.0) -> NDArray[np.float64]:
        light, _ = self._light(y, exponent, blur2)
        return _least_squares(self._columns(light), self.grey)

    def _columns(self, light: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, F, 1 + K): what a and b_k add to each grey level."""
        return np.concatenate([np.ones((*light.shape, 1)), light[:, :, None] * self._member], axis=2)

    def _light(
        self, y: NDArray[np.float64], exponent: float, blur2: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Light and its slope by y, (n, F). blur2: squared 1-sigma of blur, radians of the finest fringe."""
        angle = y[:, None] * self._rate + self._offset
        if blur2 == 0:
            meant = MEAN + AMPLITUDE * np.cos(angle)
            slope = -AMPLITUDE * np.sin(angle) * self._rate
            return meant**exponent, exponent * meant ** (exponent - 1) * slope
        blurs2 = blur2 * (self._rate / self._rate.max()) ** 2
        overtones = _overtones(exponent)
        turn = np.exp(1j * angle)
        power, light, slope = np.ones_like(turn), np.full(angle.shape, overtones[0]), np.zeros(angle.shape)
        for m in range(1, len(overtones)):
            power = power * turn
            height = 2 * overtones[m] * np.exp(-0.5 * m * m * blurs2)
            light += height * power.real
            slope -= height * m * self._rate * power.imag
        return light, slope


def _overtones(exponent: float) -> NDArray[np.float64]:
    """Of a fringe's light: its mean, and half the heights of its first overtones."""
    angle = 2 * np.pi * np.arange(64) / 64
    return np.asarray(np.fft.rfft((MEAN + AMPLITUDE * np.cos(angle)) ** exponent).real[:OVERTONES] / 64)


def _least_squares(design: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, m) solutions of n small problems, design (n, F, m), values (n, F)."""
    normal = np.einsum("nfi,nfj->nij", design, design)
    normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(normal.shape[1])
    right = np.einsum("nfi,nf->ni", design, values)
    return np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0])
