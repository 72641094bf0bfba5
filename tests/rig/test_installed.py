"""The installed service under systemd: who may do what, what is kept where, and how it lives through faults.

These tests are the life of one installation, in this order: installed, started, used, disturbed, stopped, removed.
"""

from __future__ import annotations

import os
import re
import signal
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tests.rig import virtio_card, vivid
from tests.rig.installed import (
    CACHE,
    CLONE,
    ENDPOINT,
    HOME,
    LEFT_TO_COMPILE,
    LIB,
    MEMBER,
    ON_A_CARD,
    RUN,
    STRANGER,
    Visitor,
    children,
    inside,
    journal,
    main_pid,
    must,
    run,
    show,
    wait_for,
    write_rig,
)
from tests.rig.punctual import ATTEMPTS

pytestmark = [pytest.mark.timeout(420), pytest.mark.usefixtures("installed")]

UNITS = ("fringed.service", "fringed-worker@1.service")
PATTERN = {"frequencies": [1, 8], "shifts": [4, 4]}
SHORT = {"method": "pmp", "pattern": PATTERN}
LONG = {**SHORT, "repeat": 20}
LIVE = {"exposure": 4000.0, "content": "rows"}

CAMERA = "/dev/v4l/by-path/platform-vivid.0-video-index0"
"""The node's number may be another one after it was pulled out"""

LOSS_S, RETURN_S = 1.0, 5.0


@pytest.fixture
def ada() -> Iterator[Visitor]:
    with Visitor(MEMBER) as visitor:
        visitor.hear("hello")
        yield visitor


def _rows(folder: str) -> np.ndarray:
    with np.load(Path(folder) / "scan.npz") as content:
        return np.asarray(content["rows"])


def _kernels() -> dict[str, tuple[int, int]]:
    return {str(path): (path.stat().st_mtime_ns, path.stat().st_size) for path in CACHE.rglob("*") if path.is_file()}


# --- installed ----------------------------------------------------------------------------------------------------


def test_units_are_understood_and_closed() -> None:
    """`verify` exits with 0 on a word that it does not know: it must say nothing."""
    checked = run("systemd-analyze", "verify", *(f"/etc/systemd/system/{unit.replace('1', '')}" for unit in UNITS))
    assert (checked.returncode, checked.stdout + checked.stderr) == (0, "")
    for unit in UNITS:
        judged = must("systemd-analyze", "security", "--no-pager", "--threshold=40", unit)
        print(judged.strip().splitlines()[-1])


def test_devices_belong_to_their_groups() -> None:
    for pattern, group in (("video1[01]", "video"), ("dri/card0", "video"), ("ttyACM0", "dialout")):
        (node,) = [Path("/dev/video10")] if pattern == "video1[01]" else Path("/dev").glob(pattern)
        assert (node.group(), stat.S_IMODE(node.stat().st_mode)) == (group, 0o660), node
    assert Path("/dev/fringed/trigger-RIG1").resolve() == Path("/dev/ttyACM0")
    tags = must("udevadm", "info", "--query=property", "/dev/video10")
    assert re.search(r"^CURRENT_TAGS=.*:systemd:.*", tags, re.MULTILINE)
    assert ":fringed:" in tags


def test_the_kernel_is_set_up() -> None:
    assert int(Path("/proc/sys/net/core/rmem_max").read_text()) == 67108864
    assert "options uvcvideo hwtimestamps=1" in must("modprobe", "-c")


# --- started ------------------------------------------------------------------------------------------------------


def test_it_is_ready_when_it_says_so() -> None:
    must("systemctl", "start", "fringed")
    state, text, kind = show("fringed.service", "ActiveState", "StatusText", "Type")
    assert (state, text, kind) == ("active", f"serving {ENDPOINT}", "notify")
    wait_for(lambda: len(children(main_pid())) == 2, 30)


