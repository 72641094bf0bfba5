"""Sockets: what already stands where a daemon would bind is never deleted."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from scanner.endpoints import sibling
from scanner.errors import ConfigError
from service.config import load_rig
from service.daemon import run_daemon
from service.sockets import refuse_files, refuse_taken, remove_sockets

SIBLINGS = ("notes.txt", "notes.txt-events.ipc", "notes.txt-preview.ipc", "notes.txt-worker.ipc")


def a_file(path: Path) -> None:
    path.write_text("mine")


def a_link(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as elsewhere:
        elsewhere.bind(str(path.with_name("elsewhere")))
    path.symlink_to(path.with_name("elsewhere"))


@pytest.mark.parametrize("name", SIBLINGS)
@pytest.mark.parametrize("make", [a_file, Path.mkdir, a_link])
def test_a_daemon_takes_the_place_of_nothing_but_a_socket(
    name: str, make: Callable[[Path], None], tmp_path: Path
) -> None:
    make(tmp_path / name)
    before = (tmp_path / name).lstat()
    with pytest.raises(ConfigError, match="is no socket") as caught:
        run_daemon(
            load_rig("simulated:quick/board"), state_dir=tmp_path / "state", endpoint=f"ipc://{tmp_path}/notes.txt"
        )
    assert str(tmp_path / name) in caught.value.message
    assert (tmp_path / name).lstat() == before
    assert not (tmp_path / "state").exists()


def test_a_stale_socket_is_free_and_a_served_one_is_not(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/control.ipc"
    endpoints = [endpoint, sibling(endpoint, "events")]
    refuse_files(endpoints)
    refuse_taken(endpoints)
    with socket.socket(socket.AF_UNIX) as serving:
        serving.bind(str(tmp_path / "events.ipc"))
        serving.listen()
        refuse_files(endpoints)
        with pytest.raises(ConfigError, match="another daemon serves"):
            refuse_taken(endpoints)
    refuse_taken(endpoints)


def test_a_socket_of_another_kind_is_somebody_elses(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as datagrams:
        datagrams.bind(str(tmp_path / "control.ipc"))
        with pytest.raises(ConfigError, match="somebody else"):
            refuse_taken([f"ipc://{tmp_path}/control.ipc"])


def test_only_sockets_are_removed(tmp_path: Path) -> None:
    (tmp_path / "control.ipc").write_text("mine")
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(tmp_path / "events.ipc"))
    remove_sockets(f"ipc://{tmp_path}/{name}.ipc" for name in ("control", "events", "worker"))
    assert [path.name for path in tmp_path.iterdir()] == ["control.ipc"]
