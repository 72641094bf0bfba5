"""A sequencer on a simulated rig in virtual time, with the frames kept in memory: what its tests share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.registry import open_camera, open_projector
from scanner.capture import FrameRecord, digest
from scanner.clock import VirtualClock
from scanner.decode import decoder_for
from scanner.devices import Pixels, TriggerMode, Truth
from scanner.patterns import CameraFormat, GrayPattern, PatternSequence, PmpPattern, ProjectorSize
from scanner.patterns.sequence import Precorrection
from scanner.sequencer import Acquisition, Rig, acquire
from scanner.sequencer.thumbnail import thumbnail

QUICK = ProjectorSize(320, 240)


@dataclass
class MemorySink:
    """A `FrameSink` that keeps everything."""

    frames: list[Pixels] = field(default_factory=list)
    records: list[FrameRecord] = field(default_factory=list)

    def write(self, pixels: Pixels) -> tuple[int, str]:
        self.frames.append(pixels.copy())
        return len(self.frames) - 1, digest(pixels)

    def record(self, record: FrameRecord) -> None:
        self.records.append(record)

    def offset(self, slot: int) -> int:
        return 128 + slot * self.frames[slot].nbytes


def pmp(
    frequencies: tuple[float, ...] = (1.0, 8.0),
    shifts: tuple[int, ...] = (8, 8),
    axes: tuple[Any, ...] = ("y",),
    gamma: float | None = 2.3,
) -> PatternSequence:
    """A bracketed PMP sequence for the quick rig, linear at the default gamma of its projector."""
    correction = None if gamma is None else Precorrection(gamma=gamma)
    return PatternSequence.bracketed(QUICK, PmpPattern(axes, frequencies, shifts), correction)


def gray(bits: int = 7, inverse: bool = True) -> PatternSequence:
    """A bracketed Gray code sequence for the quick rig."""
    return PatternSequence.bracketed(QUICK, GrayPattern(("y",), bits, 8, "gray", inverse))


@dataclass
class Taken:
    """What a run gave."""

    acquisition: Acquisition
    sequence: PatternSequence
    sink: MemorySink
    truth: Truth
    format: CameraFormat

    @property
    def frames(self) -> dict[int, Pixels]:
        """By position: the frame that counts."""
        last = self.acquisition.last
        return {p: self.sink.frames[r.slot] for p, r in last.items() if r.slot is not None}

    @property
    def thumbnails(self) -> dict[int, Pixels]:
        return {p: thumbnail(frame) for p, frame in self.frames.items()}

    def error_px(self) -> NDArray[np.float32]:
        """|decoded - true| rows of the pixels that were decoded."""
        decoder = decoder_for(self.sequence, self.format)
        for position, frame in self.frames.items():
            decoder.add(position, frame)
        rows = decoder.finish().rows
        assert rows is not None
        found = np.isfinite(rows)
        assert found.sum() > 0.5 * (self.truth.lit & (self.truth.rows > 0)).sum()
        error: NDArray[np.float32] = np.abs(rows - self.truth.rows)[found]
        return error


def take(
    sequence: PatternSequence,
    faults: str = "",
    *,
    scene: str = "board",
    seed: int = 1,
    mode: TriggerMode = TriggerMode.SOFTWARE,
    exposure_ns: int | None = 12_500_001,
    **options: Any,
) -> Taken:
    """Run a sequence on the quick rig. faults: `key=value&...` of the simulated devices."""
    device = f"quick/{scene}?seed={seed}" + ("&" + faults if faults else "")
    clock = VirtualClock()
    projector, camera = open_projector("simulated", device, {}, clock), open_camera("simulated", device, {}, clock)
    try:
        rig = Rig(projector, camera, trigger_mode=mode)
        sink = MemorySink()
        made = rig.plan(sequence, exposure_ns=exposure_ns)
        acquisition = acquire(rig, made, sequence, sink, clock, **options)
        caps = camera.capabilities
        truth = camera.truth()  # type: ignore[attr-defined]
        return Taken(acquisition, sequence, sink, truth, CameraFormat(caps.width, caps.height, caps.bits))
    finally:
        camera.close()
        projector.close()
