"""The daemon's side of the workers: who is there, who works on what, and what happens when one is lost.

A series goes to the first worker that is free and follows the capture folder line by line, within the worker's credit.
All sends are non-blocking: where one would block, the series waits for the worker's next word. A worker that dies or
falls silent is replaced, and its series sent again from the spool.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import msgspec
import zmq.asyncio

from scanner.errors import DecodeError, ProtocolError, StorageError
from scanner.stream import (
    SILENCE_S,
    Ack,
    Cancel,
    DecodedNote,
    End,
    Failed,
    FromWorker,
    Identify,
    Leaving,
    LiveCounts,
    PointsNote,
    Progress,
    Ready,
    Released,
    Result,
    Start,
    Stop,
    ToWorker,
    decode_from_worker,
)
from scanner.wire import PROTOCOL, error_from_body
from service.children import Child
from service.deliveries import Delivery, Seat, WorkerLost
from service.jobs import MAX_DELIVERIES
from service.live_series import LiveSeries
from service.series import RecordTail, Series
from service.sockets import send_now
from service.tasks import Tasks

RETRY_S = 0.1
RESPAWN_MAX_S = 10.0
STEADY_S = 5.0
"""A worker that lived this long did not fail to start."""

_log = logging.getLogger(__name__)
_encoder = msgspec.msgpack.Encoder()
Publish = Callable[[str, str | None, Mapping[str, Any]], None]


class WorkerPool:
    """Workers and the series that wait for them."""

    def __init__(
        self,
        router: zmq.asyncio.Socket,
        publish: Publish,
        command_line: Sequence[str],
        *,
        inherit: Sequence[int] = (),
        silence_s: float = SILENCE_S,
    ) -> None:
        """`router` is bound already; `command_line` is that of `service.worker` for workers started here."""
        self._router = router
        self._publish = publish
        self._command_line = tuple(command_line)
        self._inherit = tuple(inherit)
        self._silence_s = silence_s
        self._seats: dict[bytes, Seat] = {}
        self._parked: deque[Series | LiveSeries] = deque()
        self._children: dict[int, Child] = {}
        # Numbers of an earlier daemon's deliveries must not come again: a worker of it may still be alive.
        self._numbers = itertools.count(time.time_ns() >> 10)
        self._tasks = Tasks("the worker pool")
        self._closing = False

    def start(self, workers: int) -> None:
        """Begin to listen, and start `workers` processes."""
        self._tasks.spawn(self._listen())
        self._tasks.spawn(self._watch())
        for _ in range(workers):
            self._tasks.spawn(self._keep_worker())

    def submit(self, series: Series | LiveSeries) -> None:
        """Have a series decoded; its `outcome` says when. A live run does not wait behind others."""
        if isinstance(series, LiveSeries):
            self._parked.appendleft(series)
        else:
            self._parked.append(series)
        self._assign()

    def cancel(self, series: Series | LiveSeries) -> None:
        """Let a series go, wherever it is."""
        series.cancelled = True
        if series in self._parked:
            self._parked.remove(series)
        for seat in self._seats.values():
            if seat.delivery is not None and seat.delivery.series is series:
                self._stop_sender(seat.delivery)
                self._release(seat, seat.delivery)
        if not series.outcome.done():
            series.outcome.cancel()

    def describe(self) -> list[dict[str, Any]]:
        """The workers, for `status`."""
        return [
            {
                "worker": seat.ready.worker,
                "pid": seat.ready.pid,
                "host": seat.ready.host,
                "decode": seat.ready.decode,
                "job": None if seat.delivery is None else seat.delivery.series.job,
            }
            for seat in self._seats.values()
        ]

    @property
    def waiting(self) -> int:
        """Series that wait for a worker."""
        return len(self._parked)

    async def close(self) -> None:
        """Send the workers home and end those started here."""
        self._closing = True
        for seat in self._seats.values():
            self._send(seat, Stop())
        await self._tasks.close()
        await asyncio.gather(*(child.stop() for child in self._children.values()))

    # --- workers ------------------------------------------------------------------------------------------------

    async def _keep_worker(self) -> None:
        pause = 0.1
        while not self._closing:
            began = time.monotonic()
            try:
                await self._one_worker()
            except OSError as error:
                _log.error("a worker cannot be started: %s", error.strerror)
            pause = 0.1 if time.monotonic() - began > STEADY_S else min(2 * pause, RESPAWN_MAX_S)
            await asyncio.sleep(pause)

    async def _one_worker(self) -> None:
        child = await Child.start("service.worker", self._command_line, inherit=self._inherit)
        self._children[child.pid] = child
        status = await child.wait()
        del self._children[child.pid]
        self._died(child.pid, status)

    def _died(self, pid: int, status: int) -> None:
        _log.warning("worker %d ended with status %d", pid, status)
        for seat in list(self._seats.values()):
            if seat.ready.pid == pid:
                self._lose(seat, f"ended with status {status}")

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(self._silence_s / 4)
            for seat in list(self._seats.values()):
                if time.monotonic() - seat.heard > self._silence_s:
                    self._lose(seat, f"was silent for {self._silence_s:g} s")

    def _lose(self, seat: Seat, why: str) -> None:
        self._seats.pop(seat.identity, None)
        self._publish("worker.lost", None, {"worker": seat.ready.worker, "why": why})
        if (child := self._children.get(seat.ready.pid)) is not None:
            child.kill()
        if seat.delivery is not None:
            self._again(seat.delivery, f"worker {seat.ready.worker} {why}")
        self._assign()

    def _again(self, delivery: Delivery, why: str) -> None:
        """Send a series again, or give it up."""
        self._stop_sender(delivery)
        series = delivery.series
        if series.outcome.done():
            return
        if isinstance(series, Series):
            series.forget_points()
        if series.deliveries < MAX_DELIVERIES:
            _log.warning("job %s: %s; its series is sent again", series.job, why)
            self._parked.appendleft(series)
            return
        what, hint = f"the live run {series.job}", "look at the log for the cause"
        if isinstance(series, Series):
            what = f"the capture of job {series.job}"
            hint = f"the capture is kept; on the daemon's machine try: fringed decode {series.capture}; {hint}"
        error = DecodeError(f"{what} was given up: sent {series.deliveries} times, and the last {why}", hint=hint)
        series.outcome.set_exception(WorkerLost(error))

    # --- messages from workers ----------------------------------------------------------------------------------

    async def _listen(self) -> None:
        while True:
            identity, *parts = await self._router.recv_multipart()
            if len(parts) != 1:
                _log.error("a worker's message has one part, not %d", len(parts))
                continue
            try:
                message = decode_from_worker(parts[0])
            except ProtocolError as error:
                _log.error("%s", error)
                continue
            self._take(identity, message)

    def _take(self, identity: bytes, message: FromWorker) -> None:
        seat = self._seats.get(identity)
        if isinstance(message, Ready):
            self._arrive(identity, message)
        elif seat is None:
            self._send_to(identity, Identify())
        elif isinstance(message, Leaving):
            self._lose(seat, "left")
        else:
            seat.heard = time.monotonic()
            self._hear(seat, message)

    def _arrive(self, identity: bytes, ready: Ready) -> None:
        if ready.protocol[0] != PROTOCOL[0]:
            _log.error("worker %s speaks protocol %s: refused", ready.worker, ready.protocol)
            self._send_to(identity, Stop())
            return
        if (known := self._seats.get(identity)) is not None:
            # It was asked who it is more than once, by words it had said before it was known. What it has, it keeps.
            known.heard = time.monotonic()
            return
        seat = self._seats[identity] = Seat(identity, ready, time.monotonic())
        if ready.busy is not None:  # with something of an earlier daemon
            seat.releasing = ready.busy
            self._send(seat, Cancel(ready.busy))
        self._publish("worker.ready", None, {"worker": ready.worker, "pid": ready.pid})
        self._assign()

    def _hear(self, seat: Seat, message: FromWorker) -> None:
        delivery, number = seat.delivery, getattr(message, "delivery", None)
        if number is not None and number == seat.releasing and isinstance(message, Released | Result | Failed):
            seat.releasing = None
            self._assign()
            return
        if delivery is None or number != delivery.number:
            return  # alive, or the word of a dead delivery
        match message:
            case Ack(frames=frames):
                delivery.acked = max(delivery.acked, frames)
                delivery.wake.set()
            case Progress() | PointsNote() | DecodedNote() | LiveCounts():
                delivery.series.hear(message)
            case Result() | Failed() | Released():
                self._over(seat, delivery, message)

    def _over(self, seat: Seat, delivery: Delivery, message: Result | Failed | Released) -> None:
        seat.delivery = None
        self._stop_sender(delivery)
        if not delivery.series.outcome.done():
            match message:
                case Result():
                    delivery.series.outcome.set_result(message)
                case Failed(error=error):
                    delivery.series.outcome.set_exception(error_from_body(error))
                case Released():
                    if isinstance(delivery.series, Series):
                        delivery.series.forget_points()
                    self._parked.appendleft(delivery.series)
        self._assign()

    # --- messages to workers ------------------------------------------------------------------------------------

    def _assign(self) -> None:
        if self._closing:
            return
        free = [seat for seat in self._seats.values() if seat.free]
        for seat in free:
            series = self._next_for(seat)
            if series is None:
                continue
            series.deliveries += 1
            seat.delivery = delivery = Delivery(next(self._numbers), series)
            series.delivering(delivery.number)
            live = isinstance(series, LiveSeries)
            delivery.sender = self._tasks.spawn(
                self._send_live(seat, delivery) if live else self._send_series(seat, delivery)
            )

    def _next_for(self, seat: Seat) -> Series | LiveSeries | None:
        """Of the series that wait the first that this worker can take."""
        # A live run is for one that decodes and may make a socket beside the daemon's: ours, where there are any.
        may_publish = seat.ready.decode and (seat.ready.pid in self._children or not self._children)
        for series in self._parked:
            if may_publish or not isinstance(series, LiveSeries):
                self._parked.remove(series)
                return series
        return None

    async def _send_live(self, seat: Seat, delivery: Delivery) -> None:
        series = cast(LiveSeries, delivery.series)
        await self._deliver(seat, delivery, series.begin(delivery.number))
        while True:
            series.changed.clear()
            for frame in series.take(delivery.number):
                self._send(seat, frame)  # one that cannot be sent at once is old by then: the worker sees the gap
            if series.end is not None:
                await self._deliver(seat, delivery, End(delivery.number, series.end.reason, 0, []))
                return
            await series.changed.wait()

    async def _send_series(self, seat: Seat, delivery: Delivery) -> None:
        try:
            await self._send_frames(seat, delivery, cast(Series, delivery.series))
        except StorageError as error:
            self._release(seat, delivery)
            if not delivery.series.outcome.done():
                delivery.series.outcome.set_exception(error)

    async def _send_frames(self, seat: Seat, delivery: Delivery, series: Series) -> None:
        tail = RecordTail(series.capture, delivery.number)
        try:
            start = Start(
                delivery.number,
                series.job,
                str(series.capture),
                str(series.output(delivery.number)),
                dict(series.options),
            )
            await self._deliver(seat, delivery, start)
            while True:
                series.changed.clear()
                end = series.end  # looked at before the file: lines that come later are announced again
                for frame in tail.read(seat.ready.credit - (tail.sent - delivery.acked)):
                    await self._deliver(seat, delivery, frame)
                if tail.sent - delivery.acked >= seat.ready.credit:
                    delivery.wake.clear()
                    await delivery.wake.wait()
                elif end is not None:
                    series.whole(tail.sent)
                    await self._deliver(seat, delivery, End(delivery.number, end.reason, tail.sent, list(end.missing)))
                    return
                else:
                    await series.changed.wait()
        finally:
            tail.close()

    async def _deliver(self, seat: Seat, delivery: Delivery, message: ToWorker) -> None:
        while not self._send(seat, message):
            delivery.wake.clear()
            try:
                async with asyncio.timeout(RETRY_S):
                    await delivery.wake.wait()
            except TimeoutError:
                continue

    def _send(self, seat: Seat, message: ToWorker) -> bool:
        return self._send_to(seat.identity, message)

    def _send_to(self, identity: bytes, message: ToWorker) -> bool:
        """Send if it does not block; whether it went. A worker that cannot be reached is found out by its silence."""
        return send_now(self._router, [identity, _encoder.encode(message)])

    def _release(self, seat: Seat, delivery: Delivery) -> None:
        """Have a worker let a series go; it is free again when it says so."""
        seat.releasing, seat.delivery = delivery.number, None
        self._send(seat, Cancel(delivery.number))

    def _stop_sender(self, delivery: Delivery) -> None:
        if delivery.sender is not None:
            delivery.sender.cancel()
