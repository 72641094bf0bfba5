"""A simulated GigE Vision camera on a real wire: a device that any client of the standard can find, open and read.

It stands in the simulated world, shows what shines there, and speaks GVCP and GVSP over UDP on an address of its own
(127.0.0.2, 127.0.0.3 ...). It is no driver: the host reaches it by a driver for real cameras. Registers and features:
`gige_features`, `gige_registers`; messages: `gige_control`; packets: `gige_stream`; exposures: `gige_sensor`.
"""

from __future__ import annotations

import contextlib
import ipaddress
import select
import socket
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from drivers.simulated import gige_features as f
from drivers.simulated import gige_registers as r
from drivers.simulated.faults import CameraFaults
from drivers.simulated.gige_control import PORT, Control
from drivers.simulated.gige_registers import Identity, Refused, Registers
from drivers.simulated.gige_sensor import Sensor
from drivers.simulated.gige_stream import Stream, StreamCounts
from drivers.simulated.gige_time import DeviceClock
from drivers.simulated.lines import Regular
from drivers.simulated.options import Settings, read_settings
from drivers.simulated.world import NOMINAL_EXPOSURE_NS, enter_world
from scanner.clock import Clock
from scanner.errors import ConfigError, DeviceBusy

EVERYBODY = "255.255.255.255"
LOOPBACK = ipaddress.IPv4Network("127.0.0.0/8")
LONGEST_MESSAGE = 2048
HEARTBEAT_LOOK_S = 0.1


@dataclass(frozen=True)
class WireOptions:
    """What the wire adds to a simulated camera."""

    address: str = "127.0.0.2"
    serial: str = ""
    """empty: the address in hexadecimal digits"""
    user_name: str = ""
    loss: float = 0.0
    """share of packets that never arrive"""
    queue: int = 0
    """triggers remembered while the camera is busy; 0 drops them, 1 is the one-slot latch"""
    tick_hz: int = 125_000_000
    clock_ppm: float = 30.0
    """the camera's clock is fast by this"""
    link_mbit_s: float = 0.0
    """speed of the wire; 0: as fast as the machine can"""
    options: Mapping[str, Any] = field(default_factory=dict)
    """as of the simulated camera: shutter, readout_us, min_gap_us, ring, seed ..."""


