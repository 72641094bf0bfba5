"""A program's way to the daemon over ZeroMQ: `Client` blocks, `AsyncClient` awaits; both run one `Session`.

    with Client() as client:
        scan = client.scan("pmp", exposure="auto")
        print(scan.xyz.shape)

A client belongs to one thread (or one event loop). Errors come back as the class of `scanner.errors` that the daemon
raised, with its hint.
"""

from __future__ import annotations

import asyncio
import socket
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TypeVar

import zmq
import zmq.asyncio

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
    socket_file,
    start_call,
    unreachable,
)
from scanner.wire import DEFAULT_ENDPOINT, MAX_MESSAGE_BYTES, WELCOME, Event

if TYPE_CHECKING:
    from scanner.scan import Scan

OnEvent = Callable[[Event], None]
_T = TypeVar("_T")

EVENTS_HWM = 10_000
WELCOME_S = 2.0


class Client:
    """A blocking client. Connects when made; use it in a `with` statement."""

    def __init__(self, endpoint: str = DEFAULT_ENDPOINT, timeout_s: float = 10.0, name: str = "") -> None:
        """Connect and say hello.

        Args:
            endpoint: the daemon's control endpoint, ipc.
            timeout_s: how long an answer may take.
            name: who asks; a repeated job_id means the same job only from the same name.

        Raises:
            Unreachable: nobody answers there; the hint says how to start a daemon.
            ProtocolError: the daemon speaks another version.
        """
        self.endpoint = endpoint
        self.timeout_s = timeout_s
        self._session = Session(name)
        _probe(endpoint)
        self._context = zmq.Context()
        self._control: zmq.Socket[bytes] = _configured(self._context.socket(zmq.DEALER))
        self._events: zmq.Socket[bytes] | None = None
        try:
            self._control.connect(endpoint)
            self._welcome = self.hello()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect. May be called twice."""
        self._context.destroy(linger=0)

    def hello(self) -> dict[str, Any]:
        """What the daemon says of itself: protocol, daemon, features, limits, endpoints."""
        welcome = dict(self._exchange(self._session.hello()))
        self._endpoints = self._session.check_welcome(welcome)
        return welcome

    def status(self) -> dict[str, Any]:
        """The daemon's state: devices, workers, jobs under way, spool, number of the last event."""
        return dict(self.call("status"))

    def devices(self) -> list[dict[str, Any]]:
        """The devices that the daemon's drivers can see."""
        return list(self.call("devices.list")["devices"])

    def start_scan(self, method: str = "pmp", *, job_id: str | None = None, **params: Any) -> str:
        """Ask for a scan; returns its job id at once. See docs/reference/protocol.md for the parameters."""
        self._subscribe()
        return str(self._run(_single(start_call(method, job_id, params)))["id"])

    def events(self, job_id: str) -> Iterator[Event]:
        """A job's events until it is over; where some were lost, one that holds the state stands for them."""
        self._subscribe()
        watch = JobWatch(job_id)
        while not watch.finished:
            if watch.needs_state:
                yield from watch.state(self.call("scan.status", id=job_id))
            else:
                yield from watch.event(self._next_event(QUIET_S))

    def wait(self, job_id: str, on_event: OnEvent | None = None) -> dict[str, Any]:
        """Wait until a job is over: {id, state, reason, report, files, error}."""
        for event in self.events(job_id):
            if on_event is not None:
                on_event(event)
        return self.result(job_id)

    def scan(
        self, method: str = "pmp", *, folder: Path | None = None, on_event: OnEvent | None = None, **params: Any
    ) -> Scan:
        """Scan, wait, fetch. With `folder`, its files stay there (the capture in `capture/`).

        Interrupted by Ctrl-C, the scan is cancelled on the daemon too.

        Raises:
            ScannerError: what went wrong, as its class.
        """
        job_id = self.start_scan(method, **params)
        try:
            raise_unless_done(self.wait(job_id, on_event))
        except KeyboardInterrupt:
            self.cancel(job_id)
            raise
        if folder is not None:
            return _loaded(self.fetch(job_id, folder))
        with tempfile.TemporaryDirectory(prefix="fringed-") as temporary:
            return _loaded(self.fetch(job_id, Path(temporary)))

    def result(self, job_id: str) -> dict[str, Any]:
        """{id, state, reason, report, files: [{name, bytes, sha256}], error}."""
        return dict(self.call("scan.result", id=job_id))

    def fetch(self, job_id: str, folder: Path, on_progress: OnProgress | None = None) -> Path:
        """Bring all files of a scan into `folder`, checked, and acknowledge it; see `scanner.session.fetch`."""
        return self._run(fetch(job_id, folder, on_progress))

    def cancel(self, job_id: str) -> dict[str, Any]:
        """Stop a job; returns its state. A job that is over stays as it is."""
        return dict(self.call("scan.cancel", id=job_id))

    def list_scans(self) -> list[dict[str, Any]]:
        """The jobs that the daemon knows, oldest first."""
        return list(self.call("scan.list")["scans"])

    def acknowledge(self, job_id: str) -> None:
        """Say that a scan's files are no longer needed on the daemon: retention may delete them."""
        self.call("scan.acknowledge", id=job_id)

    def delete(self, job_id: str) -> None:
        """Delete a scan's files on the daemon now."""
        self.call("scan.delete", id=job_id)

    def preview_start(self, **params: Any) -> str:
        """Start the preview; returns the endpoint to subscribe to (ZMQ_SUB with ZMQ_CONFLATE)."""
        return str(self.call("preview.start", **params)["endpoint"])

    def preview_stop(self) -> None:
        """Stop the preview."""
        self.call("preview.stop")

    def shutdown(self) -> None:
        """End the daemon; scans under way are cancelled."""
        self.call("shutdown")

    def call(self, method: str, **params: Any) -> Any:
        """Any method by name. Raises the daemon's error as its class."""
        return self._run(_single(Call(method, params)))

    def _run(self, procedure: Procedure[_T]) -> _T:
        outcome: Any = None
        try:
            while True:
                outcome = self._exchange(procedure.send(outcome))
        except StopIteration as stop:
            result: _T = stop.value
            return result
        finally:
            procedure.close()

    def _exchange(self, call: Call) -> Any:
        number, data = self._session.request(call)
        deadline = time.monotonic() + self.timeout_s
        _send(self._control, data)
        resend_at = time.monotonic() + RESEND_S
        while (now := time.monotonic()) < deadline:
            if not self._control.poll(max(1, int((min(deadline, resend_at) - now) * 1e3))):
                if time.monotonic() >= resend_at:
                    _send(self._control, data)
                    resend_at += RESEND_S
                continue
            found, outcome = self._session.answer(self._control.recv())
            if found is not None and found != number:
                continue  # the answer to a call that was given up or sent twice
            if hello_required(outcome):
                self.hello()
                _send(self._control, data)
                continue
            if isinstance(outcome, ScannerError):
                raise outcome
            return outcome
        raise unreachable(self.endpoint, f"{call.method} was not answered within {self.timeout_s:g} s")

    def _subscribe(self) -> None:
        if self._events is not None:
            return
        self._events = _configured(self._context.socket(zmq.SUB))
        self._events.setsockopt(zmq.SUBSCRIBE, b"")
        self._events.connect(self._endpoints["events"])
        deadline = time.monotonic() + WELCOME_S
        while (left := deadline - time.monotonic()) > 0:
            if self._events.poll(int(left * 1e3)) and self._events.recv() == WELCOME:
                return

    def _next_event(self, timeout_s: float) -> Event | None:
        if self._events is None or not self._events.poll(int(timeout_s * 1e3)):
            return None
        return event_from(self._events.recv())


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
        _probe(self.endpoint)
        self._context = zmq.asyncio.Context()
        self._control = _configured(self._context.socket(zmq.DEALER))
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
        return str((await self._run(_single(start_call(method, job_id, params))))["id"])

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
            return _loaded(await self.fetch(job_id, folder))
        with tempfile.TemporaryDirectory(prefix="fringed-") as temporary:
            return _loaded(await self.fetch(job_id, Path(temporary)))

    async def result(self, job_id: str) -> dict[str, Any]:
        """{id, state, reason, report, files, error}."""
        return dict(await self.call("scan.result", id=job_id))

    async def fetch(self, job_id: str, folder: Path, on_progress: OnProgress | None = None) -> Path:
        """Bring all files of a scan into `folder`, checked, and acknowledge it."""
        return await self._run(fetch(job_id, folder, on_progress))

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

    async def preview_start(self, **params: Any) -> str:
        """Start the preview; returns the endpoint to subscribe to."""
        return str((await self.call("preview.start", **params))["endpoint"])

    async def preview_stop(self) -> None:
        """Stop the preview."""
        await self.call("preview.stop")

    async def shutdown(self) -> None:
        """End the daemon."""
        await self.call("shutdown")

    async def call(self, method: str, **params: Any) -> Any:
        """Any method by name. Raises the daemon's error as its class."""
        return await self._run(_single(Call(method, params)))

    async def _run(self, procedure: Procedure[_T]) -> _T:
        outcome: Any = None
        try:
            while True:
                outcome = await self._exchange(procedure.send(outcome))
        except StopIteration as stop:
            result: _T = stop.value
            return result
        finally:
            procedure.close()

    async def _exchange(self, call: Call) -> Any:
        number, data = self._session.request(call)
        deadline = time.monotonic() + self.timeout_s
        try:
            while (left := deadline - time.monotonic()) > 0:
                answer = self._answers[number] = asyncio.get_running_loop().create_future()
                _send(self._control, data)
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
        raise unreachable(self.endpoint, f"{call.method} was not answered within {self.timeout_s:g} s")

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
            events = _configured(self._context.socket(zmq.SUB))
            events.setsockopt(zmq.SUBSCRIBE, b"")
            events.connect(self._endpoints["events"])
            self._readers.append(asyncio.create_task(self._read_events(events, self._subscribed)))
        with suppress(TimeoutError):
            await asyncio.wait_for(self._subscribed.wait(), WELCOME_S)

    async def _read_events(self, events: zmq.asyncio.Socket, subscribed: asyncio.Event) -> None:
        while True:
            event = event_from(await events.recv())
            if event is None:
                subscribed.set()
            for queue in self._listeners:
                queue.put_nowait(event)


