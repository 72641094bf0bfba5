"""The socket over which a simulated projector tells a simulated camera what shines never takes what is not its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest

from drivers.simulated.gige_light import LightReceiver
from scanner.errors import ConfigError


def test_a_file_in_its_place_is_left_alone(tmp_path: Path) -> None:
    precious = tmp_path / "precious.txt"
    precious.write_text("mine")
    with pytest.raises(ConfigError, match="no socket"):
        LightReceiver(cast("Any", None), precious)
    assert precious.read_text() == "mine"


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no folder"):
        LightReceiver(cast("Any", None), tmp_path / "nowhere" / "light")


def test_a_name_that_is_too_long_for_a_socket_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="too long"):
        LightReceiver(cast("Any", None), tmp_path / ("light" * 40))
