"""A client's process in the guest, run as some user: obeys lines of JSON, and tells everything with the time it came.

["scan", {...}] starts a scan and tells its events; with "folder" its files are fetched. ["until", true] polls until the
daemon has devices, false until it has none. ["status", {}] asks once. ["preview", {...}] and ["live", {...}] start one,
tell of the first picture, and go on until ["leave", {}].
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Generator
from contextlib import closing
from pathlib import Path
from typing import Any

from scanner.client import Client
from scanner.errors import ScannerError


def tell(kind: str, **fields: Any) -> None:
    print(json.dumps({"kind": kind, "t": time.monotonic(), **fields}, default=str), flush=True)


def scan(client: Client, params: dict[str, Any]) -> None:
    folder = params.pop("folder", None)
    job = client.start_scan(**params)
    for event in client.events(job):
        tell(event.kind, fields=event.fields)
    outcome = client.result(job)
    if folder is not None and outcome["state"] == "done":
        client.fetch(job, Path(folder))
    tell("over", **outcome)


def until(client: Client, there: bool) -> None:
    while (client.status()["devices"] is not None) != there:
        time.sleep(0.02)
    tell("until")


def watch(client: Client, kind: str, params: dict[str, Any]) -> Generator[None, None, None]:
    """A preview, or a live run: goes on from its first picture until it is closed."""
    with closing(client.previews(**params)) if kind == "preview" else client.live(**params) as pictures:
        next(pictures)
        tell(kind)
        yield
    tell("left")


def main() -> int:
    try:
        with Client(sys.argv[1], name="visitor") as client:
            watching = None
            tell("hello", **client.hello())
            for line in sys.stdin:
                word, what = json.loads(line)
                match word:
                    case "scan":
                        scan(client, what)
                    case "until":
                        until(client, what)
                    case "preview" | "live":
                        next(watching := watch(client, word, what))
                    case "leave":
                        next(watching, None)
                    case "status":
                        tell("status", **client.status())
    except ScannerError as error:
        tell("error", type=type(error).__name__, message=str(error), hint=error.hint)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
