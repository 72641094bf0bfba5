"""A client's side of the conversation without any socket: what to send, and what an answer or event means.

`scanner.client` wraps it twice, blocking and for asyncio. Procedures of several calls are generators: they yield a
`Call` and are sent its result, so that both wrappers run the same ones.
"""

from __future__ import annotations

import hashlib
import logging
import os
import uuid
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from scanner.endpoints import ipc_path
from scanner.errors import ProtocolError, ScannerError, StorageError, Unreachable
from scanner.storage import storage_errors, sync_folder
from scanner.wire import (
    MAX_FETCH_BYTES,
    PROTOCOL,
    TERMINAL_STATES,
    WELCOME,
    ErrorBody,
    Event,
    FileEntry,
    Refused,
    Request,
    decode_event,
    decode_response,
    decoded,
    encode_request,
    error_from_body,
)

RESEND_S = 2.0
"""A call without an answer is sent again after this long: every method may be repeated (job_id), and a daemon that
was restarted has lost what was on its way to the old one."""

DEVICES_S = 90.0
"""How long calls may take that wait for devices: these are opened, and looked for by every driver (protocol.md)"""

WAIT_FOR_DEVICES = frozenset({"devices.list", "live.stop", "preview.start"})

QUIET_S = 2.0
"""After this long without an event the client asks for the job's state."""

STATE_OF_KIND = {
    **{state: state for state in ("queued", "acquired", "decoding", "decoded", "done", "failed", "cancelled")},
    **dict.fromkeys(("started", "plan", "frame", "retake"), "acquiring"),
}
"""The state that a job is in after an event of this kind."""

OnProgress = Callable[[str, int, int], None]
"""Told of a download: file, bytes so far, bytes in all (of all files)."""


@dataclass(frozen=True)
class Call:
    """A call that a procedure wants made; its result is sent back into the generator."""

    method: str
    params: Mapping[str, Any] = field(default_factory=dict)

    def patience_s(self, timeout_s: float) -> float:
        """How long its answer is waited for by a client that gives others `timeout_s`."""
        return max(timeout_s, DEVICES_S) if self.method in WAIT_FOR_DEVICES else timeout_s


_T = TypeVar("_T")
_log = logging.getLogger(__name__)
Procedure = Generator[Call | tuple[Call, ...], Any, _T]
"""Yields calls, one after another, and takes their results. Of a tuple, which are made at once, it takes a list of
results in their order; results that are bytes are then views. What a call fails with is raised where it was yielded."""


class _Raw(msgspec.Struct):
    """An answer whose result is not decoded yet."""

    id: int | str | None
    result: msgspec.Raw | msgspec.UnsetType = msgspec.UNSET
    error: ErrorBody | msgspec.UnsetType = msgspec.UNSET


_raw_answers: msgspec.msgpack.Decoder[_Raw] = msgspec.msgpack.Decoder(_Raw)
_BYTES_HEAD = {0xC4: 2, 0xC5: 3, 0xC6: 5}
"""MessagePack: first byte of bytes with a length of 8, 16, 32 bits, and how many bytes come before them"""


class Session:
    """One connection's correlation of answers with calls."""

    def __init__(self, name: str = "") -> None:
        self.name = name
        self._last_id = 0

    def hello(self) -> Call:
        """The first call of a connection, and of every new one."""
        return Call("hello", {"protocol": list(PROTOCOL), "client": self.name})

    def request(self, call: Call) -> tuple[int, bytes]:
        """Number a call: (id, bytes to send).

        Raises:
            ProtocolError: it cannot be encoded or is too long.
        """
        self._last_id += 1
        return self._last_id, encode_request(Request(id=self._last_id, method=call.method, params=dict(call.params)))

    @staticmethod
    def answer(data: bytes) -> tuple[int | str | None, Any]:
        """(id, result or ScannerError) of an answer.

        Raises:
            ProtocolError: it is none.
        """
        response = decode_response(data)
        if isinstance(response.error, ErrorBody):
            return response.id, error_from_body(response.error)
        return response.id, None if response.result is msgspec.UNSET else response.result

    @staticmethod
    def answer_in_place(data: memoryview) -> tuple[int | str | None, Any]:
        """`answer`, where a result that is bytes is a view of `data`, not a copy.

        Raises:
            ProtocolError: it is none.
        """
        response = decoded(_raw_answers, data, "an answer")
        if isinstance(response.error, ErrorBody):
            return response.id, error_from_body(response.error)
        if response.result is msgspec.UNSET:
            return response.id, None
        result = memoryview(response.result)
        if (head := _BYTES_HEAD.get(result[0])) is not None:
            return response.id, result[head:]
        return response.id, msgspec.msgpack.decode(result)

    @staticmethod
    def check_welcome(welcome: Mapping[str, Any]) -> dict[str, Any]:
        """Take hello's result: the endpoints by name.

        Raises:
            Refused: the daemon speaks another major version.
        """
        theirs = welcome.get("protocol")
        if not isinstance(theirs, list) or not theirs or theirs[0] != PROTOCOL[0]:
            raise Refused(
                f"the daemon speaks protocol {theirs!r}, this program {list(PROTOCOL)}",
                reason="protocol_version",
                hint="install the same version of fringed on both sides",
            )
        return dict(welcome.get("endpoints") or {})


def hello_required(outcome: Any) -> bool:
    """Whether an answer says that the daemon does not know this connection (it was restarted)."""
    return isinstance(outcome, Refused) and outcome.reason == "hello_required"


def unreachable(endpoint: str, what: str) -> Unreachable:
    """The error for a daemon that does not answer, with how to start one."""
    return Unreachable(
        f"no daemon at {endpoint}: {what}",
        hint=f"start one that listens there: fringed daemon CONFIG.toml --endpoint {endpoint}; or name another's with "
        "--connect",
    )


