"""`fringed decode` of a recorded live run: each frame by itself, as the run decoded it, into a folder of its own."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from service.terminal import print_error, print_facts, print_json, progress_lines

if TYPE_CHECKING:
    from scanner.capture import Capture
    from scanner.reconstruct_live import LiveReconstruction

RESULT_BYTES_PER_PIXEL = 110
"""As for the files of a scan (`service.acquisition`)."""


@dataclass(frozen=True, eq=False)
class _Frame:
    number: int
    """in the live run"""
    capture: Capture
    pattern: int


def decode_recording(
    path: Path,
    calibration: Path | None,
    output: Path | None,
    settings: Mapping[str, Any],
    frames: str | None,
    *,
    force: bool,
    as_json: bool,
) -> int:
    """Decode a recording; frames that show no pattern are named and left out.

    Raises:
        ScannerError: it cannot be read or written, or no frame of it can be decoded.
    """
    wanted = _numbers(frames)
    began = time.monotonic()
    with progress_lines() as lines:
        lines.stage("opening the recording")
        from scanner.errors import DecodeError  # noqa: PLC0415
        from scanner.storage import check_room, prepare_output  # noqa: PLC0415

        chosen = [frame for frame in _frames(path) if wanted is None or frame.number in wanted]
        if not chosen:
            raise DecodeError(f"{path} has none of these frames", hint="fringed decode without --frames takes all")
        folder = output or (path if path.is_dir() else path.parent) / "scan"
        camera = chosen[0].capture.header.camera
        check_room(folder, len(chosen) * RESULT_BYTES_PER_PIXEL * camera.width * camera.height)
        prepare_output(folder, force=force)
        decoder = _decoder(chosen[0].capture, calibration, settings)
        lines.stage("decoding", len(chosen))
        points: dict[int, int] = {}
        failed: dict[int, str] = {}
        for done, frame in enumerate(chosen):
            lines.advance(done, len(chosen), f"{done} of {len(chosen)} frames")
            try:
                points[frame.number] = _decode(decoder, frame, folder)
            except DecodeError as error:
                failed[frame.number] = str(error)
        lines.advance(len(chosen), len(chosen), f"{len(chosen)} frames")
    if not points:
        raise DecodeError(f"no frame of {path} could be decoded; the first: {failed[min(failed)]}")
    for number, problem in failed.items():
        print_error(f"frame {number} was left out: {problem}", label="warning")
    _report(folder, points, failed, time.monotonic() - began, as_json=as_json)
    return 0


def _frames(path: Path) -> Iterator[_Frame]:
    from scanner.capture import Capture  # noqa: PLC0415
    from scanner.series import recording_at  # noqa: PLC0415

    for part in recording_at(path) or ():
        capture = Capture.open(part.path)
        for pattern in capture.records:
            yield _Frame(part.first + pattern, capture, pattern)


def _decoder(capture: Capture, calibration: Path | None, settings: Mapping[str, Any]) -> LiveReconstruction:
    from scanner.decode_options import DecodeOptions  # noqa: PLC0415
    from scanner.reconstruct import calibration_for  # noqa: PLC0415
    from scanner.reconstruct_live import LiveReconstruction  # noqa: PLC0415

    lenses = calibration_for(capture, calibration)
    if lenses is None:
        print_error("no calibration: values are decoded, but no points", "--calibration FILE", label="warning")
    return LiveReconstruction(capture.header, lenses, DecodeOptions.from_dict(settings), follow=False)


def _decode(decoder: LiveReconstruction, frame: _Frame, folder: Path) -> int:
    """Number of points of the frame's scan, which is then in its folder."""
    scan = decoder.scan(frame.capture.frame(frame.pattern))
    record = frame.capture.records[frame.pattern]
    exposure = record.exposure
    scan = scan.with_report(
        live={
            "number": frame.number,
            "series": frame.capture.header.id,
            "frame_id": record.frame_id,
            "verdict": record.verdict,
            "exposure_ns": None if exposure is None else [exposure.start_ns, exposure.end_ns],
        }
    )
    scan.save(folder / f"{frame.number:06d}")
    return int(scan.report["points"])


def _numbers(text: str | None) -> range | None:
    if text is None:
        return None
    first, colon, last = text.partition(":")
    try:
        low = int(first) if first else 0
        high = (int(last) if last else 10**9) if colon else low
    except ValueError:
        low, high = 1, 0
    if low < 0 or low > high:
        raise typer.BadParameter(f"--frames: expected FIRST:LAST, as 100:109, got {text!r}")
    return range(low, high + 1)


def _report(
    folder: Path, points: Mapping[int, int], failed: Mapping[int, str], seconds: float, *, as_json: bool
) -> None:
    if as_json:
        print_json(
            {
                "folder": str(folder),
                "seconds": round(seconds, 3),
                "frames": [{"number": n, "folder": f"{n:06d}", "points": count} for n, count in points.items()],
                "failed": [{"number": n, "error": problem} for n, problem in failed.items()],
            }
        )
        return
    facts = [
        ("frames", f"{len(points):,}" + (f", {len(failed):,} left out" if failed else "")),
        ("points", f"{sum(points.values()):,}"),
        ("time", f"{seconds:.1f} s"),
        ("folders", f"{folder}/{min(points):06d} .. {max(points):06d}"),
    ]
    print_facts("recording", facts)