def test_its_processes_have_no_rights_but_their_groups() -> None:
    wanted = {must("getent", "group", name).split(":")[2] for name in ("fringed", "video", "render", "dialout")}
    daemon = main_pid()
    for pid in (daemon, *children(daemon).values()):
        said = dict(
            line.split(":\t", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":\t" in line
        )
        assert set(said["Groups"].split()) | {said["Gid"].split()[0]} == wanted
        assert said["Uid"].split() == [str(Path(LIB).stat().st_uid)] * 4
        assert (said["CapEff"], said["CapBnd"]) == ("0" * 16, "0" * 16)
        assert (said["NoNewPrivs"], said["Seccomp"]) == ("1", "2")


def test_it_may_open_its_devices_and_no_others() -> None:
    """Asked as root from among its processes: what is refused is refused by the unit's list, not by the file's mode."""
    with inside("fringed.service"):
        for node in ("/dev/video10", "/dev/dri/card0", "/dev/ttyACM0", "/dev/null"):
            os.close(os.open(node, os.O_RDWR | os.O_NONBLOCK | os.O_NOCTTY))
        for node in ("/dev/vda", "/dev/kmsg", "/dev/mem", "/dev/hwrng"):
            if Path(node).exists():
                with pytest.raises(PermissionError):
                    os.open(node, os.O_RDONLY | os.O_NONBLOCK)


def test_a_member_of_the_clients_group_scans(ada: Visitor) -> None:
    outcome = ada.scan(**SHORT, folder="/home/ada/first")
    assert outcome.get("state") == "done", outcome
    ada.ask("status", {})
    counts = ada.hear("status")["devices"]["camera"]["counts"]
    assert counts["frames"] >= 10
    assert counts["damaged"] == 0
    rows = _rows("/home/ada/first")
    assert np.abs(rows - np.arange(vivid.HEIGHT)[:, np.newaxis]).max() < 0.1


def test_a_stranger_is_kept_out_and_told_why() -> None:
    with Visitor(STRANGER) as eve:
        told = eve.hear("error", "hello")
    assert told["kind"] == "error"
    assert "may not" in told["message"]
    assert "group" in told["hint"]


@pytest.mark.parametrize(
    ("user", "path", "opens"),
    [
        (MEMBER, RUN / "control.ipc", True),
        (MEMBER, RUN / "events.ipc", True),
        (MEMBER, RUN / "worker.ipc", False),
        (STRANGER, RUN / "control.ipc", False),
        (STRANGER, RUN / "events.ipc", False),
        (STRANGER, RUN / "worker.ipc", False),
    ],
)
def test_sockets_open_for_whom_they_should(user: str, path: Path, opens: bool) -> None:
    _check_opens(user, path, opens)


def _check_opens(user: str, path: Path, opens: bool) -> None:
    connect = f"import socket; socket.socket(socket.AF_UNIX).connect({str(path)!r})"
    tried = run("/usr/bin/python3", "-I", "-S", "-c", connect, user=user)
    assert (tried.returncode == 0) == opens, tried.stderr
    assert opens or "PermissionError" in tried.stderr


@pytest.mark.parametrize(("kind", "params"), [("preview", {}), ("live", LIVE)])
def test_what_can_be_watched_is_for_clients_alone(ada: Visitor, kind: str, params: dict[str, Any]) -> None:
    """These sockets are there while somebody watches; a worker's process binds that of live runs."""
    _check_watched(ada, kind, params)


def _check_watched(visitor: Visitor, kind: str, params: dict[str, Any]) -> None:
    visitor.ask("until", True)
    visitor.hear("until")
    visitor.ask(kind, params)
    visitor.hear(kind, seconds=240)
    path = RUN / f"{kind}.ipc"
    assert (path.owner(), path.group(), stat.S_IMODE(path.stat().st_mode)) == ("fringed", "fringed-clients", 0o660)
    _check_opens(MEMBER, path, True)
    _check_opens(STRANGER, path, False)
    visitor.ask("leave", {})
    visitor.hear("left")
    wait_for(lambda: not path.exists(), 10)


@pytest.mark.parametrize("user", [MEMBER, STRANGER])
def test_nobody_else_reads_or_changes_its_files(user: str) -> None:
    for path in (LIB, CACHE, LIB / "spool", Path("/etc/fringed/rig.toml")):
        assert run("test", "-r", path, user=user).returncode == 1
    for path in (RUN, LIB, CACHE, Path("/etc/fringed"), HOME):
        assert run("test", "-w", path, user=user).returncode == 1


def test_what_it_keeps_is_its_own() -> None:
    sockets = {path.name: (path.owner(), path.group(), stat.S_IMODE(path.stat().st_mode)) for path in RUN.iterdir()}
    assert sockets == {
        "control.ipc": ("fringed", "fringed-clients", 0o660),
        "events.ipc": ("fringed", "fringed-clients", 0o660),
        "worker.ipc": ("fringed", "fringed", 0o660),
    }
    assert (RUN.owner(), RUN.group(), stat.S_IMODE(RUN.stat().st_mode)) == ("fringed", "fringed-clients", 0o2750)
    for folder, closed in ((LIB, 0o027), (CACHE, 0o077)):
        for path in (folder, *folder.rglob("*")):
            found = path.lstat()
            assert not found.st_mode & closed, path
            assert (path.owner(), path.group()) == ("fringed", "fringed"), path
    for path in (HOME, *HOME.rglob("*")):
        found = path.lstat()
        assert found.st_uid == 0, path
        assert stat.S_ISLNK(found.st_mode) or not found.st_mode & 0o022, path
    elsewhere = must("find", "/", "-xdev", "-user", "fringed", "-not", "-path", f"{LIB}*", "-not", "-path", f"{CACHE}*")
    assert elsewhere == ""


def test_it_compiles_once() -> None:
    made = [path for path in CACHE.rglob(f"{LEFT_TO_COMPILE}*.nbc") if path.is_file()]
    assert made
    assert {(path.owner(), stat.S_IMODE(path.stat().st_mode) & 0o077) for path in made} == {("fringed", 0)}


# --- disturbed ----------------------------------------------------------------------------------------------------


def _late(attempts: list[dict[str, float]]) -> bool:
    """Whether the last attempt was late; fails where the last of all was."""
    print(attempts[-1])
    late = attempts[-1]["loss"] > LOSS_S or attempts[-1]["back"] > RETURN_S
    assert not late or len(attempts) < ATTEMPTS, attempts
    return late


@pytest.fixture
def plugged() -> Iterator[None]:
    yield
    if not Path(CAMERA).exists():
        vivid.bind()


@pytest.mark.usefixtures("plugged")
@pytest.mark.parametrize("state", ["idle", "mid-scan"])
def test_a_device_pulled_out_is_told_and_used_again_when_it_is_back(ada: Visitor, state: str) -> None:
    _pull_out(ada, state, vivid, "vivid")
    outcome = ada.scan(**SHORT)
    assert outcome["state"] == "done", outcome


def test_a_card_taken_away_is_told_and_used_again_when_it_is_back(ada: Visitor) -> None:
    """The projector's whole card, unbound from its driver while it flips: see `virtio_card`."""
    virtio_card.plug_in()
    must("udevadm", "settle", "--timeout=30")
    write_rig(workers=1, projector=ON_A_CARD)
    try:
        must("systemctl", "restart", "fringed")
        for state in ("idle", "mid-scan"):
            with Visitor(MEMBER) as visitor:
                visitor.hear("hello")
                _pull_out(visitor, state, virtio_card, virtio_card.DEVICE)
    finally:
        virtio_card.plug_in()
        write_rig(workers=1)
        must("systemctl", "restart", "fringed")
    wait_for(lambda: len(children(main_pid())) == 2, 30)


def _pull_out(ada: Visitor, state: str, device: ModuleType, name: str) -> None:
    """device: has `unplug` and `bind`. name: of it, in messages."""
    attempts: list[dict[str, float]] = []
    while not attempts or _late(attempts):
        ada.ask("until", True)
        ada.hear("until")
        if state == "mid-scan":
            ada.ask("scan", LONG)
            wait_for_frames(ada, 5)
        device.unplug()
        gone = time.monotonic()
        if state == "mid-scan":
            told = ada.hear("failed", "done")
            assert told["fields"]["reason"] == "device_lost"
            assert "went away" in told["fields"]["error"]["message"]
            assert ada.hear("over")["state"] == "failed"
        else:
            ada.ask("until", False)
            told = ada.hear("until")
        refused = ada.scan(**SHORT)
        assert refused["reason"] == "device_lost", refused
        assert name in refused["error"]["message"], refused
        assert _held_nodes(children(main_pid())["service.devices_process"]) == []
        device.bind()
        ada.ask("until", True)
        back = time.monotonic()
        attempts.append({"loss": told["t"] - gone, "back": ada.hear("until")["t"] - back})


def _held_nodes(pid: int) -> list[str]:
    """Nodes of video devices and cards that a process has open or mapped, those included that are gone."""
    opened = [str(link.readlink()) for link in Path(f"/proc/{pid}/fd").iterdir()]
    mapped = _text(f"/proc/{pid}/maps").splitlines()
    return [line for line in (*opened, *mapped) if "/dev/video" in line or "/dev/dri" in line]


def wait_for_frames(visitor: Visitor, count: int) -> None:
    while visitor.hear("frame", "over")["fields"]["captured"] < count:
        continue


def test_a_daemon_that_is_stuck_is_started_anew() -> None:
    before, (restarts,) = main_pid(), show("fringed.service", "NRestarts")
    family = [before, *children(before).values()]
    os.kill(before, signal.SIGSTOP)
    began = time.monotonic()
    wait_for(lambda: show("fringed.service", "NRestarts", "ActiveState") == [str(int(restarts) + 1), "active"], 90)
    print(f"restarted after {time.monotonic() - began:.1f} s")
    assert main_pid() != before
    assert "Watchdog timeout" in journal()
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in family), 10)


