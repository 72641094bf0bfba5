"""Rigs that differ from those of scenes.json in what real ones differ: roll, pixels, lenses, where the projector is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from held_out.lenses import Optic


@dataclass(frozen=True, eq=False)
class Rig:
    """Camera at the origin; projector at `position` mm, aimed at the target and rolled; what is not geometry beside."""

    name: str
    camera: Optic
    projector: Optic
    position: tuple[float, float, float]
    distance: float
    roll_deg: float
    """of the projector about its own axis, against the camera"""
    staggered: bool = False
    """mirrors stand on their corners: every other row is half a pixel further"""
    gamma: float = 2.2
    """of the projector"""
    undone: float = 2.2
    """exponent that patterns are pre-corrected with"""
    blur_px: float = 0.55
    """projector's, in focus, projector px along rows"""
    defocus_px: float = 0.5
    """more of it for each tenth of the distance out of focus: a pupil of 9 to 12 mm"""
    camera_blur_px: float = 0.75
    vignetting: float = 0.25
    """mechanical, of both lenses, in the corner; cos^4 comes on top"""
    full_well_e: float = 9000.0
    read_noise_dn: float = 0.9
    black_dn: float = 4.0
    camera_gamma: float = 1.0
    ambient: float = 0.05

    @property
    def pose(self):
        """rotation (3, 3), translation (3,): camera's frame to the projector's."""
        at = np.array(self.position)
        ahead = np.array([0.0, 0.0, self.distance]) - at
        ahead /= np.linalg.norm(ahead)
        right = np.cross([0.0, 1.0, 0.0], ahead)
        right /= np.linalg.norm(right)
        facing = np.stack((right, np.cross(ahead, right), ahead))
        c, s = np.cos(np.radians(self.roll_deg)), np.sin(np.radians(self.roll_deg))
        rotation = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ facing
        return rotation, -rotation @ at

    @property
    def width(self):
        """What the camera sees across, at the target, mm."""
        return self.camera.size[0] * self.distance / self.camera.focal[0]

    def calibration(self):
        """The true one, as formats.md has it."""
        rotation, translation = self.pose
        return {
            "format": "fringed-calibration",
            "version": 1,
            "id": f"held-out-{self.name}",
            "created": "2026-01-01T00:00:00Z",
            "units": "mm",
            "camera": self.camera.described(),
            "projector": self.projector.described(),
            "rotation": rotation.tolist(),
            "translation": translation.tolist(),
        }

    def at(self, scale):
        """With a camera of fewer pixels behind the same lens."""
        return self if scale == 1 else replace(self, camera=self.camera.scaled(scale))


RIGS = {
    rig.name: rig
    for rig in (
        Rig(
            "roll",  # projector above, aimed down, rolled by 14 degrees; a vertical lens shift as desk projectors have
            Optic((1392, 1040), (1850.0, 1850.0), (702.3, 511.8), (-0.11, 0.08, 0.0009, -0.0006, 0.0)),
            Optic((1280, 800), (1620.0, 1620.0), (655.0, 590.0), (-0.02, 0.03, -0.0011, 0.0007, 0.0)),
            (35.0, -210.0, 40.0), 900.0, 14.0,
        ),
        Rig(
            "diamond",  # a DMD of mirrors on their corners beside the camera: rows half as high as columns are wide
            Optic((1600, 1200), (2350.0, 2352.0), (811.0, 588.0), (-0.15, 0.12, -0.0004, 0.0012, 0.0)),
            Optic((912, 1140), (1310.0, 2620.0), (462.0, 640.0), (0.03, -0.05, 0.0008, -0.001, 0.0)),
            (-170.0, 10.0, -20.0), 620.0, -12.0, staggered=True, gamma=2.0, undone=2.05, ambient=0.1,
            vignetting=0.4,
        ),
        Rig(
            "diagonal",  # up and to the right, pixels a quarter higher than wide seen in focal lengths, wide lenses
            Optic((1224, 1024), (1150.0, 1150.0), (604.0, 520.0), (-0.21, 0.1, 0.0006, 0.0004, 0.0)),
            Optic((1280, 720), (1180.0, 1475.0), (648.0, 371.0), (-0.06, 0.04, 0.0005, 0.0009, 0.0)),
            (160.0, -130.0, 0.0), 700.0, 19.0, gamma=2.4, undone=2.3, camera_gamma=1.0, blur_px=0.7,
            vignetting=0.35,
        ),
    )
}  # fmt: skip
