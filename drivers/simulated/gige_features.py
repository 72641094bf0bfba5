"""The GenICam features of the simulated GigE Vision camera, and the XML document that describes them to a client.

One table: a feature's name and kind, the register behind it, its bounds and choices. Names and meanings are those of
the GenICam Standard Features Naming Convention 2.7; the document's form is GenApi schema 1.1. Nothing here has a
value: registers do (`gige_registers`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal
from xml.sax.saxutils import escape, quoteattr

Kind = Literal["integer", "float", "enumeration", "boolean", "command", "string"]


@dataclass(frozen=True)
class Feature:
    """One feature over one register. Bounds are numbers, or names of features that hold them."""

    name: str
    kind: Kind
    address: int
    access: str = "RW"
    low: float | None = None
    high: float | str | None = None
    step: int = 1
    entries: Mapping[str, int] = field(default_factory=dict)
    selects: tuple[str, ...] = ()
    """features that change their register with this one's value"""
    selected_by: str = ""
    """the register is `address` + 4 x the value of this feature"""
    unit: str = ""
    port: str = "Device"
    length: int = 4
    bits: tuple[int, int] | None = None
    """most and least significant bit of the register, 31 .. 0, where the feature is a part of it"""


# Bootstrap registers that are features, too (GigE Vision 1.2, table 27-1).
HEARTBEAT_TIMEOUT, TICK_HIGH, TICK_LOW = 0x938, 0x93C, 0x940
LATCH, LATCHED_HIGH, LATCHED_LOW = 0x944, 0x948, 0x94C
PACKET_SIZE, PACKET_DELAY = 0xD04, 0xD08
USER_NAME = 0xE8

# Registers of this camera.
SENSOR_WIDTH, SENSOR_HEIGHT = 0x10000, 0x10004
WIDTH, HEIGHT, OFFSET_X, OFFSET_Y = 0x10010, 0x10014, 0x10018, 0x1001C
WIDTH_MAX, HEIGHT_MAX, OFFSET_X_MAX, OFFSET_Y_MAX = 0x10020, 0x10024, 0x10028, 0x1002C
BINNING_X, BINNING_Y = 0x10030, 0x10034
PIXEL_FORMAT, PAYLOAD_SIZE = 0x10040, 0x10044
ACQUISITION_MODE, ACQUISITION_START, ACQUISITION_STOP = 0x10100, 0x10104, 0x10108
FRAME_RATE_ENABLE, FRAME_RATE, FRAME_RATE_MAX = 0x10110, 0x10118, 0x10120
EXPOSURE_TIME, EXPOSURE_AUTO, READOUT_TIME = 0x10130, 0x10138, 0x10140
GAIN, GAIN_AUTO, GAMMA, WHITE_AUTO = 0x10150, 0x10158, 0x10160, 0x10168
TRIGGER_SELECTOR, TRIGGER_MODE, TRIGGER_SOURCE = 0x10200, 0x10204, 0x10208
TRIGGER_ACTIVATION, TRIGGER_DELAY, TRIGGER_SOFTWARE, TRIGGER_OVERLAP = 0x1020C, 0x10210, 0x10218, 0x1021C
COUNTER_SELECTOR, COUNTER_SOURCE, COUNTER_RESET, COUNTER_VALUE = 0x10300, 0x10304, 0x10308, 0x1030C
CHUNK_ACTIVE, CHUNK_SELECTOR, CHUNK_ENABLE = 0x10400, 0x10404, 0x10410
LINE_PERIOD, LINE_COUNT, LINE_START = 0x10500, 0x10504, 0x10508
SERIAL_NUMBER = 0xD8

MONO8, MONO10, MONO12, MONO14, MONO16 = 0x01080001, 0x01100003, 0x01100005, 0x01100025, 0x01100007
MONO10P, MONO12P, MONO10_PACKED, MONO12_PACKED = 0x010A0046, 0x010C0047, 0x010C0004, 0x010C0006
BAYER_RG8, BAYER_RG12 = 0x01080009, 0x01100011

