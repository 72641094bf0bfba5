"""The contract suite on the camera that the documentation gives as an example, and the page that shows it."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from scanner.clock import VirtualClock
from scanner.devices import CameraSettings, ChecksOptions, TriggerMode
from scanner.errors import ConfigError, DeviceError, DeviceNotFound
from tests.contract.suite import CameraBench, CameraContract

DOCS = Path(__file__).parents[2] / "docs"
EXAMPLE = DOCS / "examples" / "wedge_camera.py"


@pytest.fixture
def driver() -> Any:
    spec = importlib.util.spec_from_file_location("wedge_camera", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.driver


class TestExampleCamera(CameraContract):
    @pytest.fixture
    def bench(self, driver: Any) -> Iterator[CameraBench]:
        clock = VirtualClock()
        camera = driver.open("", {}, clock)
        yield CameraBench(camera, clock)
        camera.close()


def test_the_example_driver_refuses_as_the_page_says(driver: Any) -> None:
    assert isinstance(driver, ChecksOptions)
    ((option, _),) = driver.check("", {"colour": 1})
    assert option == "colour"
    with pytest.raises(ConfigError, match="colour"):
        driver.open("", {"colour": 1}, VirtualClock())
    with pytest.raises(DeviceNotFound):
        driver.open("7", {}, VirtualClock())
    (found,) = driver.discover()
    camera = driver.open(found.device, {}, VirtualClock())
    camera.start(TriggerMode.FREE)
    with pytest.raises(DeviceError):
        camera.start(TriggerMode.FREE)
    camera.close()
    for call in (lambda: camera.apply(CameraSettings()), camera.trigger, lambda: camera.pop(0)):
        with pytest.raises(DeviceError):
            call()


def test_the_page_shows_the_example_as_it_is() -> None:
    page = (DOCS / "how-to" / "add-a-driver.md").read_text()
    assert f"```python\n{EXAMPLE.read_text()}```\n" in page
