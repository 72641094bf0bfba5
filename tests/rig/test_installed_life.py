"""The installed service under systemd: how it lives through faults, and how it ends.

It goes on where test_installed.py ends, with a service that runs: disturbed, stopped and started, removed.
"""

from __future__ import annotations

import os
import signal
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
    HOME,
    LIB,
    LIVE,
    MEMBER,
    ON_A_CARD,
    RUN,
    SHORT,
    STRANGER,
    Visitor,
    check_watched,
    children,
    inside,
    journal,
    main_pid,
    must,
    rows_of,
    run,
    show,
    wait_for,
    write_rig,
)
from tests.rig.punctual import ATTEMPTS

pytestmark = [pytest.mark.timeout(420), pytest.mark.usefixtures("installed")]

LONG = {**SHORT, "repeat": 20}

CAMERA = "/dev/v4l/by-path/platform-vivid.0-video-index0"
"""The node's number may be another one after it was pulled out"""

LOSS_S, RETURN_S = 1.0, 5.0


def _kernels() -> dict[str, tuple[int, int]]:
    return {str(path): (path.stat().st_mtime_ns, path.stat().st_size) for path in CACHE.rglob("*") if path.is_file()}


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


def test_a_card_taken_away_is_told_and_used_again_when_it_is_back() -> None:
    """The projector's whole card, unbound from its driver while it flips: see `virtio_card`.

    No scan gets as far as a worker.
    """
    virtio_card.plug_in()
    must("udevadm", "settle", "--timeout=30")
    write_rig(workers=0, projector=ON_A_CARD)
    try:
        must("systemctl", "restart", "fringed")
        with Visitor(MEMBER) as visitor:
            visitor.hear("hello")
            for state in ("idle", "mid-scan"):
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


@pytest.fixture(scope="module")
def worker_unit() -> dict[str, tuple[int, int]]:
    """A worker of its own unit is started, which loads its kernels for a while; the kernels that were there before."""
    before = _kernels()
    write_rig(workers=0)
    must("systemctl", "start", "fringed-worker@1")
    return before


@pytest.mark.usefixtures("worker_unit")
def test_the_doctor_says_what_a_stranger_lacks() -> None:
    doctor = run("fringed", "doctor", "--json", user=STRANGER)
    assert doctor.returncode == 1
    assert "usermod -aG video eve" in doctor.stdout


def test_a_worker_of_its_own_unit_decodes_without_devices_and_network(
    worker_unit: dict[str, tuple[int, int]],
) -> None:
    assert show("fringed.service", "ActiveState") == ["active"]
    worker = int(show("fringed-worker@1.service", "MainPID")[0])
    with Visitor(MEMBER) as ada:
        outcome = ada.scan(**SHORT, folder="/home/ada/second")
        ada.ask("status", {})
        workers = ada.hear("status")["workers"]
        check_watched(ada, "live", LIVE)
    assert outcome.get("state") == "done", outcome
    assert np.abs(rows_of("/home/ada/second") - np.arange(vivid.HEIGHT)[:, np.newaxis]).max() < 0.1
    assert [entry["pid"] for entry in workers] == [worker]
    assert _devices_of(worker) == []
    assert [line.split(":")[0].strip() for line in _text(f"/proc/{worker}/net/dev").splitlines()[2:]] == ["lo"]
    with inside("fringed-worker@1.service"), pytest.raises(PermissionError):
        os.open(CAMERA, os.O_RDWR | os.O_NONBLOCK)
    assert _kernels() == worker_unit  # nothing is compiled a second time


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