PIXEL_FORMATS: Mapping[str, int] = {
    "Mono8": MONO8,
    "Mono10": MONO10,
    "Mono10p": MONO10P,
    "Mono10Packed": MONO10_PACKED,
    "Mono12": MONO12,
    "Mono12p": MONO12P,
    "Mono12Packed": MONO12_PACKED,
    "Mono14": MONO14,
    "Mono16": MONO16,
    "BayerRG8": BAYER_RG8,
    "BayerRG12": BAYER_RG12,
}
"""Codes of the Pixel Format Naming Convention 2.1."""

OFF_ON = {"Off": 0, "On": 1}
AUTO = {"Off": 0, "Once": 1, "Continuous": 2}
SOFTWARE_SOURCE, LINE1_SOURCE = 0, 1
COUNTER_SOURCES = {"Off": 0, "Line1": 1, "FrameTrigger": 2, "ExposureStart": 3}
CHUNKS = {"CounterValue": 0, "Timestamp": 1, "ExposureTime": 2}
CHUNK_IDS = {"CounterValue": 0x201, "Timestamp": 0x202, "ExposureTime": 0x203}
IMAGE_CHUNK = 0x100

EXPOSURE_MIN_US, EXPOSURE_MAX_US = 10.0, 1_000_000.0
GAIN_MAX_DB = 24.0
LEAST_SIDE = 16


def _chunk_ports() -> dict[str, int]:
    return {f"Chunk{name}Port": identity for name, identity in CHUNK_IDS.items()}


