"""Runs a plan on devices: shows patterns, takes frames, writes each with its pairing, and retakes what is in doubt.

It never waits for whoever reads the frames: pixels go to a sink (the capture folder) and that is all. It decides
nothing about content itself; `verify` judges the stamps and `witness` the pictures, both on what was recorded.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Literal, Protocol

from scanner.capture import FrameRecord, Verdict
from scanner.clock import Clock
from scanner.devices import Camera, CameraFrame, Flip, Pixels, Projector, TriggerMode
from scanner.errors import DeviceLost, ScannerError, SyncError
from scanner.patterns import PatternSequence
from scanner.sequencer.disorder import set_of, sync_error
from scanner.sequencer.findings import Witnesses
from scanner.sequencer.hearing import Hearing
from scanner.sequencer.plan import Mode, Plan
from scanner.sequencer.rig import Rig
from scanner.sequencer.steady import Steady
from scanner.sequencer.triggered import TriggeredRounds
from scanner.sequencer.verify import FrameVerdict, judge, summary, verify

_TRIGGER_MODES = {
    Mode.FREE: TriggerMode.FREE,
    Mode.SOFTWARE: TriggerMode.SOFTWARE,
    Mode.HARDWARE: TriggerMode.HARDWARE,
}


class FrameSink(Protocol):
    """Where frames go; `scanner.capture.CaptureWriter` is one."""

    def write(self, pixels: Pixels) -> tuple[int, str]:
        """Take pixels; returns (slot, digest)."""

    def record(self, record: FrameRecord) -> None:
        """Take the frame's line, after its pixels."""

    def offset(self, slot: int) -> int:
        """Byte offset of a slot's pixels in the frames file."""


OnFrame = Callable[[FrameRecord, int | None], None]
"""Called after each record with the byte offset of its pixels in the sink's file (None: the frame is missing)."""


class FinishReason(StrEnum):
    """How a run ended. The names are those of the stream's `end` message.

    running ──all frames whole, witnesses content──────────────> completed
       │  └─in doubt─> retaking ──(content)────────────────────> completed
       │                  └──still in doubt after the last round> sync_lost
       ├── cancelled() said so, between two slots ─────────────> cancelled
       ├── a device went away ─────────────────────────────────> device_lost
       └── static run, frames lost, on_overrun "stop" ─────────> overrun
    """

    COMPLETED = "completed"
    CANCELLED = "cancelled"
    DEVICE_LOST = "device_lost"
    SYNC_LOST = "sync_lost"
    OVERRUN = "overrun"


@dataclass(frozen=True)
class Acquisition:
    """What a run gave. `error` is set for device_lost, sync_lost and overrun; `raise_for_reason` raises it."""

    reason: FinishReason
    plan: Plan
    records: tuple[FrameRecord, ...]
    """every line that was recorded, in order"""
    verdicts: tuple[FrameVerdict, ...] = ()
    witnesses: Witnesses = field(default_factory=Witnesses)
    retakes: int = 0
    """frames taken again"""
    dropped: int = 0
    """static runs: frames that the camera counted and nobody received"""
    error: ScannerError | None = None

    @property
    def last(self) -> dict[int, FrameRecord]:
        """By pattern index: the line that counts."""
        return {record.pattern: record for record in self.records}

    @property
    def missing(self) -> tuple[int, ...]:
        """Pattern indices without a whole frame."""
        last = self.last
        return tuple(
            pattern
            for pattern in range(self.plan.frame_count)
            if pattern not in last or last[pattern].status == "missing"
        )

    def raise_for_reason(self) -> Acquisition:
        """Raise `error` if there is one, else return self."""
        if self.error is not None:
            raise self.error
        return self

    def report(self) -> dict[str, Any]:
        """Counts for report.json and messages."""
        return {
            "reason": self.reason.value,
            "frames": self.plan.frame_count,
            "missing": list(self.missing),
            "retakes": self.retakes,
            "dropped": self.dropped,
            "verdicts": dict(summary(self.verdicts)),
        }


def acquire(
    rig: Rig,
    plan: Plan,
    sequence: PatternSequence,
    sink: FrameSink,
    clock: Clock,
    *,
    on_frame: OnFrame | None = None,
    cancelled: Callable[[], bool] | None = None,
    on_overrun: Literal["count", "stop"] = "count",
    load: bool = True,
) -> Acquisition:
    """Run `plan` and return how it ended; what was whole is recorded in every case.

    SyncError and DeviceLost are returned in `Acquisition.error`, so that the caller has counts and witnesses of a
    failed run too; call `raise_for_reason` where an exception is wanted.

    Args:
        on_frame: called after each record; a daemon streams from here. What it raises ends the run.
        cancelled: asked between slots.
        on_overrun: static runs, what to do when the camera counted frames that never came: "count" or "stop".
        load: whether to load the images; False when the projector holds this sequence already.

    Raises:
        ConfigError: the camera refuses the settings.
        DeviceError: a device refuses something other than by vanishing.
        StorageError: the sink could not write.
    """
    run = _Run(rig, plan, sequence, sink, clock, on_frame, cancelled or _never, on_overrun == "stop")
    try:
        if load:
            rig.projector.load([rig.oriented(sequence.image(position)) for position in range(len(sequence))])
        run.prepare()
        try:
            if plan.mode is Mode.STATIC:
                run.static()
            else:
                run.whole()
        finally:
            rig.camera.stop()
    except DeviceLost as lost:
        return run.finished(FinishReason.DEVICE_LOST, lost)
    except _Ended as ended:
        return run.finished(ended.reason, ended.error)
    return run.finished(FinishReason.COMPLETED, None)


