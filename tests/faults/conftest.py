"""Daemons that a test starts one after the other on one state folder, and that leave nothing when it ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.faults.daemons import RunningDaemon, children, wait_for


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Callable[..., RunningDaemon]]:
    state, running = tmp_path / "state", list[RunningDaemon]()

    def start(**options: Any) -> RunningDaemon:
        running.append(RunningDaemon(state, **options))
        return running[-1]

    yield start
    for each in running:
        each.end()
    wait_for(lambda: not any(children(each.process.pid) for each in running))
    if running and running[-1].process.returncode == 0:  # one that was killed leaves its sockets to the next
        assert not list(state.glob("*.ipc"))
