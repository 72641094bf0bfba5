"""How fast frames go from the sequencer to a worker, through spool and ZeroMQ, and whether memory and spool stay flat.

    python bench/streaming.py [--frames 10000] [--disk DIR] [--memory DIR]

Real processes: daemon, devices process (simulated camera that hands out a ring of frames rendered beforehand, as fast
as it is asked), and a worker that maps each frame, checks its digest and decodes nothing. Series of 240 frames of
1392 x 1040, deleted once acknowledged. Two runs: the spool on a disk, against that disk's own sequential write rate
with fdatasync in the same run; and the spool on a memory file system. Exit status 1 where a limit is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from scanner.client import Client
from service.config import RigConfig

WIDTH, HEIGHT, SERIES = 1392, 1040, 240
FRAME_BYTES = WIDTH * HEIGHT
AHEAD = 2
"""Series that wait for the devices, so that they never wait for the client."""

LEAST_SHARE, LEAST_RATE = 0.80, 600.0
RATE_FRAMES = 6 * SERIES
"""Length of the file that tells the disk's own rate: 2.1 GB, longer than what a run has in the spool."""

SERIES_MB = SERIES * FRAME_BYTES / 1e6
FLAT_MB = {"spool": SERIES_MB / 2}
FLAT_MEMORY_MB = 10.0
"""Drift over a run (slope of a straight line through all samples, times the run) that counts as flat. Allocators
breathe by a few MB. The spool holds the series being written and at times the one before, so that a sample lies
anywhere within one series: the slope of 42 such samples is uncertain by a sixth of a series over the run, and half a
series is three times that. A leak of one hundredth of each series would be seen."""

MOST_SPOOL_MB = (AHEAD + 1 + 0.1) * SERIES_MB
"""The series that is about to be deleted, those that were started ahead of it, and their lines."""


@dataclass
class Samples:
    """Resident memory (own pages, not mapped files) by process, and bytes in the spool, over the run. MB."""

    memory: dict[str, list[float]] = field(default_factory=dict)
    spool: list[float] = field(default_factory=list)

    def take(self, processes: dict[str, int], spool: Path) -> None:
        """One sample of everything."""
        for name, pid in processes.items():
            self.memory.setdefault(name, []).append(own_memory_mb(pid))
        self.spool.append(spool_mb(spool))

    def drift(self) -> dict[str, float]:
        """Slope of a straight line through the samples, times the length of the run, MB."""
        return {name: _drift(values) for name, values in {**self.memory, "spool": self.spool}.items()}


def run(spool: Path, frames: int, label: str, *, disk: bool) -> dict[str, object]:
    """Stream `frames` frames through `spool`; prints as it goes and returns the figures."""
    own_rates = [write_rate(spool)] if disk else []
    samples = Samples()
    with streaming_daemon(spool) as (client, processes):
        stream(client, SERIES, samples, processes, spool)  # kernels, caches and page tables are warm after it
        began, samples = time.perf_counter(), Samples()
        count = stream(client, frames, samples, processes, spool)
        seconds = time.perf_counter() - began
        left = spool_mb(spool)
    own_rates += [write_rate(spool)] if disk else []
    rate = count / seconds
    found: dict[str, object] = {
        "spool": label,
        "frames": count,
        "frames_per_s": round(rate, 1),
        "MB_per_s": round(rate * FRAME_BYTES / 1e6, 1),
        "drift_MB": samples.drift(),
        "memory_MB": {name: round(values[-1], 1) for name, values in samples.memory.items()},
        "spool_MB_max": round(max(samples.spool), 1),
        "spool_MB_left": round(left, 1),
    }
    if disk:
        own = sum(own_rates) / len(own_rates)
        found |= {"disk_MB_per_s": [round(r / 1e6, 1) for r in own_rates], "share": round(rate * FRAME_BYTES / own, 3)}
    print(json.dumps(found), flush=True)
    return found


