"""Words of the trigger board's line protocol that both ends need: check sum, limits, error codes. No device, no port.

The protocol itself is docs/reference/trigger-protocol.md; the serial driver and the simulated board speak it.
"""

from __future__ import annotations

from typing import Literal

from scanner.devices import TriggerCapabilities, TriggerSource

PROTOCOL = (1, 0)
"""Major and minor version: another major is another protocol"""

BAUD = 115_200
LINE_MAX = 64
"""Bytes of a line, its LF included"""

ABORT_BYTE = b"\x18"
"""Acts at once, within a line too"""

CLOCK_BITS = 32
"""The board's microseconds wrap after 71.6 min"""

EVENTS_KEPT = 32
"""Events that the board can tell again"""

OUTPUTS = {"CAM1": 1, "CAM2": 2, "SYNC": 4, "LED": 8}
"""Bits of a step's outputs"""

TIMEOUT_MAX_MS = 60_000
VSYNC_TIMEOUT_MS = 200

ERRORS = {1: "crc", 2: "syntax", 3: "range", 4: "state", 5: "full", 6: "line", 7: "unknown"}

CAPABILITIES = TriggerCapabilities(
    sources=frozenset(TriggerSource),
    max_steps=64,
    max_repeats=65_535,
    dark_min_us=50,
    exposure_min_us=50,
    time_max_us=10_000_000,
    jitter_ns=1_000,
)
"""What every board of this protocol can do"""

_POLYNOMIAL = 0x07

Sum = Literal["none", "right", "wrong"]


def _table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        crc = value
        for _ in range(8):
            crc = (crc << 1 ^ _POLYNOMIAL if crc & 0x80 else crc << 1) & 0xFF
        table.append(crc)
    return tuple(table)


_TABLE = _table()


def crc8(text: bytes) -> int:
    """CRC-8 with polynomial 0x07 and initial value 0.

    >>> hex(crc8(b"123456789"))
    '0xf4'
    """
    crc = 0
    for byte in text:
        crc = _TABLE[crc ^ byte]
    return crc


def framed(text: str, *, sum_: bool = True) -> bytes:
    r"""A line as it goes over the wire.

    >>> framed("TIME?")
    b'TIME?*F8\n'
    """
    body = text.encode("ascii")
    return body + (b"*%02X" % crc8(body) if sum_ else b"") + b"\n"


def unframed(line: bytes) -> tuple[str, Sum]:
    """The text of a line without its end, and whether it had a check sum and a right one.

    Bytes that are no ASCII come out as replacement characters.
    """
    body, star, digits = line[:-3], line[-3:-2], line[-2:]
    if star == b"*" and all(digit in b"0123456789ABCDEF" for digit in digits):
        return body.decode("ascii", "replace"), "right" if crc8(body) == int(digits, 16) else "wrong"
    return line.decode("ascii", "replace"), "none"
