"""The pool's side of the talk with workers, without a process: who is known, who has what, what is sent again."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest

from scanner.capture import CaptureHeader, CaptureWriter, FrameRecord
from scanner.errors import StorageError
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, ProjectorSize
from scanner.stream import (
    Alive,
    Cancel,
    End,
    Frame,
    FromWorker,
    Identify,
    Leaving,
    PointsNote,
    Ready,
    Released,
    Result,
    Start,
    ToWorker,
)
from scanner.stream import decode_to_worker as decoded
from service.children import Child
from service.devices_link import DevicesLink
from service.series import Series
from service.worker_pool import WorkerPool


class Router:
    """A socket whose peers are this test."""

    def __init__(self) -> None:
        self.sent: list[ToWorker] = []
        self._incoming: asyncio.Queue[list[bytes]] = asyncio.Queue()

    async def recv_multipart(self) -> list[bytes]:
        return await self._incoming.get()

    def send_multipart(self, parts: Sequence[bytes], _flags: int, *, copy: bool) -> asyncio.Future[None]:
        self.sent.append(decoded(parts[1]))
        done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        done.set_result(None)
        return done

    async def say(self, *messages: FromWorker) -> None:
        for message in messages:
            self._incoming.put_nowait([b"w", msgspec.msgpack.encode(message)])
        for _ in range(10):
            await asyncio.sleep(0)

    def of(self, kind: type[Any]) -> list[Any]:
        return [message for message in self.sent if isinstance(message, kind)]


READY = Ready(protocol=(1, 0), worker="w", pid=0, host="h")


@asynccontextmanager
async def a_pool() -> AsyncIterator[tuple[WorkerPool, Router]]:
    router = Router()
    pool = WorkerPool(router, lambda *_: None, ())  # type: ignore[arg-type]
    pool.start(0)
    try:
        yield pool, router
    finally:
        await pool.close()


def captured(folder: Path, frames: int = 1) -> Series:
    """A series of a whole capture folder."""
    size = ProjectorSize(1152, 864)
    writer = CaptureWriter(folder, CaptureHeader(PatternSequence(size, McpPattern()), CameraFormat(4, 2)), frames)
    for _ in range(frames):
        writer.record(FrameRecord(slot=0, pattern=0))
    writer.close("complete")
    return series_of(folder)


def series_of(folder: Path) -> Series:
    series = Series("job", folder, folder.parent, {}, told=lambda _: None, delivering=lambda _: None)
    series.finish("completed")
    return series


async def test_a_worker_that_is_asked_twice_who_it_is_keeps_its_series(tmp_path: Path) -> None:
    async with a_pool() as (pool, router):
        series = captured(tmp_path / "capture")
        pool.submit(series)
        await router.say(Alive(), Alive())  # words to a daemon that has gone
        assert len(router.of(Identify)) == 2
        await router.say(READY, READY)
        (start,) = router.of(Start)
        assert [end.delivery for end in router.of(End)] == [start.delivery]
        await router.say(Result(start.delivery, []))
        assert series.outcome.done()


async def test_a_series_that_cannot_be_read_makes_way_for_the_next(tmp_path: Path) -> None:
    async with a_pool() as (pool, router):
        broken, whole = series_of(tmp_path / "nothing"), captured(tmp_path / "capture")
        pool.submit(broken)
        pool.submit(whole)
        await router.say(READY)
        (cancel,) = router.of(Cancel)
        await router.say(Released(cancel.delivery))
        assert isinstance(broken.outcome.exception(), StorageError)
        assert len(router.of(End)) == 1


async def test_a_damaged_line_costs_no_frame_behind_it(tmp_path: Path) -> None:
    frames = READY.credit + 5
    async with a_pool() as (pool, router):
        series = captured(tmp_path / "capture", frames)
        records = tmp_path / "capture" / "frames.jsonl"
        lines = records.read_bytes().splitlines(keepends=True)
        records.write_bytes(b"".join([b"{torn\n", *lines]))
        pool.submit(series)
        await router.say(READY)
        assert len(router.of(Frame)) == READY.credit
        assert not router.of(End)


async def test_points_are_told_once_their_frames_are_known_to_be_all(tmp_path: Path) -> None:
    told: list[Any] = []
    async with a_pool() as (pool, router):
        series = captured(tmp_path / "capture", 3)
        series.end, series.told = None, told.append
        pool.submit(series)
        await router.say(READY)
        (start,) = router.of(Start)
        await router.say(PointsNote(start.delivery, [], 2))
        series.whole(3)
        assert not told
        await router.say(PointsNote(start.delivery, [], 3))
        assert [note.frames for note in told] == [3]
        series.finish("completed")
        await router.say(PointsNote(start.delivery, []))  # of all, behind the end
        assert [note.frames for note in told] == [3, None]


async def test_points_of_a_worker_that_is_gone_are_not_told(tmp_path: Path) -> None:
    told: list[Any] = []
    async with a_pool() as (pool, router):
        series = captured(tmp_path / "capture")
        series.end, series.told = None, told.append
        pool.submit(series)
        await router.say(READY)
        await router.say(PointsNote(router.of(Start)[0].delivery, [], 1), Leaving())
        series.whole(1)
        assert not told


async def test_a_machine_without_processes_left_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = 0

    async def start(*_: Any, **__: Any) -> Child:
        nonlocal tried
        tried += 1
        raise OSError(11, "no more processes")

    monkeypatch.setattr(Child, "start", start)
    link = DevicesLink({}, lambda *_: None)
    for _ in range(2):
        with pytest.raises(Exception, match="cannot be started: no more processes"):
            await link.open()
    assert tried == 2
    assert link.answers

    pauses = []

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) > 2:
            raise asyncio.CancelledError

    monkeypatch.setattr("service.worker_pool.asyncio.sleep", sleep)
    pool = WorkerPool(Router(), lambda *_: None, ())  # type: ignore[arg-type]
    with pytest.raises(asyncio.CancelledError):
        await pool._keep_worker()
    assert pauses == [0.2, 0.4, 0.8]
