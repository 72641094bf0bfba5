"""A USB3 Vision camera on the guest's own USB: real descriptors, real bulk transfers, seen by the kernel and by Aravis.

The kernel's FunctionFS gives this process the device's end of dummy_hcd's second port. Control channel and stream are
those of the standard (GenCP 1.2, USB3 Vision 1.0); features, their registers and the sensor that exposes are the
simulated GigE camera's, registers moved out of the way of the standard's own. It shows a ramp that moves on with the
frame's number, or an even light where it is told one.
"""

from __future__ import annotations

import os
import re
import struct
import subprocess
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from drivers.simulated import gige_features as f
from drivers.simulated.gige_registers import OWN_AT, XML_AT, Identity, Refused, Registers
from drivers.simulated.gige_sensor import Sensor
from drivers.simulated.gige_stream import Picture
from drivers.simulated.gige_time import DeviceClock
from drivers.simulated.options import CameraOptions
from scanner.clock import MonotonicClock

VENDOR, MODEL, SERIAL = "fringed", "simulated-usb3", "U3V1"
WIDTH, HEIGHT = 320, 240
SENSOR = CameraOptions(readout_us=30_000.0, period_us=50_000.0)
"""Slow: a message to it takes the guest some milliseconds, and the second of two must find it busy"""
FULL_NS = 16_000_000
"""The exposure at which a picture is as bright as the light"""

_GADGET = Path("/sys/kernel/config/usb_gadget/usb3")
_ENDPOINTS = Path("/dev/usb3-camera")
_CONTROLLER = "dummy_udc.1"
_PORT = "usb2/2-0:1.0/usb2-port1"

_SBRM_AT, _SIRM_AT, _MANIFEST_AT, _GIGE_AT = 0x2000, 0x3000, 0x4000, 0x8000
_CONTROL = 0x0004
"""SI_CONTROL, bit 0: the stream is enabled"""
_LEADER_BYTES, _TRAILER_BYTES, _MESSAGE_BYTES = 52, 32, 1024
_IMAGE, _WITH_CHUNKS = 0x0001, 0x4000
_READ, _WRITE = 0x0800, 0x0802
_MAGIC = 0x43563355
_ANSWER_MS = 2000


def _descriptors() -> bytes:
    """For FunctionFS: interfaces and endpoints at high speed.

    Aravis takes both directions of the control channel to have one number, as real cameras have it. dummy_hcd deals out
    1in and 2out, 7out, 12out before 1out: an interface without meaning takes those three first.
    """

    def interface(number: int, endpoints: int, kind: tuple[int, int, int]) -> bytes:
        return struct.pack("<9B", 9, 4, number, 0, endpoints, *kind, 0)

    def bulk(address: int) -> bytes:
        return struct.pack("<4BHB", 7, 5, address, 2, 512, 0)

    body = interface(0, 3, (0xFF, 0, 0)) + bulk(0x02) + bulk(0x03) + bulk(0x04)
    body += interface(1, 2, (0xEF, 5, 0)) + bulk(0x81) + bulk(0x01)
    body += interface(2, 1, (0xEF, 5, 2)) + bulk(0x85)
    magic, has_high_speed = 3, 2
    return struct.pack("<4I", magic, 16 + len(body), has_high_speed, 9) + body


_STRINGS = struct.pack("<4I", 2, 16, 0, 0)


class _Features(Registers):
    """The GigE camera's registers under a USB3 camera's document."""

    def __init__(self) -> None:
        super().__init__(Identity("127.0.0.1", SERIAL), (WIDTH, HEIGHT))
        text = self._xml.decode().replace('StandardNameSpace="GEV"', 'StandardNameSpace="U3V"')
        text = text.replace("GevTimestampControlLatch", "TimestampLatch")
        text = text.replace("GevTimestampValue", "TimestampLatchValue")

        def moved(found: re.Match[str]) -> str:
            at = int(found[1], 16)
            return f"<Address>0x{at + (_GIGE_AT if 0 < at < 0x1000 else 0):X}</Address>"

        self._xml = re.sub(r"<Address>0x([0-9A-F]+)</Address>", moved, text).encode()

    @property
    def document_bytes(self) -> int:
        return len(self._xml)


