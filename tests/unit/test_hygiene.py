"""The suite's own promise: what a test leaves behind is found and named."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

CONFTEST = Path(__file__).parents[1] / "conftest.py"

UNTIDY = """
import socket, subprocess, tempfile, threading

kept = []

def test_process():
    subprocess.run(["sh", "-c", "setsid sleep 20 >&- 2>&- &"], check=True)

def test_thread():
    threading.Thread(target=threading.Event().wait, args=(20,), daemon=True, name="wanderer").start()

def test_socket():
    kept.append(socket.socketpair())

def test_file():
    tempfile.mkdtemp(prefix="leftover-")

def test_working_directory():
    open("dropped.txt", "w").close()

def test_tidy():
    with tempfile.TemporaryDirectory(), socket.socket():
        subprocess.run(["true"], check=True)
"""


def test_every_kind_of_leftover_is_named(tmp_path: Path) -> None:
    # The same rules in a session of their own, impatient, since nothing here is going to tidy up.
    (tmp_path / "conftest.py").write_text(CONFTEST.read_text().replace("PATIENCE_S = 2.0", "PATIENCE_S = 0.1"))
    (tmp_path / "test_untidy.py").write_text(UNTIDY)
    ran = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-rN",
            "-p",
            "no:cacheprovider",
            "--basetemp",
            tmp_path / "base",
            tmp_path,
        ],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    left = {line.split(" left behind: ")[0].split()[-1]: line for line in ran.stdout.splitlines() if "left be" in line}
    found = re.search(r"process (\d+) \(.*sleep 20", left["test_process"])
    assert found
    os.kill(int(found[1]), signal.SIGKILL)
    assert "thread wanderer" in left["test_thread"]
    assert "socket" in left["test_socket"]
    assert "leftover-" in left["test_file"]
    assert "dropped.txt" in left["test_working_directory"]
    assert "test_tidy" not in left
