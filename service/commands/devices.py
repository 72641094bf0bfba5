"""`fringed devices`: what the installed drivers can see."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING

from service.commands.options import AsJson
from service.terminal import print_json, print_table, progress_lines

if TYPE_CHECKING:
    from collections.abc import Sequence

    from scanner.devices import DeviceInfo


def devices(as_json: AsJson = False) -> int:
    """List cameras, projectors and trigger boards, each with the piece of a rig file that names it.

    \b
    Examples:
      fringed devices
      fringed devices --json
    """
    from drivers import registry  # noqa: PLC0415

    with progress_lines() as lines:
        lines.stage("looking for devices, by every driver")
        found = registry.discover()
    if as_json:
        print_json({"devices": [asdict(device) for device in found]})
        return 0
    rows = ((device.kind, device.driver, device.device, device.model) for device in found)
    print_table("devices", ("kind", "driver", "device", "model"), rows)
    simulated = [device for device in found if device.driver == "simulated"]
    for device in found:
        if device not in simulated:
            print(f"\n# {device.model}\n{_piece(device)}")
    if len(simulated) == len(found):
        print("\nno device is plugged in that a driver can see (fringed doctor looks why); without one:")
        print("fringed scan --rig simulated")
        _print_nominals([device for device in simulated if device.kind == "camera"])
    if simulated:
        print(f"\n{_simulated_rig(simulated)}")
    return 0


def _print_nominals(cameras: Sequence[DeviceInfo]) -> None:
    """What stands in the simulated scenes, by the first figure of each: what a measurement is held against."""
    of_rigs = [camera.details.get("nominals", {}) for camera in cameras]
    rows = []
    for scene, figures in (of_rigs[0] if of_rigs else {}).items():
        name = next(iter(figures))
        if not isinstance(figures[name], list):
            rows.append((scene, name, *(nominals[scene][name] for nominals in of_rigs)))
    if rows:
        print()
        rigs = (camera.device.partition("/")[0] for camera in cameras)
        print_table("what stands in the simulated scenes", ("scene", "nominal", *rigs), rows)
        print("(all sizes and places: fringed devices --json)")


def _simulated_rig(devices: Sequence[DeviceInfo]) -> str:
    """A whole rig file: simulated devices see each other where they name one scene."""
    names = list(dict.fromkeys(device.device for device in devices))
    of_first = (device for device in devices if device.device == names[0] and device.kind != "trigger")
    others = f"; also {', '.join(names[1:])}" if names[1:] else ""
    head = f"# a simulated rig: all its devices name one scene{others}\n# (more scenes: fringed devices --json)"
    return "\n\n".join((head, *map(_piece, of_first)))


def _piece(device: DeviceInfo) -> str:
    """A table of a rig file."""
    return f"[{device.kind}]\ndriver = {json.dumps(device.driver)}\ndevice = {json.dumps(device.device)}"
