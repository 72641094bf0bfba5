"""Hygiene: a test that leaves a process, thread, socket or file behind fails.

Every test runs in an empty working directory, with the session's own temporary directory; both must be as it found
them when it ends. What fixtures of wider scope hold is there before and after, and is looked at when the session ends.
"""

from __future__ import annotations

import gc
import os
import stat
import tempfile
import threading
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `service.cli` has it; before anything imports NumPy

MARK = f"FRINGED_TEST_SESSION={uuid.uuid4()}"
"""Inherited by every process that a test starts, also by those that left the family"""

PATIENCE_S = 2.0
"""Time for threads and processes that were told to end"""

LONG_LIVED = ("multiprocessing.resource_tracker", "multiprocessing.forkserver")
"""Helpers that Python keeps until it exits, by design"""

LONG_LIVED_THREADS = "strips_"
"""Those that share the pass over an image (`scanner.decode.strips`); they wait for the next one until Python exits"""

LONG_LIVED_KINDS = ("GarbageCollectorThread",)
"""pyzmq's, which frees what was sent without a copy; it ends with the process"""

KERNEL_THREAD = 0x0020_0000
"""PF_KTHREAD among the flags of /proc/PID/stat (proc(5)): it has no environment to read, and is nobody's"""

CHANCES = 3


def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Tests marked `real_time` have an emulator that must keep up with the clock: on a busy machine it gets chances."""
    if item.get_closest_marker("real_time") is None:
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for chance in range(CHANCES):
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
        if chance == CHANCES - 1 or not any(report.failed for report in reports):
            break
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


@dataclass(frozen=True)
class Traces:
    """What a test can leave behind, by name."""

    processes: frozenset[str]
    threads: frozenset[str]
    sockets: frozenset[str]
    files: frozenset[str]

    def beyond(self, before: Traces) -> list[str]:
        """What is here and was not there before, in words."""
        return [
            f"{kind[:-1] if kind != 'processes' else 'process'} {name}"
            for kind in ("processes", "threads", "sockets", "files")
            for name in sorted(getattr(self, kind) - getattr(before, kind))
        ]


@pytest.fixture(scope="session")
def places(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Path]]:
    """The session's temporary directory and working directory; every process started here bears the mark."""
    temporary, working = tmp_path_factory.mktemp("tmp"), tmp_path_factory.mktemp("cwd")
    name, _, value = MARK.partition("=")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TMPDIR", str(temporary))
        patch.setattr(tempfile, "tempdir", str(temporary))
        patch.setenv(name, value)
        patch.chdir(working)
        yield temporary, working


@pytest.fixture(scope="session", autouse=True)
def _clean_session(places: tuple[Path, Path]) -> Iterator[None]:
    before = _traces(places)
    yield
    _compare(before, places, "the session")


@pytest.fixture(autouse=True)
def _clean_test(_clean_session: None, places: tuple[Path, Path], request: pytest.FixtureRequest) -> Iterator[None]:
    os.chdir(places[1])
    before = _traces(places)
    yield
    os.chdir(places[1])
    _compare(before, places, request.node.name)


def _compare(before: Traces, places: tuple[Path, Path], what: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while left := _traces(places).beyond(before):
        gc.collect()  # a socket in a reference cycle is closed by its collection, not left behind
        if time.monotonic() > deadline:
            pytest.fail(f"{what} left behind: " + "; ".join(left), pytrace=False)
        time.sleep(0.02)


def _traces(places: tuple[Path, Path]) -> Traces:
    return Traces(
        processes=frozenset(_processes()),
        threads=frozenset(
            f"{thread.name} ({thread.ident})"
            for thread in threading.enumerate()
            if not thread.name.startswith(LONG_LIVED_THREADS) and type(thread).__name__ not in LONG_LIVED_KINDS
        ),
        sockets=frozenset(_sockets()),
        files=frozenset(str(path) for place in places for path in place.iterdir()),
    )


_strangers: set[str] = set()
"""Processes that were looked at and are not ours: nobody becomes ours later, and looking is what takes the time"""


def _processes() -> Iterator[str]:
    """Living processes that are children of this one or bear the session's mark."""
    me = str(os.getpid())
    living = {entry.name for entry in os.scandir("/proc") if entry.name.isdigit()} - {me}
    _strangers.intersection_update(living)
    for name in living - _strangers:
        folder = Path("/proc", name)
        try:
            # The name in brackets may hold blanks; state, parent and flags follow the last bracket.
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(fields[6]) & KERNEL_THREAD:
                _strangers.add(name)
                continue
            environment = (folder / "environ").read_bytes()
            command = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
        except PermissionError:
            _strangers.add(name)  # another user's
            continue
        except (OSError, ValueError):
            continue  # it ended while we looked
        state, parent = fields[0], fields[1]
        if not environment and not command and state not in "ZX":
            # Whose it is shows at the next look. On a busy machine that may be late: what a stranger starts is its own.
            # (Who lost its parent has process 1 for one, which is a stranger too.)
            if parent == "1" or parent not in _strangers:
                yield f"{name} (in the middle of its start)"
        elif MARK.encode() not in environment.split(b"\0") and parent != me:
            _strangers.add(name)
        elif state not in "ZX" and not any(name in command for name in LONG_LIVED):
            yield f"{name} ({command[:120]})"


def _sockets() -> Iterator[str]:
    """Open sockets of this process, by the kernel's name for them."""
    for descriptor in Path("/proc/self/fd").iterdir():
        try:
            if stat.S_ISSOCK(descriptor.stat().st_mode):
                yield str(descriptor.readlink())
        except OSError:
            continue  # the descriptor of the listing itself
