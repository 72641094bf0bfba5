"""What the registry opens: a display on a card of this machine, without a desktop."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from drivers.display import DisplayOptions
from drivers.kms.card import cards, driver_name, find, open_card, outputs
from drivers.kms.projector import KmsProjector
from drivers.option_table import option_problems, read_options
from scanner.clock import Clock
from scanner.devices import DeviceInfo
from scanner.errors import ConfigError, DeviceError

DRIVER = "kms"


class KmsProjectorDriver:
    """Entry point of the group `fringed.projectors`. Device strings: see `card.find`; options: `DisplayOptions`."""

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> KmsProjector:
        """Open one output; see `scanner.devices.ProjectorDriver.open`."""
        understood = read_options(DisplayOptions, options, device or DRIVER)
        node, output = find(device)
        return KmsProjector(node, output, understood, clock)

    def check(self, device: str, options: Mapping[str, Any]) -> Sequence[tuple[str, ConfigError]]:
        """See `scanner.devices.ChecksOptions.check`."""
        return option_problems(DisplayOptions, options, device or DRIVER)

    def discover(self) -> Sequence[DeviceInfo]:
        """Outputs with something connected, on cards that this user may open."""
        return list(_displays())


def _displays() -> Iterator[DeviceInfo]:
    for path in cards():
        try:
            node = open_card(path)
        except DeviceError:
            continue  # listing what can be used is no place to fail
        try:
            for output in outputs(node):
                if output.connected and output.native is not None:
                    yield DeviceInfo(
                        driver=DRIVER,
                        device=f"{path.rpartition('/')[2]}/{output.name}",
                        kind="projector",
                        model=f"{output.name} of {driver_name(node)}",
                        details={"native": str(output.native), "modes": [str(mode) for mode in output.modes]},
                    )
        except OSError:
            continue
        finally:
            node.close()
