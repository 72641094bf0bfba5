"""What a client waits for after the last exposure: XYZ and confidence in its memory, then all files on the disk.

    python bench/after_last_frame.py [--method pmp] [--scene casey2011/bust] [--scans 5] [--folder DIR]

Real processes on simulated devices, spool and scans in DIR (default: the temporary directory): daemon, devices process,
worker. Times are CLOCK_MONOTONIC from the end of the last frame's exposure, as frames.jsonl has it; the clocks of
simulated devices run in real time. The client asks for the points when it is told that they are there, and has them
when `xyz` and `confidence` are arrays. The worker's own stages come from the report; of several frames all but the
check are over before the last exposure ends. Medians, least and most; the first scan is not counted.

What the simulation costs: the camera gives its last frame 5 ms after the exposure (`readout`), which the frame's event
follows; and its pictures take processor time of the devices process, told for the whole scan beside that of the others.

Then the files by themselves, in this process: the last scan saved again and again, in turn with the same bytes written
raw to the same folder with the same fsync, in DIR and in memory (/dev/shm, where no disk plays a part). Ratios are of
neighbours in time, since disks change their pace.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scanner.client import Client
from scanner.scan import Scan, load_scan
from service.config import RigConfig

PIECE = 4 << 20
FILES = 9
"""Times that the files are saved"""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", default="pmp")
    parser.add_argument("--scene", default="casey2011/bust")
    parser.add_argument("--scans", type=int, default=5)
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    rows: list[dict[str, float]] = []
    with (
        tempfile.TemporaryDirectory(prefix="fringed-bench-", dir=given.folder) as name,
        daemon_with_worker(Path(name), given.scene) as client,
    ):
        for number in range(given.scans + 1):
            rows.append(one_scan(client, given.method, Path(name) / "last" if number == given.scans else None))
        scan = load_scan(Path(name) / "last")
        files = [files_and_raw(scan, Path(name) / "files") for _ in range(1 + FILES)][1:]
    show(rows[1:])
    with tempfile.TemporaryDirectory(prefix="fringed-bench-", dir="/dev/shm") as memory:
        in_memory = [files_and_raw(scan, Path(memory)) for _ in range(1 + FILES)][1:]
    for where, found in (("on the disk", files), ("in memory", in_memory)):
        print(f"scan.npz and cloud.ply, {where}")
        show(found)


def show(rows: list[dict[str, float]]) -> None:
    """Print medians, and from where to where the values go."""
    for key in dict.fromkeys(key for row in rows for key in row):
        values = [row[key] for row in rows if key in row]
        print(f"{key:44s}{np.median(values):9.2f} ({min(values):.2f} to {max(values):.2f})")


def one_scan(client: Client, method: str, folder: Path | None) -> dict[str, float]:
    """Milliseconds by what they are of, of one scan, which is deleted afterwards; its files go to `folder`."""
    job = client.start_scan(method)
    told: dict[str, int] = {}
    before = processor_ms(client)
    for event in client.events(job, patience_s=120):
        told.setdefault(event.kind, time.monotonic_ns())
        if event.kind == "frame" and event.fields["captured"] == event.fields["total"]:
            told["all"] = time.monotonic_ns()
        if event.kind == "points":
            arrays = client.arrays(event)
            told["here"] = time.monotonic_ns()
            assert arrays["xyz"].shape[:2] == arrays["confidence"].shape
    spent = {name: ms - before[name] for name, ms in processor_ms(client).items()}
    outcome = client.result(job)
    assert outcome["state"] == "done", outcome["error"]
    sizes = {entry["name"]: entry["bytes"] for entry in outcome["files"]}
    report = json.loads(fetched(client, job, sizes["report.json"], "report.json"))
    lines = fetched(client, job, sizes["capture/frames.jsonl"], "capture/frames.jsonl").decode().splitlines()
    end_ns = max(r["exposure"]["end_ns"] for r in map(json.loads, lines) if r["status"] == "ok")
    last = {name: (at - end_ns) / 1e6 for name, at in told.items()}
    found = {
        "told that the last frame is there": last["all"],
        "told that the points are there": last["points"],
        "XYZ and confidence in the client's memory": last["here"],
        "told that the capture is on the disk": last["acquired"],
        "told that scan.npz is whole": last["decoded"],
        "told that all is done": last["done"],
    }
    found |= {f"  worker: {stage}": 1e3 * seconds for stage, seconds in report["timings"].items()}
    found |= {f"  processor time, whole scan: {name}": ms for name, ms in spent.items()}
    if folder is not None:
        client.fetch(job, folder)
    client.delete(job)
    return found


def processor_ms(client: Client) -> dict[str, float]:
    """Processor time so far of the daemon, its two children and this client, ms."""
    daemon = int(client.hello()["daemon"]["pid"])
    spent = {"client": 1e3 * time.process_time()}
    for pid in (daemon, *map(int, Path(f"/proc/{daemon}/task/{daemon}/children").read_text().split())):
        words = Path(f"/proc/{pid}/cmdline").read_bytes()
        name = "devices, simulation and all" if b"devices_process" in words else "worker" if pid != daemon else "daemon"
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        spent[name] = 1e3 * (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return spent


def fetched(client: Client, job: str, size: int, name: str = "scan.npz") -> bytes:
    """A file of a scan, in memory."""
    pieces = []
    for offset in range(0, size, PIECE):
        length = min(PIECE, size - offset)
        pieces.append(client.call("scan.fetch", id=job, name=name, offset=offset, length=length))
    return b"".join(pieces)


def files_and_raw(scan: Scan, folder: Path) -> dict[str, float]:
    """Milliseconds until both files are whole in a folder, and until their bytes are written raw; nothing stays."""
    told: dict[str, float] = {}
    fresh = replace(scan, report={})  # with no normals made yet
    shutil.rmtree(folder / "scan", ignore_errors=True)
    began = time.perf_counter()

    def whole(name: str) -> None:
        told[name] = time.perf_counter() - began
        if name == "cloud.ply":
            raise _BothThereError

    with suppress(_BothThereError):
        fresh.save(folder / "scan", whole)
    contents = [(folder / "scan" / name).read_bytes() for name in told]
    began = time.perf_counter()
    for name, content in zip(told, contents, strict=True):
        with (folder / "scan" / f"raw-{name}").open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    raw = time.perf_counter() - began
    return {
        "  both whole": 1e3 * told["cloud.ply"],
        "  the same bytes raw": 1e3 * raw,
        "  ratio": told["cloud.ply"] / raw,
    }


class _BothThereError(Exception):
    """Ends a save whose picture and report are not waited for."""


@contextmanager
def daemon_with_worker(folder: Path, scene: str) -> Iterator[Client]:
    """A daemon that keeps everything in `folder`, with one worker, once that is ready."""
    endpoint = f"ipc://{folder}/control.ipc"
    device = {"driver": "simulated", "device": scene}
    parts: dict[str, Any] = {
        "camera": device,
        "projector": device,
        "daemon": {"endpoint": endpoint, "spool": str(folder / "spool"), "retention": {"min_free_gb": 0.0}},
    }
    rig = folder / "rig.toml"
    rig.write_text(RigConfig.model_validate(parts).as_toml())
    command = [sys.executable, "-m", "service.daemon", "--config", str(rig), "--state", str(folder), "--lifeline"]
    with (folder / "log").open("wb") as log:
        daemon = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log)
        assert daemon.stdout is not None
        assert daemon.stdin is not None
        try:
            assert daemon.stdout.readline() == b"ready\n", (folder / "log").read_text()
            with Client(endpoint, timeout_s=60) as client:
                while not (client.status()["workers"] and client.status()["devices"]):
                    time.sleep(0.1)
                yield client
                client.shutdown()
        finally:
            daemon.stdin.close()
            daemon.stdout.close()
            daemon.wait()


if __name__ == "__main__":
    main()