# --- stopped and started ------------------------------------------------------------------------------------------


def test_it_ends_in_order_and_leaves_nothing() -> None:
    daemon = main_pid()
    family = [daemon, *children(daemon).values()]
    must("systemctl", "stop", "fringed")
    result, state = show("fringed.service", "Result", "ActiveState")
    assert (result, state) == ("success", "inactive")
    assert list(RUN.iterdir()) == []
    assert not any(Path(f"/proc/{pid}").exists() for pid in family)


def test_a_worker_of_its_own_unit_decodes_without_devices_and_network() -> None:
    before = _kernels()
    write_rig(workers=0)
    must("systemctl", "start", "fringed-worker@1")
    assert show("fringed.service", "ActiveState") == ["active"]
    worker = int(show("fringed-worker@1.service", "MainPID")[0])
    with Visitor(MEMBER) as ada:
        outcome = ada.scan(**SHORT, folder="/home/ada/second")
        ada.ask("status", {})
        workers = ada.hear("status")["workers"]
        _check_watched(ada, "live", LIVE)
    assert outcome.get("state") == "done", outcome
    assert np.abs(_rows("/home/ada/second") - np.arange(vivid.HEIGHT)[:, np.newaxis]).max() < 0.1
    assert [entry["pid"] for entry in workers] == [worker]
    assert _devices_of(worker) == []
    assert [line.split(":")[0].strip() for line in _text(f"/proc/{worker}/net/dev").splitlines()[2:]] == ["lo"]
    with inside("fringed-worker@1.service"), pytest.raises(PermissionError):
        os.open(CAMERA, os.O_RDWR | os.O_NONBLOCK)
    assert _kernels() == before  # nothing is compiled a second time


