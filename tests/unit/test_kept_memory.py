"""Memory that a worker frees stays its own, in every thread: the second frame takes no fresh pages."""

from __future__ import annotations

import subprocess
import sys

import pytest

FRAMES = """
import ctypes, resource, sys, threading
from service.kept_memory import keep_memory

assert sys.argv[1] == "as it is" or keep_memory()
faults = []

def work():
    for _ in range(4):
        before = resource.getrusage(resource.RUSAGE_THREAD).ru_minflt
        blocks = [bytearray(size << 20) for size in (1, 3, 5)]
        del blocks
        faults.append(resource.getrusage(resource.RUSAGE_THREAD).ru_minflt - before)

thread = threading.Thread(target=work)
thread.start()
thread.join()
print(*faults)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="counts the faults of one thread, which Linux alone tells")
def test_a_frame_takes_the_pages_of_the_one_before():
    def faults(how):
        ran = subprocess.run(
            [sys.executable, "-c", FRAMES, how], capture_output=True, text=True, check=True, timeout=20
        )
        return [int(word) for word in ran.stdout.split()]

    first, *others = faults("kept")
    assert first > 500
    assert max(others) < 50
    assert max(faults("as it is")[1:]) > 500  # or this would be no test
