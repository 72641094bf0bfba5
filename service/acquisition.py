"""One scan on the devices: plan, ask for room, run the sequencer into the capture folder, close it. Runs in the devices
process; what it has to say goes to the daemon through `Say`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import to_builtins

from scanner.capture import CaptureHeader, CaptureWriter, FrameRecord, State
from scanner.clock import Clock
from scanner.devices import Image, KnowsTruth
from scanner.errors import ConfigError, DeviceLost, ScannerError, StorageError, SyncError
from scanner.patterns import CameraFormat
from scanner.sequencer import Acquisition, FinishReason, Plan, acquire
from scanner.storage import replace_json, storage_errors
from scanner.stream import EndReason
from scanner.wire import ScanStart, error_body
from service.endings import reason_of
from service.pipe import Began, Ended, Frames, Need, Report, Taken
from service.scan_setup import OpenRig, sequence_for
from service.write_back import WriteBack, WriteBacks

Say = Callable[[Report], None]

RESULT_BYTES_PER_PIXEL = 110
"""Room asked for the scan's files: eight float maps, points and normals in scan.npz and cloud.ply, and the picture."""


class Scan:
    """One scan, from parameters to a closed capture folder.

    `prepare` plans and says `need`; `run` takes the frames and says `ended`. `cancel` may be called from any thread.
    """

    def __init__(self, job: str, folder: Path, params: ScanStart, opened: OpenRig, clock: Clock, say: Say) -> None:
        self.job = job
        self._folder = folder
        self._params = params
        self._opened = opened
        self._clock = clock
        self._say = say
        self._cancelled = threading.Event()
        self._seen: set[int] = set()
        self._lines = 0
        self._retakes = 0
        self._exposure: dict[str, object] = {"mode": "given"}
        self.lost: DeviceLost | None = None
        """the device that went away while it ran"""

    def cancel(self) -> None:
        """Stop between two frames."""
        self._cancelled.set()

    def prepare(self) -> None:
        """Check the parameters, measure what is to be measured, plan, and say `need`.

        Raises:
            ConfigError: the parameters make no sense, or the plan refuses.
            DeviceError: a device failed.
        """
        params = self._params
        _check_filters(params)
        if params.compare_truth and not isinstance(self._opened.rig.camera, KnowsTruth):
            raise ConfigError(
                "the truth of this scene is not known: its camera is a real one",
                hint="compare_truth works with simulated rigs",
            )
        self._sequence = sequence_for(self._opened, params)
        if len(self._sequence) > 1:
            self._opened.measure_latency(self._clock)
        rig = self._opened.rig
        exposure_ns, self._exposure = self._opened.exposure_for(self._clock, self._sequence, params.exposure)
        self._plan: Plan = rig.plan(self._sequence, exposure_ns=exposure_ns, **self._plan_options())
        capabilities = rig.camera.capabilities
        self._format = CameraFormat(capabilities.width, capabilities.height, capabilities.bits, capabilities.mosaic)
        self._frame_bytes = self._format.width * self._format.height * self._format.dtype.itemsize
        self._say(self._need())

    def _plan_options(self) -> dict[str, Any]:
        return {"repeat": self._params.repeat}

    def _need(self) -> Need:
        frames = self._plan.frame_count
        results = RESULT_BYTES_PER_PIXEL * self._format.width * self._format.height
        return Need(self.job, frames, frames * self._frame_bytes + results, self._plan.as_dict())

    def run(self, write_backs: WriteBacks) -> None:
        """Take the frames, and say `taken` when the devices are free; `ended` follows when the folder is closed."""
        images = self._images()
        if self._cancelled.is_set():
            self._say(Ended(self.job, "cancelled"))
            return
        calibration = self._opened.calibration
        header = CaptureHeader(
            self._sequence,
            self._format,
            id=self.job,
            repeat=self._plan.repeat,
            calibration=None if calibration is None else "calibration.json",
            plan=self._plan.as_dict(),
            extra={"exposure": self._exposure, **self._opened.scan_state(self._clock)},
        )
        writer = CaptureWriter(self._folder, header, self._plan.frame_count)
        with write_backs.of(writer, self._frame_bytes) as disk:
            try:
                if calibration is not None:
                    replace_json(self._folder / "calibration.json", calibration.as_dict())
                self._write_truth()
                self._say(Began(self.job))
                outcome = self._acquire(writer, disk, images)
            except ScannerError as error:
                self.lost = error if isinstance(error, DeviceLost) else None
                disk.close("failed", reason_of(error), (), self._ended_by(error))
                return
            self.lost = outcome.error if isinstance(outcome.error, DeviceLost) else None
            completed = outcome.reason is FinishReason.COMPLETED
            # Before anything waits for a disk: clients wait for this word.
            self._say(Taken(self.job, self._lines if completed and not outcome.missing else None))
            state: State = "complete" if completed else "failed"
            disk.close(state, outcome.reason.value, outcome.witnesses.as_list(), self._ended_with(outcome))

    def _ended_with(self, outcome: Acquisition) -> Callable[[StorageError | None], None]:
        def say(problem: StorageError | None) -> None:
            error = problem or self._with_timing(outcome)
            reason: EndReason = outcome.reason.value if problem is None else reason_of(problem) or "disk_full"
            body = None if error is None else error_body(error)
            self._say(Ended(self.job, reason, self._lines, list(outcome.missing), body, outcome.report()))

        return say

    def _with_timing(self, outcome: Acquisition) -> ScannerError | None:
        """A run's error; of one that is out of step with what to do about latency and settling as this rig has them."""
        error = outcome.error
        if isinstance(error, SyncError) and outcome.reason is FinishReason.SYNC_LOST:
            error.hint = self._opened.timing_hint
        return error

    def _ended_by(self, error: ScannerError) -> Callable[[StorageError | None], None]:
        # On a disk that is full the folder cannot be closed: it stays `open`, which says that it was interrupted.
        return lambda _: self._say(Ended(self.job, reason_of(error), self._lines, error=error_body(error)))

    def refused(self, error: ScannerError | None) -> Ended:
        """The report of a scan that never began."""
        return Ended(self.job, None, error=None if error is None else error_body(error))

    def _images(self) -> list[Image]:
        """What the projector is to load, as far as it was made until a cancel; nothing where it holds the sequence."""
        images: list[Image] = []
        if self._opened.loaded != self._sequence:
            for position in range(len(self._sequence)):
                if self._cancelled.is_set():
                    break
                images.append(self._opened.rig.oriented(self._sequence.image(position)))
        return images

    def _acquire(self, writer: CaptureWriter, disk: WriteBack, images: list[Image]) -> Acquisition:
        def on_frame(record: FrameRecord, _offset: int | None) -> None:
            self._lines += 1
            if record.slot is not None:
                self._retakes += record.pattern in self._seen
                self._seen.add(record.pattern)
                disk.frame()
            self._say(Frames(self.job, self._lines, len(self._seen), self._retakes))

        opened = self._opened
        opened.loaded = None
        if images:
            opened.rig.projector.load(images)
        outcome = acquire(
            opened.rig,
            self._plan,
            self._sequence,
            writer,
            self._clock,
            on_frame=on_frame,
            cancelled=self._cancelled.is_set,
            load=False,
        )
        if outcome.reason is not FinishReason.DEVICE_LOST:
            opened.loaded = self._sequence
        return outcome

    def _write_truth(self) -> None:
        camera = self._opened.rig.camera
        if not self._params.compare_truth or not isinstance(camera, KnowsTruth):
            return
        truth = camera.truth()
        path = self._folder / "truth.npz"
        with storage_errors(path):
            np.savez(path, rows=truth.rows, columns=truth.columns, xyz=truth.xyz, lit=truth.lit)


def _check_filters(params: ScanStart) -> None:
    """Refuse filters that make no sense before anything moves; the worker applies them."""
    given = to_builtins(params.filters)
    if given:
        from scanner.filter_settings import FilterSettings  # noqa: PLC0415  (brings the kernels; most scans give no filter)

        FilterSettings.from_dict(given)
