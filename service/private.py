"""A daemon of one's own: started for one command, in a folder that only this user can open, gone when the command ends.

The same processes and the same wire as the daemon of a rig. Its lifeline is a pipe from the caller: it ends with the
caller, also when that is killed, and then removes its folder itself. Its log is kept where an error sends its reader
there: where a process died.
"""

from __future__ import annotations

import os
import re
import select
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from scanner.errors import ScannerError, Unreachable
from scanner.session import unreachable

if TYPE_CHECKING:
    from service.config import RigConfig

READY_S = 20.0
END_S = 10.0
RIG_FILE = "rig.toml"
LOG_FILE = "daemon.log"


@contextmanager
def private_daemon(config: RigConfig) -> Iterator[str]:
    """Run a daemon for this rig; yields its endpoint. Everything is removed at the end.

    It has a worker of its own also where the rig file leaves decoding to others: they cannot know its endpoint.

    Raises:
        Unreachable: it did not start, or died; the hint names its log, which is then kept.
    """
    daemon = config.daemon.model_copy(update={"workers": max(1, config.daemon.workers)})
    config = config.model_copy(update={"daemon": daemon})
    folder = Path(tempfile.mkdtemp(prefix="fringed-"))  # 0700
    try:
        (folder / RIG_FILE).write_text(config.as_toml(), encoding="utf-8")
        with (folder / LOG_FILE).open("wb") as log:
            process = _started(folder, log.fileno())
        try:
            _await_ready(process, folder)
            try:
                yield f"ipc://{folder}/control.ipc"
            except ScannerError as error:
                if isinstance(error, Unreachable) and process.poll() is not None:
                    raise _died(process, folder) from error
                if re.search(r"\blog\b", error.hint or ""):
                    error.hint = f"{error.hint}; the log is kept: {_kept_log(folder)}"
                raise
        finally:
            _end(process)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _started(folder: Path, log: int) -> subprocess.Popen[bytes]:
    # The rig file holds absolute paths only, so that it may be read from anywhere.
    return subprocess.Popen(  # noqa: S603
        [
            sys.executable,
            "-m",
            "service.daemon",
            "--config",
            str(folder / RIG_FILE),
            "--private",
            str(folder),
            "--lifeline",
            "--fleeting",
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=log,
        start_new_session=True,
    )


def _await_ready(process: subprocess.Popen[bytes], folder: Path) -> None:
    if process.stdout is None:
        raise AssertionError("started with a pipe")
    readable, _, _ = select.select([process.stdout], [], [], READY_S)
    if not readable or not os.read(process.stdout.fileno(), 64):
        process.kill()
        process.wait()
        raise _died(process, folder)


def _died(process: subprocess.Popen[bytes], folder: Path) -> Unreachable:
    error = unreachable(str(folder), f"the private daemon ended with status {process.returncode}")
    error.hint = f"its log is kept: {_kept_log(folder)}"
    return error


def _kept_log(folder: Path) -> str:
    descriptor, kept = tempfile.mkstemp(prefix="fringed-", suffix=".log")
    os.close(descriptor)
    shutil.copyfile(folder / LOG_FILE, kept)
    return kept


def _end(process: subprocess.Popen[bytes]) -> None:
    """Close the lifeline and wait; what does not end is killed (its children follow their own lifelines)."""
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            pipe.close()
    try:
        process.wait(END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
