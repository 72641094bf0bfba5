"""`fringed status`: a running daemon's devices, workers, jobs and disk, in words or as the daemon tells them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from typing import Annotated, Any

import typer

from scanner.endpoints import DEFAULT_ENDPOINT
from service.commands.options import AsJson
from service.terminal import print_facts, print_json, print_table


def status(
    connect: Annotated[
        str, typer.Option("--connect", metavar="ENDPOINT", help="The daemon's endpoint.")
    ] = DEFAULT_ENDPOINT,
    as_json: AsJson = False,
) -> int:
    """Ask a running daemon how it is: devices, workers, scans and disk.

    A scan without --connect has a daemon of its own, which ends with it and is not meant here.

    \b
    Examples:
      fringed status                                       of the service on this machine
      fringed status --connect ipc:///tmp/try.ipc --json   of one started with --endpoint
    """
    from scanner.client import Client  # noqa: PLC0415

    with Client(connect, name="fringed status") as client:
        content = client.status()
        scans = client.list_scans()
    if as_json:
        print_json({**content, "scans": scans})
        return 0
    print_facts(f"daemon {content['name']}", list(facts(content)))
    if scans:
        print_table("scans", ("id", "what", "state", "created", "reason"), map(row, scans))
    return 0


def facts(content: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The answer to `status` as pairs of name and words."""
    yield "rig", content["name"]
    devices = content["devices"]
    if devices is None:
        yield "devices", "not open: they open for the first scan, and after a failure for the next"
    else:
        for kind, device in devices.items():
            yield kind, _device(device)
    workers = content["workers"]
    yield "workers", "; ".join(map(_worker, workers)) or "none: scans wait until one has started"
    jobs = content["jobs"]
    yield "jobs", "; ".join(f"{job['method']} {job['state']} ({job['id']})" for job in jobs) or "none under way"
    if waiting := content["waiting_for_worker"]:
        yield "waiting", f"{waiting} captured and waiting for a worker"
    yield "spool", _spool(content["spool"])


def row(scan: Mapping[str, Any]) -> Sequence[str]:
    """A job of `scan.list` as a row of the table."""
    created = datetime.fromtimestamp(scan["created"]).astimezone()
    what = scan["method"] if scan["kind"] == "scan" else f"{scan['kind']} {scan['method']}"
    return scan["id"], what, scan["state"], created.strftime("%Y-%m-%d %H:%M:%S"), scan["reason"] or ""


def _device(device: Any) -> str:
    if not isinstance(device, Mapping):
        return "none" if device is None else str(device)
    told = dict(device)
    parts = [str(told.pop("name", "unnamed"))]
    if (width := told.pop("width", None)) and (height := told.pop("height", None)):
        parts.append(f"{width} x {height} px")
    if bits := told.pop("bits", None):
        parts.append(f"{bits} bits")
    if kind := told.pop("kind", None):
        parts.append(str(kind))
    return ", ".join(parts + [f"{name} {_flat(value)}" for name, value in told.items()])


def _worker(worker: Mapping[str, Any]) -> str:
    what = "idle" if worker["job"] is None else f"on {worker['job']}"
    return f"{worker['worker']} on {worker['host']} (process {worker['pid']}), {what}"


def _spool(spool: Mapping[str, Any]) -> str:
    limit = spool["limit_bytes"]
    most = "no limit" if limit is None else f"of {_gigabytes(limit)} at most"
    return f"{_gigabytes(spool['bytes'])}, {most}; {_gigabytes(spool['min_free_bytes'])} of the disk are kept free"


def _gigabytes(count: float) -> str:
    return f"{count / 1e9:.2f} GB" if count >= 1e8 or count == 0 else f"{count / 1e6:.1f} MB"


def _flat(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_flat(inner)}" for name, inner in value.items())
    if isinstance(value, list):
        return "; ".join(map(_flat, value)) or "none"
    return str(value)
