"""From the frames of one capture to a Scan: check, decode, triangulate, filter, compare.

One path for every caller: the decode worker feeds frames as they arrive, `fringed decode` feeds a folder at once.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scanner.calibration.watch import watched
from scanner.capture import Capture, CaptureHeader
from scanner.capture.exposure import exposure_warnings
from scanner.carrier_check import in_order_of, require_carriers
from scanner.compare import compare
from scanner.contrast import widen_at_edges
from scanner.decode import Decoded, Decoder, KeepingDecoder, decoder_for
from scanner.decode.repeated import Repetitions
from scanner.decode.stages import Observer
from scanner.decode_options import DecodeOptions, require_sizes
from scanner.devices import Pixels, Truth
from scanner.empty_scan import raise_if_empty
from scanner.errors import DecodeError, ScannerError
from scanner.geometry import Calibration, load_calibration
from scanner.patterns import FrameRole, GrayPattern, GrayPmpPattern, McpPattern, PatternSequence, PmpPattern
from scanner.ripple_correction import widen_by_ripple, without_ripple
from scanner.saturation import clips_below, overexposed
from scanner.scale_check import require_codes_within, require_geometry
from scanner.scan import Map, Scan, build_scan
from scanner.scan_report import report_of_capture, report_of_check
from scanner.sequencer import CaptureCheck, Hearing, check_capture
from scanner.uncertainty import budget_of

TRUTH_FILE = "truth.npz"
_OF_ORDER = (FrameRole.SENTINEL, FrameRole.BARS)

Progress = Callable[[str], None]
"""Told the name of each stage as it begins."""

OnPoints = Callable[[Map, Map], None]
"""Takes xyz (H, W, 3) and confidence (H, W), both float32 and final, where the frames are in step."""


class Reconstruction:
    """The decoding of one capture, fed frame by frame.

    `add` each frame as it arrives, then `finish` with the closed folder. Repetitions of the sequence are decoded one
    after the other, each as soon as it is whole, and averaged. A frame that was taken again after it was added makes
    `finish` decode from the folder: retakes are rare, and sums cannot forget.

    Frames behind the last one that is decoded say only whether all are in step. Who adds them while they are captured
    calls `listen` and `solve` meanwhile, `check` behind the last one, which has little left to do, and `finish` when
    nobody waits for points any more.
    """

    def __init__(
        self,
        header: CaptureHeader,
        calibration: Calibration | None,
        options: DecodeOptions,
        observer: Observer | None = None,
    ) -> None:
        """Raise DecodeError or CalibrationError at once where these frames cannot become a scan."""
        if calibration is not None:
            require_sizes(header, calibration)
        self._header = header
        self._calibration = calibration
        self._options = options
        self._observer = observer
        self._timings: dict[str, float] = {}
        self._begin()

    def _begin(self) -> None:
        self._decoders: dict[int, Decoder] = {0: self._new_decoder(self._observer)}
        self._repetitions = Repetitions(
            self._header.repeat,
            ambiguity_px(self._header.sequence),
            quantised=isinstance(self._header.sequence.pattern, GrayPattern),
        )
        self._failed: dict[int, DecodeError] = {}
        self._slots: dict[int, int | None] = {}
        sequence = self._header.sequence
        # The others tell whether the frames are in step, and no more.
        self._decoded_at = {p for p in range(len(sequence)) if sequence.role(p) not in _OF_ORDER}
        self._awaited = self._header.repeat * len(self._decoded_at)
        self._hearing = Hearing(sequence, self._header.camera.max_value)
        self._early: Scan | ScannerError | None = None
        self._made: tuple[Scan, CaptureCheck] | ScannerError | None = None

    def add(self, pattern: int, frame: Pixels, slot: int | None = None, *, stays: bool = False) -> None:
        """Take one frame.

        Args:
            pattern: repetition x patterns + position.
            frame: (H, W) uint8 or uint16.
            slot: its slot in the folder.
            stays: the pixels do not change before `finish` has returned, as in a folder: decoders that can work on
                them where they lie. Else the frame is not kept.

        Raises:
            DecodeError: see `scanner.decode.Decoder.add`.
        """
        if pattern in self._slots or not 0 <= pattern < self._header.frame_count:
            return
        repetition, position = divmod(pattern, len(self._header.sequence))
        if repetition not in self._decoders and not self._is_whole(repetition):
            self._decoders[repetition] = self._new_decoder()
        if position in self._decoded_at:
            self._awaited -= 1
            with self._timed("decode frames"):
                decoder = self._decoders[repetition]
                take = decoder.keep if stays and isinstance(decoder, KeepingDecoder) else decoder.add
                take(position, frame)
        self._slots[pattern] = slot
        camera = self._header.camera
        if len(self._header.sequence) > 1 and (camera.bits in (8, 16) or int(frame.max()) <= camera.max_value):
            self._hearing.take(pattern, frame)  # else it is no frame of this camera, as the check will find
        if self._header.repeat > 1 and position in self._decoded_at and self._is_whole(repetition):
            self._end_repetition(repetition)

    @property
    def may_be_solved(self) -> bool:
        """Whether all frames that are decoded are there, and it was not `solve`d yet."""
        return self._early is None and self._awaited == 0

    def listen(self, pattern: int) -> None:
        """Ask what the frames of a pattern's repetition say of their order, where only its last ones are missing."""
        self._hearing.listen(pattern)

    def solve(self, capture: Capture, progress: Progress | None = None, points: OnPoints | None = None) -> None:
        """Make the scan as far as it can be; errors are `finish`'s to raise. Args: as `check`."""
        try:
            self._early = self._with_edges(self._solved(capture, progress or (lambda _: None), points))
        except ScannerError as error:
            self._early = error

    def check(
        self,
        capture: Capture,
        progress: Progress | None = None,
        points: OnPoints | None = None,
        sure: Callable[[], None] | None = None,
    ) -> None:
        """Make the scan, all but its report, and check the frames, once all are there; errors are `finish`'s to raise.

        Args:
            capture: the folder; it may still be open.
            progress: told each stage.
            points: takes xyz and confidence as soon as they are final, where there is a calibration and `solve` did
                not give them: sigmas and report are still to come.
            sure: called behind `points`, once the frames are known to be in step.
        """
        tell = progress or (lambda _: None)
        tell("checking frames")
        try:
            self._catch_up(capture)
            self._made = self._solved_and_checked(capture, tell, points, sure)
        except ScannerError as error:
            self._made = error

    def finish(
        self,
        capture: Capture,
        progress: Progress | None = None,
        points: OnPoints | None = None,
        sure: Callable[[], None] | None = None,
    ) -> Scan:
        """The scan, once all frames are there and the folder is closed. Args: as `check`, whose work is not done again.

        Raises:
            SyncError: the frames are out of step.
            DecodeError: they cannot be decoded, or no pixel of them can although the scene is lit.
            CalibrationError: the rig cannot triangulate this pattern's axis.
        """
        tell = progress or (lambda _: None)
        self._catch_up(capture)
        if self._made is None:
            self.check(capture, progress, points, sure)
        if not isinstance(self._made, tuple):
            raise self._made or AssertionError("check has set it")
        scan, check = self._made
        phase_axis = "y" if self._calibration is None else self._calibration.phase_axis
        scan = scan.with_report(
            **report_of_check(check, scan.report["decoder"]),
            capture=report_of_capture(capture),
            uncertainty=self._budget(scan, check.mixed_share),
        )
        scan = widen_by_ripple(scan, self._header.sequence, phase_axis)
        with self._timed("drift and marks"):
            scan = watched(scan, self._calibration, self._header)
        if self._options.compare_truth:
            tell("comparing with truth")
            scan = self._compared(scan, capture)
        return scan

    def _checked(self, capture: Capture) -> CaptureCheck:
        with self._timed("check"):
            return check_capture(capture, self._hearing).raise_if_out_of_step()

    def _solved_and_checked(
        self, capture: Capture, tell: Progress, points: OnPoints | None, sure: Callable[[], None] | None
    ) -> tuple[Scan, CaptureCheck]:
        """The scan, if it was not made early, and the check in a thread beside it: frames out of step say more."""
        tell_sure = sure or (lambda: None)
        if self._early is not None:
            check = self._checked(capture)
            if isinstance(self._early, ScannerError):
                raise self._early
            tell_sure()
            return self._early, check
        with ThreadPoolExecutor(1, thread_name_prefix="check") as beside:
            checking = beside.submit(self._checked, capture)

            def final(xyz: Map, confidence: Map) -> None:
                if points is not None:
                    points(xyz, confidence)
                checking.result()
                tell_sure()

            try:
                scan = self._solved(capture, tell, final)
            except Exception:
                checking.result()
                raise
            return self._with_edges(scan), checking.result()

    def _with_edges(self, scan: Scan) -> Scan:
        if not isinstance(self._header.sequence.pattern, PmpPattern | GrayPmpPattern):
            return scan
        with self._timed("widen sigmas"):
            return widen_at_edges(scan, "y" if self._calibration is None else self._calibration.phase_axis)

    def _solved(self, capture: Capture, tell: Progress, points: OnPoints | None) -> Scan:
        """Maps and points."""
        tell("decoding")
        decoded = self._decoded()
        of_light = overexposed(decoded, capture) + clips_below(capture)
        decoded = replace(decoded, warnings=(*decoded.warnings, *capture.warnings, *of_light))
        require_codes_within(decoded, self._header.sequence)
        if len(self._header.sequence) > 1:
            # The witnesses have seen light: without it the check ends in an error of its own.
            raise_if_empty(decoded)
        if self._options.correct_ripple:
            decoded = without_ripple(decoded, self._header.sequence)
        decoded = self._carriers_fit(self._fits_geometry(decoded), capture)
        tell("triangulating")

        def final(xyz: Map) -> None:
            if points is not None:
                points(xyz, decoded.confidence)

        return build_scan(decoded, self._calibration, self._options.filters, timings=self._timings, points=final)

    def _is_whole(self, repetition: int) -> bool:
        return all(repetition * len(self._header.sequence) + p in self._slots for p in self._decoded_at)

    def _end_repetition(self, repetition: int) -> None:
        decoder = self._decoders.pop(repetition)
        try:
            with self._timed("decode"):
                self._repetitions.add(decoder.finish())
        except DecodeError as error:
            self._failed[repetition] = error

    def _decoded(self) -> Decoded:
        """The mean of all repetitions; one that cannot be decoded is left out and named, unless none can."""
        for repetition in sorted(self._decoders):
            self._end_repetition(repetition)
        if self._repetitions.count == 0:
            raise self._failed[min(self._failed)]
        with self._timed("decode"):
            decoded = self._repetitions.result()
        absent = self._header.repeat - self._repetitions.count - len(self._failed)
        said = [f"repetition {n + 1} was left out: {error}" for n, error in sorted(self._failed.items())]
        said += [f"{absent} of {self._header.repeat} repetitions have no frames"] if absent else []
        said += exposure_warnings(self._header)
        return replace(decoded, warnings=(*decoded.warnings, *said)) if said else decoded

    def _fits_geometry(self, decoded: Decoded) -> Decoded:
        """Coordinates run the way, and at the pace, that a calibrated rig lets them; see `scale_check`."""
        if self._calibration is None:
            return decoded
        with self._timed("check geometry"):
            return require_geometry(decoded, self._calibration, self._header.sequence)

    def _budget(self, scan: Scan, mixed: float | None) -> dict[str, Any] | None:
        if self._calibration is None:
            return None
        with self._timed("uncertainty"):
            found = budget_of(scan, self._calibration, self._header.sequence, mixed, self._repetitions.count)
        return None if found is None else found.as_dict()

    def _carriers_fit(self, decoded: Decoded, capture: Capture) -> Decoded:
        """MCP on a calibrated rig: the carriers' frequencies agree with the stripes' names; see `carrier_check`."""
        sequence = self._header.sequence
        values = decoded.rows if decoded.columns is None else decoded.columns
        if self._calibration is None or not isinstance(sequence.pattern, McpPattern) or values is None:
            return decoded
        position = next((p for p in sequence.fringes if p in capture.records), None)
        if position is None:
            return decoded
        with self._timed("check carriers"):
            frame, in_order = capture.frame(position), in_order_of(decoded.details)
            fit, warning = require_carriers(
                self._calibration, sequence.pattern, sequence.projector, frame, values, in_order
            )
        details = {**decoded.details, "carrier_check": None if fit is None else fit.as_dict()}
        said = () if warning is None else (warning,)
        return replace(decoded, details=details, warnings=(*decoded.warnings, *said))

    def _catch_up(self, capture: Capture) -> None:
        present = {pattern: record.slot for pattern, record in capture.require_any().items()}
        stale = any(slot is not None and present.get(pattern) != slot for pattern, slot in self._slots.items())
        if stale or self._slots.keys() - present.keys():
            self._begin()
        for pattern, slot in present.items():
            if pattern not in self._slots:
                self.add(pattern, capture.frame(pattern), slot, stays=True)

    def _new_decoder(self, observer: Observer | None = None) -> Decoder:
        fit = None if self._calibration is None else self._calibration.extra.get("mcp_phase")
        options = (self._options.decoder, observer, fit, self._calibration)
        return decoder_for(self._header.sequence, self._header.camera, *options)

    def _compared(self, scan: Scan, capture: Capture) -> Scan:
        with self._timed("compare"):
            comparison = compare(scan, load_truth(capture.path), ambiguity_px(self._header.sequence))
        return replace(scan.with_report(truth=comparison.as_dict()), error_map=comparison.picture())

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self._timings[stage] = self._timings.get(stage, 0.0) + time.perf_counter() - begin


