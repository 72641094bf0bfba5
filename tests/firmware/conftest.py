"""The firmware, built once."""

from __future__ import annotations

import pytest

from tests.firmware.simavr import Simavr, build


@pytest.fixture(scope="session")
def simavr(tmp_path_factory: pytest.TempPathFactory) -> Simavr:
    return build(tmp_path_factory.mktemp("firmware"))
