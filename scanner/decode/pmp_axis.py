"""One axis of a PMP scan, from its frames to coordinates: a sample is judged, then one pass decodes all pixels.

The pass can be shared by several threads, each taking the next strip of the image when it is done with one; its
kernels leave the interpreter lock alone. Both axes of a scan are decoded apart and joined at the end.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Decoded, Map, Reason
from scanner.decode.addresses import maps_to_fill
from scanner.decode.agreement import Remainder, remainders
from scanner.decode.cut_at_black import unmove_dark
from scanner.decode.field_end import far_rooms, margin_px
from scanner.decode.frame_doubts import may_be_doubled
from scanner.decode.neighbours import settle
from scanner.decode.noise import ROUNDING_VARIANCE, NoiseModel, default_noise
from scanner.decode.one_surface import doubt_axis, doubtful_steps
from scanner.decode.pmp_frames import AxisFrames
from scanner.decode.pmp_join import join_maps
from scanner.decode.pmp_light import Light, honest, judge_light, judge_ripple
from scanner.decode.pmp_plan import plan_axis
from scanner.decode.pmp_sample import Sample, take_sample
from scanner.decode.pmp_strips import decode_strips
from scanner.decode.reasons import REASONS
from scanner.decode.sample_kernels import MIN_PIXELS
from scanner.decode.strips import Shared, begins_of
from scanner.decode.torn_rows import LEAST_LIT, LEAST_SHARE, PARTS, leave_torn_rows_out
from scanner.decode.unwrapping import Ladder
from scanner.patterns import CameraFormat
from scanner.patterns.description import Axis
from scanner.patterns.pmp import PmpPattern


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

    def clip(self, camera: CameraFormat) -> int:
        """Grey level from which a sample counts as clipped."""
        return max(int(np.ceil(self.saturation * camera.max_value)), 1)


@dataclass(frozen=True)
class AxisMaps:
    """(P,) maps of one axis."""

    position: Map
    sigma: Map
    confidence: Map
    albedo: Map
    modulation: Map
    reason: NDArray[np.uint8]

    @classmethod
    def empty(cls, pixels: int) -> AxisMaps:
        """Maps to be written."""
        block = maps_to_fill(5, -(-pixels // 16) * 16)
        position, sigma, confidence, albedo, modulation = (row[:pixels] for row in block)
        return cls(position, sigma, confidence, albedo, modulation, np.full(pixels, 0, np.uint8))

    def join(self, other: AxisMaps) -> NDArray[np.int64]:
        """Keep what both axes decided; these maps but position and sigma become those of both.

        Returns:
            (REASONS,) how many pixels have each reason now.
        """
        counts = np.zeros(REASONS, np.int64)
        join_maps(
            self.position, self.sigma, self.confidence, self.albedo, self.modulation, self.reason,
            other.position, other.sigma, other.confidence, other.albedo, other.modulation, other.reason, counts,
        )  # fmt: skip
        return counts


def decoded_maps(
    found: Mapping[Axis, AxisFound],
    merged: AxisMaps,
    camera: CameraFormat,
    warnings: tuple[str, ...],
    details: Mapping[str, Any],
) -> Decoded:
    """The maps of one or both axes as a decoder's result, without a copy.

    Args:
        merged: confidence, albedo, modulation and reason of all axes (see `AxisMaps.join`).
    """
    shape = camera.shape
    rows, columns = (found[axis].maps if axis in found else None for axis in ("y", "x"))
    return Decoded(
        rows=None if rows is None else rows.position.reshape(shape),
        columns=None if columns is None else columns.position.reshape(shape),
        sigma_rows=None if rows is None else rows.sigma.reshape(shape),
        sigma_columns=None if columns is None else columns.sigma.reshape(shape),
        confidence=merged.confidence.reshape(shape),
        albedo=merged.albedo.reshape(shape),
        modulation=merged.modulation.reshape(shape),
        reason=merged.reason.reshape(shape),
        warnings=warnings,
        details=details,
    )


LEAST_RIPPLE_CYCLES = 0.003
"""Systematic disagreement of the finest set that is worth a word: three times what 8-bit projection leaves."""


@dataclass(frozen=True)
class Ripple:
    """What the finest set's phases have in error that is no noise: response, interreflection, flicker."""

    cycles: float
    """1-sigma, cycles of the finest set"""
    px: float
    """the same in projector px"""
    random_px: float
    """median random 1-sigma of a coordinate, projector px"""

    def warning(self, axis: str, light: Light) -> str | None:
        """What a user should know, where the ripple outweighs noise. light: of the same axis, which may name it."""
        if self.cycles < LEAST_RIPPLE_CYCLES or not self.px > self.random_px:
            return None
        return (
            f"ripple along {axis}: frequencies differ by {self.px:.2f} projector px more than noise explains "
            f"(noise is {self.random_px:.2f} px){light.named}: measure the response (fringed calibrate response), "
            "take more shifts, or look for light that surfaces throw at one another"
        )


