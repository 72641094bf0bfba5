"""Too many connections: nobody else may connect, those who are connected stay, and libzmq never ends the process."""

from __future__ import annotations

import asyncio
import resource
import socket
import stat
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
import zmq
import zmq.asyncio

from service import descriptors
from service.descriptors import Admission, open_descriptors, raise_limit
from service.sockets import bound


async def until(path: Path, there: bool) -> None:
    async with asyncio.timeout(10):
        while path.exists() is not there:
            await asyncio.sleep(0.005)


async def test_nobody_connects_while_many_descriptors_are_in_use_and_who_is_connected_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoint, path = f"ipc://{tmp_path}/c.ipc", tmp_path / "c.ipc"
    monkeypatch.setattr(descriptors, "REOPEN_S", 0.01)
    with zmq.asyncio.Context() as context:
        router, dealer = bound(context, zmq.ROUTER, endpoint), context.socket(zmq.DEALER)
        monkeypatch.setattr(descriptors, "MOST_USED", 4 * (open_descriptors() + 20))
        watching = asyncio.create_task(Admission({endpoint: router}).watch())
        dealer.connect(endpoint)
        await dealer.send(b"1")
        first = await router.recv_multipart()
        others = [socket.socket(socket.AF_UNIX) for _ in range(descriptors.MOST_USED)]
        others[0].connect(str(path))  # the descriptors of all are in use: the first to connect has it noticed
        await until(path, False)
        with pytest.raises(FileNotFoundError):
            others[1].connect(str(path))
        await dealer.send(b"2")
        assert await router.recv_multipart() == [first[0], b"2"]
        for each in others:
            each.close()
        await until(path, True)
        assert stat.S_IMODE(path.stat().st_mode) == 0o660
        with socket.socket(socket.AF_UNIX) as again:
            again.connect(str(path))
        await dealer.send(b"3")
        assert await router.recv_multipart() == [first[0], b"3"]
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)
        context.destroy(linger=0)
    assert [left.name for left in tmp_path.iterdir()] == ["c.ipc"]


SERVING = textwrap.dedent("""
    import asyncio, resource, sys, zmq, zmq.asyncio
    from service.descriptors import Admission
    from service.sockets import bound
    resource.setrlimit(resource.RLIMIT_NOFILE, (1024, 1024))
    async def main():
        with zmq.asyncio.Context() as context:
            endpoint = sys.argv[1]
            router = bound(context, zmq.ROUTER, endpoint)
            watching = asyncio.create_task(Admission({endpoint: router}).watch())
            await asyncio.sleep(0)
            print("ready", flush=True)
            await asyncio.to_thread(sys.stdin.read)
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)
            context.destroy(linger=0)
    asyncio.run(main())
""")


def test_more_connections_than_there_may_be_descriptors_do_not_end_the_process(tmp_path: Path) -> None:
    path = tmp_path / "c.ipc"
    serving = subprocess.Popen(
        [sys.executable, "-c", SERVING, f"ipc://{path}"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert serving.stdin is not None
    assert serving.stdout is not None
    assert serving.stdout.readline() == b"ready\n"
    callers = []
    try:
        for count in range(900):
            if count % 50 == 0:
                time.sleep(0.002)  # two cores may have other work: this is no race
            callers.append(socket.socket(socket.AF_UNIX))
            try:
                callers[-1].connect(str(path))
            except (FileNotFoundError, ConnectionRefusedError):
                break
        assert len(callers) < 900
        assert serving.poll() is None
    finally:
        for each in callers:
            each.close()
        serving.communicate(timeout=10)
    assert serving.returncode == 0
    assert [left.name for left in tmp_path.iterdir()] == ["c.ipc"]


def test_the_limit_is_raised_as_far_as_it_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "setrlimit", lambda _what, limits: given.append(limits))
    endless = resource.RLIM_INFINITY
    for limits in (
        (1024, 4096),
        (1024, endless),
        (1024, 1 << 30),
        (1024, 1024),
        (endless, endless),
        (100_000, 200_000),
    ):
        monkeypatch.setattr(resource, "getrlimit", lambda _what, limits=limits: limits)
        raise_limit()
    assert given == [(4096, 4096), (65_536, endless), (65_536, 1 << 30)]
