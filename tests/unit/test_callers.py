"""The control socket's callers: all are answered, in turn, also beside one who asks without end or never reads."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
import zmq
import zmq.asyncio

from service import callers
from service.callers import ANSWERS_HELD, AT_ONCE, Callers
from service.sockets import bound

FLOOD = 3000


@asynccontextmanager
async def serving(folder: Path, answer: callers.Answer) -> AsyncIterator[Callable[[], zmq.asyncio.Socket]]:
    """Callers on a socket of their own; yields what connects another one."""
    endpoint = f"ipc://{folder}/c.ipc"
    with zmq.asyncio.Context() as context:
        router = bound(context, zmq.ROUTER, endpoint, high_water=ANSWERS_HELD)
        task = asyncio.create_task(Callers(router, answer, lambda body, waiting: b"refused").serve())

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
