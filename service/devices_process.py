"""The process that owns the devices: `python -m service.devices_process`, started by the daemon.

It keeps them open (`service.held_devices`), runs scans into the spool, and shows previews while none runs. A library or
kernel call that hangs here hangs here alone. It ends when its standard input closes, whatever happened to
the daemon.

    main thread: devices, and nothing else touches them     reader: commands, cancels, the lifeline
    outbox: what it has to say, never waited for            write-back: fdatasync in passing
"""

from __future__ import annotations

import logging
import os
import queue
import signal
import sys
import threading
from collections import Counter
from pathlib import Path
from typing import BinaryIO

from scanner.clock import Clock, MonotonicClock
from scanner.devices import KeepsCounts
from scanner.errors import DeviceError, DeviceLost, ScannerError
from scanner.wire import error_body
from service.acquisition import Scan
from service.held_devices import HeldDevices
from service.live_acquisition import LiveRun
from service.logs import start_logging
from service.pipe import (
    Acquire,
    AcquireLive,
    CancelAcquire,
    Command,
    Counted,
    Devices,
    Discover,
    Ended,
    Go,
    Open,
    OpenFailed,
    Outbox,
    Preview,
    read_command,
)
from service.preview import Previewer
from service.scan_setup import OpenRig
from service.write_back import WriteBacks

GRACE_S = 3.0
"""Time for the devices to be given back once the daemon is gone."""

_log = logging.getLogger(__name__)