def stream(client: Client, frames: int, samples: Samples, processes: dict[str, int], spool: Path) -> int:
    """Series after series, the next ones waiting while one runs; returns the frames that were acknowledged."""
    series = -(-frames // SERIES)
    waiting: deque[str] = deque()
    started = 0
    for _ in range(series):
        while started < series and len(waiting) <= AHEAD:
            waiting.append(client.start_scan("mcp", repeat=SERIES))
            started += 1
        job = waiting.popleft()
        outcome = client.wait(job)
        assert outcome["state"] == "done", outcome
        assert outcome["report"]["frames"] == SERIES, outcome
        samples.take(processes, spool)
        client.delete(job)
    return series * SERIES


@contextmanager
def streaming_daemon(spool: Path) -> Iterator[tuple[Client, dict[str, int]]]:
    """A daemon with its spool there, and one worker that discards."""
    with tempfile.TemporaryDirectory(prefix="fringed-bench-", dir=spool) as state:
        endpoint = f"ipc://{state}/control.ipc"
        rig = Path(state) / "rig.toml"
        rig.write_text(streaming_rig(endpoint, spool / "series").as_toml())
        command = [sys.executable, "-m", "service.daemon", "--config", str(rig), "--state", state, "--lifeline"]
        log = (Path(state) / "log").open("wb")
        daemon = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log)
        assert daemon.stdout is not None
        assert daemon.stdout.readline() == b"ready\n"
        command = [sys.executable, "-m", "service.worker", "--discard", "--connect", endpoint]
        worker = subprocess.Popen(command, stderr=log)
        try:
            with Client(endpoint, timeout_s=60) as client:
                while not ((status := client.status())["workers"] and status["devices"]):
                    time.sleep(0.1)
                yield client, {"daemon": daemon.pid, "worker": worker.pid, "devices": child_of(daemon.pid)}
                client.shutdown()
        finally:
            for pipe in (daemon.stdin, daemon.stdout, log):
                assert pipe is not None
                pipe.close()
            daemon.wait()
            worker.wait()


def streaming_rig(endpoint: str, spool: Path) -> RigConfig:
    """A static projector with an MCP pattern, and a camera that gives its ring as fast as it is asked."""
    return RigConfig.model_validate(
        {
            "camera": {
                "driver": "simulated",
                "device": "casey2011/bust",
                "settings": {"exposure_us": 1000.0},
                "options": {"ring": 4, "period_us": 0.0},
            },
            "projector": {
                "driver": "simulated",
                "device": "casey2011/bust",
                "options": {"kind": "static", "modulation": "none"},
            },
            "daemon": {"endpoint": endpoint, "spool": str(spool), "workers": 0, "retention": {"min_free_gb": 0.0}},
        }
    )


def write_rate(folder: Path) -> float:
    """Bytes a second that the disk takes: one large file, frame after frame, fdatasync at the end (as dd does)."""
    frame = os.urandom(FRAME_BYTES)
    path = folder / "rate"
    rates = []
    for _ in range(3):
        descriptor = os.open(path, os.O_CREAT | os.O_WRONLY, 0o600)
        try:
            began = time.perf_counter()
            for _ in range(RATE_FRAMES):
                os.write(descriptor, frame)
            os.fdatasync(descriptor)
            rates.append(RATE_FRAMES * FRAME_BYTES / (time.perf_counter() - began))
        finally:
            os.close(descriptor)
            path.unlink()
    return sorted(rates)[1]


def spool_mb(spool: Path) -> float:
    """Room that files take there, MB. Files may vanish while they are counted."""
    total = 0
    for path in spool.rglob("*"):
        with suppress(FileNotFoundError):
            total += path.stat().st_blocks * 512
    return total / 1e6


def own_memory_mb(pid: int) -> float:
    """Anonymous resident memory of a process: mapped spool files are page cache, which others may have."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1]) / 1e3
    raise AssertionError("no RssAnon in /proc/PID/status")


def child_of(pid: int) -> int:
    """The only child of a process."""
    (child,) = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return int(child)


def _drift(values: list[float]) -> float:
    at = np.arange(len(values))
    return round(float(np.polyfit(at, values, 1)[0]) * len(values), 1)


def main() -> int:
    """Both runs; 1 where a limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--disk", type=Path, default=Path(), help="a folder on the disk to measure")
    parser.add_argument("--memory", type=Path, default=Path("/dev/shm"), help="a folder on a memory file system")  # noqa: S108
    given = parser.parse_args()
    problems = []
    for place, disk in ((given.disk, True), (given.memory, False)):
        with tempfile.TemporaryDirectory(prefix="fringed-bench-", dir=place.absolute()) as spool:
            found = run(Path(spool), given.frames, str(place), disk=disk)
        if disk and float(str(found["share"])) < LEAST_SHARE:
            problems.append(f"{found['share']} of the disk's own rate, {LEAST_SHARE} wanted")
        if not disk and float(str(found["frames_per_s"])) < LEAST_RATE:
            problems.append(f"{found['frames_per_s']} frames a second from memory, {LEAST_RATE:g} wanted")
        drift = found["drift_MB"]
        assert isinstance(drift, dict)
        problems += [f"{name} grew by {mb} MB" for name, mb in drift.items() if mb > FLAT_MB.get(name, FLAT_MEMORY_MB)]
        if float(str(found["spool_MB_max"])) > MOST_SPOOL_MB:
            problems.append(f"{found['spool_MB_max']} MB in the spool at once, {MOST_SPOOL_MB:.0f} at most")
        if float(str(found["spool_MB_left"])) > 1.0:
            problems.append(f"{found['spool_MB_left']} MB left in the spool after the last series was deleted")
    for problem in problems:
        print(f"missed: {problem}", file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
