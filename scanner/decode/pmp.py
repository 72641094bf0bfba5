"""Decoding PMP: fringe sets of any frequencies and shifts to absolute projector coordinates.

Frames are taken in any order. As soon as a set is whole, one pass makes its phase and modulation and the frames'
memory serves the next set; after the last frame one pass an axis unwraps up a ladder of beats (`unwrapping`). A pixel
whose fringe order is not nearly certain, and not plain from its neighbours, stays undecided. How noisy the pixels are
is taken from the capture itself: from the residual of the fit where a set has four shifts or more, else from how well
neighbouring rungs agree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Decoded, Map, Reason
from scanner.decode.agreement import PAIR_DISTANCE, Remainder, agreement, disagreements, noise_of_pairs
from scanner.decode.frames import FrameCheck
from scanner.decode.neighbours import settle
from scanner.decode.noise import ROUNDING_VARIANCE, NoiseModel, default_noise, fit_noise
from scanner.decode.pmp_kernels import fit_set, unwrap
from scanner.decode.unwrapping import Ladder, plan_ladder
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern
from scanner.patterns.description import Axis, ProjectorSize
from scanner.patterns.pmp import FringeSet

SAMPLE = 20_000
"""Pixels from which noise and agreement of a whole scan are judged: their medians are good to 1 %."""

PRIOR_FREEDOM = 8.0
"""Weight of the scan's noise model against a pixel's own residual, in degrees of freedom (conjugate prior)."""


@dataclass(frozen=True)
class PmpThresholds:
    """When a pixel is left undecided. None of these was fitted to a scene."""

    saturation: float = 1.0
    """share of the camera's range from which a sample counts as clipped"""
    min_modulation_levels: float = 1.0
    """B in grey levels: rounding makes less than one level a matter of luck"""
    min_modulation_share: float = 0.01
    """B as a share of the scan's brightest (99th percentile): light scattered from lit surfaces stays below it"""
    min_modulation_sigmas: float = 7.0
    """B over its own noise, which is also 1 over the phase's error in radians. Seven is an error of .023 cycles: no set
    tells the fringes of one eight times as fine by that"""
    max_residual_sigmas: float = 5.0
    """rms residual over noise, and"""
    max_residual_share: float = 0.35
    """rms residual over B, both: the scene moved. Uncorrected gamma 2.2 leaves .2"""
    max_remainder_sigmas: float = 5.0
    """disagreement of neighbouring rungs over its noise: 6 of ten million pixels by noise alone"""
    min_unwrap_probability: float = 0.9999
    """probability that every fringe order is right, given how far each remainder lies from half a fringe"""
    edge_sigmas: float = 4.0
    """distance to the pattern's end within which the two ends cannot be told apart"""
    phase_floor_cycles: float = 0.001
    """phase error that no modulation removes (8-bit projection, response): 1-sigma a set, in unwrapping only"""


@dataclass
class _Set:
    """One fringe set: what has arrived, and what the fit made of it."""

    fringe_set: FringeSet
    positions: tuple[int, ...]
    have: list[int] = field(default_factory=list)
    """shifts whose frames have arrived, in order of arrival"""
    gain: float = 0.0
    """variance of (B cos, B sin) over that of one sample"""

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the fit's residual."""
        return len(self.have) - 3

    def missing(self) -> list[int]:
        """Positions that have not arrived."""
        return [p for n, p in enumerate(self.positions) if n not in self.have]


