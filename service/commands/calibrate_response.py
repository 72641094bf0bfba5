"""`fringed calibrate response`: how far a projector's light is from what was meant, by fringes or by grey levels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scanner.digits import with_uncertainty
from scanner.errors import CalibrationError
from service.commands.options import AsJson
from service.terminal import ProgressLines, print_error, print_facts, print_json, progress_lines

if TYPE_CHECKING:
    from scanner.calibration.grey_levels import LevelResponse
    from scanner.calibration.response import Response

IMAGES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg")


def response(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE", help="A PMP capture or scan, a rig (a file, or simulated[:SCENE]), or a folder of images."
        ),
    ],
    levels: Annotated[
        str | None,
        typer.Option(metavar="V,V,...", help="Of a folder of images: the grey level of each, in order of their names."),
    ] = None,
    write: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Calibration file to put the response into.")
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Find the projector's response (gamma, or a table) and, from fringes, the ripple it leaves.

    Any PMP capture with two frequencies or four shifts tells an exponent by its harmonics; a plain, bright surface is
    best. A rig shows grey levels instead, which tell any response. What is found is applied at projection: as
    precorrection of the patterns. For captures there are already: fringed decode --correct-ripple.

    \b
    Examples:
      fringed calibrate response scan
      fringed calibrate response simulated
      fringed calibrate response bench.toml --write calibration.json
      fringed calibrate response levels/ --levels 0,32,64,96,128,160,192,224,255 --json
    """
    from service.config import is_simulated  # noqa: PLC0415

    if write is not None:
        _try(write)
    with progress_lines() as lines:
        found: LevelResponse | Response
        if levels is not None:
            found = _of_images(Path(source), levels, lines)
        elif is_simulated(source) or source.endswith(".toml"):
            found = _of_rig(source, lines)
        else:
            found = _of_capture(Path(source), lines)
    of_projector, doubts = _projector_response(found), _warnings(found)
    if write is not None and not doubts:
        _write(write, of_projector)
    if as_json:
        print_json({**found.as_dict(), "response": of_projector})
    else:
        where = "nowhere: this exponent is doubtful" if doubts else _where(of_projector, write)
        print_facts("response", [*_facts(found), ("where", where)])
        for said in doubts:
            print_error(said, label="warning")
    if write is not None and doubts:
        raise CalibrationError(
            f"{write} was not changed: this exponent is doubtful, as the warnings say",
            hint="measure grey levels: fringed calibrate response RIG.toml --write FILE",
        )
    return 0


def _of_capture(path: Path, lines: ProgressLines) -> Response:
    lines.stage("opening the capture")
    from scanner.calibration.response import response_of_frames  # noqa: PLC0415  (array libraries and kernels)
    from scanner.capture import Capture  # noqa: PLC0415
    from scanner.errors import DecodeError  # noqa: PLC0415

    opened = Capture.open(path)
    sequence = opened.header.sequence
    if missing := [position for position in range(len(sequence)) if position not in opened.records]:
        raise DecodeError(
            f"frames {', '.join(map(str, missing))} are missing: the response is told by all of them",
            hint="capture again",
        )
    lines.stage("fitting the response")
    frames = [opened.frame(position) for position in range(len(sequence))]
    return response_of_frames(sequence, opened.header.camera, frames)


def _of_rig(name: str, lines: ProgressLines) -> LevelResponse:
    from scanner.clock import MonotonicClock  # noqa: PLC0415
    from service.config import load_rig  # noqa: PLC0415
    from service.response_measure import measure_response  # noqa: PLC0415

    return measure_response(load_rig(name), MonotonicClock(), lines.stage)


def _of_images(folder: Path, levels: str, lines: ProgressLines) -> LevelResponse:
    lines.stage("reading images")
    import cv2  # noqa: PLC0415

    from scanner.calibration.grey_levels import response_of_levels  # noqa: PLC0415
    from scanner.errors import CalibrationError  # noqa: PLC0415

    try:
        values = [int(v) for v in levels.split(",")]
    except ValueError as error:
        raise typer.BadParameter(f"--levels: expected numbers as 0,32,64, got {levels!r}") from error
    paths = sorted(p for p in folder.glob("*") if p.suffix.lower() in IMAGES)
    read = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH) for path in paths]
    frames: list[Any] = [frame for frame in read if frame is not None]
    if not paths:
        raise CalibrationError(
            f"{folder} has no images", hint=f"one image a level, named in their order: {', '.join(sorted(IMAGES))}"
        )
    if len(frames) != len(read):
        bad = ", ".join(path.name for path, frame in zip(paths, read, strict=True) if frame is None)
        raise CalibrationError(f"{folder}: cannot read {bad}", hint="save these again, or take them again")
    kinds = [f"{f.shape[1]} x {f.shape[0]} of {8 * f.dtype.itemsize} bits" for f in frames]
    if odd := next((i for i, kind in enumerate(kinds) if kind != kinds[0]), None):
        raise CalibrationError(
            f"{folder}: {paths[0].name} is {kinds[0]}, {paths[odd].name} is {kinds[odd]}",
            hint="take all levels with one camera, region and pixel format",
        )
    # The range of more than 8 bits is not told by an image: the whole bits of what is brightest stand for it.
    top = 255 if frames[0].dtype.itemsize == 1 else (1 << max(int(max(f.max() for f in frames)).bit_length(), 9)) - 1
    return response_of_levels(values, frames, top)


