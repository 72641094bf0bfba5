"""What is shown to the simulated rig, and what it captures: single frames, PMP clouds, clouds from decoded rows."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from drivers.registry import open_camera, open_projector
from scanner.clock import VirtualClock
from scanner.decode import Decoded, decoder_for
from scanner.decode.stages import Stage
from scanner.devices import CameraSettings, TriggerMode, Truth
from scanner.geometry import Calibration
from scanner.patterns import (
    CameraFormat,
    CompositePattern,
    McpPattern,
    Pattern,
    PatternSequence,
    PmpPattern,
    ProjectorSize,
)
from scanner.patterns.sequence import Precorrection
from scanner.triangulation import triangulate

SEEDS = (0, 1, 2)
GAMMA = 2.3
"""Of the rig's projector, corrected before projection (sec. 5.6)."""

PUBLISHED = McpPattern(carriers=(90.0, 106.0, 120.0, 132.0), codes=tuple(range(16)), levels="composite")
"""Carriers that the camera sees as 78, 92, 104 and 115 cycles per field of view, as captured in sec. 5.6."""

THIRD_GENERATION = McpPattern(carriers=(136.0, 182.0, 232.0, 253.0), codes=tuple(range(16)), levels="composite")
"""The pattern of the comparison with the first generation (sec. 5.6)."""

FIRST_GENERATION = CompositePattern(carriers=(50.0, 100.0, 150.0, 200.0))
UNIT_PMP = PmpPattern(frequencies=(1.0,), shifts=(4,))
FINE_PMP = PmpPattern(frequencies=(1.0, 8.0, 64.0), shifts=(8, 8, 8))

PX_PER_CYCLE = 0.8699
"""Cycles per camera field over cycles per projector field: 555 of 638 mm at the target."""


@dataclass(frozen=True)
class Picture:
    """Any one image as a pattern. key tells two of them apart."""

    key: str
    light: Any = field(compare=False, hash=False)
    """(height, width) float32, linear light"""

    method: ClassVar[str] = "picture"
    fringe_count: ClassVar[int] = 1

    def validate(self, projector: ProjectorSize) -> None:
        """Any picture can be shown."""

    def fringe(self, index: int, projector: ProjectorSize) -> Any:
        """The picture."""
        return self.light

    def describe(self) -> dict[str, Any]:
        """Nothing that a decoder reads."""
        return {"method": self.method}


@dataclass(frozen=True, eq=False)
class Shot:
    """Frames of one pattern, and what there is to know about the scene."""

    frames: list[Any]
    sequence: PatternSequence
    camera: CameraFormat
    truth: Truth
    calibration: Calibration

    @property
    def frame(self) -> Any:
        """The first frame."""
        return self.frames[0]


@lru_cache(maxsize=24)
def shoot(scene: str, seed: int, pattern: Pattern, gamma: float | None = GAMMA, options: str = "") -> Shot:
    """Project a pattern on a scene of casey2011 and capture it.

    gamma: corrected for before projection; None: not at all. options: of the simulated world, key=value&key=value.
    """
    with _open(f"casey2011/{scene}?seed={seed}" + (f"&{options}" if options else "")) as (camera, projector, clock):
        size = ProjectorSize(projector.capabilities.width, projector.capabilities.height)
        precorrection = None if gamma is None else Precorrection(gamma=gamma)
        sequence = PatternSequence(size, pattern, precorrection=precorrection)
        frames = []
        for position in range(len(sequence)):
            projector.load([sequence.image(position)])
            projector.show(0)
            clock.sleep_until(clock.now_ns() + 200_000_000)
            camera.trigger()
            frames.append(camera.pop(1_000_000_000).pixels.copy())
        cap = camera.capabilities
        form = CameraFormat(cap.width, cap.height, cap.bits)
        return Shot(frames, sequence, form, camera.truth(), camera.true_calibration())


@contextmanager
def _open(device: str) -> Iterator[tuple[Any, Any, VirtualClock]]:
    clock = VirtualClock()
    camera = open_camera("simulated", device, {}, clock)
    projector = open_projector("simulated", device, {}, clock)
    try:
        camera.apply(CameraSettings(exposure_ns=33_333_333))
        camera.start(TriggerMode.SOFTWARE)
        yield camera, projector, clock
    finally:
        camera.close()
        projector.close()


def decode(shot: Shot, name: str = "default", stages: dict[str, Any] | None = None) -> Decoded:
    """Decode a shot; `stages` takes copies of the intermediate images by name.

    Raises:
        DecodeError: it cannot be decoded.
    """

    def keep(stage: Stage) -> None:
        if stages is not None:
            stages[stage.name] = stage.values.copy()

    decoder = decoder_for(shot.sequence, shot.camera, name, None if stages is None else keep)
    for position, frame in enumerate(shot.frames):
        decoder.add(position, frame)
    return decoder.finish()


def cloud(shot: Shot, rows: Any) -> Any:
    """(H, W, 3) float32 mm of projector rows (H, W), by the rig's true calibration."""
    return triangulate(shot.calibration, rows=np.asarray(rows, np.float32)).xyz


@lru_cache(maxsize=8)
def pmp_cloud(scene: str, seed: int, pattern: PmpPattern) -> Any:
    """(H, W, 3) float32 mm: what PMP makes of the scene."""
    shot = shoot.__wrapped__(scene, seed, pattern)  # 24 frames are not worth keeping
    return cloud(shot, decode(shot).rows)
