"""`fringed live`: one pattern stays on, and every camera frame becomes a point cloud as it comes."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.commands.options import (
    AsJson,
    AxisOption,
    Bits,
    Box,
    Carriers,
    Codes,
    Connect,
    DecoderName,
    Depth,
    EdgeFilter,
    Exposure,
    First,
    Force,
    Levels,
    Method,
    MinConfidence,
    PatternOptions,
    Profile,
    Unmodulated,
    filter_members,
    output_path,
    require_picture,
)
from service.commands.scan import exposure_given, rig_daemon
from service.terminal import print_error, print_facts, print_json, progress_lines, status_line

if TYPE_CHECKING:
    from scanner.client import Client
    from scanner.live import LiveFrame

LINE_S = 1.0
FIRST_S = 0.1
"""The line and the picture are made anew this often."""

CLOSE_S = 600.0
"""How long a recording may take to be closed and listed; a daemon that is gone shows itself much sooner."""

INCOMING = ".incoming"


def live(
    rig: Annotated[
        str | None, typer.Option(metavar="RIG", help="A rig file, or simulated[:SCENE], as simulated:casey2011/bust.")
    ] = None,
    connect: Connect = None,
    xyz: Annotated[bool, typer.Option("--xyz", help="Send points in mm instead of projector rows.")] = False,
    stride: Annotated[
        int,
        typer.Option(
            metavar="N", min=1, max=64, help="With --xyz: every Nth pixel both ways (2: a quarter of the points)."
        ),
    ] = 1,
    seconds: Annotated[
        float | None, typer.Option(metavar="S", min=0.1, max=31_536_000, help="End after this long.")
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(metavar="DIR", parser=output_path, help="Keep all frames, as captures, in this folder."),
    ] = None,
    last: Annotated[
        float | None, typer.Option(metavar="S", min=0.1, max=3600, help="With --record: keep the last S seconds only.")
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FILE", parser=output_path, help="A picture (png, jpg), made anew every second."),
    ] = None,
    exposure: Exposure = None,
    axis: AxisOption = None,
    bits: Bits = None,
    carriers: Carriers = None,
    profile: Profile = None,
    levels: Levels = None,
    codes: Codes = None,
    first: First = None,
    unmodulated: Unmodulated = None,
    depth: Depth = None,
    box: Box = None,
    min_confidence: MinConfidence = None,
    edge_filter: EdgeFilter = True,
    decoder: DecoderName = "default",
    force: Force = False,
    as_json: AsJson = False,
) -> int:
    """Live 3-D: one MCP pattern stays on, every camera frame is decoded as it comes. Ctrl-C ends it, with a table.

    Once a second a line tells the rates, what was dropped, and the latency from the end of the exposure to the result.
    Programs read the results meanwhile (client.live_frames, or the live socket).

    \b
    Examples:
      fringed live                                         the simulated rig, until Ctrl-C
      fringed live --rig bench.toml --picture now.png      and look at now.png
      fringed live --xyz --stride 2 --seconds 10 --json
      fringed live --record scans/take1 --seconds 5        then: fringed decode scans/take1 --frames 0:9
    """
    if rig is not None and connect is not None:
        raise typer.BadParameter("--rig and --connect exclude each other: a running daemon has a rig of its own")
    if last is not None and record is None:
        raise typer.BadParameter("--last says what --record keeps: give both")
    if stride > 1 and not xyz:
        raise typer.BadParameter("--stride thins points: give --xyz too")
    if picture is not None:
        require_picture(picture)
        from scanner.storage import try_file  # noqa: PLC0415

        try_file(picture)
    said = PatternOptions(None, None, axis, bits, carriers, profile, levels, None, codes, first, unmodulated)
    members = said.members(Method.MCP)
    params: dict[str, Any] = {
        "pattern": members or None,
        "exposure": None if exposure is None else exposure_given(exposure),
        "decoder": decoder,
        "content": "xyz" if xyz else "rows",
        "stride": stride,
        "filters": filter_members(depth, box, min_confidence, edge_filter=edge_filter),
        "retain": "none" if record is None else "record" if last is None else "ring",
        "ring_s": last,
        "seconds": seconds,
    }
    if record is not None:
        from scanner.storage import prepare_output  # noqa: PLC0415

        prepare_output(record, force=force)
    with progress_lines() as lines, rig_daemon(rig, connect, lines) as endpoint:
        lines.stage("preparing")
        outcome = _live(endpoint, params, record, picture, lines.end)
    _report(outcome, record, as_json=as_json)
    return 0


def _live(
    endpoint: str, params: Mapping[str, Any], record: Path | None, picture: Path | None, begun: Any
) -> dict[str, Any]:
    from scanner.client import Client  # noqa: PLC0415

    with Client(endpoint, name="fringed live") as client:
        job_id = client.live_start(**params)["id"]
        watching = _Watching(client, picture, begun)
        try:
            with suppress(KeyboardInterrupt), status_line() as line:  # Ctrl-C is how a run is ended
                watching.all(client.live_frames(job_id), line)
        finally:
            begun()
            stop(client, job_id)
            if record is not None:
                _fetch(client, job_id, record)
        outcome = client.result(job_id)
    return {**outcome, "results_read": watching.read, "points_sent": watching.sent}


def stop(client: Client, job_id: str) -> None:
    """End the run and wait until its job is over: nothing of it is under way any more."""
    client.live_stop(job_id)
    deadline = time.monotonic() + CLOSE_S
    while client.call("scan.status", id=job_id)["state"] not in ("done", "failed", "cancelled"):
        if time.monotonic() > deadline:
            break
        time.sleep(0.05)


class _Watching:
    """Reads results, draws the newest now and then."""

    def __init__(self, client: Client, picture: Path | None, begun: Any) -> None:
        self.read = 0
        self.sent: int | None = None
        """see `sent_points`, of the newest result that was looked at"""
        self._client = client
        self._picture = picture
        self._begun = begun
        self._next = 0.0

    def all(self, frames: Iterator[LiveFrame], line: Any) -> None:
        for frame in frames:
            if self.read == 0:
                self._begun()
            self.read += 1
            if time.monotonic() < self._next:
                continue
            self._next = time.monotonic() + LINE_S
            run = self._client.live_status()
            if run is None:
                return
            if (
                run["live"]["latency_ms"]["p50"] is None and not run["live"]["problem"]
            ):  # the first result is here before the first figures
                self._next = time.monotonic() + FIRST_S
                continue
            self.sent = sent_points(frame)
            line(figures(run["live"], self.sent))
            if self._picture is not None:
                _draw(self._picture, frame, f"{run['live']['results_per_s']:.0f} a second")


def sent_points(frame: LiveFrame) -> int | None:
    """Points that a thinned result holds; None where all are sent."""
    import numpy as np  # noqa: PLC0415

    if frame.xyz is None or frame.header.stride == 1:
        return None
    return int(np.count_nonzero(np.isfinite(frame.xyz[..., 2])))


def figures(live: Mapping[str, Any], sent: int | None = None) -> str:
    """The line: rates, drops, latency, points; `sent`: of those, where they are thinned."""
    latency = live["latency_ms"]
    parts = [
        f"{live['frames_per_s']:.1f} frames/s in",
        f"{live['results_per_s']:.1f} decoded",
        f"{live['dropped']:,} dropped",
        f"{live['lost']:,} lost" if live["lost"] else "",
        f"latency {_ms(latency['p50'])}, p99 {_ms(latency['p99'])}",
        _points(live["points"], sent),
        "recording" if live["retain"] != "none" else "",
        f"({live['problem']})" if live["problem"] else "",
    ]
    return "  ".join(part for part in parts if part)


def _points(whole: int, sent: int | None) -> str:
    """Of the last second's events, and of the last result: the first result may come before the first event."""
    if sent is None:
        return f"{whole:,} points"
    return f"{sent:,} points sent" + (f" of {whole:,}" if whole else "")


