"""A live run on the devices: one pattern stays on, and every frame is stored and told as it comes. Runs in the devices
process, in place of `service.acquisition.Scan`, whose parameters, exposure and images it shares.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scanner.capture import CaptureHeader, FrameRecord
from scanner.clock import Clock
from scanner.devices import Exposure, TriggerMode
from scanner.errors import ConfigError, DeviceLost, ScannerError
from scanner.patterns import McpPattern
from scanner.sequencer import EndlessFrame, endless
from scanner.stream import EndReason
from scanner.triangulation import require_depth_axis
from scanner.wire import LiveStart, ScanStart, error_body
from service.acquisition import Say, Scan
from service.endings import reason_of
from service.live_storage import SEGMENT, FrameRing, LiveStorage, Recording, ring_slots
from service.pipe import AcquireLive, Ended, Kept, LiveBegan, Need, Shot, Taken
from service.scan_setup import OpenRig
from service.write_back import WriteBacks


class LiveRun(Scan):
    """One live run: `prepare` plans and says `need`; `run` takes frames until `cancel` or the end of its time."""

    def __init__(self, command: AcquireLive, opened: OpenRig, clock: Clock, say: Say) -> None:
        super().__init__(command.job, Path(command.folder), as_scan(command.params), opened, clock, say)
        self._live = command.params
        self._lost = 0
        self._kept = Kept(command.job, 0, 0)

    def _need(self) -> Need:
        """Room for the ring, or for the first two folders of the recording."""
        pattern = self._sequence.pattern
        if len(self._sequence) != 1 or not isinstance(pattern, McpPattern):
            raise ConfigError("live takes a pattern of one image", hint="leave white and black out of the pattern")
        calibration = self._opened.calibration
        if self._live.content == "xyz":
            if calibration is None:
                raise ConfigError(
                    "xyz needs a calibration, and this rig has none",
                    hint="name one in the rig file (rig.calibration), or take rows",
                )
            require_depth_axis(calibration, pattern.axis)
        frames = ring_slots(self._plan.camera_period_ns) if self._live.retain == "none" else 2 * SEGMENT
        return Need(self.job, 0, frames * self._frame_bytes, self._plan.as_dict())

    def _plan_options(self) -> dict[str, Any]:
        """The rig file's trigger mode brings flips and frames together; nothing flips here, so the camera runs free."""
        modes = self._opened.rig.camera.capabilities.trigger_modes
        usable = (mode for mode in (TriggerMode.FREE, TriggerMode.SOFTWARE) if mode in modes)
        if (mode := next(usable, None)) is None:
            raise ConfigError(
                "live needs a camera that runs free or takes software triggers",
                device=self._opened.rig.camera.name,
                hint="this one has a trigger line only: scan with it",
            )
        return {"repeat": SEGMENT, "trigger_mode": mode}

    def run(self, write_backs: WriteBacks) -> None:
        """Take frames, and say `taken` when the devices are free; `ended` follows when the recording is closed."""
        calibration = self._opened.calibration
        lenses = None if calibration is None else calibration.as_dict()
        header = CaptureHeader(
            self._sequence,
            self._format,
            id=self.job,
            repeat=SEGMENT,
            calibration=None if lenses is None else "calibration.json",
            plan=self._plan.as_dict(),
            extra={"exposure": self._exposure, **self._opened.scan_state(self._clock)},
        )
        try:
            storage = self._storage(header, lenses)
        except ScannerError as error:
            self._say(Ended(self.job, reason_of(error), error=error_body(error)))
            return
        failed: ScannerError | None = None
        try:
            self._say(LiveBegan(self.job, header.as_dict(), lenses))
            self._take_all(storage)
        except ScannerError as error:
            failed = error
            self.lost = error if isinstance(error, DeviceLost) else None
        finally:
            write_backs.close_behind(lambda: self._close(storage, failed))
            self._say(Taken(self.job))

    def _close(self, storage: LiveStorage, failed: ScannerError | None) -> None:
        """Close what is kept, and say `ended`. On a thread of its own."""
        reason: EndReason = "completed" if failed is None else reason_of(failed) or "device_lost"
        try:
            storage.close("complete" if failed is None else "failed", reason)
        except ScannerError as error:
            failed, reason = failed or error, reason_of(error) or "disk_full" if failed is None else reason
        body = None if failed is None else error_body(failed)
        report = {"lost": self._lost, "kept": {"frames": self._kept.frames, "bytes": self._kept.bytes}}
        self._say(Ended(self.job, reason, self._lines, error=body, report=report))

    def _storage(self, header: CaptureHeader, calibration: dict[str, Any] | None) -> LiveStorage:
        period = self._plan.camera_period_ns
        if self._live.retain == "none":
            return FrameRing(self._folder, self._format, ring_slots(period))
        keep = self._live.ring_s if self._live.retain == "ring" else None
        return Recording(
            self._folder,
            header,
            calibration,
            self._told_of,
            keep_s=keep,
            period_ns=period,
        )

    def _told_of(self, frames: int, size: int) -> None:
        self._kept = Kept(self.job, frames, size)
        self._say(self._kept)

    def _take_all(self, storage: LiveStorage) -> None:
        opened = self._opened
        load = opened.loaded != self._sequence
        opened.loaded = None
        frames = endless(opened.rig, self._plan, self._sequence, self._clock, self._cancelled.is_set, load=load)
        until: int | None = None
        try:
            for taken in frames:
                if until is None and self._live.seconds is not None:
                    until = exposure_of(taken.record).start_ns + round(self._live.seconds * 1e9)
                self._take(storage, taken)
                if until is not None and exposure_of(taken.record).end_ns >= until:
                    break
        finally:
            frames.close()
        opened.loaded = self._sequence

    def _take(self, storage: LiveStorage, taken: EndlessFrame) -> None:
        number, record = self._lines, taken.record
        path, offset, digest = storage.write(taken.pixels, record, number)
        self._lines += 1
        self._lost += taken.lost
        exposure = exposure_of(record)
        frame_id = -1 if record.frame_id is None else record.frame_id
        self._say(
            Shot(self.job, number, path, offset, digest, frame_id, exposure.start_ns, exposure.end_ns, self._lost)
        )


def exposure_of(record: FrameRecord) -> Exposure:
    """The exposure of a frame that came from a camera: there always is one."""
    if record.exposure is None:
        raise AssertionError("frames of a camera have stamps")
    return record.exposure


def as_scan(params: LiveStart) -> ScanStart:
    """A live run's parameters in a scan's words, for what both share."""
    return ScanStart(
        params.job_id,
        method=params.method,
        pattern=params.pattern,
        exposure=params.exposure,
        decoder=params.decoder,
        filters=params.filters,
    )
