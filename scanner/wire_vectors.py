"""Recorded bytes of every message, for clients in other languages: `python -m scanner.wire_vectors docs/reference`.

Writes protocol-vectors.json and the examples in protocol.md between their marks, from the same types as the code.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from scanner.errors import DeviceLost, SyncError
from scanner.stream import (
    Ack,
    Alive,
    Cancel,
    DecodedNote,
    End,
    Failed,
    Frame,
    Identify,
    Leaving,
    LiveBegin,
    LiveCounts,
    LiveFrame,
    PointsNote,
    Progress,
    Ready,
    Released,
    Result,
    Start,
    Stop,
)
from scanner.wire import (
    PROTOCOL,
    ArrayEntry,
    Event,
    FileEntry,
    Notification,
    Refused,
    Request,
    Response,
    encode,
    error_body,
)
from scanner.wire_images import LiveHeader, PreviewHeader, encode_image

JOB = "0b3e3a52-9f0e-4c52-8a55-3f1d8f3b6a11"
DELIVERY = 1753233956852223
SHA = "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08"
BEGIN, END = "<!-- examples: begin -->", "<!-- examples: end -->"

_FILE = FileEntry("scan.npz", 2843430, SHA)
_ARRAYS = (
    ArrayEntry("xyz", "<f4", (240, 320, 3), 165, 921600),
    ArrayEntry("confidence", "<f4", (240, 320), 922092, 307200),
)

LIVE_JOB = "5d0e2f7c-7c1a-4b0e-9a53-0a4f5f7f1d22"

_LIVE = {
    "endpoint": "ipc:///run/fringed/live.ipc",
    "content": "xyz",
    "stride": 2,
    "retain": "ring",
    "seconds": 12.5,
    "captured": 750,
    "lost": 0,
    "decoded": 740,
    "undecodable": 2,
    "dropped": 7,
    "points": 1342868,
    "decode_ms": 14.2,
    "threads": 2,
    "problem": None,
    "frames_per_s": 60.0,
    "results_per_s": 59.5,
    "latency_ms": {"count": 742, "p50": 24.5, "p90": 31.0, "p99": 38.5, "max": 61.2},
    "recorded": {"frames": 512, "bytes": 741212160},
    "header": None,
    "calibration": None,
}

CALLS: tuple[tuple[str, dict[str, Any], Any], ...] = (
    (
        "hello",
        {"protocol": list(PROTOCOL), "client": "example"},
        {
            "protocol": list(PROTOCOL),
            "daemon": {"name": "bench", "version": "0.1.0", "pid": 4711},
            "features": ["hello", "status", "scan.start"],
            "limits": {
                "request_bytes": 16384,
                "message_bytes": 8388608,
                "fetch_bytes": 4194304,
                "queued_scans": 256,
            },
            "endpoints": {
                "events": "ipc:///run/fringed/events.ipc",
                "preview": "ipc:///run/fringed/preview.ipc",
                "live": "ipc:///run/fringed/live.ipc",
                "worker": "ipc:///run/fringed/worker.ipc",
            },
        },
    ),
    (
        "status",
        {},
        {
            "number": 41,
            "name": "bench",
            "devices": {
                "camera": {"name": "simulated camera quick/board", "width": 320, "height": 240, "bits": 8},
                "projector": {
                    "name": "simulated projector quick/board",
                    "width": 320,
                    "height": 240,
                    "kind": "framebuffer",
                },
            },
            "workers": [{"worker": "rig-812", "pid": 812, "host": "rig", "decode": True, "job": None}],
            "waiting_for_worker": 0,
            "jobs": [],
            "spool": {"bytes": 13508608, "limit_bytes": None, "min_free_bytes": 1000000000},
        },
    ),
    (
        "devices.list",
        {},
        {
            "devices": [
                {
                    "driver": "simulated",
                    "device": "quick/bust",
                    "kind": "camera",
                    "model": "simulated rig quick",
                    "details": {"width": 320, "height": 240},
                }
            ]
        },
    ),
    (
        "scan.start",
        {
            "job_id": JOB,
            "method": "pmp",
            "pattern": {"frequencies": [1, 8, 64], "shifts": [8, 8, 8]},
            "exposure": "auto",
            "filters": {"edges": True, "depth": [1100.0, 1400.0]},
        },
        {
            "number": 42,
            "id": JOB,
            "kind": "scan",
            "method": "pmp",
            "state": "queued",
            "reason": None,
            "captured": 0,
            "total": 0,
            "stage": "",
            "created": 1795311639.25,
            "ended": None,
            "acknowledged": False,
            "deleted": False,
            "error": None,
        },
    ),
    (
        "scan.status",
        {"id": JOB},
        {
            "number": 57,
            "id": JOB,
            "kind": "scan",
            "method": "pmp",
            "state": "acquiring",
            "reason": None,
            "captured": 11,
            "total": 31,
            "stage": "",
            "created": 1795311639.25,
            "ended": None,
            "acknowledged": False,
            "deleted": False,
            "error": None,
        },
    ),
    (
        "scan.result",
        {"id": JOB},
        {
            "id": JOB,
            "state": "done",
            "reason": "completed",
            "report": {"points": 76800},
            "files": [msgspec.to_builtins(_FILE)],
            "error": None,
        },
    ),
    ("scan.fetch", {"id": JOB, "name": "scan.npz", "offset": 0, "length": 4}, b"PK\x03\x04"),
    ("scan.acknowledge", {"id": JOB}, {"number": 90, "id": JOB, "state": "done", "acknowledged": True}),
    ("scan.cancel", {"id": JOB}, {"number": 58, "id": JOB, "state": "cancelled", "reason": "cancelled"}),
    ("scan.list", {}, {"number": 90, "scans": [{"id": JOB, "state": "done"}]}),
    ("scan.delete", {"id": JOB}, {"number": 91, "id": JOB, "state": "done", "deleted": True}),
    (
        "live.start",
        {"job_id": LIVE_JOB, "content": "xyz", "stride": 2, "retain": "ring", "ring_s": 10.0},
        {
            "number": 95,
            "id": LIVE_JOB,
            "kind": "live",
            "method": "mcp",
            "state": "queued",
            "reason": None,
            "captured": 0,
            "total": 0,
            "stage": "",
            "created": 1795311700.5,
            "ended": None,
            "acknowledged": False,
            "deleted": False,
            "error": None,
            "endpoint": "ipc:///run/fringed/live.ipc",
        },
    ),
    ("live.status", {}, {"number": 99, "run": {"id": LIVE_JOB, "kind": "live", "state": "acquiring", "live": _LIVE}}),
    ("live.stop", {"id": LIVE_JOB}, {"number": 104, "id": LIVE_JOB, "kind": "live", "state": "acquired"}),
    ("preview.start", {"rate_hz": 10.0, "max_width": 480}, {"endpoint": "ipc:///run/fringed/preview.ipc"}),
    ("preview.stop", {}, {}),
    ("shutdown", {}, {}),
)

EVENTS: tuple[Event, ...] = (
    Event(42, "queued", JOB, {"state": "queued"}),
    Event(44, "frame", JOB, {"state": "acquiring", "captured": 11, "total": 31, "retakes": 0}),
    Event(97, "live.counts", LIVE_JOB, {"state": "acquiring", "captured": 690, "decoded": 681, "dropped": 7}),
    Event(60, "decoding", JOB, {"state": "decoding", "stage": "triangulating"}),
    Event(
        62,
        "points",
        JOB,
        {"state": "acquiring", "file": "scan.npz", "arrays": [msgspec.to_builtins(array) for array in _ARRAYS]},
    ),
    Event(61, "worker.lost", None, {"worker": "rig-812", "why": "ended with status -9"}),
)

ERRORS: tuple[tuple[str, Response], ...] = (
    (
        "error: unknown method",
        Response(
            id=7, error=error_body(Refused("unknown method 'scan.begin'", reason="unknown_method", hint="methods: ..."))
        ),
    ),
    (
        "error: not MessagePack",
        Response(id=None, error=error_body(Refused("not MessagePack: ...", reason="malformed"))),
    ),
    (
        "error: of a device",
        Response(id=8, error=error_body(DeviceLost("no answer", device="camera 0", hint="check its cable"))),
    ),
    (
        "error: out of step",
        Response(id=9, error=error_body(SyncError("frames 7, 8 out of step", frames=(7, 8), hint="longer dwell"))),
    ),
)

STREAM: tuple[Struct, ...] = (
    Ready(protocol=PROTOCOL, worker="rig-812", pid=812, host="rig"),
    Start(DELIVERY, JOB, f"/spool/{JOB}/capture", f"/spool/{JOB}/scan-{DELIVERY}", {"decoder": "default"}),
    Frame(DELIVERY, 0, 0, 0, "ok", f"/spool/{JOB}/capture/frames.npy", 128, "c8d3a1f27e5b9064"),
    Ack(DELIVERY, 4),
    End(DELIVERY, "completed", 31, []),
    Progress(DELIVERY, "triangulating"),
    PointsNote(DELIVERY, list(_ARRAYS), 31),
    DecodedNote(DELIVERY, [_FILE], {"points": 76800}),
    LiveBegin(DELIVERY, LIVE_JOB, {"format": "fringed-capture"}, None, "ipc:///run/fringed/live.ipc", 0),
    LiveFrame(
        DELIVERY, 17, f"/spool/{LIVE_JOB}/capture/ring", 24610560, "c8d3a1f27e5b9064", 17, 10**12, 10**12 + 10**7
    ),
    LiveCounts(DELIVERY, 18, 15, 0, 2, [(49, 12), (50, 3)], 25.2, 14.2, 1342868, 2),
    Result(DELIVERY, [_FILE], {"points": 76800}),
    Failed(DELIVERY, error_body(SyncError("frames 7, 8 out of step", frames=(7, 8)))),
    Cancel(DELIVERY),
    Released(DELIVERY),
    Alive(),
    Identify(),
    Leaving(),
    Stop(),
)


def vectors() -> list[dict[str, str | Any]]:
    """Every example: {name, direction, message (as JSON), hex}. Bytes in a message are shown as {"bytes": hex}."""
    found = []
    for number, (method, params, result) in enumerate(CALLS, start=1):
        request, response = Request(id=number, method=method, params=params), Response(id=number, result=result)
        found.append(_vector(f"{method}: call", "client to daemon", request))
        found.append(_vector(f"{method}: answer", "daemon to client", response))
    found += [_vector(name, "daemon to client", response) for name, response in ERRORS]
    found += [_vector(f"event: {event.kind}", "daemon to subscribers", Notification(params=event)) for event in EVENTS]
    header = PreviewHeader(number=3, width=2, height=2, dtype="uint8", t_ns=1234567890, stride=4)
    found.append(
        {
            "name": "preview",
            "direction": "daemon to subscribers",
            "message": {"header": msgspec.to_builtins(header), "pixels": {"bytes": "00407fff"}},
            "hex": encode_image(header, bytes([0, 64, 127, 255])).hex(),
        }
    )
    live = LiveHeader(
        number=17,
        job=LIVE_JOB,
        content="rows",
        width=2,
        height=2,
        dtype="uint16",
        scale=75.0,
        points=3,
        frame_id=17,
        start_ns=10**12,
        end_ns=10**12 + 10**7,
        sent_ns=10**12 + 34 * 10**6,
        decode_ms=14.2,
    )
    rows = bytes.fromhex("000026007100ff7f")
    found.append(
        {
            "name": "live",
            "direction": "worker to subscribers",
            "message": {"header": msgspec.to_builtins(live), "values": {"bytes": rows.hex()}},
            "hex": encode_image(live, rows).hex(),
        }
    )
    to_daemon = (Ready, Ack, Progress, PointsNote, DecodedNote, LiveCounts, Result, Failed, Released, Alive, Leaving)
    for message in STREAM:
        direction = "worker to daemon" if isinstance(message, to_daemon) else "daemon to worker"
        found.append(_vector(f"worker: {message.__struct_config__.tag}", direction, message))
    return found


def as_json() -> str:
    """protocol-vectors.json."""
    content = {"format": "fringed-protocol-vectors", "version": 1, "protocol": list(PROTOCOL), "vectors": vectors()}
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def as_markdown() -> str:
    """The examples of protocol.md: message and bytes."""
    lines = []
    for vector in vectors():
        lines += [
            f"### {vector['name']}",
            "",
            f"*{vector['direction']}*",
            "",
            "```",
            json.dumps(vector["message"], ensure_ascii=False),
            *(vector["hex"][i : i + 96] for i in range(0, len(vector["hex"]), 96)),
            "```",
            "",
        ]
    return "\n".join(lines)


def with_examples(page: str) -> str:
    """The page with its examples made anew."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n\n{as_markdown()}\n{END}{after}"


def _vector(name: str, direction: str, message: Struct) -> dict[str, Any]:
    return {
        "name": name,
        "direction": direction,
        "message": _shown(msgspec.to_builtins(message, builtin_types=(bytes,))),
        "hex": encode(message).hex(),
    }


def _shown(content: Any) -> Any:
    if isinstance(content, bytes):
        return {"bytes": content.hex()}
    if isinstance(content, dict):
        return {key: _shown(value) for key, value in content.items()}
    return [_shown(value) for value in content] if isinstance(content, list) else content


def main() -> int:
    """Write the files into the given folder."""
    folder = Path(sys.argv[1])
    (folder / "protocol-vectors.json").write_text(as_json(), encoding="utf-8")
    page = folder / "protocol.md"
    page.write_text(with_examples(page.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
