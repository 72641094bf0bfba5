"""The control socket's callers: all are answered, in turn, also beside one who asks without end or never reads."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
import zmq
import zmq.asyncio

from service import callers
from service.callers import ANSWERS_HELD, AT_ONCE, CALLS_HELD, Callers
from service.sockets import bound

FLOOD = 3000
LONGEST = 1000


Answer = Callable[[bytes, list[bytes]], Awaitable[bytes]]


class Asked:
    """A service that answers as it is told."""

    def __init__(self, answer: Answer) -> None:
        self._answer = answer

    async def answer(self, identity: bytes, body: list[bytes]) -> bytes:
        return await self._answer(identity, body)

    def refuse(self, _body: list[bytes], _waiting: int) -> bytes:
        return b"refused"

    def refuse_long(self, length: int) -> bytes:
        return b"%d are too many" % length


@asynccontextmanager
async def serving(folder: Path, answer: Answer) -> AsyncIterator[Callable[[], zmq.asyncio.Socket]]:
    """Callers on a socket of their own; yields what connects another one."""
    endpoint = f"ipc://{folder}/c.ipc"
    with zmq.asyncio.Context() as context:
        router = bound(context, zmq.ROUTER, endpoint, high_water=ANSWERS_HELD, received=CALLS_HELD)
        task = asyncio.create_task(Callers(router, Asked(answer), LONGEST).serve())

        def connected() -> zmq.asyncio.Socket:
            dealer = context.socket(zmq.DEALER)
            dealer.setsockopt(zmq.LINGER, 0)
            dealer.setsockopt(zmq.RCVHWM, 10)
            dealer.connect(endpoint)
            return dealer

        try:
            yield connected
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            context.destroy(linger=0)


async def read(socket: zmq.asyncio.Socket) -> bytes:
    async with asyncio.timeout(10):
        return await socket.recv()  # type: ignore[no-any-return]


async def echo(_caller: bytes, body: list[bytes]) -> bytes:
    return body[0] + bytes(4000)


async def test_a_flood_is_answered_whole_and_keeps_nobody_waiting(tmp_path: Path) -> None:
    answered = 0

    async def counted(caller: bytes, body: list[bytes]) -> bytes:
        nonlocal answered
        answered += 1
        return await echo(caller, body)

    async with serving(tmp_path, counted) as connected:
        many, one = connected(), connected()
        for number in range(FLOOD):
            await many.send(b"%d" % number)
        await one.send(b"one")
        assert (await read(one)).startswith(b"one")
        assert answered < FLOOD, "it did not read, and was worked for all the same"
        found = [int((await read(many)).rstrip(b"\0")) for _ in range(FLOOD)]
        assert sorted(found) == list(range(FLOOD))


async def test_slow_calls_of_one_leave_room_for_others(tmp_path: Path) -> None:
    go, begun = asyncio.Event(), 0

    async def slow(_caller: bytes, body: list[bytes]) -> bytes:
        nonlocal begun
        if body == [b"slow"]:
            begun += 1
            await go.wait()
        return body[0]

    async with serving(tmp_path, slow) as connected:
        many, one = connected(), connected()
        for _ in range(3 * AT_ONCE):
            await many.send(b"slow")
        for number in range(3):
            await one.send(b"%d" % number)
            assert await read(one) == b"%d" % number
        while begun < AT_ONCE:
            await asyncio.sleep(0)
        await one.send(b"-")
        assert await read(one) == b"-"
        assert begun == AT_ONCE
        go.set()
        assert [await read(many) for _ in range(3 * AT_ONCE)] == [b"slow"] * 3 * AT_ONCE


async def test_every_refusal_reaches_a_flooding_caller_that_reads_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(callers, "MAX_WAITING", 5)
    async with serving(tmp_path, echo) as connected:
        many, one = connected(), connected()
        for number in range(FLOOD):
            await many.send(b"%d" % number)
        await one.send(b"one")
        assert (await read(one)).startswith(b"one")
        found = [await read(many) for _ in range(FLOOD)]
        assert found.count(b"refused") > FLOOD / 2
        assert len([answer for answer in found if answer != b"refused"]) >= AT_ONCE


async def test_what_is_too_much_is_refused_and_a_caller_that_left_forgotten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(callers, "MAX_WAITING", 5)
    go = asyncio.Event()

    async def slow(_caller: bytes, _body: list[bytes]) -> bytes:
        await go.wait()
        return b"done"

    async with serving(tmp_path, slow) as connected:
        many, gone = connected(), connected()
        await gone.send(b"and away")
        for _ in range(AT_ONCE + 5 + 2):
            await many.send(b"x")
        assert [await read(many) for _ in range(2)] == [b"refused"] * 2
        gone.close()
        go.set()
        assert [await read(many) for _ in range(AT_ONCE + 5)] == [b"done"] * (AT_ONCE + 5)


async def test_calls_are_begun_in_turn_one_of_each_caller(tmp_path: Path) -> None:
    """A caller that has much to ask is no reason for another to wait for more than one of its calls."""
    begun: list[bytes] = []

    async def noted(_caller: bytes, body: list[bytes]) -> bytes:
        begun.append(body[0][:1])
        return body[0]

    async with serving(tmp_path, noted) as connected:
        first, second = connected(), connected()
        for one in (first, second):  # connected, and known by their answers
            await one.send(b"-")
            await read(one)
        for number in range(4 * CALLS_HELD):
            await first.send(b"a%d" % number)
        await second.send(b"b")
        assert await read(second) == b"b"
        for _ in range(4 * CALLS_HELD):
            await read(first)
        assert begun[2:].index(b"b") <= CALLS_HELD + 1


async def test_calls_that_are_too_long_are_refused_and_never_held(tmp_path: Path) -> None:
    begun = 0

    async def counted(_caller: bytes, body: list[bytes]) -> bytes:
        nonlocal begun
        begun += 1
        return body[0]

    async with serving(tmp_path, counted) as connected:
        many, one = connected(), connected()
        for _ in range(100):
            await many.send(bytes(LONGEST + 1))
        await one.send(bytes(LONGEST))
        assert await read(one) == bytes(LONGEST)
        assert [await read(many) for _ in range(100)] == [b"1001 are too many"] * 100
        assert begun == 1


async def test_whoever_has_calls_waiting_adds_none_while_all_hold_too_much(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(callers, "ALL_WAITING_BYTES", 3 * LONGEST)
    monkeypatch.setattr(callers, "AT_ONCE", 1)
    go, begun = asyncio.Event(), asyncio.Event()

    async def slow(_caller: bytes, body: list[bytes]) -> bytes:
        begun.set()
        await go.wait()
        return body[0]

    async with serving(tmp_path, slow) as connected:
        many, one = connected(), connected()
        await many.send(bytes(LONGEST))
        await begun.wait()
        for _ in range(4):
            await many.send(bytes(LONGEST))
        assert await read(many) == b"refused"
        await one.send(bytes(LONGEST))
        go.set()
        assert await read(one) == bytes(LONGEST)
        assert [await read(many) for _ in range(4)] == [bytes(LONGEST)] * 4


async def test_of_one_who_went_away_not_all_calls_are_worked_on(tmp_path: Path) -> None:
    go, begun = asyncio.Event(), 0

    async def slow(_caller: bytes, body: list[bytes]) -> bytes:
        nonlocal begun
        begun += body == [b"gone"]
        await go.wait()
        return body[0]

    async with serving(tmp_path, slow) as connected:
        many, one = connected(), connected()
        for _ in range(10 * AT_ONCE):
            await many.send(b"gone")
        await one.send(b"-")
        while begun < AT_ONCE:
            await asyncio.sleep(0)
        many.close()
        await asyncio.sleep(0.02)
        go.set()
        assert await read(one) == b"-"
        await one.send(b"-")
        assert await read(one) == b"-"
        assert AT_ONCE <= begun <= 4 * AT_ONCE
