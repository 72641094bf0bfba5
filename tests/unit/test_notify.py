"""What systemd is told, over a real datagram socket; and the unit files, as systemd itself reads them."""

from __future__ import annotations

import asyncio
import re
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.notify import Notifier

ROOT = Path(__file__).parents[2]
UNITS = sorted((ROOT / "systemd").glob("*.service"))


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(5)
        yield listening, str(tmp_path / "notify")


def test_ready_and_ending_are_told(manager: tuple[socket.socket, str]) -> None:
    listening, path = manager
    told = Notifier({"NOTIFY_SOCKET": path})
    told.ready("serving ipc:///x")
    assert listening.recv(100) == b"READY=1\nSTATUS=serving ipc:///x"
    told.ending()
    assert listening.recv(100) == b"STOPPING=1"
    assert not told.watched


def test_an_abstract_socket_is_understood() -> None:
    name = f"fringed-test-{id(object())}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind("\0" + name)
        listening.settimeout(5)
        Notifier({"NOTIFY_SOCKET": "@" + name}).ending()
        assert listening.recv(100) == b"STOPPING=1"


def test_the_watchdog_is_fed_while_devices_answer(manager: tuple[socket.socket, str]) -> None:
    listening, path = manager
    alive = iter([True, False, True])

    def answers() -> bool:
        answer = next(alive, None)
        if answer is None:
            raise asyncio.CancelledError
        return answer

    notifier = Notifier({"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "3000"})
    assert notifier.watched
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(notifier.feed(answers))
    listening.setblocking(False)
    assert [listening.recv(100), listening.recv(100)] == [b"WATCHDOG=1"] * 2
    with pytest.raises(BlockingIOError):
        listening.recv(100)


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"NOTIFY_SOCKET": "/nowhere/at/all", "WATCHDOG_USEC": "0"},
        {"NOTIFY_SOCKET": "/nowhere/at/all", "WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"},
    ],
)
def test_where_nobody_listens_nothing_fails(environment: dict[str, str]) -> None:
    told = Notifier(environment)
    told.ready("x")
    told.ending()
    asked: list[bool] = []
    asyncio.run(asyncio.wait_for(told.feed(lambda: not asked.append(True)), 5))
    assert asked == []  # nobody is fed
    assert not told.watched


def test_every_key_of_the_units_is_known_and_set_once() -> None:
    assert len(UNITS) == 2
    for unit in UNITS:
        keys = [line.split("=")[0] for line in unit.read_text().splitlines() if "=" in line and line[0] not in "#["]
        repeated = {key for key in keys if keys.count(key) > 1}
        assert repeated <= {"DeviceAllow", "Environment"}, unit
        assert "MemoryDenyWriteExecute" not in keys


if shutil.which("systemd-analyze"):

    @pytest.mark.parametrize("unit", UNITS, ids=lambda path: path.stem)
    def test_systemd_understands_the_units_and_finds_them_closed(unit: Path, tmp_path: Path) -> None:
        """Exposure at most 4.0 of 10. `verify` ends with 0 on unknown keys, so its words count."""
        for each in UNITS:
            content = each.read_text().replace("@BIN@/fringed", "/bin/true").replace("@DOC@", "/usr/share/doc")
            (tmp_path / each.name).write_text(content)
        own = tmp_path / unit.name
        verified = subprocess.run(
            ["systemd-analyze", "verify", own], capture_output=True, text=True, check=False, timeout=60
        )
        about_us = [
            line for line in verified.stderr.splitlines() if re.search(r"fringed\S*\.service:\d+:|Unknown", line)
        ]
        assert about_us == []
        secure = ["systemd-analyze", "security", "--offline=true", "--threshold=40", "--no-pager", own]
        judged = subprocess.run(secure, capture_output=True, text=True, check=False, timeout=60)
        assert judged.returncode == 0, judged.stdout[-500:]
