"""The simulated GigE Vision camera's sensor: when it exposes, on whose word, and what it then sends.

    idle --AcquisitionStart--> free running, or waiting for triggers --AcquisitionStop--> idle

One thread exposes and sends, in real time. A trigger that comes while the sensor is busy is dropped, as most cameras
do; with `latch` the camera remembers one of them and exposes late, as others do; with `queue` it remembers several.
Block ids are consecutive whatever was dropped: only counts and stamps tell.
"""

from __future__ import annotations

import math
import struct
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from drivers.simulated import gige_features as f
from drivers.simulated.gige_pixels import BITS, binned, packed, payload_bytes
from drivers.simulated.gige_registers import Refused, Registers
from drivers.simulated.gige_stream import Picture, Stream
from drivers.simulated.gige_time import REMEMBERED, DeviceClock, Edges
from drivers.simulated.lines import Line, LineName
from drivers.simulated.options import CameraOptions
from drivers.simulated.world import World
from scanner.devices import Pixels

BUSY = 0x8007
LONGEST_WAIT_S = 0.1
AUTOMATIC_SHARE = 0.2
"""An automatic function that was left on makes exposures wander by this share"""
LINE_WAIT_S = 0.001
"""Between two looks at a line of the world, whose edges are found when they are past"""


@dataclass(frozen=True)
class _Shot:
    start_ns: int
    exposure_ns: int
    number: int


@dataclass(frozen=True)
class _Setting:
    """What the registers said when the acquisition began."""

    pixel_format: int
    binning: tuple[int, int]
    region: tuple[int, int, int, int]
    gain_db: float
    gamma: float
    exposure_ns: int
    automatic: bool
    """an automatic function was left on"""
    period_ns: int
    triggered: bool
    source: int
    delay_ns: int
    chunks: tuple[str, ...]
    counter: int
    packet_bytes: int
    packet_delay_s: float


