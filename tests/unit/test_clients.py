"""What both clients do with calls, and with those that fail, without any daemon."""

from __future__ import annotations

import asyncio
import hashlib
import logging
from pathlib import Path
from typing import Any

import pytest

from scanner.client import AsyncClient, Client
from scanner.errors import StorageError
from scanner.session import Call

CONTENT = b"all of it"
ENTRY = {"name": "scan.ply", "bytes": len(CONTENT), "sha256": hashlib.sha256(CONTENT).hexdigest()}


class Daemon:
    """Answers for a daemon; `full` is the method that fails there."""

    def __init__(self, full: str = "") -> None:
        self.full = full
        self.calls: list[Call] = []

    def answer(self, call: Call) -> Any:
        self.calls.append(call)
        if call.method == self.full:
            raise StorageError("No space left on device")
        return CONTENT if call.method == "scan.fetch" else {"state": "done", "files": [ENTRY]}


def both(daemon: Daemon, method: str, /, *arguments: Any, **named: Any) -> list[Any]:
    """A method of the blocking client and of the other, connected to `daemon`."""

    class Blocking(Client):
        def __init__(self) -> None:
            pass

        def _exchange(self, call: Call) -> Any:
            return daemon.answer(call)

    class Awaiting(AsyncClient):
        def __init__(self) -> None:
            pass

        async def _exchange(self, call: Call) -> Any:
            return daemon.answer(call)

    async def awaited() -> Any:
        return await getattr(Awaiting(), method)(*arguments, **named)

    return [getattr(Blocking(), method)(*arguments, **named), asyncio.run(awaited())]


def test_what_is_fetched_whole_is_there_though_the_daemon_cannot_note_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        assert both(Daemon("scan.acknowledge"), "fetch", "a-job", tmp_path) == [tmp_path, tmp_path]
    assert (tmp_path / "scan.ply").read_bytes() == CONTENT
    assert [record.levelname for record in caplog.records] == ["WARNING", "WARNING"]
    assert "scan a-job is fetched, but not acknowledged" in caplog.text
    assert "No space left on device" in caplog.text


def test_what_could_not_be_fetched_is_an_error_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="No space left"):
        both(Daemon("scan.fetch"), "fetch", "a-job", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_parameter_may_have_any_name() -> None:
    daemon = Daemon()
    both(daemon, "call", "scan.start", method="mcp", self=1)
    assert [dict(call.params) for call in daemon.calls] == 2 * [{"method": "mcp", "self": 1}]