CATEGORIES: Mapping[str, tuple[Feature, ...]] = {
    "DeviceControl": (
        Feature("DeviceVendorName", "string", 0x48, "RO", length=32),
        Feature("DeviceModelName", "string", 0x68, "RO", length=32),
        Feature("DeviceVersion", "string", 0x88, "RO", length=32),
        Feature("DeviceSerialNumber", "string", SERIAL_NUMBER, "RO", length=16),
        Feature("DeviceUserID", "string", USER_NAME, length=16),
    ),
    "ImageFormatControl": (
        Feature("SensorWidth", "integer", SENSOR_WIDTH, "RO"),
        Feature("SensorHeight", "integer", SENSOR_HEIGHT, "RO"),
        Feature("WidthMax", "integer", WIDTH_MAX, "RO"),
        Feature("HeightMax", "integer", HEIGHT_MAX, "RO"),
        Feature("Width", "integer", WIDTH, low=LEAST_SIDE, high="WidthMax", step=4),
        Feature("Height", "integer", HEIGHT, low=LEAST_SIDE, high="HeightMax", step=2),
        Feature("OffsetXMax", "integer", OFFSET_X_MAX, "RO"),
        Feature("OffsetYMax", "integer", OFFSET_Y_MAX, "RO"),
        Feature("OffsetX", "integer", OFFSET_X, low=0, high="OffsetXMax", step=2),
        Feature("OffsetY", "integer", OFFSET_Y, low=0, high="OffsetYMax", step=2),
        Feature("BinningHorizontal", "integer", BINNING_X, low=1, high=4),
        Feature("BinningVertical", "integer", BINNING_Y, low=1, high=4),
        Feature("PixelFormat", "enumeration", PIXEL_FORMAT, entries=PIXEL_FORMATS),
    ),
    "AcquisitionControl": (
        Feature("AcquisitionMode", "enumeration", ACQUISITION_MODE, entries={"Continuous": 0}),
        Feature("AcquisitionStart", "command", ACQUISITION_START, "WO"),
        Feature("AcquisitionStop", "command", ACQUISITION_STOP, "WO"),
        Feature("AcquisitionFrameRateEnable", "boolean", FRAME_RATE_ENABLE),
        Feature("AcquisitionFrameRateMax", "float", FRAME_RATE_MAX, "RO", length=8, unit="Hz"),
        Feature(
            "AcquisitionFrameRate", "float", FRAME_RATE, low=0.1, high="AcquisitionFrameRateMax", length=8, unit="Hz"
        ),
        Feature("ExposureTime", "float", EXPOSURE_TIME, low=EXPOSURE_MIN_US, high=EXPOSURE_MAX_US, length=8, unit="us"),
        Feature("ExposureAuto", "enumeration", EXPOSURE_AUTO, entries=AUTO),
        Feature("SensorReadoutTime", "float", READOUT_TIME, "RO", length=8, unit="us"),
        Feature(
            "TriggerSelector",
            "enumeration",
            TRIGGER_SELECTOR,
            entries={"FrameStart": 0},
            selects=("TriggerMode", "TriggerSource", "TriggerActivation", "TriggerDelay", "TriggerSoftware"),
        ),
        Feature("TriggerMode", "enumeration", TRIGGER_MODE, entries=OFF_ON),
        Feature(
            "TriggerSource",
            "enumeration",
            TRIGGER_SOURCE,
            entries={"Software": SOFTWARE_SOURCE, "Line1": LINE1_SOURCE},
        ),
        Feature("TriggerActivation", "enumeration", TRIGGER_ACTIVATION, entries={"RisingEdge": 0, "FallingEdge": 1}),
        Feature("TriggerDelay", "float", TRIGGER_DELAY, low=0.0, high=1e6, length=8, unit="us"),
        Feature("TriggerOverlap", "enumeration", TRIGGER_OVERLAP, "RO", entries={"Off": 0}),
        Feature("TriggerSoftware", "command", TRIGGER_SOFTWARE, "WO"),
    ),
    "AnalogControl": (
        Feature("Gain", "float", GAIN, low=0.0, high=GAIN_MAX_DB, length=8, unit="dB"),
        Feature("GainAuto", "enumeration", GAIN_AUTO, entries=AUTO),
        Feature("Gamma", "float", GAMMA, low=0.25, high=4.0, length=8),
        Feature("BalanceWhiteAuto", "enumeration", WHITE_AUTO, entries=AUTO),
    ),
    "CounterAndTimerControl": (
        Feature(
            "CounterSelector",
            "enumeration",
            COUNTER_SELECTOR,
            entries={"Counter0": 0},
            selects=("CounterEventSource", "CounterReset", "CounterValue"),
        ),
        Feature("CounterEventSource", "enumeration", COUNTER_SOURCE, entries=COUNTER_SOURCES),
        Feature("CounterReset", "command", COUNTER_RESET, "WO"),
        Feature("CounterValue", "integer", COUNTER_VALUE, "RO"),
    ),
    "ChunkDataControl": (
        Feature("ChunkModeActive", "boolean", CHUNK_ACTIVE),
        Feature("ChunkSelector", "enumeration", CHUNK_SELECTOR, entries=CHUNKS, selects=("ChunkEnable",)),
        Feature("ChunkEnable", "boolean", CHUNK_ENABLE, selected_by="ChunkSelector"),
        Feature("ChunkCounterValue", "integer", 0, "RO", port="ChunkCounterValuePort"),
        Feature("ChunkTimestamp", "integer", 0, "RO", port="ChunkTimestampPort", length=8),
        Feature("ChunkExposureTime", "float", 0, "RO", port="ChunkExposureTimePort", length=8, unit="us"),
    ),
    "TransportLayerControl": (
        Feature("PayloadSize", "integer", PAYLOAD_SIZE, "RO", unit="B"),
        Feature("GevHeartbeatTimeout", "integer", HEARTBEAT_TIMEOUT, low=300, high=60_000, unit="ms"),
        Feature("GevTimestampTickFrequency", "integer", TICK_LOW, "RO", unit="Hz"),
        Feature("GevTimestampControlLatch", "command", LATCH, "WO"),
        Feature("GevTimestampValue", "integer", LATCHED_HIGH, "RO", length=8),
        Feature("GevSCPSPacketSize", "integer", PACKET_SIZE, low=576, high=65_000, step=4, unit="B", bits=(15, 0)),
        Feature("GevSCPSFireTestPacket", "boolean", PACKET_SIZE, bits=(31, 31)),
        Feature("GevSCPD", "integer", PACKET_DELAY, low=0, high=1_000_000),
    ),
    "TestLineControl": (
        # Not of the naming convention: the camera's line can be pulsed by itself, where nobody has a wire.
        Feature("TestLinePeriod", "integer", LINE_PERIOD, low=100, high=10_000_000, unit="us"),
        Feature("TestLinePulses", "integer", LINE_COUNT, low=1, high=1_000_000),
        Feature("TestLineStart", "command", LINE_START, "WO"),
    ),
}

FEATURES: Mapping[str, Feature] = {feature.name: feature for group in CATEGORIES.values() for feature in group}