def _never() -> bool:
    return False


class _Ended(Exception):
    """Unwinds a run that ends before its time."""

    def __init__(self, reason: FinishReason, error: ScannerError | None = None) -> None:
        super().__init__(reason.value)
        self.reason = reason
        self.error = error


class _Run:
    """One run's state: what was recorded so far."""

    def __init__(
        self,
        rig: Rig,
        plan: Plan,
        sequence: PatternSequence,
        sink: FrameSink,
        clock: Clock,
        on_frame: OnFrame | None,
        cancelled: Callable[[], bool],
        stop_on_overrun: bool,
    ) -> None:
        self.plan, self.sequence, self.sink, self.clock = plan, sequence, sink, clock
        self.camera: Camera = rig.camera
        self.projector: Projector = rig.projector
        self.triggered = TriggeredRounds(plan, rig.projector, rig.camera, rig.trigger, clock)
        self.settings = rig.settings
        self.on_frame, self.cancelled, self.stop_on_overrun = on_frame, cancelled, stop_on_overrun
        self.records: list[FrameRecord] = []
        self.attempts: dict[int, int] = {}
        self.verdicts: list[FrameVerdict] = []
        self.witnesses = Witnesses()
        self.retakes = self.dropped = 0
        self.hearing = Hearing(sequence, rig.camera.capabilities.max_value)

    def prepare(self) -> None:
        self.camera.apply(replace(self.settings, exposure_ns=self.plan.exposure_ns))
        self.hearing = Hearing(self.sequence, self.camera.capabilities.max_value)

    def finished(self, reason: FinishReason, error: ScannerError | None) -> Acquisition:
        self.verdicts = verify(self.plan, self.sequence, self.records)
        return Acquisition(
            reason,
            self.plan,
            tuple(self.records),
            tuple(self.verdicts),
            self.witnesses,
            self.retakes,
            self.dropped,
            error,
        )

    # --- static -------------------------------------------------------------------------------------------------

    def static(self) -> None:
        """One pattern stays on; frames as they come."""
        flip = self.projector.show(0)
        self.clock.sleep_until(flip.t_ns + self.plan.trigger_delay_ns)
        self.camera.start(TriggerMode.FREE)
        steady, taken = Steady(self.plan, flip), 0
        while taken < self.plan.repeat:
            self.go_on()
            frame = self.camera.pop(self.plan.pop_timeout_ns)
            if frame is None:
                self.missing(taken, flip)
                taken += 1
                continue
            if (lost := steady.lost_before(frame)) is None:
                continue
            if lost:
                self.lost(lost)
            self.take(taken, flip, frame)
            taken += 1

    def lost(self, count: int) -> None:
        self.dropped += count
        if self.stop_on_overrun:
            raise _Ended(
                FinishReason.OVERRUN,
                SyncError(
                    f"{count} frames were lost between camera and disk",
                    device=self.camera.name,
                    hint="the camera is faster than the spool: lower its frame rate, or spool to a faster disk",
                ),
            )

    # --- multi-frame --------------------------------------------------------------------------------------------

    def whole(self) -> None:
        """Every pattern once, then what is in doubt again, in bounded rounds."""
        self.camera.start(_TRIGGER_MODES[self.plan.mode])
        self.slots(range(self.plan.frame_count))
        for _ in range(self.plan.retakes):
            again = self.doubtful()
            if self.witnesses.dark:
                break
            if not again:
                return
            self.retakes += len(again)
            self.darken()
            self.slots(again)
        if self.doubtful() or self.witnesses.dark:
            raise _Ended(FinishReason.SYNC_LOST, self.out_of_step())

    def slots(self, patterns: Sequence[int]) -> None:
        if self.plan.mode is Mode.HARDWARE:
            black = next(iter(self.sequence.sentinels), 0)
            for pattern, flip in self.triggered.round(patterns, black, self.take, self.go_on).items():
                self.missing(pattern, flip)
            return
        for pattern in patterns:
            self.go_on()
            flip = self.projector.show(pattern % self.plan.patterns)
            frame = self.software(pattern, flip) if self.plan.mode is Mode.SOFTWARE else self.free(pattern, flip)
            if frame is None:
                self.missing(pattern, flip)
            else:
                self.take(pattern, flip, frame)

    def go_on(self) -> None:
        if self.cancelled():
            raise _Ended(FinishReason.CANCELLED)

    def darken(self) -> None:
        """Black for a while, as before the first round: light that comes late must not follow what it should be."""
        black = next(iter(self.sequence.sentinels), None)
        if black is not None:
            flip = self.projector.show(black)
            self.clock.sleep_until(flip.t_ns + self.plan.period_ns)

    def software(self, pattern: int, flip: Flip) -> CameraFrame | None:
        """Wait for the light, trigger, take this trigger's frame; older ones that still come are dropped."""
        self.clock.sleep_until(flip.t_ns + flip.bound_ns + self.plan.trigger_delay_ns)
        called_ns = self.clock.now_ns()
        self.camera.trigger()
        self.hearing.listen(pattern)  # while it is exposed
        until = called_ns + self.plan.pop_timeout_ns
        while (frame := self.camera.pop(max(0, until - self.clock.now_ns()))) is not None:
            if frame.exposure.start_ns + frame.exposure.bound_ns >= called_ns:
                return frame
        return None

    def free(self, pattern: int, flip: Flip) -> CameraFrame | None:
        """The first frame that certainly began in the new light. The pattern stays on until it has arrived."""
        self.hearing.listen(pattern)  # while it is exposed
        ready = flip.t_ns + flip.bound_ns + self.plan.window_start_ns
        until = ready + self.plan.pop_timeout_ns
        while (frame := self.camera.pop(max(0, until - self.clock.now_ns()))) is not None:
            if frame.exposure.start_ns - frame.exposure.bound_ns >= ready:
                self.clock.sleep_until(flip.t_ns + (self.plan.dwell - 1) * self.plan.refresh_ns)
                return frame
        return None

    def take(self, pattern: int, flip: Flip, frame: CameraFrame) -> None:
        if self.plan.patterns > 1 and pattern < self.plan.patterns * self.plan.repeat:
            self.hearing.take(pattern, frame.pixels)
        slot, digest = self.sink.write(frame.pixels)
        record = FrameRecord(
            slot,
            pattern,
            self.attempt(pattern),
            "ok" if frame.complete else "incomplete",
            digest,
            frame.frame_id,
            frame.trigger,
            frame.exposure,
            flip,
        )
        self.put(record, self.sink.offset(slot))

    def missing(self, pattern: int, flip: Flip) -> None:
        self.hearing.lose(pattern)
        self.put(FrameRecord(None, pattern, self.attempt(pattern), "missing", flip=flip), None)

    def attempt(self, pattern: int) -> int:
        self.attempts[pattern] = self.attempts.get(pattern, -1) + 1
        return self.attempts[pattern]

    def put(self, record: FrameRecord, offset: int | None) -> None:
        verdict: Verdict = "unproved" if record.slot is None else judge(self.plan, record, None).verdict
        record = replace(record, verdict=verdict)
        self.records.append(record)
        self.sink.record(record)
        if self.on_frame is not None:
            self.on_frame(record, offset)

    # --- doubt ----------------------------------------------------------------------------------------------------

    def doubtful(self) -> list[int]:
        """Pattern indices to take again; empty when stamps and content agree with the plan."""
        self.verdicts = verify(self.plan, self.sequence, self.records)
        found = {verdict.pattern for verdict in self.verdicts if verdict.suspect}
        whole: set[int] = set()
        for repetition in range(self.plan.repeat):
            first = repetition * self.plan.patterns
            # Frames already known to be wrong would only confuse the content of the others.
            seen = self.hearing.witnesses(repetition, without=found)
            self.witnesses = seen if repetition == 0 else self.witnesses.joined(seen)
            found.update(first + position for position in seen.suspects)
            if seen.whole:
                whole.update(range(first, first + self.plan.patterns))
        return sorted(self.with_sets(found) | whole)

    def with_sets(self, patterns: set[int]) -> set[int]:
        """The patterns, each with its whole set where the set's frames are older than the plan allows."""
        now, last = self.clock.now_ns(), {record.pattern: record for record in self.records}
        found = set(patterns)
        for pattern in patterns:
            repetition, position = divmod(pattern, self.plan.patterns)
            members = [repetition * self.plan.patterns + p for p in set_of(self.sequence, position)]
            ends = [e.end_ns for p in members if (r := last.get(p)) is not None and (e := r.exposure) is not None]
            if ends and now - max(ends) > self.plan.max_set_ms * 1_000_000:
                found.update(members)
        return found

    def out_of_step(self) -> ScannerError:
        suspects = sorted({v.pattern % self.plan.patterns for v in self.verdicts if v.suspect})
        said = self.triggered.faults
        return sync_error(self.sequence, self.verdicts, self.witnesses, suspects, self.retakes, said=said)