def reconstruct(
    capture: Capture,
    calibration: Calibration | None,
    options: DecodeOptions | None = None,
    progress: Progress | None = None,
    observer: Observer | None = None,
) -> Scan:
    """Decode a folder, all at once. `observer` is told the first repetition's intermediate images.

    Raises:
        SyncError, DecodeError, CalibrationError: see `Reconstruction.finish`.
    """
    tell = progress or (lambda _: None)
    tell("reading frames")
    reconstruction = Reconstruction(capture.header, calibration, options or DecodeOptions(), observer)
    for pattern, record in capture.records.items():
        reconstruction.add(pattern, capture.frame(pattern), record.slot, stays=True)
    return reconstruction.finish(capture, progress)


def ambiguity_px(sequence: PatternSequence) -> float | None:
    """Projector px by which a value is off if its fringe order or stripe is wrong; None where codes have no period."""
    pattern, projector = sequence.pattern, sequence.projector
    pattern = pattern.pmp if isinstance(pattern, GrayPmpPattern) else pattern
    if isinstance(pattern, PmpPattern):
        return min(projector.along(axis) for axis in pattern.axes) / max(pattern.frequencies)
    return pattern.pitch_px(projector) if isinstance(pattern, McpPattern) else None


def calibration_for(capture: Capture, given: Path | None = None) -> Calibration | None:
    """The calibration to use: the given file, else the file the capture names, else none.

    Raises:
        CalibrationError: a file that is named is missing or unusable.
    """
    path = given if given is not None else capture.calibration_path
    return None if path is None else load_calibration(path)


def load_truth(folder: Path) -> Truth:
    """The truth that a simulated rig left in its capture folder.

    Raises:
        DecodeError: there is none, or it is damaged.
    """
    path = folder / TRUTH_FILE
    try:
        with np.load(path, allow_pickle=False) as content:
            return Truth(content["rows"], content["columns"], content["xyz"], content["lit"])
    except FileNotFoundError as error:
        raise DecodeError(
            f"{folder} has no {TRUTH_FILE}: the truth of this scene is not known",
            hint="only simulated rigs know it: fringed scan --rig simulated --compare-truth",
        ) from error
    except (OSError, ValueError, KeyError) as error:
        raise DecodeError(f"cannot read {path}: {error}") from error
