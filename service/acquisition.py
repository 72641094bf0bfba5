"""One scan on the devices: plan, ask for room, run the sequencer into the capture folder, close it. Runs in the devices
process; what it has to say goes to the daemon through `Say`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from msgspec import to_builtins

from scanner.capture import CaptureHeader, CaptureWriter, FrameRecord, State
from scanner.clock import Clock
from scanner.devices import KnowsTruth
from scanner.errors import ConfigError, DeviceError, DeviceLost, ScannerError, StorageError, SyncError
from scanner.patterns import CameraFormat
from scanner.sequencer import Acquisition, FinishReason, Plan, acquire, auto_exposure
from scanner.storage import replace_json
from scanner.stream import EndReason
from scanner.wire import ScanStart, error_body
from service.pipe import Began, Ended, Frames, Need, Report
from service.scan_setup import OpenRig, sequence_for

Say = Callable[[Report], None]

RESULT_BYTES_PER_PIXEL = 110
"""Room asked for the scan's files: eight float maps, points and normals in scan.npz and cloud.ply, and the picture."""

SYNC_EVERY_BYTES = 16 << 20
"""Written back in passing, so that little is left to wait for at the end."""


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
        exposure_ns = self._exposure_ns()
        self._plan: Plan = rig.plan(self._sequence, repeat=params.repeat, exposure_ns=exposure_ns)
        capabilities = rig.camera.capabilities
        self._format = CameraFormat(capabilities.width, capabilities.height, capabilities.bits, capabilities.mosaic)
        self._frame_bytes = self._format.width * self._format.height * self._format.dtype.itemsize
        frames = self._plan.frame_count
        results = RESULT_BYTES_PER_PIXEL * self._format.width * self._format.height
        self._say(Need(self.job, frames, frames * self._frame_bytes + results, self._plan.as_dict()))

    def run(self) -> None:
        """Take the frames. Ends with `ended`, whatever happens."""
        try:
            ended = self._run()
        except ScannerError as error:
            ended = Ended(self.job, _reason_of(error), self._lines, error=error_body(error))
        self._say(ended)

    def refused(self, error: ScannerError | None) -> Ended:
        """The report of a scan that never began."""
        return Ended(self.job, None, error=None if error is None else error_body(error))

    def _run(self) -> Ended:
        calibration = self._opened.calibration
        header = CaptureHeader(
            self._sequence,
            self._format,
            id=self.job,
            repeat=self._plan.repeat,
            calibration=None if calibration is None else "calibration.json",
            plan=self._plan.as_dict(),
            extra={"exposure": self._exposure},
        )
        writer = CaptureWriter(self._folder, header, self._plan.frame_count)
        try:
            if calibration is not None:
                replace_json(self._folder / "calibration.json", calibration.as_dict())
            self._write_truth()
            self._say(Began(self.job))
            with _WriteBack(writer, self._frame_bytes) as syncing:
                outcome = self._acquire(writer, syncing)
            state: State = "complete" if outcome.reason is FinishReason.COMPLETED else "failed"
            writer.close(state, outcome.reason.value, witnesses=outcome.witnesses.as_list())
        except ScannerError as error:
            with suppress(StorageError):  # on a disk that is full the folder stays `open`: interrupted, as it is
                writer.close("failed", _reason_of(error))
            raise
        finally:
            writer.abandon()
        problem = None if outcome.error is None else error_body(outcome.error)
        reason: EndReason = outcome.reason.value
        return Ended(self.job, reason, self._lines, list(outcome.missing), problem, outcome.report())

    def _acquire(self, writer: CaptureWriter, syncing: _WriteBack) -> Acquisition:
        def on_frame(record: FrameRecord, _offset: int | None) -> None:
            self._lines += 1
            if record.slot is not None:
                self._retakes += record.pattern in self._seen
                self._seen.add(record.pattern)
                syncing.frame()
            self._say(Frames(self.job, self._lines, len(self._seen), self._retakes))

        return acquire(
            self._opened.rig,
            self._plan,
            self._sequence,
            writer,
            self._clock,
            on_frame=on_frame,
            cancelled=self._cancelled.is_set,
        )

    def _exposure_ns(self) -> int | None:
        wanted = self._params.exposure or self._opened.exposure or "auto"
        if isinstance(wanted, str):
            return self._auto_exposure_ns()
        if not 0 < wanted <= 10_000_000:
            raise ConfigError(f"exposure {wanted:g} us is outside 0 .. 10 s", hint='give microseconds, or "auto"')
        return round(wanted * 1000)

    def _auto_exposure_ns(self) -> int:
        rig = self._opened.rig
        choice = auto_exposure(
            rig.projector,
            rig.camera,
            self._clock,
            self._sequence,
            settings=rig.settings,
            trigger_mode=rig.trigger_mode,
            latency=rig.latency,
            settle=rig.settle,
        )
        self._exposure = {
            "mode": "auto",
            "exposure_us": choice.exposure_ns / 1000,
            "level": choice.level,
            "note": choice.note,
            "warning": choice.warning,
        }
        return choice.exposure_ns

    def _write_truth(self) -> None:
        camera = self._opened.rig.camera
        if not self._params.compare_truth or not isinstance(camera, KnowsTruth):
            return
        truth = camera.truth()
        np.savez(self._folder / "truth.npz", rows=truth.rows, columns=truth.columns, xyz=truth.xyz, lit=truth.lit)


class _WriteBack:
    """Syncs a capture in passing, in a thread of its own."""

    def __init__(self, writer: CaptureWriter, frame_bytes: int) -> None:
        self._writer = writer
        self._every = max(1, SYNC_EVERY_BYTES // frame_bytes)
        self._frames = 0
        self._wanted = threading.Event()
        self._closing = False
        self._error: StorageError | None = None
        self._thread = threading.Thread(target=self._sync, name="write-back")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing = True
        self._wanted.set()
        self._thread.join()

    def frame(self) -> None:
        """One more frame was written.

        Raises:
            StorageError: writing back failed.
        """
        if self._error is not None:
            raise self._error
        self._frames += 1
        if self._frames % self._every == 0:
            self._wanted.set()

    def _sync(self) -> None:
        while True:
            self._wanted.wait()
            self._wanted.clear()
            if self._closing:
                return
            try:
                self._writer.sync()
            except StorageError as error:
                self._error = error
                return


def _check_filters(params: ScanStart) -> None:
    """Refuse filters that make no sense before anything moves; the worker applies them."""
    given = to_builtins(params.filters)
    if given:
        from scanner.filters import FilterSettings  # noqa: PLC0415  (brings the kernels; most scans give no filter)

        FilterSettings.from_dict(given)


def _reason_of(error: ScannerError) -> EndReason | None:
    match error:
        case DeviceLost():
            return "device_lost"
        case SyncError():
            return "sync_lost"
        case StorageError():
            return "disk_full"
        case DeviceError():
            return "device_lost"
        case _:
            return None
