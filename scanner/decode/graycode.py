"""Decoding Gray and binary code, with inverses or with white and black, along one axis or both.

The position is the centre of the cell that the projected bits name (formats.md). A pixel on the border of two cells
leaves one bit open, blur one or two; where all that they could mean are cells close by, the position is the middle of
these, and its sigma what their borders leave (`graycode_cells`). Everywhere else an open bit leaves the pixel
undecided. Frames are kept and decoded in one pass over all of them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Coordinates, Decoded, Map, Reason
from scanner.decode.addresses import addresses_of, maps_to_fill
from scanner.decode.code_end import between_ends, beyond_ends
from scanner.decode.frames import FrameCheck
from scanner.decode.graycode_bits import BOTH, INVERSE, PLAIN
from scanner.decode.graycode_blur import blurred_bits, share_to_count, shares_decided
from scanner.decode.graycode_cells import narrow_cells
from scanner.decode.graycode_noise import noise_factor
from scanner.decode.graycode_strips import decode_code_strips
from scanner.decode.noise import ROUNDING_VARIANCE, default_noise
from scanner.decode.reasons import REASONS
from scanner.decode.runs import runs_of
from scanner.decode.strips import Shared, begins_of, threads_to_use
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, GrayPattern, PatternSequence, ProjectorSize
from scanner.patterns.description import Axis
from scanner.sample_lanes import LINE

SAMPLE = 4096
"""Pixels from which a capture's noise is judged, times the coarse bits: its median is good to 2 %."""

ENOUGH = 1024
"""Pixels with light in them that a sample should have; larger ones are taken until it has, or there are no more."""


@dataclass(frozen=True)
class GrayThresholds:
    """When a pixel is left undecided."""

    saturation: float = 1.0
    """share of the camera's range from which a sample counts as clipped"""
    min_contrast_levels: float = 3.0
    """white less black in grey levels: below it, rounding decides bits"""
    min_contrast_sigmas: float = 8.0
    """white less black over the noise of one sample"""
    decisive_share: float = 0.15
    """share of the contrast by which a bit's two levels must differ: less is the border of two cells, or blur"""
    decisive_sigmas: float = 3.5
    """the same difference over its noise; below it the bit is open"""
    max_open_cells: int = 3
    """from the first to the last cell that a pixel's open bits leave, two bits at most: 1 is the border of two cells, 3
    two blurred bits"""
    min_code_probability: float = 0.999
    """probability that every bit is right that matters"""
    least_end_share: float = 0.6
    """of the contrast around it that a pixel has on the projected field's first or last cell: half is the end itself;
    0: nobody asks"""


