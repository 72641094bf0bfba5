"""The memory of the simulated GigE Vision camera: bootstrap registers, its own registers, and the XML document.

Plain big-endian memory with bounds; what a write sets in motion is the business of whoever asked to be told of it
(`Registers.on_write`). Addresses: GigE Vision 1.2, table 27-1, and `gige_features`.
"""

from __future__ import annotations

import ipaddress
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from drivers.simulated import gige_features as f

BOOTSTRAP_BYTES = 0x1000
OWN_AT, OWN_BYTES = 0x10000, 0x1000
XML_AT = 0x100000

CONTROL_PRIVILEGE = 0xA00
CONTROL, EXCLUSIVE = 2, 1
STREAM_PORT, STREAM_ADDRESS, STREAM_SOURCE_PORT = 0xD00, 0xD18, 0xD1C
MAC_HIGH, MAC_LOW, CURRENT_ADDRESS, CURRENT_MASK = 0x8, 0xC, 0x24, 0x34
XML_URL_0 = 0x200
DISCOVERY_BYTES = 0xF8
FIRE_TEST_PACKET, DO_NOT_FRAGMENT = 1 << 31, 1 << 30

CAPABILITY = 0x934
CAN_CONCATENATE, CAN_WRITE_MEMORY, CAN_RESEND = 1 << 0, 1 << 1, 1 << 2
HAS_SERIAL, HAS_USER_NAME = 1 << 30, 1 << 31

VENDOR, MODEL, VERSION = "fringed", "simulated-gige", "1"


class Refused(Exception):
    """A read or write the camera does not take; `status` is the code of the answer."""

    def __init__(self, status: int) -> None:
        super().__init__(f"status 0x{status:04x}")
        self.status = status


INVALID_PARAMETER, INVALID_ADDRESS, WRITE_PROTECT, BAD_ALIGNMENT, ACCESS_DENIED, BUSY = (
    0x8002,
    0x8003,
    0x8004,
    0x8005,
    0x8006,
    0x8007,
)


@dataclass(frozen=True)
class Identity:
    """Who the camera says it is."""

    address: str
    serial: str
    user_name: str = ""
    tick_hz: int = 1_000_000_000

    @property
    def mac(self) -> bytes:
        """Locally administered, one for each address."""
        return b"\x02\xf1" + ipaddress.IPv4Address(self.address).packed


