"""The real firmware in simavr: built once a session, run by script in simulated time or on a pty in real time.

Where the tools are missing, tests that need them are not run and say so; setup/packages-firmware.txt lists them.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from tests.trigger_golden import Transcript

HERE = Path(__file__).parent
FIRMWARE = HERE.parents[1] / "drivers" / "serial_trigger" / "firmware"
MHZ = 16
BYTE_CYCLES = 1496
LAP_CYCLES = 8 << 16
PINS = ("CAM1", "CAM2", "SYNC", "LED")

NEEDED = {
    "make": shutil.which("make"),
    "cc": shutil.which("cc"),
    "gcc-avr": shutil.which("avr-gcc"),
    "avr-libc": Path("/usr/lib/avr/include/avr/io.h").exists(),
    "libsimavr-dev": Path("/usr/include/simavr/sim_avr.h").exists(),
}
MISSING = [name for name, there in NEEDED.items() if not there]


@dataclass(frozen=True)
class Simavr:
    """The two programs."""

    board: Path
    elf: Path
    started: int = 0
    """cycle at which the firmware's clock begins to count: scripts' times are since then"""


@dataclass(frozen=True)
class Log:
    """What a script's run gave, cycles since the reset."""

    lines: list[tuple[int, str]]
    pins: list[tuple[int, str, int]]
    inputs: list[tuple[int, str, int]]
    """edges on VSYNC and EXT, when the chip saw them"""
    started: int
    """cycle of the firmware's clock's first count, within a lap of its timer"""

    def transcript(self) -> Transcript:
        """In microseconds of the board's clock."""
        return Transcript(
            [((cycle - self.started) / MHZ, line) for cycle, line in self.lines],
            [((cycle - self.started) / MHZ, pin, level) for cycle, pin, level in self.pins],
        )

    def rises(self, pin: str) -> list[int]:
        """Cycles at which a pin or input went high."""
        return [cycle for cycle, name, level in [*self.pins, *self.inputs] if name == pin and level]

    def falls(self, pin: str) -> list[int]:
        """Cycles at which a pin or input went low."""
        return [cycle for cycle, name, level in [*self.pins, *self.inputs] if name == pin and not level]


def build(folder: Path) -> Simavr:
    """Build both; fails the test where that fails, and does not run it where a tool is missing."""
    if MISSING:
        pytest.skip(f"not run: {', '.join(MISSING)} missing; setup/packages-firmware.txt lists what these tests need")
    board = folder / "simavr_board"
    for command in (
        ["make", "-s", "-C", FIRMWARE, f"BUILD={folder}", "all"],
        ["cc", "-O2", "-Wall", "-Wextra", "-Werror", "-o", board, HERE / "simavr_board.c", "-lsimavr"],
    ):
        built = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
        assert built.returncode == 0, built.stderr
    simavr = Simavr(board, folder / "trigger.elf")
    return replace(simavr, started=run(simavr, [], 1_000).started)


def run(simavr: Simavr, actions: Sequence[tuple[float, str, Any]], end_us: float) -> Log:
    """Run a script; actions as `tests.trigger_golden.actions` gives them."""
    script = [*sorted(_script(actions), key=lambda row: row[0]), (round(end_us * MHZ), "end")]
    text = "".join(f"{simavr.started + cycle} {what}\n" for cycle, what in script)
    ran = subprocess.run(
        [simavr.board, simavr.elf, "script"], input=text, capture_output=True, text=True, check=False, timeout=60
    )
    assert ran.returncode == 0, ran.stderr
    return _log(ran.stdout)


@dataclass(frozen=True)
class Running:
    """The board in real time, its UART on the port `path`."""

    path: str
    process: subprocess.Popen[str]

    def stop_vsync(self) -> None:
        """No further edge comes on VSYNC."""
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()

    def unplug(self) -> None:
        """The port hangs up."""
        self.process.kill()


@contextmanager
def on_pty(simavr: Simavr, vsync_us: int = 0) -> Iterator[Running]:
    """The board in real time."""
    with subprocess.Popen(
        [simavr.board, simavr.elf, "pty", str(vsync_us)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        bufsize=1,
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("pty "):
                break
        else:
            pytest.fail("simavr_board gave no pty")
        try:
            yield Running(line.split()[1], process)
        finally:
            process.kill()


def _script(actions: Sequence[tuple[float, str, Any]]) -> Iterator[tuple[int, str]]:
    for t_us, what, value in actions:
        if what != "bytes":
            yield round(t_us * MHZ), f"{what} {value}"
            continue
        for place, byte in enumerate(value):  # the last one has wholly arrived at t_us
            yield round(t_us * MHZ) - (len(value) - place) * BYTE_CYCLES, f"byte {byte:02x}"


def _log(text: str) -> Log:
    log = Log([], [], [], 0)
    started = 0
    for row in text.splitlines():
        cycle, what, *rest = row.split(" ", 2)
        if not cycle.isdigit():
            continue  # simavr's own words
        if what == "line":
            log.lines.append((int(cycle), rest[0]))
        elif what == "lap":
            started = int(cycle) % LAP_CYCLES
        else:
            (log.pins if what in PINS else log.inputs).append((int(cycle), what, int(rest[0])))
    return Log(log.lines, log.pins, log.inputs, started)