@dataclass(frozen=True)
class _Codes:
    """The frames by what they are, in the form kernels take them.

    addresses: (A, bits, 2) intp, image and inverse, 0 where there is none. kinds: (A, bits) int64, PLAIN, INVERSE or
    BOTH. levels: (2,) intp, white and black, or zeros. like: (0,) of the frames' dtype.
    """

    addresses: NDArray[np.intp]
    kinds: NDArray[np.int64]
    levels: NDArray[np.intp]
    like: NDArray[Any]

    @property
    def has_levels(self) -> bool:
        """Whether white and black were projected and came."""
        return bool(self.levels.all())

    @property
    def coarse(self) -> int:
        """Bits whose pairs stand in for white and black; the finest are left out: blur has taken their contrast."""
        return int(max((self.kinds.shape[1] + 1) // 2, 1))


class GrayDecoder:
    """A `scanner.decode.Decoder` for one Gray or binary code capture.

    Args:
        sequence: what was projected; its pattern is a `GrayPattern`.
        camera: the frames' format.
        thresholds: when a pixel is left undecided.
        threads: that share the pass over the pixels; as `threads_to_use` says if None.

    Raises:
        DecodeError: neither inverses, nor white and black; or the code has fewer words than the projector has pixels.
    """

    def __init__(
        self,
        sequence: PatternSequence,
        camera: CameraFormat,
        thresholds: GrayThresholds | None = None,
        threads: int | None = None,
    ) -> None:
        if not isinstance(sequence.pattern, GrayPattern):
            raise DecodeError(f"a Gray code decoder cannot decode method {sequence.pattern.method!r}")
        sequence.pattern.validate(sequence.projector)
        if not sequence.pattern.inverse and (sequence.white is None or sequence.black is None):
            raise DecodeError(
                "Gray code without inverses needs a white and a black frame",
                hint='name their positions in the pattern ("white", "black"), or project inverses',
            )
        self._sequence = sequence
        self._pattern = sequence.pattern
        self._camera = camera
        self._thresholds = thresholds or GrayThresholds()
        self._check = FrameCheck(sequence, camera)
        self._threads = threads or threads_to_use()
        pattern = sequence.pattern
        self._kept = {*sequence.fringes, *({sequence.white, sequence.black} - {None})}
        self._frames: dict[int, NDArray[Any]] = {}
        pixels = camera.width * camera.height
        self._pixels, whole_lines = pixels, -(-pixels // LINE) * LINE
        self._maps = maps_to_fill(2 * len(pattern.axes) + 3, whole_lines)
        self._reason = np.full(whole_lines, 0, np.uint8)
        # Lines with pixels near an end of the field, by axis.
        self._marked = np.full((len(pattern.axes), whole_lines // LINE), 0, np.uint8)

    def add(self, position: int, frame: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
        """Take a copy of the frame at `position`.

        Raises:
            DecodeError: wrong size or dtype, or a position that was given before or does not exist.
        """
        self._check.take(position, frame)
        if position in self._kept:
            self._frames[position] = frame.copy(order="C")

    def keep(self, position: int, frame: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
        """Take the frame at `position` as it is, without a copy: it must not change before `finish` has returned.

        Raises:
            DecodeError: see `add`.
        """
        self._check.take(position, frame)
        if position in self._kept:
            self._frames[position] = np.ascontiguousarray(frame)

    def finish(self) -> Decoded:
        """The maps.

        Raises:
            DecodeError: a bit cannot be told; the missing frames are named.
        """
        counts, factor, warnings = self._decode(brief=False)
        return self._decoded(counts, factor, warnings)

    def coordinates(self) -> Coordinates:
        """In place of `finish`: the same coordinates and confidence, in less time: maps are most of what is moved.

        What is left out: sigma, albedo and modulation.

        Raises:
            DecodeError: as `finish`.
        """
        *_, warnings = self._decode(brief=True)
        positions, _, (confidence, *_) = self._by_axis()
        return Coordinates(positions.get("y"), positions.get("x"), confidence, warnings)

    # --- frames -------------------------------------------------------------------------------------------------

    def _codes(self) -> _Codes:
        pattern, sequence = self._pattern, self._sequence
        each, bits = pattern.frames_per_bit, pattern.bits
        addresses = np.zeros((len(pattern.axes), bits, 2), np.intp)
        fringes = sequence.fringes
        came = [index for index, position in enumerate(fringes) if position in self._frames]
        in_order = np.zeros(len(fringes), np.intp)
        in_order[came] = addresses_of([self._frames[fringes[index]] for index in came])
        addresses[:, :, :each] = in_order.reshape(len(pattern.axes), bits, each)
        have = addresses != 0
        kinds = np.where(have.all(axis=2), BOTH, np.where(have[:, :, 0], PLAIN, INVERSE))
        levels = np.zeros(2, np.intp)
        if sequence.white in self._frames and sequence.black in self._frames:
            levels[:] = addresses_of([self._frames[p] for p in (sequence.white, sequence.black) if p is not None])
        return _Codes(addresses, kinds, levels, np.empty(0, self._camera.dtype))

    def _check_complete(self, codes: _Codes) -> tuple[str, ...]:
        pattern, sequence = self._pattern, self._sequence
        each, have = pattern.frames_per_bit, codes.addresses != 0
        if have[:, :, :each].all() and (each == 2 or codes.has_levels):
            return ()
        lost, warnings = [], []
        for index, axis in enumerate(pattern.axes):
            for bit in range(pattern.bits):
                first = (index * pattern.bits + bit) * each
                came = have[index, bit, :each]
                if not came.any() or not ((came.all() and each == 2) or codes.has_levels):
                    lost += [sequence.fringes[first + n] for n in range(each) if not came[n]]
                elif not came.all():
                    warnings.append(f"bit {bit} along {axis} decoded from one of its two frames")
        if not pattern.inverse and not codes.has_levels:
            lost += [p for p in (sequence.white, sequence.black) if p is not None and p not in self._frames]
        if lost:
            raise DecodeError(
                f"frames {', '.join(map(str, sorted(set(lost))))} are missing: the code cannot be read without them",
                hint="capture these frames again",
            )
        return tuple(warnings)

    def _noise_factor(self, codes: _Codes) -> float:
        model, limit = default_noise(self._camera.max_value), self._thresholds.min_contrast_levels
        kinds, levels = codes.kinds[0, : codes.coarse], codes.levels
        # The first axis's coarse bits: they have few borders of cells in them.
        addresses, size = codes.addresses[0, : codes.coarse], SAMPLE
        sigmas, most = self._thresholds.min_contrast_sigmas, self._camera.max_value
        noise = np.array([model.read, model.per_level, ROUNDING_VARIANCE, limit, most, sigmas], np.float32)
        while True:
            starts, length = runs_of(self._pixels, size)
            lit, factor = noise_factor(addresses, kinds, levels, codes.like, starts, length, noise)
            if lit >= ENOUGH or size >= self._pixels:
                break
            size *= 8
        return float(factor)

    # --- decoding -----------------------------------------------------------------------------------------------

    def _decode(self, brief: bool) -> tuple[NDArray[np.int64], float, tuple[str, ...]]:
        """Fill the maps, or of a brief answer those of `coordinates`.

        How many pixels have each reason, the noise's factor, and what a user should know.
        """
        codes = self._codes()
        warnings = self._check_complete(codes)
        pattern, t = self._pattern, self._thresholds
        max_value = self._camera.max_value
        model = default_noise(max_value)
        noise = np.array([model.read, model.per_level, ROUNDING_VARIANCE, 1], np.float32)
        sizes = np.array([self._sequence.projector.along(axis) for axis in pattern.axes])
        cell = self._cell_px
        ends = [np.add(between_ends(along, cell, t.least_end_share), 0.5) / cell - 0.5 for along in sizes.tolist()]
        arguments = (
            codes.addresses, codes.kinds, codes.levels, codes.like,
            np.empty(0, np.uint16 if codes.like.itemsize == 1 else np.uint32), codes.coarse,
            max(int(np.ceil(t.saturation * max_value)), 1), pattern.code == "gray", pattern.code_bits - pattern.bits,
            sizes, noise,
            np.array([t.min_contrast_levels, t.min_contrast_sigmas**2, t.decisive_share, t.decisive_sigmas**2,
                      1 - t.min_code_probability, t.max_open_cells, max_value], np.float32),
            np.array(ends, np.float32), brief, share_to_count(self._reason.size // LINE), self._maps, self._reason,
            self._marked, begins_of(self._pixels, self._threads),
        )  # fmt: skip

        def take_strips(gate: NDArray[np.int64], counts: NDArray[np.int64]) -> bool:
            return decode_code_strips(*arguments, gate, counts)

        with Shared(take_strips, self._threads, REASONS + codes.kinds.size + 1) as shared:
            noise[3] = factor = self._noise_factor(codes)
            shared.open()
            counts = shared.finish()
        shares = shares_decided(counts[REASONS:], codes.kinds.shape)
        for index, axis in enumerate(() if brief else pattern.axes):
            sigma, along = self._maps[len(pattern.axes) + index], self._sequence.projector.along(axis)
            narrow_cells(sigma, self._maps[index], along, self._cell_px, self._camera.width)
        self._leave_ends_out(codes, counts)
        return counts[:REASONS], factor, (*warnings, *blurred_bits(pattern, shares))

    @property
    def _cell_px(self) -> int:
        return 1 << (self._pattern.code_bits - self._pattern.bits)

    def _leave_ends_out(self, codes: _Codes, counts: NDArray[np.int64]) -> None:
        """Pixels that look beyond the field have no values."""
        pattern, share, axes = self._pattern, self._thresholds.least_end_share, len(self._pattern.axes)
        # Without white and black an axis's two coarsest bits and their inverses: one at most is on a border.
        pairs = codes.levels[None] if codes.has_levels else codes.addresses[:, :2]
        for index, axis in enumerate(pattern.axes if share else ()):
            out = beyond_ends(
                self._maps[index, : self._pixels], self._camera.width, self._sequence.projector.along(axis),
                self._cell_px, share, pairs if codes.has_levels else pairs[index], codes.like, self._marked[index],
            )  # fmt: skip
            if not out.size:
                continue
            self._maps[: 2 * axes, out], self._maps[2 * axes, out] = np.nan, 0
            self._reason[out] = Reason.BORDER
            counts[Reason.VALUE] -= out.size
            counts[Reason.BORDER] += out.size

    def _by_axis(self) -> tuple[dict[Axis, Map], dict[Axis, Map], list[Map]]:
        """Positions and sigmas by axis; confidence, albedo and modulation."""
        axes = self._pattern.axes
        maps = [row[: self._pixels].reshape(self._camera.shape) for row in self._maps]
        positions, sigmas = (dict(zip(axes, maps[first:], strict=False)) for first in (0, len(axes)))
        return positions, sigmas, maps[2 * len(axes) :]

    def _decoded(self, counts: NDArray[np.int64], factor: float, warnings: tuple[str, ...]) -> Decoded:
        positions, sigmas, (confidence, albedo, modulation) = self._by_axis()
        return Decoded(
            rows=positions.get("y"),
            columns=positions.get("x"),
            sigma_rows=sigmas.get("y"),
            sigma_columns=sigmas.get("x"),
            confidence=confidence,
            albedo=albedo,
            modulation=modulation,
            reason=self._reason[: self._pixels].reshape(self._camera.shape),
            warnings=warnings,
            details={
                "method": "gray",
                "counts": {r.name.lower(): int(counts[r]) for r in Reason if counts[r]},
                "thresholds": asdict(self._thresholds),
                "noise_factor": factor,
            },
        )


def warm_up() -> None:
    """Compile every kernel of this method for the frames cameras give, so that no scan waits for it."""
    for bits in (8, 16):
        camera = CameraFormat(32, 32, bits)
        sequence = PatternSequence(ProjectorSize(32, 32), GrayPattern(("x",), 5, 5))
        decoder = GrayDecoder(sequence, camera)
        for position in range(len(sequence)):
            decoder.add(position, sequence.image(position).astype(camera.dtype))
        decoder.finish()
