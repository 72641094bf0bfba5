"""`fringed calibrate marks`: fixed discs or a plate in the field, measured now, to be measured again in each scan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from service.commands.calibrate_solve import Replace
from service.commands.options import AsJson, output_path, require_free
from service.terminal import print_error, print_facts, print_json, progress_lines


def marks(
    scan: Annotated[Path, typer.Argument(metavar="SCAN", help="A scan's folder, taken when the rig was calibrated.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE", parser=output_path, help="File of marks to write.")
    ],
    at: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y", help="Camera pixel on or beside a disc; three times or more."),
    ] = None,
    plate: Annotated[
        str | None,
        typer.Option(metavar="X,Y,W,H", help="Part of the camera's picture, pixels, that shows a flat plate alone."),
    ] = None,
    force: Replace = False,
    as_json: AsJson = False,
) -> int:
    """Measure witness marks for the first time.

    Discs of one grey on another, ten pixels across or more, or a flat plate, fixed where every scan sees them. Name the
    file under [rig] in the rig file: each scan's report then says by how many mm they have moved.

    \b
    Examples:
      fringed calibrate marks scan --plate 20,20,160,120 -o scans/marks.json      the simulated wall as plate
      fringed calibrate marks today/ --at 80,90 --at 1300,95 --at 690,980 -o marks.json
    """
    require_free(output, force=force)
    places = [_numbers(text, 2, "--at") for text in at or ()]
    region = None if plate is None else region_given(plate, "--plate")
    with progress_lines() as lines:
        lines.stage("measuring marks")
        from scanner.calibration.marks import reference_marks  # noqa: PLC0415
        from scanner.errors import DecodeError  # noqa: PLC0415
        from scanner.scan import load_scan  # noqa: PLC0415
        from scanner.storage import replace_json, try_file  # noqa: PLC0415

        try_file(output)
        opened = load_scan(scan)
        if opened.xyz is None:
            raise DecodeError(
                f"{scan} has no points", hint="decode it with a calibration: fringed decode --calibration"
            )
        found = reference_marks(
            opened.albedo,
            opened.xyz,
            [(x, y) for x, y in places],
            region,
            str((opened.report.get("rig") or {}).get("calibration", "")),
        )
        replace_json(output, found.as_dict())
    if found.in_line:
        print_error(
            "the marks lie on one line: a turn about it moves none of them",
            "fix one more beside it, or a plate",
            label="warning",
        )
    if as_json:
        print_json({"file": str(output), **found.as_dict()})
        return 0
    facts: list[tuple[str, Any]] = [
        (f"mark {mark.name}", f"at {_words(mark.at, 2)} px, {_words(mark.xyz, 3)} mm") for mark in found.points
    ]
    if found.plate is not None:
        facts.append(("plate", f"at {_words(found.plate.point, 3)} mm, normal {_words(found.plate.normal, 4)}"))
    print_facts("marks", [*facts, ("file", output), ("in the rig file", f'[rig] marks = "{output.absolute()}"')])
    return 0


def region_given(text: str, option: str) -> tuple[int, int, int, int]:
    """X,Y,W,H as whole pixels.

    Raises:
        typer.BadParameter: it is not.
    """
    x, y, width, height = (round(value) for value in _numbers(text, 4, option))
    if min(width, height) < 1:
        raise typer.BadParameter(f"{option}: {text!r} holds no pixel")
    return x, y, width, height


def _numbers(text: str, count: int, option: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(0 <= value < 65_536 for value in values):
        raise typer.BadParameter(f"{option}: expected {count} pixel numbers with commas between, got {text!r}")
    return values


def _words(values: tuple[float, ...], digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)
