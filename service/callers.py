"""The control socket's callers: every call is answered, and nobody's many calls keep another's waiting.

A caller's calls wait in a queue of its own. Those that wait are begun in turn, one of each caller, and of one only so
many are at work at once. Calls that are too long never wait: they are refused as they come, and nobody looks into them.
Answers that a caller does not read stay here until it does, and its next calls wait with them: ZeroMQ would drop what
its own queue does not hold. Everything that is held has a bound in bytes. What a call does is not known here.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Awaitable
from dataclasses import dataclass, field
from typing import Protocol

import zmq
import zmq.asyncio

from service.sockets import Sent, try_send

AT_ONCE = 16
"""Calls of one caller that are worked on at the same time: some wait for devices or disk, and others may pass them."""

MAX_WAITING = 32_768
"""Calls of one caller that may wait; more are refused."""

MAX_WAITING_BYTES = 4 << 20
"""The same by their length."""

ALL_WAITING_BYTES = 64 << 20
"""The same of all callers; beyond, whoever has calls waiting may not add to them."""

CALLS_HELD = 4
"""Calls of one caller that ZeroMQ holds, of 2 MiB at most each; beyond, it reads no more and the caller has to wait."""

ANSWERS_HELD = 32
"""Answers that ZeroMQ holds for one caller: a caller that fetches and never reads costs 128 MB of memory, not 40 GB."""

REFUSALS_HELD, REFUSAL_BYTES = 8192, 1024
"""Refusals that wait for a caller that floods and does not read, and the length up to which one may (it repeats the
call's id): 8 MB at most. Calls beyond are dropped without a word, as nothing else has a bound."""

ALL_UNREAD = 65_536
"""Unread answers of all callers with which no further refusal waits"""

BATCH = 64
"""Calls taken from the socket before everything else has its turn."""

RETRY_S, RETRY_MOST_S = 0.001, 1.0
"""Pause before a caller that does not read is tried again: doubled each time, up to the second."""

_log = logging.getLogger(__name__)


class Service(Protocol):
    """What makes the answers."""

    async def answer(self, identity: bytes, body: list[bytes]) -> bytes:
        """Of a caller's identity and a call's parts, the answer's bytes."""

    def refuse(self, body: list[bytes], waiting: int) -> bytes:
        """The answer to a call that is one too many, of its parts and the number that wait."""

    def refuse_long(self, length: int) -> bytes:
        """The answer to a call of too many bytes."""


@dataclass(eq=False)
class _Caller:
    """One connection: what it asked and was not yet told."""

    identity: bytes
    waiting: deque[tuple[list[bytes], list[bytes]]] = field(default_factory=deque)
    """address and parts of calls that nobody works on yet"""
    waiting_bytes: int = 0
    at_work: int = 0
    unread: deque[list[bytes]] = field(default_factory=deque)
    """answers that it has no room for"""
    in_line: bool = False
    """it is among those of whom a call is begun next"""

    @property
    def idle(self) -> bool:
        return not (self.waiting or self.at_work or self.unread)

    @property
    def can_begin(self) -> bool:
        return bool(self.waiting) and self.at_work < AT_ONCE and not self.unread


class Callers:
    """All that are connected to one ROUTER socket. `serve` takes their calls until it is cancelled."""

    def __init__(self, socket: zmq.asyncio.Socket, service: Service, longest: int) -> None:
        """`longest`: bytes of a call that is looked at."""
        self._socket = socket
        self._plain: zmq.Socket[bytes] = zmq.Socket.shadow(socket.underlying)
        self._service = service
        self._longest = longest
        self._callers: dict[bytes, _Caller] = {}
        self._line: deque[_Caller] = deque()
        self._somebody = asyncio.Event()
        self._waiting_bytes = 0
        self._unread = 0
        self._tasks: set[asyncio.Task[None]] = set()

    async def serve(self) -> None:
        """Take calls and have them answered."""
        self._spawn(self._begin_in_turn())
        try:
            while True:
                self._take(await self._socket.recv_multipart(copy=False))
                # ROUTER takes from its callers in turn: a flood by one leaves every other place of the batch free.
                for _ in range(BATCH - 1):
                    try:
                        frames = self._plain.recv_multipart(zmq.DONTWAIT, copy=False)
                    except zmq.Again:
                        break
                    self._take(frames)
                await asyncio.sleep(0)
        finally:
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)

    def _take(self, frames: list[zmq.Frame]) -> None:
        caller = self._caller(frames[0].bytes)
        # A REQ socket puts an empty part between address and message; it gets one back.
        delimited = len(frames) > 2 and not len(frames[1])
        address = [caller.identity, b""] if delimited else [caller.identity]
        parts = frames[len(address) :]
        length = sum(len(part) for part in parts)
        if length > self._longest:
            self._tell(caller, [*address, self._service.refuse_long(length)], refusal=True)
            return
        body = [part.bytes for part in parts]
        if (
            len(caller.waiting) + caller.at_work >= MAX_WAITING + AT_ONCE
            or caller.waiting_bytes + length > MAX_WAITING_BYTES
            or (caller.waiting and self._waiting_bytes + length > ALL_WAITING_BYTES)
        ):
            self._tell(caller, [*address, self._service.refuse(body, len(caller.waiting))], refusal=True)
            return
        caller.waiting.append((address, body))
        caller.waiting_bytes += length
        self._waiting_bytes += length
        self._put_in_line(caller)

    def _caller(self, identity: bytes) -> _Caller:
        if (caller := self._callers.get(identity)) is None:
            caller = self._callers[identity] = _Caller(identity)
        return caller

    def _put_in_line(self, caller: _Caller) -> None:
        if caller.can_begin and not caller.in_line:
            caller.in_line = True
            self._line.append(caller)
            self._somebody.set()

    async def _begin_in_turn(self) -> None:
        """One call of each caller that has any, then the next of each; all that is at work has its turn after each."""
        while True:
            await self._somebody.wait()
            while self._line:
                caller = self._line.popleft()
                caller.in_line = False
                if caller.can_begin:
                    self._begin(caller)
                    self._put_in_line(caller)
                    await asyncio.sleep(0)
            self._somebody.clear()

    def _begin(self, caller: _Caller) -> None:
        address, body = caller.waiting.popleft()
        self._let_go(caller, body)
        caller.at_work += 1
        self._spawn(self._work(caller, address, body))

    async def _work(self, caller: _Caller, address: list[bytes], body: list[bytes]) -> None:
        try:
            self._tell(caller, [*address, await self._service.answer(caller.identity, body)])
        finally:
            caller.at_work -= 1
            self._put_in_line(caller)
            self._forget(caller)

    def _tell(self, caller: _Caller, message: list[bytes], *, refusal: bool = False) -> None:
        outcome = Sent.FULL if caller.unread else try_send(self._socket, message)
        if outcome is Sent.GONE:
            _log.debug("a client went away before its answer came")
            # What it asked last was perhaps to be done all the same (shutdown); nobody waits for all of a flood.
            while len(caller.waiting) > AT_ONCE:
                self._let_go(caller, caller.waiting.pop()[1])
        if outcome is Sent.FULL and not (refusal and self._is_much(caller, message)):
            self._unread += 1
            caller.unread.append(message)
            if len(caller.unread) == 1:
                self._spawn(self._tell_later(caller))
        else:
            self._forget(caller)

    def _let_go(self, caller: _Caller, body: list[bytes]) -> None:
        length = sum(len(part) for part in body)
        caller.waiting_bytes -= length
        self._waiting_bytes -= length

    def _is_much(self, caller: _Caller, message: list[bytes]) -> bool:
        held = len(caller.unread)
        return len(message[-1]) > REFUSAL_BYTES or held >= REFUSALS_HELD or self._unread >= ALL_UNREAD

    async def _tell_later(self, caller: _Caller) -> None:
        """Tell a caller that does not read what it was not told, when it has room."""
        pause = RETRY_S
        while caller.unread:
            await asyncio.sleep(pause)
            before = len(caller.unread)
            while caller.unread and try_send(self._socket, caller.unread[0]) is not Sent.FULL:
                caller.unread.popleft()
                self._unread -= 1
            pause = min(2 * pause, RETRY_MOST_S) if len(caller.unread) == before else RETRY_S
        self._put_in_line(caller)
        self._forget(caller)

    def _forget(self, caller: _Caller) -> None:
        if caller.idle and self._callers.get(caller.identity) is caller:
            del self._callers[caller.identity]

    def _spawn(self, work: Awaitable[None]) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
