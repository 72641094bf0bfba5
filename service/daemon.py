"""The daemon: sockets, children and their lives. `python -m service.daemon --config FILE`, or `fringed daemon FILE`.

It imports neither OpenCV nor kernels and never holds a pixel; what it does for clients is in `service.control`, what it
does with jobs in `service.pipeline`.
"""

from __future__ import annotations

import argparse
import asyncio
import fcntl
import logging
import os
import select
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zmq
import zmq.asyncio

from scanner.endpoints import sibling
from scanner.errors import ConfigError, ScannerError
from scanner.storage import storage_errors
from scanner.stream import SILENCE_S as WORKER_SILENCE_S
from scanner.wire import MAX_REQUEST_BYTES, MAX_SENT_BYTES, Event, Notification, encode
from service.callers import ANSWERS_HELD, CALLS_HELD, Callers
from service.calls import Calls
from service.control import Control, Endpoints
from service.descriptors import Admission, raise_limit
from service.devices_link import SILENCE_S as DEVICES_SILENCE_S
from service.devices_link import DevicesLink
from service.jobs import JobStore
from service.live import Live
from service.logs import start_logging
from service.notify import Notifier
from service.pipeline import Pipeline
from service.sockets import (
    MAX_SUBSCRIPTION_BYTES,
    bound,
    keep_from_clients,
    refuse_files,
    refuse_taken,
    remove_sockets,
    send_now,
)
from service.spool import Limits, Spool
from service.worker_pool import WorkerPool

if TYPE_CHECKING:
    from service.config import RigConfig

DEFAULT_STATE = Path("/var/lib/fringed")
LOCK_S = 5.0
"""How long the children of a daemon that was killed may take to end."""

SUBSCRIPTION_S, SUBSCRIPTIONS_HELD = 0.001, 16
"""Pause after subscriptions to events, of which the daemon has no use, and how many ZeroMQ holds of one subscriber: one
that makes them without end waits, and not the daemon."""

OnReady = Callable[[Mapping[str, str]], None]
"""Takes the endpoints by name"""

_log = logging.getLogger(__name__)


