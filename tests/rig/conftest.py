"""Tests that need the kernel's virtual devices: they run in the guest that `make rig` boots, and nowhere else."""

from __future__ import annotations

import os

import pytest

IN_THE_GUEST = bool(os.environ.get("RIG_IN_A_BOX"))

collect_ignore_glob = [] if IN_THE_GUEST else ["test_*.py"]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if not IN_THE_GUEST:
        terminalreporter.write_line("tests/rig was left out: it runs in a guest with real kernel devices, `make rig`")