@dataclass(frozen=True)
class AxisFound:
    """What one axis's decoding found beside its maps."""

    maps: AxisMaps
    ladder: Ladder
    noise: NoiseModel
    remainders: list[Remainder]
    settled: int
    off_surface: int
    """pixels left out because their fringe is not the one of the surface around them"""
    ripple: Ripple | None
    """None with one frequency, which has nothing to differ from"""
    light: Light
    random_px: float
    """median random 1-sigma of a coordinate, projector px"""
    counts: NDArray[np.int64]
    """(REASONS,) pixels by reason"""
    may_be_doubled: bool
    """residuals are large enough for one frame to show what another one shows"""
    sample: Sample
    rooms: NDArray[np.float32]
    """(2, n) distances from the field's ends, of `field_end.mind_ends`"""


def decode_axis(
    pattern: PmpPattern,
    along: int,
    camera: CameraFormat,
    frames: AxisFrames,
    maps: AxisMaps,
    thresholds: PmpThresholds,
    threads: int,
    ladder: Ladder | None = None,
    brief: bool = False,
) -> AxisFound:
    """Decode one axis into `maps`.

    Args:
        brief: write position, confidence and reason alone, and tell neither ripple, light nor `random_px`.
        along: projector pixels along the axis. threads: that share the pass. ladder: the way up to the finest set;
            None: as `plan_ladder` finds it.
    """
    t, plan = thresholds, plan_axis(pattern, along, frames.there, ladder)
    pixels, finest, clip, sigmas = camera.width * camera.height, plan.finest, t.clip(camera), t.min_modulation_sigmas
    modulation_limits = t.min_modulation_levels, t.min_modulation_share, sigmas
    sigma, albedo, modulation = (m[: 0 if brief else None] for m in (maps.sigma, maps.albedo, maps.modulation))
    floors, model, limits = np.empty(len(plan.ratios), np.float32), np.empty(5, np.float32), np.empty(8, np.float32)
    rooms = far_rooms(pixels)
    arguments = (
        frames.addresses, frames.like, frames.starts, frames.weights, frames.grams, frames.whole, clip,
        plan.gains, plan.rungs, plan.ratios, plan.errors2, floors, model, plan.scale, limits,
        plan.ladder.periodic, finest,
        maps.position, sigma, maps.confidence, albedo, modulation, maps.reason, rooms, begins_of(pixels, threads),
    )  # fmt: skip
    with Shared(lambda gate, counts: decode_strips(*arguments, gate, counts), threads, REASONS) as shared:
        sample, seen = take_sample(frames, plan, pixels, camera.max_value, clip, modulation_limits)
        residual = sample.residual
        sample, least = honest(sample, seen, frames, plan), seen.least
        judged = sample.judged(plan, least, sigmas, t.phase_floor_cycles)
        noise = judged.noise
        floors[:] = plan.step_errors2 * judged.steps[:, 1] ** 2
        model[:] = noise.read, noise.per_level, ROUNDING_VARIANCE, sample.prior, 1 / (sample.prior + frames.freedom)
        limits[:] = (
            least, sigmas**2, t.max_residual_sigmas**2, t.max_residual_share**2 + sample.overtone_share2(finest),
            t.max_remainder_sigmas**2, 1 - t.min_unwrap_probability, t.edge_sigmas, margin_px(along),
        )  # fmt: skip
        shared.open()
        # What a report tells is no business of the pass: others are in it by now.
        found = remainders(plan.ladder, judged.steps, judged.pixels)
        doubled = may_be_doubled(frames, sample, residual, found, seen.good)
        random_px, ripple, light = np.nan, None, Light((), None)
        if not brief:
            random_px = plan.per_cycle * judged.phase_sigma(finest)
            light = judge_light(sample, seen, pattern.frequencies, plan)
            light = judge_ripple(light, frames, plan, sample, pixels, clip, noise, least, sigmas)
            if found and judged.pixels >= MIN_PIXELS:
                ripple = _ripple(found[-1], float(plan.step_errors2[-1]), plan.per_cycle, random_px)
        counts = shared.finish()
    settled = off_surface = 0
    if counts[Reason.UNWRAP_RISK]:
        if steps := doubtful_steps(found):
            turns = (maps.position + np.float32(pattern.origin)) * np.float32(1 / along)
            off_surface = doubt_axis(
                frames, plan.ladder, steps, clip, camera.width, turns, maps.confidence, maps.reason
            )
            counts[Reason.VALUE] -= off_surface
            counts[Reason.UNWRAP_RISK] += off_surface
        settled = settle(maps.position, maps.sigma, maps.confidence, maps.reason, camera.width, 1 / plan.per_cycle)
        counts[Reason.UNWRAP_RISK] -= settled
        counts[Reason.VALUE] += settled
        # Each has its tentative coordinate's distances, or is one fringe off.
        rooms -= np.float32(plan.per_cycle if settled else 0)
    if counts[Reason.MOVED]:
        dark = unmove_dark(maps.reason, frames, least, t.min_modulation_sigmas, camera.max_value)
        counts[Reason.MOVED] -= dark
        counts[Reason.SHADOW] += dark
    if counts[Reason.MOVED] >= PARTS * LEAST_LIT * LEAST_SHARE:
        shape = camera.shape
        confidence, torn = maps.confidence.reshape(shape), maps.reason.reshape(shape)
        changes = leave_torn_rows_out(torn, maps.position.reshape(shape), maps.sigma.reshape(shape), confidence)
        if changes.any():
            confidence[torn == Reason.OUT_OF_STEP] = 0
            counts += changes
    return AxisFound(
        maps, plan.ladder, noise, found, settled, off_surface, ripple, light, random_px, counts,
        doubled, sample, rooms,
    )  # fmt: skip


