"""The process that owns the devices: `python -m service.devices_process`, started by the daemon.

It opens them through the registry, keeps them open, runs scans into the spool, and shows previews while none runs. A
library or kernel call that hangs here hangs here alone. It ends when its standard input closes, whatever happened to
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
from pathlib import Path
from typing import BinaryIO

from scanner.clock import Clock, MonotonicClock
from scanner.errors import DeviceError, ScannerError
from scanner.wire import error_body
from service.acquisition import Scan
from service.live_acquisition import LiveRun
from service.logs import start_logging
from service.pipe import (
    Acquire,
    AcquireLive,
    CancelAcquire,
    Command,
    DeviceFault,
    Devices,
    Discover,
    Ended,
    Go,
    Open,
    Opened,
    OpenFailed,
    Outbox,
    Preview,
    read_command,
)
from service.preview import Previewer
from service.scan_setup import OpenRig, open_rig
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
        self._opened: OpenRig | None = None
        self._previewer: Previewer | None = None
        self._write_backs = WriteBacks()

    def run(self) -> int:
        """Serve until the daemon is gone; returns the exit status."""
        threading.Thread(target=self._read, name="reader", daemon=True).start()
        try:
            return self._serve()
        finally:
            if self._previewer is not None:
                self._previewer.close()
            if self._opened is not None:
                self._opened.close()
            self._write_backs.wait()

    def _serve(self) -> int:
        while True:
            try:
                command = self._queue.get(timeout=self._patience())
            except queue.Empty:
                if not self._preview():
                    return 1
                continue
            if command is None:
                return 0
            if not self._obey(command):
                return 1

    def _patience(self) -> float | None:
        return None if self._previewer is None else self._previewer.pause_s()

    def _obey(self, command: Command) -> bool:
        match command:
            case Open(rig=settings):
                try:
                    self._opened = open_rig(settings, self._clock)
                except ScannerError as error:
                    self._outbox.post(OpenFailed(error_body(error)))
                    return False
                self._outbox.post(described(self._opened))
            case Acquire() | AcquireLive():
                self._acquire(command)
            case Preview():
                self._set_preview(command)
            case Discover(number=number):
                self._outbox.post(Devices(number, _discovered()))
            case CancelAcquire():
                _log.debug("cancelled: %s", command.job)  # seen to by the reader, while it ran
            case Go():
                _log.warning("no scan waits for its go")
        return True

    def _acquire(self, command: Acquire | AcquireLive) -> None:
        if self._opened is None:
            raise AssertionError("the daemon opens devices first")
        if self._previewer is not None and self._previewer.rest():
            self._opened.loaded = None
        scan = self._made(command, self._opened)
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
        finally:
            with self._lock:
                self._scan = None

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
        if self._previewer is not None:
            self._previewer.close()
            self._previewer = None
            if self._opened is not None:
                self._opened.loaded = None
        if command.rate_hz > 0 and self._opened is not None:
            self._previewer = Previewer(self._opened.rig, self._clock, command)

    def _preview(self) -> bool:
        """Show one picture; False where the camera is lost."""
        if self._previewer is None:
            return True
        try:
            self._previewer.show()
        except DeviceError as error:
            self._outbox.post(DeviceFault(error_body(error)))
            return False
        return True

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


def described(opened: OpenRig) -> Opened:
    """What the daemon is told of the opened devices."""
    camera, projector = opened.rig.camera, opened.rig.projector
    seen, shown = camera.capabilities, projector.capabilities
    return Opened(
        camera={"name": camera.name, "width": seen.width, "height": seen.height, "bits": seen.bits},
        projector={"name": projector.name, "width": shown.width, "height": shown.height, "kind": shown.kind.value},
    )


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
