"""What a client waits for after the last exposure: XYZ and confidence in its memory, then all files on the disk.

    python bench/after_last_frame.py [--method pmp] [--scene casey2011/bust] [--scans 5] [--folder DIR]

Real processes on simulated devices, spool and scans in DIR (default: the temporary directory): daemon, devices process,
worker. Times are CLOCK_MONOTONIC from the end of the last fringe frame's exposure, as frames.jsonl has it; the clocks
of simulated devices run in real time. The client asks for scan.npz as soon as it is told of it, reads it from memory,
and has the points when `xyz` and `confidence` are arrays. Files are complete when the scan is done. Beside it, in the
same run: the bytes of scan.npz and cloud.ply written raw to the same folder, with the same fsync. The worker's own
stages come from the report. Medians; the first scan is not counted.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from scanner.client import Client
from service.config import RigConfig

PIECE = 4 << 20


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
        for _ in range(given.scans + 1):
            rows.append(one_scan(client, given.method, Path(name)))
    for key in dict.fromkeys(key for row in rows for key in row):
        values = [row[key] for row in rows[1:] if key in row]
        print(f"{key:44s}{np.median(values):9.1f} ({min(values):.1f})")


def one_scan(client: Client, method: str, folder: Path) -> dict[str, float]:
    """Milliseconds by what they are of, of one scan, which is deleted afterwards."""
    job = client.start_scan(method)
    told: dict[str, int] = {}
    for event in client.events(job, patience_s=120):
        told.setdefault(event.kind, time.monotonic_ns())
        if event.kind == "decoded":
            size = next(entry["bytes"] for entry in event.fields["files"] if entry["name"] == "scan.npz")
            with np.load(io.BytesIO(fetched(client, job, size))) as content:
                points, confidence = content["xyz"], content["confidence"]
            told["points"] = time.monotonic_ns()
            assert points.shape[:2] == confidence.shape
    outcome = client.result(job)
    assert outcome["state"] == "done", outcome["error"]
    sizes = {entry["name"]: entry["bytes"] for entry in outcome["files"]}
    report = json.loads(fetched(client, job, sizes["report.json"], "report.json"))
    lines = fetched(client, job, sizes["capture/frames.jsonl"], "capture/frames.jsonl").decode().splitlines()
    end_ns = max(r["exposure"]["end_ns"] for r in map(json.loads, lines) if r["status"] == "ok")
    last = {name: (at - end_ns) / 1e6 for name, at in told.items()}
    found = {
        "told that it is decoded": last["decoded"],
        "XYZ and confidence in the client's memory": last["points"],
        "told that all is done": last["done"],
    }
    found |= {f"  worker: {stage}": 1e3 * seconds for stage, seconds in report["timings"].items()}
    files = sum(report["timings"].get(f"write {name}", 0.0) for name in ("scan.npz", "cloud.ply"))
    own = raw(folder / "raw", sizes["scan.npz"]) + raw(folder / "raw", sizes["cloud.ply"])
    found |= {"scan.npz and cloud.ply": 1e3 * files, "the same bytes raw": 1e3 * own, "  ratio": files / own}
    client.delete(job)
    return found


def fetched(client: Client, job: str, size: int, name: str = "scan.npz") -> bytes:
    """A file of a scan, in memory."""
    pieces = []
    for offset in range(0, size, PIECE):
        length = min(PIECE, size - offset)
        pieces.append(client.call("scan.fetch", id=job, name=name, offset=offset, length=length))
    return b"".join(pieces)


def raw(path: Path, size: int) -> float:
    """Seconds to write so many bytes."""
    content = np.random.default_rng(0).bytes(size)
    began = time.perf_counter()
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    return time.perf_counter() - began


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