class DevicesProcess:
    """One life of the process: open, then command after command."""

    def __init__(self, commands: BinaryIO, outbox: Outbox, clock: Clock) -> None:
        self._commands = commands
        self._outbox = outbox
        self._clock = clock
        self._queue: queue.SimpleQueue[Command | None] = queue.SimpleQueue()
        self._scan: Scan | None = None
        self._cancelled: set[str] = set()
        self._lock = threading.Lock()
        self._devices = HeldDevices(clock, outbox.post)
        self._previewer: Previewer | None = None
        self._write_backs = WriteBacks()
        self._counts: Counter[str] = Counter()

    def run(self) -> int:
        """Serve until the daemon is gone; returns the exit status."""
        threading.Thread(target=self._read, name="reader", daemon=True).start()
        try:
            return self._serve()
        finally:
            if self._previewer is not None:
                self._previewer.close()
            self._devices.close()
            self._write_backs.wait()

    def _serve(self) -> int:
        while True:
            try:
                command = self._queue.get(timeout=self._patience())
            except queue.Empty:
                self._idle()
                continue
            if command is None:
                return 0
            if not self._obey(command):
                return 1

    def _patience(self) -> float | None:
        pauses = (
            self._devices.pause_s() if self._is_idle else None,
            None if self._previewer is None else self._previewer.pause_s(),
        )
        return min((pause for pause in pauses if pause is not None), default=None)

    @property
    def _is_idle(self) -> bool:
        """Nobody looks at pictures, which would tell a lost device."""
        return self._previewer is None or self._previewer.resting

    def _idle(self) -> None:
        """What is due while no command waits."""
        if self._is_idle:
            self._devices.mind()
        if self._devices.opened is None:
            self._end_preview()
        if self._previewer is None or self._previewer.pause_s() > 0:
            return
        try:
            self._previewer.show()
        except DeviceError as error:
            self._lose(error)

    def _obey(self, command: Command) -> bool:
        match command:
            case Open(rig=settings):
                try:
                    self._devices.open(settings)
                except ScannerError as error:
                    self._outbox.post(OpenFailed(error_body(error)))
                    return False
            case Acquire() | AcquireLive():
                self._acquire(command)
            case Preview():
                self._set_preview(command)
            case Discover(number=number):
                self._outbox.post(Devices(number, _discovered()))
            case CancelAcquire():
                _log.debug("cancelled: %s", command.job)  # seen to by the reader, while it ran
            case Go() if command.job not in self._cancelled:
                _log.warning("no scan waits for its go")
            case Go():
                _log.debug("cancelled before its go: %s", command.job)
        return True

    def _acquire(self, command: Acquire | AcquireLive) -> None:
        try:
            opened = self._devices.ready()
        except ScannerError as error:
            self._outbox.post(Ended(command.job, None, error=error_body(error)))
            return
        if self._previewer is not None and self._previewer.rest():
            opened.loaded = None
        scan = self._made(command, opened)
        with self._lock:
            self._scan = scan
            if command.job in self._cancelled:
                scan.cancel()
        try:
            scan.prepare()
            if self._may_go(command.job):
                scan.run(self._write_backs)
            else:
                self._outbox.post(Ended(command.job, "cancelled"))
        except ScannerError as error:
            self._outbox.post(scan.refused(error))
            scan.lost = scan.lost or (error if isinstance(error, DeviceLost) else None)
        finally:
            with self._lock:
                self._scan = None
        self._count(opened)
        if scan.lost is not None:
            self._lose(scan.lost)

    def _count(self, opened: OpenRig) -> None:
        if isinstance(camera := opened.rig.camera, KeepsCounts):
            self._counts.update(camera.counts)
            self._outbox.post(Counted(dict(self._counts)))

    def _lose(self, error: ScannerError) -> None:
        self._end_preview()
        self._devices.lose(error)

    def _end_preview(self) -> None:
        """The daemon asks for it again when the devices are back."""
        if self._previewer is not None:
            self._previewer.close()
            self._previewer = None

    def _made(self, command: Acquire | AcquireLive, opened: OpenRig) -> Scan:
        if isinstance(command, AcquireLive):
            return LiveRun(command, opened, self._clock, self._outbox.post)
        return Scan(command.job, Path(command.folder), command.params, opened, self._clock, self._outbox.post)

    def _may_go(self, job: str) -> bool:
        """Wait for the daemon's word, which knows the room in the spool."""
        while True:
            command = self._queue.get()
            match command:
                case Go(job=named) if named == job:
                    return True
                case CancelAcquire(job=named) if named == job:
                    return False
                case None:
                    self._queue.put(None)
                    return False
                case Discover(number=number):
                    self._outbox.post(Devices(number, _discovered()))
                case Preview():
                    self._set_preview(command)
                case _:
                    _log.warning("%s while a scan waits for its go", type(command).__name__)

    def _set_preview(self, command: Preview) -> None:
        opened = self._devices.opened
        if self._previewer is not None and opened is not None and self._previewer.is_of(command, opened.rig):
            return  # a client asks again where pictures are late: they would be later still, and the socket gone
        if self._previewer is not None:
            self._end_preview()
            if opened is not None:
                opened.loaded = None
        if command.rate_hz > 0 and opened is not None:
            self._previewer = Previewer(opened.rig, self._clock, command, opened.exposure)

    def _read(self) -> None:
        while (command := read_command(self._commands)) is not None:
            if isinstance(command, CancelAcquire):
                with self._lock:
                    self._cancelled.add(command.job)
                    if self._scan is not None and self._scan.job == command.job:
                        self._scan.cancel()
            self._queue.put(command)
        with self._lock:
            if self._scan is not None:
                self._scan.cancel()
        self._queue.put(None)
        # The main thread may hang in a library: it has this long to give the devices back.
        threading.Event().wait(GRACE_S)
        os._exit(1)


def _discovered() -> list[dict[str, object]]:
    from drivers import registry  # noqa: PLC0415  (loads every driver there is)

    return [
        {
            "driver": found.driver,
            "device": found.device,
            "kind": found.kind,
            "model": found.model,
            "details": found.details,
        }
        for found in registry.discover()
    ]


def main() -> int:
    """Serve the daemon on standard input and output."""
    start_logging("devices")
    # Ctrl-C in a terminal reaches the whole group; the daemon decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    reports = os.dup(1)
    os.dup2(2, 1)  # what a library prints must not mix with the reports
    outbox = Outbox(reports)
    try:
        return DevicesProcess(sys.stdin.buffer, outbox, MonotonicClock()).run()
    finally:
        outbox.close()


if __name__ == "__main__":
    status = main()
    logging.shutdown()
    # Everything is closed; taking LLVM and SciPy down in order would cost another third of a second.
    os._exit(status)
