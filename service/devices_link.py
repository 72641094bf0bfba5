"""The daemon's side of the devices process: starts it, asks for scans, and gives it up when it hangs or dies.

closed --open--> opening --opened--> idle --acquire--> scanning --ended--> idle
idle --fault--> lost, and the process opens them again by itself --opened--> idle
any --process gone, or silent for too long (it is killed)--> closed; the next need opens a fresh one
"""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from scanner.errors import DeviceBusy, DeviceError, DeviceLost, ProtocolError, ScannerError
from scanner.wire import LiveStart, ScanStart, error_body, error_from_body
from service.children import Child
from service.pipe import (
    Acquire,
    AcquireLive,
    Began,
    CancelAcquire,
    Command,
    Counted,
    DeviceFault,
    Devices,
    Discover,
    Ended,
    Frames,
    Go,
    Kept,
    LiveBegan,
    Need,
    Open,
    Opened,
    OpenFailed,
    Preview,
    Report,
    Shot,
    Taken,
    framed,
    read_report,
)

OPEN_S = 60.0
"""Slow to open: a camera on a sleeping bus, a simulated scene whose kernels are compiled first."""

SILENCE_S = 30.0
"""A scan says something with every frame; exposures last 10 s at most (`service.config`), twice that and a margin."""

KILL_S = 10.0
"""A process in an uninterruptible call of the kernel does not die when it is killed."""

DISCOVER_S = 30.0
"""Drivers look for twenty seconds at most, each in a process of its own."""

_OPENING = "opening"
_log = logging.getLogger(__name__)
Publish = Callable[[str, str | None, Mapping[str, Any]], None]


class ScanListener(Protocol):
    """What hears of a scan while it runs."""

    async def need(self, need: Need) -> None:
        """The scan is planned. Raise StorageError to refuse it."""

    def began(self) -> None:
        """The capture folder is there."""

    def frames(self, frames: Frames) -> None:
        """More lines are in frames.jsonl."""

    def taken(self, taken: Taken) -> None:
        """There will be no more of them."""

    def live(self, report: LiveBegan | Shot | Kept) -> None:
        """Of a live run: it began, took a frame, or has more on disk."""


