"""The daemon's methods: what each call of a client does. Sockets are `service.daemon`'s."""

from __future__ import annotations

import asyncio
import logging
import os
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from importlib import metadata
from typing import TYPE_CHECKING, Any

from scanner.errors import DeviceBusy, StorageError
from scanner.wire import (
    LARGE_BYTES,
    MAX_FETCH_BYTES,
    MAX_MESSAGE_BYTES,
    MAX_REQUEST_BYTES,
    PROTOCOL,
    Fetch,
    Hello,
    JobRef,
    LiveStart,
    LiveStop,
    Nothing,
    PreviewStart,
    Refused,
    Request,
    ScanStart,
    params_as,
)
from service.devices_link import DevicesLink
from service.jobs import Job, JobState
from service.live import Live
from service.pieces import Encoded, large_piece, piece
from service.pipe import Preview
from service.pipeline import MAX_QUEUED, Pipeline
from service.worker_pool import WorkerPool

if TYPE_CHECKING:
    from service.rig_model import RigSettings

MAX_CLIENTS = 4096
"""Connections remembered; one that was forgotten says hello again."""

SPOOL_FRESH_S = 1.0
"""How long `status` says what the spool held when it was last measured."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Endpoints:
    """Where the daemon's sockets are."""

    control: str
    events: str
    preview: str
    worker: str
    live: str