def _devices_of(pid: int) -> list[str]:
    return must(
        "nsenter",
        "-t",
        str(pid),
        "-m",
        "sh",
        "-c",
        "ls -d /dev/video* /dev/dri /dev/tty[AU]* /dev/vda 2>/dev/null || :",
    ).split()


def _text(path: str) -> str:
    return Path(path).read_text()


def test_the_doctor_says_what_a_stranger_lacks() -> None:
    doctor = run("fringed", "doctor", "--json", user=STRANGER)
    assert doctor.returncode == 1
    assert "usermod -aG video eve" in doctor.stdout


# --- removed ------------------------------------------------------------------------------------------------------


def test_it_is_removed_and_what_was_made_with_it_stays() -> None:
    kept = sorted(str(path) for path in LIB.rglob("*"))
    must(CLONE / "setup/install-system.sh", "--remove")
    assert show("fringed.service", "ActiveState") == ["inactive"]
    assert not HOME.exists()
    left: Any = must(
        "find",
        "/etc",
        "/usr/local",
        "-name",
        "*fringed*",
        "-not",
        "-path",
        "*/fringed*.d*",
        "-not",
        "-path",
        "/etc/fringed",
    )
    assert left == ""
    assert Path("/etc/fringed/rig.toml").exists()
    assert sorted(str(path) for path in LIB.rglob("*") if "lock" not in path.name) == [
        p for p in kept if "lock" not in p
    ]