class Daemon:
    """One daemon in one event loop: `async with` has it running, `run` serves until it is stopped."""

    def __init__(
        self,
        config: RigConfig,
        *,
        state_dir: Path,
        endpoint: str,
        devices_silence_s: float = DEVICES_SILENCE_S,
        worker_silence_s: float = WORKER_SILENCE_S,
    ) -> None:
        self._config = config
        self._state_dir = state_dir
        self._endpoints = Endpoints(
            endpoint, *(sibling(endpoint, name) for name in ("events", "preview", "worker", "live"))
        )
        self._devices_silence_s = devices_silence_s
        self._worker_silence_s = worker_silence_s
        self._number = 0
        self._stopped = asyncio.Event()
        self._notifier = Notifier()

    @property
    def endpoints(self) -> Mapping[str, str]:
        """Where it listens: control, and the others as `hello` names them."""
        return vars(self._endpoints)

    async def run(self, ready: asyncio.Event | None = None) -> None:
        """Serve until `stop`.

        Raises:
            ConfigError: another daemon is at work on the same state, or an endpoint makes no sense.
            StorageError: state or spool cannot be written.
        """
        endpoints = tuple(vars(self._endpoints).values())
        refuse_files(endpoints)
        refuse_taken([self._endpoints.control])
        with _locked(self._state_dir) as lock:
            # Only now: children of a daemon that was killed may have served theirs until the lock was free.
            refuse_taken(endpoints)
            store = JobStore(self._state_dir / "jobs")
            spool = _spool(self._config, self._state_dir)
            spool.prepare()
            context = zmq.asyncio.Context()
            try:
                await self._serve(context, store, spool, lock, ready)
            finally:
                context.destroy(linger=200)
                remove_sockets(endpoints)

    def stop(self) -> None:
        """End soon: the scan that acquires is cancelled, what is being decoded is kept for the next daemon."""
        self._stopped.set()

    async def _serve(
        self, context: zmq.asyncio.Context, store: JobStore, spool: Spool, lock: int, ready: asyncio.Event | None
    ) -> None:
        held = {"high_water": ANSWERS_HELD, "received": CALLS_HELD, "longest": MAX_SENT_BYTES}
        self._control = bound(context, zmq.ROUTER, self._endpoints.control, **held)
        listened = {"received": SUBSCRIPTIONS_HELD, "longest": MAX_SUBSCRIPTION_BYTES}
        self._events = bound(context, zmq.XPUB, self._endpoints.events, **listened)
        router = bound(context, zmq.ROUTER, self._endpoints.worker)
        keep_from_clients(self._endpoints.worker)
        rig = self._config.model_dump(mode="json")
        devices = DevicesLink(rig, self.publish, inherit=[lock], silence_s=self._devices_silence_s)
        command_line = ("--serve", self._endpoints.worker)
        workers = WorkerPool(router, self.publish, command_line, inherit=[lock], silence_s=self._worker_silence_s)
        pipeline = Pipeline(store, spool, devices, workers, self.publish)
        live = Live(pipeline, devices, workers, self._endpoints.live)
        control = Control(
            self._config.rig, self._endpoints, pipeline, devices, workers, live, lambda: self._number, self.stop
        )
        callers = Callers(self._control, Calls(control), MAX_REQUEST_BYTES)
        listening = (self._endpoints.control, self._endpoints.events, self._endpoints.worker)
        serving = [asyncio.create_task(work) for work in (callers.serve(), self._drain_subscriptions())]
        workers.start(self._config.daemon.workers)
        opening = asyncio.create_task(_open_early(devices))
        loading = asyncio.create_task(asyncio.to_thread(import_module, "service.door"))  # before the first scan waits
        pipeline.start(live.recover)
        feeding = asyncio.create_task(self._notifier.feed(lambda: devices.answers))
        self._notifier.ready(f"serving {self._endpoints.control}")
        if ready is not None:
            ready.set()
        _log.info("serving %s", self._endpoints.control)
        admission = Admission(dict(zip(listening, (self._control, self._events, router), strict=True)))
        try:
            await self._stopped.wait()
        finally:
            _log.info("ending")
            admission.close()
            self._notifier.ending()
            await live.close()
            await pipeline.close()
            ended = (*serving, opening, loading, feeding)
            for task in ended:
                task.cancel()
            await asyncio.gather(*ended, return_exceptions=True)
            await asyncio.gather(workers.close(), devices.close())

    # --- sockets ------------------------------------------------------------------------------------------------

    def publish(self, kind: str, job: str | None, fields: Mapping[str, Any]) -> None:
        """Number an event and send it to all who listen; one who is late loses some and sees it by the number."""
        self._number += 1
        data = encode(Notification(params=Event(self._number, kind, job, dict(fields))))
        send_now(self._events, [data])

    async def _drain_subscriptions(self) -> None:
        plain: zmq.Socket[bytes] = zmq.Socket.shadow(self._events.underlying)
        while True:
            await self._events.recv()
            with suppress(zmq.Again):
                for _ in range(1000):
                    plain.recv(zmq.DONTWAIT)
            await asyncio.sleep(SUBSCRIPTION_S)


async def _open_early(devices: DevicesLink) -> None:
    """Devices open while nobody waits for them yet; what fails is told by an event, and again by the first scan."""
    try:
        await devices.open()
    except ScannerError as error:
        _log.error("devices: %s (%s)", error, error.hint)


@contextmanager
def _locked(state_dir: Path) -> Iterator[int]:
    """Hold the state folder's lock. Children inherit it: it is free when the last of an earlier daemon is gone."""
    with storage_errors(state_dir):
        state_dir.mkdir(mode=0o750, parents=True, exist_ok=True)
        descriptor = os.open(state_dir / "lock", os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o640)
    try:
        deadline = time.monotonic() + LOCK_S
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise ConfigError(
                        f"another daemon is at work in {state_dir}",
                        hint="fringed status shows it; two daemons need two state folders and two endpoints",
                    ) from None
                time.sleep(0.05)
        yield descriptor
    finally:
        os.close(descriptor)


