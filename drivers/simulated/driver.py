"""What the registry opens: the drivers of the simulated camera, projector and trigger board."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.nominals import nominals
from drivers.simulated.options import DEFAULT_SCENE, Settings, read_settings, setting_problems
from drivers.simulated.projector import SimulatedProjector
from drivers.simulated.rigs import rig, rig_names
from drivers.simulated.scenes import scene_names
from drivers.simulated.sequenced import SimulatedSequencedProjector
from drivers.simulated.trigger_board import SimulatedTriggerBoard
from drivers.simulated.world import enter_world
from scanner.clock import Clock
from scanner.devices import DeviceInfo
from scanner.errors import ConfigError
from scanner.trigger_protocol import CAPABILITIES

DRIVER = "simulated"


class SimulatedCameraDriver:
    """Entry point of the group `fringed.cameras`; see `options` for device strings and option tables."""

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> SimulatedCamera:
        """Open the camera of a simulated world.

        Raises:
            ConfigError: unknown rig, scene or option, or one that contradicts the projector's.
            DeviceBusy: that world's camera is open already.
        """
        settings = read_settings(device, options, "camera")
        name = _name(settings.world.rig, settings.world.scene, "camera")
        return SimulatedCamera(enter_world(settings, clock, name), settings, name)

    def check(self, device: str, options: Mapping[str, Any]) -> Sequence[tuple[str, ConfigError]]:
        """See `scanner.devices.ChecksOptions.check`."""
        return setting_problems(device, options, "camera")

    def discover(self) -> Sequence[DeviceInfo]:
        """One camera for each reference rig."""
        return [_info(name, "camera") for name in rig_names()]


class SimulatedProjectorDriver:
    """Entry point of the group `fringed.projectors`."""

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> SimulatedProjector:
        """Open the projector of a simulated world; see `SimulatedCameraDriver.open`."""
        mode, others = _mode_apart(options)
        settings = read_settings(device, others, "projector")
        _check_mode(mode, settings)
        name = _name(settings.world.rig, settings.world.scene, "projector")
        made = SimulatedSequencedProjector if settings.projector.kind == "sequencer" else SimulatedProjector
        return made(enter_world(settings, clock, name), settings, name)

    def check(self, device: str, options: Mapping[str, Any]) -> Sequence[tuple[str, ConfigError]]:
        """See `scanner.devices.ChecksOptions.check`."""
        mode, others = _mode_apart(options)
        found = setting_problems(device, others, "projector")
        if any(option == "" for option, _ in found):
            return found  # which projector it is, and so its size, is not known
        try:
            _check_mode(mode, read_settings(device, {}, "projector"))
        except ConfigError as error:
            found.append(("mode", error))
        return found

    def discover(self) -> Sequence[DeviceInfo]:
        """One projector for each reference rig."""
        return [_info(name, "projector") for name in rig_names()]


class SimulatedTriggerDriver:
    """Entry point of the group `fringed.triggers`."""

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> SimulatedTriggerBoard:
        """Open the trigger board of a simulated world; see `SimulatedCameraDriver.open`."""
        settings = read_settings(device, options, "trigger")
        name = _name(settings.world.rig, settings.world.scene, "trigger board")
        return SimulatedTriggerBoard(enter_world(settings, clock, name), settings, name)

    def check(self, device: str, options: Mapping[str, Any]) -> Sequence[tuple[str, ConfigError]]:
        """See `scanner.devices.ChecksOptions.check`."""
        return setting_problems(device, options, "trigger")

    def discover(self) -> Sequence[DeviceInfo]:
        """One board for each reference rig."""
        details = {"steps": CAPABILITIES.max_steps, "scenes": list(scene_names())}
        return [
            DeviceInfo(DRIVER, f"{name}/{DEFAULT_SCENE}", "trigger", f"simulated rig {name}", details)
            for name in rig_names()
        ]


def _mode_apart(options: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
    """The rig file's `projector.mode`, and the projector's own options."""
    return options.get("mode"), {key: value for key, value in options.items() if key != "mode"}


def _check_mode(mode: Any, settings: Settings) -> None:
    """Raise ConfigError where a mode is wanted that is not the projector's size."""
    world = settings.world
    width, height = rig(world.rig).calibration.projector.size
    if mode is not None and str(mode).partition("@")[0] != f"{width}x{height}":
        raise ConfigError(
            f"the simulated projector has one mode, {width}x{height}, and not {mode}",
            device=_name(world.rig, world.scene, "projector"),
            hint="leave projector.mode out; another rig of `fringed devices` has another projector",
        )


def _name(rig_name: str, scene: str, role: str) -> str:
    return f"simulated {role} {rig_name}/{scene}"


def _info(rig_name: str, kind: Literal["camera", "projector"]) -> DeviceInfo:
    chosen = rig(rig_name)
    lens = chosen.calibration.camera if kind == "camera" else chosen.calibration.projector
    details = {"width": lens.size[0], "height": lens.size[1], "scenes": list(scene_names())}
    if kind == "camera":
        details["nominals"] = nominals(chosen)
    return DeviceInfo(
        driver=DRIVER,
        device=f"{rig_name}/{DEFAULT_SCENE}",
        kind=kind,
        model=f"simulated rig {rig_name}",
        details=details,
    )