class Control:
    """Answers calls. `answer` may be awaited by many at once."""

    def __init__(
        self,
        rig: RigSettings,
        endpoints: Endpoints,
        pipeline: Pipeline,
        devices: DevicesLink,
        workers: WorkerPool,
        live: Live,
        last_event: Callable[[], int],
        stop: Callable[[], None],
    ) -> None:
        self._name = rig.name
        self._phase_axis = rig.phase_axis
        self._endpoints = endpoints
        self._pipeline = pipeline
        self._devices = devices
        self._workers = workers
        self._live = live
        self._last_event = last_event
        self._stop = stop
        self._clients: OrderedDict[bytes, str] = OrderedDict()
        self._measuring: asyncio.Task[int] | None = None
        self._fresh_until = 0.0
        self._methods: dict[str, Callable[[Request, str], Awaitable[Any]]] = {
            "status": self._status,
            "devices.list": self._list_devices,
            "scan.start": self._start,
            "scan.status": self._scan_status,
            "scan.result": self._result,
            "scan.fetch": self._fetch,
            "scan.cancel": self._cancel,
            "scan.list": self._list,
            "scan.acknowledge": self._acknowledge,
            "scan.delete": self._delete,
            "live.start": self._live_start,
            "live.stop": self._live_stop,
            "live.status": self._live_status,
            "preview.start": self._preview_start,
            "preview.stop": self._preview_stop,
            "shutdown": self._shutdown,
        }

    def check(self, identity: bytes, method: str) -> None:
        """Whether a method is served, to this connection.

        Raises:
            Refused: no; nothing else of its call needs to be read.
        """
        if method != "hello" and method not in self._methods:
            raise Refused(
                f"unknown method {method[:100]!r}",
                reason="unknown_method",
                hint=f"methods: hello, {', '.join(self._methods)}",
            )
        if method != "hello" and identity not in self._clients:
            raise Refused(
                f"{method} before hello: this connection is not known",
                reason="hello_required",
                hint="say hello first, and again when the daemon was restarted",
            )

    async def answer(self, identity: bytes, request: Request) -> Any:
        """A call's result.

        Raises:
            ScannerError: what the client is told.
        """
        self.check(identity, request.method)
        if request.method == "hello":
            return self._hello(identity, request)
        return await self._methods[request.method](request, self._clients[identity])

    def _hello(self, identity: bytes, request: Request) -> dict[str, Any]:
        given = params_as(Hello, request)
        if min(given.protocol) < 0:
            raise Refused(
                f"hello: protocol {list(given.protocol)} is no version",
                reason="invalid_params",
                hint=f"[major, minor], as {list(PROTOCOL)}",
            )
        if given.protocol[0] != PROTOCOL[0]:
            raise Refused(
                f"the client speaks protocol {list(given.protocol)}, this daemon {list(PROTOCOL)}",
                reason="protocol_version",
                hint=f"protocol: {list(PROTOCOL)}; programs that are fringed's own are of the daemon's version",
            )
        self._clients[identity] = given.client
        self._clients.move_to_end(identity)
        while len(self._clients) > MAX_CLIENTS:
            self._clients.popitem(last=False)
        return {
            "protocol": list(PROTOCOL),
            "daemon": {"name": self._name, "version": metadata.version("fringed"), "pid": os.getpid()},
            "features": ["hello", *self._methods],
            "limits": {
                "request_bytes": MAX_REQUEST_BYTES,
                "message_bytes": MAX_MESSAGE_BYTES,
                "fetch_bytes": MAX_FETCH_BYTES,
                "queued_scans": MAX_QUEUED,
            },
            "endpoints": {
                "events": self._endpoints.events,
                "preview": self._endpoints.preview,
                "live": self._endpoints.live,
                "worker": self._endpoints.worker,
            },
        }

    async def _status(self, request: Request, _client: str) -> dict[str, Any]:
        params_as(Nothing, request)
        spool = self._pipeline.spool
        return {
            "number": self._last_event(),
            "name": self._name,
            "devices": self._devices.description,
            "workers": self._workers.describe(),
            "waiting_for_worker": self._workers.waiting,
            "jobs": [job.status() for job in self._pipeline.store.unfinished()],
            "spool": {
                "bytes": await self._spool_bytes(),
                "limit_bytes": spool.limits.bytes,
                "min_free_bytes": spool.limits.min_free_bytes,
            },
        }

    async def _spool_bytes(self) -> int:
        """Measured once for all who ask within SPOOL_FRESH_S: every file of it is looked at."""
        now = asyncio.get_running_loop().time()
        if self._measuring is None or (self._measuring.done() and now >= self._fresh_until):
            self._fresh_until = now + SPOOL_FRESH_S
            self._measuring = asyncio.create_task(asyncio.to_thread(self._pipeline.spool.used))
        return await asyncio.shield(self._measuring)

    async def _list_devices(self, request: Request, _client: str) -> dict[str, Any]:
        params_as(Nothing, request)
        self._refuse_while_live()
        return {"devices": await self._devices.discover()}

    async def _start(self, request: Request, client: str) -> dict[str, Any]:
        params = params_as(ScanStart, request)
        self._refuse_endless(params)
        if self._pipeline.store.find(params, client) is None:
            self._refuse_nonsense(params)
            self._refuse_while_live()
        job = await self._pipeline.submit(params, client)
        return self._with_number(job)

    async def _scan_status(self, request: Request, _client: str) -> dict[str, Any]:
        return self._with_number(self._job(request))

    async def _result(self, request: Request, _client: str) -> dict[str, Any]:
        job = self._job(request)
        if job.deleted and job.state is JobState.DONE:
            raise StorageError(
                f"the files of job {job.id} were deleted", hint="scans leave the spool once acknowledged, or by age"
            )
        if job.state is JobState.DONE:
            self._pipeline.spool.lease(job.id)
        return job.result()

    async def _fetch(self, request: Request, _client: str) -> bytes | Encoded:
        given = params_as(Fetch, request)
        job = self._pipeline.store.get(given.id)
        size = None if job.deleted else job.readable(given.name)
        if size is None:
            raise Refused(
                f"job {job.id} has no file {given.name[:200]!r}", reason="unknown_file", hint="scan.result names them"
            )
        if given.offset < 0 or not 0 < given.length <= MAX_FETCH_BYTES:
            raise Refused(
                f"scan.fetch: offset {given.offset}, length {given.length}",
                reason="invalid_params",
                hint=f"offset 0 or more, length 1 .. {MAX_FETCH_BYTES}",
            )
        length = min(given.length, size - given.offset)
        if length <= 0:
            return b""  # also where the file system could not seek so far
        self._pipeline.spool.lease(job.id)
        folder = self._pipeline.spool.folder(job.id)
        inside, _, name = given.name.rpartition("/")
        path = (folder / inside if inside else folder / (job.output or "")) / name
        if length < LARGE_BYTES:
            return await asyncio.to_thread(piece, path, given.offset, length)
        return await asyncio.to_thread(large_piece, request.id, path, given.offset, length)

    async def _cancel(self, request: Request, _client: str) -> dict[str, Any]:
        job = self._job(request)
        if isinstance(job.params, LiveStart):
            await self._live.stop(job.id)
        else:
            await self._pipeline.cancel(job)
        return self._with_number(job)

    async def _list(self, request: Request, _client: str) -> dict[str, Any]:
        params_as(Nothing, request)
        return {"number": self._last_event(), "scans": [job.status() for job in self._pipeline.store]}

    async def _acknowledge(self, request: Request, _client: str) -> dict[str, Any]:
        job = self._job(request)
        await self._pipeline.acknowledge(job)
        return self._with_number(job)

    async def _delete(self, request: Request, _client: str) -> dict[str, Any]:
        job = self._job(request)
        await self._pipeline.delete(job)
        return self._with_number(job)

    async def _live_start(self, request: Request, client: str) -> dict[str, Any]:
        params = params_as(LiveStart, request)
        self._refuse_endless(params)
        if self._pipeline.store.find(params, client) is None:
            self._refuse_nonsense(params)
        job = await self._live.start(params, client)
        return {**self._with_number(job), "endpoint": self._endpoints.live}

    async def _live_stop(self, request: Request, _client: str) -> dict[str, Any]:
        job = await self._live.stop(params_as(LiveStop, request).id)
        return self._with_number(job)

    async def _live_status(self, request: Request, _client: str) -> dict[str, Any]:
        params_as(Nothing, request)
        return {"number": self._last_event(), "run": self._live.status()}

    @staticmethod
    def _refuse_endless(params: ScanStart | LiveStart) -> None:
        from service.door import refuse_endless  # noqa: PLC0415  (as below)

        refuse_endless(params)

    def _refuse_nonsense(self, params: ScanStart | LiveStart) -> None:
        from service.door import refuse_nonsense  # noqa: PLC0415  (brings NumPy; loaded while the devices open)

        opened = self._devices.description
        size = None if opened is None else (opened["projector"]["width"], opened["projector"]["height"])
        refuse_nonsense(params, size, self._phase_axis)

    def _refuse_while_live(self) -> None:
        if self._live.running:
            raise DeviceBusy("the devices are busy with a live run", hint="end it first (live.stop)")

    async def _preview_start(self, request: Request, _client: str) -> dict[str, Any]:
        given = params_as(PreviewStart, request)
        if not 0 < given.rate_hz <= 60 or not 16 <= given.max_width <= 2048:
            raise Refused(
                f"preview.start: rate {given.rate_hz:g} Hz, width {given.max_width}",
                reason="invalid_params",
                hint="rate_hz up to 60, max_width 16 .. 2048",
            )
        await self._devices.preview(Preview(self._endpoints.preview, given.rate_hz, given.max_width))
        return {"endpoint": self._endpoints.preview}

    async def _preview_stop(self, request: Request, _client: str) -> dict[str, Any]:
        params_as(Nothing, request)
        await self._devices.preview(Preview(self._endpoints.preview, 0.0, 0))
        return {}

    async def _shutdown(self, request: Request, _client: str) -> Mapping[str, Any]:
        params_as(Nothing, request)
        self._stop()
        return {}

    def _job(self, request: Request) -> Job:
        return self._pipeline.store.get(params_as(JobRef, request).id)

    def _with_number(self, job: Job) -> dict[str, Any]:
        return {"number": self._last_event(), **job.status()}
