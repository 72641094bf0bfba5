"""A program's way to the daemon over ZeroMQ: `Client` blocks, `AsyncClient` awaits; both run one `Session`.

    with Client() as client:
        scan = client.scan("pmp", exposure="auto")
        print(scan.xyz.shape)

A client belongs to one thread (or one event loop). Errors come back as the class of `scanner.errors` that the daemon
raised, with its hint.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TypeVar

import zmq
import zmq.asyncio

from scanner.client_asyncio import AsyncClient
from scanner.client_sockets import WELCOME_S, configured, conflated, loaded, probe, send, single
from scanner.endpoints import DEFAULT_ENDPOINT
from scanner.errors import ScannerError, Unreachable
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
from scanner.wire import WELCOME, Event

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from scanner.camera_picture import CameraPicture
    from scanner.live import LiveFrame
    from scanner.scan import Scan

__all__ = ["AsyncClient", "Client", "OnEvent"]

OnEvent = Callable[[Event], None]
_T = TypeVar("_T")


class Client:
    """A blocking client. Connects when made; use it in a `with` statement."""

    def __init__(self, endpoint: str = DEFAULT_ENDPOINT, timeout_s: float = 10.0, name: str = "") -> None:
        """Connect and say hello.

        Args:
            endpoint: the daemon's control endpoint, ipc.
            timeout_s: how long an answer may take; at least 90 s of calls that wait for devices.
            name: who asks; a repeated job_id means the same job only from the same name.

        Raises:
            Unreachable: nobody answers there; the hint says how to start a daemon.
            ProtocolError: the daemon speaks another version.
        """
        self.endpoint = endpoint
        self.timeout_s = timeout_s
        self._session = Session(name)
        probe(endpoint)
        self._context = zmq.Context()
        self._control: zmq.Socket[bytes] = configured(self._context.socket(zmq.DEALER))
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
        return str(self._run(single(start_call(method, job_id, params)))["id"])

    def events(self, job_id: str, *, patience_s: float | None = None) -> Iterator[Event]:
        """A job's events until it is over; where some were lost, one that holds the state stands for them.

        Raises:
            Unreachable: the daemon does not answer, or has had no news of the job for `patience_s`.
        """
        self._subscribe()
        watch = JobWatch(job_id)
        heard = time.monotonic()
        while not watch.finished:
            if watch.needs_state:
                news = watch.state(self.call("scan.status", id=job_id))
            else:
                news = watch.event(self._next_event(QUIET_S))
            if news:
                heard = time.monotonic()
            elif patience_s is not None and time.monotonic() - heard > patience_s:
                raise Unreachable(
                    f"no news of scan {job_id} for {patience_s:g} s", hint="fringed status shows what the daemon is at"
                )
            yield from news

    def wait(self, job_id: str, on_event: OnEvent | None = None, *, patience_s: float | None = None) -> dict[str, Any]:
        """Wait until a job is over: {id, state, reason, report, files, error}. See `events`."""
        for event in self.events(job_id, patience_s=patience_s):
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
            return loaded(self.fetch(job_id, folder))
        with tempfile.TemporaryDirectory(prefix="fringed-") as temporary:
            return loaded(self.fetch(job_id, Path(temporary)))

    def result(self, job_id: str) -> dict[str, Any]:
        """{id, state, reason, report, files: [{name, bytes, sha256}], error}."""
        return dict(self.call("scan.result", id=job_id))

    def fetch(
        self, job_id: str, folder: Path, on_progress: OnProgress | None = None, *, failed_too: bool = False
    ) -> Path:
        """Bring all files of a scan into `folder`, checked, and acknowledge it; see `scanner.session.fetch`."""
        return self._run(fetch(job_id, folder, on_progress, failed_too=failed_too))

    def arrays(self, points: Event) -> dict[str, NDArray[Any]]:
        """xyz and confidence of a scan whose files are still being written: of its event `points` (see `events`)."""
        from scanner.early_points import fetch_arrays  # noqa: PLC0415  (clients that want no arrays do not load them)

        return self._run(fetch_arrays(points))

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

    @contextmanager
    def live(self, *, stop: bool = True, **params: Any) -> Iterator[Iterator[LiveFrame]]:
        """Start a live run and read its results; it is stopped at the end of the block.

            with client.live(content="xyz", stride=2) as frames:
                for frame in frames:
                    print(frame.number, frame.latency_ms, frame.xyz)

        Args:
            stop: False leaves the run going.
            params: of `live.start`, see docs/reference/protocol.md.

        Raises:
            DeviceBusy: a scan or another live run has the devices.
            ScannerError: while reading: why the run failed, as its class.
        """
        job_id = self.live_start(**params)["id"]
        frames = self.live_frames(job_id)
        try:
            yield frames
        finally:
            frames.close()
            if stop:
                self.live_stop(job_id)

    def live_start(self, job_id: str | None = None, **params: Any) -> dict[str, Any]:
        """Start a live run; its state, with the `endpoint` of the results."""
        from scanner.live import live_start_call  # noqa: PLC0415  (clients that want no arrays do not load them)

        return dict(self._run(single(live_start_call(job_id, params))))

    def live_frames(self, job_id: str) -> Generator[LiveFrame, None, None]:
        """Results of a live run, the newest each time, until it is over.

        Raises:
            ScannerError: why it failed, as its class.
        """
        from scanner.live import QUIET_S, LiveWatch  # noqa: PLC0415

        watch = LiveWatch(job_id)
        live = conflated(self._context.socket(zmq.SUB), self._endpoints["live"])
        try:
            while not watch.finished:
                if live.poll(int(QUIET_S * 1e3)):
                    frame = watch.result(live.recv())
                    if frame is not None:
                        yield frame
                else:
                    watch.state(self.call("live.status"))
        finally:
            live.close()

    def live_stop(self, job_id: str | None = None) -> dict[str, Any]:
        """End a live run; its state once the devices are free. A recording is whole when its job is done (`wait`)."""
        return dict(self.call("live.stop", id=job_id))

    def live_status(self) -> dict[str, Any] | None:
        """The live run under way, or the last one: state, counts, rates, latency; None where there was none."""
        return self.call("live.status")["run"]  # type: ignore[no-any-return]

    def previews(self, **params: Any) -> Generator[CameraPicture, None, None]:
        """Pictures of the preview, the newest each time, until the generator is closed; params: see `preview.start`.

        Raises:
            ScannerError: why there are none, as its class.
        """
        from scanner.camera_picture import CameraPicture  # noqa: PLC0415
        from scanner.live import QUIET_S  # noqa: PLC0415

        pictures = conflated(self._context.socket(zmq.SUB), self.preview_start(**params))
        last = None
        try:
            while True:
                if pictures.poll(int(2e3 * QUIET_S)):
                    yield (last := CameraPicture.of(pictures.recv(), last))
                else:
                    self.preview_start(**params)  # once more: after a lost camera it has ended; or it says why not
        finally:
            pictures.close()
            with suppress(ScannerError):
                self.preview_stop()

    def preview_start(self, **params: Any) -> str:
        """Start the preview; returns the endpoint to subscribe to (ZMQ_SUB with ZMQ_CONFLATE)."""
        return str(self.call("preview.start", **params)["endpoint"])

    def preview_stop(self) -> None:
        """Stop the preview."""
        self.call("preview.stop")

    def shutdown(self) -> None:
        """End the daemon; scans under way are cancelled."""
        self.call("shutdown")

    def call(self, method: str, /, **params: Any) -> Any:
        """Any method by name. Raises the daemon's error as its class."""
        return self._run(single(Call(method, params)))

    def _run(self, procedure: Procedure[_T]) -> _T:
        try:
            wanted = next(procedure)
            while True:
                try:
                    outcome = self._exchange(wanted) if isinstance(wanted, Call) else self._exchange_all(wanted)
                except ScannerError as error:
                    wanted = procedure.throw(error)
                else:
                    wanted = procedure.send(outcome)
        except StopIteration as stop:
            result: _T = stop.value
            return result
        finally:
            procedure.close()

    def _exchange(self, call: Call) -> Any:
        number, data = self._session.request(call)
        patience_s = call.patience_s(self.timeout_s)
        deadline = time.monotonic() + patience_s
        send(self._control, data)
        resend_at = time.monotonic() + RESEND_S
        while (now := time.monotonic()) < deadline:
            if not self._control.poll(max(1, int((min(deadline, resend_at) - now) * 1e3))):
                if time.monotonic() >= resend_at:
                    send(self._control, data)
                    resend_at += RESEND_S
                continue
            found, outcome = self._session.answer(self._control.recv())
            if found is not None and found != number:
                continue  # the answer to a call that was given up or sent twice
            if hello_required(outcome):
                self.hello()
                send(self._control, data)
                continue
            if isinstance(outcome, ScannerError):
                raise outcome
            return outcome
        raise unreachable(self.endpoint, f"{call.method} was not answered within {patience_s:g} s")

    def _exchange_all(self, calls: tuple[Call, ...]) -> list[Any]:
        """Several calls at once: while one answer is on its way the next is being made."""
        asked: dict[int | str | None, int] = {}
        results: dict[int, Any] = {}
        for index, call in enumerate(calls):
            number, data = self._session.request(call)
            asked[number] = index
            send(self._control, data)
        while len(results) < len(calls) and self._control.poll(int(RESEND_S * 1e3)):
            found, outcome = self._session.answer_in_place(self._control.recv(copy=False).buffer)
            if isinstance(outcome, ScannerError) and not hello_required(outcome):
                raise outcome
            if found in asked and not isinstance(outcome, ScannerError):
                results[asked[found]] = outcome
        # What was not answered, or not known to whom, once more by itself.
        return [results[n] if n in results else self._exchange(call) for n, call in enumerate(calls)]

    def _subscribe(self) -> None:
        if self._events is not None:
            return
        self._events = configured(self._context.socket(zmq.SUB))
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