def _projector_response(found: LevelResponse | Response) -> dict[str, Any] | None:
    """What a calibration file says of it; None where fringes were projected through a table."""
    from scanner.calibration.response import Response  # noqa: PLC0415

    if isinstance(found, Response):
        return None if found.gamma is None else {"gamma": round(found.gamma, 4)}
    return found.response


def _try(path: Path) -> None:
    """What is measured will have to go in there."""
    from scanner.geometry import load_calibration  # noqa: PLC0415
    from scanner.storage import try_file  # noqa: PLC0415

    load_calibration(path)
    try_file(path)


def _write(path: Path, of_projector: dict[str, Any] | None) -> None:
    from scanner.calibration.calibration_file import as_text  # noqa: PLC0415
    from scanner.calibration_id import content_id  # noqa: PLC0415
    from scanner.errors import CalibrationError  # noqa: PLC0415
    from scanner.geometry import calibration_from_dict  # noqa: PLC0415
    from scanner.storage import replace_file  # noqa: PLC0415

    if of_projector is None:
        raise CalibrationError(
            "the capture was projected through a table, which an exponent cannot be put in place of",
            hint="measure by grey levels: fringed calibrate response RIG.toml --write FILE",
        )
    content = json.loads(path.read_text(encoding="utf-8"))
    camera = (content.get("response") or {}).get("camera")
    content["response"] = {"projector": of_projector, "camera": camera}
    content["id"] = content_id(content)
    calibration_from_dict(content, name=f"{path} with this response")
    replace_file(path, as_text(content).encode())


def _warnings(found: LevelResponse | Response) -> tuple[str, ...]:
    from scanner.calibration.response import Response  # noqa: PLC0415

    return found.warnings if isinstance(found, Response) else ()


def _facts(found: LevelResponse | Response) -> list[tuple[str, str]]:
    from scanner.calibration.response import BIAS, Response  # noqa: PLC0415

    if isinstance(found, Response):
        exponent = with_uncertainty(found.exponent, found.expanded)
        share = found.expanded / found.exponent
        projected = "" if found.gamma is None else with_uncertainty(found.gamma, share * found.gamma)
        return [
            ("exponent", f"{exponent} (k = 2) left in this capture (1: the light is linear)"),
            ("+-", f"noise, and {BIAS:.0%} of it{_pulled(found)}; grey levels tell any response"),
            ("ripple", f"{found.ripple_px:.3f} projector px rms in this capture"),
            ("misfit", f"{found.misfit_before:.2%} of the fringes, {found.misfit_after:.2%} with this exponent"),
            ("gamma to undo", projected or "the table used, followed by light ^ (1 / exponent)"),
        ]
    fits = "an exponent fits" if "gamma" in found.response else "no exponent fits: a table"
    gamma = with_uncertainty(found.gamma, 2 * found.sigma)
    steady = (
        "each shown once: whether the light is steady is not known"
        if found.unsteady is None
        else f"the light of one is steady to {found.unsteady:.2%}"
    )
    return [
        ("gamma", f"{gamma} (k = 2), with {found.misfit:.2%} of white left: {fits}"),
        ("levels", f"{len(found.levels)}, seen by {found.pixels:,} pixels; {steady}"),
    ]


def _pulled(found: Response) -> str:
    from scanner.calibration.response import PULL  # noqa: PLC0415

    if not found.blurred:
        return ""
    return f" and {PULL:.0%} of its distance from 1, to which blur draws it: one frequency cannot tell blur"


def _where(of_projector: dict[str, Any] | None, written: Path | None) -> str:
    if written is not None:
        return f"written to {written}: scans with it are corrected from now on"
    if of_projector is None:
        return (
            "of no use to a calibration file: a table was undone. Measure the rig: fringed calibrate response RIG.toml"
        )
    if "table" in of_projector:
        return "--write FILE puts the table into a calibration file, and scans undo it"
    return "--write FILE puts the gamma (with what is undone already) into a calibration file, and scans undo it"
