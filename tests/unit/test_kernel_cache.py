"""The folder of compiled kernels: beside the sources, or one that is safe, or none."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest

from scanner.kernel_cache import VARIABLE, choose_cache


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Sources that this user may not write. (Tests may run as root, to whom the system forbids nothing.)"""
    folder = tmp_path / "installed"
    (folder / "__pycache__").mkdir(parents=True)
    really = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: folder not in Path(path).parents and really(path, mode))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()
    return folder


def test_beside_the_sources_where_that_can_be_written(tmp_path: Path) -> None:
    environment = {"HOME": str(tmp_path)}
    assert choose_cache(tmp_path, environment)
    assert VARIABLE not in environment


def test_what_the_user_said_stays(installed: Path) -> None:
    environment = {VARIABLE: "/somewhere"}
    assert choose_cache(installed, environment)
    assert environment == {VARIABLE: "/somewhere"}


def test_in_the_users_cache(installed: Path, tmp_path: Path) -> None:
    environment = {"HOME": str(tmp_path / "home")}
    assert choose_cache(installed, environment)
    assert environment[VARIABLE] == str(tmp_path / "home/.cache/fringed")
    environment = {"HOME": str(tmp_path / "home"), "XDG_CACHE_HOME": str(tmp_path / "xdg")}
    assert choose_cache(installed, environment)
    assert environment[VARIABLE] == str(tmp_path / "xdg/fringed")


@pytest.mark.parametrize("home", ["", "/proc/nonexistent"])
def test_without_a_home_in_a_private_folder(home: str, installed: Path, tmp_path: Path) -> None:
    environment = {"HOME": home}
    assert choose_cache(installed, environment)
    folder = Path(environment[VARIABLE])
    assert folder.parent == tmp_path / "tmp"
    assert folder.stat().st_mode & 0o777 == 0o700


def test_a_folder_that_others_can_write_or_a_link_is_not_trusted(installed: Path, tmp_path: Path) -> None:
    planted = tmp_path / "tmp" / f"fringed-kernels-{os.geteuid()}"
    planted.mkdir()
    planted.chmod(0o777)
    environment: dict[str, str] = {}
    assert not choose_cache(installed, environment)
    planted.rmdir()
    planted.symlink_to(tmp_path)
    assert not choose_cache(installed, environment)
    assert environment == {}