def document(vendor: str, model: str) -> bytes:
    """The description of the camera as a client reads it, UTF-8."""
    lines = [
        '<?xml version="1.0" encoding="utf-8"?>',
        f"<RegisterDescription ModelName={quoteattr(model)} VendorName={quoteattr(vendor)}"
        ' StandardNameSpace="GEV" SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0"'
        ' MajorVersion="1" MinorVersion="0" SubMinorVersion="0" ToolTip="simulated camera"'
        ' ProductGuid="5b1d1bd0-4e44-4c1e-a9f9-2c6c1f0a7e11" VersionGuid="a8d2c7ce-8f0a-4d30-a9fb-7d9e64a3c2f4"'
        ' xmlns="http://www.genicam.org/GenApi/Version_1_1">',
        '<Category Name="Root" NameSpace="Standard">',
        *(f"<pFeature>{name}</pFeature>" for name in CATEGORIES),
        "</Category>",
    ]
    for name, group in CATEGORIES.items():
        lines.append(f'<Category Name="{name}" NameSpace="Standard">')
        lines += [f"<pFeature>{feature.name}</pFeature>" for feature in group]
        lines.append("</Category>")
    for feature in FEATURES.values():
        lines += _feature(feature)
    lines.append('<Port Name="Device" NameSpace="Standard"></Port>')
    for port, identity in _chunk_ports().items():
        lines.append(f'<Port Name="{port}" NameSpace="Custom"><ChunkID>{identity:X}</ChunkID></Port>')
    lines.append("</RegisterDescription>")
    return "\n".join(lines).encode()


def _feature(feature: Feature) -> Iterator[str]:
    if feature.kind == "string":
        yield f'<StringReg Name="{feature.name}" NameSpace="Standard">'
        yield from _register_body(feature)
        yield "</StringReg>"
        return
    tag = feature.kind.capitalize()
    yield f'<{tag} Name="{feature.name}" NameSpace="Standard">'
    for name, value in feature.entries.items():
        yield f'<EnumEntry Name="{name}" NameSpace="Standard"><Value>{value}</Value></EnumEntry>'
    yield f"<pValue>{feature.name}Register</pValue>"
    yield from _limits(feature)
    if feature.kind == "command":
        yield f"<CommandValue>{1 if feature.address != LATCH else 2}</CommandValue>"
    if feature.kind == "boolean":
        yield "<OnValue>1</OnValue><OffValue>0</OffValue>"
    for name in feature.selects:
        yield f"<pSelected>{name}</pSelected>"
    yield f"</{tag}>"
    yield from _register(feature)


def _limits(feature: Feature) -> Iterator[str]:
    if feature.kind not in ("integer", "float"):
        return
    if feature.low is not None:
        yield f"<Min>{feature.low:g}</Min>"
    if isinstance(feature.high, str):
        yield f"<pMax>{feature.high}</pMax>"
    elif feature.high is not None:
        yield f"<Max>{feature.high:.0f}</Max>"
    if feature.kind == "integer" and feature.step != 1:
        yield f"<Inc>{feature.step}</Inc>"
    if feature.unit:
        yield f"<Unit>{escape(feature.unit)}</Unit>"


def _register(feature: Feature) -> Iterator[str]:
    tag = "FloatReg" if feature.kind == "float" else "IntReg" if feature.bits is None else "MaskedIntReg"
    yield f'<{tag} Name="{feature.name}Register" NameSpace="Custom">'
    yield from _register_body(feature)
    if feature.bits is not None:
        # Bits of a big-endian register are counted from its most significant one.
        yield f"<LSB>{31 - feature.bits[1]}</LSB><MSB>{31 - feature.bits[0]}</MSB>"
    if tag != "FloatReg":
        yield "<Sign>Unsigned</Sign>"
    yield "<Endianess>BigEndian</Endianess>"
    yield f"</{tag}>"


def _register_body(feature: Feature) -> Iterator[str]:
    yield f"<Address>0x{feature.address:X}</Address>"
    if feature.selected_by:
        yield f'<pIndex Offset="4">{feature.selected_by}Register</pIndex>'  # an index is an integer, no enumeration
    yield f"<Length>{feature.length}</Length><AccessMode>{feature.access}</AccessMode>"
    yield f"<pPort>{feature.port}</pPort><Cachable>NoCache</Cachable>"