def _spool(config: RigConfig, state_dir: Path) -> Spool:
    daemon = config.daemon
    days = daemon.retention.max_age_days
    return Spool(
        Path(daemon.spool) if daemon.spool is not None else state_dir / "spool",
        Limits(
            bytes=None if daemon.spool_limit_gb is None else round(daemon.spool_limit_gb * 1e9),
            min_free_bytes=round(daemon.retention.min_free_gb * 1e9),
            max_age_s=None if days is None else days * 86400.0,
        ),
    )


def run_daemon(
    config: RigConfig,
    *,
    state_dir: Path = DEFAULT_STATE,
    endpoint: str = "",
    lifeline: bool = False,
    ready: OnReady | None = None,
) -> None:
    """Run a daemon until it is told to end: by a client, SIGTERM, SIGINT or SIGHUP, or its lifeline.

    Args:
        config: the rig.
        state_dir: job records, and the spool where the rig file names none.
        endpoint: control endpoint; "": the rig file's.
        lifeline: end when standard input closes, and say "ready" on standard output.
        ready: told the endpoints by name once they answer.

    Raises:
        ConfigError, StorageError, ProtocolError: it cannot begin.
    """
    raise_limit()
    tell = _say_ready if lifeline else ready
    asyncio.run(_run(config, state_dir, endpoint or config.daemon.endpoint, lifeline, tell))


async def _run(config: RigConfig, state_dir: Path, endpoint: str, lifeline: bool, tell: OnReady | None) -> None:
    daemon = Daemon(config, state_dir=state_dir, endpoint=endpoint)
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        if number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
            continue  # nohup
        loop.add_signal_handler(number, daemon.stop)
    ready = asyncio.Event()
    telling = None if tell is None else asyncio.create_task(_tell_ready(ready, tell, daemon.endpoints))
    if lifeline:
        loop.add_reader(sys.stdin.fileno(), _read_lifeline, daemon)
    try:
        await daemon.run(ready)
    finally:
        if lifeline:
            loop.remove_reader(sys.stdin.fileno())
        if telling is not None:
            telling.cancel()


def _read_lifeline(daemon: Daemon) -> None:
    if not os.read(sys.stdin.fileno(), 64):
        daemon.stop()


async def _tell_ready(ready: asyncio.Event, tell: OnReady, endpoints: Mapping[str, str]) -> None:
    await ready.wait()
    tell(endpoints)


def _say_ready(_endpoints: Mapping[str, str]) -> None:
    print("ready", flush=True)


def main() -> int:
    """The process."""
    parser = argparse.ArgumentParser(prog="python -m service.daemon")
    parser.add_argument("--config", required=True, help="a rig file, or simulated[:DEVICE]")
    parser.add_argument("--state", type=Path, default=DEFAULT_STATE, help="folder of job records")
    parser.add_argument("--private", type=Path, help="keep sockets, records and spool in this folder")
    parser.add_argument("--lifeline", action="store_true", help="end when standard input closes")
    parser.add_argument("--fleeting", action="store_true", help="delete the private folder when the lifeline closed")
    given = parser.parse_args()
    start_logging("daemon")
    try:
        return _served(given)
    finally:
        # Whoever made the folder may have been killed. Where this daemon failed it still needs the log in there.
        if given.private is not None and given.fleeting and _lifeline_closed():
            shutil.rmtree(given.private, ignore_errors=True)


def _served(given: argparse.Namespace) -> int:
    try:
        from service.config import load_rig  # noqa: PLC0415  (after logging: its errors are logged)

        config = load_rig(given.config)
        state, endpoint = given.state, ""
        if given.private is not None:
            state, endpoint = given.private, f"ipc://{given.private}/control.ipc"
            config = config.model_copy(update={"daemon": config.daemon.model_copy(update={"spool": None})})
        run_daemon(config, state_dir=state, endpoint=endpoint, lifeline=given.lifeline)
    except ScannerError as error:
        _log.error("%s%s", error, f" ({error.hint})" if error.hint else "")
        return 1
    return 0


def _lifeline_closed() -> bool:
    readable, _, _ = select.select([sys.stdin], [], [], 0)
    return bool(readable) and not os.read(sys.stdin.fileno(), 64)


if __name__ == "__main__":
    sys.exit(main())
