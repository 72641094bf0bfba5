"""What stands at the top of the repository: the rooms of the house and its papers, and nothing that a change took along
by mistake."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

TOP = Path(__file__).parents[2]
ROOMS = {"bench", "changelog.d", "docs", "drivers", "scanner", "service", "setup", "systemd", "tests", "udev", ".ci"}
PAPERS = {".gitignore", "CHANGELOG.md", "LICENSE", "Makefile", "README.md", "pyproject.toml"}


@pytest.mark.skipif(shutil.which("git") is None or not (TOP / ".git").exists(), reason="no clone")
def test_nothing_stands_at_the_top_that_does_not_belong_there() -> None:
    asked = subprocess.run(["git", "ls-files", "-z"], cwd=TOP, capture_output=True, check=False)
    if asked.returncode:
        pytest.skip(f"git does not answer here: {asked.stderr.decode().strip()}")
    assert {name.split("/")[0] for name in asked.stdout.decode().split("\0") if name} == ROOMS | PAPERS
