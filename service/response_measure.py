"""A rig's response by flat grey levels: shown up and down again, each seen by the rig's own camera."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scanner.calibration.grey_levels import LEVELS, LevelResponse, response_of_levels
from scanner.clock import Clock
from scanner.devices import ProjectorKind
from scanner.digits import with_uncertainty
from scanner.errors import CalibrationError, ConfigError
from scanner.patterns.sequence import Precorrection
from scanner.sequencer.light import fitting_exposure
from scanner.sequencer.shots import Shots
from service.config import RigConfig
from service.scan_setup import OpenRig, open_rig


def measure_response(config: RigConfig, clock: Clock, stage: Callable[[str], None]) -> LevelResponse:
    """Open a rig's devices, show grey levels as they are (no precorrection), and give the devices back.

    Raises:
        ConfigError: the projector shows one image only.
        CalibrationError: the levels show no response.
        DeviceError: a device cannot be opened, or failed.
    """
    stage("opening devices")
    opened = open_rig(config.model_dump(mode="json"), clock)
    try:
        return _measured(opened, clock, stage)
    finally:
        opened.close()


def first_response(config: RigConfig, clock: Clock, stage: Callable[[str], None]) -> tuple[LevelResponse | None, str]:
    """The response that a calibration begins with, and what to say of it.

    Returns:
        None where nothing in view tells it: what the rig's calibration has stays, or a pose's fringes have to tell it.

    Raises:
        DeviceError: a device cannot be opened, or failed.
    """
    stage("opening devices")
    opened = open_rig(config.model_dump(mode="json"), clock)
    claimed: Precorrection | None = None
    try:
        claimed = opened.known.precorrection
        found = _measured(opened, clock, stage)
    except (CalibrationError, ConfigError) as error:
        instead = "the first pose's fringes will" if claimed is None else "what the rig's calibration has stays"
        return None, f"response: not told by grey levels ({error}); {instead}"
    finally:
        opened.close()
    words = (
        f"gamma {with_uncertainty(found.gamma, 2 * found.sigma)} (k = 2)" if "gamma" in found.response else "a table"
    )
    instead = "" if claimed is None else _beside(claimed, found)
    return found, (
        f"response: {words}, by {len(found.levels)} grey levels on what is in view; scans will undo it{instead}"
    )


def _beside(claimed: Precorrection, found: LevelResponse) -> str:
    """What the rig's calibration has, beside what grey levels tell."""
    if claimed.gamma is None:
        return ", in place of the table that the rig's calibration has"
    if "gamma" in found.response and abs(found.gamma - claimed.gamma) <= 2 * found.sigma:
        return f", which agrees with the rig's calibration (gamma {claimed.gamma:.4f})"
    return f": the rig's calibration is wrong, it has gamma {claimed.gamma:.4f}"


def _measured(opened: OpenRig, clock: Clock, stage: Callable[[str], None]) -> LevelResponse:
    rig = opened.rig
    capabilities = rig.projector.capabilities
    if capabilities.kind is not ProjectorKind.FRAMEBUFFER:
        raise ConfigError(
            f"a {capabilities.kind.value} projector is not flipped by the host, and shows no levels one by one",
            device=rig.projector.name,
            hint="show them by other means, and give the images: fringed calibrate response FOLDER --levels ...",
        )
    with Shots(rig.projector, rig.camera, clock, settings=rig.settings, trigger_mode=rig.trigger_mode) as shots:
        stage("choosing the exposure")
        fitting_exposure(shots, capabilities.refresh_ns)
        rig.projector.load([np.full((capabilities.height, capabilities.width), v, np.uint8) for v in LEVELS])
        shots.images = len(LEVELS)
        stage("measuring levels")
        order = [*range(len(LEVELS)), *reversed(range(len(LEVELS)))]
        frames = [shots.steady(i).pixels for i in order]
    return response_of_levels([LEVELS[i] for i in order], frames, rig.camera.capabilities.max_value)
