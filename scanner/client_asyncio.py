"""`scanner.client.Client` for asyncio: the same methods, awaited."""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TypeVar

import zmq
import zmq.asyncio

from scanner.client_sockets import WELCOME_S, configured, conflated, loaded, probe, send, single
from scanner.endpoints import DEFAULT_ENDPOINT
from scanner.errors import ProtocolError, ScannerError
from scanner.session import (
    QUIET_S,
    RESEND_S,
    Call,
    JobWatch,
    OnProgress,
    Procedure,
    Session,
    event_from,
    fetch,
    hello_required,
    raise_unless_done,
    start_call,
    unreachable,
)
from scanner.wire import Event

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from scanner.live import LiveFrame
    from scanner.scan import Scan

OnEvent = Callable[[Event], None]
_T = TypeVar("_T")


class AsyncClient:
    """The same for asyncio: `async with AsyncClient() as client`. Methods are those of `Client`, awaited."""

    def __init__(self, endpoint: str = DEFAULT_ENDPOINT, timeout_s: float = 10.0, name: str = "") -> None:
        self.endpoint = endpoint
        self.timeout_s = timeout_s
        self._session = Session(name)
        self._context: zmq.asyncio.Context | None = None
        self._answers: dict[int, asyncio.Future[Any]] = {}
        self._listeners: set[asyncio.Queue[Event | None]] = set()
        self._readers: list[asyncio.Task[None]] = []
        self._endpoints: dict[str, Any] = {}
        self._subscribed: asyncio.Event | None = None

    async def __aenter__(self) -> Self:
        """Connect and say hello.

        Raises:
            Unreachable: nobody answers there.
            ProtocolError: the daemon speaks another version.
        """
        probe(self.endpoint)
        self._context = zmq.asyncio.Context()
        self._control = configured(self._context.socket(zmq.DEALER))
        self._control.connect(self.endpoint)
        self._readers.append(asyncio.create_task(self._read_answers()))
        try:
            await self.hello()
        except BaseException:
            await self.close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Disconnect. May be called twice."""
        readers, self._readers = self._readers, []
        for reader in readers:
            reader.cancel()
        await asyncio.gather(*readers, return_exceptions=True)
        self._subscribed = None
        if self._context is not None:
            self._context.destroy(linger=0)
            self._context = None

    async def hello(self) -> dict[str, Any]:
        """What the daemon says of itself."""
        welcome = dict(await self._exchange(self._session.hello()))
        self._endpoints = self._session.check_welcome(welcome)
        return welcome

    async def status(self) -> dict[str, Any]:
        """The daemon's state."""
        return dict(await self.call("status"))

    async def devices(self) -> list[dict[str, Any]]:
        """The devices that the daemon's drivers can see."""
        return list((await self.call("devices.list"))["devices"])

    async def start_scan(self, method: str = "pmp", *, job_id: str | None = None, **params: Any) -> str:
        """Ask for a scan; returns its job id at once."""
        await self._subscribe()
        return str((await self._run(single(start_call(method, job_id, params))))["id"])

    async def events(self, job_id: str) -> AsyncIterator[Event]:
        """A job's events until it is over."""
        await self._subscribe()
        queue: asyncio.Queue[Event | None] = asyncio.Queue()
        self._listeners.add(queue)
        try:
            watch = JobWatch(job_id)
            while not watch.finished:
                if watch.needs_state:
                    news = watch.state(await self.call("scan.status", id=job_id))
                else:
                    news = watch.event(await _next(queue, QUIET_S))
                for event in news:
                    yield event
        finally:
            self._listeners.discard(queue)

    async def wait(self, job_id: str, on_event: OnEvent | None = None) -> dict[str, Any]:
        """Wait until a job is over: {id, state, reason, report, files, error}."""
        async for event in self.events(job_id):
            if on_event is not None:
                on_event(event)
        return await self.result(job_id)

    async def scan(
        self, method: str = "pmp", *, folder: Path | None = None, on_event: OnEvent | None = None, **params: Any
    ) -> Scan:
        """Scan, wait, fetch; cancelled with its task."""
        job_id = await self.start_scan(method, **params)
        try:
            raise_unless_done(await self.wait(job_id, on_event))
        except asyncio.CancelledError:
            await self.cancel(job_id)
            raise
        if folder is not None:
            return loaded(await self.fetch(job_id, folder))
        with tempfile.TemporaryDirectory(prefix="fringed-") as temporary:
            return loaded(await self.fetch(job_id, Path(temporary)))

    async def result(self, job_id: str) -> dict[str, Any]:
        """{id, state, reason, report, files, error}."""
        return dict(await self.call("scan.result", id=job_id))

    async def fetch(
        self, job_id: str, folder: Path, on_progress: OnProgress | None = None, *, failed_too: bool = False
    ) -> Path:
        """Bring all files of a scan into `folder`, checked, and acknowledge it."""
        return await self._run(fetch(job_id, folder, on_progress, failed_too=failed_too))

    async def arrays(self, points: Event) -> dict[str, NDArray[Any]]:
        """xyz and confidence of a scan whose files are still being written; see `Client.arrays`."""
        from scanner.early_points import fetch_arrays  # noqa: PLC0415

        return await self._run(fetch_arrays(points))

    async def cancel(self, job_id: str) -> dict[str, Any]:
        """Stop a job; returns its state."""
        return dict(await self.call("scan.cancel", id=job_id))

    async def list_scans(self) -> list[dict[str, Any]]:
        """The jobs that the daemon knows, oldest first."""
        return list((await self.call("scan.list"))["scans"])

    async def acknowledge(self, job_id: str) -> None:
        """Say that a scan's files are no longer needed on the daemon."""
        await self.call("scan.acknowledge", id=job_id)

    async def delete(self, job_id: str) -> None:
        """Delete a scan's files on the daemon now."""
        await self.call("scan.delete", id=job_id)

    @asynccontextmanager
    async def live(self, *, stop: bool = True, **params: Any) -> AsyncIterator[AsyncIterator[LiveFrame]]:
        """Start a live run and read its results: `async with client.live() as frames`, `async for frame in frames`."""
        job_id = (await self.live_start(**params))["id"]
        frames = self.live_frames(job_id)
        try:
            yield frames
        finally:
            await frames.aclose()
            if stop:
                await self.live_stop(job_id)

    async def live_start(self, job_id: str | None = None, **params: Any) -> dict[str, Any]:
        """Start a live run; its state, with the `endpoint` of the results."""
        from scanner.live import live_start_call  # noqa: PLC0415  (clients that want no arrays do not load them)

        return dict(await self._run(single(live_start_call(job_id, params))))

    async def live_frames(self, job_id: str) -> AsyncGenerator[LiveFrame, None]:
        """Results of a live run, the newest each time, until it is over."""
        from scanner.live import QUIET_S, LiveWatch  # noqa: PLC0415

        if self._context is None:
            raise ProtocolError("the client is closed")
        watch = LiveWatch(job_id)
        live = conflated(self._context.socket(zmq.SUB), self._endpoints["live"])
        try:
            while not watch.finished:
                if await live.poll(int(QUIET_S * 1e3)):
                    frame = watch.result(await live.recv())
                    if frame is not None:
                        yield frame
                else:
                    watch.state(await self.call("live.status"))
        finally:
            live.close()

    async def live_stop(self, job_id: str | None = None) -> dict[str, Any]:
        """End a live run; its state once the devices are free."""
        return dict(await self.call("live.stop", id=job_id))

    async def live_status(self) -> dict[str, Any] | None:
        """The live run under way, or the last one."""
        return (await self.call("live.status"))["run"]  # type: ignore[no-any-return]

    async def preview_start(self, **params: Any) -> str:
        """Start the preview; returns the endpoint to subscribe to."""
        return str((await self.call("preview.start", **params))["endpoint"])

    async def preview_stop(self) -> None:
        """Stop the preview."""
        await self.call("preview.stop")

    async def shutdown(self) -> None:
        """End the daemon."""
        await self.call("shutdown")

    async def call(self, method: str, /, **params: Any) -> Any:
        """Any method by name. Raises the daemon's error as its class."""
        return await self._run(single(Call(method, params)))

    async def _run(self, procedure: Procedure[_T]) -> _T:
        try:
            wanted = next(procedure)
            while True:
                try:
                    if isinstance(wanted, Call):
                        outcome: Any = await self._exchange(wanted)
                    else:
                        outcome = await asyncio.gather(*(self._exchange(call) for call in wanted))
                except ScannerError as error:
                    wanted = procedure.throw(error)
                else:
                    wanted = procedure.send(outcome)
        except StopIteration as stop:
            result: _T = stop.value
            return result
        finally:
            procedure.close()

    async def _exchange(self, call: Call) -> Any:
        number, data = self._session.request(call)
        patience_s = call.patience_s(self.timeout_s)
        deadline = time.monotonic() + patience_s
        try:
            while (left := deadline - time.monotonic()) > 0:
                answer = self._answers[number] = asyncio.get_running_loop().create_future()
                send(self._control, data)
                done, _ = await asyncio.wait({answer}, timeout=min(left, RESEND_S))
                if not done:
                    continue
                outcome = answer.result()
                if hello_required(outcome):
                    await self.hello()
                    continue
                if isinstance(outcome, ScannerError):
                    raise outcome
                return outcome
        finally:
            self._answers.pop(number, None)
        raise unreachable(self.endpoint, f"{call.method} was not answered within {patience_s:g} s")

    async def _read_answers(self) -> None:
        while True:
            data = await self._control.recv()
            try:
                number, outcome = self._session.answer(data)
            except ProtocolError as error:
                number, outcome = None, error
            for waiting in self._answers if number is None else [number]:
                answer = self._answers.get(waiting)  # type: ignore[arg-type]
                if answer is not None and not answer.done():
                    answer.set_result(outcome)

    async def _subscribe(self) -> None:
        if self._subscribed is None:
            if self._context is None:
                raise ProtocolError("the client is closed")
            self._subscribed = asyncio.Event()
            events = configured(self._context.socket(zmq.SUB))
            events.setsockopt(zmq.SUBSCRIBE, b"")
            events.connect(self._endpoints["events"])
            self._readers.append(asyncio.create_task(self._read_events(events, self._subscribed)))
        with suppress(TimeoutError):
            async with asyncio.timeout(WELCOME_S):
                await self._subscribed.wait()

    async def _read_events(self, events: zmq.asyncio.Socket, subscribed: asyncio.Event) -> None:
        while True:
            event = event_from(await events.recv())
            if event is None:
                subscribed.set()
            for queue in self._listeners:
                queue.put_nowait(event)


async def _next(queue: asyncio.Queue[Event | None], timeout_s: float) -> Event | None:
    # Not wait_for: under Python 3.11 it can swallow a cancellation that comes with an event.
    try:
        async with asyncio.timeout(timeout_s):
            return await queue.get()
    except TimeoutError:
        return None
