"""Processes that the daemon starts: each in a session of its own, each with a lifeline.

A child's standard input is a pipe from the daemon. It closes when the daemon ends, however it ends, and the child then
ends too: `kill -9` of the daemon leaves nothing behind.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress

_log = logging.getLogger(__name__)


class Child:
    """One running child process."""

    def __init__(self, name: str, process: asyncio.subprocess.Process) -> None:
        self.name = name
        self._process = process

    @classmethod
    async def start(
        cls, module: str, arguments: Sequence[str] = (), *, inherit: Sequence[int] = (), talks: bool = False
    ) -> Child:
        """Start `python -m module`.

        Args:
            module: its import name.
            arguments: its command line.
            inherit: descriptors to hand on (the daemon's lock: it stays locked until the last child is gone).
            talks: whether its standard output is read here.
        """
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            module,
            *arguments,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE if talks else asyncio.subprocess.DEVNULL,
            start_new_session=True,
            pass_fds=tuple(inherit),
        )
        return cls(module.rpartition(".")[2], process)

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def reports(self) -> asyncio.StreamReader:
        """Its standard output; only of a child that talks."""
        if self._process.stdout is None:
            raise AssertionError("started without talks=True")
        return self._process.stdout

    def send(self, data: bytes) -> None:
        """Write to its standard input; a child that is gone takes nothing, which its `wait` says."""
        if self._process.stdin is not None and not self._process.stdin.is_closing():
            self._process.stdin.write(data)

    async def wait(self) -> int:
        """Its exit status; negative: the signal that killed it."""
        return await self._process.wait()

    def kill(self) -> None:
        """End it at once, with whatever it started."""
        if self._process.returncode is None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)

    async def stop(self, grace_s: float = 3.0) -> None:
        """Close the lifeline, wait, and kill what does not end."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        try:
            async with asyncio.timeout(grace_s):
                await self._process.wait()
        except TimeoutError:
            _log.warning("%s (%d) did not end within %g s and was killed", self.name, self.pid, grace_s)
            self.kill()
            await self._process.wait()
