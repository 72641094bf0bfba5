"""The service as an administrator installs it in the guest: unpacked, prepared, a rig file of vivid's two nodes, two
ordinary users (ada may ask for scans, eve may not), and clients that run as one of them.

What the guest lacks are the Python packages of others: those of the clone's .venv are mounted, since unpacking 700 MB
there takes minutes. Kernels are compiled beforehand, but for one, so that the service must compile and keep it.
"""

from __future__ import annotations

import json
import os
import queue
import shutil
import stat
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import numpy as np

from tests.rig import virtio_card

CLONE = Path(__file__).parents[2]
STATE = CLONE / ".setup/rig"
HOME = Path("/usr/local/lib/fringed")
SITE = HOME / "lib/python3.11/site-packages"
RUN, LIB, CACHE = Path("/run/fringed"), Path("/var/lib/fringed"), Path("/var/cache/fringed")
ENDPOINT = f"ipc://{RUN}/control.ipc"
VISITOR = Path("/opt/visitor.py")
MEMBER, STRANGER = "ada", "eve"

LEFT_TO_COMPILE = "ply."
"""Kernels of `scanner.ply`, the smallest: the service compiles them itself"""

RIG = """
[camera]
driver = "v4l2"
device = "platform-vivid.0-video-index0"
[camera.settings]
exposure_us = 4000
[camera.options]
mode = "640x480@59.94"
pixel_format = "GREY"
shutter = "global"
exposure_us = 4000
[camera.options.controls]
loop_video = 1
osd_text_mode = 2
[projector]
{projector}
[daemon]
workers = {workers}
[daemon.retention]
min_free_gb = 0.1
"""

LOOPED = """driver = "v4l2"
device = "platform-vivid.0-video-index1"
mode = "640x480@59.94"
# vivid's two ends have clocks of their own: what the output takes at its tick, the input has at its next.
latency_us = [0, 17000]
settle_us = 0
[projector.options]
pixel_format = "GREY"
"""

ON_A_CARD = f"""driver = "kms"
device = "{virtio_card.DEVICE}"
mode = "640x480"
latency_us = [0, 17000]
settle_us = 0
"""
"""Nobody's camera sees that display: scans begin, and come to no good end"""

SHORT = {"method": "pmp", "pattern": {"frequencies": [1, 8], "shifts": [4, 4]}}
LIVE = {"exposure": 4000.0, "content": "rows"}
"""Parameters of a scan and of a live run"""

KERNELS = """[Service]
Environment=NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES= NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1
"""


def run(*words: str | Path, user: str | None = None, timeout_s: float = 120) -> subprocess.CompletedProcess[str]:
    """A command's outcome, as root or as somebody else."""
    line = [str(word) for word in words]
    if user is not None:
        line = ["runuser", "-u", user, "--", *line]
    return subprocess.run(line, capture_output=True, text=True, timeout=timeout_s, check=False, cwd="/")


def must(*words: str | Path, timeout_s: float = 120) -> str:
    """A command's output; it must succeed."""
    done = run(*words, timeout_s=timeout_s)
    assert done.returncode == 0, f"{words}: {done.stderr}{done.stdout}"
    return done.stdout


def show(unit: str, *names: str) -> list[str]:
    """Properties of a unit, in the order asked for."""
    found = dict(line.split("=", 1) for line in must("systemctl", "show", unit, "-p", ",".join(names)).splitlines())
    return [found[name] for name in names]


def journal(unit: str = "fringed.service") -> str:
    return must("journalctl", "-u", unit, "--no-pager", "-o", "cat")


def install() -> None:
    """Everything but starting it."""
    must("cp", "-r", "--preserve=mode,timestamps,links", f"{STATE}/stage/.", "/")
    must(CLONE / "setup/install-system.sh", "--prepare")
    packages = Path("/opt/packages")
    packages.mkdir()
    must("mount", "--bind", next(CLONE.glob(".venv/lib/python3*/site-packages")), packages)
    (SITE / "packages.pth").write_text(f"{packages}\n")
    must("useradd", "-m", "-G", "fringed-clients", MEMBER)
    must("useradd", "-m", STRANGER)
    shutil.copy(CLONE / "tests/rig/box/visitor.py", VISITOR)
    VISITOR.chmod(0o644)
    write_rig(workers=1)
    for unit in ("fringed.service.d", "fringed-worker@.service.d"):
        folder = Path("/etc/systemd/system") / unit
        folder.mkdir()
        (folder / "kernels.conf").write_text(KERNELS)
    shutil.copytree(STATE / "kernels/installed", CACHE)
    for path in CACHE.rglob(f"{LEFT_TO_COMPILE}*"):
        path.unlink()
    must("chown", "-R", "fringed:fringed", CACHE)
    must("chmod", "-R", "go=", CACHE)
    must("systemctl", "daemon-reload")


