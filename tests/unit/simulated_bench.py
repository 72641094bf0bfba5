"""A simulated rig on a virtual clock, for the tests of the simulated devices."""

from __future__ import annotations

from typing import Any

import numpy as np

from drivers.simulated import camera_driver, projector_driver
from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.projector import SimulatedProjector
from scanner.clock import VirtualClock
from scanner.devices import CameraFrame, CameraSettings, Flip, TriggerMode

SECOND_NS = 1_000_000_000


class Bench:
    """Camera and projector in one world."""

    def __init__(
        self, device: str, camera: dict[str, Any] | None = None, projector: dict[str, Any] | None = None, up_s: int = 1
    ) -> None:
        """up_s: what the clock shows."""
        self.clock = VirtualClock(up_s * SECOND_NS)
        self.camera: SimulatedCamera = camera_driver.open(device, camera or {}, self.clock)
        self.projector: SimulatedProjector = projector_driver.open(device, projector or {}, self.clock)

    def greys(self, *values: int) -> list[np.ndarray]:
        """Load plain images of these values."""
        c = self.projector.capabilities
        images = [np.full((c.height, c.width), value, dtype=np.uint8) for value in values]
        self.projector.load(images)
        return images

    def steady(self, index: int) -> Flip:
        """Show an image and wait until it stands."""
        flip = self.projector.show(index)
        self.clock.sleep_until(flip.t_ns + 4 * self.projector.capabilities.refresh_ns)
        return flip

    def start(self, mode: TriggerMode, exposure_ns: int = 33_333_000) -> None:
        """Set the exposure and start the camera."""
        self.camera.apply(CameraSettings(exposure_ns=exposure_ns))
        self.camera.start(mode)

    def shot(self) -> CameraFrame:
        """Trigger, and the frame."""
        self.camera.trigger()
        return self.popped()

    def popped(self) -> CameraFrame:
        """The next frame."""
        frame = self.camera.pop(5 * SECOND_NS)
        assert frame is not None
        return frame

    def captured(self, images: list[np.ndarray]) -> list[np.ndarray]:
        """A steady, software-triggered frame of each image, as float64."""
        self.projector.load(images)
        self.start(TriggerMode.SOFTWARE)
        frames = []
        for i in range(len(images)):
            self.steady(i)
            frames.append(self.shot().pixels.astype(np.float64))
        self.camera.stop()
        return frames
