"""What patterns depend on: a projector's size, the axis that measures depth, the camera's scale, the response.

Read from the calibration where the rig file names one, so that nothing is opened; else the devices are opened, asked,
and given back. The patterns themselves are `service.scan_setup`'s.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from scanner.errors import ConfigError
from scanner.geometry import Calibration, load_calibration
from scanner.patterns import ProjectorSize
from scanner.patterns.description import Axis
from scanner.patterns.sequence import Precorrection
from service.config import load_rig


@dataclass(frozen=True)
class KnownRig:
    """What a rig's patterns depend on: by it a scan and `fringed patterns --for` come to the same ones."""

    projector: ProjectorSize
    axis: Axis
    """that measures depth"""
    camera_scale: tuple[float, float] | None
    """see `Calibration.camera_scale`; None where no camera is known"""
    precorrection: Precorrection | None
    """what makes this rig's light linear"""


def known_of(
    phase_axis: Axis | None, calibration: Calibration | None, projector: ProjectorSize, camera: tuple[int, int]
) -> KnownRig:
    """What is known of a rig by its file's `phase_axis`, its calibration and its devices' sizes.

    Without a calibration the projector's picture is taken to fill the camera's (width, height).
    """
    if calibration is None:
        filled = camera[0] / projector.width, camera[1] / projector.height
        return KnownRig(projector, phase_axis or "y", filled, None)
    measures: Axis = "x" if calibration.phase_axis == "x" else "y"
    return KnownRig(projector, phase_axis or measures, calibration.camera_scale, _precorrection(calibration))


def known_rig(name: str) -> KnownRig:
    """A rig by the path of its file, or `simulated[:DEVICE]`.

    Raises:
        ConfigError, CalibrationError: the file or its calibration is unusable.
        DeviceError: there is no calibration, and the devices cannot be opened.
    """
    config = load_rig(name)
    if config.rig.calibration is not None:
        calibration = load_calibration(config.rig.calibration)
        projector = ProjectorSize(*calibration.projector.size)
        return known_of(config.rig.phase_axis, calibration, projector, calibration.camera.size)
    from scanner.clock import MonotonicClock  # noqa: PLC0415
    from service.scan_setup import open_rig  # noqa: PLC0415

    opened = open_rig(config.model_dump(mode="json"), MonotonicClock())
    try:
        return opened.known
    finally:
        opened.close()


def _precorrection(calibration: Calibration | None) -> Precorrection | None:
    """What undoes the projector's response: its inverse."""
    response = ((calibration.extra.get("response") or {}) if calibration else {}).get("projector")
    if not response:
        return None
    gamma, table = response.get("gamma"), response.get("table")
    if gamma is not None:
        return None if gamma == 1 else Precorrection(gamma=float(gamma))
    if table is None:
        return None
    return Precorrection(table=inverse_table(table))


def inverse_table(table: Any) -> tuple[float, ...]:
    """The input value 0 .. 255 for each light k / 255, from the light 0 .. 1 of each input value.

    Raises:
        ConfigError: it is no response: not 256 rising numbers.
    """
    values = [float(value) for value in table]
    rising = all(low <= high for low, high in pairwise(values))
    if len(values) != 256 or not rising or values[0] < 0 or values[-1] > 1 or values[0] == values[-1]:
        raise ConfigError("calibration: response.projector.table must be 256 rising values of light, 0 .. 1")
    import numpy as np  # noqa: PLC0415  (of this module's uses the only one)

    # Light that the projector cannot make is given its nearest: np.interp holds the ends. Flat parts keep one value.
    light, index = np.unique(values, return_index=True)
    return tuple(float(v) for v in np.interp(np.arange(256) / 255, light, index))
