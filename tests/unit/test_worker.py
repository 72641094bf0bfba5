"""The worker's two threads: the one that talks never outlives the one that decodes."""

from __future__ import annotations

from pathlib import Path

import pytest

from scanner.errors import ScannerError
from service import work
from service.worker import Worker


def test_a_worker_whose_decoder_died_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    worker = Worker(f"ipc://{tmp_path}/worker.ipc", decode=False)
    monkeypatch.setattr(worker._work, "serve", lambda jobs: None)
    with pytest.raises(ScannerError, match="decoding thread died"):
        worker.run()


def test_one_decoder_that_cannot_be_made_ready_does_not_stop_the_others(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    ready: list[str] = []

    class Module:
        def __init__(self, name: str) -> None:
            self.name = name

        def warm_up(self) -> None:
            if self.name.endswith("broken"):
                raise ValueError("no kernel")
            ready.append(self.name)

    monkeypatch.setattr(work, "modules_with_kernels", lambda: ["scanner.broken", "scanner.sound"])
    monkeypatch.setattr("importlib.import_module", Module)
    work._warm_up()
    assert ready == ["scanner.sound"]
    assert "scanner.broken could not be made ready" in caplog.text
