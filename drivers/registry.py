"""Drivers by name, found through entry points: third parties add one without touching this project."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any, Literal, cast

from scanner.errors import ConfigError

if TYPE_CHECKING:  # names of drivers are asked for by processes that load none, and no array library either
    from scanner.clock import Clock
    from scanner.devices import (
        Camera,
        CameraDriver,
        DeviceInfo,
        Projector,
        ProjectorDriver,
        TriggerBoard,
        TriggerDriver,
    )

Kind = Literal["camera", "projector", "trigger"]

_GROUPS: dict[Kind, str] = {
    "camera": "fringed.cameras",
    "projector": "fringed.projectors",
    "trigger": "fringed.triggers",
}

_SIMULATORS = "fringed.simulators"

_log = logging.getLogger(__name__)


def open_camera(driver: str, device: str, options: Mapping[str, Any], clock: Clock) -> Camera:
    """Open a camera by its driver's name.

    Raises:
        ConfigError: no such driver; the hint lists those installed.
        DeviceError: see `scanner.devices.CameraDriver.open`.
    """
    return cast("CameraDriver", _load("camera", driver)).open(device, options, clock)


def open_projector(driver: str, device: str, options: Mapping[str, Any], clock: Clock) -> Projector:
    """Open a projector by its driver's name; see `open_camera`."""
    return cast("ProjectorDriver", _load("projector", driver)).open(device, options, clock)


def open_trigger(driver: str, device: str, options: Mapping[str, Any], clock: Clock) -> TriggerBoard:
    """Open a trigger board by its driver's name; see `open_camera`."""
    return cast("TriggerDriver", _load("trigger", driver)).open(device, options, clock)


def load_simulator(name: str) -> Any:
    """What starts simulated devices on a real wire (group `fringed.simulators`); called as `fringed simulate` does.

    Raises:
        ConfigError: no such simulator.
    """
    entries = {entry.name: entry for entry in entry_points(group=_SIMULATORS)}
    if name not in entries:
        raise ConfigError(f"no simulator named {name!r}", hint=f"installed: {', '.join(sorted(entries)) or 'none'}")
    return entries[name].load()


def driver_names(kind: Kind) -> list[str]:
    """Names of the installed drivers of a kind, sorted."""
    return sorted({entry.name for entry in entry_points(group=_GROUPS[kind])})


def check_driver(kind: Kind, name: str) -> None:
    """Raise ConfigError unless a driver of that kind and name is installed. Loads nothing."""
    _entry(kind, name)


def discover() -> list[DeviceInfo]:
    """Every device that any installed driver can see; a driver that fails to load is logged and left out."""
    found: list[DeviceInfo] = []
    for kind in _GROUPS:
        for name in driver_names(kind):
            try:
                devices: Sequence[DeviceInfo] = _load(kind, name).discover()
            except ConfigError as error:
                _log.warning("%s", error)
                continue
            found.extend(devices)
    return found


def _entry(kind: Kind, name: str) -> EntryPoint:
    entries = {entry.name: entry for entry in entry_points(group=_GROUPS[kind])}
    if name not in entries:
        near = get_close_matches(name, entries, n=1)
        raise ConfigError(
            f"no {kind} driver named {name!r}",
            hint=(f"did you mean {near[0]!r}? " if near else "") + f"installed: {', '.join(sorted(entries)) or 'none'}",
        )
    return entries[name]


def _load(kind: Kind, name: str) -> Any:
    entry = _entry(kind, name)
    try:
        return entry.load()
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"{kind} driver {name!r} does not load: {error}",
            hint=f"it comes from {entry.value!r}; reinstall the package that brings it",
        ) from error
