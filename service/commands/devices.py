"""`fringed devices`: what the installed drivers can see."""

from __future__ import annotations

from dataclasses import asdict

from service.commands.options import AsJson
from service.terminal import print_json, print_table


def devices(as_json: AsJson = False) -> int:
    """List cameras, projectors and trigger boards, with the names that a rig file calls them by.

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
    return 0
