"""Decoding PMP: fringe sets of any frequencies and shifts to absolute projector coordinates.

Phase measuring profilometry is Srinivasan's, Liu's and Halioua's (1984); coarser sets tell the periods of finer ones
(Huntley and Saldner 1993).

Frames are taken in any order, and kept until their axis is whole; it is then decoded in one pass over its frames
(`pmp_axis`), so that what is left after a scan's last frame is one pass. A pixel whose fringe order is not nearly
certain, and not plain from its neighbours, stays undecided. How noisy the pixels are is taken from the capture itself:
from the residual of the fit where a set has four shifts or more, else from how well neighbouring rungs agree. A frame
that shows what another one of its set shows is left out, and named (`doubled`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode import (
    Coordinates,
    Decoded,
    Reason,
    addresses,
    field_end,
    neighbours,
    one_surface,
    pair_noise,
    spectra,
)
from scanner.decode.agreement import disagreements, doubtful_counts
from scanner.decode.between_sets import Disorder, disorders, exchange, faults_of_all, faults_of_few, told_of
from scanner.decode.doubled import lit_pixels, misplaced_frames
from scanner.decode.drifting import drift_of, miscounts, moved
from scanner.decode.field_end import FieldEnd, heights_of, mind_ends
from scanner.decode.frames import FrameCheck
from scanner.decode.lone_set import require_fringes
from scanner.decode.pmp_axis import AxisFound, AxisMaps, PmpThresholds, decode_axis, decoded_maps, undecided
from scanner.decode.pmp_frames import axis_frames
from scanner.decode.pmp_plan import plan_axis, whole_sets
from scanner.decode.rotated import cannot_reveal, hides_late_set, out_of_step, rotated_sets, still_apart
from scanner.decode.strips import threads_to_use
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize
from scanner.patterns.description import Axis


class PmpDecoder:
    """A `scanner.decode.Decoder` for one PMP capture.

    Args:
        sequence: what was projected; its pattern is a `PmpPattern`.
        camera: the frames' format.
        thresholds: when a pixel is left undecided.
        threads: that share the pass over the pixels; as `threads_to_use` says if None.

    Raises:
        DecodeError: the frequencies are ambiguous over the projector.
    """

    def __init__(
        self,
        sequence: PatternSequence,
        camera: CameraFormat,
        thresholds: PmpThresholds | None = None,
        threads: int | None = None,
    ) -> None:
        if not isinstance(sequence.pattern, PmpPattern):
            raise DecodeError(f"a PMP decoder cannot decode method {sequence.pattern.method!r}")
        self._sequence = sequence
        self._pattern = sequence.pattern
        self._camera = camera
        self._thresholds = thresholds or PmpThresholds()
        self._threads = threads or threads_to_use()
        for axis in self._pattern.axes:
            plan_axis(self._pattern, sequence.projector.along(axis), whole_sets(self._pattern))
        self._check = FrameCheck(sequence, camera)
        self._fringe_at = {position: fringe for fringe, position in enumerate(sequence.fringes)}
        self._frames: dict[int, NDArray[Any]] = {}
        self._each_axis = sum(self._pattern.shifts)
        self._awaited = dict.fromkeys(self._pattern.axes, self._each_axis)
        self._copies: NDArray[Any] | None = None
        self._maps = {axis: AxisMaps.empty(camera.width * camera.height) for axis in self._pattern.axes}
        self._found: dict[Axis, AxisFound] = {}
        self._ends: dict[Axis, FieldEnd | None] = {}
        self._doubled: dict[Axis, list[str]] = {axis: [] for axis in self._pattern.axes}

    @property
    def camera(self) -> CameraFormat:
        """The format of the frames it takes."""
        return self._camera

    def add(self, position: int, frame: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
        """Take a copy of the frame at `position`.

        Raises:
            DecodeError: wrong size or dtype, or a position that was given before or does not exist.
        """
        self._check.take(position, frame)
        fringe = self._fringe_at.get(position)
        if fringe is not None:
            if self._copies is None:
                self._copies = np.empty((len(self._fringe_at), *self._camera.shape), self._camera.dtype)
            self._copies[fringe] = frame
            self._took(fringe, self._copies[fringe])

    def keep(self, position: int, frame: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
        """Take the frame at `position` as it is, without a copy: it must not change before `finish` has returned.

        Raises:
            DecodeError: see `add`.
        """
        self._check.take(position, frame)
        fringe = self._fringe_at.get(position)
        if fringe is not None:
            self._took(fringe, np.ascontiguousarray(frame))

    def finish(self) -> Decoded:
        """The maps. Sets that lost frames are solved from those that arrived, if there are three.

        Raises:
            DecodeError: fewer than three frames of a set arrived; they are named. Or there are no fringes.
        """
        warnings = self._missing()
        for axis in self._pattern.axes:
            if axis not in self._found:
                self._decode(axis)
        for axis in self._pattern.axes:
            found = self._found[axis]
            self._require_fringes(axis, found)
            if (changes := found.light.flicker) is not None:
                warnings += tuple(filter(None, [changes.warning(axis, found.random_px)]))
            if found.ripple is not None and (ripple := found.ripple.warning(axis, found.light)) is not None:
                warnings += (ripple,)
            warnings += self._told_of_counts(axis, found)
        warnings += self._found[self._pattern.axes[0]].ladder.warnings()
        return self._decoded((*chain(*self._doubled.values()), *warnings))

    def coordinates(self) -> Coordinates:
        """In place of `finish`: the same coordinates and confidence, in less time.

        What is left out: sigma, albedo, modulation, and what a report says of ripple, overtones and flicker. A scan of
        both axes is joined from all its maps, and takes as long as `finish`.

        Raises:
            DecodeError: as `finish`.
        """
        if len(self._pattern.axes) == 2:
            whole = self.finish()
            return Coordinates(whole.rows, whole.columns, whole.confidence, whole.warnings)
        warnings, (axis,) = self._missing(), self._pattern.axes
        found = self._decoded_in_step(axis, brief=True)
        self._require_fringes(axis, found)
        shape = self._camera.shape
        position, confidence = found.maps.position.reshape(shape), found.maps.confidence.reshape(shape)
        rows, columns = (position, None) if axis == "y" else (None, position)
        warnings = (*self._doubled[axis], *warnings, *self._told_of_counts(axis, found), *found.ladder.warnings())
        return Coordinates(rows, columns, confidence, warnings)

    def _took(self, fringe: int, frame: NDArray[Any]) -> None:
        self._frames[fringe] = frame
        # An axis that is whole before the last one's frames come is decoded in the meantime.
        axis = self._pattern.axes[fringe // self._each_axis]
        self._awaited[axis] -= 1
        if not self._awaited[axis] and len(self._frames) < len(self._fringe_at):
            self._decode(axis)

    def _missing(self) -> tuple[str, ...]:
        if len(self._frames) == len(self._fringe_at):
            return ()
        positions, warnings, lost = self._sequence.fringes, [], []
        for s in self._pattern.sets():
            missing = [positions[n] for n in range(s.first, s.first + s.shifts) if n not in self._frames]
            have = s.shifts - len(missing)
            if have < 3:
                lost += missing
            elif missing:
                warnings.append(
                    f"frequency {s.frequency:g} along {s.axis} decoded from {have} of {s.shifts} frames; "
                    f"missing: {', '.join(map(str, missing))}"
                )
        if lost:
            raise DecodeError(
                f"frames {', '.join(map(str, lost))} are missing: a fringe set needs three",
                hint="capture these frames again",
            )
        return tuple(warnings)

    def _decode(self, axis: Axis) -> None:
        self._found[axis] = self._decoded_in_step(axis, brief=False)

    def _decoded_in_step(self, axis: Axis, brief: bool) -> AxisFound:
        """Decode one axis, without the frames of it that are found to show what they should not."""
        found = self._decoded_axis(axis, brief)
        for look in (self._all_late, self._misplaced, *[self._disordered] * len(self._pattern.frequencies)):
            mended = look(axis, found) if found.may_be_doubled else None
            if mended is not None:
                if not mended:
                    return self._without_values(axis, found, brief)
                found = self._decoded_axis(axis, brief)
        frequencies, shifts = self._pattern.frequencies, self._pattern.shifts
        if found.may_be_doubled and (drift := self._drift(axis, found)):
            self._doubled[axis].append(moved(axis, drift))
            return self._without_values(axis, found, brief, Reason.MOVED)
        if rotated := rotated_sets(found.ladder, found.remainders, shifts):
            self._doubled[axis] += out_of_step(axis, rotated, frequencies, shifts)
            return self._without_values(axis, found, brief)
        if self._doubled[axis] and (more := still_apart(axis, found.remainders)):
            self._doubled[axis] += more
            return self._without_values(axis, found, brief)
        return found

    def _without_values(
        self, axis: Axis, found: AxisFound, brief: bool, reason: Reason = Reason.OUT_OF_STEP
    ) -> AxisFound:
        self._ends[axis] = None
        return undecided(found, reason, None if brief else self._thresholds, self._camera.max_value)

    def _drift(self, axis: Axis, found: AxisFound) -> float | None:
        """Projector px a frame by which a scene drifts, where fringes are counted wrong for that; else None."""
        frames = axis_frames(self._pattern, axis, self._frames)
        drift = drift_of(self._pattern, frames, lit_pixels(found.sample, frames))
        if drift is None or not miscounts(found.ladder, self._pattern.frequencies, self._pattern.shifts, drift):
            return None
        return drift * self._sequence.projector.along(axis)

    def _all_late(self, axis: Axis, found: AxisFound) -> bool | None:
        """Whether frames that are out of step were put in it; None where none is found to be. Of the whole sequence."""
        return self._told(axis, found, faults_of_all)

    def _misplaced(self, axis: Axis, found: AxisFound) -> bool | None:
        """The same, of frames that their own sets tell."""
        sets = [s for s in self._pattern.sets() if s.axis == axis]
        faults = misplaced_frames(axis_frames(self._pattern, axis, self._frames), found.sample)
        shifts, ladder, several = self._pattern.shifts, found.ladder, sum(one.late != 0 for one in faults) > 1
        faults = [
            replace(one, mended=False)
            if one.late and (several or hides_late_set(ladder, one.of_set, one.late, shifts))
            else one
            for one in faults
        ]
        for fault in faults:
            told = fault.says(lambda k, n: self._sequence.fringes[sets[k].first + n])
            self._doubled[axis].append(
                f"frequency {sets[fault.of_set].frequency:g} along {axis}: {told}; capture again"
            )
            fault.mend(self._frames, sets[fault.of_set].first)
        return all(fault.mended for fault in faults) if faults else None

    def _disordered(self, axis: Axis, found: AxisFound) -> bool | None:
        """The same, of frames that steps between sets tell."""
        return self._told(axis, found, faults_of_few)

    def _told(self, axis: Axis, found: AxisFound, faults: Callable[[Sequence[int]], Iterable[Disorder]]) -> bool | None:
        """Look for faults, keep what there is to be told, and put frames in step where that can be done."""
        sets = [s for s in self._pattern.sets() if s.axis == axis]
        frames = axis_frames(self._pattern, axis, self._frames)
        at, along = lit_pixels(found.sample, frames), self._sequence.projector.along(axis)
        these = disorders(faults(frames.shifts), self._pattern, frames, at, found.ladder, along)
        if not these:
            return None
        mended = len(these) == 1 and bool(these[0].exchanged)
        if mended:
            exchange(self._frames, *(sets[k].first + n for k, n in these[0].exchanged))
        told = told_of(these, mended, axis, self._pattern, lambda k, n: self._sequence.fringes[sets[k].first + n])
        self._doubled[axis].append(f"{told}; capture again")
        return mended

    def _decoded_axis(self, axis: Axis, brief: bool) -> AxisFound:
        frames = axis_frames(self._pattern, axis, self._frames)
        along, maps = self._sequence.projector.along(axis), self._maps[axis]
        found = decode_axis(
            self._pattern, along, self._camera, frames, maps, self._thresholds, self._threads, brief=brief
        )
        self._ends[axis] = mind_ends(
            maps.position, maps.sigma[: 0 if brief else None], maps.confidence, maps.reason, found.rooms, along,
            lambda: heights_of(self._pattern, along, found.sample), found.counts,
        )  # fmt: skip
        return found

    def _told_of_counts(self, axis: Axis, found: AxisFound) -> tuple[str, ...]:
        """What a user should know of periods that may be counted wrong."""
        end = self._ends[axis]
        ends = () if end is None else tuple(filter(None, [end.warning(axis)]))
        return disagreements(axis, found.remainders) + doubtful_counts(axis, found.remainders) + ends

    def _require_fringes(self, axis: Axis, found: AxisFound) -> None:
        if len(self._pattern.frequencies) == 1:
            period = self._sequence.projector.along(axis) / self._pattern.frequencies[0]
            require_fringes(found.maps.position.reshape(self._camera.shape), period, axis)

    # --- the result ---------------------------------------------------------------------------------------------

    def _decoded(self, warnings: tuple[str, ...]) -> Decoded:
        found = [self._found[axis] for axis in self._pattern.axes]
        merged, counts = found[0].maps, found[0].counts
        if len(found) == 2:
            counts = merged.join(found[1].maps)
        return decoded_maps(self._found, merged, self._camera, warnings, self._details(counts))

    def _details(self, counts: NDArray[np.int64]) -> dict[str, Any]:
        # What varies least is noise alone: of two axes, the better one stands for the camera.
        noise = min((f.noise for f in self._found.values()), key=lambda n: (not n.measured, n.read))
        return {
            "method": "pmp",
            "counts": {r.name.lower(): int(counts[r]) for r in Reason if counts[r]},
            "thresholds": dict(vars(self._thresholds)),
            "noise": dict(vars(noise)),
            "unwrapping": {
                axis: {
                    "frequencies": [float(f) for f in found.ladder.frequencies],
                    "combinations": found.ladder.combinations.tolist(),
                    "remainders": [dict(vars(r)) for r in found.remainders],
                    "settled_by_neighbours": found.settled,
                    "left_out_by_surface": found.off_surface,
                    "ripple": None if found.ripple is None else dict(vars(found.ripple)),
                }
                for axis, found in self._found.items()
            },
            "cannot_reveal": list(cannot_reveal(self._pattern.frequencies, self._pattern.shifts)),
            "light": {axis: found.light.as_dict() for axis, found in self._found.items()},
            "field_end": {axis: end.as_dict() for axis, end in self._ends.items() if end is not None},
        }


def warm_up() -> None:
    """Compile every kernel of this method for the frames cameras give, so that no scan waits for it."""
    for bits in (8, 16):
        sequence = PatternSequence(ProjectorSize(64, 64), PmpPattern(("x", "y"), (1.0, 8.0), (3, 4)))
        decoder = PmpDecoder(sequence, CameraFormat(64, 64, bits), threads=1)
        for position in range(len(sequence)):
            decoder.add(position, sequence.image(position).astype(decoder.camera.dtype))
        decoder.finish()
    addresses.warm_up()
    field_end.warm_up()
    neighbours.warm_up()
    one_surface.warm_up()
    pair_noise.warm_up()
    spectra.warm_up()
