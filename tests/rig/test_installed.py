"""The installed service under systemd: who may do what, and what is kept where.

These tests and those of test_installed_life.py are the life of one installation, in this order: installed, started,
used; disturbed, stopped, removed.
"""

from __future__ import annotations

import os
import re
import stat
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.rig import vivid
from tests.rig.installed import (
    CACHE,
    ENDPOINT,
    HOME,
    LEFT_TO_COMPILE,
    LIB,
    LIVE,
    MEMBER,
    RUN,
    SHORT,
    STRANGER,
    Visitor,
    check_opens,
    check_watched,
    children,
    inside,
    main_pid,
    must,
    rows_of,
    run,
    show,
    wait_for,
)

pytestmark = [pytest.mark.timeout(420), pytest.mark.usefixtures("installed")]

UNITS = ("fringed.service", "fringed-worker@1.service")

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
    check_opens(user, path, opens)


@pytest.mark.parametrize("user", [MEMBER, STRANGER])
def test_nobody_else_reads_or_changes_its_files(user: str) -> None:
    for path in (LIB, CACHE, LIB / "spool", Path("/etc/fringed/rig.toml")):
        assert run("test", "-r", path, user=user).returncode == 1
    for path in (RUN, LIB, CACHE, Path("/etc/fringed"), HOME):
        assert run("test", "-w", path, user=user).returncode == 1


def test_a_member_of_the_clients_group_scans(ada: Visitor) -> None:
    outcome = ada.scan(**SHORT, folder="/home/ada/first")
    assert outcome.get("state") == "done", outcome
    ada.ask("status", {})
    counts = ada.hear("status")["devices"]["camera"]["counts"]
    assert counts["frames"] >= 10
    assert counts["damaged"] == 0
    rows = rows_of("/home/ada/first")
    assert np.abs(rows - np.arange(vivid.HEIGHT)[:, np.newaxis]).max() < 0.1


@pytest.mark.parametrize(("kind", "params"), [("preview", {}), ("live", LIVE)])
def test_what_can_be_watched_is_for_clients_alone(ada: Visitor, kind: str, params: dict[str, Any]) -> None:
    """These sockets are there while somebody watches; a worker's process binds that of live runs."""
    check_watched(ada, kind, params)


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
            with suppress(FileNotFoundError):  # the daemon is at work: what it was just writing has its name by now
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
