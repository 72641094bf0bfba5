"""`fringed scan`: one scan, from a running daemon or from a private one that lives as long as the command."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from service.commands.options import (
    AsJson,
    Box,
    Connect,
    DecoderName,
    Depth,
    EdgeFilter,
    Exposure,
    Force,
    Method,
    MinConfidence,
    OutputFolder,
    PatternOptions,
    filter_members,
)
from service.commands.pattern_options import UNSAID, takes_pattern
from service.commands.summary import report_result
from service.terminal import ProgressLines, progress_lines

if TYPE_CHECKING:
    from scanner.client import Client
    from scanner.errors import ScannerError
    from scanner.wire import Event

INCOMING = ".incoming"
"""Folder inside the output folder where files arrive, until all are there"""

CANCEL_S = 5.0
"""How long an interrupted command waits to hear that its scan has stopped"""


@takes_pattern
def scan(
    rig: Annotated[
        str | None,
        typer.Option(metavar="RIG", help="A rig file, or simulated[:SCENE], as simulated:bench2026/sphere_board."),
    ] = None,
    method: Annotated[
        Method,
        typer.Option(
            metavar="pmp|mcp|gray|gray+pmp|cp",
            help="What to project: phase shifts (pmp), one frame (mcp, cp), Gray code, or both.",
        ),
    ] = Method.PMP,
    output: OutputFolder = None,
    connect: Connect = None,
    exposure: Exposure = None,
    pattern: PatternOptions = UNSAID,
    repeat: Annotated[
        int,
        typer.Option(
            metavar="N", min=1, max=1000, help="Repetitions of the whole sequence, averaged: less random error."
        ),
    ] = 1,
    depth: Depth = None,
    box: Box = None,
    min_confidence: MinConfidence = None,
    edge_filter: EdgeFilter = True,
    decoder: DecoderName = "default",
    compare_truth: Annotated[
        bool, typer.Option("--compare-truth", help="Simulated rigs: compare with the truth, in the report and a map.")
    ] = False,
    force: Force = False,
    as_json: AsJson = False,
) -> int:
    """Scan: project, capture, decode; a point cloud, a picture and a report.

    Without --rig and --connect the rig is the simulated one. Without -o the folder is scan-DATE-TIME. Besides the
    pattern's own frames, a sequence has black and white ones around it and one of bars: they prove which frame saw
    which pattern. One frame alone (mcp, cp) needs none.

    \b
    Examples:
      fringed scan                                         the simulated rig, PMP
      fringed scan --method mcp -o scans/one-frame         one frame
      fringed scan --rig simulated:bench2026/sphere_board --compare-truth
      fringed scan --rig bench.toml --depth 400:700        real devices
      fringed scan --connect ipc:///run/fringed/control.ipc
      fringed scan --frequencies 1,8,64 --shifts 4,4,16 --json
    """
    if rig is not None and connect is not None:
        raise typer.BadParameter("--rig and --connect exclude each other: a running daemon has a rig of its own")
    members = pattern.members(method)
    params: dict[str, Any] = {
        "pattern": members or None,
        "exposure": None if exposure is None else exposure_given(exposure),
        "decoder": decoder,
        "filters": filter_members(depth, box, min_confidence, edge_filter=edge_filter),
        "compare_truth": compare_truth,
        "repeat": repeat,
    }
    place = Place(output, force)
    place.check()
    began = time.monotonic()
    with progress_lines() as lines, rig_daemon(rig, connect, lines) as endpoint:
        folder = _scan(endpoint, method, params, place, lines)
        lines.stage("ending")
    report_result(folder, time.monotonic() - began, lines.spent, as_json=as_json)
    return 0


@dataclass(frozen=True)
class Place:
    """Where a scan's files go. Its folder is made when they arrive: a command that is killed before leaves none."""

    wanted: Path | None
    force: bool

    @property
    def folder(self) -> Path:
        """The one that was asked for, or one that is free now."""
        return self.wanted or _fresh_folder()

    @property
    def failed(self) -> Path:
        """Beside it, for the frames of a scan that failed: the same command can be typed again."""
        beside = self.folder.resolve()
        name = f"{beside.name or 'scan'}-failed"
        names = chain([name], (f"{name}-{n}" for n in count(2)))
        return next(folder for folder in (beside.parent / name for name in names) if not folder.exists())

    def check(self) -> None:
        """Raise StorageError where no folder can be made, before anything moves."""
        from scanner.storage import try_output  # noqa: PLC0415

        try_output(self.folder, force=self.force)

    @contextmanager
    def made(self) -> Iterator[Path]:
        """The folder; one that was made for files that do not arrive is removed again."""
        from scanner.storage import not_there, prepare_output, remove_empty  # noqa: PLC0415

        folder = self.folder
        new = not_there(folder)
        prepare_output(folder, force=self.force)
        incoming = folder / INCOMING
        shutil.rmtree(incoming, ignore_errors=True)  # of a command that was killed: its files are another scan's
        try:
            yield folder
        except BaseException:
            shutil.rmtree(incoming, ignore_errors=True)
            remove_empty(new)
            raise


def _fresh_folder() -> Path:
    """scan-DATE-TIME in the working directory, with a number behind it where that exists."""
    name = datetime.now().astimezone().strftime("scan-%Y%m%d-%H%M%S")
    numbered = (f"{name}-{n}" for n in count(2))
    return next(folder for folder in map(Path, chain([name], numbered)) if not folder.exists())