class GigeCamera:
    """One camera on the wire, from `__init__` to `close`; threads of its own answer and send."""

    def __init__(self, device: str, wire: WireOptions, clock: Clock) -> None:
        """device: RIG/SCENE[?option=value], as the simulated camera's.

        Raises:
            ConfigError: unknown rig, scene or option, or one that a camera on the wire does not have.
            DeviceBusy: the address is taken, or the world has a camera.
        """
        self._wire = wire
        self.name = f"simulated gige camera {wire.address}"
        if ipaddress.ip_address(wire.address) not in LOOPBACK:
            raise ConfigError(
                f"{wire.address} is not on this machine alone", device=self.name, hint="take one of 127.0.0.0/8"
            )
        if not 0 <= wire.loss < 1:
            raise ConfigError(f"a loss of {wire.loss:g} is not 0 .. 1", device=self.name)
        self._settings = _settings(device, wire)
        self.world = enter_world(self._settings, clock, self.name)
        self.world.hold("camera", self, self.name)
        self._clock = clock
        self._silent = False
        self._dead = threading.Event()
        self._sockets: list[socket.socket] = []
        try:
            self._power_up()
        except BaseException:
            self.world.release("camera")
            raise

    @property
    def address(self) -> str:
        """Where it is found."""
        return self._wire.address

    @property
    def counts(self) -> StreamCounts:
        """What the stream sent, lost and sent again since power-up."""
        return self._stream.counts

    @property
    def dropped_triggers(self) -> int:
        """Triggers since the last AcquisitionStart that started no exposure."""
        return self._sensor.dropped_triggers

    @property
    def controlled(self) -> bool:
        """Whether a client holds the control privilege."""
        return self._control.controller is not None

    def true_start_ns(self, block: int) -> int:
        """When the exposure of a block (its number on the wire) began: of the last ones since AcquisitionStart."""
        return self._sensor.true_starts[block]

    def pulse(self, t_ns: int) -> None:
        """A rising edge on Line1."""
        self._sensor.pulse(t_ns)

    def hang(self) -> None:
        """Answer nothing and send nothing, as a camera whose firmware hangs; `resume` ends it."""
        self._silent = True
        self._stream.aim(None)

    def resume(self) -> None:
        """Answer again. Whoever held the control privilege has lost it where its heartbeat ran out meanwhile."""
        self._silent = False

    def unplug(self) -> None:
        """Leave the wire, and forget every setting, as a camera does that loses its power."""
        if self._dead.is_set():
            return
        self._dead.set()
        self._thread.join(timeout=5.0)
        self._sensor.close()
        self._stream.close()
        for each in self._sockets:
            each.close()

    def plug(self) -> None:
        """Come back after `unplug`."""
        if self._dead.is_set():
            self._dead.clear()
            self._power_up()

    def close(self) -> None:
        """Leave for good. May be called twice."""
        self.unplug()
        self.world.release("camera")

    # --- power --------------------------------------------------------------------------------------------------

    def _power_up(self) -> None:
        wire, settings = self._wire, self._settings
        self._sockets = _sockets(wire.address, self.name)
        serial = wire.serial or f"{int(ipaddress.IPv4Address(wire.address)):08X}"
        size = self.world.rig.calibration.camera.size
        registers = Registers(Identity(wire.address, serial, wire.user_name, wire.tick_hz), size)
        self._registers = registers
        seed = settings.world.shared.seed
        self._stream = Stream(wire.address, wire.loss, seed, 1e6 * wire.link_mbit_s)
        offset = int(self.world.random(0x6776).integers(1 << 40))
        self._ticks = DeviceClock(wire.tick_hz, offset, wire.clock_ppm, self._clock.now_ns())
        self._sensor = Sensor(self.world, settings.camera, registers, self._stream, self._ticks, wire.queue)
        registers.set_number(f.EXPOSURE_TIME, NOMINAL_EXPOSURE_NS // 1000)
        registers.set_number(f.READOUT_TIME, settings.camera.readout_us)
        registers.set_word(r.STREAM_SOURCE_PORT, self._stream.source_port)
        self._control = Control(registers, self._stream.resend, self._released, self._clock.now_ns)
        self._wire_registers(registers)
        self._fit_registers(0)
        self._thread = threading.Thread(target=self._serve, name="simulated gige control", daemon=True)
        self._thread.start()

    def _wire_registers(self, registers: Registers) -> None:
        """What a write sets in motion."""
        for address in (f.WIDTH, f.HEIGHT, f.BINNING_X, f.BINNING_Y, f.PIXEL_FORMAT, f.OFFSET_X, f.OFFSET_Y):
            registers.on_write(address, self._fit_registers)
        for address in (f.EXPOSURE_TIME, f.CHUNK_ACTIVE, *(f.CHUNK_ENABLE + 4 * i for i in f.CHUNKS.values())):
            registers.on_write(address, self._fit_registers)
        registers.on_write(f.ACQUISITION_START, self._start)
        registers.on_write(f.ACQUISITION_STOP, lambda _: self._sensor.stop())
        registers.on_write(f.TRIGGER_SOFTWARE, lambda _: self._sensor.software_trigger())
        registers.on_write(f.COUNTER_RESET, lambda _: self._sensor.reset_counter())
        registers.on_read(f.COUNTER_VALUE, self._read_counter)
        registers.on_write(f.LATCH, self._latch)
        registers.on_write(f.PACKET_SIZE, self._set_packet_size)
        registers.on_write(r.STREAM_PORT, lambda _: self._aim())
        registers.on_write(r.STREAM_ADDRESS, lambda _: self._aim())
        registers.on_write(f.LINE_START, self._start_line)

    def _serve(self) -> None:
        while not self._dead.is_set():
            ready, _, _ = select.select(self._sockets, [], [], HEARTBEAT_LOOK_S)
            if not ready:
                self._control.check_heartbeat()
            for each in ready:
                message, sender = each.recvfrom(LONGEST_MESSAGE)
                # A broadcast may come from any network this machine is on: this camera is there for loopback alone.
                if self._silent or ipaddress.ip_address(sender[0]) not in LOOPBACK:
                    continue
                answer = self._control.answer(message, sender)
                if answer is not None:
                    self._sockets[0].sendto(answer, sender)

    def _released(self) -> None:
        """The client is gone: nothing is sent any more."""
        self._sensor.stop()
        self._stream.aim(None)
        self._registers.set_word(r.STREAM_PORT, 0)

    # --- registers ----------------------------------------------------------------------------------------------

    def _fit_registers(self, _: int) -> None:
        """Bounds that depend on other settings."""
        if self._sensor.acquiring:
            raise Refused(r.BUSY)
        registers = self._registers
        for side, sensor, binning, most, least, offset, offset_most in (
            (f.WIDTH, f.SENSOR_WIDTH, f.BINNING_X, f.WIDTH_MAX, 4, f.OFFSET_X, f.OFFSET_X_MAX),
            (f.HEIGHT, f.SENSOR_HEIGHT, f.BINNING_Y, f.HEIGHT_MAX, 2, f.OFFSET_Y, f.OFFSET_Y_MAX),
        ):
            limit = registers.word(sensor) // registers.word(binning) // least * least
            registers.set_word(most, limit)
            registers.set_word(side, min(registers.word(side), limit))
            registers.set_word(offset_most, limit - registers.word(side))
            registers.set_word(offset, min(registers.word(offset), limit - registers.word(side)))
        registers.set_word(f.PAYLOAD_SIZE, self._sensor.payload_size())
        shortest_s = registers.number(f.EXPOSURE_TIME) * 1e-6 + self._settings.camera.gap_ns * 1e-9
        registers.set_number(f.FRAME_RATE_MAX, 1.0 / shortest_s)
        if not registers.number(f.FRAME_RATE) or registers.number(f.FRAME_RATE) > 1.0 / shortest_s:
            registers.set_number(f.FRAME_RATE, 1.0 / shortest_s)

    def _start(self, _: int) -> None:
        if self._sensor.acquiring:
            raise Refused(r.BUSY)
        self._sensor.start()

    def _read_counter(self) -> None:
        count = self._sensor.counter(self._clock.now_ns(), self._registers.word(f.COUNTER_SOURCE))
        self._registers.set_word(f.COUNTER_VALUE, count)

    def _latch(self, value: int) -> None:
        if value & 2:
            ticks = self._ticks.ticks(self._clock.now_ns())
            self._registers.set_word(f.LATCHED_HIGH, ticks >> 32)
            self._registers.set_word(f.LATCHED_LOW, ticks)

    def _aim(self) -> None:
        address, port = self._target()
        self._stream.aim((address, port) if port else None)

    def _target(self) -> tuple[str, int]:
        address = str(ipaddress.IPv4Address(self._registers.word(r.STREAM_ADDRESS)))
        if ipaddress.ip_address(address) not in LOOPBACK and address != "0.0.0.0":  # noqa: S104  (compared, not bound)
            raise Refused(r.INVALID_PARAMETER)
        return address, self._registers.word(r.STREAM_PORT) & 0xFFFF

    def _set_packet_size(self, value: int) -> None:
        size = value & 0xFFFF
        feature = f.FEATURES["GevSCPSPacketSize"]
        if not (feature.low or 0) <= size <= float(feature.high or 0):
            raise Refused(r.INVALID_PARAMETER)
        self._registers.set_word(f.PACKET_SIZE, value & ~r.FIRE_TEST_PACKET)
        address, port = self._target()
        if value & r.FIRE_TEST_PACKET and port:
            self._stream.send_test(size, (address, port))

    def _start_line(self, _: int) -> None:
        """Pulses on Line1, at a period of this machine's clock."""
        period_ns, count = 1000 * self._registers.word(f.LINE_PERIOD), self._registers.word(f.LINE_COUNT)
        train = Regular(self._clock.now_ns() + period_ns, period_ns)
        train.end(self._clock.now_ns() + count * period_ns + period_ns // 2)
        self._sensor.listen(train)


def _settings(device: str, wire: WireOptions) -> Settings:
    settings = read_settings(device, wire.options, "camera")
    if settings.camera_faults != CameraFaults():
        raise ConfigError(
            f"device {device!r}: a camera on the wire has faults of its own",
            hint="loss, queue, hang and unplugging; those of the simulated camera are for that driver",
        )
    return settings


def _sockets(address: str, name: str) -> list[socket.socket]:
    """The control port on the camera's own address, and on the address that means everybody."""
    own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        own.bind((address, PORT))
    except OSError as error:
        own.close()
        raise DeviceBusy(
            f"port {PORT} of {address} cannot be had: {error.strerror}",
            device=name,
            hint="another simulated camera has this address; take the next one (127.0.0.3 ...)",
        ) from error
    everybody = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with contextlib.suppress(OSError):  # found by address all the same
        everybody.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        everybody.bind((EVERYBODY, PORT))
        return [own, everybody]
    everybody.close()
    return [own]