class DevicesLink:
    """One devices process at a time."""

    def __init__(
        self, rig: Mapping[str, Any], publish: Publish, *, inherit: Sequence[int] = (), silence_s: float = SILENCE_S
    ) -> None:
        self._rig = dict(rig)
        self._publish = publish
        self._inherit = tuple(inherit)
        self._silence_s = silence_s
        self._child: Child | None = None
        self._reader: asyncio.Task[None] | None = None
        self._opened: asyncio.Future[Opened] | None = None
        self._scans: dict[str, asyncio.Queue[Report | None]] = {}
        self._due: dict[str, float] = {}
        """by job, or `_OPENING`: when a process that says nothing must be gone, killing included; the loop's time, s"""
        self._numbers = itertools.count(1)
        self._discoveries: dict[int, asyncio.Future[list[dict[str, Any]]]] = {}
        self._looking: asyncio.Task[list[dict[str, Any]]] | None = None
        self._preview: Preview | None = None
        self._counts: dict[str, int] = {}
        self.description: dict[str, Any] | None = None
        """camera and projector as opened, and what became of the camera's frames; None while there are none"""

    @property
    def answers(self) -> bool:
        """False where a process that is silent could not be killed in time: only a new daemon helps then."""
        now = asyncio.get_running_loop().time()
        return all(now < due for due in self._due.values())

    async def open(self) -> Opened:
        """Open the devices unless they are.

        Raises:
            ScannerError: why they cannot be opened.
        """
        opened = self._opened or await self._start()
        self._due.setdefault(_OPENING, asyncio.get_running_loop().time() + OPEN_S + KILL_S)
        try:
            async with asyncio.timeout(OPEN_S):
                return await asyncio.shield(opened)
        except TimeoutError:
            await self._give_up()
            raise DeviceLost(
                f"the devices did not open within {OPEN_S:g} s",
                hint="unplug and plug the camera, look at the log, and try `fringed devices`",
            ) from None
        finally:
            self._due.pop(_OPENING, None)

    async def acquire(
        self, job: str, folder: Path, params: ScanStart | LiveStart, listener: ScanListener
    ) -> Awaitable[Ended]:
        """Run a scan or a live run until the devices are free; returns its end, which always comes, to be awaited."""
        self._scans[job] = asyncio.Queue()
        try:
            await self.open()
        except ScannerError as error:
            del self._scans[job]
            return _at_once(Ended(job, None, error=error_body(error)))
        place = str(folder)
        self._send(AcquireLive(job, place, params) if isinstance(params, LiveStart) else Acquire(job, place, params))
        ended = await self._follow(job, listener)
        if ended is not None:
            del self._scans[job]
            return _at_once(ended)
        return asyncio.ensure_future(self._until_closed(job))

    def cancel(self, job: str) -> None:
        """Stop a scan between two frames."""
        self._send(CancelAcquire(job))

    async def discover(self) -> list[dict[str, Any]]:
        """The devices that the drivers can see. Those who ask while it is being looked get the same answer.

        Raises:
            ScannerError: they cannot be asked now.
        """
        if self._looking is None or self._looking.done():
            self._looking = asyncio.create_task(self._discover())
        return await asyncio.shield(self._looking)

    async def _discover(self) -> list[dict[str, Any]]:
        await self.open()
        number = next(self._numbers)
        found: asyncio.Future[list[dict[str, Any]]] = asyncio.get_running_loop().create_future()
        self._discoveries[number] = found
        self._send(Discover(number))
        try:
            async with asyncio.timeout(DISCOVER_S):
                return await found
        except TimeoutError:
            raise DeviceBusy("the devices are busy with a scan", hint="ask again when it is over") from None
        finally:
            self._discoveries.pop(number, None)

    async def preview(self, wanted: Preview) -> None:
        """Start the preview, or stop it (rate 0).

        Raises:
            ScannerError: the devices cannot be opened.
        """
        self._preview = wanted if wanted.rate_hz > 0 else None
        if wanted.rate_hz > 0:
            await self.open()
        self._send(wanted)

    async def close(self) -> None:
        """Give the devices back and end the process."""
        if self._looking is not None:
            self._looking.cancel()
            await asyncio.gather(self._looking, return_exceptions=True)
        if self._child is not None:
            await self._child.stop()
        if self._reader is not None:
            await asyncio.gather(self._reader, return_exceptions=True)

    async def _start(self) -> asyncio.Future[Opened]:
        opened = self._opened = asyncio.get_running_loop().create_future()
        opened.add_done_callback(_seen)
        try:
            self._child = await Child.start("service.devices_process", inherit=self._inherit, talks=True)
        except OSError as error:
            what = f"the devices process cannot be started: {error.strerror}"
            self._fail_opening(DeviceError(what, hint="memory, processes or open files ran out: see the log"))
            self._opened = None  # the next need tries again
            return opened
        self._reader = asyncio.create_task(self._read(self._child))
        self._send(Open(self._rig))
        return opened

    async def _follow(self, job: str, listener: ScanListener) -> Ended | None:
        """Until the devices are free; the end, if it has come by then."""
        while True:
            report = await self._next(job, self._silence_s)
            match report:
                case Ended():
                    return report
                case Taken():
                    listener.taken(report)
                    return None
                case Need():
                    try:
                        await listener.need(report)
                        self._send(Go(job))
                    except ScannerError as error:
                        self._send(CancelAcquire(job))
                        return await self._refused(job, error)
                case Began():
                    listener.began()
                case Frames():
                    listener.frames(report)
                case LiveBegan() | Shot() | Kept():
                    listener.live(report)

    async def _next(self, job: str, patience_s: float) -> Report:
        self._due[job] = asyncio.get_running_loop().time() + patience_s + KILL_S
        try:
            async with asyncio.timeout(patience_s):
                report = await self._scans[job].get()
        except TimeoutError:
            await self._give_up()
            return self._lost(job, f"the devices process said nothing for {patience_s:g} s and was killed")
        finally:
            del self._due[job]
        return self._lost(job, "the devices process died") if report is None else report

    async def _until_closed(self, job: str) -> Ended:
        """The disk may be slow; the process is given up only where it is surely stuck."""
        try:
            while True:
                if isinstance(report := await self._next(job, 10 * self._silence_s), Ended):
                    return report
        finally:
            del self._scans[job]

    async def _refused(self, job: str, error: ScannerError) -> Ended:
        while not isinstance(await self._next(job, self._silence_s), Ended):
            continue
        return Ended(job, None, error=error_body(error))

    @staticmethod
    def _lost(job: str, what: str) -> Ended:
        error = DeviceLost(what, hint="look at the log for the cause; the next scan opens the devices again")
        return Ended(job, "device_lost", error=error_body(error))

    def _send(self, command: Command) -> None:
        if self._child is not None:
            self._child.send(framed(command))

    async def _give_up(self) -> None:
        if self._child is not None:
            self._child.kill()
            await self._child.wait()
        if self._reader is not None:
            await asyncio.gather(self._reader, return_exceptions=True)

    async def _read(self, child: Child) -> None:
        try:
            while (report := await read_report(child.reports)) is not None:
                self._take(report)
        except ProtocolError as error:
            _log.error("%s", error)
            child.kill()
        status = await child.wait()
        self._gone(status)

    def _take(self, report: Report) -> None:
        match report:
            case Opened():
                self.description = {"camera": report.camera, "projector": report.projector}
                self._describe()
                if self._opened is not None and not self._opened.done():
                    self._opened.set_result(report)
                self._publish("device.opened", None, self.description)
                if self._preview is not None:
                    self._send(self._preview)
            case OpenFailed(error=error):
                self._fail_opening(error_from_body(error))
                self._publish("device.failed", None, {"error": error.message})
            case Counted(counts=counts):
                self._counts = counts
                self._describe()
            case DeviceFault(error=error):
                self.description = None
                self._publish("device.lost", None, {"error": error.message})
            case Devices(number=number, devices=devices):
                if (waiting := self._discoveries.get(number)) is not None and not waiting.done():
                    waiting.set_result(devices)
            case Need() | Began() | Frames() | LiveBegan() | Shot() | Kept() | Taken() | Ended():
                if (scan := self._scans.get(report.job)) is not None:
                    scan.put_nowait(report)

    def _describe(self) -> None:
        if self.description is not None and self._counts:
            self.description["camera"]["counts"] = self._counts

    def _gone(self, status: int) -> None:
        was_open = self.description is not None
        self._counts = {}
        self.description = None
        self._fail_opening(DeviceError(f"the devices process ended with status {status}", hint="look at the log"))
        self._opened = None
        self._child = None
        for scan in self._scans.values():
            scan.put_nowait(None)
        if was_open and status != 0:
            self._publish("device.lost", None, {"status": status})

    def _fail_opening(self, error: ScannerError) -> None:
        if self._opened is not None and not self._opened.done():
            self._opened.set_exception(error)


def _at_once(ended: Ended) -> asyncio.Future[Ended]:
    future: asyncio.Future[Ended] = asyncio.get_running_loop().create_future()
    future.set_result(ended)
    return future


def _seen(opened: asyncio.Future[Opened]) -> None:
    """Opening at start has nobody who waits for it: a failure is told by the event, and again by the next scan."""
    if not opened.cancelled():
        opened.exception()