def undecided(found: AxisFound, why: Reason, thresholds: PmpThresholds | None, max_value: int) -> AxisFound:
    """The same of an axis whose frames were out of step: no pixel with light has a value, and nothing is told of what
    its frequencies and its light would have been.

    Args:
        why: reason of pixels with light. thresholds, max_value: by which fringes pass for light; None where modulations
            were not asked for. The scan's own noise is not asked: frames out of step have made it.
    """
    maps, counts = found.maps, np.zeros(REASONS, np.int64)
    there = np.isin(maps.reason, (Reason.VALUE, Reason.UNWRAP_RISK, Reason.BORDER, Reason.MOVED))
    if thresholds is not None:
        b, noise = maps.modulation, default_noise(max_value)
        least = max(thresholds.min_modulation_levels, thresholds.min_modulation_share * float(np.percentile(b, 99)))
        lit = (b >= least) & (b**2 >= thresholds.min_modulation_sigmas**2 * noise.variance(maps.albedo))
        there |= lit & np.isin(maps.reason, (Reason.SHADOW, Reason.LOW_MODULATION))
    maps.reason[there] = why
    for values in (maps.position, maps.sigma):
        values.fill(np.nan)
    maps.confidence.fill(0)
    counts += np.bincount(maps.reason, minlength=REASONS)
    return replace(found, remainders=[], settled=0, off_surface=0, ripple=None, light=Light((), None), counts=counts)


def _ripple(last: Remainder, weight: float, per_cycle: float, random_px: float) -> Ripple:
    cycles = last.beyond_noise / float(np.sqrt(weight))
    return Ripple(cycles, per_cycle * cycles, random_px)