class PmpDecoder:
    """A `scanner.decode.Decoder` for one PMP capture.

    Args:
        sequence: what was projected; its pattern is a `PmpPattern`.
        camera: the frames' format.
        thresholds: when a pixel is left undecided.

    Raises:
        DecodeError: the frequencies are ambiguous over the projector.
    """

    def __init__(
        self, sequence: PatternSequence, camera: CameraFormat, thresholds: PmpThresholds | None = None
    ) -> None:
        if not isinstance(sequence.pattern, PmpPattern):
            raise DecodeError(f"a PMP decoder cannot decode method {sequence.pattern.method!r}")
        self._sequence = sequence
        self._pattern = sequence.pattern
        self._camera = camera
        self._thresholds = thresholds or PmpThresholds()
        plan_ladder(self._pattern.frequencies, [2 / n for n in self._pattern.shifts])
        fringes = sequence.fringes
        self._sets = [_Set(s, fringes[s.first : s.first + s.shifts]) for s in self._pattern.sets()]
        self._where = {p: (k, n) for k, s in enumerate(self._sets) for n, p in enumerate(s.positions)}
        self._check = FrameCheck(sequence, camera)
        self._frames: dict[int, NDArray[Any]] = {}
        self._spare: list[NDArray[Any]] = []
        pixels = camera.width * camera.height
        per_axis = len(self._pattern.frequencies)
        self._phases = {axis: _filled(per_axis, pixels) for axis in self._pattern.axes}
        self._modulations = {axis: _filled(per_axis, pixels) for axis in self._pattern.axes}
        self._mean = _filled(pixels)
        self._residual = _filled(pixels)
        self._clipped = np.full(pixels, 0, np.uint8)
        self._maps = {axis: _AxisMaps.empty(pixels) for axis in self._pattern.axes}
        self._settled: dict[Axis, int] = {}

    @property
    def camera(self) -> CameraFormat:
        """The format of the frames it takes."""
        return self._camera

    def add(self, position: int, frame: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
        """Take the frame at `position`; when it completes its set, the set is fitted.

        Raises:
            DecodeError: wrong size or dtype, or a position that was given before or does not exist.
        """
        self._check.take(position, frame)
        if position not in self._where:
            return
        index, n = self._where[position]
        fringe_set = self._sets[index]
        if index not in self._frames:
            self._frames[index] = self._buffer(fringe_set.fringe_set.shifts)
        self._frames[index][len(fringe_set.have)] = frame.reshape(-1)
        fringe_set.have.append(n)
        if len(fringe_set.have) == fringe_set.fringe_set.shifts:
            self._fit(index)

    def finish(self) -> Decoded:
        """The maps. Sets that lost frames are solved from those that arrived, if there are three.

        Raises:
            DecodeError: fewer than three frames of a set arrived; they are named.
        """
        warnings = self._complete_sets()
        self._mean /= len(self._sets)
        ladders = {axis: plan_ladder(self._pattern.frequencies, self._gains(axis)) for axis in self._pattern.axes}
        noise = self._noise(ladders)
        remainders: dict[Axis, list[Remainder]] = {}
        for axis, ladder in ladders.items():
            remainders[axis] = self._agreement(axis, ladder, noise)
            warnings += disagreements(axis, remainders[axis])
            self._unwrap(axis, ladder, noise, remainders[axis])
        warnings += ladders[self._pattern.axes[0]].warnings()
        return self._decoded(noise, ladders, remainders, warnings)

    # --- sets ---------------------------------------------------------------------------------------------------

    def _buffer(self, shifts: int) -> NDArray[Any]:
        for i, spare in enumerate(self._spare):
            if len(spare) >= shifts:
                return self._spare.pop(i)
        return np.empty((shifts, self._camera.width * self._camera.height), self._camera.dtype)

    def _fit(self, index: int) -> None:
        s, frames = self._sets[index], self._frames.pop(index)
        design = design_matrix(self._pattern, s.fringe_set.shifts, s.have)
        inverse = np.linalg.inv(design.T @ design)
        weights = np.ascontiguousarray(inverse @ design.T, dtype=np.float32)
        axis, k = s.fringe_set.axis, index % len(self._pattern.frequencies)
        phase, modulation = self._phases[axis][k], self._modulations[axis][k]
        clip = max(int(np.ceil(self._thresholds.saturation * self._camera.max_value)), 1)
        fit_set(
            frames[: len(s.have)], weights, (design.T @ design).astype(np.float32), clip,
            phase, modulation, self._mean, self._residual, self._clipped,
        )  # fmt: skip
        s.gain = float(inverse[1, 1] + inverse[2, 2]) / 2
        self._spare.append(frames)

    def _complete_sets(self) -> tuple[str, ...]:
        short = [s for s in self._sets if len(s.have) < 3]
        if short:
            frames = [p for s in short for p in s.missing()]
            raise DecodeError(
                f"frames {', '.join(map(str, frames))} are missing: a fringe set needs three",
                hint="capture these frames again",
            )
        warnings = []
        for index in sorted(self._frames):
            s = self._sets[index]
            frames = s.missing()
            warnings.append(
                f"frequency {s.fringe_set.frequency:g} along {s.fringe_set.axis} decoded from {len(s.have)} of "
                f"{s.fringe_set.shifts} frames; missing: {', '.join(map(str, frames))}"
            )
            self._fit(index)
        return tuple(warnings)

    # --- the whole scan -----------------------------------------------------------------------------------------

    @property
    def _stride(self) -> int:
        # Odd, so that a sample does not stand in few columns of an image of even width.
        return max(self._mean.size // SAMPLE, 1) | 1

    @property
    def _freedom(self) -> int:
        return sum(s.freedom for s in self._sets)

    def _gains(self, axis: Axis) -> list[float]:
        return [s.gain for s in self._sets if s.fringe_set.axis == axis]

    def _noise(self, ladders: Mapping[Axis, Ladder]) -> NoiseModel:
        if self._freedom == 0:
            # What varies least between neighbours is noise alone: of two axes, the better one.
            return min(
                (self._noise_of_pairs(*item) for item in ladders.items()), key=lambda n: (not n.measured, n.read)
            )
        sample = slice(self._stride // 2, None, self._stride)
        usable = self._clipped[sample] == 0
        return fit_noise(
            self._mean[sample][usable], self._residual[sample][usable], self._freedom, self._camera.max_value
        )

    def _noise_of_pairs(self, axis: Axis, ladder: Ladder) -> NoiseModel:
        start, end = self._stride // 2, self._mean.size - PAIR_DISTANCE
        pair = slice(start, end, self._stride), slice(start + PAIR_DISTANCE, None, self._stride)
        noise = default_noise(self._camera.max_value)
        good = np.logical_and(*(self._usable(axis, sample, noise) for sample in pair))
        gains = np.asarray(self._gains(axis), dtype=np.float32)[:, None] / np.float32(4 * np.pi**2)
        phases = np.stack([self._phases[axis][:, sample][:, good] for sample in pair])
        per_variance = np.stack([gains / self._modulations[axis][:, sample][:, good] ** 2 for sample in pair])
        level = (self._mean[pair[0]][good] + self._mean[pair[1]][good]) * np.float32(0.5)
        return noise_of_pairs(ladder, phases, per_variance, level, self._centre(axis), self._camera.max_value)

    def _usable(self, axis: Axis, sample: slice, noise: NoiseModel) -> NDArray[np.bool_]:
        b2 = self._modulations[axis][:, sample] ** 2
        enough = self._thresholds.min_modulation_sigmas**2 * self._noise_of_b2(axis, sample, noise)
        good = (b2 > max(self._least_modulation**2, 1e-12)) & (b2 > enough)
        return np.asarray(good.all(axis=0) & (self._clipped[sample] == 0))

    def _noise_of_b2(self, axis: Axis, sample: slice, noise: NoiseModel) -> NDArray[np.float32]:
        gains = np.asarray(self._gains(axis), dtype=np.float32)[:, None]
        return np.asarray(gains * self._variance(noise, sample))

    def _variance(self, noise: NoiseModel, pixels: slice) -> NDArray[np.float32]:
        # The plain form of what the kernel does.
        model = noise.variance(self._mean[pixels])
        own = (PRIOR_FREEDOM * model + self._residual[pixels]) / (PRIOR_FREEDOM + self._freedom)
        return np.asarray(np.maximum(own, model), dtype=np.float32)

    @cached_property
    def _least_modulation(self) -> float:
        finest = [self._modulations[axis][self._finest][:: self._stride] for axis in self._pattern.axes]
        brightest = max(float(np.quantile(b, 0.99)) for b in finest)
        t = self._thresholds
        return max(t.min_modulation_levels, t.min_modulation_share * brightest)

    @property
    def _finest(self) -> int:
        f = self._pattern.frequencies
        return max(range(len(f)), key=lambda k: (f[k], k))

    def _agreement(self, axis: Axis, ladder: Ladder, noise: NoiseModel) -> list[Remainder]:
        sample = slice(self._stride // 2, None, self._stride)
        good = self._usable(axis, sample, noise)
        b2 = self._modulations[axis][:, sample][:, good] ** 2
        cycles2 = self._noise_of_b2(axis, sample, noise)[:, good] / (b2 * np.float32(4 * np.pi**2))
        phases = self._phases[axis][:, sample][:, good]
        return agreement(ladder, phases, cycles2, self._centre(axis), self._thresholds.phase_floor_cycles)

    def _centre(self, axis: Axis) -> float:
        """The field's centre as a fraction of it, where the pattern's phase is counted from `origin` before pixel 0."""
        return 0.5 + (self._pattern.origin - 0.5) / self._sequence.projector.along(axis)

    def _unwrap(self, axis: Axis, ladder: Ladder, noise: NoiseModel, remainders: Sequence[Remainder]) -> None:
        t, maps, f32 = self._thresholds, self._maps[axis], partial(np.array, dtype=np.float32)
        along, centre = self._sequence.projector.along(axis), self._centre(axis)
        freedom = self._freedom
        systematic = np.array([r.systematic for r in remainders], dtype=np.float64)
        errors2 = ladder.errors**2
        unwrap(
            self._phases[axis], self._modulations[axis], self._mean, self._residual, self._clipped,
            f32(self._gains(axis)), f32(ladder.combinations), f32(ladder.ratios),
            f32(errors2), f32(errors2.sum(axis=1) * systematic**2),
            f32([noise.read, noise.per_level, ROUNDING_VARIANCE, PRIOR_FREEDOM, 1 / (PRIOR_FREEDOM + freedom)]),
            f32([along, self._pattern.origin, ladder.frequencies[0] * centre, ladder.frequencies[-1], centre - 0.5]),
            f32([self._least_modulation, t.min_modulation_sigmas**2, t.max_residual_sigmas**2,
                 t.max_residual_share**2, t.max_remainder_sigmas**2, 1 - t.min_unwrap_probability, t.edge_sigmas]),
            ladder.periodic, self._finest,
            maps.position, maps.sigma, maps.confidence, maps.reason,
        )  # fmt: skip
        per_px = float(ladder.frequencies[-1]) / along
        self._settled[axis] = settle(
            maps.position, maps.sigma, maps.confidence, maps.reason, self._camera.width, per_px
        )

    # --- the result ---------------------------------------------------------------------------------------------

    def _decoded(
        self,
        noise: NoiseModel,
        ladders: Mapping[Axis, Ladder],
        remainders: Mapping[Axis, list[Remainder]],
        warnings: tuple[str, ...],
    ) -> Decoded:
        axes = self._pattern.axes
        maps = [self._maps[axis] for axis in axes]
        modulation = self._modulations[axes[0]][self._finest]
        merged = maps[0]
        if len(maps) == 2:
            modulation = np.minimum(modulation, self._modulations[axes[1]][self._finest])
            _merge(maps[0], maps[1])
        shape = self._camera.shape
        by_axis = {
            axis: (m.position.reshape(shape), m.sigma.reshape(shape)) for axis, m in zip(axes, maps, strict=True)
        }
        rows, sigma_rows = by_axis.get("y", (None, None))
        columns, sigma_columns = by_axis.get("x", (None, None))
        return Decoded(
            rows=rows,
            columns=columns,
            sigma_rows=sigma_rows,
            sigma_columns=sigma_columns,
            confidence=merged.confidence.reshape(shape),
            albedo=self._mean.reshape(shape),
            modulation=modulation.reshape(shape),
            reason=merged.reason.reshape(shape),
            warnings=warnings,
            details=self._details(merged.reason, noise, ladders, remainders),
        )

    def _details(
        self,
        reason: NDArray[np.uint8],
        noise: NoiseModel,
        ladders: Mapping[Axis, Ladder],
        remainders: Mapping[Axis, list[Remainder]],
    ) -> dict[str, Any]:
        counts = {r.name.lower(): int(np.count_nonzero(reason == np.uint8(r))) for r in Reason}
        return {
            "method": "pmp",
            "counts": {name: count for name, count in counts.items() if count},
            "thresholds": asdict(self._thresholds),
            "noise": asdict(noise),
            "unwrapping": {
                axis: {
                    "frequencies": [float(f) for f in ladder.frequencies],
                    "combinations": ladder.combinations.tolist(),
                    "remainders": [asdict(r) for r in remainders[axis]],
                    "settled_by_neighbours": self._settled[axis],
                }
                for axis, ladder in ladders.items()
            },
        }


def design_matrix(pattern: PmpPattern, shifts: int, have: Sequence[int]) -> NDArray[np.float64]:
    """(N, 3) rows [1, cos alpha_n, -sin alpha_n], alpha_n = sign 2 pi n / shifts + offset, for the shifts n in `have`.

    I = A + B cos(theta + alpha_n) = [A, B cos theta, B sin theta] . row.
    """
    alpha = pattern.sign * 2 * np.pi * np.asarray(have) / shifts + pattern.offset
    return np.stack([np.ones_like(alpha), np.cos(alpha), -np.sin(alpha)], axis=1)


def warm_up() -> None:
    """Compile every kernel of this method for the frames cameras give, so that no scan waits for it."""
    for bits in (8, 16):
        sequence = PatternSequence(ProjectorSize(64, 64), PmpPattern(("x", "y"), (1.0, 8.0), (3, 4)))
        decoder = PmpDecoder(sequence, CameraFormat(64, 64, bits))
        for position in range(len(sequence)):
            decoder.add(position, sequence.image(position).astype(decoder.camera.dtype))
        decoder.finish()


@dataclass(frozen=True)
class _AxisMaps:
    """(P,) maps of one axis."""

    position: Map
    sigma: Map
    confidence: Map
    reason: NDArray[np.uint8]

    @classmethod
    def empty(cls, pixels: int) -> _AxisMaps:
        return cls(_filled(pixels), _filled(pixels), _filled(pixels), np.full(pixels, 0, np.uint8))


def _filled(*shape: int) -> Map:
    # np.full writes, np.zeros only promises: the system finds the memory now, while frames are being exposed, and not
    # after the last one.
    return np.full(shape, 0, np.float32)


def _merge(first: _AxisMaps, second: _AxisMaps) -> None:
    # A pixel is decided when both its coordinates are; the first axis's maps become those of both.
    np.multiply(first.confidence, second.confidence, out=first.confidence)
    first.reason[first.reason == 0] = second.reason[first.reason == 0]
    undecided = first.reason != 0
    for values in (first.position, first.sigma, second.position, second.sigma):
        values[undecided] = np.nan
