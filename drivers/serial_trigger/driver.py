"""What the registry opens: finds the port, makes sure that the board on it is one of ours, and hands it over.

Device strings: a port (`/dev/ttyACM0`, `/dev/serial/by-id/...`), `serial:NUMBER` (its USB serial number), or "" for
the first board that answers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from drivers.option_table import option_problems, read_options
from drivers.serial_trigger.board import BoardOptions, SerialTriggerBoard
from drivers.serial_trigger.link import Link
from drivers.serial_trigger.ports import candidates, paths_for
from drivers.serial_trigger.protocol import Message
from drivers.serial_trigger.transport import SerialTransport
from scanner.clock import Clock
from scanner.devices import DeviceInfo
from scanner.errors import ConfigError, DeviceError, DeviceLost
from scanner.trigger_protocol import PROTOCOL

DRIVER = "serial"

BOOT_S = 3.0
"""An Arduino that opening has reset runs its boot loader for up to 2 s"""

KNOCK_S = 0.4


@dataclass(frozen=True)
class Found:
    """A board that has introduced itself."""

    link: Link
    identity: str
    """its answer to `*IDN?`"""


class SerialTriggerDriver:
    """Entry point `serial` of the group `fringed.triggers`."""

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> SerialTriggerBoard:
        """Open a board; see `scanner.devices.TriggerDriver.open` and `BoardOptions` for the option table.

        Raises:
            ConfigError: an option makes no sense, or the port is none.
            DeviceNotFound, DeviceBusy, PermissionDenied, DeviceError: it cannot be opened, or is another device.
        """
        chosen = read_options(BoardOptions, options, device or "trigger board")
        return SerialTriggerBoard(lambda on_message: connect(device, clock, on_message), chosen, clock)

    def check(self, device: str, options: Mapping[str, Any]) -> Sequence[tuple[str, ConfigError]]:
        """See `scanner.devices.ChecksOptions.check`."""
        return option_problems(BoardOptions, options, device or "trigger board")

    def discover(self) -> Sequence[DeviceInfo]:
        """Ports that may be trigger boards, by their USB numbers; none is opened."""
        return [
            DeviceInfo(
                DRIVER,
                port.path,
                "trigger",
                f"{port.model}, if it has the firmware",
                {"usb": f"{port.vid:04x}:{port.pid:04x}", "serial_number": port.serial_number},
            )
            for port in candidates()
        ]


def connect(device: str, clock: Clock, on_message: Callable[[Message], None]) -> Found:
    """The first board at `device` that introduces itself.

    Raises:
        DeviceError: see `SerialTriggerDriver.open`; of several ports, what the last one had to say.
    """
    failure: DeviceError | None = None
    for path in paths_for(device):
        try:
            return _introduced(Link(SerialTransport(path), clock, on_message), clock)
        except DeviceError as error:
            failure = error
    raise failure or DeviceError("no port to try", device=device)


def _introduced(link: Link, clock: Clock) -> Found:
    try:
        identity = _identity(link, clock)
        _check_identity(identity, link.name)
        link.ask("*CRC 1")
        link.require_sums()
        link.ask("*RST")
    except BaseException:
        link.close()
        raise
    return Found(link, identity)


def _check_identity(identity: str, name: str) -> None:
    maker, _, rest = identity.partition(",")
    version = rest.split(",")[1] if rest.count(",") >= 1 else ""
    if maker != "fringed" or not version:
        raise DeviceError(
            f"another device answers there: {identity!r}",
            device=name,
            hint="give the trigger board's port, or flash its firmware: docs/how-to/make-a-trigger-board.md",
        )
    if version.partition(".")[0] != str(PROTOCOL[0]):
        raise DeviceError(
            f"the board speaks protocol {version}, this program {PROTOCOL[0]}.{PROTOCOL[1]}",
            device=name,
            hint="flash the firmware of this release: docs/how-to/make-a-trigger-board.md",
        )


def _identity(link: Link, clock: Clock) -> str:
    """The answer to `*IDN?`, asked until the boot loader has given way."""
    deadline = clock.now_ns() + round(1e9 * BOOT_S)
    while True:
        try:
            link.knock()
            clock.sleep_until(clock.now_ns() + 20_000_000)
            return link.ask("*IDN?", tries=1)
        except DeviceLost as lost:
            if link.lost is not None:
                raise
            if clock.now_ns() > deadline:
                said = f", {link.damaged} lines that are none of its protocol" if link.damaged else ""
                raise DeviceError(
                    f"what is there does not answer as a trigger board{said}",
                    device=link.name,
                    hint="give the board's port, or flash its firmware: docs/how-to/make-a-trigger-board.md",
                ) from lost
            clock.sleep_until(clock.now_ns() + round(1e9 * KNOCK_S))
