"""`fringed decode`: a capture folder, from here or from elsewhere, to a scan. Needs no daemon and no device."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.commands.decode_recording import decode_recording
from service.commands.options import (
    AsJson,
    Box,
    DecoderName,
    Depth,
    EdgeFilter,
    Force,
    MinConfidence,
    OutputFolder,
    filter_members,
    output_path,
)
from service.commands.summary import report_result
from service.terminal import print_error, progress_lines

if TYPE_CHECKING:
    from scanner.geometry import Calibration


def decode(
    capture: Annotated[
        Path, typer.Argument(metavar="CAPTURE", help="A capture's or a scan's folder, a recording, or a JSON file.")
    ],
    calibration: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Calibration to use instead of the capture's own.")
    ] = None,
    output: OutputFolder = None,
    decoder: DecoderName = "default",
    stages: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", parser=output_path, help="Folder for pictures of the decoder's stages, 01-input.png and on."
        ),
    ] = None,
    frames: Annotated[
        str | None, typer.Option(metavar="FIRST:LAST", help="Recordings of live runs: these frames only, as 100:109.")
    ] = None,
    depth: Depth = None,
    box: Box = None,
    min_confidence: MinConfidence = None,
    edge_filter: EdgeFilter = True,
    correct_ripple: Annotated[
        bool,
        typer.Option("--correct-ripple", help="PMP of 3 to 5 shifts: take off the ripple that the response has left."),
    ] = False,
    compare_truth: Annotated[
        bool, typer.Option("--compare-truth", help="Captures of simulated rigs: compare with the truth.")
    ] = False,
    force: Force = False,
    as_json: AsJson = False,
) -> int:
    """Decode a capture into a point cloud, or each frame of a recorded live run into one.

    Without -o the files go to the folder scan beside the capture's JSON file; those of a recording to a folder for
    each frame in there.

    \b
    Examples:
      fringed decode scan -o scans/unfiltered --no-edge-filter
      fringed decode scan -o scans/near --depth 1000:1400
      fringed decode skull/capture-gray.json --calibration skull/calibration.json     made elsewhere
    After fringed scan --method mcp -o scans/one-frame, and fringed live --record scans/take1 --seconds 5:
      fringed decode scans/one-frame -o scans/published --decoder casey2011 --stages scans/stages
      fringed decode scans/take1 --frames 0:9
    """
    filters = filter_members(depth, box, min_confidence, edge_filter=edge_filter)
    began = time.monotonic()
    from scanner.series import recording_at  # noqa: PLC0415

    if recording_at(capture) is not None:
        if stages is not None or compare_truth:
            raise typer.BadParameter("--stages and --compare-truth say nothing to a recording of a live run")
        settings = {"decoder": decoder, "filters": filters}
        return decode_recording(capture, calibration, output, settings, frames, force=force, as_json=as_json)
    if frames is not None:
        raise typer.BadParameter("--frames chooses from a recording of a live run, and this is none")
    with progress_lines() as lines:
        lines.stage("opening the capture")
        from scanner.capture import Capture  # noqa: PLC0415  (array libraries and kernels)
        from scanner.decode_options import DecodeOptions  # noqa: PLC0415
        from scanner.reconstruct import calibration_for, reconstruct  # noqa: PLC0415
        from scanner.stage_pictures import StageFolder  # noqa: PLC0415
        from scanner.storage import not_there, prepare_output, remove_empty  # noqa: PLC0415

        chosen = {"decoder": decoder, "filters": filters, "compare_truth": compare_truth}
        options = DecodeOptions.from_dict({**chosen, "correct_ripple": correct_ripple})
        opened = Capture.open(capture)
        lens_file = calibration_for(opened, calibration)
        # Of a folder that is still being recorded frames are not lost, but still to come.
        lost = None if opened.header.state == "open" else opened.lost
        folder = output or opened.path / "scan"
        new = [not_there(made_here) for made_here in (stages, folder) if made_here is not None]
        observer: StageFolder | None = None
        try:
            prepare_output(folder, force=force)
            if stages is not None:
                observer = StageFolder(prepare_output(stages, force=force))
            made = reconstruct(opened, lens_file, options, lines.stage, observer)
            if lost is not None:
                made = made.with_report(warnings=[lost, *made.report["warnings"]])
            lines.stage("writing files")
            _keep_calibration(lens_file, folder, opened.path)
            made.save(folder)
        except BaseException:
            if lost is not None:
                lines.note(lost)
            # The stages up to a failure stay: they are what it is looked for with.
            if observer is not None and observer.written:
                lines.note(f"stages up to the failure: {stages}")
            for made_here in new:
                remove_empty(made_here)
            raise
        if observer is not None:
            lines.note(f"{len(observer.written)} stages: {stages}")
    if made.xyz is None:
        print_error("no calibration: values are decoded, but no points", "--calibration FILE", label="warning")
    report_result(folder, time.monotonic() - began, lines.spent, as_json=as_json)
    return 0


def _keep_calibration(calibration: Calibration | None, folder: Path, capture: Path) -> None:
    """Store what the points are made with beside them, as a capture does; its own file stays as it is."""
    from scanner.storage import replace_json  # noqa: PLC0415

    if calibration is not None and folder.resolve() != capture.resolve():
        replace_json(folder / "calibration.json", calibration.as_dict())
