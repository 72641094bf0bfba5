"""Decoding Gray and binary code, with inverses or with white and black, along one axis or both.

The position is the centre of the cell that the projected bits name (formats.md). A pixel on the border of two cells
leaves one bit open; where both values name neighbouring cells it is decided all the same, everywhere else an open bit
leaves the pixel undecided. Frames are kept until an axis is whole and then decoded in one pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Decoded, Map, Reason
from scanner.decode.frames import FrameCheck
from scanner.decode.graycode_kernels import BOTH, INVERSE, PLAIN, decode_bits
from scanner.decode.noise import ROUNDING_VARIANCE, default_noise
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, GrayPattern, PatternSequence, ProjectorSize
from scanner.patterns.description import Axis

SAMPLE = 30_000
"""Pixels from which a capture's noise is judged."""


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
    """cells that a pixel's open bits may span, two bits at most: 1 is the border of two cells, 3 two blurred bits"""
    min_code_probability: float = 0.999
    """probability that every bit is right that matters"""


@dataclass
class _Images:
    """Code images of one axis, of one kind: (bits, P), taken as they arrive."""

    pixels: NDArray[Any]
    have: set[int] = field(default_factory=set)

    def take(self, bit: int, frame: NDArray[Any]) -> None:
        """Keep a copy of the image of `bit`."""
        self.pixels[bit] = frame.reshape(-1)
        self.have.add(bit)


@dataclass(frozen=True)
class _Bits:
    """One axis: its images and their inverses."""

    axis: Axis
    plain: _Images
    inverse: _Images

    def kinds(self, bits: int) -> list[int | None]:
        """PLAIN, INVERSE or BOTH for each bit; None where neither has come."""
        table = {(True, True): BOTH, (True, False): PLAIN, (False, True): INVERSE}
        return [table.get((bit in self.plain.have, bit in self.inverse.have)) for bit in range(bits)]


