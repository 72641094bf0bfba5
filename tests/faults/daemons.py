"""Daemons as processes, to be killed: on a state folder that outlives them, with the processes they start."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from scanner.client import Client
from service.config import load_rig

RIG = "simulated:quick/board"


class RunningDaemon:
    """A daemon process; `daemon` are keys of the rig file's table of that name."""

    def __init__(self, state: Path, rig: str = RIG, **daemon: Any) -> None:
        config = load_rig(rig)
        config = config.model_copy(update={"daemon": config.daemon.model_copy(update=daemon)})
        state.mkdir(exist_ok=True)
        (state / "rig.toml").write_text(config.as_toml())
        self.endpoint = f"ipc://{state}/control.ipc"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "service.daemon", "--config", state / "rig.toml", "--private", state, "--lifeline"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == b"ready\n"

    def kill(self) -> None:
        self.process.kill()
        self.end()

    def end(self) -> None:
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()
        self.process.wait(15)


def children(daemon_pid: int, module: str = "") -> list[int]:
    """Processes that a daemon started, of one module or all."""
    found = []
    for folder in Path("/proc").iterdir():
        with suppress(OSError, ValueError, IndexError):
            command = (folder / "cmdline").read_bytes()
            stat = (folder / "stat").read_text().rpartition(")")[2].split()
            if module.encode() in command and int(stat[1]) == daemon_pid and stat[0] != "Z":
                found.append(int(folder.name))
    return found


def settle(endpoint: str) -> None:
    """Wait until worker and devices are there, so that no process appears within a test."""
    with Client(endpoint) as waiting:
        wait_for(lambda: (status := waiting.status())["workers"] and status["devices"])


def wait_for(true: Callable[[], Any], timeout_s: float = 30.0) -> Any:
    deadline = time.monotonic() + timeout_s
    while not (found := true()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)
    return found
