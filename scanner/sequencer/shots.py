"""Single test shots outside a run: show one of a few flat images, take one frame of it. For measuring, not scanning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import TracebackType

import numpy as np

from scanner.clock import Clock
from scanner.devices import (
    Camera,
    CameraFrame,
    CameraSettings,
    Exposure,
    Flip,
    Interval,
    Pixels,
    Projector,
    ProjectorKind,
    TriggerMode,
)
from scanner.errors import ConfigError, DeviceError
from scanner.sequencer.plan import ASSUMED_REFRESHES
from scanner.sequencer.thumbnail import thumbnail

BLACK, WHITE = 0, 1

HOST_SLACK_NS = 500_000_000
"""A frame that has not come so long after it was due is lost."""

SHOTS = 3
"""A shot of steady light is tried so often: where one frame in ten is lost, one shot in a thousand fails."""


@dataclass(frozen=True, eq=False)
class Shot:
    """One frame: its thumbnail, when it was exposed, and the flip before it."""

    pixels: Pixels
    exposure: Exposure
    flip: Flip


class Shots:
    """Takes test shots of black, white or other images; a context manager that leaves the camera stopped."""

    def __init__(
        self,
        projector: Projector,
        camera: Camera,
        clock: Clock,
        *,
        trigger_mode: TriggerMode | None = None,
        settings: CameraSettings | None = None,
        light_delay_ns: int | None = None,
    ) -> None:
        """Load full-off and full-on images.

        Args:
            light_delay_ns: from a flip to steady light; None: what the projector declares, or an assumption.

        Raises:
            ConfigError: the camera can be triggered neither by software nor run free.
        """
        self.projector, self.camera, self.clock = projector, camera, clock
        self.settings = settings or CameraSettings()
        modes = camera.capabilities.trigger_modes
        own = TriggerMode.SOFTWARE if TriggerMode.SOFTWARE in modes else TriggerMode.FREE
        # A trigger line is for runs: single shots of a rig that has one are taken like those of any other.
        self.mode = own if trigger_mode in (None, TriggerMode.HARDWARE) else trigger_mode
        if self.mode not in modes:
            raise ConfigError("test shots need a camera with software trigger or free run", device=camera.name)
        size = projector.capabilities
        black = np.zeros((size.height, size.width), dtype=np.uint8)
        images: Sequence[Pixels] = (black, np.full_like(black, 255))
        if size.kind is ProjectorKind.STATIC:
            images = images[1:]
        self.images = len(images)
        projector.load([image.astype(np.uint8, copy=False) for image in images])
        self.light_delay_ns = declared_delay_ns(projector) if light_delay_ns is None else light_delay_ns
        self.exposure_ns = 0

    def __enter__(self) -> Shots:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.camera.stop()

    def expose_for(self, exposure_ns: int) -> int:
        """Stop, set the exposure, start again. Returns what the camera took."""
        self.camera.stop()
        taken = self.camera.apply(replace(self.settings, exposure_ns=exposure_ns))
        self.exposure_ns = exposure_ns if taken.exposure_ns is None else taken.exposure_ns
        self.camera.start(self.mode)
        return self.exposure_ns

    def show(self, image: int) -> Flip:
        """Flip to black or white; static projectors have white alone."""
        return self.projector.show(min(image, self.images - 1))

    def steady(self, image: int) -> Shot:
        """A frame of an image that certainly shines; one that is lost or comes in part is taken again.

        Raises:
            DeviceError: none of SHOTS came.
        """
        for _ in range(SHOTS - 1):
            if (shot := self._taken(self.show(image), self.light_delay_ns)) is not None:
                return shot
        return self.after(self.show(image), self.light_delay_ns)

    def after(self, flip: Flip, delay_ns: int) -> Shot:
        """The frame whose exposure begins `delay_ns` after a flip (software trigger), or the first one later.

        Raises:
            DeviceError: no frame came.
        """
        if (shot := self._taken(flip, delay_ns)) is None:
            raise DeviceError(
                "no frame came for a test shot", device=self.camera.name, hint="is another program using the camera?"
            )
        return shot

    def _taken(self, flip: Flip, delay_ns: int) -> Shot | None:
        due = flip.t_ns + delay_ns
        if self.mode is TriggerMode.SOFTWARE:
            latency = self.camera.capabilities.trigger_latency or Interval(0, 0)
            self.clock.sleep_until(due - latency.low_ns)
            self.camera.trigger()
        frame = self._pop(due if self.mode is TriggerMode.FREE else flip.t_ns)
        return None if frame is None else Shot(thumbnail(frame.pixels), frame.exposure, flip)

    def _pop(self, earliest_ns: int) -> CameraFrame | None:
        caps = self.camera.capabilities
        until = self.clock.now_ns() + caps.min_period_ns(self.exposure_ns) * 2 + caps.readout_ns + HOST_SLACK_NS
        while (frame := self.camera.pop(max(0, until - self.clock.now_ns()))) is not None:
            if frame.complete and frame.exposure.start_ns + frame.exposure.bound_ns >= earliest_ns:
                return frame
        return None


def declared_delay_ns(projector: Projector) -> int:
    """From a flip's stamp to steady light, as declared; with `ASSUMED_REFRESHES` for what is not."""
    caps = projector.capabilities
    known = sum(interval.high_ns for interval in (caps.latency, caps.settle) if interval is not None)
    return known + (0 if caps.latency and caps.settle else ASSUMED_REFRESHES * caps.refresh_ns)
