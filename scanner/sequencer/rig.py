"""A rig as the sequencer takes it: opened devices, what was measured of them, and how the projector hangs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from scanner.devices import Camera, CameraSettings, Image, Interval, Projector, TriggerBoard, TriggerMode
from scanner.patterns import PatternSequence
from scanner.sequencer.plan import Plan, plan


@dataclass(frozen=True)
class Rig:
    """The opened devices and what was measured of them.

    `latency` and `settle` are the rig's own measured values and override the projector's; `trigger_mode` None means
    hardware trigger where there is a board, else software trigger where the camera has one, else free run. `mirror`
    and `rotate` say how the projector hangs: they are applied to each image before it is loaded (mirror first), so
    that patterns land as described.
    """

    projector: Projector
    camera: Camera
    trigger: TriggerBoard | None = None
    latency: Interval | None = None
    settle: Interval | None = None
    dwell: int | None = None
    settings: CameraSettings = field(default_factory=CameraSettings)
    trigger_mode: TriggerMode | None = None
    mirror: bool = False
    rotate: Literal[0, 180] = 0

    @property
    def light_known(self) -> bool:
        """Whether latency and settling are both known, each from the rig file or the driver: one proves nothing."""
        declared = self.projector.capabilities
        return (self.latency or declared.latency) is not None and (self.settle or declared.settle) is not None

    def plan(self, sequence: PatternSequence, **options: Any) -> Plan:
        """`plan` with this rig's devices and measured values; options are those of `plan` and go before the rig's."""
        own: dict[str, Any] = {
            "latency": self.latency,
            "settle": self.settle,
            "dwell": self.dwell,
            "exposure_ns": self.settings.exposure_ns,
            "trigger_mode": self.trigger_mode,
            "board": None if self.trigger is None else self.trigger.capabilities,
        }
        return plan(self.projector.capabilities, self.camera.capabilities, sequence, **{**own, **options})

    def oriented(self, image: Image) -> Image:
        """An image as this projector must be given it. (H, W) uint8, C-contiguous."""
        if self.mirror:
            image = image[:, ::-1]
        if self.rotate == 180:
            image = image[::-1, ::-1]
        return np.ascontiguousarray(image)
