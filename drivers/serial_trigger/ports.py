"""Which serial ports may be trigger boards, without opening one: opening resets an Arduino, and may be another's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from serial.tools import list_ports

from scanner.errors import DeviceNotFound

BOARDS: dict[tuple[int, int], str] = {
    (0x2341, 0x0001): "Arduino Uno",
    (0x2341, 0x0043): "Arduino Uno R3",
    (0x2341, 0x0243): "Arduino Uno R3",
    (0x2A03, 0x0043): "Arduino Uno R3 (arduino.org)",
    (0x0403, 0x6001): "Arduino Nano (FT232R)",
    (0x0403, 0x6015): "Arduino Nano (FT231X)",
    (0x1A86, 0x7523): "Arduino Nano or Uno (CH340)",
    (0x1A86, 0x5523): "Arduino Nano or Uno (CH341)",
    (0x10C4, 0xEA60): "Arduino Nano or Uno (CP2102)",
}
"""USB vendor and product of boards with an ATmega328P. Those of bare USB-to-serial chips are other things, too: who
opens one asks `*IDN?`."""


@dataclass(frozen=True)
class Port:
    """A serial port on USB."""

    path: str
    model: str
    vid: int
    pid: int
    serial_number: str | None


def candidates() -> Sequence[Port]:
    """Ports with a board's USB numbers, by path."""
    found = [
        Port(info.device, BOARDS[info.vid, info.pid], info.vid, info.pid, info.serial_number)
        for info in list_ports.comports()
        if info.vid is not None and info.pid is not None and (info.vid, info.pid) in BOARDS
    ]
    return sorted(found, key=lambda port: port.path)


def paths_for(device: str) -> Sequence[str]:
    """Where to look for `device`: "" all candidates, "serial:NUMBER" that USB serial number, else a path.

    Raises:
        DeviceNotFound: no port answers to that.
    """
    if device.startswith("serial:"):
        number = device.removeprefix("serial:")
        paths = [port.path for port in candidates() if port.serial_number == number]
    elif device:
        return [device]
    else:
        paths = [port.path for port in candidates()]
    if not paths:
        known = ", ".join(f"{port.path} (serial:{port.serial_number})" for port in candidates()) or "none"
        raise DeviceNotFound(
            f"no trigger board {device!r}" if device else "no trigger board is plugged in",
            device="trigger board",
            hint=f"plug it in, or give its port as device; candidates: {known}",
        )
    return paths