def _draw(path: Path, frame: LiveFrame, caption: str) -> None:
    from scanner.live_picture import encoded, live_picture  # noqa: PLC0415
    from scanner.storage import replace_file  # noqa: PLC0415

    replace_file(path, encoded(live_picture(frame, caption), path.suffix))


def _fetch(client: Client, job_id: str, folder: Path) -> None:
    """Bring the recording, also of a run that failed: its folders and series.json right into `folder`."""
    from scanner.storage import check_room, storage_errors, sync_folder  # noqa: PLC0415

    files = client.result(job_id)["files"]
    if not files:
        return
    incoming = folder / INCOMING
    check_room(folder, sum(entry["bytes"] for entry in files))
    try:
        with progress_lines() as lines:
            lines.stage("fetching the recording")
            client.fetch(job_id, incoming, lambda _, done, total: lines.advance(done, total), failed_too=True)
        with storage_errors(folder):
            for path in (incoming / "capture").iterdir():
                target = folder / path.name
                if target.is_dir():
                    shutil.rmtree(target)
                path.replace(target)
            sync_folder(folder)
    finally:
        shutil.rmtree(incoming, ignore_errors=True)


def _report(outcome: Mapping[str, Any], record: Path | None, *, as_json: bool) -> None:
    report = dict(outcome["report"])
    report.pop("header", None)
    report.pop("calibration", None)
    if as_json:
        place = None if record is None else str(record)
        own = {key: outcome[key] for key in ("results_read", "points_sent")}
        print_json({"state": outcome["state"], "folder": place, **own, **report})
        return
    latency = report["latency_ms"]
    facts = [
        ("time", f"{report['seconds']:.1f} s"),
        ("frames", f"{report['captured']:,} ({report['frames_per_s']:.1f} a second)"),
        ("decoded", f"{report['decoded']:,} ({report['results_per_s']:.1f} a second)"),
        ("dropped", f"{report['dropped']:,}"),
        ("lost by the camera", f"{report['lost']:,}"),
        ("undecodable", f"{report['undecodable']:,}"),
        ("latency", ", ".join(f"{name} {_ms(latency[name])}" for name in ("p50", "p90", "p99", "max"))),
    ]
    if record is not None:
        facts += [("recorded", f"{report['recorded']['frames']:,} frames"), ("recording", str(record))]
    print_facts("live", facts)
    if report["problem"]:
        print_error(f"the last frame gave nothing: {report['problem']}", label="warning")


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f} ms"