def socket_file(endpoint: str) -> Path:
    """The socket file to look for before connecting (ZeroMQ itself would wait for it for ever).

    Raises:
        Refused: not a local endpoint.
    """
    return Path(ipc_path(endpoint))


def start_call(method: str, job_id: str | None, params: Mapping[str, Any]) -> Call:
    """The call that starts a scan, with a fresh job id where none is given."""
    given = {key: value for key, value in params.items() if value is not None}
    return Call("scan.start", {"job_id": job_id or str(uuid.uuid4()), "method": method, **given})


def event_from(data: bytes) -> Event | None:
    """An event of the events socket; None for the welcome that says the subscription counts."""
    return None if data == WELCOME else decode_event(data)


class JobWatch:
    """Follows one job through events and, where some were lost, through its state.

    Feed it events; whenever `needs_state` is set, ask `scan.status` and give it the answer. `finished` is set once the
    job is in a terminal state.
    """

    def __init__(self, job_id: str) -> None:
        self.job_id = job_id
        self.needs_state = True
        self.finished = False
        self._number: int | None = None
        self._state = ""

    def event(self, event: Event | None) -> list[Event]:
        """Take the next event, or None after `QUIET_S` of silence or a new subscription; returns what is news."""
        if event is None:
            self.needs_state = True
            return []
        if self._number is not None and event.number <= self._number and not self.needs_state:
            # Older than the snapshot, or numbered by a daemon that was started since.
            self.needs_state = event.number == 1
            return []
        if self._number is None or event.number != self._number + 1:
            self.needs_state = True
        self._number = event.number
        if event.job != self.job_id:
            return []
        self._state = STATE_OF_KIND.get(event.kind, self._state)
        self.finished = event.kind in TERMINAL_STATES
        return [event]

    def state(self, status: Mapping[str, Any]) -> list[Event]:
        """Take `scan.status`; returns an event that stands for those lost, if the state is news."""
        self.needs_state = False
        self._number = int(status["number"])
        state = str(status["state"])
        self.finished = state in TERMINAL_STATES
        if state == self._state:
            return []
        self._state = state
        return [Event(self._number, state, self.job_id, {**status, "snapshot": True})]


def raise_unless_done(outcome: Mapping[str, Any]) -> None:
    """Raise the error of a job that did not end well.

    Raises:
        ScannerError: of the class the daemon named, with its hint.
    """
    if outcome["state"] != "done":
        raise error_of(outcome)


def error_of(outcome: Mapping[str, Any]) -> ScannerError:
    """The error of a job that did not end well, of the class that the daemon named, with its hint."""
    body = outcome.get("error")
    if body:
        return error_from_body(msgspec.convert(body, ErrorBody))
    return ScannerError(f"scan {outcome.get('id')} is {outcome['state']}: {outcome.get('reason')}")


def fetch(
    job_id: str, folder: Path, on_progress: OnProgress | None = None, *, failed_too: bool = False
) -> Procedure[Path]:
    """Bring all of a scan's files: each is checked against its digest and appears whole or not at all.

    Then the scan is acknowledged. Where that fails the files are here all the same: it is logged as a warning.

    Args:
        job_id: the job.
        folder: where the files go; it is made.
        on_progress: told of each piece.
        failed_too: also of a job that failed: the frames that it had recorded by then.

    Raises:
        ScannerError: the job did not end well.
        StorageError: no room, or a file arrived damaged; under its name is nothing then, and it may be fetched again.
    """
    outcome = yield Call("scan.result", {"id": job_id})
    if not failed_too:
        raise_unless_done(outcome)
    files = [msgspec.convert(entry, FileEntry) for entry in outcome["files"]]
    total = sum(entry.bytes for entry in files)
    before = 0
    for entry in files:
        yield from _fetch_file(job_id, entry, _target(folder, entry.name), on_progress, before, total)
        before += entry.bytes
    try:
        yield Call("scan.acknowledge", {"id": job_id})
    except ScannerError as error:
        _log.warning("scan %s is fetched, but not acknowledged: the daemon keeps its files (%s)", job_id, error)
    return folder


def _fetch_file(
    job_id: str, entry: FileEntry, target: Path, on_progress: OnProgress | None, before: int, total: int
) -> Procedure[None]:
    partial = target.with_name(f".{target.name}.part")
    with storage_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            with partial.open("wb") as file:
                sha = hashlib.sha256()
                got = 0
                while got < entry.bytes:
                    length = min(MAX_FETCH_BYTES, entry.bytes - got)
                    piece = yield Call(
                        "scan.fetch", {"id": job_id, "name": entry.name, "offset": got, "length": length}
                    )
                    if not isinstance(piece, bytes) or not 0 < len(piece) <= length:
                        raise ProtocolError(f"scan.fetch of {entry.name} at {got} gave no bytes")
                    file.write(piece)
                    sha.update(piece)
                    got += len(piece)
                    if on_progress is not None:
                        on_progress(entry.name, before + got, total)
                file.flush()
                os.fsync(file.fileno())
            if sha.hexdigest() != entry.sha256:
                raise StorageError(f"{entry.name} arrived damaged: its SHA-256 differs", hint="fetch it again")
            partial.replace(target)
            sync_folder(target.parent)
        finally:
            partial.unlink(missing_ok=True)


def _target(folder: Path, name: str) -> Path:
    path = (folder / name).resolve()
    if not path.is_relative_to(folder.resolve()) or path == folder.resolve():
        raise ProtocolError(f"the daemon named a file {name!r} outside of the folder")
    return path
