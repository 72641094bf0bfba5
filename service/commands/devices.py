"""`fringed devices`: what the installed drivers can see."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING

from service.commands.options import AsJson
from service.terminal import print_json, print_table

if TYPE_CHECKING:
    from scanner.devices import DeviceInfo


def devices(as_json: AsJson = False) -> int:
    """List cameras, projectors and trigger boards, each with the piece of a rig file that names it.

    \b
    Examples:
      fringed devices
      fringed devices --json
    """
    from drivers import registry  # noqa: PLC0415

    found = registry.discover()
    if as_json:
        print_json({"devices": [asdict(device) for device in found]})
        return 0
    rows = ((device.kind, device.driver, device.device, device.model) for device in found)
    print_table("devices", ("kind", "driver", "device", "model"), rows)
    real = [device for device in found if device.driver != "simulated"]
    for device in real:
        print(f"\n# {device.model}\n{_piece(device)}")
    if not real:
        print("\nno device is plugged in that a driver can see (fringed doctor looks why); without one:")
        print("fringed scan --rig simulated")
    return 0


def _piece(device: DeviceInfo) -> str:
    """A table of a rig file."""
    return f"[{device.kind}]\ndriver = {json.dumps(device.driver)}\ndevice = {json.dumps(device.device)}"