class Sensor:
    """Exposes on the world's light, and sends."""

    def __init__(
        self, world: World, options: CameraOptions, registers: Registers, stream: Stream, clock: DeviceClock, queue: int
    ) -> None:
        """queue: triggers remembered while busy; 0 drops them, 1 is the latch that `options.latch` asks for, too."""
        self._world, self._options, self._registers, self._stream = world, options, registers, stream
        self._clock, self._device_clock, self._queue = world.clock, clock, max(queue, int(options.latch))
        self._changed = threading.Condition()
        self._setting: _Setting | None = None
        self._shots: deque[_Shot] = deque()
        self._line_edges, self._frame_triggers, self._exposures = Edges(), Edges(), Edges()
        self._idle_ns = self._next_free_ns = 0
        self._numbers = 0
        self._block = 0
        self._ring: list[Pixels] = []
        self._own_line: Line | None = None
        self.dropped_triggers = 0
        """since the last start"""
        self.true_starts: dict[int, int] = {}
        """by block: start of the exposure, ns; the last REMEMBERED of them"""
        self._open = True
        self._line_seen_ns = 0
        self._warm_up()
        self._thread = threading.Thread(target=self._run, name="simulated sensor", daemon=True)
        self._thread.start()

    def start(self) -> None:
        """AcquisitionStart."""
        with self._changed:
            self._forget()
            setting = self._read_setting()
            self._next_free_ns = self._idle_ns = self._line_seen_ns = self._clock.now_ns()
            self._setting = setting
            self._changed.notify_all()

    def stop(self) -> None:
        """AcquisitionStop. The frame under way is not sent."""
        with self._changed:
            self._setting = None
            self._shots.clear()
            self._changed.notify_all()

    @property
    def acquiring(self) -> bool:
        """Between start and stop."""
        return self._setting is not None

    def software_trigger(self) -> None:
        """TriggerSoftware."""
        self._trigger(self._clock.now_ns(), f.SOFTWARE_SOURCE)

    def pulse(self, t_ns: int) -> None:
        """A rising edge on Line1 at `t_ns`. Edges come in the order of their times."""
        with self._changed:
            self._line_edges.add(t_ns)
        self._trigger(t_ns, f.LINE1_SOURCE)

    def listen(self, line: Line) -> None:
        """Hear the edges of this line, too, until the acquisition ends."""
        with self._changed:
            self._own_line = line
            self._changed.notify_all()

    def reset_counter(self) -> None:
        """CounterReset."""
        for seen in (self._line_edges, self._frame_triggers, self._exposures):
            seen.reset(self._clock.now_ns())

    def counter(self, at_ns: int, source: int) -> int:
        """What the counter stands at."""
        seen = {1: self._line_edges, 2: self._frame_triggers, 3: self._exposures}.get(source)
        return 0 if seen is None else seen.count(at_ns)

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._open = False
            self._setting = None
            self._changed.notify_all()
        self._thread.join(timeout=5.0)

    # --- when ----------------------------------------------------------------------------------------------------

    def _trigger(self, t_ns: int, source: int) -> None:
        with self._changed:
            setting = self._setting
            if setting is None or not setting.triggered or setting.source != source:
                return
            self._frame_triggers.add(t_ns)
            software = source == f.SOFTWARE_SOURCE
            latency_us = self._options.trigger_latency_us if software else self._options.line_latency_us
            start = t_ns + setting.delay_ns + round(1e3 * latency_us)
            if start < self._idle_ns:
                waiting = sum(shot.start_ns > t_ns for shot in self._shots)
                if waiting >= self._queue:
                    self.dropped_triggers += 1
                    return
                start = self._idle_ns
            if len(self._shots) >= self._options.buffers:
                self.dropped_triggers += 1
                return
            self._expose(start, setting)
            self._changed.notify_all()

    def _expose(self, start_ns: int, setting: _Setting) -> None:
        exposure_ns = setting.exposure_ns
        if setting.automatic:
            exposure_ns = round(exposure_ns * (1.0 + AUTOMATIC_SHARE * math.sin(self._numbers)))
        self._shots.append(_Shot(start_ns, exposure_ns, self._numbers))
        if setting.counter == f.COUNTER_SOURCES["ExposureStart"]:
            self._exposures.add(start_ns)
        self._numbers += 1
        self._idle_ns = start_ns + exposure_ns + self._options.gap_ns

    def _begin_free(self, now_ns: int, setting: _Setting) -> None:
        """Exposures that began by now; while all buffers are full the sensor waits."""
        while not setting.triggered and self._next_free_ns <= now_ns and len(self._shots) < self._options.buffers:
            # A thread that was late keeps the pace; one that was held up by full buffers does not catch up.
            start = self._next_free_ns if now_ns - self._next_free_ns < 2 * setting.period_ns else now_ns
            self._expose(start, setting)
            self._next_free_ns = start + setting.period_ns

    def _watch_line(self, now_ns: int) -> None:
        """Edges that are past, on the world's line and on the camera's own, in the order of their times."""
        lines = [line for line in (self._line, self._own_line) if line is not None]
        while edges := [e for line in lines if (e := line.next_edge(self._line_seen_ns)) is not None and e <= now_ns]:
            self._line_seen_ns = min(edges)
            self.pulse(self._line_seen_ns)

    @property
    def _line(self) -> Line | None:
        return self._world.lines.get(cast("LineName", self._options.line))

    def _run(self) -> None:
        while True:
            if self._setting is not None:
                self._watch_line(self._clock.now_ns())
            self._fill_ring()
            with self._changed:
                if not self._open:
                    return
                setting, now = self._setting, self._clock.now_ns()
                if setting is not None:
                    self._begin_free(now, setting)
                shot = self._shots[0] if self._shots else None
                wait_ns = self._wait_ns(now, setting, shot)
                if setting is None or shot is None or wait_ns > 0:
                    self._changed.wait(min(self._longest_wait_s, wait_ns / 1e9))
                    continue
            self._deliver(shot, setting)

    @property
    def _longest_wait_s(self) -> float:
        return LONGEST_WAIT_S if self._line is None and self._own_line is None else LINE_WAIT_S

    def _wait_ns(self, now_ns: int, setting: _Setting | None, shot: _Shot | None) -> float:
        """Until there is something to do."""
        times = [] if shot is None else [shot.start_ns + shot.exposure_ns + self._options.rolling_ns]
        if setting is not None and not setting.triggered and len(self._shots) < self._options.buffers:
            times.append(self._next_free_ns)
        return min((t - now_ns for t in times), default=1e9 * LONGEST_WAIT_S)

    # --- what ----------------------------------------------------------------------------------------------------

    def _deliver(self, shot: _Shot, setting: _Setting) -> None:
        """Render, wait until the readout is over, send."""
        if self._ring:
            frame = self._ring[shot.number % len(self._ring)]
        else:
            frame = self._render(shot.start_ns, shot.exposure_ns, setting, shot.number)
        content = self._payload(frame, shot, setting)
        ready = shot.start_ns + shot.exposure_ns + self._options.readout_ns
        self._clock.sleep_until(ready)
        with self._changed:
            if self._setting is not setting or not self._shots or self._shots[0] is not shot:
                return  # stopped meanwhile
            self._shots.popleft()
            self._block = self._block % 0xFFFF + 1
            block = self._block
            self.true_starts[block] = shot.start_ns
            self.true_starts.pop(block - REMEMBERED, None)
        x, y, width, height = setting.region
        stamp = self._device_clock.ticks(shot.start_ns)
        picture = Picture(setting.pixel_format, width, height, x, y, stamp, bool(setting.chunks))
        self._stream.send(block, picture, memoryview(content), setting.packet_bytes, setting.packet_delay_s)

    def _fill_ring(self) -> None:
        """The ring's frames, of what shone just before; a client need not wait for the answer to its start."""
        setting = self._setting
        if setting is None or self._ring or not self._options.ring:
            return
        begun = self._clock.now_ns() - setting.exposure_ns
        ring = [self._render(begun, setting.exposure_ns, setting, number) for number in range(self._options.ring)]
        with self._changed:
            if self._setting is setting:
                self._ring = ring
                self._next_free_ns = self._clock.now_ns()

    def _warm_up(self) -> None:
        """Compile, cast, and allocate before anybody waits for a frame."""
        width, height = self._world.rig.calibration.camera.size
        for kind, bits in ((np.uint8, 8), (np.uint16, 12)):
            scratch: Any = np.empty((height, width), dtype=kind)
            self._world.render(
                self._clock.now_ns() - 1_000_000, 1_000_000, self._options.rolling_ns, 0.0, bits, 0, scratch
            )

    def _render(self, start_ns: int, exposure_ns: int, setting: _Setting, number: int) -> Pixels:
        width, height = self._world.rig.calibration.camera.size
        bits = BITS[setting.pixel_format]
        frame: Any = np.empty((height, width), dtype=np.uint8 if bits <= 8 else np.uint16)
        self._world.render(start_ns, exposure_ns, self._options.rolling_ns, setting.gain_db, bits, number, frame)
        if setting.gamma != 1.0:
            top = (1 << bits) - 1
            table = np.round(top * (np.arange(top + 1) / top) ** setting.gamma).astype(frame.dtype)
            frame = table[frame]
        x, y, width, height = setting.region
        seen: Pixels = np.ascontiguousarray(binned(frame, *setting.binning)[y : y + height, x : x + width])  # type: ignore[assignment]
        return seen

    def _payload(self, frame: Pixels, shot: _Shot, setting: _Setting) -> bytes | bytearray | memoryview:
        image = packed(frame, setting.pixel_format)
        if not setting.chunks:
            return memoryview(image.data)
        values = {
            "CounterValue": struct.pack(">I", self.counter(shot.start_ns, setting.counter) & 0xFFFFFFFF),
            "Timestamp": struct.pack(">Q", self._device_clock.ticks(shot.start_ns)),
            "ExposureTime": struct.pack(">d", shot.exposure_ns / 1e3),
        }
        content = bytearray(image.tobytes() + struct.pack(">II", f.IMAGE_CHUNK, image.nbytes))
        for name in setting.chunks:
            content += values[name] + struct.pack(">II", f.CHUNK_IDS[name], len(values[name]))
        return content

    # --- settings ------------------------------------------------------------------------------------------------

    def payload_size(self) -> int:
        """Bytes of a frame with the present registers."""
        registers = self._registers
        size = payload_bytes(registers.word(f.PIXEL_FORMAT), registers.word(f.WIDTH) * registers.word(f.HEIGHT))
        chunks = self._chunks()
        if chunks:
            size += 8 + sum(8 + f.FEATURES[f"Chunk{name}"].length for name in chunks)
        return size

    def _chunks(self) -> tuple[str, ...]:
        if not self._registers.word(f.CHUNK_ACTIVE):
            return ()
        enabled = [name for name, index in f.CHUNKS.items() if self._registers.word(f.CHUNK_ENABLE + 4 * index)]
        return tuple(enabled)

    def _read_setting(self) -> _Setting:
        word, number = self._registers.word, self._registers.number
        exposure = round(1e3 * number(f.EXPOSURE_TIME))
        shortest = exposure + self._options.gap_ns
        slowed = word(f.FRAME_RATE_ENABLE) and number(f.FRAME_RATE) > 0
        asked = round(1e9 / number(f.FRAME_RATE)) if slowed else round(1e3 * (self._options.period_us or 0.0))
        width, height = word(f.WIDTH), word(f.HEIGHT)
        x, y = word(f.OFFSET_X), word(f.OFFSET_Y)
        if x + width > word(f.WIDTH_MAX) or y + height > word(f.HEIGHT_MAX):
            raise Refused(BUSY)
        return _Setting(
            pixel_format=word(f.PIXEL_FORMAT),
            binning=(word(f.BINNING_X), word(f.BINNING_Y)),
            region=(x, y, width, height),
            gain_db=number(f.GAIN),
            gamma=number(f.GAMMA),
            automatic=any(word(address) for address in (f.EXPOSURE_AUTO, f.GAIN_AUTO, f.WHITE_AUTO)),
            exposure_ns=exposure,
            period_ns=max(shortest, asked),
            triggered=word(f.TRIGGER_MODE) == f.OFF_ON["On"],
            source=word(f.TRIGGER_SOURCE),
            delay_ns=round(1e3 * number(f.TRIGGER_DELAY)),
            chunks=self._chunks(),
            counter=word(f.COUNTER_SOURCE),
            packet_bytes=word(f.PACKET_SIZE) & 0xFFFF,
            packet_delay_s=word(f.PACKET_DELAY) / self._device_clock.tick_hz,
        )

    def _forget(self) -> None:
        self._ring = []
        self._own_line = None
        self._shots.clear()
        self._line_edges, self._frame_triggers, self._exposures = Edges(), Edges(), Edges()
        self._block = 0
        self.dropped_triggers = 0
        self.true_starts = {}