class Registers:
    """The camera's memory: written by the thread that answers the client."""

    def __init__(self, identity: Identity, size: tuple[int, int]) -> None:
        self._bootstrap = bytearray(BOOTSTRAP_BYTES)
        self._own = bytearray(OWN_BYTES)
        self._xml = f.document(VENDOR, MODEL)
        self._told: dict[int, Callable[[int], None]] = {}
        self._asked: dict[int, Callable[[], None]] = {}
        self._checks = _checks()
        self._fill_bootstrap(identity)
        self._fill_own(size)

    def on_write(self, address: int, told: Callable[[int], None]) -> None:
        """Call `told` with the new value after each write to a register; it may raise Refused."""
        self._told[address] = told

    def on_read(self, address: int, asked: Callable[[], None]) -> None:
        """Call `asked` before a register is read: it sets the value."""
        self._asked[address] = asked

    def word(self, address: int) -> int:
        """A 32-bit register."""
        memory, at = self._place(address, 4)
        value: int = struct.unpack_from(">I", memory, at)[0]
        return value

    def set_word(self, address: int, value: int) -> None:
        """Set a 32-bit register from inside: no check, nobody told."""
        memory, at = self._place(address, 4)
        struct.pack_into(">I", memory, at, value & 0xFFFFFFFF)

    def number(self, address: int) -> float:
        """A 64-bit IEEE register."""
        memory, at = self._place(address, 8)
        value: float = struct.unpack_from(">d", memory, at)[0]
        return value

    def set_number(self, address: int, value: float) -> None:
        """Set a 64-bit IEEE register from inside."""
        memory, at = self._place(address, 8)
        struct.pack_into(">d", memory, at, value)

    def read(self, address: int, size: int) -> bytes:
        """Memory as a client reads it.

        Raises:
            Refused: no such memory.
        """
        if XML_AT <= address < XML_AT + len(self._xml) + 4:
            at = address - XML_AT
            return self._xml[at : at + size].ljust(size, b"\0")
        if address in self._asked:
            self._asked[address]()
        memory, at = self._place(address, size)
        return bytes(memory[at : at + size])

    def write(self, address: int, content: bytes) -> None:
        """A client's write of one register.

        Raises:
            Refused: no such register, it is read-only, or the value is out of its bounds.
        """
        memory, at = self._place(address, len(content))
        check = self._checks.get(address)
        if check is None and address not in self._told:
            raise Refused(WRITE_PROTECT)
        before = bytes(memory[at : at + len(content)])
        if check is not None and not check(content, self):
            raise Refused(INVALID_PARAMETER)
        memory[at : at + len(content)] = content
        told = self._told.get(address)
        if told is not None:
            try:
                told(int.from_bytes(content[:4], "big"))
            except Refused:
                memory[at : at + len(content)] = before
                raise

    def _place(self, address: int, size: int) -> tuple[bytearray, int]:
        if address % 4:
            raise Refused(BAD_ALIGNMENT)
        if address >= 0 and address + size <= BOOTSTRAP_BYTES:
            return self._bootstrap, address
        if address >= OWN_AT and address + size <= OWN_AT + OWN_BYTES:
            return self._own, address - OWN_AT
        raise Refused(INVALID_ADDRESS)

    def _fill_bootstrap(self, identity: Identity) -> None:
        word = self.set_word
        word(0x0, 0x00010002)  # GigE Vision 1.2
        word(0x4, 0x80000001)  # big endian, UTF-8
        word(MAC_HIGH, int.from_bytes(identity.mac[:2], "big"))
        word(MAC_LOW, int.from_bytes(identity.mac[2:], "big"))
        word(0x10, 0x7)
        word(0x14, 0x5)
        word(CURRENT_ADDRESS, int(ipaddress.IPv4Address(identity.address)))
        word(CURRENT_MASK, 0xFF000000)
        for address, length, text in (
            (0x48, 32, VENDOR),
            (0x68, 32, MODEL),
            (0x88, 32, VERSION),
            (0xA8, 48, "a simulated camera"),
            (f.SERIAL_NUMBER, 16, identity.serial),
            (f.USER_NAME, 16, identity.user_name),
            (XML_URL_0, 512, f"Local:fringed.xml;{XML_AT:x};{len(self._xml):x}"),
        ):
            self._bootstrap[address : address + length] = text.encode()[: length - 1].ljust(length, b"\0")
        word(0x600, 1)
        word(0x904, 1)
        word(CAPABILITY, CAN_CONCATENATE | CAN_WRITE_MEMORY | CAN_RESEND | HAS_SERIAL | HAS_USER_NAME)
        word(f.HEARTBEAT_TIMEOUT, 3000)
        word(f.TICK_HIGH, identity.tick_hz >> 32)
        word(f.TICK_LOW, identity.tick_hz)
        word(f.PACKET_SIZE, 1500)

    def _fill_own(self, size: tuple[int, int]) -> None:
        width, height = size
        for address, value in (
            (f.SENSOR_WIDTH, width),
            (f.SENSOR_HEIGHT, height),
            (f.WIDTH, width),
            (f.HEIGHT, height),
            (f.WIDTH_MAX, width),
            (f.HEIGHT_MAX, height),
            (f.BINNING_X, 1),
            (f.BINNING_Y, 1),
            (f.PIXEL_FORMAT, f.MONO8),
            (f.LINE_PERIOD, 16_667),
            (f.LINE_COUNT, 1),
            # As cameras come out of the box: everything that can spoil a measurement is on.
            (f.EXPOSURE_AUTO, f.AUTO["Continuous"]),
            (f.GAIN_AUTO, f.AUTO["Continuous"]),
            (f.WHITE_AUTO, f.AUTO["Continuous"]),
        ):
            self.set_word(address, value)
        self.set_number(f.GAMMA, 0.7)


_Check = Callable[[bytes, Registers], bool]


def _checks() -> Mapping[int, _Check]:
    """What is written through features is checked by the feature's own bounds."""
    found: dict[int, _Check] = {}
    for feature in f.FEATURES.values():
        if feature.access == "RO" or feature.port != "Device" or feature.bits is not None:
            continue
        if feature.selected_by:
            for value in f.FEATURES[feature.selected_by].entries.values():
                found[feature.address + 4 * value] = _check_of(feature)
        else:
            found[feature.address] = _check_of(feature)
    for address in (CONTROL_PRIVILEGE, STREAM_PORT, STREAM_ADDRESS, f.PACKET_SIZE):
        found[address] = lambda content, _: len(content) == 4
    return found


def _check_of(feature: f.Feature) -> _Check:
    def check(content: bytes, registers: Registers) -> bool:
        if feature.kind == "string":
            return len(content) <= feature.length
        if feature.kind == "float":
            return len(content) == 8 and _within(feature, struct.unpack(">d", content)[0], registers)
        if len(content) != 4:
            return False
        value = int.from_bytes(content, "big")
        if feature.kind == "enumeration":
            return value in feature.entries.values()
        if feature.kind == "boolean":
            return value in (0, 1)
        return feature.kind == "command" or (value % feature.step == 0 and _within(feature, value, registers))

    return check


def _within(feature: f.Feature, value: float, registers: Registers) -> bool:
    high = feature.high
    if isinstance(high, str):
        bound = f.FEATURES[high]
        high = registers.number(bound.address) if bound.kind == "float" else registers.word(bound.address)
    return (feature.low is None or value >= feature.low) and (high is None or value <= high * (1 + 1e-9))
