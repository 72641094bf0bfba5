"""The reference rigs of scenes.json as exact geometry: where camera and projector stand and how they see.

The camera's frame is the rig's: the camera stands at the origin and looks along +z at the aim point. The projector
is turned so that the *centre of its picture* lands on the aim point, its own x axis staying level. For a lens without
shift that centre is its optical axis; with `vertical_offset` 1 the axis is the picture's lower edge, and a rig whose
axis were aimed instead would light half of its target.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.geometry import Calibration, Lens

Array = NDArray[np.float64]

REFERENCE_AIM_MM = 1346.0
"""Distance of the target's centre in the coordinates of scenes.json"""

REFERENCE_FIELD_MM = 555.0
"""Width of the field at the target that the scenes of scenes.json were drawn for"""


@dataclass(frozen=True, eq=False)
class Rig:
    """One rig: its true calibration, the point both devices aim at, and how scenes are fitted to it.

    A scene's point p (coordinates of scenes.json) stands at aim + scale (p - (0, 0, 1346)): its target's centre is
    at the aim point and it fills the same share of the field on every rig.
    """

    name: str
    calibration: Calibration
    aim: Array
    """(3,) mm, camera frame"""
    scale: float
    axis: str

    def to_scene(self, points: NDArray[Any]) -> Array:
        """(..., 3) mm in the camera's frame to the coordinates of scenes.json."""
        return (np.asarray(points, dtype=np.float64) - self.aim) / self.scale + (0.0, 0.0, REFERENCE_AIM_MM)

    def from_scene(self, points: NDArray[Any]) -> Array:
        """(..., 3) mm in the coordinates of scenes.json to the camera's frame."""
        return (np.asarray(points, dtype=np.float64) - (0.0, 0.0, REFERENCE_AIM_MM)) * self.scale + self.aim


def rig_names() -> tuple[str, ...]:
    """Names of the reference rigs; the first is the default."""
    return tuple(reference()["rigs"])


@cache
def rig(name: str) -> Rig:
    """The rig of that name.

    Raises:
        KeyError: there is none.
    """
    description = reference()["rigs"][name]
    camera = _lens(description["camera"])
    projector = _lens(description["projector"])
    position = np.asarray(description["projector_position_mm"], dtype=np.float64)
    aim = np.asarray(description["both_aim_at_mm"], dtype=np.float64)
    rotation = _aimed(projector, aim - position)
    calibration = Calibration(
        camera,
        projector,
        rotation=rotation,
        translation=-rotation @ position,
        id=f"simulated-{name}",
    )
    field_mm = camera.size[0] * aim[2] / camera.matrix[0, 0]
    return Rig(name, calibration, aim, float(field_mm) / REFERENCE_FIELD_MM, description["axis"])


@cache
def reference() -> Mapping[str, Any]:
    """scenes.json, as it stands in the package."""
    content: Mapping[str, Any] = json.loads(files(__package__).joinpath("scenes.json").read_text(encoding="utf-8"))
    return content


def _lens(description: Mapping[str, Any]) -> Lens:
    width, height = description["size"]
    if "focal_px" in description:
        fx = fy = float(description["focal_px"])
    elif "throw_ratio" in description:
        fx = fy = float(description["throw_ratio"]) * width
    else:
        across, down = description["field_mm"]
        fx, fy = width * description["distance_mm"] / across, height * description["distance_mm"] / down
    # Pixel centres at whole numbers: the picture spans -0.5 .. size - 0.5. vertical_offset 1: axis at its lower edge.
    cx = (width - 1) / 2
    cy = (height - 1) / 2 + float(description.get("vertical_offset", 0.0)) * height / 2
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Lens((width, height), matrix, np.asarray(description.get("distortion", [0.0] * 5), dtype=np.float64))


def _aimed(lens: Lens, direction: Array) -> Array:
    """Rotation from the camera's frame to a lens whose picture's centre lies in `direction`, its x axis level."""
    width, height = lens.size
    centre = lens.normalised(np.array([(width - 1) / 2, (height - 1) / 2]))
    yaw = np.arctan2(direction[0], direction[2])
    # y points down: looking up is a negative y. The pitch brings the picture's centre, not the axis, onto the target.
    pitch = np.arctan2(direction[1], np.hypot(direction[0], direction[2])) - np.arctan2(centre[1], 1.0)
    to_rig = _about_y(yaw) @ _about_x(-pitch)
    return np.ascontiguousarray(to_rig.T)


def _about_x(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _about_y(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