def _single(call: Call) -> Procedure[Any]:
    return (yield call)


async def _next(queue: asyncio.Queue[Event | None], timeout_s: float) -> Event | None:
    try:
        return await asyncio.wait_for(queue.get(), timeout_s)
    except TimeoutError:
        return None


def _loaded(folder: Path) -> Scan:
    from scanner.scan import load_scan  # noqa: PLC0415  (clients that want no arrays do not pay for NumPy's kernels)

    return load_scan(folder)


def _send(control: Any, data: bytes) -> None:
    # Never blocks: where the queue to a daemon that is gone is full, the call is sent again later.
    with suppress(zmq.Again):
        control.send(data, zmq.DONTWAIT)


_Socket = TypeVar("_Socket", bound="zmq.Socket[Any]")


def _configured(opened: _Socket) -> _Socket:
    opened.setsockopt(zmq.LINGER, 0)
    opened.setsockopt(zmq.SNDHWM, 1000)
    opened.setsockopt(zmq.RCVHWM, EVENTS_HWM)
    opened.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
    opened.setsockopt(zmq.RECONNECT_IVL, 50)
    opened.setsockopt(zmq.RECONNECT_IVL_MAX, 1000)
    return opened


def _probe(endpoint: str) -> None:
    """Raise Unreachable at once where nobody listens: ZeroMQ itself would wait without a word."""
    path = socket_file(endpoint)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as trial:
        trial.settimeout(1.0)
        try:
            trial.connect(str(path))
        except FileNotFoundError:
            raise unreachable(endpoint, "the socket does not exist") from None
        except ConnectionRefusedError:
            raise unreachable(endpoint, "nobody listens on the socket") from None
        except PermissionError:
            error = unreachable(endpoint, "this user may not open the socket")
            error.hint = "become a member of the daemon's group (log in again afterwards)"
            raise error from None
        except OSError as error:
            raise unreachable(endpoint, str(error.strerror or error)) from None
