"""Too many connections: nobody else may connect, those who are connected stay, and libzmq never ends the process."""

from __future__ import annotations

import asyncio
import resource
import socket
import stat
import struct
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
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
        admission = Admission({endpoint: router})
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
        admission.close()
        context.destroy(linger=0)
    assert [left.name for left in tmp_path.iterdir()] == ["c.ipc"]


SERVING = textwrap.dedent("""
    import resource, sys, zmq
    from scanner.clock import VirtualClock
    from service.descriptors import Admission
    from service.live_work import _Publisher
    from service.pipe import Preview
    from service.preview import Previewer
    from service.sockets import bound
    limit, looks, control, live, preview = int(sys.argv[1]), sys.argv[2] == "looks", *sys.argv[3:]
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, limit))
    if not looks:
        Admission._watch = lambda self: None
    context = zmq.Context()
    admission = Admission({control: bound(context, zmq.ROUTER, control)})
    publisher, previewer = _Publisher(live), Previewer(None, VirtualClock(), Preview(preview, 10.0, 320))
    print("ready", flush=True)
    sys.stdin.read()
    if looks:
        publisher.close()
        for each, of in ((previewer._admission, previewer._context), (admission, context)):
            each.close()
            of.destroy(linger=0)
""")
NAMES = ("control.ipc", "live.ipc", "preview.ipc")


@contextmanager
def serving(folder: Path, limit: int, *, looks: bool) -> Iterator[subprocess.Popen[bytes]]:
    """A process with each kind of socket that clients connect to."""
    words = [str(limit), "looks" if looks else "is kept from it", *(f"ipc://{folder / name}" for name in NAMES)]
    with subprocess.Popen(
        [sys.executable, "-c", SERVING, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        yield process
        if not looks:
            process.kill()


def connect(path: Path, most: int) -> list[socket.socket]:
    """Connections, as many and as fast as can be had."""
    callers: list[socket.socket] = []
    while len(callers) < most:
        caller = socket.socket(socket.AF_UNIX)
        caller.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", 0, 100_000))
        try:
            caller.connect(str(path))
        except OSError:  # the file is gone, or nobody is accepted any more
            caller.close()
            break
        callers.append(caller)
    return callers


async def test_hundreds_of_connections_are_too_many_where_the_limit_cannot_be_raised(tmp_path: Path) -> None:
    with serving(tmp_path, 1024, looks=True) as process:
        for path in (tmp_path / name for name in NAMES):
            await until(path, True)
            callers = connect(path, 600)
            await until(path, False)
            with pytest.raises(FileNotFoundError), socket.socket(socket.AF_UNIX) as another:
                another.connect(str(path))
            for each in callers:
                each.close()
            for name in NAMES:
                await until(tmp_path / name, True)
        assert process.poll() is None
    assert process.returncode == 0
    assert list(tmp_path.glob("*.full")) == []


def test_no_haste_reaches_the_limit_of_a_process_that_is_kept_from_looking(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    with serving(tmp_path, descriptors.LEAST_SURE, looks=False) as process:
        callers = [caller for name in NAMES for caller in connect(tmp_path / name, descriptors.LEAST_SURE)]
        open_there = len(list(Path(f"/proc/{process.pid}/fd").iterdir()))
        assert process.poll() is None
        for each in callers:
            each.close()
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert 2000 < open_there < descriptors.LEAST_SURE


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