class _World:
    """What the sensor exposes on: an even light."""

    def __init__(self) -> None:
        self.light = 0
        self.clock = MonotonicClock()
        self.lines: dict[str, Any] = {}
        self.rig = SimpleNamespace(calibration=SimpleNamespace(camera=SimpleNamespace(size=(WIDTH, HEIGHT))))

    def render(
        self, start_ns: int, exposure_ns: int, rolling_ns: int, gain_db: float, bits: int, number: int, frame: Any
    ) -> None:
        """Into `frame`, (H, W)."""
        frame[...] = min(round(self.light * exposure_ns / FULL_NS), 255) << max(0, bits - 8)


class Usb3Camera:
    """Plugged in from `__init__` to `close`."""

    def __init__(self) -> None:
        self._features = _Features()
        self._memory = bytearray(0x5000)
        self._world: Any = _World()
        self._clock = DeviceClock(1_000_000_000, 0, 0.0, 0)
        self._sending = threading.Lock()
        self._closing = False
        stream: Any = self  # it sends; what else a wire does concerns no sensor
        self._sensor = Sensor(self._world, SENSOR, self._features, stream, self._clock, queue=0)
        self._fill()
        self._build()
        self._files = [os.open(_ENDPOINTS / f"ep{number}", os.O_RDWR) for number in (4, 5, 6)]
        self._answers, self._commands, self._stream = self._files
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._serve, self._drain)]
        for thread in self._threads:
            thread.start()
        (_GADGET / "UDC").write_text(_CONTROLLER)

    @staticmethod
    def picture(number: int) -> NDArray[np.uint8]:
        """What frame `number` (from 0 at each start) shows while there is no light."""
        return np.add.outer(np.arange(HEIGHT), np.arange(WIDTH) + number).astype(np.uint8)

    def set_light(self, level: int) -> None:
        """Of pictures that begin from now on; 0: they show the ramp."""
        self._world.light = level

    def close(self) -> None:
        """Pull the plug, and take the gadget apart."""
        self._closing = True
        (_GADGET / "UDC").write_text("\n")
        self._sensor.close()
        for thread in self._threads:
            thread.join(5)
            assert not thread.is_alive()
        for each in (*self._files, self._setup):
            os.close(each)
        self._take_apart()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- the gadget ---------------------------------------------------------------------------------------------------

    def _build(self) -> None:
        subprocess.run(["modprobe", "usb_f_fs"], check=True)
        config, strings = _GADGET / "configs/c.1", _GADGET / "strings/0x409"
        for folder in (_GADGET, config, strings, _GADGET / "functions/ffs.usb3"):
            folder.mkdir()
        # A composite device (class ef, subclass 02, protocol 01) of a vendor number for tests (pid.codes).
        numbers = {"idVendor": "0x1209", "idProduct": "0x0001", "bDeviceClass": "0xef", "bDeviceSubClass": "0x02"}
        for name, value in {**numbers, "bDeviceProtocol": "0x01"}.items():
            (_GADGET / name).write_text(value)
        for name, value in {"manufacturer": VENDOR, "product": MODEL, "serialnumber": SERIAL}.items():
            (strings / name).write_text(value)
        (config / "ffs.usb3").symlink_to(_GADGET / "functions/ffs.usb3")
        _ENDPOINTS.mkdir()
        subprocess.run(["mount", "-t", "functionfs", "usb3", str(_ENDPOINTS)], check=True)
        self._setup = os.open(_ENDPOINTS / "ep0", os.O_RDWR | os.O_NONBLOCK)
        os.write(self._setup, _descriptors())
        os.write(self._setup, _STRINGS)

    @staticmethod
    def _take_apart() -> None:
        subprocess.run(["umount", str(_ENDPOINTS)], check=True)
        _ENDPOINTS.rmdir()
        (_GADGET / "configs/c.1/ffs.usb3").unlink()
        for folder in ("configs/c.1", "functions/ffs.usb3", "strings/0x409", "."):
            (_GADGET / folder).rmdir() if folder != "." else _GADGET.rmdir()

    def _drain(self) -> None:
        """Events of the device as a whole (bound, enabled, suspended): there is nothing to be done about them."""
        while not self._closing:
            try:
                os.read(self._setup, 64)
            except BlockingIOError:
                time.sleep(0.05)
            except OSError:
                return

    # --- memory -------------------------------------------------------------------------------------------------------

    def _fill(self) -> None:
        """Bootstrap registers, little-endian (GenCP 1.2, 4.3; USB3 Vision 1.0, 4.3 and 4.4)."""
        put = self._put
        put(0x0000, "<I", 0x00010002)
        for at, text in ((0x04, VENDOR), (0x44, MODEL), (0xC4, "1"), (0x144, SERIAL)):
            self._memory[at : at + 64] = text.encode().ljust(64, b"\0")
        put(0x01CC, "<I", _ANSWER_MS)
        put(0x01D0, "<Q", _MANIFEST_AT)
        put(0x01D8, "<Q", _SBRM_AT)
        put(_SBRM_AT, "<I", 0x00010000)
        put(_SBRM_AT + 0x14, "<II", _MESSAGE_BYTES, _MESSAGE_BYTES)
        put(_SBRM_AT + 0x1C, "<IQ", 1, _SIRM_AT)
        put(_SIRM_AT + 0x10, "<II", _LEADER_BYTES, _TRAILER_BYTES)
        put(_MANIFEST_AT, "<Q", 1)
        put(_MANIFEST_AT + 8, "<HBBIQQ", 0, 0, 1, 0, XML_AT, self._features.document_bytes)
        features, sensor = self._features, self._sensor
        features.set_number(f.EXPOSURE_TIME, 1000.0)
        features.set_number(f.READOUT_TIME, SENSOR.readout_us)
        features.on_write(f.ACQUISITION_START, lambda _: sensor.start())
        features.on_write(f.ACQUISITION_STOP, lambda _: self._stop())
        features.on_write(f.TRIGGER_SOFTWARE, lambda _: sensor.software_trigger())
        features.on_write(f.COUNTER_RESET, lambda _: sensor.reset_counter())
        features.on_read(f.COUNTER_VALUE, self._read_counter)
        features.on_write(f.LATCH, lambda _: self._latch())
        for at in (f.WIDTH, f.HEIGHT, f.PIXEL_FORMAT, f.EXPOSURE_TIME, f.CHUNK_ACTIVE):
            features.on_write(at, lambda _: self._fit())
        for index in f.CHUNKS.values():
            features.on_write(f.CHUNK_ENABLE + 4 * index, lambda _: self._fit())
        self._fit()

    def _put(self, at: int, form: str, *values: int) -> None:
        struct.pack_into(form, self._memory, at, *values)

    def _fit(self) -> None:
        """Registers that follow from others."""
        payload = self._sensor.payload_size()
        self._features.set_word(f.PAYLOAD_SIZE, payload)
        self._put(_SIRM_AT + 0x08, "<Q", payload)
        fastest = 1e9 / SENSOR.period_ns(round(1e3 * self._features.number(f.EXPOSURE_TIME)))
        self._features.set_number(f.FRAME_RATE_MAX, fastest)
        if not 0 < self._features.number(f.FRAME_RATE) <= fastest:
            self._features.set_number(f.FRAME_RATE, fastest)

    def _latch(self) -> None:
        now = self._clock.ticks(time.monotonic_ns())
        self._features.set_word(f.LATCHED_HIGH, now >> 32)
        self._features.set_word(f.LATCHED_LOW, now)

    def _read_counter(self) -> None:
        count = self._sensor.counter(time.monotonic_ns(), self._features.word(f.COUNTER_SOURCE))
        self._features.set_word(f.COUNTER_VALUE, count)

    def _stop(self) -> None:
        """A frame under way is sent to its end: the host takes transfers back only after this."""
        self._sensor.stop()
        if self._sending.acquire(timeout=_ANSWER_MS / 2e3):
            self._sending.release()

    # --- the control channel ------------------------------------------------------------------------------------------

    def _serve(self) -> None:
        while not self._closing:
            try:
                message = os.read(self._commands, _MESSAGE_BYTES)
                if message:
                    os.write(self._answers, self._answer(message))
            except OSError:
                time.sleep(0.02)  # not configured by a host, or not any more

    def _answer(self, message: bytes) -> bytes:
        _, _, command, length, number = struct.unpack_from("<IHHHH", message)
        body, content, status = message[12 : 12 + length], b"", 0
        try:
            if command == _READ:
                at, _, count = struct.unpack("<QHH", body)
                content = self._read(at, count)
            else:
                (at,) = struct.unpack_from("<Q", body)
                self._write(at, body[8:])
                content = struct.pack("<HH", 0, len(body) - 8)
        except Refused as refused:
            status = refused.status
        return struct.pack("<IHHHH", _MAGIC, status, command + 1, len(content), number) + content

    def _read(self, at: int, count: int) -> bytes:
        if at + count <= len(self._memory):
            return bytes(self._memory[at : at + count])
        return self._features.read(at - (_GIGE_AT if at < OWN_AT else 0), count)

    def _write(self, at: int, content: bytes) -> None:
        if at + len(content) <= len(self._memory):
            self._memory[at : at + len(content)] = content
        else:
            self._features.write(at - (_GIGE_AT if at < OWN_AT else 0), content)

    # --- the stream ---------------------------------------------------------------------------------------------------

    def send(self, block: int, picture: Picture, content: memoryview, _bytes: int, _delay_s: float) -> None:
        """A frame that the sensor has read out, on its thread; `block` counts from 1."""
        with self._sending:
            if self._closing or not self._sensor.acquiring:
                return
            try:
                for part in self._parts(block - 1, picture, bytearray(content)):
                    os.write(self._stream, part)
            except OSError:
                self._sensor.stop()  # the host went away, or took its transfers back

    def _parts(self, number: int, picture: Picture, content: bytearray) -> tuple[bytes, bytes, bytes]:
        """Leader, payload and trailer of a frame (USB3 Vision 1.0, 5.4)."""
        if not self._world.light and picture.pixel_format == f.MONO8:
            x, y, width, height = picture.offset_x, picture.offset_y, picture.width, picture.height
            content[: width * height] = self.picture(number)[y : y + height, x : x + width].tobytes()
        kind = _IMAGE
        if picture.has_chunks:
            kind |= _WITH_CHUNKS
            _turn_tags(content)
        place = (picture.pixel_format, picture.width, picture.height, picture.offset_x, picture.offset_y, 0, 0)
        leader = struct.pack("<4sHHQ", b"U3VL", 0, _LEADER_BYTES, number)
        leader += struct.pack("<HHQIIIIIHH", 0, kind, picture.stamp, *place)
        trailer = struct.pack("<4sHHQ", b"U3VT", 0, _TRAILER_BYTES, number)
        return leader, bytes(content), trailer + struct.pack("<HHQI", 0, 0, len(content), picture.height)


def _turn_tags(content: bytearray) -> None:
    """Behind each chunk its name and size, which are little-endian here, and big-endian in GigE Vision."""
    end = len(content)
    while end > 0:
        name, size = struct.unpack_from(">II", content, end - 8)
        struct.pack_into("<II", content, end - 8, name, size)
        end -= 8 + size


def node() -> Path:
    """The camera's device node."""
    (found,) = [
        path.parent for path in Path("/sys/bus/usb/devices").glob("*/serial") if path.read_text().strip() == SERIAL
    ]
    bus, number = ((found / name).read_text() for name in ("busnum", "devnum"))
    return Path(f"/dev/bus/usb/{int(bus):03}/{int(number):03}")


def cable(plugged: bool) -> None:
    """Cut the port's power, or give it again."""
    Path(f"/sys/bus/usb/devices/{_PORT}/disable").write_text("0" if plugged else "1")


def wait_for(condition: Any, seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)
