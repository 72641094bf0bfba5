"""Tests that need the kernel's virtual devices: they run in the guest that `make rig` boots, and nowhere else."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.rig.installed import Visitor

MODE = os.environ.get("RIG_IN_A_BOX")
"""How the guest was booted: "fast" for the drivers, "steady" for drivers in time, "systemd" for the service; None: this
is no guest"""

LEFT_OUT = {None: ["test_*.py"], "fast": ["test_installed*.py", "test_steady*.py"], "steady": [], "systemd": []}

collect_ignore_glob = LEFT_OUT[MODE]


@pytest.fixture(scope="session")
def installed() -> None:
    """The service, installed as an administrator does it, and not started."""
    from tests.rig.installed import install  # noqa: PLC0415  (of the guest alone)

    install()


@pytest.fixture(scope="session")
def ada() -> Iterator[Visitor]:
    """A member of the clients' group who has said hello to the service; one for all tests, as it starts slowly."""
    from tests.rig.installed import MEMBER, Visitor  # noqa: PLC0415  (of the guest alone)

    with Visitor(MEMBER) as visitor:
        visitor.hear("hello")
        yield visitor


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if MODE is None:
        terminalreporter.write_line("tests/rig was left out: it runs in a guest with real kernel devices, `make rig`")
