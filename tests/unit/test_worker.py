"""The worker's two threads: the one that talks never outlives the one that decodes."""

from __future__ import annotations

from pathlib import Path

import pytest

from scanner.errors import ScannerError
from service.worker import Worker


def test_a_worker_whose_decoder_died_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    worker = Worker(f"ipc://{tmp_path}/worker.ipc", decode=False)
    monkeypatch.setattr(worker._work, "serve", lambda jobs: None)
    with pytest.raises(ScannerError, match="decoding thread died"):
        worker.run()
