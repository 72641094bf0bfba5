"""The control socket's callers: every call is answered, and nobody's many calls keep another's waiting.

A caller's calls wait in a queue of its own, and only so many of them are worked on at once. Answers that a caller does
not read stay here until it does, and its next calls wait with them: ZeroMQ would drop what its own queue does not hold.
What a call does is not known here.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

import zmq
import zmq.asyncio

from service.sockets import Sent, try_send

AT_ONCE = 16
"""Calls of one caller that are worked on at the same time: some wait for devices or disk, and others may pass them."""

MAX_WAITING = 32_768
"""Calls of one caller that may wait; more are refused."""

MAX_WAITING_BYTES = 16 << 20
"""The same by their length."""

ANSWERS_HELD = 32
"""Answers that ZeroMQ holds for one caller: a caller that fetches and never reads costs 128 MB of memory, not 40 GB."""

REFUSALS_HELD, REFUSAL_BYTES = 32_768, 1024
"""Answers that wait for a caller that floods and does not read, and the length up to which a refusal may be one of them
(it repeats the call's id): 32 MB at most. Calls beyond are dropped without a word, as nothing else has a bound."""

BATCH = 64
"""Calls taken from the socket before everything else has its turn."""

RETRY_S, RETRY_MOST_S = 0.001, 1.0
"""Pause before a caller that does not read is tried again: doubled each time, up to the second."""

Answer = Callable[[bytes, list[bytes]], Awaitable[bytes]]
"""Of a caller's identity and a call's parts, the answer's bytes."""

_log = logging.getLogger(__name__)


@dataclass
class _Caller:
    """One connection: what it asked and was not yet told."""

    waiting: deque[tuple[list[bytes], list[bytes]]] = field(default_factory=deque)
    """address and parts of calls that nobody works on yet"""
    waiting_bytes: int = 0
    at_work: int = 0
    unread: deque[list[bytes]] = field(default_factory=deque)
    """answers that it has no room for"""

    @property
    def idle(self) -> bool:
        return not (self.waiting or self.at_work or self.unread)


class Callers:
    """All that are connected to one ROUTER socket. `serve` takes their calls until it is cancelled."""

    def __init__(self, socket: zmq.asyncio.Socket, answer: Answer, refuse: Callable[[list[bytes], int], bytes]) -> None:
        """`refuse` gives the answer to a call that is one too many, of its parts and the number that wait."""
        self._socket = socket
        self._plain: zmq.Socket[bytes] = zmq.Socket.shadow(socket.underlying)
        self._answer = answer
        self._refuse = refuse
        self._callers: dict[bytes, _Caller] = {}
        self._tasks: set[asyncio.Task[None]] = set()

    async def serve(self) -> None:
        """Take calls and have them answered."""
        try:
            while True:
                self._take(await self._socket.recv_multipart())
                # ROUTER takes from its callers in turn: a flood by one leaves every other place of the batch free.
                for _ in range(BATCH - 1):
                    try:
                        parts = self._plain.recv_multipart(zmq.DONTWAIT)
                    except zmq.Again:
                        break
                    self._take(parts)
                await asyncio.sleep(0)
        finally:
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)

    def _take(self, parts: list[bytes]) -> None:
        # A REQ socket puts an empty part between address and message; it gets one back.
        address = parts[:2] if len(parts) > 2 and not parts[1] else parts[:1]
        body = parts[len(address) :]
        caller = self._callers.setdefault(address[0], _Caller())
        length = sum(len(part) for part in body)
        if len(caller.waiting) >= MAX_WAITING or caller.waiting_bytes + length > MAX_WAITING_BYTES:
            refusal = self._refuse(body, len(caller.waiting))
            fits = len(refusal) <= REFUSAL_BYTES and len(caller.unread) < REFUSALS_HELD
            self._tell(caller, [*address, refusal], may_wait=fits)
            return
        caller.waiting.append((address, body))
        caller.waiting_bytes += length
        self._begin(caller)

    def _begin(self, caller: _Caller) -> None:
        while caller.waiting and caller.at_work < AT_ONCE and not caller.unread:
            address, body = caller.waiting.popleft()
            caller.waiting_bytes -= sum(len(part) for part in body)
            caller.at_work += 1
            self._spawn(self._work(caller, address, body))

    async def _work(self, caller: _Caller, address: list[bytes], body: list[bytes]) -> None:
        try:
            self._tell(caller, [*address, await self._answer(address[0], body)])
        finally:
            caller.at_work -= 1
            self._begin(caller)
            self._forget(address[0], caller)

    def _tell(self, caller: _Caller, message: list[bytes], *, may_wait: bool = True) -> None:
        outcome = Sent.FULL if caller.unread else try_send(self._socket, message)
        if outcome is Sent.GONE:
            _log.info("a client went away before its answer came")
        if outcome is Sent.FULL and may_wait:
            caller.unread.append(message)
            if len(caller.unread) == 1:
                self._spawn(self._tell_later(caller))

    async def _tell_later(self, caller: _Caller) -> None:
        """Tell a caller that does not read what it was not told, when it has room."""
        pause, identity = RETRY_S, caller.unread[0][0]
        while caller.unread:
            await asyncio.sleep(pause)
            before = len(caller.unread)
            while caller.unread and try_send(self._socket, caller.unread[0]) is not Sent.FULL:
                caller.unread.popleft()
            pause = min(2 * pause, RETRY_MOST_S) if len(caller.unread) == before else RETRY_S
        self._begin(caller)
        self._forget(identity, caller)

    def _forget(self, identity: bytes, caller: _Caller) -> None:
        if caller.idle and self._callers.get(identity) is caller:
            del self._callers[identity]

    def _spawn(self, work: Awaitable[None]) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
