"""The worker: its two threads, of which the one that talks never outlives the other, and what it says to whom."""

from __future__ import annotations

from pathlib import Path
from threading import Event

import pytest
import zmq

from scanner.errors import ScannerError
from scanner.stream import Alive, Ready, decode_from_worker
from service import work
from service.worker import Worker


def test_a_worker_whose_decoder_died_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    worker = Worker(f"ipc://{tmp_path}/worker.ipc", decode=False)
    monkeypatch.setattr(worker._work, "serve", lambda jobs: None)
    monkeypatch.setattr("service.worker.CONNECT_MS", 0)
    with pytest.raises(ScannerError, match="decoding thread died"):
        worker.run()


def test_nothing_waits_for_a_daemon_that_is_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint = f"ipc://{tmp_path}/worker.ipc"
    worker = Worker(endpoint, decode=False)
    for _ in range(3):
        worker._say(Alive())
    monkeypatch.setattr(worker._work, "serve", lambda jobs: None)
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        router.bind(endpoint)
        with pytest.raises(ScannerError):
            worker.run()
        assert router.poll(5000)
        first = decode_from_worker(router.recv_multipart()[1])
    assert isinstance(first, Ready)


def test_decoders_are_made_ready_without_the_broken_one_and_no_more_once_the_worker_ends(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    ready, ending = list[str](), Event()

    class Module:
        def __init__(self, name: str) -> None:
            self.name = name

        def warm_up(self) -> None:
            if self.name.endswith("broken"):
                raise ValueError("no kernel")
            ready.append(self.name)

    monkeypatch.setattr(work, "modules_with_kernels", lambda: ["scanner.broken", "scanner.sound"])
    monkeypatch.setattr("importlib.import_module", Module)
    work._warm_up(ending)
    assert ready == ["scanner.sound"]
    assert "scanner.broken could not be made ready" in caplog.text
    ending.set()
    work._warm_up(ending)
    assert ready == ["scanner.sound"]
