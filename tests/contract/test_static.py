"""The contract suite on a slide, and what a slide refuses."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from drivers.registry import open_projector
from scanner.clock import VirtualClock
from scanner.devices import ProjectorKind
from scanner.errors import ConfigError, DeviceError
from tests.contract.suite import ProjectorBench, ProjectorContract


class TestStaticProjector(ProjectorContract):
    @pytest.fixture(params=({"size": [320, 240]}, {"mode": "320x240@50", "refresh_hz": 50}))
    def bench(self, request: pytest.FixtureRequest) -> Iterator[ProjectorBench]:
        clock = VirtualClock()
        projector = open_projector("static", "grating 7", request.param, clock)
        yield ProjectorBench(projector, clock)
        projector.close()


def _picture(path: Path) -> np.ndarray:
    image = np.random.default_rng(5).integers(0, 256, (48, 64), dtype=np.uint8)
    cv2.imwrite(str(path), image)
    return image


def test_a_slide_takes_its_own_pattern_and_no_other(tmp_path: Path) -> None:
    image = _picture(tmp_path / "slide.png")
    slide = open_projector("static", "", {"picture": str(tmp_path / "slide.png")}, VirtualClock())
    assert slide.capabilities.kind is ProjectorKind.STATIC
    assert (slide.capabilities.width, slide.capabilities.height) == (64, 48)
    slide.load([image])
    slide.show(0)
    other = image.copy()
    other[:24] ^= 1
    with pytest.raises(DeviceError, match=r"another pattern.*50%"):
        slide.load([other])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, "size is not told"),
        ({"size": [64, 48], "mode": "48x64"}, "two ways"),
        ({"mode": "wide"}, "makes no sense"),
        ({"size": [0, 48]}, "cannot be"),
        ({"picture": "/no/slide.png"}, "is not there"),
        ({"size": [64, 48], "refresh_hz": 0}, "refresh_hz"),
        ({"sice": [64, 48]}, "unknown option 'sice'"),
    ],
)
def test_a_slide_that_makes_no_sense_is_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        open_projector("static", "", options, VirtualClock())
