"""What a rig's patterns depend on: the projector's size, the axis that measures depth, the camera's scale.

Read from the calibration where the rig file names one, so that nothing is opened; else the devices are opened, asked,
and given back.
"""

from __future__ import annotations

from dataclasses import dataclass

from scanner.geometry import Calibration, load_calibration
from scanner.patterns import ProjectorSize
from scanner.patterns.description import Axis
from service.config import RigConfig, load_rig


@dataclass(frozen=True)
class KnownRig:
    """What is known of a rig. camera_scale: see `Calibration.camera_scale`; None without a calibration."""

    projector: ProjectorSize
    axis: Axis
    camera_scale: tuple[float, float] | None


def known_rig(name: str) -> KnownRig:
    """A rig by the path of its file, or `simulated[:DEVICE]`.

    Raises:
        ConfigError, CalibrationError: the file or its calibration is unusable.
        DeviceError: there is no calibration, and the devices cannot be opened.
    """
    config = load_rig(name)
    if config.rig.calibration is not None:
        calibration = load_calibration(config.rig.calibration)
        return _known(config, calibration, ProjectorSize(*calibration.projector.size))
    from scanner.clock import MonotonicClock  # noqa: PLC0415
    from service.scan_setup import open_rig  # noqa: PLC0415

    opened = open_rig(config.model_dump(mode="json"), MonotonicClock())
    try:
        return _known(config, opened.calibration, opened.projector)
    finally:
        opened.close()


def _known(config: RigConfig, calibration: Calibration | None, projector: ProjectorSize) -> KnownRig:
    known: Axis = "x" if calibration is not None and calibration.phase_axis == "x" else "y"
    return KnownRig(
        projector, config.rig.phase_axis or known, None if calibration is None else calibration.camera_scale
    )