def write_rig(*, workers: int, projector: str = LOOPED) -> None:
    Path("/etc/fringed/rig.toml").write_text(RIG.format(workers=workers, projector=projector))


def main_pid() -> int:
    return int(show("fringed.service", "MainPID")[0])


def children(pid: int) -> dict[str, int]:
    """A process's children by the module that they run."""
    found = {}
    for number in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        words = Path(f"/proc/{number}/cmdline").read_bytes().split(b"\0")
        found[words[words.index(b"-m") + 1].decode()] = int(number)
    return found


def wait_for(condition: Any, seconds: float) -> Any:
    """What `condition` returns once that is true."""
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < deadline, f"not within {seconds} s; the journal ends: {journal()[-3000:]}"
        time.sleep(0.2)
    return found


class Visitor:
    """A client's process; see box/visitor.py."""

    def __init__(self, user: str) -> None:
        self._process = subprocess.Popen(
            ["runuser", "-u", user, "--", HOME / "bin/python", "-P", VISITOR, ENDPOINT],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd="/",
            env={"PATH": os.environ["PATH"], "HOME": f"/home/{user}"},
        )
        self._told: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def ask(self, word: str, what: Any) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps([word, what]) + "\n")
        self._process.stdin.flush()

    def hear(self, *kinds: str, seconds: float = 120) -> dict[str, Any]:
        """The next thing told that is one of `kinds`."""
        deadline = time.monotonic() + seconds
        heard = []
        while (left := deadline - time.monotonic()) > 0:
            try:
                told = self._told.get(timeout=left)
            except queue.Empty:
                break
            heard.append(told)
            if told["kind"] in kinds:
                return told
            if told["kind"] == "gone":
                break
        raise AssertionError(f"{kinds} was not told within {seconds} s, but {heard[-8:]}; journal: {journal()[-3000:]}")

    def scan(self, **params: Any) -> dict[str, Any]:
        """A whole scan's outcome."""
        self.ask("scan", params)
        return self.hear("over", "error", "gone", seconds=240)

    def close(self) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join()
        self._process.stdout.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._told.put(json.loads(line))
        self._told.put({"kind": "gone"})


def rows_of(folder: str) -> np.ndarray:
    """Of the scan in this folder."""
    with np.load(Path(folder) / "scan.npz") as content:
        return np.asarray(content["rows"])


def check_opens(user: str, path: Path, opens: bool) -> None:
    """Whether this user can connect to this socket."""
    connect = f"import socket; socket.socket(socket.AF_UNIX).connect({str(path)!r})"
    tried = run("/usr/bin/python3", "-I", "-S", "-c", connect, user=user)
    assert (tried.returncode == 0) == opens, tried.stderr
    assert opens or "PermissionError" in tried.stderr


def check_watched(visitor: Visitor, kind: str, params: dict[str, Any]) -> None:
    """A preview or a live run has a socket, for members of the clients' group, while somebody watches."""
    visitor.ask("until", True)
    visitor.hear("until")
    visitor.ask(kind, params)
    visitor.hear(kind, seconds=240)
    path = RUN / f"{kind}.ipc"
    assert (path.owner(), path.group(), stat.S_IMODE(path.stat().st_mode)) == ("fringed", "fringed-clients", 0o660)
    check_opens(MEMBER, path, True)
    check_opens(STRANGER, path, False)
    visitor.ask("leave", {})
    visitor.hear("left")
    wait_for(lambda: not path.exists(), 10)


@contextmanager
def inside(unit: str) -> Iterator[None]:
    """This process among those of a unit: the devices that the unit may not open are closed to it too."""
    own = Path("/sys/fs/cgroup") / Path("/proc/self/cgroup").read_text().strip().rpartition("::/")[2] / "cgroup.procs"
    theirs = Path("/sys/fs/cgroup") / show(unit, "ControlGroup")[0].lstrip("/") / "cgroup.procs"
    theirs.write_text(str(os.getpid()))
    try:
        yield
    finally:
        own.write_text(str(os.getpid()))