class GrayDecoder:
    """A `scanner.decode.Decoder` for one Gray or binary code capture.

    Args:
        sequence: what was projected; its pattern is a `GrayPattern`.
        camera: the frames' format.
        thresholds: when a pixel is left undecided.

    Raises:
        DecodeError: neither inverses, nor white and black.
    """

    def __init__(
        self, sequence: PatternSequence, camera: CameraFormat, thresholds: GrayThresholds | None = None
    ) -> None:
        if not isinstance(sequence.pattern, GrayPattern):
            raise DecodeError(f"a Gray code decoder cannot decode method {sequence.pattern.method!r}")
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
        self._axes = {
            axis: _Bits(axis, self._images(True), self._images(self._pattern.inverse)) for axis in self._pattern.axes
        }
        self._where = {p: i for i, p in enumerate(sequence.fringes)}
        self._levels: dict[str, NDArray[Any]] = {}

    def add(self, position: int, frame: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
        """Take the frame at `position`.

        Raises:
            DecodeError: wrong size or dtype, or a position that was given before or does not exist.
        """
        self._check.take(position, frame)
        if position == self._sequence.white:
            self._levels["white"] = frame.reshape(-1).copy()
        elif position == self._sequence.black:
            self._levels["black"] = frame.reshape(-1).copy()
        elif position in self._where:
            each = self._pattern.frames_per_bit
            axis, within = divmod(self._where[position], self._pattern.bits * each)
            bit, inverted = divmod(within, each)
            bits = self._axes[self._pattern.axes[axis]]
            (bits.inverse if inverted else bits.plain).take(bit, frame)

    def finish(self) -> Decoded:
        """The maps.

        Raises:
            DecodeError: a bit cannot be told; the missing frames are named.
        """
        warnings = self._check_complete()
        light, dark, clipped = self._light_and_dark()
        factor = self._noise_factor(light, dark)
        found = {axis: self._decode(bits, light, dark, clipped, factor) for axis, bits in self._axes.items()}
        first, *rest = found.values()
        for other in rest:
            first.join(other)
        return self._decoded(found, light, dark, factor, warnings)

    def _images(self, projected: bool) -> _Images:
        rows = self._pattern.bits if projected else 0
        return _Images(np.empty((rows, self._camera.width * self._camera.height), self._camera.dtype))

    # --- frames -------------------------------------------------------------------------------------------------

    def _check_complete(self) -> tuple[str, ...]:
        have_levels = len(self._levels) == 2
        lost, warnings = [], []
        for index, (axis, bits) in enumerate(self._axes.items()):
            each = self._pattern.frames_per_bit
            for bit, kind in enumerate(bits.kinds(self._pattern.bits)):
                first = (index * self._pattern.bits + bit) * each
                frames = [self._sequence.fringes[first + n] for n in range(each)]
                if kind is None or (kind != BOTH and not have_levels):
                    lost += [
                        p
                        for p, images in zip(frames, (bits.plain, bits.inverse), strict=False)
                        if bit not in images.have
                    ]
                elif kind != BOTH and each == 2:
                    warnings.append(f"bit {bit} along {axis} decoded from one of its two frames")
        if not self._pattern.inverse and not have_levels:
            lost += [
                p
                for p, name in ((self._sequence.white, "white"), (self._sequence.black, "black"))
                if name not in self._levels and p is not None
            ]
        if lost:
            raise DecodeError(
                f"frames {', '.join(map(str, sorted(set(lost))))} are missing: the code cannot be read without them",
                hint="capture these frames again",
            )
        return tuple(warnings)

    def _light_and_dark(self) -> tuple[Map, Map, NDArray[np.uint8]]:
        # White and black as projected, or the brighter and darker of each pair, averaged: the finest bits are left
        # out of the average where there are others, because blur has taken their contrast.
        clip = max(int(np.ceil(self._thresholds.saturation * self._camera.max_value)), 1)
        if len(self._levels) == 2:
            light, dark = (self._levels[name].astype(np.float32) for name in ("white", "black"))
            return light, dark, np.asarray(dark >= clip, dtype=np.uint8)
        coarse = max((self._pattern.bits + 1) // 2, 1)
        pairs = [(b.plain.pixels[bit], b.inverse.pixels[bit]) for b in self._axes.values() for bit in range(coarse)]
        light = np.mean([np.maximum(a, b) for a, b in pairs], axis=0, dtype=np.float32)
        dark = np.mean([np.minimum(a, b) for a, b in pairs], axis=0, dtype=np.float32)
        return light, dark, np.asarray(dark >= clip - 0.5, dtype=np.uint8)

    def _noise_factor(self, light: Map, dark: Map) -> float:
        # Variance over that of the default model, from what the images of a pixel have in common: an image and its
        # inverse add up to the same in all bits; without inverses an image is as light as white or as dark as black.
        model = default_noise(self._camera.max_value)
        stride = max(light.size // SAMPLE, 1) | 1
        white, black = light[::stride], dark[::stride]
        lit = (white - black > self._thresholds.min_contrast_levels) & (white < self._camera.max_value)
        if np.count_nonzero(lit) < 100:
            return 1.0
        expected = model.variance((white + black) * np.float32(0.5))[lit]
        ratios = []
        for bits in self._axes.values():
            for bit, kind in enumerate(bits.kinds(self._pattern.bits)):
                if kind == BOTH:
                    image, inverse = (i.pixels[bit, ::stride][lit] for i in (bits.plain, bits.inverse))
                    total = image.astype(np.float32) + inverse
                    ratios.append((total - white[lit] - black[lit]) ** 2 / ((4 if self._levels else 3) * expected))
                else:
                    images = bits.plain if kind == PLAIN else bits.inverse
                    image = images.pixels[bit, ::stride][lit].astype(np.float32)
                    nearer = np.minimum(np.abs(image - white[lit]), np.abs(image - black[lit]))
                    ratios.append(nearer**2 / (2 * expected))
        # Coarse bits have few borders of cells in them; those are cut off at three sigmas, which leaves .973 of the
        # mean square. (.455 is the median square: whole grey levels make it too coarse to be the measure itself.)
        coarse = np.concatenate(ratios[: max(len(ratios) // 2, 1)])
        least = float(np.median(ROUNDING_VARIANCE / expected))
        within = coarse <= 9 * max(float(np.median(coarse)) / 0.455, least)
        return max(float(coarse[within].mean()) / 0.973, least)

    # --- decoding -----------------------------------------------------------------------------------------------

    def _decode(self, bits: _Bits, light: Map, dark: Map, clipped: NDArray[np.uint8], factor: float) -> _AxisMaps:
        pattern, t = self._pattern, self._thresholds
        kinds = [kind for kind in bits.kinds(pattern.bits) if kind is not None]
        model = default_noise(self._camera.max_value)
        maps = _AxisMaps.empty(light.size)
        decode_bits(
            bits.plain.pixels, (bits.inverse if pattern.inverse else bits.plain).pixels, np.array(kinds),
            light, dark, clipped,
            pattern.code == "gray", pattern.code_bits - pattern.bits, self._sequence.projector.along(bits.axis),
            np.array([model.read, model.per_level, ROUNDING_VARIANCE, factor], np.float32),
            np.array([t.min_contrast_levels, t.min_contrast_sigmas**2, t.decisive_share, t.decisive_sigmas**2,
                      1 - t.min_code_probability, t.max_open_cells], np.float32),
            maps.position, maps.sigma, maps.confidence, maps.reason,
        )  # fmt: skip
        return maps

    def _decoded(
        self, found: Mapping[Axis, _AxisMaps], light: Map, dark: Map, factor: float, warnings: tuple[str, ...]
    ) -> Decoded:
        shape = self._camera.shape
        merged = next(iter(found.values()))
        positions = {axis: maps.position.reshape(shape) for axis, maps in found.items()}
        sigmas = {axis: maps.sigma.reshape(shape) for axis, maps in found.items()}
        counts = np.bincount(merged.reason, minlength=len(Reason))
        return Decoded(
            rows=positions.get("y"),
            columns=positions.get("x"),
            sigma_rows=sigmas.get("y"),
            sigma_columns=sigmas.get("x"),
            confidence=merged.confidence.reshape(shape),
            albedo=((light + dark) * np.float32(0.5)).reshape(shape),
            modulation=((light - dark) * np.float32(0.5)).reshape(shape),
            reason=merged.reason.reshape(shape),
            warnings=warnings,
            details={
                "method": "gray",
                "counts": {r.name.lower(): int(counts[r]) for r in Reason if counts[r]},
                "thresholds": asdict(self._thresholds),
                "noise_factor": factor,
            },
        )


@dataclass(frozen=True)
class _AxisMaps:
    """(P,) maps of one axis."""

    position: Map
    sigma: Map
    confidence: Map
    reason: NDArray[np.uint8]

    @classmethod
    def empty(cls, pixels: int) -> _AxisMaps:
        """Maps to be written."""
        position, sigma, confidence = (np.empty(pixels, np.float32) for _ in range(3))
        return cls(position, sigma, confidence, np.empty(pixels, np.uint8))

    def join(self, other: _AxisMaps) -> None:
        """Keep what both axes decided; this axis's confidence and reason become those of both."""
        np.multiply(self.confidence, other.confidence, out=self.confidence)
        self.reason[self.reason == 0] = other.reason[self.reason == 0]
        undecided = self.reason != 0
        for values in (self.position, self.sigma, other.position, other.sigma):
            values[undecided] = np.nan


def warm_up() -> None:
    """Compile every kernel of this method for the frames cameras give, so that no scan waits for it."""
    for bits in (8, 16):
        camera = CameraFormat(32, 32, bits)
        sequence = PatternSequence(ProjectorSize(32, 32), GrayPattern(("x",), 5, 5))
        decoder = GrayDecoder(sequence, camera)
        for position in range(len(sequence)):
            decoder.add(position, sequence.image(position).astype(camera.dtype))
        decoder.finish()
