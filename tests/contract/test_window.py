"""The contract suite on a window, under Xvfb: left out, and said so, where there is no Xvfb or no SDL."""

from __future__ import annotations

import ctypes.util
import os
import shutil
import subprocess
from collections.abc import Iterator

import numpy as np
import pytest

from drivers.registry import open_projector
from drivers.window import projector_driver
from drivers.window.projector import WindowProjector
from scanner.clock import VirtualClock
from scanner.devices import Source
from scanner.errors import ConfigError, DeviceError, DeviceLost, DeviceNotFound
from tests.contract.suite import ProjectorBench, ProjectorContract

MISSING = [
    name
    for name, there in (("xvfb", shutil.which("Xvfb")), ("libsdl2-2.0-0", ctypes.util.find_library("SDL2-2.0")))
    if not there
]

pytestmark = pytest.mark.skipif(bool(MISSING), reason=f"needs {' and '.join(MISSING)}: apt-get install them")


@pytest.fixture(scope="module", autouse=True)
def screen() -> Iterator[None]:
    """A display of its own, 800x600. The server picks a free number and tells it."""
    reader, writer = os.pipe()
    command = ["Xvfb", "-displayfd", str(writer), "-screen", "0", "800x600x24", "-nolisten", "tcp", "-noreset"]
    with subprocess.Popen(command, pass_fds=[writer], stderr=subprocess.DEVNULL) as server:
        os.close(writer)
        with os.fdopen(reader) as told:
            number = told.readline().strip()  # to the line's end: the server dies of a pipe that is closed earlier
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("DISPLAY", f":{number}")
            patch.setenv("SDL_VIDEODRIVER", "x11")
            patch.delenv("WAYLAND_DISPLAY", raising=False)
            yield
        server.terminate()


def _open(device: str = "", **options: object) -> WindowProjector:
    opened = open_projector("window", device, options, VirtualClock())
    assert isinstance(opened, WindowProjector)
    return opened


class TestWindow(ProjectorContract):
    @pytest.fixture
    def bench(self) -> Iterator[ProjectorBench]:
        clock = VirtualClock()
        projector = open_projector("window", "", {"windowed": [320, 240]}, clock)
        yield ProjectorBench(projector, clock)
        projector.close()


def test_the_whole_display_is_taken_and_greys_are_exact() -> None:
    projector = _open(mode="800x600")
    try:
        image = np.random.default_rng(2).integers(0, 256, (600, 800), dtype=np.uint8)
        projector.load([image])
        flip = projector.show(0)
        assert flip.source is Source.ESTIMATED
        assert flip.bound_ns >= projector.capabilities.refresh_ns
        drawn = projector.window.drawn(projector.pictures[0])
        assert all(np.array_equal(drawn[..., colour], image) for colour in range(3))
    finally:
        projector.close()


def test_displays_are_listed_and_others_are_refused() -> None:
    assert [(info.model, info.details["size"]) for info in projector_driver.discover()] == [("screen", "800x600")]
    with pytest.raises(DeviceNotFound, match="no display '3'"):
        _open("3")
    with pytest.raises(ConfigError, match="800x600"):
        _open(mode="1920x1080@60")
    with pytest.raises(ConfigError, match="'800x600@fast' makes no sense"):
        _open(mode="800x600@fast")


def test_a_display_without_a_name_is_not_called_by_its_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    assert [(info.device, info.model) for info in projector_driver.discover()] == [("0", "display of the desktop")]


def test_without_a_desktop_there_is_a_hint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":4242")
    assert projector_driver.discover() == []
    with pytest.raises(DeviceNotFound) as caught:
        _open()
    assert "kms" in (caught.value.hint or "")


def test_an_image_that_does_not_reach_the_renderer_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    projector = _open(windowed=[64, 48])
    try:
        monkeypatch.setattr(projector.window._sdl, "SDL_UpdateTexture", lambda *_: -1)
        with pytest.raises(DeviceError, match="cannot be loaded"):
            projector.load([np.zeros((48, 64), dtype=np.uint8)])
    finally:
        projector.close()


def test_a_window_that_was_closed_is_lost() -> None:
    projector = _open(windowed=[64, 48])
    try:
        projector.load([np.zeros((48, 64), dtype=np.uint8)])
        projector.show(0)
        event = (ctypes.c_uint32 * 14)(0x200, 0, 1, 14)  # SDL_WINDOWEVENT, close
        ctypes.CDLL("libSDL2-2.0.so.0").SDL_PushEvent(event)
        for _ in range(2):
            with pytest.raises(DeviceLost, match="closed"):
                projector.show(0)
    finally:
        projector.close()
    with pytest.raises(DeviceError):
        projector.load([])