def exposure_given(text: str) -> float | Literal["auto"]:
    """An exposure as the command line has it: auto, or microseconds.

    Raises:
        typer.BadParameter: neither.
    """
    if text == "auto":
        return "auto"
    try:
        value = float(text)
    except ValueError as error:
        raise typer.BadParameter(f"--exposure: expected auto or microseconds, got {text!r}") from error
    if not 1 <= value <= 10_000_000:
        raise typer.BadParameter(f"--exposure: expected 1 .. 10000000 microseconds, got {text!r}")
    return value


@contextmanager
def rig_daemon(rig: str | None, connect: str | None, lines: ProgressLines) -> Iterator[str]:
    """Endpoint of the daemon to ask: the one named, or a private one with this rig."""
    if connect is not None:
        yield connect
        return
    from service.config import load_rig  # noqa: PLC0415
    from service.private import private_daemon  # noqa: PLC0415

    config = load_rig(rig or "simulated")
    lines.stage(f"starting {config.rig.name}")
    with private_daemon(config) as endpoint:
        yield endpoint


def _scan(endpoint: str, method: Method, params: Mapping[str, Any], place: Place, lines: ProgressLines) -> Path:
    """Start the job, follow it, fetch its files into place; returns their folder."""
    from scanner.client import Client  # noqa: PLC0415
    from scanner.errors import StorageError  # noqa: PLC0415
    from scanner.session import raise_unless_done  # noqa: PLC0415

    with Client(endpoint, name="fringed scan") as client:
        job_id = client.start_scan(method.value, **params)
        try:
            outcome = client.wait(job_id, _follower(place.folder, lines))
            if outcome["state"] == "failed" and outcome["files"]:
                raise _with_frames_kept(client, outcome, place, lines)
            raise_unless_done(outcome)
            lines.stage("fetching files")
            with place.made() as folder:
                client.fetch(job_id, folder / INCOMING, lambda _, done, total: lines.advance(done, total))
                _into_place(folder / INCOMING, folder)
        except (KeyboardInterrupt, SystemExit, StorageError):
            _cancel(client, job_id)
            raise
    return folder


def _with_frames_kept(client: Client, outcome: Mapping[str, Any], place: Place, lines: ProgressLines) -> ScannerError:
    """Bring what a failed scan recorded into a folder of its own; returns the scan's error, which then says where."""
    from scanner.errors import ScannerError, StorageError  # noqa: PLC0415
    from scanner.session import error_of  # noqa: PLC0415
    from scanner.storage import storage_errors  # noqa: PLC0415

    error, job_id, folder = error_of(outcome), str(outcome["id"]), place.failed
    incoming = folder.with_name(f".{folder.name}{INCOMING}")
    try:
        lines.stage("fetching the frames of the failed scan")
        shutil.rmtree(incoming, ignore_errors=True)  # of a command that was killed
        with storage_errors(folder):
            incoming.mkdir(parents=True)
            client.fetch(job_id, incoming, lambda _, done, total: lines.advance(done, total), failed_too=True)
            if not any(incoming.iterdir()):
                raise StorageError("the daemon has them no more")
            incoming.replace(folder)
        kept = f"its frames are kept: fringed audit {_as_typed(folder)}"
    except ScannerError as problem:
        kept = f"its frames could not be kept: {problem}"
    finally:
        shutil.rmtree(incoming, ignore_errors=True)
    error.hint = f"{error.hint}; {kept}" if error.hint else kept
    return error


def _as_typed(folder: Path) -> Path:
    """From the working directory, where it lies in there."""
    return folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder


def _follower(folder: Path, lines: ProgressLines) -> Callable[[Event], None]:
    """Draws a job's events, and asks for room under `folder` as soon as the plan says how much is needed."""
    from scanner.storage import check_room  # noqa: PLC0415

    def follow(event: Event) -> None:
        fields = event.fields
        match event.kind:
            case "queued":
                lines.stage("waiting for the rig")
            case "started":
                lines.stage("preparing")
            case "plan":
                check_room(folder, int(fields["bytes"]))
            case "frame" | "acquiring":  # the latter is the state that stands for events that were lost
                done, total = int(fields.get("captured", 0)), int(fields.get("total", 0))
                lines.stage("capturing" if total else "preparing", total or None)
                if total:
                    lines.advance(done, total, f"{done} of {total} frames")
            case "retake":
                total = int(fields.get("total", 0))
                lines.stage("capturing", total or None)
                lines.advance(
                    total, total, f"{total} frames; {_counted(fields.get('retakes'))} taken again: out of step"
                )
            case "acquired":
                lines.stage("reading frames")
            case "decoding":
                stage = str(fields.get("stage") or "reading frames")
                lines.stage("writing files" if stage.startswith("wrote ") else stage)

    return follow


def _counted(retakes: Any) -> str:
    return "1 was" if retakes == 1 else f"{retakes} were"


def _cancel(client: Client, job_id: str) -> None:
    client.timeout_s = CANCEL_S
    client.cancel(job_id)


def _into_place(incoming: Path, folder: Path) -> None:
    """Move what has arrived whole into the output folder, in place of what an earlier scan left there."""
    from scanner.storage import storage_errors, sync_folder  # noqa: PLC0415

    with storage_errors(folder):
        for name in ("report.json", "error_map.png", "cloud.ply"):  # files that not every scan has
            (folder / name).unlink(missing_ok=True)
        for path in sorted(incoming.iterdir(), key=lambda path: path.name == "report.json"):
            target = folder / path.name
            if target.is_dir():
                shutil.rmtree(target)
            path.replace(target)
        incoming.rmdir()
        sync_folder(folder)
