"""Drivers by name, found through entry points: third parties add one without touching this project."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
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

LOOKING_S = 20.0
"""A driver that found nothing in this time is given up: networks are asked for a second, buses answer at once,
and on a busy machine all of them start at the same time."""

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


def option_problems(
    kind: Kind, name: str, device: str, options: Mapping[str, Any]
) -> Sequence[tuple[str, ConfigError]]:
    """What that driver would refuse of a rig file without looking at a device: (option, error), option "" for `device`.

    Nothing where the driver cannot tell (`scanner.devices.ChecksOptions`).

    Raises:
        ConfigError: no such driver, or it does not load.
    """
    from scanner.devices import ChecksOptions  # noqa: PLC0415

    driver = _load(kind, name)
    return driver.check(device, options) if isinstance(driver, ChecksOptions) else ()


def discover() -> list[DeviceInfo]:
    """Every device that any installed driver can see.

    Each driver looks in a process of its own: a library that hangs, crashes or leaves threads behind does it there,
    and costs its own devices only, with a warning in the log.
    """
    names = sorted({name for kind in _GROUPS for name in driver_names(kind)})
    looking = {
        name: subprocess.Popen(  # noqa: S603  (this interpreter, this module, names of installed drivers)
            [sys.executable, "-m", "drivers.registry", name], stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        for name in names
    }
    deadline = time.monotonic() + LOOKING_S
    return [device for name, process in looking.items() for device in _seen(name, process, deadline)]


def look(name: str) -> list[DeviceInfo]:
    """What one driver can see, of every kind, in this process.

    Raises:
        ConfigError: no driver of this name, or it fails to load.
    """
    kinds = [kind for kind in _GROUPS if name in driver_names(kind)]
    if not kinds:
        raise ConfigError(f"no driver named {name!r}", hint=f"installed: {', '.join(sorted(driver_names('camera')))}")
    return [device for kind in kinds for device in _load(kind, name).discover()]


def _seen(name: str, process: subprocess.Popen[bytes], deadline: float) -> list[DeviceInfo]:
    with process:
        try:
            out, err = process.communicate(timeout=max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            _log.warning("driver %s found nothing in %g s and was given up", name, LOOKING_S)
            return []
    if process.returncode != 0:
        last = err.decode(errors="replace").strip().rpartition("\n")[2]
        _log.warning("driver %s cannot look for devices: %s", name, last or f"status {process.returncode}")
        return []
    from scanner.devices import DeviceInfo  # noqa: PLC0415

    return [DeviceInfo(**device) for device in json.loads(out.splitlines()[-1])]


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


if __name__ == "__main__":
    # The last line is the answer: libraries write what they like before it.
    print("\n" + json.dumps([asdict(device) for device in look(sys.argv[1])]))
