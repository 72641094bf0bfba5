"""No daemon, one that refuses, and one of one's own: what clients are told, and what is left when it ends."""

from __future__ import annotations

import socket
import stat
import tempfile
from pathlib import Path

import pytest

from scanner.client import AsyncClient, Client
from scanner.errors import DeviceLost, StorageError, Unreachable
from scanner.wire import Refused
from service.config import RigConfig, load_rig
from service.private import private_daemon
from tests.faults.daemons import RIG, RunningDaemon


def test_nobody_there(tmp_path: Path) -> None:
    with pytest.raises(Unreachable, match="does not exist") as caught:
        Client(f"ipc://{tmp_path}/control.ipc")
    assert "fringed daemon" in str(caught.value.hint)


async def test_nobody_listens_any_more(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(tmp_path / "control.ipc"))
    with pytest.raises(Unreachable, match="nobody listens"):
        async with AsyncClient(f"ipc://{tmp_path}/control.ipc"):
            pass


def test_tcp_is_refused_in_words() -> None:
    with pytest.raises(Refused, match="only ipc") as caught:
        Client("tcp://127.0.0.1:5555")
    assert "CURVE" in str(caught.value.hint)


def test_a_scan_without_room_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    running = RunningDaemon(tmp_path, spool_limit_gb=1e-6, workers=0)
    try:
        with Client(running.endpoint) as client:
            with pytest.raises(StorageError, match="spool holds") as caught:
                client.scan("mcp")
            assert "spool_limit_gb" in str(caught.value.hint)
            job = client.list_scans()[-1]
        assert job["reason"] == "disk_full"
        assert not (tmp_path / "spool" / job["id"]).exists()
    finally:
        running.end()


def test_a_private_daemon_that_cannot_start_names_its_log(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = load_rig(RIG)
    monkeypatch.setattr(RigConfig, "as_toml", lambda self: "nonsense = [")
    with pytest.raises(Unreachable) as caught, private_daemon(rig):
        pass
    log = Path(str(caught.value.hint).rpartition(": ")[2])
    assert "rig.toml" in log.read_text()
    log.unlink()
    assert log.parent == Path(tempfile.gettempdir())


def test_a_private_daemon_has_a_worker_whatever_the_rig_file_says_and_leaves_the_log_that_an_error_points_to() -> None:
    rig, folders = load_rig(RIG), list[Path]()
    alone = rig.model_copy(update={"daemon": rig.daemon.model_copy(update={"workers": 0})})

    def lost() -> None:
        with private_daemon(alone) as endpoint, Client(endpoint) as client:
            folders.append(Path(endpoint.removeprefix("ipc://")).parent)
            assert stat.S_IMODE(folders[0].stat().st_mode) == 0o700
            assert client.scan("mcp").xyz is not None
            raise DeviceLost("the devices process died", hint="look at the log for the cause")

    with pytest.raises(DeviceLost) as caught:
        lost()
    assert not folders[0].exists()
    log = Path(str(caught.value.hint).rpartition(": ")[2])
    assert "serving ipc://" in log.read_text()
    log.unlink()
