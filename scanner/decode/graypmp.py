"""Decoding Gray + PMP: one fringe set's phase, and the fringe nearest to where the Gray code puts a pixel.

Both parts go through the decoders of their own methods; here they are put together. A cell of the code is half a
fringe or less, so that the phase's place and the code's differ by a quarter of a fringe in the middle of a cell, and by
no more than half of one where a border bit is read as its neighbour's. Pixels where they differ by more are undecided.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Decoded, Reason
from scanner.decode.field_end import FieldEnd, heights_of, mind_ends, rooms_of
from scanner.decode.frames import FrameCheck
from scanner.decode.graycode import GrayDecoder, GrayThresholds
from scanner.decode.phase_and_code import PhaseAndCode, compare_phase_and_code, require_code_order
from scanner.decode.pmp_axis import AxisFound, AxisMaps, PmpThresholds, decode_axis, decoded_maps
from scanner.decode.pmp_frames import axis_frames
from scanner.decode.reasons import REASONS
from scanner.decode.strips import threads_to_use
from scanner.decode.unwrapping import Ladder
from scanner.errors import DecodeError
from scanner.kernel import kernel
from scanner.patterns import CameraFormat, GrayPmpPattern, PartSequence, PatternSequence
from scanner.patterns.description import Axis

MOST_APART = 0.42
"""Of a fringe, between the places of phase and code: beyond, the next fringe is nearly as likely. Over the cells
themselves, of half a fringe, it is a quarter at most."""

FEWEST_BITS = 4
"""Of a code, whose coarse half then tells the contrast of white and black"""


class GrayPmpDecoder:
    """A `scanner.decode.Decoder` for one Gray + PMP capture.

    Args:
        sequence: what was projected; its pattern is a `GrayPmpPattern`.
        camera: the frames' format.
        threads: that share the pass over the pixels; as `threads_to_use` says if None.

    Raises:
        DecodeError: the code has fewer words than the projector has pixels.
    """

    def __init__(self, sequence: PatternSequence, camera: CameraFormat, threads: int | None = None) -> None:
        if not isinstance(sequence.pattern, GrayPmpPattern):
            raise DecodeError(f"a Gray + PMP decoder cannot decode method {sequence.pattern.method!r}")
        sequence.pattern.gray.validate(sequence.projector)
        self._sequence, self._pattern, self._camera = sequence, sequence.pattern, camera
        self._threads = threads or threads_to_use()
        self._check = FrameCheck(sequence, camera)
        self._frames: dict[int, NDArray[Any]] = {}

    def add(self, position: int, frame: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
        """Take a copy of the frame at `position`.

        Raises:
            DecodeError: wrong size or dtype, or a position that was given before or does not exist.
        """
        self._check.take(position, frame)
        self._frames[position] = frame.copy(order="C")

    def finish(self) -> Decoded:
        """The maps.

        Raises:
            DecodeError: frames without which phase or code cannot be read are missing; they are named. Or phase and
                code contradict each other.
        """
        self._require_fringes()
        found = {axis: self._phases(axis) for axis in self._pattern.axes}
        code = self._code(next(iter(found.values())).maps)
        warnings = list(code.warnings)
        agreement: dict[Axis, PhaseAndCode] = {}
        ends: dict[Axis, FieldEnd | None] = {}
        for axis, of_axis in found.items():
            cells = code.rows if axis == "y" else code.columns
            if cells is None:
                raise AssertionError("the code has the axes of the fringes")
            along = self._sequence.projector.along(axis)
            period = along / self._pattern.pmp.frequencies[0]
            m = of_axis.maps
            sound = (m.reason == Reason.VALUE) & (code.reason.reshape(-1) == Reason.VALUE)
            beyond = int(np.count_nonzero((m.reason == Reason.VALUE) & (code.reason.reshape(-1) == Reason.BORDER)))
            plain = self._pattern.gray.code == "gray"
            require_code_order(cells, sound.reshape(cells.shape), beyond, axis, self._pattern.cell_px, gray=plain)
            agreement[axis] = compare_phase_and_code(
                m.position, cells.reshape(-1), sound, axis, period, self._pattern.cell_px
            )
            agreement[axis].require()
            warnings += filter(None, [agreement[axis].warning()])
            _choose_fringe(
                m.position, m.sigma, m.confidence, m.reason, cells.reshape(-1), code.confidence.reshape(-1),
                code.reason.reshape(-1), np.float32(period), np.float32(along), np.float32(MOST_APART),
            )  # fmt: skip
            counts = np.bincount(m.reason, minlength=REASONS)
            ends[axis] = end = self._mind_ends(of_axis, along, code, counts)
            warnings += filter(None, [None if end is None else end.warning(axis)])
            if (changes := of_axis.light.flicker) is not None:
                warnings += filter(None, [changes.warning(axis, of_axis.random_px)])
        first, *other = [f.maps for f in found.values()]
        if other:
            counts = first.join(other[0])
        return self._decoded(found, agreement, ends, first, code, counts, tuple(warnings))

    def _mind_ends(self, found: AxisFound, along: int, code: Decoded, counts: NDArray[np.int64]) -> FieldEnd | None:
        """What ends of the field did to an axis's maps, whose blur the code's contrast tells beside the fringes'."""
        gray, sequence, m = self._pattern.gray, self._sequence, found.maps
        levels = sequence.white is not None and sequence.black is not None
        contrast = code.modulation.reshape(-1) if gray.inverse or levels or gray.bits >= FEWEST_BITS else None
        return mind_ends(
            m.position, m.sigma, m.confidence, m.reason, rooms_of(m.position, along), along,
            lambda: heights_of(self._pattern.pmp, along, found.sample, contrast), counts,
        )  # fmt: skip

    def _require_fringes(self) -> None:
        lost: list[int] = []
        for s in self._pattern.pmp.sets():
            positions = self._sequence.fringes[s.first : s.first + s.shifts]
            missing = [p for p in positions if p not in self._frames]
            if s.shifts - len(missing) < 3:
                lost += missing
        if lost:
            raise DecodeError(
                f"frames {', '.join(map(str, lost))} are missing: a fringe set needs three",
                hint="capture these frames again",
            )

    def _phases(self, axis: Axis) -> AxisFound:
        """The axis's coordinates as if all pixels saw the fringe at the field's centre."""
        pmp = self._pattern.pmp
        by_fringe = {n: self._frames[p] for n, p in enumerate(self._sequence.fringes) if p in self._frames}
        frames = axis_frames(pmp, axis, by_fringe)
        alone = Ladder(np.eye(1, dtype=np.int64), np.array(pmp.frequencies), np.zeros((0, 1)), periodic=False)
        maps = AxisMaps.empty(self._camera.width * self._camera.height)
        along = self._sequence.projector.along(axis)
        return decode_axis(pmp, along, self._camera, frames, maps, PmpThresholds(), self._threads, alone)

    def _code(self, light: AxisMaps) -> Decoded:
        """The code, decoded.

        Where neither inverses nor white and black were projected, fringes and coarse bits stand for them.
        """
        part = PartSequence.of(self._sequence, self._pattern.gray, self._pattern.pmp.fringe_count)
        frames = {p: self._frames[p] for p in part.chosen if p in self._frames}
        for position in (part.white, part.black):
            if position is not None and position in self._frames:
                frames[position] = self._frames[position]
        if not self._pattern.gray.inverse and (part.white is None or part.black is None):
            part = PartSequence(
                part.projector, part.pattern, part.total, part.total + 1, part.sentinels, part.bars,
                part.precorrection, part.chosen, part.total + 2,
            )  # fmt: skip
            contrast = self._half_contrast(light, [frames[p] for p in part.chosen if p in frames])
            for position, sign in ((part.total - 2, 1), (part.total - 1, -1)):
                level = np.clip(light.albedo + sign * contrast, 0, self._camera.max_value)
                frames[position] = np.rint(level).astype(self._camera.dtype).reshape(self._camera.shape)
        # Cells beyond one fringe name two, between which the phase does not choose.
        of_fringe = self._sequence.projector.along(self._pattern.axes[0]) / self._pattern.pmp.frequencies[0]
        together = max(round(of_fringe / self._pattern.cell_px) - 1, 1)
        # What is left out at the field's end, the fringes say.
        open_cells = min(together, GrayThresholds.max_open_cells)
        thresholds = GrayThresholds(max_open_cells=open_cells, least_end_share=0)
        decoder = GrayDecoder(part, self._camera, thresholds, self._threads)
        for position, frame in frames.items():
            decoder.keep(position, frame)
        return decoder.finish()

    def _half_contrast(self, light: AxisMaps, code: list[NDArray[Any]]) -> NDArray[np.float32]:
        """(P,) float32: half of what white and black would differ by.

        Fringes show it where they are sharp. Blur takes from fine fringes what it leaves to the coarse bits, and levels
        that the bits go beyond would pass for noise: how far those lie from the fringes' mean says it without blur. Of
        the coarse half of an axis's bits one at most is on a border here, which the middle one leaves out.
        """
        axes, bits = len(self._pattern.axes), self._pattern.gray.bits
        if len(code) != axes * bits or bits < FEWEST_BITS:
            return light.modulation
        coarse = np.stack([frame.reshape(-1) for frame in code[: (bits + 1) // 2]]).astype(np.float32)
        apart = np.abs(coarse - light.albedo)
        middle = len(apart) // 2
        return np.asarray(np.partition(apart, middle, axis=0)[middle], np.float32)

    def _decoded(
        self,
        found: dict[Axis, AxisFound],
        agreement: dict[Axis, PhaseAndCode],
        ends: dict[Axis, FieldEnd | None],
        maps: AxisMaps,
        code: Decoded,
        counts: NDArray[np.int64],
        warnings: tuple[str, ...],
    ) -> Decoded:
        details = {
            "method": self._pattern.method,
            "counts": {r.name.lower(): int(counts[r]) for r in Reason if counts[r]},
            "noise": asdict(next(iter(found.values())).noise),
            "light": {axis: f.light.as_dict() for axis, f in found.items()},
            "field_end": {axis: end.as_dict() for axis, end in ends.items() if end is not None},
            "phase_and_code": {axis: a.as_dict() for axis, a in agreement.items()},
            "code": {key: code.details[key] for key in ("counts", "thresholds", "noise_factor")},
        }
        return decoded_maps(found, maps, self._camera, warnings, details)


@kernel
def _choose_fringe(
    position: NDArray[np.float32],
    sigma: NDArray[np.float32],
    confidence: NDArray[np.float32],
    reason: NDArray[np.uint8],
    cells: NDArray[np.float32],
    code_confidence: NDArray[np.float32],
    code_reason: NDArray[np.uint8],
    period: np.float32,
    along: np.float32,
    most_apart: np.float32,
) -> None:
    """Put each phase on the fringe nearest to its cell's centre. All (P,); the first four are changed."""
    for i in range(reason.size):
        why = reason[i] if reason[i] != 0 else code_reason[i]
        if why == 0:
            apart = cells[i] - position[i]
            order = np.rint(apart / period)
            value = position[i] + order * period
            if abs(apart - order * period) > most_apart * period:
                why = np.uint8(4)
            elif value < -0.5 or value > along - np.float32(0.5):
                why = np.uint8(5)
            else:
                position[i] = value
                confidence[i] = min(confidence[i], code_confidence[i])
        if why != 0:
            position[i] = np.float32(np.nan)
            sigma[i] = np.float32(np.nan)
            confidence[i] = np.float32(0)
        reason[i] = why


def warm_up() -> None:
    """Compile the kernel."""
    one, why = np.zeros(2, np.float32), np.zeros(2, np.uint8)
    scale = np.float32(1)
    _choose_fringe(one.copy(), one.copy(), one.copy(), why.copy(), one, one, why, scale, scale, scale)
