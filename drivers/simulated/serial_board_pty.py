"""The simulated board on a pty, in real time, with the faults of real lines: what the serial driver can be tried on.

    with PtyBoard(vsync_us=16_667) as board: driver.open(board.path, {}, MonotonicClock())

Bytes take their time, as on a UART at 115200 baud. Noise is drawn from a seed; the other faults are switched on by
calls. It is a device for tests and for trying things out: the rig file's driver `simulated` is `trigger_board`.
"""

from __future__ import annotations

import os
import select
import threading
import time
import tty
from dataclasses import dataclass

import numpy as np

from drivers.simulated.serial_board import PinEdge, Said, SerialBoard

BYTE_NS = 86_806
"""10 bits at 115200 baud"""

STEP_S = 0.001
"""The board's pins and lines are brought up to date this often"""


@dataclass(frozen=True)
class LineFaults:
    """What befalls lines on their way, each with this probability."""

    flip: float = 0.0
    """one bit of a line is flipped, either way"""
    garbage: float = 0.0
    """bytes of no meaning come before a line from the board, a line end among them"""
    lose: float = 0.0
    """a line from the board never comes"""
    seed: int = 0


class PtyBoard:
    """A board that answers on `path` from construction to `close`."""

    def __init__(
        self, *, vsync_us: float | None = None, clock_ppm: float = 0.0, faults: LineFaults | None = None
    ) -> None:
        """vsync_us: period of edges on its input VSYNC; clock_ppm: how much its clock is fast."""
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        self._slave = slave
        self._rate = 1 + 1e-6 * clock_ppm
        self._vsync_ns = None if vsync_us is None else round(1e3 * vsync_us)
        self.faults = faults or LineFaults()
        """may be changed at any time"""
        self._random = np.random.default_rng(self.faults.seed)
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._hung = threading.Event()
        self._to_host: list[tuple[int, bytes]] = []
        self.pins: list[PinEdge] = []
        """every change of an output, board time"""
        self.received: list[bytes] = []
        """every piece of what the host wrote"""
        self._reset()
        self._thread = threading.Thread(target=self._serve, name=f"simulated board {self.path}", daemon=True)
        self._thread.start()

    def __enter__(self) -> PtyBoard:
        """Itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def now_ns(self) -> int:
        """The board's clock."""
        return round((time.monotonic_ns() - self._began_ns) * self._rate)

    def host_ns(self, board_ns: int) -> int:
        """CLOCK_MONOTONIC when the board's clock showed `board_ns`: what a fit of it must find."""
        return self._began_ns + round(board_ns / self._rate)

    def pulse(self, source: str) -> None:
        """A rising and a falling edge on VSYNC or EXT, now."""
        with self._lock:
            now = self.now_ns()
            self._board.edge(source, True, now)
            self._board.edge(source, False, now + 1)

    def reset(self) -> None:
        """Begin anew, as after a disturbance of its supply."""
        with self._lock:
            self._reset()

    def jump(self, ns: int) -> None:
        """The board's clock goes forward at once, as no crystal's does."""
        with self._lock:
            self._go_on()
            self._began_ns -= ns
            self._edges_until(self.now_ns())  # there were none in the time that never was

    def hang(self, hung: bool = True) -> None:
        """Neither read nor say anything from now on, or again."""
        if hung:
            self._hung.set()
        else:
            self._hung.clear()

    def stop_vsync(self) -> None:
        """No further edge comes on VSYNC."""
        self._vsync_ns = None

    def close(self) -> None:
        """Unplug it; may be called twice."""
        if not self._closing.is_set():
            self._closing.set()
            self._thread.join()
            os.close(self._slave)
            os.close(self._master)

    def _reset(self) -> None:
        self._board = SerialBoard()
        self._began_ns = time.monotonic_ns()
        self._next_vsync_ns = 0

    # --- the board's thread --------------------------------------------------------------------------------------

    def _serve(self) -> None:
        while not self._closing.is_set():
            readable = select.select([self._master], [], [], STEP_S)[0]
            if self._hung.is_set():
                with self._lock:
                    self._edges_until(self.now_ns())  # it does not see them
                time.sleep(STEP_S)
                continue
            with self._lock:
                if readable:
                    self._receive(os.read(self._master, 4096))
                self._go_on()
                due = [data for t_ns, data in self._to_host if t_ns <= self.now_ns()]
                del self._to_host[: len(due)]
            for data in due:
                os.write(self._master, data)

    def _receive(self, data: bytes) -> None:
        """What the host wrote, as it arrives: line by line, each when its last byte is there."""
        self.received.append(data)
        t_ns = self.now_ns()
        for piece in data.splitlines(keepends=True):
            t_ns += len(piece) * BYTE_NS
            while self.now_ns() < t_ns:
                time.sleep(BYTE_NS / 1e9)
            self._go_on()
            self._board.receive(self._flipped(piece), t_ns)

    def _go_on(self) -> None:
        """Edges, pins and lines up to now."""
        now = self.now_ns()
        # All of them, each at its time, however late this thread comes: a board does not wait for its host's processor.
        for t_ns in self._edges_until(now):
            self._board.edge("VSYNC", True, t_ns)
            self._board.edge("VSYNC", False, t_ns + 1)
        for output in self._board.advance(now):
            if isinstance(output, PinEdge):
                self.pins.append(output)
            else:
                self._send(output)

    def _edges_until(self, now: int) -> list[int]:
        """When VSYNC rose since it was asked last."""
        vsync_ns = self._vsync_ns
        if vsync_ns is None:
            return []
        period = round(vsync_ns * self._rate)
        times = list(range(self._next_vsync_ns, now + 1, period))
        self._next_vsync_ns += len(times) * period
        return times

    def _send(self, said: Said) -> None:
        faults = self.faults
        data = self._flipped(said.data)
        if self._random.random() < faults.garbage:
            data = bytes(self._random.integers(0, 256, 6, dtype=np.uint8)) + b"\n" + data
        if self._random.random() < faults.lose:
            return
        last = self._to_host[-1][0] if self._to_host else 0
        self._to_host.append((max(last, said.t_ns) + len(data) * BYTE_NS, data))

    def _flipped(self, data: bytes) -> bytes:
        """With one bit flipped, as often as that happens."""
        if self._random.random() >= self.faults.flip:
            return data
        place, bit = int(self._random.integers(len(data))), int(self._random.integers(8))
        return data[:place] + bytes([data[place] ^ 1 << bit]) + data[place + 1 :]
